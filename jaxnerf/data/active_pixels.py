"""The pixels that training draws from: those that are unmasked and whose rays may hit matter."""

import dataclasses
import functools
import math
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Bool, Int

from jaxnerf.core.occupancy.grid import clip_rays_to_box, is_occupied
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.core.views import Views
from jaxnerf.data.geometry.seen_cells import likely_empty_cells, seen_cells
from jaxnerf.data.geometry.visual_hull import visual_hull
from jaxnerf.data.ray_batches import PixelRuns, view_rays
from jaxnerf.models.grid_schedule import GridSchedule, InitialCells
from jaxnerf.runtime import cores, stages
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.runtime.user_cache import load_or_make

_MAX_RAYS = 2**22  # pixels up to which the ray of each is tested
_NUM_TILES = 2**21  # tiles that are tested instead of more pixels; a ray takes some microseconds
_SLOW = 0.5  # seconds of work from which the result is cached
_VERSION = 2  # of cached results; a change of the code that finds other cells or pixels for the same views increases it


def active_region(
    views: Views,
    schedule: GridSchedule,
    *,
    use_alpha: bool,
    min_views: int = 0,
    ndc: bool = False,
    pixel_offset: float = 0.5,
) -> tuple[InitialCells, PixelRuns | None, Int[np.ndarray, " M"]]:
    """Finds what is known of the grid's cells, and the pixels whose rays may hit one of them.

    A result that takes a while to compute is kept in the user's cache.

    Args:
        views: of the split that is trained on.
        schedule: of the box.
        use_alpha: whether cells outside the visual hull of the views' alpha are invalid.
        min_views: number of views that must see a valid cell, see `seen_cells`; 0: the cameras tell nothing.
        ndc, pixel_offset: see `draw_batch`.

    Returns:
        cells: of the grid before training.
        active: the pixels to draw from, see `find_active_pixels`; None: all.
        indices: flat, of the valid cells, int32.
    """
    if min_views and ndc:
        raise ValueError(
            f"occupancy.min_views is {min_views} with normalised device coordinates, which hold what the cameras see, "
            "expected 0; correct --config.occupancy.min_views or --config.data.ndc"
        )
    options = {"use_alpha": use_alpha, "ndc": ndc, "pixel_offset": pixel_offset}
    runs = {field.name for field in dataclasses.fields(PixelRuns)}

    def make():
        valid = valid_cells(views, schedule, use_alpha=use_alpha)
        empty = np.zeros_like(valid)
        if min_views:
            find_seen = functools.partial(seen_cells, views, schedule, min_views=min_views)
            find_empty = functools.partial(likely_empty_cells, views, schedule, pixel_offset=pixel_offset)
            # At once: one computes while Python traces the programs of the other.
            (seen, free), empty = cores.map_on_cores(lambda find: find(), (find_seen, find_empty))
            valid &= seen & ~free
            empty &= valid
        active = find_active_pixels(views, schedule, valid, **options)
        return {"valid": valid, "empty": empty} | ({} if active is None else vars(active))

    def is_valid(arrays):
        return arrays["valid"].shape == schedule.shape and set(arrays) in (
            {"valid", "empty"},
            {"valid", "empty"} | runs,
        )

    name = f"active_{_fingerprint(views, schedule, options | {'min_views': min_views})}"
    found = load_or_make(None, name, make, is_valid=is_valid, min_seconds=_SLOW)
    valid, empty = found.pop("valid"), found.pop("empty")
    cells = InitialCells(valid, empty if empty.any() else None)
    return cells, PixelRuns(**found) if found else None, np.flatnonzero(valid).astype(np.int32)


def valid_cells(views: Views, schedule: GridSchedule, *, use_alpha: bool) -> Bool[np.ndarray, "X Y Z"]:
    """Returns the cells in the visual hull of the views' alpha; all cells without alpha or use_alpha."""
    if not use_alpha or views.pixels.shape[-1] != 4:
        return np.ones(schedule.shape, bool)
    # The hull halves its cells, so it is fastest if their number is a small one times a power of two.
    count, halvings = max(schedule.shape), 0
    while count > 31:
        count, halvings = -(-count // 2), halvings + 1
    count <<= halvings
    lower = np.asarray(schedule.lower)
    upper = lower + count * (np.asarray(schedule.upper) - lower) / schedule.shape
    x, y, z = schedule.shape
    return visual_hull(views, lower, upper, resolution=count)[:x, :y, :z]


def unmasked_pixels(views: Views) -> PixelRuns | None:
    """Returns the pixels inside the views' mask; None if there is no mask.

    Raises:
        ValueError: if a view has no such pixel; names the view.
    """
    if views.mask is None:
        return None
    parts = []
    for view, (first, count) in enumerate(zip(views.offset, np.prod(views.size, axis=1), strict=True)):
        parts.append(runs_of(np.asarray(views.mask[first : first + count]), first))
        if not len(parts[-1][0]):
            name = views.names[view] if views.names else view
            raise ValueError(
                f"view {name}: its mask excludes all pixels, expected at least one; remove the view or correct its mask"
            )
    return join_runs(parts)


def find_active_pixels(
    views: Views,
    schedule: GridSchedule,
    valid: Bool[np.ndarray, "X Y Z"],
    *,
    use_alpha: bool = False,
    ndc: bool = False,
    pixel_offset: float = 0.5,
    chunk: int = 2**12,
) -> PixelRuns | None:
    """Returns the unmasked pixels that have alpha > 0 or whose rays hit a valid cell; None: all pixels.

    If there are too many pixels to test each, square tiles are tested by the ray through their center, and the
    neighbours of active tiles are active, too. The result then contains some pixels whose rays hit no valid cell.

    Args:
        views: of the split that is trained on.
        schedule: of the box.
        valid: which cells may contain matter.
        use_alpha: whether pixels with alpha > 0 are active without a test of their rays.
        ndc, pixel_offset: see `draw_batch`.
        chunk: number of rays that are tested at once.

    Raises:
        ValueError: if there are none.
    """
    if schedule.contracted:
        return unmasked_pixels(views)  # every ray hits a valid cell
    total = views.pixels.shape[0]
    side = 1 if total <= _MAX_RAYS else math.ceil(math.sqrt(total / _NUM_TILES))
    opaque, tested = [], []
    for index in range(len(views.offset)):
        unmasked = _unmasked(views, index)
        opaque.append(_any_of(_has_alpha(views, index) & unmasked if use_alpha else np.zeros_like(unmasked), side))
        tested.append(np.argwhere(_any_of(unmasked, side) & ~opaque[-1]))
    counts = [len(tiles) for tiles in tested]
    centers = (np.concatenate(tested)[:, ::-1] * side + (side - 1) / 2 + pixel_offset).astype(np.float32)
    view = np.repeat(np.arange(len(counts)), counts)
    hits = _hits(views, schedule, valid, view, centers, ndc=ndc, chunk=chunk)
    parts = []
    for index, found in enumerate(np.split(hits, np.cumsum(counts)[:-1])):
        active = opaque[index]
        active[tuple(tested[index][found].T)] = True
        active = _pixels_of(active, side, views.size[index]) & _unmasked(views, index)
        parts.append(runs_of(active.reshape(-1), views.offset[index]))
    runs = join_runs(parts)
    if not runs.size:
        raise ValueError(
            f"no ray of {len(views.offset)} views hits a valid cell of the box {schedule.lower} to {schedule.upper}; "
            "correct scene.lower and scene.upper"
        )
    return runs


def runs_of(
    chosen: Bool[np.ndarray, " N"], offset: int | np.integer = 0
) -> tuple[Int[np.ndarray, " R"], Int[np.ndarray, " R"]]:
    """Returns the first ids and the lengths of the runs of True; ids count from an offset."""
    edges = np.flatnonzero(np.diff(chosen, prepend=False, append=False))
    return edges[::2] + offset, edges[1::2] - edges[::2]


def join_runs(parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> PixelRuns:
    """Returns the PixelRuns, in numpy, of results of `runs_of` whose ids ascend."""
    first, length = (np.concatenate(column) for column in zip(*parts, strict=True))
    ends = np.cumsum(length)
    return PixelRuns(first=np.int32(first), before=np.int32(ends - length), size=np.int32(length.sum()))


def _fingerprint(views, schedule, options):
    """Returns a hash of all inputs of a result, and of the version of the code that finds it.

    Colours are no input. A test compares results with those of each version, so that no change of the code finds what
    an earlier version has cached.
    """
    plain = (
        _VERSION,
        (schedule.lower, schedule.upper, schedule.shape, schedule.step_size, schedule.contracted),
        (views.cameras.lens, views.pixels.shape, options),
    )
    arrays = [
        views.offset,
        views.size,
        views.near,
        views.far,
        views.free_depth,
        views.mask,
        views.box,
        views.cameras,
        views.sparse,
    ]
    if options["use_alpha"] and views.pixels.shape[-1] == 4:
        ends = np.append(views.offset[1:], len(views.pixels))
        arrays += [views.pixels[first:end, 3] for first, end in zip(views.offset, ends, strict=True)]
    return fingerprint(repr(plain), *arrays)


def _slice(views, index):
    """Returns the slice of a view's pixels, and its (height, width)."""
    height, width = views.size[index]
    return slice(views.offset[index], views.offset[index] + height * width), (height, width)


def _unmasked(views, index):
    """Returns which pixels [H, W] of a view belong to batches."""
    pixels, size = _slice(views, index)
    return np.ones(size, bool) if views.mask is None else np.asarray(views.mask[pixels]).reshape(size)


def _has_alpha(views, index):
    """Returns which pixels [H, W] of a view have alpha > 0; none if the views have no alpha."""
    pixels, size = _slice(views, index)
    if views.pixels.shape[-1] != 4:
        return np.zeros(size, bool)
    return np.asarray(views.pixels[pixels, 3] > 0).reshape(size)


def _any_of(pixels, side):
    """Returns for each tile whether any of its pixels [H, W] is True."""
    if side == 1:
        return pixels
    height, width = (-(-length // side) for length in pixels.shape)
    padded = np.zeros((height * side, width * side), bool)
    padded[: pixels.shape[0], : pixels.shape[1]] = pixels
    return padded.reshape(height, side, width, side).any(axis=(1, 3))


def _pixels_of(tiles, side, size):
    """Returns which pixels [H, W] belong to the given tiles or to neighbours of them; side 1: to the tiles."""
    if side == 1:
        return tiles
    wide = np.pad(tiles, 1)
    rows = wide[:-2] | wide[1:-1] | wide[2:]
    tiles = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    height, width = size
    return tiles.repeat(side, axis=0)[:height].repeat(side, axis=1)[:, :width]


def _hits(views, schedule, valid, view, pixels, *, ndc, chunk):
    """Returns whether rays [N] of views [N] through pixels [N, 2] hit a valid cell."""
    everywhere = valid.all()

    @jax.jit
    def hits(views, grid, view, pixels):
        rays = jax.vmap(lambda view, pixel: view_rays(views, view, pixel, ndc=ndc))(view, pixels)
        if everywhere:
            inside = clip_rays_to_box(grid, rays)
            return inside.far > inside.near
        samples = march_rays(None, grid, rays, step_size=schedule.step_size, cell=schedule.cell)
        return ((samples.delta > 0) & is_occupied(grid, rays, samples.t)).any(axis=-1)

    cameras = dataclasses.replace(views, pixels=np.zeros((1, 1), np.uint8), mask=None)
    found, grid = np.zeros(view.size, bool), schedule.create(valid)

    def test(start):
        indices = np.minimum(np.arange(start, start + chunk), view.size - 1)  # a single compiled shape
        found[indices] = hits(cameras, grid, view[indices], pixels[indices])
        return start

    with stages.stage("testing which pixels show the box") as stage:
        for start in cores.map_on_cores(test, range(0, view.size, chunk), compiles=True):
            stage.update(start, view.size)
    return found
