"""Rays that see nothing: found by a coarse look at a grid, and left out when a picture is rendered."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp

from jaxnerf.core.occupancy.grid import clip_rays_to_box, flat_index
from jaxnerf.core.types import Rendering, without_samples

_BLOCK = 2  # cells a side: of the blocks that tell what a ray may meet


def rays_may_hit(grid, rays, *, cell):
    """Returns [...], False where no sample of a ray can lie in an occupied cell.

    Blocks of cells are asked at a few places along the ray, so of the rays that pass nearby many are True,
    and all where space is contracted. A ray that is NaN may meet anything, and shows.

    Args:
        grid, rays, cell: see samples_in_box.
    """
    if grid.contracted:
        return jnp.ones(rays.near.shape, bool)
    blocks = _blocks_around(grid.occupied)
    inside = clip_rays_to_box(grid, rays)
    length = inside.far - inside.near
    sides = [size * count for size, count in zip(cell, grid.occupied.shape, strict=True)]
    # No point of a ray is further than a block from a place, but for rounding.
    count = math.ceil(math.hypot(*sides) / (1.99 * _BLOCK * min(cell)))

    def ask(index, met):
        t, places = inside.near + length * ((index + 0.5) / count), []
        for axis, (size, wide) in enumerate(zip(cell, blocks.shape, strict=True)):
            place = (rays.origins[..., axis] + t * rays.directions[..., axis] - grid.lower[axis]) / size
            places.append(jnp.clip((place / _BLOCK).astype(jnp.int32), 0, wide - 1))
        flat = flat_index(places, blocks.shape)
        return met | blocks.reshape(-1)[flat]

    met = jax.lax.fori_loop(0, count, ask, jnp.zeros(rays.near.shape, bool))
    numbers = (rays.origins.sum(axis=-1), rays.directions.sum(axis=-1), rays.near, rays.far)
    return (met & (length > 0)) | jnp.isnan(sum(numbers))


def render_background(rays, *, background=None):
    """Returns what rays see where there is nothing.

    Args:
        rays: Rays [...].
        background: see render_samples.

    Returns:
        Rendering [...] without weights: the background's colour, depth far, and 0.
    """
    shape = rays.near.shape
    behind = jnp.zeros(3) if background is None else jnp.asarray(background)
    return Rendering(
        rgb=jnp.broadcast_to(behind, (*shape, 3)),
        opacity=jnp.zeros(shape),
        depth=rays.far,
        disparity=jnp.zeros(shape),
        weights=None,
        num_dropped=jnp.zeros(shape, jnp.int32),
    )


def render_selected(render, rays, chosen, otherwise, *, chunk):
    """Returns a whole image of which only some rays are rendered, those that may see something.

    Args:
        render, rays, chunk: see render_image; but the last chunk is filled up with rays of no length, which
            cost least.
        chosen: [H, W] bool, which rays are rendered.
        otherwise: Rendering [H, W] without weights, of the others; see render_nothing.

    Returns:
        Rendering [H, W] without weights.

    Raises:
        ValueError: if chunk < 1, or on another shape of chosen.
    """
    if chunk < 1:
        raise ValueError(f"render_chosen: chunk {chunk}, wanted at least 1")
    if chosen.shape != rays.near.shape:
        raise ValueError(f"render_chosen: chosen {chosen.shape}, wanted {rays.near.shape} as the rays")
    order, whole = _order(chosen), jax.tree.map(jnp.copy, otherwise)  # a copy, as it is written into
    for start in range(0, int(chosen.sum()), chunk):
        places, part = _chosen_of(rays, order, start, chunk=chunk)
        whole = _with_part(whole, places, without_samples(render(part)))
    return whole


def _blocks_around(occupied):
    """Returns which blocks hold an occupied cell, or have one among their 26 neighbours."""
    # Slices, each or-ed with the others: reduce_window takes several times as long on a CPU.
    blocks, reach = occupied, 3 * _BLOCK
    for axis in range(3):
        around = [(_BLOCK, _BLOCK + -occupied.shape[i] % _BLOCK) if i == axis else (0, 0) for i in range(3)]
        wide = jnp.pad(blocks, around)
        ends = wide.shape[axis] - reach + 1
        cells = (jax.lax.slice_in_dim(wide, i, ends + i, stride=_BLOCK, axis=axis) for i in range(reach))
        blocks = functools.reduce(jnp.bitwise_or, cells)
    return blocks


# All jitted: op by op they would take longer than a small picture's rays.
@jax.jit
def _order(chosen):
    """Returns [N], the places of the rays that are chosen [...]; those of no ray after them."""
    return jnp.flatnonzero(chosen, size=chosen.size, fill_value=chosen.size)


@functools.partial(jax.jit, static_argnames="chunk")
def _chosen_of(rays, order, start, *, chunk):
    """Returns places [chunk], those in order from start on, and the Rays there: of no length for no ray."""
    axes = rays.near.ndim
    places = order.at[start + jnp.arange(chunk)].get(mode="fill", fill_value=order.size)
    part = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[axes:]).at[places].get(mode="clip"), rays)
    return places, dataclasses.replace(part, far=jnp.where(places < order.size, part.far, part.near))


@functools.partial(jax.jit, donate_argnums=0)
def _with_part(whole, places, part):
    """Returns the Rendering [...] with the Rendering [N] at places [N] in it."""

    def put(leaf, new):
        flat = leaf.reshape(-1, *new.shape[1:])
        return flat.at[places].set(new, mode="drop").reshape(leaf.shape)

    return jax.tree.map(put, whole, part)
