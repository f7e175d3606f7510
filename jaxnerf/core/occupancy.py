"""Only where there is something: a grid of what may be occupied, and the renderer that asks nowhere else.

The grid is part of the model. A field that was trained under one means nothing where the grid is empty, so
whoever renders that field renders it with its grid.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnerf.core import compositing, rendering
from jaxnerf.core.structs import Rendering, check_shapes, pytree


@pytree()
class Grid:
    """What is known of the R x R x R cells of a box, indexed x first."""

    lower: jax.Array  # [3] world units, the box
    upper: jax.Array  # [3]
    possible: jax.Array  # [R, R, R] bool; False is empty for good, as alpha masks have shown
    peak: jax.Array  # [R, R, R] 1 / world unit, the largest density found of late
    mean: jax.Array  # [R, R, R] 1 / world unit, the running mean of the densities found
    occupied: jax.Array  # [R, R, R] bool, where a scene is asked


def create_grid(lower, upper, possible, *, assumed):
    """Returns the Grid of a box of which only is known what is possible (as the grids of arXiv:2201.05989).

    Args:
        lower, upper: [3] world units.
        possible: [R, R, R] bool, x first.
        assumed: 1 / world unit, the density taken for found everywhere. An empty cell is left out after as
            many looks as bring that down to the threshold: log(assumed / threshold) / log(1 / decay).

    Returns:
        Grid with fields [R, R, R], occupied wherever that is possible.

    Raises:
        ValueError: on other shapes.
    """
    lower, upper, possible = (jnp.asarray(value) for value in (lower, upper, possible))
    check_shapes("create_grid", lower=(lower, "3"), upper=(upper, "3"), possible=(possible, "R R R"))
    mean = jnp.zeros(possible.shape, jnp.float32)
    peak = jnp.full_like(mean, assumed)
    return Grid(lower=lower, upper=upper, possible=possible, peak=peak, mean=mean, occupied=possible)


def update_grid(key, grid, scene, cells, *, threshold, decay=0.6, smoothing=0.2, chunk=8192):
    """Returns the Grid after a look at a random point in each of some cells (as in arXiv:2201.05989).

    A cell is occupied where the largest density of late, or that of a neighbour, exceeds the threshold:
    a field that is still forming must not lose what it is about to grow.

    Args:
        key: where in each cell.
        grid: Grid.
        scene: see render_samples.
        cells: [M] int32, flat indices x first, each at most once.
        threshold: 1 / world unit; 0.01 over the spacing of samples leaves out what absorbs 1 % of the light.
        decay: what of the peak outlasts a look that finds less.
        smoothing: the weight of a look in the running mean.
        chunk: cells asked at once.

    Returns:
        Grid. What is not possible stays empty. No gradient is meant to flow through it.

    Raises:
        ValueError: on other shapes.
    """
    check_shapes("update_grid", cells=(cells, "M"))
    resolution = grid.occupied.shape[0]
    corner = jnp.stack(jnp.unravel_index(cells, grid.occupied.shape), axis=-1)
    place = (corner + jax.random.uniform(key, corner.shape)) / resolution
    x = grid.lower[None] + place * (grid.upper - grid.lower)[None]
    # Density has no direction; any will do.
    ask = lambda x: scene(x[None, None], jnp.array([[[0.0, 0.0, 1.0]]]))[0][0, 0]  # noqa: E731
    found = jax.lax.map(ask, x, batch_size=min(chunk, cells.size))
    peak, mean = grid.peak.reshape(-1), grid.mean.reshape(-1)
    peak = peak.at[cells].set(jnp.maximum(decay * peak[cells], found))
    mean = mean.at[cells].add(smoothing * (found - mean[cells]))
    peak, mean = peak.reshape(grid.peak.shape), mean.reshape(grid.mean.shape)
    return dataclasses.replace(grid, peak=peak, mean=mean, occupied=_widen(peak > threshold) & grid.possible)


def cut_to_box(grid, rays):
    """Returns the Rays between their ends and inside the grid's box; near = far where they miss it."""
    origins, directions = rays.origins, rays.directions
    level = directions == 0
    lower, upper = (bound.reshape(*(1,) * rays.near.ndim, 3) for bound in (grid.lower, grid.upper))
    inside = (origins >= lower) & (origins < upper)
    ends = [(bound - origins) / jnp.where(level, 1, directions) for bound in (lower, upper)]
    enter = jnp.where(level, jnp.where(inside, -jnp.inf, jnp.inf), jnp.minimum(*ends)).max(axis=-1)
    leave = jnp.where(level, jnp.inf, jnp.maximum(*ends)).min(axis=-1)
    near = jnp.clip(enter, rays.near, rays.far)
    return dataclasses.replace(rays, near=near, far=jnp.clip(leave, near, rays.far))


def occupied_at(grid, rays, t):
    """Returns [..., S], whether the cell around x(t) may be occupied; a t that is NaN counts, and shows."""
    index, inside = _cell(grid, rays, t)
    return (inside & grid.occupied.reshape(-1)[index]) | jnp.isnan(t)


def render_packed(scene, grid, rays, samples, *, capacity, stop=0.0, background=None):
    """Returns what render_samples does, asking the scene only where the grid is occupied.

    The samples of all rays that count are packed into a pool of fixed size, and composited there (Eq. 3,
    with the skipping and the early stop of arXiv:2201.05989).

    Args:
        scene: see render_samples; it is asked for [1, K, 3] positions with as many directions.
        grid: Grid. Outside its box there is nothing.
        rays: Rays [...].
        samples: Samples [..., S]; rules "segments" and "points".
        capacity: K, the size of the pool, at least the number of rays where stop is given.
        stop: 0 asks all samples at once; those that do not fit are left out and counted. Greater than 0,
            the pool is filled again and again with the next samples of the rays that still let more than
            this through: none is left out, and where colours are in [0, 1] the colour is within stop of the
            whole one. That is for rendering: it has no reverse mode.
        background: see render_samples.

    Returns:
        Rendering [...] without weights; dropped [...] says how many samples of a ray did not fit.

    Raises:
        ValueError: as render_samples; on rule "gauss"; if stop > 0 and capacity is less than the rays.
    """
    if samples.rule == "gauss":
        raise ValueError(
            "render_packed: rule 'gauss' asks in pairs, which a cell's border may part; use 'segments'"
        )
    check_shapes(
        "render_packed", near=(rays.near, "..."), t=(samples.t, "... S"), delta=(samples.delta, "... S")
    )
    shape = rays.near.shape
    flat = jax.tree.map(lambda x: jnp.asarray(x).reshape(-1, *x.shape[len(shape) :]), (rays, samples))
    if stop > 0 and flat[0].near.size > capacity:
        raise ValueError(
            f"render_packed: capacity is {capacity} for {flat[0].near.size} rays, wanted one sample of each "
            "at least; render fewer rays at once"
        )
    rays, samples = flat
    queue = _queue(grid, rays, samples)
    ask = functools.partial(_ask, scene, rays, samples)
    if stop > 0:
        sums, dropped = _until_stopped(queue, ask, capacity, stop), jnp.zeros_like(queue.count)
    else:
        taken = jnp.clip(capacity - queue.first, 0, queue.count)
        sums, dropped = ask(_fill(queue, queue.first, taken, capacity)), queue.count - taken
    return _rendering(sums, dropped, rays.far, shape, background)


class _Queue(NamedTuple):
    """The samples that count, ray after ray."""

    order: jax.Array  # [B S] int32, their places among all samples; what is left over is 0
    first: jax.Array  # [B] int32, where each ray's begin in order
    count: jax.Array  # [B] int32


class _Pool(NamedTuple):
    """What is asked at once."""

    source: jax.Array  # [K] int32, places among all samples
    ray: jax.Array  # [K] int32, ascending
    used: jax.Array  # [K] bool, False for the room that is left


class _Sums(NamedTuple):
    """What the samples asked so far add up to, for each ray."""

    optical_depth: jax.Array  # [B]
    rgb: jax.Array  # [B, 3]
    depth: jax.Array  # [B] sum of w t
    disparity: jax.Array  # [B] sum of w / t


def _queue(grid, rays, samples):
    kept = ~(samples.delta <= 0) & occupied_at(grid, rays, samples.t)
    rank = jnp.cumsum(kept, axis=-1, dtype=jnp.int32)
    count = rank[:, -1]
    first = jnp.cumsum(count) - count
    size = kept.size
    place = jnp.where(kept, first[:, None] + rank - 1, size)
    order = jnp.zeros(size, jnp.int32).at[place.reshape(-1)].set(jnp.arange(size), mode="drop")
    return _Queue(order, first, count)


def _fill(queue, first, taken, capacity):
    """Returns the Pool of the samples first to first + taken of each ray in the queue."""
    ends = jnp.cumsum(taken)
    ray = jnp.repeat(jnp.arange(taken.size), taken, total_repeat_length=capacity)
    slot = jnp.arange(capacity)
    place = first[ray] + slot - (ends - taken)[ray]
    return _Pool(queue.order[jnp.clip(place, 0, queue.order.size - 1)], ray, slot < ends[-1])


def _ask(scene, rays, samples, pool):
    """Returns the Sums of a pool, as if nothing lay before it."""
    t = jnp.where(pool.used, samples.t.reshape(-1)[pool.source], 0)
    delta = jnp.where(pool.used, samples.delta.reshape(-1)[pool.source], 0)
    one = jax.tree.map(lambda leaf: leaf[pool.ray][None], rays)  # Rays [1, K], one a sample
    x = one.origins + t[None, :, None] * one.directions
    density, rgb = scene(x, one.viewdirs)
    rendering.check_answer("render_packed", density, rgb, x)
    density = jnp.where(pool.used, density[0], 0)
    length = rendering.world_length(delta[:, None], one.directions[0])[:, 0]
    starts = pool.ray != jnp.roll(pool.ray, 1).at[0].set(-1)
    weights, optical_depth = compositing.packed_weights(density, length, starts, longest=samples.t.shape[-1])
    colours = [jnp.where(pool.used, rgb[0, :, axis], 0) * weights for axis in range(3)]
    parts = [optical_depth, *colours, weights * t, compositing.share_over(weights, t)]
    sums = jax.ops.segment_sum(jnp.stack(parts, axis=-1), pool.ray, rays.near.size, indices_are_sorted=True)
    return _Sums(sums[:, 0], sums[:, 1:4], sums[:, 4], sums[:, 5])


def _until_stopped(queue, ask, capacity, stop):
    """Returns the Sums of all rays, each asked until no more than stop passes, or to its end."""

    def waits(done, sums):
        return (done < queue.count) & (jnp.exp(-sums.optical_depth) > stop)

    def step(state):
        done, sums = state
        waiting = waits(done, sums)
        quota = capacity // jnp.maximum(waiting.sum(), 1)
        taken = jnp.where(waiting, jnp.minimum(queue.count - done, quota), 0)
        more = ask(_fill(queue, queue.first + done, taken, capacity))
        light = jnp.exp(-sums.optical_depth)
        return done + taken, _Sums(
            optical_depth=sums.optical_depth + more.optical_depth,
            rgb=sums.rgb + light[:, None] * more.rgb,
            depth=sums.depth + light * more.depth,
            disparity=sums.disparity + light * more.disparity,
        )

    done = jnp.zeros_like(queue.count)
    zeros = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype),
        jax.eval_shape(lambda: ask(_fill(queue, queue.first, done, capacity))),
    )
    return jax.lax.while_loop(lambda state: waits(*state).any(), step, (done, zeros))[1]


def _rendering(sums, dropped, far, shape, background):
    passing = jnp.exp(-sums.optical_depth)
    rgb = sums.rgb
    if background is not None:
        behind = jnp.broadcast_to(jnp.asarray(background, rgb.dtype), (*shape, 3)).reshape(-1, 3)
        rgb = rgb + passing[:, None] * behind
    flat = Rendering(
        rgb=rgb,
        opacity=-jnp.expm1(-sums.optical_depth),
        depth=sums.depth + compositing.share_of(passing, far),
        disparity=sums.disparity,
        weights=None,
        dropped=dropped,
    )
    return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), flat)


def _widen(occupied):
    """Returns the cells that are occupied or touch one that is."""
    for axis in range(3):
        window = tuple(3 if i == axis else 1 for i in range(3))
        occupied = jax.lax.reduce_window(occupied, False, jax.lax.bitwise_or, window, (1, 1, 1), "SAME")
    return occupied


def _cell(grid, rays, t):
    """Returns the flat index [..., S] of the cell at x(t), and whether x(t) is inside the box."""
    resolution = grid.occupied.shape[0]
    index, inside = 0, True
    for axis in range(3):
        scale = resolution / (grid.upper[axis] - grid.lower[axis])
        start = (rays.origins[..., axis] - grid.lower[axis]) * scale
        place = start[..., None] + t * (rays.directions[..., axis] * scale)[..., None]
        inside &= (place >= 0) & (place < resolution)
        index = index * resolution + jnp.clip(place.astype(jnp.int32), 0, resolution - 1)
    return index, inside
