"""Fields whose colour depends on reflected directions: their inputs, their normals, and the options."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import all_finite, compiled, without_damping
from jaxnerf.core.reflections import integrated_directional_encoding
from jaxnerf.fields.base import contract_field
from jaxnerf.fields.hash_grid import HashGridOptions, hash_grid_field
from jaxnerf.fields.mlp import MlpOptions, mlp_field
from jaxnerf.fields.reflections import DEGREES, reflection_features

BOX = {"lower": (-1.0, -1.0, -1.0), "upper": (1.0, 1.0, 1.0)}
GRID = {**BOX, "resolutions": (4, 9), "table_size": 100, "features_per_level": 2, "width": 16, "view_width": 8}
MAKE = {
    "hash_grid": lambda **options: hash_grid_field(**GRID, **options),
    "mlp": lambda **options: mlp_field(depth=2, width=16, view_width=8, num_freqs=3, **options),
}
features = compiled(reflection_features, "shape")


def directions(shape, seed=1):
    vectors = np.random.default_rng(seed).normal(size=(*shape, 3))
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def inside(shape, seed=2):
    return np.random.default_rng(seed).uniform(-0.9, 0.9, size=(*shape, 3)).astype(np.float32)


def random_params(field):
    rng, shapes = np.random.default_rng(3), jax.eval_shape(field.init, jax.random.key(0))
    return jax.tree.map(lambda leaf: np.float32(rng.normal(scale=0.3, size=leaf.shape)), shapes)


def test_colour_reads_the_encoded_reflection_and_the_cosine():
    outputs = np.random.default_rng(0).normal(size=(4, 6)).astype(np.float32)
    view = directions((2, 1))
    got, normals = features(outputs, view, shape=(2, 3))
    normal = outputs[:3].T.reshape(2, 3, 3)
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    np.testing.assert_allclose(normals, normal, atol=1e-6)
    cosine = -(view * normal).sum(axis=-1)
    reflected = view + 2 * cosine[..., None] * normal
    roughness = np.log1p(np.exp(outputs[3] - 1)).reshape(2, 3)
    encoded = integrated_directional_encoding(reflected, roughness, degrees=DEGREES)
    np.testing.assert_allclose(got[:-1], encoded.reshape(6, -1).T, atol=2e-6)
    np.testing.assert_allclose(got[-1], cosine.reshape(-1), atol=1e-6)


def test_normals_of_zero_and_grazing_rays_have_gradients():
    outputs = np.zeros((4, 3), np.float32)
    outputs[:, 1:] = [[1, 0], [0, 1e-30], [0, 0], [80, -80]]  # the second ray grazes; rough, and a mirror
    view = np.float32([[0, 1, 0]])

    def total(outputs):
        return sum(each.sum() for each in reflection_features(outputs, view, (3,)))

    assert all_finite(jax.jit(jax.value_and_grad(total))(outputs))


@pytest.mark.parametrize("name", MAKE)
def test_a_field_predicts_unit_normals_and_its_colour_depends_on_them(name):
    field = MAKE[name](reflections=True)
    params = random_params(field)
    x, view = inside((2, 5)), directions((2, 1))
    normals = compiled(field.normals)(params, x, view)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), np.ones((2, 5)), atol=1e-6)
    gradient = jax.jit(jax.grad(lambda params: field.apply(params, x, view)[1].sum()))(params)
    layer, rows = ("density", slice(16, None)) if name == "hash_grid" else ("reflection", slice(None))
    assert (np.abs(gradient[layer]["kernel"][:, rows]).sum(axis=0) > 0).all()


@pytest.mark.parametrize("name", MAKE)
def test_without_reflections_there_are_no_parameters_for_them(name):
    field, other = MAKE[name](), MAKE[name](reflections=True)
    assert field.normals is None and other.normals is not None
    sizes = [sum(leaf.size for leaf in jax.tree.leaves(jax.eval_shape(each.init, jax.random.key(0)))) for each in
             (field, other)]  # fmt: skip
    harmonics = sum(2 * degree + 1 for degree in DEGREES) + 1
    assert sizes[1] - sizes[0] == 4 * 17 + 8 * harmonics


def test_normals_of_a_contracted_field_are_those_at_the_contracted_position():
    field = MAKE["hash_grid"](reflections=True)
    params = random_params(field)
    contracted = contract_field(field, BOX["lower"], BOX["upper"])
    x, view = jnp.array([[[0.1, -0.2, 0.3], [0.0, 2.0, 0.0]]]), directions((1, 1))
    # Twice as far as the sphere of half the box, a position is three quarters of the way to its end.
    expected = jax.jit(field.normals)(params, jnp.array([[[0.1, -0.2, 0.3], [0.0, 0.875, 0.0]]]), view)
    np.testing.assert_allclose(jax.jit(contracted.normals)(params, x, view), expected, atol=1e-6)


def test_normals_of_cones_without_extent_are_those_of_points():
    plain, cones = MAKE["mlp"](reflections=True), MAKE["mlp"](reflections=True, prefilter=True)
    params, x, view = random_params(cones), inside((2, 5)), directions((2, 1))
    normals = [jax.jit(cones.normals)(params, x, view, radius=size, length=size) for size in (0.0, 0.5)]
    expected = jax.jit(plain.normals)(without_damping(params, 3), x, view)
    np.testing.assert_allclose(normals[0], expected, atol=1e-6)
    assert np.abs(normals[1] - expected).max() > 0.01


@pytest.mark.parametrize("options", [HashGridOptions, MlpOptions])
def test_reflections_without_view_directions_are_refused(options):
    with pytest.raises(ValueError, match="reflections is True and use_viewdirs False"):
        options(reflections=True, use_viewdirs=False).check()
