"""Sums in a fixed order: as accurate as others, and the same bits whatever the order of their terms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import compiled
from jaxnerf import hash_grid_field
from jaxnerf.core import fixed_order
from jaxnerf.core.fixed_order import segment_sums

add_rows = compiled(fixed_order.add_rows, "num_rows")


def values_and_rows(count=4000, num_rows=7):
    rng = np.random.default_rng(0)
    values = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-9, 3, size=(count, 1))
    return values.astype(np.float32), rng.integers(num_rows - 1, size=count)


def test_rows_are_summed_exactly_up_to_the_smallest_part():
    values, rows = values_and_rows()
    sums = np.asarray(add_rows(values, rows, 7))
    exact = np.zeros((7, 3))
    np.add.at(exact, rows, values.astype(np.float64))
    np.testing.assert_allclose(sums, exact, rtol=2**-23, atol=len(values) * 2.0**-50 * np.abs(values).max())
    assert (sums[6] == 0).all()  # no value has this row


def test_the_order_does_not_matter_to_a_single_bit():
    values, rows = values_and_rows()
    order = np.random.default_rng(1).permutation(len(rows))
    np.testing.assert_array_equal(add_rows(values, rows, 7), add_rows(values[order], rows[order], 7))


@pytest.mark.parametrize("scale", [1e-30, 1e30, 0.0])
def test_values_of_any_size_are_summed(scale):
    values = np.full((6, 1), scale, np.float32)
    np.testing.assert_allclose(add_rows(values, np.zeros(6, int), 2), [[6 * scale], [0]], rtol=1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_value_that_is_not_finite_is_visible(bad):
    assert np.isnan(add_rows(np.array([[1.0], [bad]], np.float32), np.array([0, 1]), 2)).all()


def test_no_values_sum_to_zero():
    np.testing.assert_array_equal(add_rows(np.zeros((0, 2)), np.zeros(0, int), 3), np.zeros((3, 2)))
    nowhere = np.zeros(0, int), np.zeros(0, bool), np.zeros(0, bool)
    np.testing.assert_array_equal(segment_sums(np.zeros((0, 2)), *nowhere, 3, 4), np.zeros((3, 2)))


def test_segments_have_the_sums_and_gradients_of_jax():
    segment = jnp.array([0, 0, 0, 2, 2, 4, 4, 4, 4, 4])
    used = jnp.arange(10) < 7  # the others are beyond the longest segment
    starts = segment != jnp.roll(segment, 1).at[0].set(-1)
    values = jax.random.normal(jax.random.key(0), (10, 2))

    def in_order(values):
        return segment_sums(values, segment, starts, used, 5, 3)

    def plain(values):
        return jax.ops.segment_sum(jnp.where(used[:, None], values, 0), segment, 5)

    sums = np.asarray(plain(values))
    np.testing.assert_allclose(jax.jit(in_order)(values), sums, rtol=1e-6)
    for function in (in_order, plain):
        gradient = jax.jit(jax.grad(lambda values, function=function: (function(values) ** 3).sum()))(values)
        np.testing.assert_allclose(gradient, np.where(used[:, None], 3 * sums[segment] ** 2, 0), rtol=1e-5)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("apply", marks=pytest.mark.extra, id="plain"),
        pytest.param("apply_in_fixed_order", id="fixed order"),
    ],
)
def test_the_hash_grid_of_an_accelerator_is_that_of_a_cpu(monkeypatch, name):
    field = hash_grid_field(lower=(-1,) * 3, upper=(1,) * 3, resolutions=(4, 8, 32), table_size=2**9)
    params = jax.jit(field.init)(jax.random.key(0))
    x = jax.random.uniform(jax.random.key(1), (32, 16, 3), minval=-1.1, maxval=1.1)
    viewdirs = jnp.full((32, 1, 3), 3**-0.5)

    def loss(params, x, name="apply"):
        density, rgb = getattr(field, name)(params, x, viewdirs)
        return density.mean() + (rgb**2).mean()

    expected = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))(params, x)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    found = jax.jit(jax.value_and_grad(functools.partial(loss, name=name), argnums=(0, 1)))(params, x)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-7), found, expected)
