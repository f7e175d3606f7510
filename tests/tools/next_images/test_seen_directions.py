"""Familiarity is that of the nearest direction seen, and a renderer composites it like a colour."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import compiled, full_grid, random_rays
from jaxnerf import render_packed, render_samples
from jaxnerf.core.poses import spread_directions
from jaxnerf.core.sampling import samples_from_edges, uniform_edges
from jaxnerf.tools.next_images.seen_directions import (
    NUM_DIRECTIONS,
    familiarity,
    familiarity_scene,
    nearest_direction,
)

DIRECTIONS = np.array(spread_directions(NUM_DIRECTIONS))
familiarity_of = compiled(familiarity)


def words(*directions):
    """Returns the words [2] of a cell that has been seen in some of the directions."""
    bits = sum(1 << direction for direction in directions)
    return np.uint32([bits & 0xFFFFFFFF, bits >> 32])


def unit_vectors(count):
    vectors = np.random.default_rng(0).normal(size=(count, 3))
    return np.float32(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def test_directions_cover_the_sphere():
    np.testing.assert_allclose(np.linalg.norm(DIRECTIONS, axis=1), 1)
    vectors = unit_vectors(4000)
    angles = np.degrees(np.arccos((vectors @ DIRECTIONS.T).max(axis=1)))
    assert angles.max() < 20 and angles.mean() < 10
    np.testing.assert_array_equal(compiled(nearest_direction)(vectors), (vectors @ DIRECTIONS.T).argmax(axis=1))


@pytest.mark.parametrize("seen", [(0,), (31,), (32,), (63,), (3, 40, 62)])
def test_familiarity_is_that_of_the_nearest_direction_seen(seen):
    vectors = unit_vectors(200)
    expected = (1 + (vectors @ DIRECTIONS[list(seen)].T).max(axis=1)) / 2
    found = familiarity_of(np.broadcast_to(words(*seen), (200, 2)), vectors)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_what_has_not_been_seen_is_not_familiar():
    np.testing.assert_array_equal(familiarity_of(np.zeros((7, 2), np.uint32), unit_vectors(7)), 0)


def test_more_directions_make_no_view_less_familiar():
    vectors, rng = unit_vectors(300), np.random.default_rng(1)
    some = rng.integers(0, 2**32, (300, 2), np.uint32) & rng.integers(0, 2**32, (300, 2), np.uint32)
    more = some | rng.integers(0, 2**32, (300, 2), np.uint32)
    assert (familiarity_of(more, vectors) >= familiarity_of(some, vectors)).all()


def ball(x, viewdirs):
    return 3 * jnp.exp(-(x**2).sum(axis=-1) / 2), 0.5 + 0 * (x + viewdirs)


def rendered(render, seen):
    grid, rays = full_grid(half=6.0, shape=(4, 4, 4)), random_rays(2, (20,), near=0.0, far=8.0)
    samples = samples_from_edges(None, uniform_edges(rays.near, rays.far, num_segments=64))

    @jax.jit
    def run(seen):
        return render(familiarity_scene(ball, grid, seen), rays, samples, background=[1.0])

    return run(jnp.asarray(seen)), rays


def test_a_renderer_composites_familiarity():
    everywhere, nowhere = (np.tile(words(*each), (4, 4, 4, 1)) for each in ((5,), ()))
    image, rays = rendered(render_samples, everywhere)
    assert image.rgb.shape == (20, 1) and 0.05 < image.opacity.max()
    value = familiarity_of(np.broadcast_to(words(5), (20, 2)), rays.viewdirs)
    np.testing.assert_allclose(image.rgb[:, 0], image.opacity * value + 1 - image.opacity, atol=1e-5)
    empty, _ = rendered(render_samples, nowhere)
    np.testing.assert_allclose(empty.rgb[:, 0], 1 - empty.opacity, atol=1e-5)


def test_the_words_are_those_of_the_cell_and_of_no_cell_outside():
    seen = np.zeros((4, 4, 4, 2), np.uint32)
    seen[1, 2, 3] = words(*range(64))
    scene = familiarity_scene(ball, full_grid(half=2.0, shape=(4, 4, 4)), seen)
    x = np.float32([[[-0.5, 0.5, 1.5], [0.5, -0.5, 1.5], [-0.5, 0.5, 2.5]]])
    density, found = jax.jit(scene)(x, np.float32([[[0, 0, 1]]]))
    assert found.shape == (1, 3, 1)
    assert found[0, 0, 0] > 0.97 and found[0, 1, 0] == 0 and found[0, 2, 0] == 0
    np.testing.assert_allclose(density, ball(x, x)[0], rtol=1e-5)


def test_packed_rendering_gives_the_same():
    rng = np.random.default_rng(3)
    seen = rng.integers(0, 2**32, (4, 4, 4, 2), np.uint32) & rng.integers(0, 2**32, (4, 4, 4, 2), np.uint32)
    grid = full_grid(half=6.0, shape=(4, 4, 4))

    def packed(scene, rays, samples, background):
        return render_packed(scene, grid, rays, samples, max_samples=2000, background=background)

    np.testing.assert_allclose(rendered(packed, seen)[0].rgb, rendered(render_samples, seen)[0].rgb, atol=1e-5)


def test_words_of_another_grid_are_refused():
    with pytest.raises(ValueError, match="two words for each cell"):
        familiarity_scene(ball, full_grid(shape=(4, 4, 4)), np.zeros((4, 4, 5, 2), np.uint32))
    with pytest.raises(ValueError, match="viewdirs has shape"):
        familiarity(np.zeros((3, 2), np.uint32), np.zeros((4, 3), np.float32))
