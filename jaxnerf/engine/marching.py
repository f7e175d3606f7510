"""Samples along rays through the box of a grid: equal steps, or steps that grow with the distance."""

import math

import jax
import jax.numpy as jnp

from jaxnerf.core import occupancy
from jaxnerf.core.sampling import samples_from_edges, stepped_edges

_BLOCK = 2  # cells a side: of the blocks that tell what a ray may meet


def samples_in_box(key, grid, rays, *, step, cell, stretch=1.0):
    """Returns Samples [..., S] of equal steps along what a grid's box cuts from rays [...].

    Args:
        key: see stepped_edges.
        grid: Grid. Where all of space is contracted into its box, see samples_everywhere.
        rays: Rays [...].
        step: world units, a number.
        cell: [3] world units, numbers, the size of one of this grid's cells: they say how many
            samples a ray may need.
        stretch: how many steps one sample takes, at least 1, traced or not.
    """
    x, y, z = (rays.directions[..., axis] for axis in range(3))
    speed = jnp.sqrt(x * x + y * y + z * z)
    sides = [size * count for size, count in zip(cell, grid.possible.shape, strict=True)]
    if grid.contracted:
        return samples_everywhere(key, grid, rays, stretch * step / speed, max(sides) / 4 / step)
    inside = occupancy.cut_to_box(grid, rays)
    count = _whole_words(math.hypot(*sides) / step + 1)
    edges = stepped_edges(key, inside.near, inside.far, step=stretch * step / speed, num_segments=count)
    return samples_from_edges(None, edges)


def may_meet(grid, rays, *, cell):
    """Returns [...], False where no sample of a ray can lie in an occupied cell.

    Blocks of cells are asked at a few places along the ray, so of the rays that pass nearby many are True,
    and all where space is contracted. A ray that is NaN may meet anything, and shows.

    Args:
        grid, rays, cell: see samples_in_box.
    """
    if grid.contracted:
        return jnp.ones(rays.near.shape, bool)
    blocks = _blocks_around(grid.occupied)
    inside = occupancy.cut_to_box(grid, rays)
    length = inside.far - inside.near
    sides = [size * count for size, count in zip(cell, grid.occupied.shape, strict=True)]
    # No point of a ray is further than a block from a place, but for rounding.
    count = math.ceil(math.hypot(*sides) / (1.99 * _BLOCK * min(cell)))

    def ask(index, met):
        t, flat = inside.near + length * ((index + 0.5) / count), 0
        for axis, (size, wide) in enumerate(zip(cell, blocks.shape, strict=True)):
            place = (rays.origins[..., axis] + t * rays.directions[..., axis] - grid.lower[axis]) / size
            flat = flat * wide + jnp.clip((place / _BLOCK).astype(jnp.int32), 0, wide - 1)
        return met | blocks.reshape(-1)[flat]

    met = jax.lax.fori_loop(0, count, ask, jnp.zeros(rays.near.shape, bool))
    numbers = (rays.origins.sum(axis=-1), rays.directions.sum(axis=-1), rays.near, rays.far)
    return (met & (length > 0)) | jnp.isnan(sum(numbers))


def samples_everywhere(key, grid, rays, t_step, steps_of_room):
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
    edges = stepped_edges(key, near, far, step=t_step, num_segments=count)
    nearest, scale = nearest[..., None], scale[..., None]
    edges = nearest + scale * jnp.tan(edges / scale)
    return samples_from_edges(None, jnp.clip(edges, rays.near[..., None], rays.far[..., None]))


def _blocks_around(occupied):
    """Returns which blocks hold an occupied cell, or have one among their 26 neighbours."""
    blocks = occupied
    for axis in range(3):
        sizes = [(3 * _BLOCK, _BLOCK) if i == axis else (1, 1) for i in range(3)]
        around = [(_BLOCK, _BLOCK + -occupied.shape[i] % _BLOCK) if i == axis else (0, 0) for i in range(3)]
        window, strides = zip(*sizes, strict=True)
        blocks = jax.lax.reduce_window(blocks, False, jax.lax.bitwise_or, window, strides, around)
    return blocks


def _whole_words(count):
    """Returns a number of samples for which the packer's flags fill whole words: padding takes longer."""
    count = math.ceil(count)
    return count + -count % 32
