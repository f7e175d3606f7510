"""Losses and regularizers: closed forms, gradients, degenerate rays, dense and packed."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

import jaxnerf
from helpers import all_finite, assert_batch_is_vmap_is_jit, checked_grid, compiled, full_grid, rays_past_origin
from jaxnerf.core.losses import (
    depth_loss,
    mse_loss,
    opacity_loss,
)
from jaxnerf.core.occupancy.grid import is_occupied
from jaxnerf.core.types import without_samples

pytest_plugins = ["run_fixtures"]

KEPT, FINITE_FAR, INFINITE_FAR = 0.7, (1.0, 7.0), (1.5, np.inf)


def make_batch(near, far):
    near, far = jnp.broadcast_arrays(jnp.float32(near), jnp.float32(far))
    vectors = jnp.zeros((*near.shape, 3))
    rays = jaxnerf.Rays(origins=vectors, directions=vectors, viewdirs=vectors, near=near, far=far)
    return jaxnerf.Batch(rays=rays, rgb=vectors)


def make_rendering(weights, t, delta, rule="segments"):
    """Returns a Rendering that has weights and samples; losses of the weights read nothing else."""
    samples = jaxnerf.Samples(t=t, delta=delta, rule=rule)
    names = ("rgb", "opacity", "depth", "disparity", "num_dropped")
    return jaxnerf.Rendering(weights=weights, samples=samples, **dict.fromkeys(names, weights[..., 0]))


def test_the_opacity_of_the_last_rendering_is_compared_with_alpha():
    opacity = jnp.float32([0.0, 0.25, 1.0])
    batch = dataclasses.replace(make_batch(np.zeros(3), 1.0), alpha=jnp.float32([0.0, 1.0, 0.5]))
    first, last = (make_rendering(jnp.full((3, 1), 0.5), *jnp.ones((2, 3, 1))) for _ in range(2))
    last = dataclasses.replace(last, opacity=opacity)
    np.testing.assert_allclose(opacity_loss((first, last), batch), [0, 0.5625, 0.25])


compiled_loss = compiled(jaxnerf.distortion_loss)


def distortion(weights, t, delta, near=0.0, far=1.0, rule="segments"):
    """Returns the loss of one ray, or of rays [B]."""
    batch = make_batch(jnp.broadcast_to(near, weights.shape[:-1]), far)
    return jaxnerf.distortion_loss([make_rendering(weights, t, delta, rule)], batch)


compiled_distortion = compiled(distortion, "rule")
loss_and_gradient = compiled(jax.value_and_grad(distortion, argnums=(0, 1, 2)))


def double_sum(weights, t, delta, near, far, rule="segments"):
    """Returns Eq. 15 of one ray as it is printed, in float64 and in quadratic time."""
    weights, t, delta = np.float64(weights), np.float64(t), np.float64(delta)
    used = delta > 0
    weights, t, delta = weights[used], t[used], delta[used]
    if rule == "points":
        delta = np.minimum(delta, np.maximum(far - t, 0))
    lower = t if rule == "points" else t - delta / 2
    if np.isinf(far):  # from near on, or from t = 1 where that is not positive
        start = near if near > 0 else 1.0
        s = 1 - start / np.maximum(t, start)
        lengths = start / np.maximum(lower, start) - start / np.maximum(lower + delta, start)
    else:
        s, lengths = (t - near) / (far - near), delta / (far - near)
    pairs = weights[:, None] * weights[None] * np.abs(s[:, None] - s[None])
    return pairs.sum() + (weights**2 * lengths).sum() / 3


def random_samples(seed, count, near, far):
    """Returns weights, t and delta [count] float32 of adjacent segments on one ray, some of them unused."""
    rng = np.random.default_rng(seed)
    edges = np.sort(rng.uniform(0, 1, count + 1))
    edges = near / (1 - 0.9 * edges) if np.isinf(far) else near + edges * (far - near)
    t, delta = (edges[1:] + edges[:-1]) / 2, np.diff(edges) * (rng.uniform(size=count) < KEPT)
    weights = rng.dirichlet(np.ones(count)) * rng.uniform()
    return np.float32(weights), np.float32(t), np.float32(delta)


def test_two_samples():
    weights, t, delta = np.float32([0.3, 0.5]), np.float32([2.0, 3.5]), np.float32([0.4, 0.8])
    pair, own = 2 * 0.3 * 0.5 * 1.5 / 4, (0.3**2 * 0.4 + 0.5**2 * 0.8) / 4 / 3
    np.testing.assert_allclose(compiled_distortion(weights, t, delta, near=1, far=5), pair + own, rtol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 17, 300])
def test_equal_weights_on_an_even_grid_have_the_mean_distance_of_two_points(count):
    """Two uniform random points in [0, 1] are 1/3 apart on average, whatever the number of samples."""
    t, delta = np.float32((np.arange(count) + 0.5) / count), np.full(count, 1 / count, np.float32)
    np.testing.assert_allclose(compiled_distortion(np.full(count, 1 / count, np.float32), t, delta), 1 / 3, rtol=1e-6)


def test_a_single_sample_counts_only_its_own_length():
    one = np.float32([0.6])
    np.testing.assert_allclose(
        compiled_distortion(one, np.float32([3]), np.float32([2]), 1, 6), 0.36 * 2 / 5 / 3, rtol=1e-6
    )


@pytest.mark.parametrize("count", [10, 100, 1000])
def test_a_peak_costs_less_the_narrower_it_is(count):
    weights = np.zeros(count, np.float32)
    weights[count // 3] = 1
    t, delta = np.float32((np.arange(count) + 0.5) / count), np.full(count, 1 / count, np.float32)
    np.testing.assert_allclose(compiled_distortion(weights, t, delta), 1 / (3 * count), rtol=1e-5)


@pytest.mark.parametrize("rule", ["segments", "points"])
@pytest.mark.parametrize("near, start", [(0.0, 1.0), (-2.0, 1.0), (1.5, 1.5)])
def test_a_segment_is_clipped_where_disparity_begins(near, start, rule):
    """One segment in front of the start, around it or behind it, with its sample on either side, dense and packed."""
    for t in np.float32([0.2, 0.8, 0.999, 1.0, 1.1, 2.0]) * np.float32(start):
        for delta in np.float32([0.3, 1.0, 1.5]) * np.float32(start):
            given = np.float32([0.7]), t[None], delta[None]
            want = double_sum(*given, near, np.inf, rule)
            np.testing.assert_allclose(compiled_distortion(*given, near, np.inf, rule=rule), want, rtol=3e-6, atol=1e-7)
            slot = {"ray_index": np.zeros(1, np.int32), "used": np.ones(1, bool), "rule": rule}
            slot = jaxnerf.PackedSamples(**dict(zip(("weights", "t", "delta"), given, strict=True)), **slot)
            packed = dataclasses.replace(make_rendering(*[np.zeros((1, 1), np.float32)] * 3), samples=slot)
            got = compiled_loss([packed], make_batch(np.full(1, near), np.inf))[0]
            np.testing.assert_allclose(got, want, rtol=3e-6, atol=1e-7)


@pytest.mark.parametrize("near, far", [FINITE_FAR, INFINITE_FAR])
@pytest.mark.parametrize("rule", ["segments", "points"])
def test_the_linear_sum_is_the_double_sum(near, far, rule):
    for seed, count in ((0, 1), (1, 2), (2, 33), (3, 200)):
        given = random_samples(seed, count, near, far)
        want = double_sum(*given, near, far, rule)
        np.testing.assert_allclose(compiled_distortion(*given, near, far, rule=rule), want, rtol=2e-6, atol=1e-12)


@pytest.mark.parametrize("rule", ["segments", "points"])
@pytest.mark.parametrize(
    "edges", [(0.2, 0.7, 1.6, 3.0), (0.0, 1.0, 2.0, 9.0), (0.1, 40.0), (0.0, 0.5), (0.5, 0.9, 1.2)]
)
def test_segments_of_a_ray_from_0_to_infinity_are_cut_at_1(edges, rule):
    """The definition: s(t) = 1 - 1 / max(t, 1), and a segment's length is the difference of s at its ends."""
    edges = np.array(edges)
    lower, upper, t = edges[:-1], edges[1:], edges[:-1] if rule == "points" else (edges[1:] + edges[:-1]) / 2
    s, lengths = 1 - 1 / np.maximum(t, 1), 1 / np.maximum(lower, 1) - 1 / np.maximum(upper, 1)
    weights = np.linspace(0.1, 0.3, len(t))
    want = (weights * weights[:, None] * np.abs(s - s[:, None])).sum() + (weights**2 * lengths).sum() / 3
    got = compiled_distortion(*map(np.float32, (weights, t, upper - lower)), 0.0, np.inf, rule=rule)
    np.testing.assert_allclose(got, want, rtol=2e-6, atol=1e-9)


@pytest.mark.parametrize("near, far", [FINITE_FAR, INFINITE_FAR])
def test_the_gradient_is_that_of_the_double_sum(near, far):
    given = random_samples(4, 40, near, far)
    slopes = loss_and_gradient(*given, near, far)[1]
    used = given[2] > 0
    for place, slope in enumerate(slopes):
        for index in np.flatnonzero(used)[::5]:
            step = 1e-5 * given[1][index]
            low, high = ([np.float64(value) for value in given] for _ in range(2))
            low[place][index] -= step
            high[place][index] += step
            want = (double_sum(*high, near, far) - double_sum(*low, near, far)) / (2 * step)
            np.testing.assert_allclose(slope[index], want, rtol=1e-3, atol=2e-6)
        assert not np.any(slope[~used])


def nan_where_unused(weights, t, delta):
    return weights, np.where(delta > 0, t, np.float32(np.nan)), delta


@pytest.mark.parametrize(
    "name, near, far, change",
    [
        ("an empty ray", 1.0, 7.0, lambda w, t, d: (0 * w, t, d)),
        ("no used sample", 1.0, 7.0, lambda w, t, d: (w, t, 0 * d)),
        ("NaN where nothing is used", 1.0, 7.0, nan_where_unused),
        ("near equals far", 3.0, 3.0, lambda w, t, d: (w, 0 * t + 3, 0 * d)),
        ("near equals far, positive lengths", 3.0, 3.0, lambda w, t, d: (w, t, d)),
        ("infinite far", 1.0, np.inf, nan_where_unused),
        ("infinite far and last segment", 1.0, np.inf, lambda w, t, d: (w, t, np.append(d[:-1], np.float32(np.inf)))),
        ("infinite far from 0 on", 0.0, np.inf, lambda w, t, d: (w, t, d)),
        ("coincident samples", 1.0, 7.0, lambda w, t, d: (w, 0 * t + 2, d)),
    ],
)
def test_degenerate_rays_have_finite_losses_and_gradients(name, near, far, change):
    given = tuple(np.float32(value) for value in change(*random_samples(5, 24, 1.0, 7.0)))
    value, slopes = loss_and_gradient(*given, near, far)
    assert all_finite((value, slopes[0], slopes[1])), name
    assert np.isfinite(slopes[2][np.isfinite(given[2])]).all() and value >= 0
    if name in ("an empty ray", "no used sample", "near equals far", "near equals far, positive lengths"):
        assert value == 0 and not np.any(slopes[1])


@pytest.mark.parametrize("far", [7.0, np.inf])
def test_the_last_delta_of_points_ends_with_the_ray(far):
    """A last delta of 1e10, as in the released codes, counts up to far."""
    t = np.float32([1.5, 2.0, 4.0, 6.0])
    weights, delta = np.float32([0.1, 0.2, 0.3, 0.1]), np.float32([0.5, 2.0, 2.0, 1e10])
    got = compiled_distortion(weights, t, delta, 1.5, far, rule="points")
    np.testing.assert_allclose(got, double_sum(weights, t, delta, 1.5, far, "points"), rtol=1e-5)


def test_nan_weights_show():
    weights, t, delta = random_samples(6, 8, 1.0, 7.0)
    delta[3] = 1.0
    weights[3] = np.nan
    assert np.isnan(compiled_distortion(weights, t, delta, 1, 7))


@pytest.mark.parametrize("name", ["t", "weights"])
def test_nan_in_a_packed_ray_stays_in_its_ray(name):
    """Ray 1 of three is NaN; slots behind it are of ray 2, and the last two are unused."""
    arrays = {"t": np.float32([2, 3, 2, 4, 2, 5, 9, 9]), "weights": np.float32([0.3, 0.4] * 3 + [0, 0])}
    others = {
        "delta": np.ones(8, np.float32),
        "ray_index": np.int32([0, 0, 1, 1, 2, 2, 2, 2]),
        "used": np.arange(8) < 6,
    }
    batch = make_batch(np.full(3, 1.0), 7.0)

    @jax.jit
    def losses(**arrays):
        samples = jaxnerf.PackedSamples(**arrays, **others)
        rendering = make_rendering(np.zeros((3, 1), np.float32), np.zeros((3, 1)), np.zeros((3, 1)))
        return jaxnerf.distortion_loss([dataclasses.replace(rendering, weights=None, samples=samples)], batch)

    slopes = jax.jit(jax.grad(lambda arrays: losses(**arrays)[jnp.array([0, 2])].sum()))
    clean, clean_slopes = jax.device_get((losses(**arrays), slopes(arrays)))
    arrays[name][2:4] = np.nan
    got = np.asarray(losses(**arrays))
    np.testing.assert_array_equal(np.isnan(got), [False, True, False])
    np.testing.assert_array_equal(got[[0, 2]], clean[[0, 2]])
    for key, slope in slopes(arrays).items():
        np.testing.assert_array_equal(np.delete(slope, [2, 3]), np.delete(clean_slopes[key], [2, 3]))


@pytest.mark.parametrize("far", [7.0, np.inf])
def test_dense_and_packed_distortion_have_the_same_gradients(far):
    """By the weight and the position of each sample; the third of five rays is empty, and three slots are unused."""
    counts, rng = [4, 1, 0, 7, 3], np.random.default_rng(2)
    ray = np.repeat(np.arange(5), counts)
    rank = np.concatenate([np.arange(count) for count in counts])
    weights, delta = (rng.uniform(0.01, 0.3, len(ray)).astype(np.float32) for _ in range(2))
    t = np.float32(1.5 + 0.7 * rank + rng.uniform(0, 0.3, len(ray)))
    scale = rng.normal(size=5).astype(np.float32)

    def dense(weights, t):
        def placed(values, fill):
            return jnp.full((5, 7), fill, jnp.float32).at[ray, rank].set(values)

        return distortion(placed(weights, 0.0), placed(t, 1.0), placed(delta, 0.0), 1.0, far)

    def packed(weights, t):
        slots = jaxnerf.PackedSamples(
            weights=jnp.pad(weights, (0, 3)),
            t=jnp.pad(t, (0, 3)),
            delta=np.pad(delta, (0, 3)),
            ray_index=np.pad(ray, (0, 3), constant_values=4).astype(np.int32),
            used=np.arange(len(ray) + 3) < len(ray),
        )
        rendering = dataclasses.replace(
            make_rendering(*[np.zeros((5, 1), np.float32)] * 3), weights=None, samples=slots
        )
        return jaxnerf.distortion_loss([rendering], make_batch(np.full(5, 1.0), far))

    np.testing.assert_allclose(jax.jit(packed)(weights, t), jax.jit(dense)(weights, t), rtol=1e-5, atol=1e-7)
    slopes = (jax.grad(lambda *a, f=f: (scale * f(*a)).sum(), argnums=(0, 1)) for f in (dense, packed))
    want, got = (jax.jit(slope)(weights, t) for slope in slopes)
    for slope, expected in zip(got, want, strict=True):
        np.testing.assert_allclose(slope, expected, rtol=1e-4, atol=1e-6)


RAYS, SEGMENTS = 24, 40


def dense_rendering(scene, rays, samples):
    return jaxnerf.render_samples(scene, rays, samples)


def packed_rendering(scene, rays, samples):
    return jaxnerf.render_packed(scene, None, rays, samples, max_samples=RAYS * SEGMENTS + 7)


@functools.partial(jax.jit, static_argnums=0)
def losses_and_slope(render, rays, samples, batch):
    """Returns two losses [2, RAYS] of a Gaussian ball, and the derivative of their sum by its density."""

    def total(scale):
        outputs = [render(lambda x, v: (scale * jnp.exp(-2 * (x**2).sum(axis=-1)), jax.nn.sigmoid(x)), rays, samples)]
        losses = jnp.stack([loss(outputs, batch) for loss in (jaxnerf.distortion_loss, depth_loss)])
        return losses.sum(), losses

    (_, losses), slope = jax.value_and_grad(total, has_aux=True)(jnp.float32(4.0))
    return losses, slope


@pytest.mark.parametrize("masked", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize("rule", ["segments", pytest.param("points", marks=pytest.mark.slow)])
def test_dense_and_packed_renderings_have_the_same_losses(masked, rule, unoptimized):
    """Also in value and gradient where the occupancy grid skips samples, or the buffer has unused slots."""
    rays = rays_past_origin(0, RAYS)
    edges = jaxnerf.uniform_edges(rays.near, rays.far, num_segments=SEGMENTS)
    segments = jaxnerf.samples_from_edges(jax.random.key(1), edges)
    samples = segments if rule == "segments" else jaxnerf.samples_from_points(segments.t)
    grid = checked_grid() if masked else full_grid()
    samples = dataclasses.replace(samples, delta=jnp.where(is_occupied(grid, rays, samples.t), samples.delta, 0))
    depth = rays.near + np.linspace(0.2, 0.8, RAYS, dtype=np.float32) * (rays.far - rays.near)
    fields = {"depth": depth, "depth_weight": np.arange(RAYS) % 3 / 2.0}
    batch = jaxnerf.Batch(rays=rays, rgb=np.zeros((RAYS, 3), np.float32), **fields)

    want, want_slope = losses_and_slope(dense_rendering, rays, samples, batch)
    got, slope = losses_and_slope(packed_rendering, rays, samples, batch)
    assert got.shape == (2, RAYS) and np.max(want, axis=1).min() > 1e-3
    np.testing.assert_allclose(got[0], want[0], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(got[1:], want[1:], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(slope, want_slope, rtol=1e-4)


def test_batch_is_vmap_is_jit():
    parts = [random_samples(seed, 30, 1.0, 7.0) for seed in range(5)]
    given = [np.stack(values) for values in zip(*parts, strict=True)]
    assert_batch_is_vmap_is_jit(lambda *given: distortion(*given, 1.0, 7.0), *given)


def largest_intermediate(function, *given):
    """Returns the size of the largest array in the jaxpr of a function and of all that it calls."""

    def sizes(jaxpr):
        for equation in jaxpr.eqns:
            yield from (variable.aval.size for variable in equation.outvars)
            for inner in jaxprs_in_params(equation.params):
                yield from sizes(inner)

    return max(sizes(jax.make_jaxpr(function)(*given).jaxpr))


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["dense", "packed"])
def test_time_and_memory_are_linear_in_the_number_of_samples(layout):
    def function(weights, t, delta):
        if layout == "dense":
            return jax.grad(lambda weights: distortion(weights, t, delta, 1.0, 7.0))(weights)
        index = jnp.arange(weights.size, dtype=jnp.int32) // 100
        samples = jaxnerf.PackedSamples(weights=weights, t=t, delta=delta, ray_index=index, used=delta > 0)
        batch = make_batch(jnp.ones(weights.size // 100), 7.0)

        def total(weights):
            rendering = make_rendering(weights, t, delta)
            rendering = dataclasses.replace(
                rendering, weights=None, samples=dataclasses.replace(samples, weights=weights)
            )
            return jaxnerf.distortion_loss([rendering], batch).sum()

        return jax.grad(total)(weights)

    flops = []
    for count in (2000, 8000):
        given = random_samples(0, count, 1.0, 7.0)
        assert largest_intermediate(function, *given) <= 20 * count
        flops.append(jax.jit(function).lower(*given).compile().cost_analysis()["flops"])
    assert flops[1] < 5 * flops[0]  # 16 where it is quadratic


def test_a_rendering_without_samples_is_an_error():
    weights, t, delta = random_samples(0, 4, 1.0, 7.0)
    rendering = make_rendering(weights, t, delta)
    for incomplete in (without_samples(rendering), dataclasses.replace(rendering, weights=None)):
        with pytest.raises(ValueError, match="distortion_loss: the rendering has no samples"):
            jaxnerf.distortion_loss([incomplete], make_batch(1.0, 7.0))


def test_mse_is_the_sum_over_all_renderings():
    rng = np.random.default_rng(0)
    colors = jnp.asarray(rng.uniform(size=(3, 5, 3)), jnp.float32)
    weights = np.zeros((5, 1), np.float32)
    outputs = [dataclasses.replace(make_rendering(weights, weights, weights), rgb=rgb) for rgb in colors[:2]]
    batch = dataclasses.replace(make_batch(np.ones(5), 2.0), rgb=colors[2])
    want = sum(((rgb - colors[2]) ** 2).mean(axis=-1) for rgb in colors[:2])
    np.testing.assert_allclose(mse_loss(outputs, batch), want, rtol=1e-6)
    np.testing.assert_allclose(mse_loss(outputs[1:], batch).mean(), ((colors[1] - colors[2]) ** 2).mean(), rtol=1e-6)


def depth_of(weights, t, delta, depth, confidence=1.0):
    """Returns the depth loss of one ray."""
    batch = dataclasses.replace(
        make_batch(0.0, 9.0), depth=jnp.float32(depth), depth_weight=jnp.asarray(confidence, jnp.float32)
    )
    return depth_loss([make_rendering(weights, t, delta)], batch)


def test_the_depth_loss_is_the_mean_relative_distance_from_the_depth():
    """Also its gradient; the transmitted fraction counts as infinitely far."""
    weights, t, delta = random_samples(7, 30, 1.0, 7.0)
    used, depth = delta > 0, 3.0
    distance = np.abs(t - depth) / (t + depth)
    want = (weights * distance)[used].sum() + 1 - weights[used].sum()
    value, slope = jax.jit(jax.value_and_grad(depth_of))(weights, np.where(used, t, np.nan), delta, depth, 0.5)
    np.testing.assert_allclose(value, 0.5 * want, rtol=1e-5)
    np.testing.assert_allclose(slope, np.where(used, 0.5 * (distance - 1), 0), atol=1e-6)


def test_the_depth_loss_is_least_where_the_ray_ends_at_the_depth():
    t = np.float32([1.0, 3.0, 6.0])
    at = [depth_of(np.eye(3, dtype=np.float32)[index], t, np.ones_like(t), 3.0) for index in range(3)]
    fog = depth_of(np.float32([0.6, 0.0, 0.4]), t, np.ones_like(t), 3.0)  # its mean depth is 3, too
    np.testing.assert_allclose([*at, fog], [0.5, 0, 1 / 3, 0.6 / 2 + 0.4 / 3], atol=1e-6)


def test_a_depth_of_weight_0_has_no_loss_and_no_gradient():
    given = random_samples(8, 9, 1.0, 7.0)
    for depth, confidence in ((0.0, 0.0), (3.0, 0.0), (0.0, 1.0)):
        value, slope = jax.jit(jax.value_and_grad(depth_of))(*given, depth, confidence)
        assert value == confidence and not np.any(slope)
