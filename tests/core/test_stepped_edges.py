"""Edges in equal steps: their number grows with the length of the ray, and they cover the ray exactly."""

import jax
import numpy as np
import pytest

import jaxnerf
from helpers import assert_batch_is_vmap_is_jit, compiled

RAYS, SEGMENTS, STEP = 200, 40, 0.125

stepped_edges = compiled(jaxnerf.stepped_edges, "num_segments")
samples_from_edges = compiled(jaxnerf.samples_from_edges)


@pytest.fixture(scope="module")
def ends():
    """Returns near and far [RAYS]; the segments reach far on every ray, and some rays are empty."""
    rng = np.random.default_rng(0)
    near = np.float32(rng.uniform(0, 3, RAYS))
    way = rng.uniform(0, (SEGMENTS - 1) * STEP, RAYS) * (rng.uniform(size=RAYS) < 0.9)
    return near, near + np.float32(way)


@pytest.fixture(scope="module")
def keys():
    return jax.random.split(jax.random.key(1), RAYS)


@pytest.fixture(params=["no key", "one key", "a key per ray"])
def edges(request, ends, keys):
    key = {"no key": None, "one key": jax.random.key(2), "a key per ray": keys}[request.param]
    return stepped_edges(key, *ends, step_size=STEP, num_segments=SEGMENTS)


def test_they_ascend_from_near_to_far_exactly(ends, edges):
    near, far = ends
    assert edges.shape == (RAYS, SEGMENTS + 1) and edges.dtype == np.float32
    np.testing.assert_array_equal(edges[:, 0], near)
    np.testing.assert_array_equal(edges[:, -1], far)
    assert (np.diff(edges) >= 0).all()


def test_all_but_the_ends_are_one_step_long(ends, edges):
    near, far = ends
    lengths = np.diff(np.float64(edges))
    assert lengths.max() <= STEP + 1e-6  # also the last: the ways are no longer than the segments reach
    for length, begin, end in zip(lengths, near, far, strict=True):
        taken = np.flatnonzero(length)
        assert taken.size == 0 if begin == end else (taken == np.arange(taken.size)).all()
        np.testing.assert_allclose(length[taken[1:-1]], STEP, atol=2e-6)


def test_samples_cover_the_whole_ray(ends, edges):
    near, far = ends
    samples = samples_from_edges(None, edges)
    np.testing.assert_allclose(np.float64(samples.delta).sum(-1), np.float64(far) - near, atol=1e-5)
    some = samples.delta > 0
    assert ((samples.t >= near[:, None]) & (samples.t <= far[:, None])).all()
    np.testing.assert_array_equal(some.any(-1), far > near)


def test_a_key_moves_all_edges_of_a_ray_by_one_draw(keys):
    near, far = np.zeros(RAYS, np.float32), np.full(RAYS, 100, np.float32)
    still = stepped_edges(None, near, far, step_size=STEP, num_segments=SEGMENTS)
    moved = still - stepped_edges(keys, near, far, step_size=STEP, num_segments=SEGMENTS)
    draws = moved[:, 1] / STEP
    np.testing.assert_allclose(moved[:, 1:-1], np.broadcast_to(moved[:, 1:2], (RAYS, SEGMENTS - 1)), atol=1e-6)
    assert (draws >= 0).all() and (draws < 1).all() and len(np.unique(draws)) > RAYS * 0.95
    assert np.abs(np.histogram(draws, bins=4, range=(0, 1))[0] - RAYS / 4).max() < 31  # five deviations
    one = stepped_edges(jax.random.key(2), near, far, step_size=STEP, num_segments=SEGMENTS)
    assert len(np.unique(one[:, 1])) > RAYS * 0.95


def test_a_ray_with_its_own_key_does_not_depend_on_its_batch(ends, keys):
    near, far = ends
    whole = stepped_edges(keys, near, far, step_size=STEP, num_segments=SEGMENTS)
    part = stepped_edges(keys[2:4], near[2:4], far[2:4], step_size=STEP, num_segments=SEGMENTS)
    np.testing.assert_array_equal(part, whole[2:4])


def test_each_ray_can_have_its_step_size():
    near, far = np.float32([1, 1]), np.float32([2, 2])
    got = stepped_edges(None, near, far, step_size=np.float32([0.25, 0.5]), num_segments=4)
    np.testing.assert_array_equal(got, [[1, 1.25, 1.5, 1.75, 2], [1, 1.5, 2, 2, 2]])


def test_where_steps_do_not_reach_far_the_last_is_longer():
    got = stepped_edges(None, np.float32(1), np.float32(9), step_size=1.0, num_segments=3)
    np.testing.assert_array_equal(got, [1, 2, 3, 9])
    np.testing.assert_array_equal(
        stepped_edges(None, np.float32(1), np.float32(9), step_size=1.0, num_segments=1), [1, 9]
    )


def test_an_empty_ray_has_no_segment(keys):
    same = np.float32(np.linspace(0, 9, RAYS))
    for key in (None, keys):
        got = stepped_edges(key, same, same, step_size=STEP, num_segments=SEGMENTS)
        np.testing.assert_array_equal(got, np.repeat(same[:, None], SEGMENTS + 1, axis=1))


def test_batch_is_vmap_is_jit(ends, keys):
    def moved(key, near, far):
        return jaxnerf.stepped_edges(key, near, far, step_size=STEP, num_segments=5)

    assert_batch_is_vmap_is_jit(moved, keys, *ends)


def test_gradients_are_those_of_near_and_far():
    """Each edge follows near, up to where it is far."""

    def total(near, far):
        return jaxnerf.stepped_edges(None, near, far, step_size=1.0, num_segments=4).sum()

    near, far = (np.float32([value]) for value in (0.5, 2.9))  # 0.5 1.5 2.5 2.9 2.9
    np.testing.assert_array_equal(jax.jit(jax.grad(total, (0, 1)))(near, far), [[3], [2]])


def test_wrong_arguments(keys):
    ones = np.ones
    for message, call in {
        "far": lambda: jaxnerf.stepped_edges(None, ones(2), ones(3), step_size=1.0, num_segments=2),
        "num_segments is 0": lambda: jaxnerf.stepped_edges(None, ones(2), ones(2), step_size=1.0, num_segments=0),
        "key": lambda: jaxnerf.stepped_edges(keys[:3], ones(2), ones(2), step_size=1.0, num_segments=2),
        "fit": lambda: jaxnerf.stepped_edges(None, ones(2), ones(2), step_size=ones(3), num_segments=2),
    }.items():
        with pytest.raises(ValueError, match=message):
            call()
