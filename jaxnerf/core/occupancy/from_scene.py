"""The occupancy grid of a scene that was trained without one: the cells that are dense and visible."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxnerf.core import rendering, volume_rendering
from jaxnerf.core.loops import vary_like
from jaxnerf.core.occupancy.grid import OccupancyGrid, cells_around, grid_from_scene, mark_cells
from jaxnerf.core.occupancy.packed import count_occupied, evaluate_samples, fill_buffer, flattened, occupied_words
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.core.types import Background, Rays, Samples, SceneFn, Vector

_CHUNK = 2**11  # rays
_MAX_ERROR = 1 / 512  # of a colour: half a step of 8 bits
_OPAQUE = 1e-3  # transmittance below which a ray counts as opaque


def num_visibility_rays(shape: tuple[int, int, int]) -> int:
    """Returns how many rays visible_grid needs for a grid of a shape, so that several hit each cell on a surface."""
    return -(-16 * max(shape) ** 2 // _CHUNK) * _CHUNK


def visible_grid(
    scene: SceneFn,
    rays: Rays,
    *,
    lower: Vector,
    upper: Vector,
    shape: tuple[int, int, int],
    step_size: float,
    threshold: ArrayLike,
    contracted: bool = False,
    max_samples: int,
    background: Background | None = None,
) -> OccupancyGrid:
    """Creates the grid of the cells of a box in which a scene is dense and visible.

    A cell is occupied if the rays need it for colours within half a step of 8 bits, or if it lies between two
    such cells. A network that was trained along whole rays has white fog in front of white surfaces, fog thinner
    than the threshold in front of everything dense, and matter inside objects; none of these is kept. In a scene that
    asks for time, a cell is visible if it is at one of the times of the rays.

    Args:
        scene: see render_samples.
        rays: Rays [N] of the training views; N is a multiple of 2048.
        lower, upper: [3] world units, the box.
        shape: cells along x, y and z.
        step_size: world units between samples.
        threshold, contracted: see grid_from_scene.
        max_samples: samples evaluated at once.
        background: see render_samples.
    """
    bounds = (jnp.asarray(bound, jnp.float32) for bound in (lower, upper))
    grid = grid_from_scene(jax.random.key(0), scene, *bounds, shape, threshold=threshold, contracted=contracted)
    dense = drop_thin_density(scene, grid, threshold)
    cell = tuple((high - low) / count for low, high, count in zip(lower, upper, shape, strict=True))

    def mark(marked, rays):
        samples = march_rays(None, grid, rays, step_size=step_size, cell=cell)
        options = {"error": _MAX_ERROR, "max_samples": max_samples, "background": background}
        needed = visible_samples(dense, grid, rays, samples, **options)
        return mark_cells(marked, grid, rays, samples.t, needed), None

    parts = jax.tree.map(lambda leaf: leaf.reshape(-1, _CHUNK, *leaf.shape[1:]), rays)
    marked = vary_like(jnp.zeros(shape, bool), grid, rays)
    marked = jax.lax.scan(mark, marked, parts)[0]
    return keep_cells(grid, marked)


def visible_samples(
    scene: SceneFn,
    grid: OccupancyGrid | None,
    rays: Rays,
    samples: Samples,
    *,
    error: float,
    max_samples: int,
    background: Background | None = None,
) -> Bool[Array, "*batch samples"]:
    """Finds the samples that a ray needs: dropping all others changes its colour by at most an error.

    Samples are visited from back to front. A sample is dropped if the error of the ray's colour (Eq. 3 of
    arXiv:2003.08934), including that of the samples dropped behind it, stays within the bound. White fog in front
    of a white background is not needed, nor is the inside of a wall.

    Args:
        scene, rays, samples, background: see render_packed.
        grid: OccupancyGrid, in whose occupied cells the scene is evaluated.
        error: bound in each of the three channels, which are assumed to be in [0, 1].
        max_samples: samples evaluated at once; all are evaluated, in as many rounds as that takes.

    Returns:
        [..., S] bool; False where the scene is not evaluated. A ray whose transmittance is below 1e-3 keeps
        the samples that make it opaque, whatever their colours, as opacity and depth depend on them. A sample that
        is NaN is needed, so that it is visible.
    """
    name, shape = "visible_samples", samples.t.shape
    rays, samples = flattened(name, rays, samples, max_samples)
    if not math.prod(shape):
        return jnp.zeros(shape, bool)
    occupied = count_occupied(occupied_words(grid, rays, samples))

    def evaluate_round(index, outputs):
        slot = index * max_samples + jnp.arange(max_samples, dtype=jnp.int32)
        buffer = fill_buffer(occupied, slot, slot < occupied.ends[-1])
        t = samples.t[buffer.ray, buffer.source]
        delta = lambda: samples.delta[buffer.ray, buffer.source]  # noqa: E731
        density, rgb = evaluate_samples(name, scene, rays, t, buffer.ray, buffer.used, delta)
        place = jnp.where(buffer.used, buffer.ray * shape[-1] + buffer.source, outputs.shape[0])
        return outputs.at[place].set(jnp.concatenate([density[:, None], rgb], axis=-1), mode="drop")

    rounds = -(-occupied.ends[-1] // max_samples)
    outputs = jnp.zeros((samples.t.size, 4))
    outputs = vary_like(outputs, jax.eval_shape(evaluate_round, jnp.zeros_like(rounds), outputs))
    outputs = jax.lax.fori_loop(0, rounds, evaluate_round, outputs)
    density, *rgb = jnp.moveaxis(outputs.reshape(*samples.t.shape, 4), -1, 0)
    length = rendering.segment_lengths(jnp.maximum(samples.delta, 0), rays)
    depth = volume_rendering.optical_depth(name, density, length)
    before = jnp.exp(-volume_rendering.exclusive_sum(depth))
    through = jnp.exp(-depth)

    def drop(state, sample):
        # [B, 3]: the colour behind the sample, and its error so far; [B]: the transmittance that the dropped
        # samples of an opaque ray open behind it.
        behind, wrong, opened = state
        before, through, rgb = sample
        transmitted = through[:, None]
        change = wrong + (1 - transmitted) * (rgb - behind)
        needed = ~(before * jnp.maximum(jnp.abs(change).max(axis=-1), opened) <= error)
        wrong = jnp.where(needed[:, None], transmitted * wrong, change)
        opened = jnp.where(needed, through * opened, opened)
        return ((1 - transmitted) * rgb + transmitted * behind, wrong, opened), needed

    behind = jnp.zeros(3) if background is None else jnp.asarray(background)
    behind = jnp.broadcast_to(behind, (*rays.near.shape, 3))
    opaque = before[:, -1:] * through[:, -1:] < _OPAQUE
    start = vary_like((behind, jnp.zeros_like(behind), opaque[:, 0].astype(behind.dtype)), behind, outputs, length)
    nearest_first = (before.T, through.T, jnp.stack(rgb, axis=-1).swapaxes(0, 1))
    return jax.lax.scan(drop, start, nearest_first, reverse=True)[1].T.reshape(shape)


def drop_thin_density(
    scene: SceneFn, grid: OccupancyGrid, threshold: Float[ArrayLike, ""] | Float[ArrayLike, "X Y Z"]
) -> SceneFn:
    """Makes a scene that is empty where its density is at most a threshold; NaN stays.

    Args:
        scene: see render_samples.
        grid: OccupancyGrid, to whose cells the threshold belongs.
        threshold: see update_grid.
    """
    threshold = jnp.asarray(threshold, jnp.float32)

    @functools.wraps(scene)
    def thinned(x, viewdirs, **inputs):
        density, rgb = scene(x, viewdirs, **inputs)
        least = threshold.reshape(-1)[cells_around(grid, x)[0]] if threshold.ndim else threshold
        return jnp.where(density <= least, 0, density), rgb

    return thinned


def keep_cells(grid: OccupancyGrid, marked: Bool[ArrayLike, "X Y Z"]) -> OccupancyGrid:
    """Returns the grid in which only cells that are marked, or between two that are, stay occupied."""
    between = marked
    for axis in range(3):
        around = jnp.pad(marked, [(1, 1) if i == axis else (0, 0) for i in range(3)])
        before, after = (jax.lax.slice_in_dim(around, i, i + marked.shape[axis], axis=axis) for i in (0, 2))
        between |= before & after
    occupied = grid.occupied & between
    return dataclasses.replace(grid, density_mean=jnp.where(occupied, grid.density_mean, -1), occupied=occupied)


def crop_grid(grid: OccupancyGrid) -> OccupancyGrid:
    """Returns the grid of the smallest box that holds the occupied cells; the same grid if it is contracted."""
    occupied, lower, upper = jax.device_get((grid.occupied, grid.lower, grid.upper))
    if grid.contracted or not occupied.any():
        return grid
    first, end = zip(*((index.min(), index.max() + 1) for index in occupied.nonzero()), strict=True)
    lower = lower.astype("float64")
    cell = (upper - lower) / occupied.shape
    inside = tuple(slice(*ends) for ends in zip(first, end, strict=True))
    return OccupancyGrid(
        lower=jnp.float32(lower + first * cell),
        upper=jnp.float32(lower + end * cell),
        **{name: getattr(grid, name)[inside] for name in ("valid", "density_max", "density_mean", "occupied")},
    )
