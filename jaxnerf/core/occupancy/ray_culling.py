"""Ray culling: finds the rays that cannot hit an occupied cell, by means of a coarse grid, and skips them."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

from jaxnerf.core.loops import vary_like
from jaxnerf.core.occupancy.grid import OccupancyGrid, clip_rays_to_box, flat_index
from jaxnerf.core.types import Background, Rays, Rendering, has_nan, without_samples

_COARSE = 2  # cells along a side of a coarse cell


def rays_may_hit(grid: OccupancyGrid, rays: Rays, *, cell: Sequence[float]) -> Bool[Array, "*batch"]:
    """Returns whether a sample of each ray can lie in an occupied cell.

    The test reads coarse cells at a few positions along the ray, so it is True for many rays that only pass near an
    occupied cell. It is True for all rays if space is contracted, and for a ray with NaN, so that the NaN is visible.

    Args:
        grid, rays, cell: see march_rays.
    """
    if grid.contracted:
        return jnp.ones(rays.near.shape, bool)
    coarse = _coarse_cells(grid.occupied)
    inside = clip_rays_to_box(grid, rays)
    length = inside.far - inside.near
    sides = [size * count for size, count in zip(cell, grid.occupied.shape, strict=True)]
    # Up to rounding, no point of a ray is further than a coarse cell from one of these positions.
    count = math.ceil(math.hypot(*sides) / (1.99 * _COARSE * min(cell)))

    def read(index):
        t, places = inside.near + length * ((index + 0.5) / count), []
        for axis, (size, wide) in enumerate(zip(cell, coarse.shape, strict=True)):
            place = (rays.origins[..., axis] + t * rays.directions[..., axis] - grid.lower[axis]) / size
            places.append(jnp.clip((place / _COARSE).astype(jnp.int32), 0, wide - 1))
        flat = flat_index(places, coarse.shape)
        return coarse.reshape(-1)[flat]

    def one_by_one():
        nowhere = vary_like(jnp.zeros(rays.near.shape, bool), grid, rays)
        return jax.lax.fori_loop(0, count, lambda index, hit: hit | read(index), nowhere)

    def together():  # each iteration of a loop is several launches
        return jax.vmap(read)(jnp.arange(count)).any(axis=0)

    hit = jax.lax.platform_dependent(cpu=one_by_one, default=together)
    return (hit & (length > 0)) | has_nan(rays)


def render_background(rays: Rays, *, background: Background | None = None, median_depth: bool = False) -> Rendering:
    """Renders rays through empty space.

    Args:
        rays: Rays [...].
        background, median_depth: see render_samples.

    Returns:
        Rendering [...] without weights: the background's colour, depths far, opacity and disparity 0.
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
        median_depth=rays.far if median_depth else None,
    )


def render_selected(
    render: Callable[[Rays], Rendering],
    rays: Rays,
    selected: Bool[ArrayLike, "*batch"],
    otherwise: Rendering | None,
    *,
    chunk: int,
    map: Callable[..., Iterable] = map,
) -> Rendering:
    """Renders only some rays of an image, those that may hit an occupied cell.

    Args:
        render, rays, chunk, map: see render_image; but the last chunk is padded with rays of length 0, which
            cost least.
        selected: [H, W] bool, which rays are rendered.
        otherwise: Rendering [H, W] without weights, of the other rays; see render_background.

    Returns:
        Rendering [H, W] without weights.

    Raises:
        ValueError: if chunk < 1, or if selected has another shape than the rays.
    """
    if chunk < 1:
        raise ValueError(f"render_selected: chunk is {chunk}, expected at least 1")
    if selected.shape != rays.near.shape:
        raise ValueError(f"render_selected: selected has shape {selected.shape}, expected {rays.near.shape}, the rays'")
    order, whole = _order(selected), jax.tree.map(jnp.copy, otherwise)  # a copy, as it is written into

    def render_from(start):
        places, part = _selected_of(rays, order, start, chunk=chunk)
        return places, without_samples(render(part))

    for places, part in map(render_from, range(0, int(selected.sum()), chunk)):
        whole = _with_part(whole, places, part)
    return whole


def _coarse_cells(occupied):
    """Returns which coarse cells hold an occupied cell, or have one among their 26 neighbours."""
    # A bitwise or of shifted slices: reduce_window takes several times as long on a CPU.
    coarse, reach = occupied, 3 * _COARSE
    for axis in range(3):
        around = [(_COARSE, _COARSE + -occupied.shape[i] % _COARSE) if i == axis else (0, 0) for i in range(3)]
        wide = jnp.pad(coarse, around)
        ends = wide.shape[axis] - reach + 1
        cells = (jax.lax.slice_in_dim(wide, i, ends + i, stride=_COARSE, axis=axis) for i in range(reach))
        coarse = functools.reduce(jnp.bitwise_or, cells)
    return coarse


# All are jitted: run op by op, they would take longer than rendering a small image.
@jax.jit
def _order(selected):
    """Returns [N], the indices of the selected rays; N in the remaining places."""
    return jnp.flatnonzero(selected, size=selected.size, fill_value=selected.size)


@functools.partial(jax.jit, static_argnames="chunk")
def _selected_of(rays, order, start, *, chunk):
    """Returns indices [chunk], those in order from start on, and their Rays: of length 0 where there is none."""
    axes = rays.near.ndim
    places = order.at[start + jnp.arange(chunk)].get(mode="fill", fill_value=order.size)
    part = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[axes:]).at[places].get(mode="clip"), rays)
    return places, dataclasses.replace(part, far=jnp.where(places < order.size, part.far, part.near))


@functools.partial(jax.jit, donate_argnums=0)
def _with_part(whole, places, part):
    """Returns the Rendering [...] with the Rendering [N] at indices [N] in it."""

    def put(leaf, new):
        flat = leaf.reshape(-1, *new.shape[1:])
        return flat.at[places].set(new, mode="drop").reshape(leaf.shape)

    return jax.tree.map(put, whole, part)
