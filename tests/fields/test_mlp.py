"""The paper's network, against a plain float64 one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oracle
from helpers import assert_same, without_damping
from jaxnerf.core.scene import needs_of
from jaxnerf.fields.base import contract_field
from jaxnerf.fields.hash_grid import hash_grid_field
from jaxnerf.fields.mlp import cone_variance, damping_of_octaves, mlp_field

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


def count(params):
    return sum(leaf.size for leaf in jax.tree.leaves(params))


def inputs(seed=0, num_rays=6, num_samples=4):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.5, 1.5, (num_rays, num_samples, 3)).astype(np.float32)
    viewdirs = rng.normal(size=(num_rays, 1, 3))
    return x, (viewdirs / np.linalg.norm(viewdirs, axis=-1, keepdims=True)).astype(np.float32)


@pytest.fixture(scope="module")
def paper():
    """The network, parameters with biases that are not 0, and the compiled apply."""
    field = mlp_field()
    params = jax.jit(field.init)(jax.random.key(0))
    rng = np.random.default_rng(1)
    biased = {
        name: {**layer, "bias": rng.normal(scale=0.1, size=layer["bias"].shape).astype(np.float32)}
        for name, layer in params.items()
    }
    biased["density"]["bias"] -= np.float32(0.05)
    return field, params, biased, jax.jit(field.apply)


def plain_forward(params, x, viewdir):
    """Returns density and colour at one point: Fig. 7 of the paper in float64."""
    layer = {name: (np.float64(p["kernel"]), np.float64(p["bias"])) for name, p in params.items()}

    def dense(name, value):
        kernel, bias = layer[name]
        return value @ kernel + bias

    encoded = oracle.positional_encoding(np.float64(x), 10)
    hidden = encoded
    for index in range(8):
        hidden = np.maximum(dense(f"trunk_{index}", hidden), 0)
        if index == 4:
            hidden = np.concatenate([encoded, hidden])
    density = np.maximum(dense("density", hidden)[0], 0)
    features = np.concatenate([dense("bottleneck", hidden), oracle.positional_encoding(np.float64(viewdir), 4)])
    rgb = dense("rgb", np.maximum(dense("view", features), 0))
    return density, 1 / (1 + np.exp(-rgb))


def test_the_papers_network_has_595844_parameters(paper):
    assert count(paper[1]) == 595_844


def test_it_is_the_papers_network(paper):
    _, _, params, apply = paper
    x, viewdirs = inputs()
    density, rgb = apply(params, x, viewdirs)
    assert density.shape == (6, 4) and rgb.shape == (6, 4, 3)
    expected = [[plain_forward(params, point, viewdirs[i, 0]) for point in x[i]] for i in range(6)]
    expected_density = np.array([[pair[0] for pair in row] for row in expected])
    expected_rgb = np.array([[pair[1] for pair in row] for row in expected])
    assert 0 < (expected_density > 0).mean() < 1, "the test's inputs prove nothing"
    np.testing.assert_allclose(density, expected_density, atol=1e-5)
    np.testing.assert_allclose(rgb, expected_rgb, atol=1e-5)


def test_density_depends_on_position_alone_and_color_does_not(paper):
    _, _, params, apply = paper
    x, viewdirs = inputs()
    density, rgb = apply(params, x, viewdirs)
    other_density, other_rgb = apply(params, x, -viewdirs)
    np.testing.assert_array_equal(density, other_density)
    assert (np.abs(rgb - other_rgb).max(axis=-1) > 1e-4).all()


def test_one_direction_per_ray_equals_one_per_sample(paper):
    _, _, params, apply = paper
    x, viewdirs = inputs()
    each = np.broadcast_to(viewdirs, x.shape)
    for a, b in zip(apply(params, x, viewdirs), apply(params, x, each), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_it_starts_with_glorot_and_no_bias(paper):
    for name, layer in paper[1].items():
        kernel = np.asarray(layer["kernel"])
        bound = np.sqrt(6 / sum(kernel.shape))
        assert not np.any(layer["bias"]), name
        assert np.abs(kernel).max() <= bound * (1 + 1e-6), name
        if kernel.size > 1000:
            np.testing.assert_allclose(kernel.std(), bound / np.sqrt(3), rtol=0.05, err_msg=name)


def test_without_view_directions_their_parameters_are_absent():
    field = mlp_field(use_viewdirs=False)
    params = jax.eval_shape(field.init, jax.random.key(0))
    assert not {"bottleneck", "view"} & set(params)
    assert params["rgb"]["kernel"].shape == (256, 3)
    assert count(params) == 595_844 - (256 * 257) - (283 * 128 + 128) - (128 * 3) + 256 * 3
    small = mlp_field(use_viewdirs=False, depth=2, width=8, num_freqs=2)
    params, (x, viewdirs), apply = jax.jit(small.init)(jax.random.key(0)), inputs(), jax.jit(small.apply)
    for a, b in zip(apply(params, x, viewdirs), apply(params, x, -viewdirs), strict=True):
        np.testing.assert_array_equal(a, b)


def test_layers_without_an_activation_between_them_cost_one_product_per_sample():
    width, view_width, samples = 64, 32, 2**12
    field = mlp_field(depth=2, width=width, view_width=view_width, num_freqs=1, num_view_freqs=1)
    params = jax.eval_shape(field.init, jax.random.key(0))
    x, viewdirs = (jax.ShapeDtypeStruct((1, count, 3), jnp.float32) for count in (samples, 1))
    flops = jax.jit(field.apply).lower(params, x, viewdirs).cost_analysis()["flops"]
    products = samples * (9 * width + width**2 + width + width * view_width + 3 * view_width)
    products += 9 * view_width + width**2 * view_width + width * view_width
    others = flops - 2 * products
    assert 0 < others < samples * width**2, "a product for each sample is more than there should be"


@pytest.mark.parametrize("options", [{}, {"key": True}, {"density_noise": 1.0}])
def test_without_noise_no_random_numbers_are_drawn(options):
    assert "random_bits" not in _jaxpr(**options)


def test_noise_is_one_normal_number_per_sample():
    assert "random_bits" in _jaxpr(key=True, density_noise=1.0)
    field = mlp_field(depth=1, width=4, density_activation="softplus")
    params = jax.jit(field.init)(jax.random.key(0))
    x, viewdirs = np.zeros((1000, 5, 3), np.float32), np.ones((1000, 1, 3), np.float32)
    apply = jax.jit(field.apply, static_argnames="density_noise")
    density, rgb = apply(params, x, viewdirs, key=jax.random.key(1), density_noise=0.5)
    raw = np.log(np.expm1(np.float64(density)))  # before softplus
    assert abs(raw.std() - 0.5) < 0.03
    assert np.ptp(rgb, axis=(0, 1)).max() < 1e-6


def _jaxpr(key=None, density_noise=0.0):
    field = mlp_field(depth=1, width=4)
    params = jax.eval_shape(field.init, jax.random.key(0))
    return str(
        jax.make_jaxpr(
            lambda params, k, x, d: field.apply(params, x, d, key=k if key else None, density_noise=density_noise)
        )(params, jax.random.key(0), *inputs())
    )


@pytest.mark.slow
def test_bfloat16_concerns_the_layers_alone():
    options = {"depth": 2, "width": 16, "num_freqs": 4}
    exact, rough = mlp_field(**options), mlp_field(**options, compute_dtype=jnp.bfloat16)
    params, points = jax.jit(rough.init)(jax.random.key(0)), inputs()
    assert {leaf.dtype for leaf in jax.tree.leaves(params)} == {jnp.dtype("float32")}
    outputs = [jax.jit(field.apply)(params, *points) for field in (rough, exact)]
    for a, b in zip(*outputs, strict=True):
        assert a.dtype == b.dtype == jnp.float32
        assert 0 < np.abs(a - b).max() < 0.05


def test_an_unknown_activation_is_named():
    with pytest.raises(ValueError, match="density_activation is 'tanh', expected one of .*relu"):
        mlp_field(density_activation="tanh")


# Averages over cones.


@pytest.fixture(scope="module")
def small():
    """A small network, its twin with prefilter, and parameters of the twin."""
    options = {"depth": 2, "width": 16, "view_width": 8, "num_freqs": 6}
    plain, cones = mlp_field(**options), mlp_field(**options, prefilter=True)
    assert needs_of(plain.apply) == () and needs_of(cones.apply) == ("radius", "length")
    params = jax.jit(cones.init)(jax.random.key(0))
    return plain, cones, jax.tree.map(lambda leaf: leaf + 0.1, params)


def extents(shape, radius, length):
    return {"radius": jnp.full(shape, radius), "length": jnp.full(shape, length)}


def test_points_instead_of_cones_are_what_the_plain_network_sees(small):
    plain, cones, params = small
    x, viewdirs = inputs()
    point = jax.jit(cones.apply)(params, x, viewdirs, **extents(x.shape[:-1], 0.0, 0.0))
    assert_same(point, jax.jit(plain.apply)(without_damping(params, 6), x, viewdirs), rtol=1e-5, atol=1e-5)


def test_a_sample_is_no_shorter_than_the_pixel_is_wide(small):
    """Of shorter ones, the length does not matter, and the variance is that of the pixel; of longer ones, it does."""
    _, cones, params = small
    x, viewdirs = inputs()
    np.testing.assert_allclose(
        cone_variance(viewdirs, *extents((6, 4), 0.1 / 3**0.5, 0.05).values()), 0.1**2 / 12, rtol=1e-6
    )
    none, short, long = (
        jax.jit(cones.apply)(params, x, viewdirs, **extents((6, 4), 0.1, length)) for length in (0.0, 0.17, 0.5)
    )
    assert_same(none, short, rtol=0, atol=0)
    assert min(np.abs(part - want).max() for part, want in zip(long, short, strict=True)) > 1e-3


EXTENTS = np.array([0.0, 1e-30, 1e-12, 1e-3, 0.02, 0.5, 3.0, 1e6, 1e17, 1e25, np.inf])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_cones_leave_of_octaves_and_its_derivatives_are_those_of_float64(dtype):
    """For radius and length of any size."""
    radius, length = (each.reshape(-1) for each in np.meshgrid(EXTENTS, EXTENTS))
    away, octaves = np.array([[2.0, -1.0, 2.0]]) / 3, 2.0 ** np.arange(12)

    def damping(radius, length):
        variance = cone_variance(jnp.asarray(away, dtype), radius[None], length[None])
        return damping_of_octaves(variance.mean(axis=-1), 12)[:, 0]

    with jax.enable_x64(dtype == np.float64):
        slopes = jax.vmap(jax.jacrev(damping, argnums=(0, 1)))
        given = [jnp.asarray(each, dtype) for each in (radius, length)]
        got, by = jax.jit(lambda *at: (jax.vmap(damping)(*at), slopes(*at)))(*given)
        assert got.dtype == by[0].dtype == dtype
    wide = np.sqrt(3) * radius > length
    along, across = (np.minimum(each, 1e18) for each in (np.where(wide, np.sqrt(3) * radius, length), radius))
    want = np.exp(-(octaves**2) / 2 * (along**2 / 12 + across**2 / 2)[:, None] / 3)
    np.testing.assert_allclose(got, want, atol=1e-6)
    steep = -(octaves**2) / 3 * want
    by_length = np.where(wide, 0, along / 12)[:, None] * steep
    by_radius = (np.where(wide, across / 4, 0) + across / 2)[:, None] * steep
    np.testing.assert_allclose(by[0], by_radius, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(by[1], by_length, rtol=1e-4, atol=1e-3)


def test_wide_cones_show_no_waves(small):
    """What is left is the position itself, so that the result is that of a network without octaves."""
    _, cones, params = small
    none = mlp_field(depth=2, width=16, view_width=8, num_freqs=0)
    kernel = params["trunk_0"]["kernel"]
    bare = {**params, "trunk_0": {**params["trunk_0"], "kernel": kernel[:3]}}
    x, viewdirs = inputs()
    want = none.apply(bare, x, viewdirs)
    for size in (1e3, jnp.inf):
        got = jax.jit(cones.apply)(params, x, viewdirs, **extents((6, 1), size, size))
        assert_same(got, want, rtol=1e-5, atol=1e-5)
    along = cones.apply(params, x, viewdirs, **extents((6, 1), 0.0, 0.1))
    across = cones.apply(params, x, viewdirs, **extents((6, 1), 0.1, 0.0))
    assert min(np.abs(part - want).max() for part, want in zip(along, across, strict=True)) > 1e-3


def test_gradients_through_cones_are_finite_at_any_size(small):
    _, cones, params = small
    x, viewdirs = inputs()

    @jax.jit
    def slopes(extent):
        def total(params, x, radius, length):
            density, rgb = cones.apply(params, x, viewdirs, radius=radius, length=length)
            return density.sum() + rgb.sum()

        return jax.grad(total, argnums=(0, 1, 2, 3))(params, x, *extents((6, 4), extent, 4 * extent).values())

    for extent in (0.0, 1e-30, 0.1, 1e20, np.inf):
        found = slopes(extent)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
        assert np.any(found[2]) == np.any(found[3]) == (0 < extent < 1e18)


def test_cones_are_smaller_where_space_is_contracted(small):
    """Far away, an interval of the same contracted length shows the same."""
    _, cones, params = small
    field = contract_field(cones, np.full(3, -2.0), np.full(3, 2.0))
    x, viewdirs = np.float32([[[0.0, 0.0, 1e3]]]), np.float32([[[0.6, 0.0, 0.8]]])
    far = jax.jit(field.apply)(params, x, viewdirs, **extents((1, 1), 2.0, 2.0))
    scale = ((2e3 - 1) / 1e9) ** (2 / 3)
    near = jax.jit(cones.apply)(
        params, np.float32([[[0.0, 0.0, 2 - 1e-3]]]), viewdirs, **extents((1, 1), 2 * scale, 2 * scale)
    )
    assert_same(far, near, rtol=1e-5, atol=1e-5)
    assert all(np.isfinite(leaf).all() for leaf in field.apply(params, x, viewdirs, **extents((1, 1), np.inf, np.inf)))


FIELDS = {
    "mlp": mlp_field(depth=2, width=16, view_width=8, num_freqs=3),
    "hash_grid": hash_grid_field(lower=(-1, -1, -1), upper=(1, 1, 1), resolutions=(8,), width=16, view_width=8),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, rays, samples, directions",
    [("mlp", 16, 64, 1), ("mlp", 16, 64, 64), ("mlp", 512, 1, 1), ("mlp", 2, 512, 1), ("hash_grid", 2, 512, 1)],
)
def test_padding_for_the_cache_changes_no_output(name, rays, samples, directions):
    """Outputs and gradients for 512 or 1024 samples are those of the first ray and of the others."""
    field, rng = FIELDS[name], np.random.default_rng(0)
    x, pull = rng.uniform(-1, 1, (2, rays, samples, 3)).astype(np.float32)
    viewdirs = rng.normal(size=(rays, directions, 3)).astype(np.float32)
    params = jax.jit(field.init)(jax.random.key(0))

    @jax.jit
    def evaluate(params, x, viewdirs, pull):
        def total(params, x):
            density, rgb = field.apply(params, x, viewdirs)
            return (pull * (density[..., None] + rgb)).sum(), (density, rgb)

        return jax.value_and_grad(total, argnums=(0, 1), has_aux=True)(params, x)

    (_, outputs), (slopes, moves) = evaluate(params, x, viewdirs, pull)
    first, rest = ([value[rows] for value in (x, viewdirs, pull)] for rows in (slice(1), slice(1, None)))
    parts = [evaluate(params, *part) for part in (first, rest)]
    close = {"rtol": 1e-5, "atol": 1e-5}
    assert_same(outputs, jax.tree.map(lambda *some: jnp.concatenate(some), *(part[0][1] for part in parts)))
    assert_same(moves, jnp.concatenate([part[1][1] for part in parts]), **close)
    assert_same(slopes, jax.tree.map(jnp.add, *(part[1][0] for part in parts)), **close)


@pytest.mark.parametrize("shape", [(0, 4), (4, 0), (0,)])
@pytest.mark.parametrize("prefilter", [False, True])
def test_fields_are_evaluated_at_no_points(shape, prefilter):
    box = {"lower": (-1,) * 3, "upper": (1,) * 3, "resolutions": (4, 8), "table_size": 64}
    fields = mlp_field(depth=2, width=16, view_width=8, prefilter=prefilter), hash_grid_field(**box)
    x, viewdirs = np.zeros((*shape, 3), np.float32), np.zeros((*shape[:-1], 1, 3), np.float32)
    sizes = {"radius": np.zeros(shape, np.float32), "length": np.zeros(shape, np.float32)} if prefilter else {}
    for field in fields[: 2 - prefilter]:
        params = jax.jit(field.init)(jax.random.key(0))
        for apply in filter(None, (field.apply, field.apply_in_fixed_order)):

            def total(params, apply=apply):
                density, rgb = apply(params, x, viewdirs, **sizes)
                assert density.shape == shape and rgb.shape == (*shape, 3)
                return density.sum() + rgb.sum()

            assert not any(leaf.any() for leaf in jax.tree.leaves(jax.jit(jax.grad(total))(params)))
