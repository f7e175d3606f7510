"""visible_grid keeps the cells that views need; thin fog and the insides of objects are empty."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import compiled, rays_past_origin
from jaxnerf import render_packed
from jaxnerf.core.occupancy.from_scene import drop_thin_density, visible_grid
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.fields.base import Field
from jaxnerf.models.grid_schedule import make_grid_schedule

SIDE, STEP = 24, 0.03
FOG = 0.9  # of the density below which a cell is empty
WIRE = 0.02  # its radius; a cell's side is 0.083


@pytest.fixture(scope="module")
def schedule():
    options = {"threshold": 0.01, "update_every": 1, "cells_per_update": 2**15}
    bounds = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
    return make_grid_schedule(*bounds, resolution=SIDE, step_size=STEP, field=Field(None, None), **options)


def scene(x, viewdirs):
    """A ball, opaque and of one colour; a thin wire beside it; and fog all around."""
    ball = jnp.linalg.norm(x, axis=-1) < 0.4
    wire = jnp.linalg.norm(x[..., :2] - jnp.array([0.75, 0.0]).reshape(1, 1, 2), axis=-1) < WIRE
    density = jnp.where(ball, 200.0, jnp.where(wire, 400.0, FOG * 0.01 / STEP))
    return density, jnp.where(ball[..., None], 0.8, 0.3) + 0 * x


@pytest.fixture(scope="module")
def grid(schedule):
    find = jax.jit(lambda rays: visible_grid(scene, rays, **schedule.box(), max_samples=2**14, background=None))
    return find(rays_past_origin(0, 2**15))


def kinds_of_cells():
    """Returns the distance of each cell's middle to the ball's, and to the wire."""
    x, y, z = (np.indices((SIDE,) * 3) + 0.5) * (2 / SIDE) - 1
    return np.sqrt(x**2 + y**2 + z**2), np.hypot(x - 0.75, y)


def test_fog_and_the_inside_of_an_object_are_empty(grid):
    occupied, (from_ball, from_wire) = np.asarray(grid.occupied), kinds_of_cells()
    assert occupied.any()
    assert not occupied[(from_ball > 0.48) & (from_wire > 0.09)].any()
    assert not occupied[from_ball < 0.2].any()


def test_a_visible_wire_thinner_than_a_cell_is_kept(grid):
    occupied, (_, from_wire) = np.asarray(grid.occupied), kinds_of_cells()
    assert (occupied & (from_wire < 0.06)).any(axis=(0, 1)).mean() > 0.9


def test_images_are_those_of_the_scene_without_fog(schedule, grid):
    rays = rays_past_origin(1, 256)
    samples = compiled(march_rays, "step_size", "cell")(None, grid, rays, step_size=STEP, cell=schedule.cell)
    everywhere = schedule.create(jnp.ones((SIDE,) * 3, bool))
    clear = drop_thin_density(scene, everywhere, schedule.threshold)
    show = jax.jit(lambda grid: render_packed(clear, grid, rays, samples, max_samples=2**15).rgb)
    np.testing.assert_allclose(show(grid), show(everywhere), atol=1 / 256)
