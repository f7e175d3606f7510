"""The hash grid: interpolation of its levels, spherical harmonics, gradients and cost."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from helpers import all_finite, assert_batch_is_vmap_is_jit, assert_same, compiled
from jaxnerf.core.scene import needs_of
from jaxnerf.fields.hash_grid import (
    color_activation,
    damping,
    harmonics,
    hash_grid_field,
    total_variation,
    vertices,
)
from jaxnerf.fields.hash_interpolation import TableLevel, interpolate

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")

BOX = {"lower": (-1.0, 0.0, 2.0), "upper": (1.0, 3.0, 3.0)}
SIZE = (3, 5, 4)  # vertices of the level that is dense
COUNT = int(np.prod(SIZE))
fast_harmonics = compiled(harmonics)


@compiled
def dense(table, place):
    """Returns the features of a level that begins at row 7."""
    return interpolate(table, list(place), [TableLevel(SIZE, range(7, 7 + COUNT))])


@compiled
def shared(table, place):
    """Returns the features of a level of 9 x 9 x 9 vertices in 64 rows from row 5 on."""
    return interpolate(table, list(place), [TableLevel((9, 9, 9), range(5, 69))])


def level(values):
    """Returns a table with the values [COUNT, F] from row 7 on, between rows that must not be read."""
    return np.pad(np.float32(values), ((7, 4), (0, 0)), constant_values=np.nan)


def places(count, seed=0, low=0.0, high=1.0):
    return np.random.default_rng(seed).uniform(low, high, (3, count)).astype(np.float32)


def directions(shape, seed=1):
    vectors = np.random.default_rng(seed).normal(size=(*shape, 3))
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def inside(shape, seed=2):
    """Returns points [..., 3] of BOX."""
    lower, upper = np.float32(BOX["lower"]), np.float32(BOX["upper"])
    return lower + np.random.default_rng(seed).uniform(size=(*shape, 3)).astype(np.float32) * (upper - lower)


@pytest.mark.slow
def test_bfloat16_concerns_the_layers_alone():
    options = {"resolutions": (4,), "features_per_level": 2, "view_width": 8, "view_depth": 1, "width": 16}
    exact, rough = (hash_grid_field(**BOX, **options, compute_dtype=dtype) for dtype in (None, jnp.bfloat16))
    shapes, rng = jax.eval_shape(exact.init, jax.random.key(0)), np.random.default_rng(6)
    params = jax.tree.map(lambda leaf: np.float32(rng.normal(scale=0.3, size=leaf.shape)), shapes)
    x, viewdirs = inside((2, 30)), directions((2, 1))

    def outputs_and_gradient(field):
        def total(params):
            outputs = field.apply(params, x, viewdirs)
            return sum(map(jnp.sum, outputs)), outputs

        return jax.tree.leaves(jax.jit(jax.grad(total, has_aux=True))(params))

    for one, two in zip(outputs_and_gradient(exact), outputs_and_gradient(rough), strict=True):
        assert two.dtype == jnp.float32 and 0 < np.linalg.norm(one - two) < 0.05 * np.linalg.norm(one)


@pytest.fixture(scope="module")
def field():
    """A small field with a dense level and one that shares rows, parameters, and its compiled functions."""
    # A list, as JSON gives it.
    field = hash_grid_field(**BOX, resolutions=[4, 9], table_size=100, features_per_level=2, view_width=8)
    init = compiled(field.init)
    rng = np.random.default_rng(3)
    params = jax.tree.map(
        lambda leaf: leaf + jnp.float32(rng.normal(scale=0.3, size=leaf.shape)), init(jax.random.key(0))
    )
    return field, params, compiled(field.apply), init


def test_a_dense_level_holds_trilinear_functions_exactly():
    factors = np.random.default_rng(4).normal(size=(2, 2, 2, 3))  # of 1, x, y, z and their products

    def trilinear(x, y, z):
        powers = [np.stack([np.ones_like(value), value]) for value in np.float64([x, y, z])]
        return np.einsum("an,bn,cn,abcf->nf", *powers, factors)

    corners = np.stack(np.meshgrid(*(np.linspace(0, 1, size) for size in SIZE), indexing="ij"))
    table = level(trilinear(*corners.reshape(3, -1)))
    points = places(200)
    np.testing.assert_allclose(dense(table, points), trilinear(*points), atol=3e-6)


def test_at_its_vertices_a_dense_level_is_its_table():
    values = np.random.default_rng(5).normal(size=(COUNT, 2)).astype(np.float32)
    corners = np.stack(np.meshgrid(*(np.linspace(0, 1, size) for size in SIZE), indexing="ij"))
    got = dense(level(values), np.resize(np.float32(corners.reshape(3, -1)), (3, COUNT)))
    np.testing.assert_allclose(got, values, atol=2e-6)


@pytest.mark.parametrize("at", [dense, shared], ids=["dense", "shared"])
def test_places_outside_the_box_read_no_rows_outside_the_level(at):
    """Rows around the level are NaN. Places are 0, 1, their neighbouring floats, outside, and far outside."""
    table = level(np.ones((COUNT, 2))) if at is dense else np.pad(np.ones((64, 2), "f"), ((5, 3), (0, 0)))
    if at is shared:
        table[:5] = table[-3:] = np.nan
    edges = [0, 1, np.nextafter(np.float32(1), 0), np.nextafter(np.float32(0), 1), -1e-7, 1.5, -3e38, np.inf]
    grid = np.stack(np.meshgrid(edges, edges, edges, indexing="ij")).reshape(3, -1).astype(np.float32)
    np.testing.assert_allclose(at(table, grid), np.ones((grid.shape[1], 2)), rtol=1e-6)


def test_outside_the_features_are_those_of_the_nearest_place_inside():
    table = level(np.random.default_rng(6).normal(size=(COUNT, 2)))
    points = places(100, low=-1.0, high=2.0)
    np.testing.assert_array_equal(dense(table, points), dense(table, np.clip(points, 0, 1)))


def test_a_nan_place_shows_and_affects_no_other():
    table = np.random.default_rng(7).normal(size=(100, 2)).astype(np.float32)
    points = places(10)
    wrong = points.copy()
    wrong[[0, 1, 2], [3, 5, 7]] = np.nan
    for at in (dense, shared):
        got, want = at(table, wrong), at(table, points)
        assert np.isnan(got[[3, 5, 7]]).all()
        whole = np.setdiff1d(range(10), [3, 5, 7])
        np.testing.assert_array_equal(got[whole], want[whole])


def test_a_level_with_more_vertices_than_rows_uses_every_row():
    """Every one of the 64 rows is read by some vertex, and about as often as any other."""
    corners = np.stack(np.meshgrid(*[np.float32(np.arange(9) / 8)] * 3, indexing="ij")).reshape(3, -1)
    rows = np.pad(np.eye(64, dtype=np.float32), ((5, 0), (0, 0)))
    read = shared(rows, corners)
    np.testing.assert_allclose(read.sum(-1), 1, atol=1e-6)
    counts = read.round().sum(0)
    assert counts.sum() == 729 and counts.min() >= 1 and counts.max() < 40


def test_gradients_are_those_of_the_linear_pieces():
    table, points = level(np.random.default_rng(8).normal(size=(COUNT, 2))), places(6, low=0.02, high=0.23)
    points[:, 4], points[:, 5] = 0, 1  # on faces of the box

    def first(place):
        return interpolate(jnp.asarray(table), list(place), [TableLevel(SIZE, range(7, 7 + COUNT))])[:, 0].sum()

    slopes = jax.jit(jax.grad(first))(points)
    step = np.where(points[0] == 1, -1, 1) * np.float32(1 / 64)
    for axis in range(3):  # the function is linear along each axis, so that differences are exact
        moved = points.copy()
        moved[axis] += step
        np.testing.assert_allclose(slopes[axis], (dense(table, moved) - dense(table, points))[:, 0] / step, atol=1e-3)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="concerns the compiler for CPUs")
def test_positions_are_computed_once_and_not_for_each_vertex(field):
    field, params, *_ = field

    def loss(params, x):
        density, rgb = field.apply(params, jnp.floor(x), x)
        return density.sum() + rgb.sum()

    text = jax.jit(jax.grad(loss)).lower(params, jnp.zeros((1, 640, 3))).compile().as_text()
    assert text.count(" floor(") in (1, 3)  # for all components together, or for each; without storing them 38


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="concerns the compiler for CPUs")
def test_products_of_the_backward_pass_have_features_first(field):
    """Those with one row per sample are slower."""
    field, params, *_ = field
    count, features = 640, params["kernel"].shape[0]

    def loss(params, x):
        density, rgb = field.apply(params, x, x)
        return density.sum() + rgb.sum()

    text = jax.jit(jax.grad(loss)).lower(params, jnp.zeros((1, count, 3))).compile().as_text()
    products = [line for line in text.splitlines() if " dot(" in line]
    assert any(f"f32[{features},{count}]" in line for line in products)
    assert not any(f"f32[{count},{features}]" in line for line in products)


def test_forward_and_reverse_derivatives_agree(field):
    field, params, *_ = field
    x, viewdirs = inside((2, 3)), directions((2, 3))
    leaves, tree = jax.tree.flatten(params)
    rng = np.random.default_rng(0)
    change = tree.unflatten([rng.normal(size=leaf.shape).astype(np.float32) for leaf in leaves])

    def loss(params):
        density, rgb = field.apply(params, x, viewdirs)
        return jnp.log(density).sum() + rgb.sum()

    _, forward = jax.jit(lambda: jax.jvp(loss, (params,), (change,)))()
    slopes = jax.jit(jax.grad(loss))(params)
    reverse = sum(jax.tree.leaves(jax.tree.map(lambda a, b: (a * b).sum(), slopes, change)))
    np.testing.assert_allclose(forward, reverse, rtol=1e-4)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_component_of_a_position_that_is_not_finite_affects_no_other(field, value):
    _, params, apply, _ = field
    x = inside((1, 6))
    wrong, nearest = x.copy(), x.copy()
    wrong[0, 2, 1], nearest[0, 2, 1] = value, BOX["upper" if value > 0 else "lower"][1]
    density, expected = (np.array(apply(params, x, directions((1, 1)))[0]) for x in (wrong, nearest))
    if np.isnan(value):
        expected[0, 2] = np.nan
    np.testing.assert_array_equal(density, expected)


def test_the_number_of_vertices_is_proportional_to_the_sides():
    assert vertices([2, 2, 2], 16) == (16, 16, 16)
    assert vertices([2, 3, 1], 13) == (9, 13, 5)
    assert vertices([1e-6, 1, 1e3], 5) == (2, 2, 5)  # two at least: a cell
    for resolution in (2, 17, 128):
        sides = np.float64([1.0, 0.7, 0.33])
        cells = np.array(vertices(sides, resolution)) - 1
        assert cells.max() == resolution - 1
        assert (np.abs(cells - sides * (resolution - 1)) <= np.maximum(0.5, 1 - sides)).all()


def test_harmonics_are_orthonormal():
    """Gauss points along the axis and equal steps around it integrate products of degree 2 exactly."""
    z, weights = np.polynomial.legendre.leggauss(4)
    turn = 2 * np.pi * np.arange(8) / 8
    ring = np.sqrt(1 - z[:, None] ** 2)
    points = np.stack([ring * np.cos(turn), ring * np.sin(turn), z[:, None] + 0 * turn], -1).reshape(-1, 3)
    values = np.float64(fast_harmonics(np.float32(points)))
    each = np.repeat(weights, 8) * 2 * np.pi / 8
    np.testing.assert_allclose(values.T @ (each[:, None] * values), np.eye(9), atol=1e-6)


def test_harmonics_are_their_closed_forms():
    x, y, z = np.float64(directions((4, 5))).transpose(2, 0, 1)
    root = lambda value: np.sqrt(value / np.pi)  # noqa: E731
    expected = [
        root(1) / 2 + 0 * x,
        *(root(3 / 4) * value for value in (y, z, x)),
        *(root(15) / 2 * value for value in (x * y, y * z, x * z)),
        root(5) / 4 * (3 * z**2 - 1),
        root(15) / 4 * (x**2 - y**2),
    ]
    got = fast_harmonics(directions((4, 5)))
    assert got.shape == (4, 5, 9)
    np.testing.assert_allclose(got, np.stack(expected, -1), atol=1e-6)


def test_one_direction_per_ray_equals_one_per_sample(field):
    _, params, apply, _ = field
    x, viewdirs = inside((6, 4)), directions((6, 1))
    density, rgb = apply(params, x, viewdirs)
    assert density.shape == (6, 4) and rgb.shape == (6, 4, 3)
    assert density.dtype == rgb.dtype == np.float32
    assert (density > 0).all() and (rgb > 0).all() and (rgb < 1).all()
    assert_same(apply(params, x, np.broadcast_to(viewdirs, x.shape)), (density, rgb))
    other_density, other_rgb = apply(params, x, -viewdirs)
    np.testing.assert_array_equal(other_density, density)
    assert (np.abs(other_rgb - rgb).max(-1) > 1e-4).all()


def test_batch_is_vmap_is_jit(field):
    plain, params, _, _ = field
    x, viewdirs = inside((6, 4)), directions((6, 1))
    assert_batch_is_vmap_is_jit(lambda *given: plain.apply(params, *given), x, viewdirs)


def test_outside_the_box_the_field_is_that_of_the_nearest_point(field):
    _, params, apply, _ = field
    x = np.float32(inside((6, 4)) * 3 - 2)
    nearest = np.clip(x, np.float32(BOX["lower"]), np.float32(BOX["upper"]))
    assert (x != nearest).any(-1).mean() > 0.5
    assert_same(apply(params, x, directions((6, 1))), apply(params, nearest, directions((6, 1))), atol=2e-6)


@pytest.mark.parametrize("size", [0.0, 1e-30, 1.0, 1e4, 1e30])
def test_outputs_and_gradients_are_finite_for_features_of_any_size(field, size, finite={}):  # noqa: B006
    plain, params, _, _ = field

    def total(params, x, viewdirs):
        density, rgb = plain.apply(params, x, viewdirs)
        return density.sum() + rgb.sum(), (density, rgb)

    run = finite.setdefault("run", compiled(jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True)))
    params = {**params, "table": np.sign(params["table"]) * np.float32(size)}
    (_, (density, rgb)), slopes = run(params, inside((6, 4)), directions((6, 1)))
    assert all_finite((density, rgb, slopes))
    assert density.max() <= np.exp(15) * 1.001 and (density >= 0).all()


def test_color_is_the_sigmoid_and_its_derivative_never_vanishes():
    logits = np.linspace(-200, 200, 4001, dtype=np.float32)
    values, slopes = compiled(jax.vmap(jax.value_and_grad(color_activation)))(logits)
    expected, own = compiled(jax.vmap(jax.value_and_grad(jax.nn.sigmoid)))(logits)
    np.testing.assert_array_equal(values, expected)
    least = 1e-3 * (6.9 / np.maximum(np.abs(logits), 6.9)) ** 2
    assert own.min() == 0 and slopes.min() > 0
    np.testing.assert_allclose(slopes, np.maximum(own, least), rtol=1e-6)
    inside = np.abs(logits) < 6.9
    np.testing.assert_array_equal(slopes[inside], own[inside])
    beyond = np.array([7.0, 70.0, 7e3, 1e30], np.float32)
    assert (np.diff(beyond * jax.vmap(jax.grad(color_activation))(beyond)) < 0).all()  # the gradient of a weight


def test_saturated_color_learns(field):
    """A white field becomes black; through a sigmoid no gradient would return."""
    plain, params, apply, _ = field
    x, viewdirs = inside((6, 4)), directions((6, 1))
    params = {**params, "rgb": {**params["rgb"], "bias": np.full(3, 40.0, np.float32)}}
    assert (apply(params, x, viewdirs)[1] == 1).all()
    optimizer = optax.adam(1.0)

    def step(carry, _):
        params, state = carry
        grad = jax.grad(lambda params: jnp.square(plain.apply(params, x, viewdirs)[1]).mean())(params)
        updates, state = optimizer.update(grad, state)
        return (optax.apply_updates(params, updates), state), None

    params, _ = compiled(lambda carry: jax.lax.scan(step, carry, length=40)[0])((params, optimizer.init(params)))
    assert apply(params, x, viewdirs)[1].max() < 0.1


def test_the_initial_parameters_depend_on_the_key_alone(field):
    init, apply = field[3], field[2]
    first, again, other = (init(jax.random.key(seed)) for seed in (0, 0, 1))
    assert_same(first, again, rtol=0, atol=0)
    assert (first["table"] != other["table"]).mean() > 0.99
    assert first["table"].shape == (3 * 4 * 2 + 100, 2)  # the box is 2 x 3 x 1
    assert not first["bias"].any() and np.abs(first["table"]).max() <= 0.025
    density, _ = apply(first, inside((6, 4)), directions((6, 1)))
    np.testing.assert_allclose(density, 1, atol=0.5)  # thin fog to begin with


def test_without_view_directions_their_parameters_and_operations_are_absent():
    flops, rows = {}, {}
    x, viewdirs = inside((32, 16)), directions((32, 1))
    for use_viewdirs in (True, False):
        plain = hash_grid_field(**BOX, resolutions=(4,), table_size=100, use_viewdirs=use_viewdirs)
        params = jax.eval_shape(plain.init, jax.random.key(0))
        rows[use_viewdirs] = params["view_0"]["kernel"].shape[0]
        apply = jax.jit(plain.apply).lower(params, x, viewdirs).compile()
        flops[use_viewdirs] = apply.cost_analysis()["flops"]
    assert rows == {True: 15 + 9, False: 15}
    # At least the hidden layer's product with 9 harmonics of each sample.
    assert flops[True] - flops[False] >= 2 * 9 * 128 * 32 * 16
    params = jax.tree.map(lambda leaf: np.ones(leaf.shape, leaf.dtype), params)
    assert_same(apply(params, x, viewdirs), apply(params, x, -viewdirs), rtol=0, atol=0)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"lower": (0, 0, 0), "upper": (1, 0, 1)}, "the box is .* expected lower < upper"),
        ({"lower": (0, 0), "upper": (1, 1)}, "the box is"),
        ({"lower": (), "upper": ()}, "the box is"),
        ({"lower": (0,) * 3, "upper": (float("nan"),) * 3}, "the box is"),
        ({**BOX, "resolutions": ()}, r"resolutions are \(\), expected at least one, each at least 2"),
        ({**BOX, "resolutions": (8, 1)}, r"resolutions are \(8, 1\)"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=f"hash_grid_field: {message}"):
        hash_grid_field(**options)


def test_the_derivative_by_the_table_is_an_interpolation():
    """Features are linear in the table, so their change is the interpolated change; on faces and outside, too."""
    levels = [TableLevel(SIZE, range(COUNT)), TableLevel((9, 9, 9), range(COUNT, COUNT + 64))]
    rng = np.random.default_rng(4)
    table, change = (rng.normal(size=(COUNT + 64, 2)).astype(np.float32) for _ in range(2))
    points = np.concatenate([places(20), np.float32([[0, 1, -0.5, 1.5]] * 3)], axis=1)
    value, slope = jax.jvp(lambda table: interpolate(table, list(points), levels), (table,), (change,))
    np.testing.assert_allclose(value, interpolate(table, list(points), levels), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(slope, interpolate(change, list(points), levels), rtol=1e-5, atol=1e-6)


def test_mixed_second_derivatives_are_those_of_finite_differences():
    """As a loss of the field's slopes has them: by the place, then by the table."""
    levels = [TableLevel(SIZE, range(COUNT)), TableLevel((9, 9, 9), range(COUNT, COUNT + 64))]
    rng = np.random.default_rng(3)
    table, change = (rng.normal(size=(COUNT + 64, 2)).astype(np.float32) for _ in range(2))
    points = list(places(20, low=0.02, high=0.98))

    @jax.jit
    def loss(table):
        slopes = jax.grad(lambda place: interpolate(table, place, levels).sum())(points)
        return sum((slope**2).sum() for slope in slopes)

    along = (jax.jit(jax.grad(loss))(table) * change).sum()
    np.testing.assert_allclose(along, (loss(table + change) - loss(table - change)) / 2, rtol=1e-3)  # a square: exact


def test_hashed_levels_with_different_numbers_of_rows_are_named():
    with pytest.raises(ValueError, match=r"interpolate: hashed levels have \[32, 64\] rows, expected the same number"):
        levels = [TableLevel((9, 9, 9), range(64)), TableLevel((9, 9, 9), range(64, 96))]
        interpolate(jnp.ones((96, 2)), [jnp.zeros(3)] * 3, levels)


def test_a_table_of_another_shape_is_named():
    with pytest.raises(ValueError, match="interpolate: table"):
        interpolate(jnp.ones(8), [jnp.zeros(3)] * 3, [TableLevel((2, 2, 2), range(8))])


LEVELS = (TableLevel((2, 3, 2), range(12)), TableLevel((4, 4, 4), range(12, 32)), TableLevel((3, 2, 2), range(32, 44)))


def test_total_variation_compares_neighbours_in_levels_that_are_not_hashed():
    table = np.float32(np.random.default_rng(0).normal(size=(44, 2)))
    loss = jax.value_and_grad(lambda table: total_variation({"table": table}, levels=LEVELS))
    value, slope = jax.jit(loss)(table)
    want = 0.0
    for level in (LEVELS[0], LEVELS[2]):
        vertices = table[level.rows.start : level.rows.stop].reshape(*level.size, 2)
        want += sum((np.diff(vertices, axis=axis) ** 2).mean() for axis in range(3)) / 2
    np.testing.assert_allclose(value, want, rtol=1e-5)
    assert not slope[12:32].any() and slope[:12].any() and abs(slope.sum()) < 1e-5
    assert total_variation({"table": table}, levels=LEVELS[1:2]) == 0


# Damping by the size of a pixel's footprint.


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_damping_is_the_mass_within_a_cell(dtype):
    """Its value and derivative are those of float64, for any radius."""
    radius = np.array([0.0, 1e-30, 1e-3, 0.1, 0.3, 1.0, 7.0, 1e4, 1e30, np.inf], dtype)
    cell = 0.25
    with jax.enable_x64(dtype == np.float64):
        value, slope = jax.vmap(jax.value_and_grad(lambda at: damping(at, cell)))(jnp.asarray(radius))
        assert value.dtype == dtype
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        at = cell / (math.sqrt(2) * radius.astype(np.float64))
        expected = np.array([math.erf(each) for each in at])
        derivative = np.where(at > 4, 0, -2 / math.sqrt(math.pi) * np.exp(-(at**2)) * at / radius)
    np.testing.assert_allclose(value, expected, rtol=1e-6, atol=2e-8)
    np.testing.assert_allclose(slope[:-1], derivative[:-1], rtol=1e-5, atol=1e-6)
    assert value[0] == 1 and slope[0] == 0 and value[-1] == 0 and slope[-1] == 0


def test_a_prefiltered_field_forgets_what_is_smaller_than_the_footprint():
    options = {**BOX, "resolutions": (3, 17), "table_size": 2000, "prefilter": True}
    field = hash_grid_field(**options)
    assert needs_of(field.apply) == ("radius",) and needs_of(hash_grid_field(**BOX).apply) == ()
    params = jax.jit(field.init)(jax.random.key(0))
    params["table"] = jnp.asarray(np.random.default_rng(0).normal(size=params["table"].shape), jnp.float32)
    x, viewdirs = inside((6, 4)), directions((6, 1))

    @jax.jit
    def log_density(radius, params=params):
        return jnp.log(field.apply(params, x, viewdirs, radius=jnp.broadcast_to(radius, (6, 4)))[0])

    assert np.ptp(log_density(jnp.inf)) == 0 < np.ptp(log_density(0.0))
    coarse = {**params, "table": params["table"].at[2 * 3 * 2 :].set(0)}  # without cells of 0.19 a side
    narrow, wide = (np.abs(log_density(radius, coarse) - log_density(radius)).max() for radius in (1e-3, 1.0))
    assert narrow > 0.5 and wide < 0.2 * narrow
    one_per_ray = field.apply(params, x, viewdirs, radius=jnp.full((6, 1), 0.3))[0]
    np.testing.assert_allclose(jnp.log(one_per_ray), log_density(0.3), atol=1e-5)
