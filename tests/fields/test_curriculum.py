"""The curricula of fields: what is masked has no effect and no gradient, at the end they are what they are without."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnerf.core.scene import needs_of
from jaxnerf.fields.curriculum import band_weights, view_weight
from jaxnerf.fields.hash_grid import HashGrid, hash_grid_field
from jaxnerf.fields.mlp import mlp_field

GRID = {"lower": (-1.0,) * 3, "upper": (1.0,) * 3, "resolutions": (3, 6, 12), "width": 8, "view_width": 8}
MLP = {"depth": 3, "width": 8, "skip_layer": 0, "view_width": 8, "num_freqs": 3, "num_view_freqs": 2}
FIELDS = {"hash_grid": (hash_grid_field, GRID), "mlp": (mlp_field, MLP)}
pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")
BOTH = pytest.mark.parametrize("name", FIELDS)


def make(name, **curricula):
    """Returns a field and random parameters, the same for all curricula."""
    function, options = FIELDS[name]
    field = function(**options, **curricula)
    leaves, tree = jax.tree.flatten(field.init(jax.random.key(0)))
    rng = np.random.default_rng(1)
    leaves = [np.float32(leaf + 0.3 * rng.standard_normal(leaf.shape)) for leaf in leaves]
    return field, jax.tree.unflatten(tree, leaves)


def rays():
    rng = np.random.default_rng(2)
    x, directions = np.float32(rng.uniform(-1, 1, (5, 4, 3))), rng.standard_normal((5, 1, 3))
    return jnp.asarray(x), jnp.float32(directions / np.linalg.norm(directions, axis=-1, keepdims=True))


def test_bands_are_switched_on_one_after_the_other():
    weights = [band_weights(progress, 5, 0.5) for progress in (0.0, 0.0625, 0.125, 0.3125, 0.5, 0.9)]
    expected = [[1, 0, 0, 0, 0], [1, 0.5, 0, 0, 0], [1, 1, 0, 0, 0], [1, 1, 1, 0.5, 0], [1] * 5, [1] * 5]
    np.testing.assert_allclose(weights, expected, atol=1e-6)
    assert band_weights(0.0, 1, 0.5) == 1


def test_view_dependence_is_switched_on_within_a_tenth():
    np.testing.assert_allclose(
        [view_weight(each, 0.5) for each in (0, 0.5, 0.55, 0.6, 1)], [0, 0, 0.5, 1, 1], atol=1e-6
    )
    np.testing.assert_allclose([view_weight(each, 0.95) for each in (0.95, 1.0)], [0, 1])


@BOTH
def test_without_curricula_a_field_asks_for_nothing_and_computes_no_weights(name):
    field, params = make(name)
    assert needs_of(field.apply) == ()
    assert needs_of(make(name, coarse_to_fine=0.5)[0].apply) == ("progress",)
    assert needs_of(make(name, viewdirs_from=0.5)[0].apply) == ("progress",)
    masked = make(name, coarse_to_fine=0.5, viewdirs_from=0.5)[0]
    plain = str(jax.make_jaxpr(field.apply)(params, *rays()))
    assert plain.count(" mul ") < str(jax.make_jaxpr(masked.apply)(params, *rays(), progress=0.5)).count(" mul ")


@BOTH
def test_at_the_end_a_field_is_the_one_without_curricula(name):
    field, params = make(name)
    expected = field.apply(params, *rays())
    curricula, _ = make(name, coarse_to_fine=0.4, viewdirs_from=0.3)
    for progress in (0.4, 1.0):
        got = curricula.apply(params, *rays(), progress=jnp.float32(progress))
        for a, b in zip(got, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    before = curricula.apply(params, *rays(), progress=jnp.float32(0.1))
    assert np.abs(before[0] - expected[0]).max() > 1e-3


@BOTH
def test_before_its_start_colour_does_not_depend_on_the_direction(name):
    field, params = make(name, viewdirs_from=0.5)
    x, directions = rays()

    def spread(progress):
        colors = [field.apply(params, x, each, progress=progress)[1] for each in (directions, -directions[::-1])]
        return float(jnp.abs(colors[0] - colors[1]).max())

    assert spread(0.5) == 0 and spread(1.0) > 1e-3


@BOTH
def test_masked_bands_have_no_gradient(name):
    field, params = make(name, coarse_to_fine=0.5)
    slope = jax.jit(jax.grad(lambda params, progress: field.apply(params, *rays(), progress=progress)[0].sum()))
    for progress, bands in ((0.0, 1), (0.25, 2), (1.0, 3)):
        found = slope(params, progress)
        if name == "hash_grid":
            levels = HashGrid(**GRID).levels()
            reached = [np.any(found["table"][level.rows.start : level.rows.stop]) for level in levels]
        else:
            kernel = found["trunk_0"]["kernel"][3:]
            reached = [np.any(kernel[6 * band : 6 * band + 6]) for band in range(3)]
        assert reached == [band < bands for band in range(3)]


@pytest.mark.parametrize("progress", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("view_depth", [0, 2])
def test_a_hash_grid_without_its_curricula_is_the_same_at_that_progress(progress, view_depth):
    options = {**GRID, "view_depth": view_depth, "coarse_to_fine": 0.5, "viewdirs_from": 0.25}
    field = hash_grid_field(**options)
    params = field.init(jax.random.key(3))
    params = jax.tree.map(lambda leaf: leaf + 0.3, params)
    plain, folded = HashGrid(**options).without_curricula(params, progress)
    assert (plain.coarse_to_fine, plain.viewdirs_from) == (0, 0)
    got = hash_grid_field(**{**GRID, "view_depth": view_depth}).apply(folded, *rays())
    for a, b in zip(got, field.apply(params, *rays(), progress=progress), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)
