"""Ray marching: samples at equal steps through the box of an occupancy grid, or at steps that grow with distance."""

import math
from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnerf.core.occupancy.grid import OccupancyGrid, clip_rays_to_box
from jaxnerf.core.safe_math import at_least_float32
from jaxnerf.core.sampling import samples_from_edges, stepped_edges
from jaxnerf.core.types import Keys, Rays, Samples


def march_rays(
    key: Keys | None, grid: OccupancyGrid, rays: Rays, *, step_size: float, cell: Sequence[float]
) -> Samples:
    """Returns samples at equal steps along the part of each ray that is inside the grid's box.

    Args:
        key: see stepped_edges.
        grid: OccupancyGrid. If it is contracted, the steps are those of samples_in_contracted_space.
        rays: Rays [...].
        step_size: world units, a number.
        cell: [3] world units, numbers, the size of a cell of this grid; it bounds the number of samples that a
            ray may need.

    Returns:
        Samples [..., S].
    """
    t_step, count = steps_in_t(rays, step_size), num_steps(grid, step_size, cell)
    if grid.contracted:
        return samples_in_contracted_space(key, grid, rays, t_step, count)
    inside = clip_rays_to_box(grid, rays)
    edges = stepped_edges(key, inside.near, inside.far, step_size=t_step, num_segments=count)
    return samples_from_edges(None, edges)


def num_steps(grid: OccupancyGrid, step_size: float, cell: Sequence[float]) -> int:
    """Returns the number of samples of each ray of march_rays."""
    sides = [size * count for size, count in zip(cell, grid.valid.shape, strict=True)]
    if grid.contracted:
        return _whole_words(max(sides) / step_size + 1)
    return _whole_words(math.hypot(*sides) / step_size + 1)


def steps_in_t(rays: Rays, step_size: float) -> Float[Array, "*batch"]:
    """Returns a step of world units in t, [...] for Rays [...]."""
    x, y, z = (at_least_float32(rays.directions[..., axis])[0] for axis in range(3))
    return step_size / jnp.sqrt(x * x + y * y + z * z)


def samples_in_contracted_space(
    key: Keys | None,
    grid: OccupancyGrid,
    rays: Rays,
    t_step: Float[Array, "*batch"],
    count: int,
) -> Samples:
    """Returns samples from near to far, at steps that grow with the contracted cells; far may be arbitrarily large.

    Let r be the distance from the box's center, r0 the smallest r of the ray, and R the side of the box's inner
    half. Steps are equal in s, where t = s / (1 - (s / m)^2), m = max(r0, R), and both t and s are measured from the
    point at r0. Steps have their plain length near the center, are longer by 2 (r / R)^2 far from it, as contracted
    cells are, and are self-similar where r0 exceeds R.

    Args:
        key: see stepped_edges.
        grid: OccupancyGrid, contracted.
        rays: Rays [...].
        t_step: [...] in t, the step where space is not contracted.
        count: S, of samples.

    Returns:
        Samples [..., S].
    """
    middle, half = (grid.lower + grid.upper) / 2, (grid.upper - grid.lower).max() / 2
    middle = middle.reshape(*(1,) * rays.near.ndim, 3)
    origins, directions = at_least_float32(rays.origins, rays.directions)
    squares = (directions**2).sum(axis=-1)
    nearest = ((middle - origins) * directions).sum(axis=-1) / squares
    away = origins + nearest[..., None] * directions - middle
    smallest = half / jnp.sqrt(squares)
    scale = jnp.maximum(jnp.sqrt((away**2).sum(axis=-1) / squares), smallest)
    t_step = t_step * scale / smallest
    last = scale - t_step / 2  # a whole step more would end at infinity
    near, far = (jnp.minimum(_compress(t - nearest, scale), last) for t in (rays.near, rays.far))
    edges = stepped_edges(key, near, far, step_size=t_step, num_segments=count)
    edges = nearest[..., None] + edges / (1 - (edges / scale[..., None]) ** 2)
    return samples_from_edges(None, jnp.clip(edges, rays.near[..., None], rays.far[..., None]))


def _compress(t, scale):
    """Returns s with t = s / (1 - (s / scale)^2)."""
    ratio = jnp.clip(t / scale, -1e15, 1e15)  # beyond, s equals the scale, and the square might overflow
    return 2 * ratio * scale / (1 + jnp.sqrt(1 + 4 * ratio**2))


def _whole_words(count):
    """Rounds up to a multiple of 32, as render_packed stores one bit per sample in words and would have to pad."""
    count = math.ceil(count)
    return count + -count % 32
