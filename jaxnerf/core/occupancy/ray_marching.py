"""Samples along rays through the box of a grid: equal steps, or steps that grow with the distance."""

import math

import jax.numpy as jnp

from jaxnerf.core.occupancy.grid import clip_rays_to_box
from jaxnerf.core.sampling import samples_from_edges, stepped_edges


def march_rays(key, grid, rays, *, step_size, cell, stretch=1.0):
    """Returns Samples [..., S] of equal steps along what a grid's box cuts from rays [...].

    Args:
        key: see stepped_edges.
        grid: Grid. Where all of space is contracted into its box, see samples_everywhere.
        rays: Rays [...].
        step_size: world units, a number.
        cell: [3] world units, numbers, the size of one of this grid's cells: they say how many
            samples a ray may need.
        stretch: how many steps one sample takes, at least 1, traced or not.
    """
    x, y, z = (rays.directions[..., axis] for axis in range(3))
    speed = jnp.sqrt(x * x + y * y + z * z)
    sides = [size * count for size, count in zip(cell, grid.valid.shape, strict=True)]
    if grid.contracted:
        return samples_in_contracted_space(key, grid, rays, stretch * step_size / speed, max(sides) / 4 / step_size)
    inside = clip_rays_to_box(grid, rays)
    count = _whole_words(math.hypot(*sides) / step_size + 1)
    edges = stepped_edges(key, inside.near, inside.far, step_size=stretch * step_size / speed, num_segments=count)
    return samples_from_edges(None, edges)


def samples_in_contracted_space(key, grid, rays, t_step, steps_of_room):
    """Returns Samples [..., S] from near to far, however far, whose steps grow as contracted cells do.

    With r the distance to the box's center, r0 the ray's smallest, and R the side of its plain part over
    the square root of 2, steps are equal in s where t = m tan(s / m), m = max(r0, R), counted from the place
    of r0: plain near the center, times (r / R)^2 far from it, and alike at any scale where r0 exceeds R.

    Args:
        key: see stepped_edges.
        grid: Grid, contracted.
        rays: Rays [...].
        t_step: [...] in t, where space is plain.
        steps_of_room: a number, half of the plain part's side over the step.
    """
    middle, half = (grid.lower + grid.upper) / 2, (grid.upper - grid.lower).max() / 4 * math.sqrt(2)
    middle = middle.reshape(*(1,) * rays.near.ndim, 3)
    squares = (rays.directions**2).sum(axis=-1)
    nearest = ((middle - rays.origins) * rays.directions).sum(axis=-1) / squares
    away = rays.origins + nearest[..., None] * rays.directions - middle
    smallest = half / jnp.sqrt(squares)
    scale = jnp.maximum(jnp.sqrt((away**2).sum(axis=-1) / squares), smallest)
    t_step = t_step * scale / smallest
    last = scale * (math.pi / 2) - t_step / 2  # a whole step more would never end
    near, far = (jnp.minimum(scale * jnp.arctan((t - nearest) / scale), last) for t in (rays.near, rays.far))
    count = _whole_words(math.pi * math.sqrt(2) * steps_of_room + 1)
    edges = stepped_edges(key, near, far, step_size=t_step, num_segments=count)
    nearest, scale = nearest[..., None], scale[..., None]
    edges = nearest + scale * jnp.tan(edges / scale)
    return samples_from_edges(None, jnp.clip(edges, rays.near[..., None], rays.far[..., None]))


def _whole_words(count):
    """Returns a number of samples for which the packer's flags fill whole words: padding takes longer."""
    count = math.ceil(count)
    return count + -count % 32
