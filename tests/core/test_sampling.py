import jax
import numpy as np
import pytest

import jaxnerf
from helpers import all_finite, assert_batch_is_vmap_is_jit, compiled
from jaxnerf.core.sampling import stratified_points

RAYS, SEGMENTS, POINTS = 6, 8, 5

uniform_edges = compiled(jaxnerf.uniform_edges, "num_segments", "in_disparity")
samples_from_edges = compiled(jaxnerf.samples_from_edges)
samples_from_points = compiled(jaxnerf.samples_from_points)
inverse_cdf = compiled(jaxnerf.inverse_cdf)
importance_points = compiled(jaxnerf.importance_points, "num_points", "padding")
merge_edges = compiled(jaxnerf.merge_edges)
slope_of_inverse_cdf = compiled(jax.grad(lambda u: jaxnerf.inverse_cdf(np.arange(5.0), np.ones(4), u[None])[0]))


def f32(values):
    return np.asarray(values, np.float32)


@pytest.fixture(scope="module")
def edges():
    return f32(2 + np.cumsum(np.random.default_rng(0).uniform(0.01, 1, (RAYS, SEGMENTS + 1)), axis=-1))


@pytest.fixture(scope="module")
def weights():
    return f32(np.random.default_rng(1).exponential(size=(RAYS, SEGMENTS)))


@pytest.fixture(scope="module")
def keys():
    return jax.random.split(jax.random.key(2), RAYS)


@pytest.mark.parametrize("in_disparity", [False, True])
def test_uniform_edges_begin_at_near_and_end_at_far_exactly(in_disparity):
    near = f32(np.random.default_rng(3).uniform(0.01, 3.0, 500))
    far = near + f32(np.random.default_rng(4).exponential(size=500))
    got = uniform_edges(near, far, num_segments=7, in_disparity=in_disparity)
    assert got.shape == (500, 8)
    np.testing.assert_array_equal(got[:, 0], near)
    np.testing.assert_array_equal(got[:, -1], far)
    assert (np.diff(got, axis=-1) >= 0).all()
    steps = np.diff(1 / np.asarray(got, np.float64) if in_disparity else np.asarray(got, np.float64), axis=-1)
    np.testing.assert_allclose(steps, np.broadcast_to(steps.mean(axis=-1, keepdims=True), (500, 7)), atol=3e-5)


def test_uniform_edges_reach_infinity_in_disparity():
    got = uniform_edges(f32(2.0), f32(np.inf), num_segments=4, in_disparity=True)
    np.testing.assert_allclose(got, [2, 8 / 3, 4, 8, np.inf], rtol=1e-6)


@pytest.mark.parametrize("rule", ["segments", "gauss"])
def test_random_samples_move_with_their_edges(edges, keys, rule):
    """They can be differentiated by the edges: all edges shifted by the same distance shift all samples by it."""
    move = lambda edges: jaxnerf.samples_from_edges(keys, edges, rule=rule).t  # noqa: E731
    _, moved = jax.jit(lambda *of: jax.jvp(move, *of))((edges,), (np.ones_like(edges),))
    np.testing.assert_allclose(moved, 1, rtol=1e-5)


@pytest.mark.parametrize("in_disparity", [False, True])
def test_uniform_edges_of_an_empty_ray(in_disparity):
    same = f32([0.1, 3.3])
    got = uniform_edges(same, same, num_segments=3, in_disparity=in_disparity)
    np.testing.assert_array_equal(got, np.repeat(same[:, None], 4, axis=1))


def test_midpoints_without_a_key(edges):
    samples = samples_from_edges(None, edges)
    np.testing.assert_allclose(samples.t, (edges[:, 1:] + edges[:, :-1]) / 2, rtol=1e-6)
    np.testing.assert_array_equal(samples.delta, np.diff(edges))
    assert samples.rule == "segments"


@pytest.mark.parametrize("width", [1e-2, 1.0])
def test_exactly_one_sample_in_each_segment(width):
    """At t = 1000 a segment of width 1e-2 / 8 holds 20 floats, so that a plain draw may be rounded out of it."""
    bins = f32(1000 + width * np.broadcast_to(np.linspace(0, 1, 9), (4000, 9)))
    t = samples_from_edges(jax.random.key(5), bins).t
    assert (t >= bins[:, :-1]).all() and (t < bins[:, 1:]).all()


def test_draws_fill_their_segment_evenly():
    t = samples_from_edges(jax.random.key(6), np.broadcast_to(f32([0.0, 1.0, 3.0]), (4000, 3))).t
    for i, (lower, upper) in enumerate([(0, 1), (1, 3)]):
        counts = np.histogram(t[:, i], bins=8, range=(lower, upper))[0]
        assert counts.sum() == 4000 and abs(counts - 500).max() < 120  # over five deviations


def test_draws_fill_an_infinite_segment_evenly_in_disparity():
    t = samples_from_edges(jax.random.key(6), np.broadcast_to(f32([2.0, np.inf]), (4000, 2))).t
    counts = np.histogram(1 / t, bins=8, range=(0, 0.5))[0]
    assert counts.sum() == 4000 and abs(counts - 500).max() < 120  # over five deviations


def test_a_ray_with_its_own_key_does_not_depend_on_its_batch(edges, weights, keys):
    t, points = samples_from_edges(keys, edges).t, importance_points(keys, edges, weights, num_points=POINTS)
    np.testing.assert_array_equal(samples_from_edges(keys[2:4], edges[2:4]).t, t[2:4])
    np.testing.assert_array_equal(samples_from_edges(keys[3], edges[3]).t, t[3])
    part = importance_points(keys[2:4], edges[2:4], weights[2:4], num_points=POINTS)
    np.testing.assert_array_equal(part, points[2:4])


def test_one_key_draws_different_numbers_for_every_ray(edges, weights):
    same = np.broadcast_to(edges[0], edges.shape)
    t = samples_from_edges(jax.random.key(7), same).t
    assert len(np.unique(t[:, 0])) == RAYS
    np.testing.assert_array_equal(t, samples_from_edges(jax.random.key(7), same).t)
    assert (t != samples_from_edges(jax.random.key(8), same).t).any()
    points = importance_points(jax.random.key(7), same, np.ones_like(weights), num_points=POINTS)
    assert len(np.unique(points[:, 0])) == RAYS


def test_points_stand_for_the_gap_behind_them():
    samples = samples_from_points(f32([1.0, 1.5, 4.0]))
    np.testing.assert_array_equal(samples.delta, f32([0.5, 2.5, 1e10]))
    np.testing.assert_array_equal(samples_from_points(f32([[1.0]]), last_delta=2.0).delta, [[2.0]])


def test_inverse_cdf_by_hand():
    e, w = f32([0.0, 1.0, 2.0, 5.0]), f32([1.0, 3.0, 0.0])
    u = f32([0.0, 0.125, 0.25, 0.625, 1.0])
    np.testing.assert_allclose(inverse_cdf(e, w, u), [0, 0.5, 1, 1.5, 2], atol=1e-6)


def test_inverse_cdf_undoes_the_cdf(edges, weights):
    u = f32(np.sort(np.random.default_rng(9).uniform(size=(RAYS, 40)), axis=-1))
    t = inverse_cdf(edges, weights, u)
    assert (np.diff(t, axis=-1) >= 0).all()
    for row in range(RAYS):
        sums = np.append(0, np.cumsum(np.asarray(weights[row], np.float64)))
        np.testing.assert_allclose(np.interp(t[row], edges[row], sums / sums[-1]), u[row], atol=1e-5)


@pytest.mark.parametrize("scale", [1e-36, 1e-20, 1e20, 1e37])
def test_inverse_cdf_has_no_scale(edges, weights, scale):
    u = np.broadcast_to(np.linspace(0, 1, 11), (RAYS, 11))
    np.testing.assert_allclose(inverse_cdf(edges, weights * scale, u), inverse_cdf(edges, weights, u), rtol=1e-6)


def test_inverse_cdf_of_weights_whose_sum_overflows():
    points = inverse_cdf(f32([0, 1, 2, 3, 4]), np.full(4, 3e38, np.float32), f32([0.1, 0.5, 0.8]))
    np.testing.assert_allclose(points, [0.4, 2, 3.2], rtol=1e-6)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1.0, 1e30])
def test_inverse_cdf_gradients_are_finite(edges, weights, scale):
    slopes = compiled(jax.grad(lambda *a: jaxnerf.inverse_cdf(*a).sum(), argnums=(0, 2)))
    u = np.broadcast_to(np.linspace(0, 1, 5), (RAYS, 5))
    holes = np.where(weights > 1, weights, 0) * scale
    assert all_finite(slopes(edges, holes, u))


@pytest.mark.parametrize("random", [False, True])
def test_importance_points_split_the_weight_evenly_in_order_without_gradient(edges, weights, keys, random):
    key = keys if random else None
    points = importance_points(key, edges, weights, num_points=POINTS)
    assert (np.diff(points, axis=-1) >= 0).all()
    assert (points >= edges[:, :1]).all() and (points <= edges[:, -1:]).all()
    for row in range(RAYS):
        sums = np.append(0, np.cumsum(np.asarray(weights[row], np.float64)))
        fraction = POINTS * np.interp(points[row], edges[row], sums / sums[-1]) - np.arange(POINTS)
        assert (fraction > -1e-5).all() and (fraction < 1 + 1e-5).all()

    def total(edges, weights):
        return jaxnerf.importance_points(key, edges, weights, num_points=POINTS).sum()

    slopes = compiled(jax.grad(total, argnums=(0, 1)))
    for slope in slopes(edges, weights):
        np.testing.assert_array_equal(slope, 0)


def test_importance_points_of_an_empty_ray_and_of_one_wall():
    e = f32(np.linspace(2, 6, 5))
    np.testing.assert_allclose(importance_points(None, e, np.zeros(4), num_points=4), [2.5, 3.5, 4.5, 5.5])
    wall = importance_points(None, e, f32([0.0, 0.0, 1.0, 0.0]), num_points=3)
    np.testing.assert_allclose(wall, [4 + 1 / 6, 4.5, 5 - 1 / 6], rtol=1e-6)


def test_one_hot_weights_place_all_points_in_their_segment():
    """Also at u = 0 and u = 1, whatever the number of empty segments before and behind."""
    e = np.broadcast_to(np.arange(9, dtype=np.float32) ** 2, (8, 9))
    got = inverse_cdf(e, np.eye(8, dtype=np.float32), np.broadcast_to(f32([0, 0.5, 1]), (8, 3)))
    np.testing.assert_allclose(got, np.stack([e[0, :-1], (e[0, :-1] + e[0, 1:]) / 2, e[0, 1:]], axis=-1))


@pytest.mark.parametrize("place", [0, SEGMENTS - 1])
def test_nan_weights_show(edges, weights, place):
    """Numbers would look like points of a field that works."""
    broken = weights.copy()
    broken[2, place] = np.nan
    points = importance_points(None, edges, broken, num_points=POINTS)
    np.testing.assert_array_equal(np.isnan(points), np.broadcast_to(np.arange(RAYS)[:, None] == 2, points.shape))


def test_one_importance_point_is_the_median():
    got = importance_points(None, f32([0.0, 1.0, 2.0]), f32([1.0, 3.0]), num_points=1)
    np.testing.assert_allclose(got, [4 / 3], rtol=1e-6)


def test_padding_is_added_to_every_weight(edges, weights):
    got = importance_points(None, edges, weights, num_points=POINTS, padding=0.5)
    np.testing.assert_allclose(got, importance_points(None, edges, weights + 0.5, num_points=POINTS), rtol=1e-6)


def test_merged_edges_are_sorted_and_complete():
    got = merge_edges(f32([[1.0, 3.0]]), f32([[2.0, 3.0, 0.5]]))
    np.testing.assert_array_equal(got, [[0.5, 1.0, 2.0, 3.0, 3.0]])


def test_batch_is_vmap_is_jit(edges, weights, keys):
    near, far, u = edges[:, 0], edges[:, -1], f32([[0.0, 0.4, 1.0]] * RAYS)
    assert_batch_is_vmap_is_jit(lambda a, b: jaxnerf.uniform_edges(a, b, num_segments=3), near, far)
    assert_batch_is_vmap_is_jit(jaxnerf.samples_from_edges, keys, edges)
    assert_batch_is_vmap_is_jit(jaxnerf.samples_from_points, edges)
    assert_batch_is_vmap_is_jit(jaxnerf.inverse_cdf, edges, weights, u)
    assert_batch_is_vmap_is_jit(lambda *a: jaxnerf.importance_points(*a, num_points=3), keys, edges, weights)
    assert_batch_is_vmap_is_jit(jaxnerf.merge_edges, edges, weights)


def test_wrong_arguments():
    ones = np.ones
    for message, call in {
        "far": lambda: jaxnerf.uniform_edges(ones(2), ones(3), num_segments=2),
        "num_segments": lambda: jaxnerf.uniform_edges(ones(2), ones(2), num_segments=0),
        "near": lambda: jaxnerf.uniform_edges(np.zeros(2), ones(2), num_segments=2, in_disparity=True),
        "far is inf": lambda: stratified_points(None, ones(2), np.full(2, np.inf), num_points=4),
        "edges": lambda: jaxnerf.samples_from_edges(None, ones((2, 1))),
        "rule": lambda: jaxnerf.samples_from_edges(None, ones(3), rule="other"),
        "key": lambda: jaxnerf.samples_from_edges(jax.random.split(jax.random.key(0), 3), ones((2, 4))),
        "t has": lambda: jaxnerf.samples_from_points(np.float32(1.0)),
        "weights": lambda: jax.eval_shape(jaxnerf.inverse_cdf, ones((2, 4)), ones((2, 4)), ones((2, 5))),
        "u has": lambda: jaxnerf.inverse_cdf(ones((2, 4)), ones((2, 3)), ones((3, 5))),
        "num_points": lambda: jaxnerf.importance_points(None, ones(3), ones(2), num_points=0),
        "weights has": lambda: jaxnerf.importance_points(None, ones((2, 4)), ones((3, 3)), num_points=2),
        "points": lambda: jaxnerf.merge_edges(ones((2, 4)), ones((3, 4))),
    }.items():
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.parametrize("u", [0.0, 0.25, 0.5, 1.0])
def test_the_gradient_of_inverse_cdf_is_not_halved_at_ties(u):
    assert slope_of_inverse_cdf(f32(u)) == 4


def test_weights_of_half_precision_are_raised_first():
    weights = jax.numpy.asarray(np.random.default_rng(10).uniform(size=128), jax.numpy.bfloat16)
    given = f32(np.linspace(2, 6, 129)), weights
    got = importance_points(None, *given, num_points=192)
    want = importance_points(None, given[0], weights.astype("float32"), num_points=192)
    assert got.dtype == np.float32
    np.testing.assert_array_equal(got, want)
    assert samples_from_edges(None, given[0].astype(jax.numpy.bfloat16)).t.dtype == np.float32


@pytest.mark.parametrize("near, far, count", [(2, 6, 100), (2, 6, 192), (0, 1, 100), (1000, 1000.5, 192)])
def test_draws_lie_in_the_exact_bins(near, far, count):
    """Edges are rounded; a draw equal to one would count for the bin before."""
    edges = uniform_edges(f32(near), f32(far), num_segments=count)
    t = samples_from_edges(jax.random.key(11), np.broadcast_to(edges, (20_000, count + 1))).t
    bins = (np.asarray(t, np.float64) - near) / (far - near) * count
    np.testing.assert_array_equal(np.floor(bins), np.broadcast_to(np.arange(count), t.shape))
