"""Convergence of each quadrature rule to the closed forms, its error at edges, and its gradients.

Everything here runs in float64 unless it says otherwise.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf
from helpers import all_finite, compiled
from jaxnerf import (
    Camera,
    Rays,
    rays_from_pixels,
    render_hierarchical,
    render_rays,
    render_samples,
    samples_from_edges,
)
from jaxnerf.core.volume_rendering import opacity
from test_scenes import analytic

SLOPE = ((0.0, 0.0, 0.2), (0.1, -0.1, -0.15), (0.05, 0.05, -0.2))
COLOURED = {"rgb": (0.4, 0.5, 0.6), "rgb_slope": SLOPE}
SMOOTH = {
    "fog": analytic.slab(1.0, lower=-100.0, upper=100.0, **COLOURED),
    "linear": analytic.linear(0.8, **COLOURED),
    "atmosphere": analytic.atmosphere(2.0, scale_height=0.8, **COLOURED),
    "blob": analytic.blob(3.0, center=(0.0, 0.0, 0.8), deviation=0.7, **COLOURED),
}
# A thin layer that rays enter from above and end in, the typical case of the paper's scenes.
HAZE = analytic.atmosphere(8.0, scale_height=0.07, **COLOURED)
SHARP = {
    "slab": analytic.slab(2.0, lower=0.4, upper=1.3, **COLOURED),
    "ball": analytic.ball(2.0, center=(0.0, 0.0, 1.0), radius=1.0, **COLOURED),
    "two_colours": analytic.two_colors(1.0, height=1.1),
}
ORDERS = {"segments": 1.9, "gauss": 3.8}


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def make_rays(origins, directions, near, far):
    origins, directions = np.array(origins, np.float64), np.array(directions, np.float64)
    viewdirs = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    ends = (np.full(len(origins), end, np.float64) for end in (near, far))
    return Rays(origins=origins, directions=directions, viewdirs=viewdirs, near=next(ends), far=next(ends))


# Oblique, of several lengths, and all above z = 0.
OBLIQUE = make_rays(
    [(-2.0, 0.25, 0.125), (1.5, -1.0, 0.5), (0.25, 2.0, 0.25), (-1.0, -1.5, 1.0)],
    [(0.875, -0.125, 0.375), (-0.625, 0.5, 0.75), (0.125, -1.125, 0.5), (0.5, 0.75, 0.25)],
    near=0.5,
    far=4.5,
)
DESCENDING = make_rays(
    [(-2.0, 0.3, 3.4), (1.5, -1.0, 3.2), (0.2, 2.0, 3.7), (-1.0, -1.5, 2.5)],
    [(0.9, -0.1, -0.9), (-0.6, 0.5, -0.8), (0.1, -0.6, -1.0), (0.5, 0.7, -0.6)],
    near=0.0,
    far=4.0,
)


@functools.cache
def exact(medium, which="oblique"):
    return compiled(medium.exact)({"oblique": OBLIQUE, "descending": DESCENDING}[which])


def errors(medium, rays, rule, numbers, expected):
    """Returns the largest errors [numbers, 3] over rays, of colour, opacity and depth.

    All numbers of evaluations fraction one compiled shape, padded with cells of width 0: see
    test_cells_of_width_zero_change_nothing.
    """
    each = 2 if rule == "gauss" else 1
    render = compiled(functools.partial(padded, medium.scene, rule, max(numbers) // each))
    return np.array([largest(render(rays, n // each), expected) for n in numbers])


def padded(scene, rule, shape, rays, cells):
    """Returns the Rendering with a number of cells, among `shape` of which the last have width 0."""
    fraction = jnp.minimum(jnp.arange(shape + 1) / cells, 1)
    edges = rays.near[:, None] + (rays.far - rays.near)[:, None] * fraction[None]
    return render_samples(scene, rays, samples_from_edges(None, edges, rule=rule))


def even(medium, rays, rule, numbers):
    """Returns the Renderings by render_rays."""
    render = compiled(lambda rays, n: render_rays(None, medium.scene, rays, num_samples=n, rule=rule), "n")
    return [render(rays, n=n) for n in numbers]


@pytest.mark.parametrize("rule", ["segments", "gauss"])
def test_cells_of_width_zero_change_nothing(rule):
    each = 2 if rule == "gauss" else 1
    (expected,) = even(SMOOTH["blob"], OBLIQUE, rule, [48])
    got = compiled(functools.partial(padded, SMOOTH["blob"].scene, rule, 96 // each))(OBLIQUE, 48 // each)
    for part in ("rgb", "opacity", "depth", "disparity"):
        np.testing.assert_allclose(getattr(got, part), getattr(expected, part), rtol=1e-13)
    np.testing.assert_array_equal(got.weights[:, 48:], 0)


def largest(got, expected):
    parts = ("rgb", "opacity", "depth")
    return [np.abs(getattr(got, part) - getattr(expected, part)).max() for part in parts]


@pytest.mark.slow
@pytest.mark.parametrize("rule", ORDERS)
@pytest.mark.parametrize("name", SMOOTH)
def test_order_of_color_opacity_and_depth(name, rule):
    found = errors(SMOOTH[name], OBLIQUE, rule, (48, 96, 192), exact(SMOOTH[name]))
    no_error = found[-1] < 1e-13  # the optical depth of an affine density has no error
    assert list(no_error) == [False, name in ("fog", "linear"), False]
    found = found[:, ~no_error]
    assert (np.log2(found[:-1] / found[1:]) >= ORDERS[rule]).all(), found


@pytest.mark.parametrize("name", ["fog", "atmosphere"])
def test_the_released_rule_stalls_where_the_far_end_is_in_matter(name):
    expected = exact(SMOOTH[name])
    found = [largest(got, expected)[0] for got in even(SMOOTH[name], OBLIQUE, "points", (48, 384))]
    assert np.log2(found[0] / found[1]) / 3 < 0.6
    assert found[1] > 1e-2


def test_number_of_evaluations_for_an_atmosphere():
    enough = {"segments": {1e-3: 192, 1e-5: 1536}, "gauss": {1e-3: 48, 1e-5: 192}}
    for rule, numbers in enough.items():
        tried = [number // part for number in numbers.values() for part in (2, 1)]
        found = errors(HAZE, DESCENDING, rule, tried, exact(HAZE, "descending"))[:, 0]
        for bound, half, whole in zip(numbers, found[::2], found[1::2], strict=True):
            assert whole <= bound < half, (rule, bound, half, whole)


@pytest.mark.parametrize("name", SMOOTH)
def test_the_floor_of_float32(name):
    """After convergence only rounding errors are left, and more samples do not increase them."""
    expected = exact(SMOOTH[name])
    assert all((np.float32(x) == x).all() for x in (OBLIQUE.origins, OBLIQUE.directions))
    with jax.enable_x64(False):
        rays = jax.tree.map(np.float32, OBLIQUE)
        render = functools.partial(render_rays, None, SMOOTH[name].scene, num_samples=1536, rule="gauss")
        got = compiled(render)(rays)
        assert got.rgb.dtype == np.float32
    assert np.abs(got.rgb - expected.rgb).max() < 1e-6
    assert np.abs(got.opacity - expected.opacity).max() < 1e-6
    assert np.abs(got.depth / expected.depth - 1).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("rule", ORDERS)
@pytest.mark.parametrize("name", SHARP)
def test_an_edge_costs_at_most_its_cell(name, rule):
    """An edge inside a cell is displaced at most to the end of the cell."""
    numbers = np.array([48, 192, 768])
    cells = numbers if rule == "segments" else numbers // 2
    found = errors(SHARP[name], OBLIQUE, rule, numbers, exact(SHARP[name]))[:, 0]
    density, edges, colors = 2.0, 2, 1.0
    length = np.linalg.norm(OBLIQUE.directions, axis=-1).max() * 4.0 / cells
    assert (found <= density * edges * colors * length).all(), found
    assert (found[1:] <= found[:-1]).all()


@pytest.mark.parametrize("rule, order", ORDERS.items())
def test_an_edge_between_two_cells_costs_nothing(rule, order):
    rays = make_rays([(0.0, 0.0, 0.0), (0.5, 0.0, 4.0)], [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)], 0.0, 4.0)
    slab = analytic.slab(3.0, lower=1.0, upper=2.0, **COLOURED)
    found = errors(slab, rays, rule, (48, 96, 192), compiled(slab.exact)(rays))
    assert (found[:, 1] < 1e-14).all()
    found = found[:, [0, 2]]
    assert (np.log2(found[:-1] / found[1:]) >= order).all()
    halves = analytic.two_colors(3.0, height=1.0)
    assert (errors(halves, rays, rule, (48,), compiled(halves.exact)(rays))[:, :2] < 1e-14).all()


@pytest.mark.slow
@pytest.mark.parametrize("rule, order", [("segments", 1.4), ("gauss", 3.5)])
def test_stratified_samples_converge_and_err_to_both_sides(rule, order):
    medium, draws = SMOOTH["atmosphere"], 256
    rays = jax.tree.map(lambda leaf: np.repeat(leaf[:1], draws, axis=0), OBLIQUE)
    expected = exact(medium).rgb[0]
    keys = jax.random.split(jax.random.key(0), draws)
    render = compiled(lambda keys, rays, n: render_rays(keys, medium.scene, rays, num_samples=n, rule=rule), "n")
    root_mean_square = []
    for number in (24, 96):
        error = render(keys, rays, n=number).rgb - expected
        root_mean_square.append(np.sqrt((error**2).mean()))
        if rule == "segments":
            standard_error = error.std(axis=0) / np.sqrt(draws)
            assert (np.abs(error.mean(axis=0)) < 4 * standard_error + 0.1 * root_mean_square[-1]).all()
    assert np.log2(root_mean_square[0] / root_mean_square[1]) / 2 >= order


@pytest.mark.slow
@pytest.mark.parametrize("rule, order", ORDERS.items())
def test_hierarchical_converges_to_the_closed_form(rule, order):
    medium = SMOOTH["atmosphere"]
    expected = exact(medium)

    def render(rays, n):
        return render_hierarchical(
            None, medium.scene, medium.scene, rays, num_coarse=n // 2, num_fine=n // 2, rule=rule
        )[1]

    # Over a factor of 8, as the points do not fall alike from one number to the next.
    found = np.array([largest(compiled(render, "n")(OBLIQUE, n=n), expected) for n in (48, 384)])
    assert (np.log2(found[0] / found[1]) / 3 >= order - 0.2).all(), found


def test_the_released_rule_converges_where_the_far_end_is_empty():
    ball = SHARP["ball"]
    expected = exact(ball).rgb

    def render(rays, n):
        return render_hierarchical(
            None, ball.scene, ball.scene, rays, num_coarse=n // 2, num_fine=n // 2, rule="points"
        )[1].rgb

    found = [np.abs(compiled(render, "n")(OBLIQUE, n=n) - expected).max() for n in (24, 768)]
    assert found[1] < 4e-3 and found[1] < found[0] / 4


@pytest.fixture(scope="module")
def swept():
    """Densities [200, 12] over all of float32, with zeros, inf, and cells of length 0."""
    rng = np.random.default_rng(0)
    density = np.float32(10.0 ** rng.uniform(-30, 30, (200, 12)))
    density[:40] = np.float32(rng.uniform(0, 5, (40, 12)))
    density[rng.random(density.shape) < 0.1] = 0
    density[rng.random(density.shape) < 0.05] = np.inf
    length = np.repeat(np.float32(rng.uniform(0.01, 1, (200, 6))), 2, axis=-1)
    length[rng.random(density.shape) < 0.1] = 0
    return density, length


def test_gauss_weights_sum_to_the_opacity(swept):
    density, length = swept
    with jax.enable_x64(False):
        weights = jaxnerf.weights_from_density
        got = compiled(functools.partial(weights, rule="gauss"))(density, length)
        plain = compiled(weights)(density, length)
        stopped = compiled(opacity)(density, length)
    assert got.dtype == np.float32
    assert (got >= 0).all() and (got <= 1).all()
    np.testing.assert_array_equal(got[(length == 0) | (density == 0)], 0)
    np.testing.assert_allclose(got.sum(axis=-1), stopped, atol=1e-6)
    # What moves stays in its cell.
    cells = (len(density), -1, 2)
    np.testing.assert_allclose(got.reshape(cells).sum(-1), plain.reshape(cells).sum(-1), atol=2e-7)


def test_gauss_weights_do_not_see_masked_samples(swept):
    density, length = swept
    hidden = np.where(length == 0, np.float32(np.nan), density)
    with jax.enable_x64(False):
        run = compiled(
            jax.value_and_grad(
                lambda *arrays: (jaxnerf.weights_from_density(*arrays, rule="gauss") ** 2).sum(),
                argnums=(0, 1),
            )
        )
        seen, masked = run(density, length), run(hidden, length)
    assert all_finite(seen)
    for a, b in zip(jax.tree.leaves(seen), jax.tree.leaves(masked), strict=True):
        np.testing.assert_array_equal(a, b)


def test_splitting_cells_of_constant_density_changes_no_weight():
    rng = np.random.default_rng(1)
    density, length = rng.exponential(size=(50, 6)), rng.uniform(0.01, 2, (50, 6))
    weights = compiled(functools.partial(jaxnerf.weights_from_density, rule="gauss"))
    whole = weights(density.repeat(2, axis=-1), length.repeat(2, axis=-1) / 2)
    split = weights(density.repeat(4, axis=-1), length.repeat(4, axis=-1) / 4)
    np.testing.assert_allclose(split.reshape(50, 6, 4).sum(-1), whole.reshape(50, 6, 2).sum(-1), rtol=1e-12, atol=1e-15)


def test_gauss_weights_follow_the_transmittance_at_the_points():
    """In one thin cell they are proportional to sigma exp(-tau), to the order of the rule."""
    depth = 0.1
    first, second = compiled(jaxnerf.weights_from_density, "rule")(np.ones(2), np.full(2, depth / 2), rule="gauss")
    np.testing.assert_allclose(first / second, np.exp(depth / np.sqrt(3)), rtol=1e-3)


@pytest.mark.parametrize("fog, wall", [(1e-3, 1e6), (1e-3, np.inf), (1e-9, 1e30)])
def test_a_wall_keeps_its_color_behind_fog_in_its_own_cell(fog, wall):
    def scene(x, viewdirs):
        behind = x[..., 2] >= 0.5
        rgb = jnp.where(behind[..., None], jnp.array([0.0, 1.0, 0.0]), jnp.array([1.0, 0.0, 0.0]))
        return jnp.where(behind, wall, fog), rgb

    ray = make_rays([(0.0, 0.0, 0.0)], [(0.0, 0.0, 1.0)], 0.0, 1.0)
    got = compiled(lambda ray: render_rays(None, scene, ray, num_samples=2, rule="gauss"))(ray)
    np.testing.assert_allclose(got.rgb, [[0, 1, 0]], atol=1e-2)
    np.testing.assert_allclose(got.opacity, 1)


@pytest.mark.parametrize(
    "call",
    [
        lambda scene: render_rays(None, scene, OBLIQUE, num_samples=7, rule="gauss"),
        lambda scene: render_hierarchical(None, scene, scene, OBLIQUE, num_coarse=7, num_fine=8, rule="gauss"),
        lambda scene: render_hierarchical(None, scene, scene, OBLIQUE, num_coarse=8, num_fine=7, rule="gauss"),
        lambda scene: jaxnerf.weights_from_density(jnp.ones((2, 3)), jnp.ones((2, 3)), rule="gauss"),
        lambda scene: render_rays(None, scene, OBLIQUE, num_samples=8, rule="simpson"),
        lambda scene: samples_from_edges(None, jnp.arange(3.0), rule="simpson"),
    ],
    ids=["rays", "coarse", "fine", "weights", "unknown", "unknown edges"],
)
def test_odd_numbers_and_unknown_rules_are_errors(call):
    with pytest.raises(ValueError, match="gauss"):
        jax.eval_shape(lambda: call(SMOOTH["fog"].scene))


@pytest.mark.parametrize("start", [0.0, 2.0, 1000.0])
def test_drawn_gauss_cells_fill_the_ray_in_order(start):
    """In float32, where 64 cells at 1000 hold a few floats each."""
    with jax.enable_x64(False):
        edges = np.float32(start + np.sort(np.random.default_rng(2).random((500, 65)), axis=-1) * 0.5)
        samples = compiled(functools.partial(samples_from_edges, rule="gauss"))(
            jax.random.split(jax.random.key(3), 500), edges
        )
    t, delta = samples.t, np.float64(samples.delta)
    assert t.shape == (500, 128)
    assert (np.diff(t, axis=-1) >= 0).all() and (delta >= 0).all()
    assert (t >= edges[:, :1]).all() and (t <= edges[:, -1:]).all()
    np.testing.assert_array_equal(delta[:, ::2], delta[:, 1::2])
    # The cells' ends, from their lengths, run from the first edge to the last and hold their samples.
    ends = edges[:, :1] + np.concatenate([np.zeros((500, 1)), np.cumsum(2 * delta[:, ::2], axis=-1)], axis=-1)
    tolerance = 64 * np.spacing(np.float32(start + 1)) / 2
    np.testing.assert_allclose(ends[:, -1], edges[:, -1], atol=tolerance)
    assert (t[:, ::2] >= ends[:, :-1] - tolerance).all() and (t[:, 1::2] <= ends[:, 1:] + tolerance).all()
    # Each inner end was drawn between the middles beside it.
    middles = (np.float64(edges[:, 1:]) + edges[:, :-1]) / 2
    assert (ends[:, 1:-1] >= middles[:, :-1] - tolerance).all()
    assert (ends[:, 1:-1] <= middles[:, 1:] + tolerance).all()


PIXELS = np.array([[1.0, 2.0], [7.5, 3.0], [4.0, 8.0], [9.0, 9.5]])
MEDIUM_OF = {
    "atmosphere": lambda density, rgb: analytic.atmosphere(density, scale_height=0.8, rgb=rgb, rgb_slope=SLOPE),
    "blob": lambda density, rgb: analytic.blob(
        density, center=(0.0, 0.0, 0.8), deviation=0.7, rgb=rgb, rgb_slope=SLOPE
    ),
}
# density, colour [3], pose [3, 4] from the eye, focal [2]: a camera that looks slightly up at the blob.
PLACE = np.array(
    [
        *[1.5],
        *[0.4, 0.5, 0.6],
        *[0.96, 0.0, 0.28, 0.8, 0.28, 0.0, -0.96, -3.0, 0.0, 1.0, 0.0, 0.6],
        12.0,
        13.0,
    ]
)


def seen(name, place, see):
    """Returns colours [4, 3] by see(medium, rays) for the numbers in place [18]."""
    pose, focal = place[4:16].reshape(3, 4), place[16:]
    camera = Camera(to_world=pose, focal=focal, center=jnp.array([5.0, 5.0]))
    rays = rays_from_pixels(camera, jnp.asarray(PIXELS), near=1.0, far=5.0)
    return see(MEDIUM_OF[name](place[0], place[1:4]), rays).rgb


@functools.cache
def exact_slopes(name):
    return compiled(jax.jacrev(lambda place: seen(name, place, lambda medium, rays: medium.exact(rays))))(PLACE)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, rule, accuracy",
    [("atmosphere", "gauss", 2e-5), ("blob", "gauss", 2e-5), ("blob", "segments", 2e-3)],
)
def test_gradients_through_the_renderer(name, rule, accuracy):
    """With respect to density, colour, pose and focal length: those of the closed form, and finite differences."""

    def rendered(place):
        return seen(name, place, lambda medium, rays: render_rays(None, medium.scene, rays, num_samples=64, rule=rule))

    got = compiled(jax.jacrev(rendered))(PLACE)
    expected = exact_slopes(name)
    assert (np.abs(expected).max(axis=(0, 1)) > 1e-3).all()  # each number matters
    scale = np.abs(expected).max()
    np.testing.assert_allclose(got, expected, atol=accuracy * scale)
    run, step = compiled(rendered), 1e-5
    for i, move in enumerate(step * np.eye(len(PLACE))):
        difference = (run(PLACE + move) - run(PLACE - move)) / (2 * step)
        np.testing.assert_allclose(got[..., i], difference, rtol=1e-6, atol=1e-6)
