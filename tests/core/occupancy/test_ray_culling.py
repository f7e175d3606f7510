"""Ray culling skips no ray that hits an occupied cell, and images are the same without it."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import assert_same, compiled, random_rays, rays_past_origin
from jaxnerf import create_grid, render_rays
from jaxnerf.core.occupancy.grid import is_occupied
from jaxnerf.core.occupancy.ray_culling import rays_may_hit, render_background, render_selected
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.core.types import without_samples
from jaxnerf.models.occupancy import render_with_grid

SHAPE = (4, 3)
CELL = (0.05, 0.04, 0.06)


def ball(x, viewdirs):
    density = 5 * jax.nn.sigmoid(4 * (2 - jnp.sqrt((x**2).sum(axis=-1) + 1e-6)))
    return density, 0.5 + 0.2 * jnp.sin(x) + 0.3 * viewdirs


def through_ball(rays):
    return render_rays(None, ball, rays, num_samples=16)


def grid_of(kind):
    """Returns an OccupancyGrid that is empty, has a few occupied cells, or those of a ball."""
    shape, rng = (23, 40, 31), np.random.default_rng(0)  # no multiple of a coarse cell
    half = np.float32(np.multiply(CELL, shape) / 2)
    away = np.moveaxis(np.indices(shape), 0, -1) * CELL + np.divide(CELL, 2) - half
    valid = {
        "nothing": np.zeros(shape, bool),
        "dust": rng.uniform(size=shape) < 1e-3,
        "a ball": np.linalg.norm(away, axis=-1) < 0.4,
    }[kind]
    return create_grid(-half, half, valid, initial_density=1.0)


@pytest.mark.parametrize("kind, most", [("nothing", 0.0), ("dust", np.inf), ("a ball", 1.6)])
def test_no_ray_that_hits_an_occupied_cell_is_culled(kind, most):
    """And of rays past a ball, most are culled."""
    grid, rays = grid_of(kind), rays_past_origin(7, 4000)

    @jax.jit
    def classify(grid, rays):
        samples = march_rays(None, grid, rays, step_size=0.01, cell=CELL)
        meets = (samples.delta > 0) & is_occupied(grid, rays, samples.t)
        return meets.any(axis=-1), rays_may_hit(grid, rays, cell=CELL), (samples.delta > 0).any(axis=-1)

    meets, may, enters = map(np.asarray, classify(grid, rays))
    assert not (meets & ~may).any() and not (may & ~enters).any()
    assert may.sum() <= most * meets.sum()
    for name in ("origins", "directions", "near", "far"):
        unknown = dataclasses.replace(rays, **{name: np.full_like(getattr(rays, name), np.nan)})
        assert classify(grid, unknown)[1].all(), name
    everywhere = dataclasses.replace(grid, contracted=True)
    assert rays_may_hit(everywhere, rays, cell=CELL).all()


@pytest.mark.parametrize("fraction", [0.0, 0.4, 1.0])
def test_rays_that_are_not_selected_are_not_rendered(fraction):
    evaluated, rays = [], random_rays(0, SHAPE)

    @jax.jit
    def render(rays):
        jax.debug.callback(lambda *parts: evaluated.append(parts), rays.origins, rays.far - rays.near)
        return through_ball(rays)

    selected = jnp.asarray(np.random.default_rng(0).uniform(size=SHAPE) < fraction)
    nothing = render_background(rays, background=jnp.array([0.1, 0.2, 0.3]))
    got = jax.block_until_ready(render_selected(render, rays, selected, nothing, chunk=5))
    jax.effects_barrier()
    whole = without_samples(compiled(through_ball)(rays))
    either = lambda a, b: np.where(np.asarray(selected).reshape(*SHAPE, *(1,) * (a.ndim - 2)), a, b)  # noqa: E731
    assert_same(got, jax.tree.map(either, whole, nothing))
    assert len(evaluated) == -(-int(selected.sum()) // 5)
    origins = [origin for part, length in evaluated for origin in np.asarray(part)[np.asarray(length) > 0].tolist()]
    assert sorted(origins) == sorted(np.asarray(rays.origins)[np.asarray(selected)].tolist())
    with ThreadPoolExecutor(2) as pool:
        again = render_selected(jax.jit(through_ball), rays, selected, nothing, chunk=5, map=pool.map)
    assert_same(again, got)


@pytest.mark.slow
def test_render_background_is_the_rendering_of_an_empty_scene():
    rays, background = random_rays(0, SHAPE), jnp.array([0.1, 0.2, 0.3])
    empty = lambda x, viewdirs: (jnp.zeros(x.shape[:-1]), x)  # noqa: E731
    seen = render_rays(None, empty, rays, num_samples=4, background=background)
    got = render_background(rays, background=background)
    assert_same(got, without_samples(seen), rtol=0, atol=1e-6)
    assert_same(render_background(rays).rgb, np.zeros((*SHAPE, 3)), rtol=0, atol=0)


def test_culled_rays_are_rendered_the_same():
    grid, rays, background = grid_of("a ball"), rays_past_origin(7, 500), jnp.array([0.1, 0.2, 0.3])

    @jax.jit
    def both(grid, rays):
        options = {
            "step_size": 0.02,
            "cell": CELL,
            "early_stop_eps": 1e-3,
            "max_samples": 512,
            "background": background,
        }
        nothing = render_background(rays, background=background)
        return rays_may_hit(grid, rays, cell=CELL), render_with_grid(ball, grid, rays, **options), nothing

    may, seen, nothing = both(grid, rays)
    assert 0.1 < may.mean() < 0.9
    culled = lambda rendering: jax.tree.map(lambda leaf: np.asarray(leaf)[~may], rendering)  # noqa: E731
    assert_same(culled(seen), culled(nothing), rtol=0, atol=0)


def test_wrong_arguments():
    rays = random_rays(0, SHAPE)
    with pytest.raises(ValueError, match="render_selected: chunk is 0"):
        render_selected(through_ball, rays, np.ones(SHAPE, bool), None, chunk=0)
    with pytest.raises(ValueError, match=r"render_selected: selected has shape \(3,\), expected \(4, 3\)"):
        render_selected(through_ball, rays, np.ones(3, bool), None, chunk=4)
