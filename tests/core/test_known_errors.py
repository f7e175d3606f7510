"""The known maximum errors: every public function of jaxnerf.core has a row, and none has outgrown its bound."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf
from jaxnerf.core import metrics, volume_rendering
from known_errors import ROWS, records, search

NAMES = [str(row) for row in ROWS]
# Their functions have another row, and they take long to compile.
AGAIN = (
    "rays_from_pixels, fisheye",
    "pixel_radius, fisheye",
    "undistort, opencv",
    "render_rays, gauss",
    "render_image",
)
MINIMIZES = {"estimate_pose"}  # what has no formula to compare with; its covariance states its error


def _largest(row, count=32):
    """Returns {column: largest error} of the known worst inputs and of random ones, jitted."""
    with jax.numpy_rank_promotion("allow"):  # scenes of a user may promote ranks
        known = records.known(records.read()[str(row)])
        found = search.climb(search.Meter(row, ("jitted",)), generations=0, count=count, known=known)
    return {" ".join(column): worst.error for column, worst in found.items()}


def _beyond(row):
    """Returns the columns in which a row's error is beyond its bound."""
    record = records.read()[str(row)]
    return [column for column, error in _largest(row).items() if not error <= record[column]["bound"]]


def _row(name):
    return ROWS[NAMES.index(name)]


def test_every_public_function_of_core_has_a_row():
    public = {name: inspect.unwrap(getattr(jaxnerf, name)) for name in jaxnerf.__all__}
    functions = {
        name
        for name, value in public.items()
        if inspect.isfunction(value) and value.__module__.startswith("jaxnerf.core.")
    }
    assert {row.name for row in ROWS} == functions - MINIMIZES
    assert len(set(NAMES)) == len(NAMES) and set(records.read()) == set(NAMES)


def test_the_unit_is_what_rounding_explains():
    want, arrays = np.array([[1.0, 3.0]]), np.arange(2)
    moved = np.array([[[[1.0, 3.0 + 3e-7]]]])  # the second changes when its inputs are rounded
    rounded = want + np.array([[2.0**-24, 6e-7]])
    errors = search._mixed(rounded, want, moved, search.EPS, 1e-30, arrays)
    np.testing.assert_allclose(errors, [[0.5, 6e-7 / (3 * 2.0**-23 + 3e-7)]], rtol=1e-6)
    assert np.isinf(search._mixed(np.full((1, 2), np.nan), want, moved, search.EPS, 0, arrays)).all()


def test_a_jump_counts_by_how_far_its_input_is():
    want, arrays = np.zeros((1, 1)), np.zeros(1, int)
    moved = np.array([[[[0.0], [1.0 if step >= 3 else 0.0]]] for step in search.LADDER])  # jumps 3 half ulps away
    assert search._backward(np.full((1, 1), 1.0), want, moved, search.EPS, 0, arrays) == 3
    assert np.isinf(search._backward(np.full((1, 1), 2.0), want, moved, search.EPS, 0, arrays)).all()


def _parameters():
    marks = {name: pytest.mark.extra if name in AGAIN else pytest.mark.slow for name in NAMES}
    return [pytest.param(row, id=str(row), marks=marks[str(row)]) for row in ROWS]


@pytest.mark.parametrize("row", _parameters())
def test_no_error_has_outgrown_its_bound(row):
    record, found = records.read()[str(row)], _largest(row)
    beyond = [
        f"{column}: {error:.3g}, bound {record[column]['bound']}"
        for column, error in found.items()
        if not error <= record[column]["bound"]
    ]
    assert not beyond, "\n".join([str(row), *beyond, "found by experiments/stability/stability.py --rows"])


# Planted mistakes, each of which must move a row beyond its bound.


@pytest.mark.slow
def test_an_epsilon_moves_a_row(monkeypatch):
    monkeypatch.setattr(metrics, "decibels", lambda error: -10 / jnp.log(10.0) * jnp.log(error + 1e-10))
    assert _beyond(_row("psnr"))


@pytest.mark.slow
def test_a_missing_where_moves_a_row(monkeypatch):
    def product(function, density, length):
        return jnp.minimum(density * length, volume_rendering.OPAQUE)

    monkeypatch.setattr(volume_rendering, "optical_depth", product)
    assert _beyond(_row("weights_from_density"))


@pytest.mark.slow
def test_a_float32_cumsum_moves_a_row(monkeypatch):
    """The paper's product rule, and T_i from the sum up to and including a sample less its own term."""

    def weights(depth):
        return jnp.exp(-(jnp.cumsum(depth, axis=-1) - depth)) * (1 - jnp.exp(-depth))

    monkeypatch.setattr(volume_rendering, "_weights", weights)
    assert _beyond(_row("weights_from_density"))
