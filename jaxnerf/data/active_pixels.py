"""What of a dataset training looks at: the valid cells of the grid, and the pixels whose rays may hit one.

Pixels are kept as runs of neighbours, as single ids would fill as much memory as the pixels.
"""

import dataclasses
import hashlib
import math
import pathlib

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf.core.occupancy.grid import is_occupied
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.core.types import pytree
from jaxnerf.data.geometry.visual_hull import visual_hull
from jaxnerf.data.ray_batches import view_rays
from jaxnerf.runtime.user_cache import load_or_make

_EACH = 2**24  # pixels, up to which the ray of each is tested
_TILES = 2**21  # tiles that are tested in place of more pixels: a ray takes some microseconds
_SLOW = 0.5  # seconds of work from which the result is kept for the next start
_RUNS = ("first", "before", "size")


@pytree()
class PixelRuns:
    """Ids of pixels, ascending: runs of neighbours, each with all ids from its first on."""

    first: jax.Array  # [R] int32, the id that a run begins with
    before: jax.Array  # [R] int32, how many ids the runs before it have
    size: jax.Array  # int32, how many ids there are

    def ids(self, places):
        """Returns the ids [...] at places [...] of the list, each below its size."""
        run = jnp.searchsorted(self.before, places, side="right") - 1
        return jnp.asarray(self.first)[run] + places - jnp.asarray(self.before)[run]

    def count_below(self, bounds):
        """Returns how many ids [...] of the list lie below bounds [...]."""
        run = jnp.maximum(jnp.searchsorted(self.first, bounds) - 1, 0)
        ends = jnp.append(self.before[1:], self.size)
        into = bounds - jnp.asarray(self.first)[run]
        return jnp.clip(jnp.asarray(self.before)[run] + into, 0, ends[run])

    def all_ids(self):
        """Returns [L] int32, in numpy on the host."""
        lengths = np.diff(np.append(self.before, self.size))
        return (np.arange(self.size) + np.repeat(self.first - self.before, lengths)).astype(np.int32)


def active_region(views, schedule, *, use_alpha, ndc=False, pixel_offset=0.5):
    """Returns what is known before training: possible [X, Y, Z] bool, live Runs, and cells [M] int32.

    A survey that took a while is kept in the user's cache.

    Args:
        views: Views.
        space: Space.
        use_alpha: whether pixels without alpha show that nothing is there.
        ndc, pixel_offset: see draw_batch.

    Returns:
        possible: which cells may hold something; live: see live.pixels_that_meet; cells: the flat indices of
        those that are possible.
    """
    options = {"use_alpha": use_alpha, "ndc": ndc, "pixel_offset": pixel_offset}

    def look():
        valid = valid_cells(views, schedule, use_alpha=use_alpha)
        live = find_active_pixels(views, schedule, valid, **options)
        runs = {} if live is None else {name: getattr(live, name) for name in _RUNS}
        return {"valid": valid} | runs

    def fits(arrays):
        return arrays["valid"].shape == schedule.shape and set(arrays) in ({"valid"}, {"valid", *_RUNS})

    found = load_or_make(None, f"active_{_fingerprint(views, schedule, options)}", look, fits=fits, worth=_SLOW)
    valid = found.pop("valid")
    return valid, PixelRuns(**found) if found else None, np.flatnonzero(valid).astype(np.int32)


def valid_cells(views, schedule, *, use_alpha):
    """Returns [X, Y, Z] bool, what the views' alpha leaves possible; all without use_alpha."""
    if not use_alpha or views.pixels.shape[-1] != 4:
        return np.ones(schedule.shape, bool)
    # The hull halves its cells, so it is fastest with few of them times a power of two along each axis.
    count, halvings = max(schedule.shape), 0
    while count > 31:
        count, halvings = -(-count // 2), halvings + 1
    count <<= halvings
    lower = np.asarray(schedule.lower)
    upper = lower + count * (np.asarray(schedule.upper) - lower) / schedule.shape
    x, y, z = schedule.shape
    return visual_hull(views, lower, upper, resolution=count)[:x, :y, :z]


def _fingerprint(views, schedule, options):
    """Returns a hash of all that a survey depends on: any of this package's code may be part of it."""
    digest = hashlib.sha256()
    for file in sorted(pathlib.Path(__file__).parents[1].rglob("*.py")):
        digest.update(file.read_bytes())
    plain = (
        schedule.lower,
        schedule.upper,
        schedule.shape,
        schedule.step_size,
        schedule.contracted,
        views.cameras.lens,
    )
    digest.update(repr((plain, views.pixels.shape, options)).encode())
    arrays = (views.offset, views.size, views.near, views.far, views.mask, views.box, views.cameras)
    for leaf in jax.tree.leaves(arrays):
        digest.update(np.ascontiguousarray(leaf))
    if options["use_alpha"] and views.pixels.shape[-1] == 4:
        for first, (height, width) in zip(views.offset, views.size, strict=True):
            digest.update(np.ascontiguousarray(views.pixels[first : first + height * width, 3]))
    return digest.hexdigest()[:24]


def unmasked_pixels(views):
    """Returns Runs, the ids of the pixels that belong to batches; None where all do.

    Raises:
        ValueError: if a view has none; names it.
    """
    if views.mask is None:
        return None
    parts = []
    for view, (first, count) in enumerate(zip(views.offset, np.prod(views.size, axis=1), strict=True)):
        parts.append(runs_of(np.asarray(views.mask[first : first + count]), first))
        if not len(parts[-1][0]):
            name = views.names[view] if views.names else view
            raise ValueError(f"view {name}: its mask leaves no pixel, wanted at least one; drop the view or mend it")
    return join(parts)


def find_active_pixels(views, schedule, valid, *, use_alpha=False, ndc=False, pixel_offset=0.5, chunk=2**12):
    """Returns Runs of the pixels that show something or whose rays meet a possible cell; None for all.

    Of very many pixels square tiles are asked by the ray through their middle, and the tiles around one that
    shows or meets something count, too. Then some pixels are among them that meet nothing.

    Args:
        views: Views. A pixel outside their mask does not count.
        space: Space.
        possible: [X, Y, Z] bool.
        use_alpha: whether a pixel with alpha shows something, so that its ray need not be followed.
        ndc, pixel_offset: see draw_batch.
        chunk: rays followed at once.

    Raises:
        ValueError: if there are none.
    """
    if schedule.contracted:
        return unmasked_pixels(views)  # every ray does
    total = views.pixels.shape[0]
    side = 1 if total <= _EACH else math.ceil(math.sqrt(total / _TILES))
    tiles = [_known_tiles(views, index, side, use_alpha) for index in range(len(views.offset))]
    asked = [np.argwhere(inside & ~shown) for shown, inside in tiles]
    view = np.repeat(np.arange(len(asked)), [len(places) for places in asked])
    middles = (np.concatenate(asked)[:, ::-1] * side + (side - 1) / 2 + pixel_offset).astype(np.float32)
    met = _may_hit(views, schedule, valid, view, middles, ndc=ndc, chunk=chunk)
    found = np.split(met, np.cumsum([len(places) for places in asked])[:-1])
    live = join([_runs(views, index, side, tiles[index][0], asked[index], part) for index, part in enumerate(found)])
    if not live.size:
        raise ValueError(
            f"no ray of {len(views.offset)} views meets anything in the box {schedule.lower} to {schedule.upper}; "
            "correct occupancy.lower and occupancy.upper"
        )
    return live


def _known_tiles(views, index, side, use_alpha):
    """Returns of a view's tiles [H, W] which show something, and which have pixels that count."""
    shown, inside = _known(views, index, use_alpha)
    return _any_of(shown & inside, side), _any_of(inside, side)


def _known(views, index, use_alpha):
    """Returns of a view's pixels [H, W] which show something, and which count."""
    size, first = tuple(views.size[index]), views.offset[index]
    own = slice(first, first + size[0] * size[1])
    shown = np.zeros(size, bool)
    if use_alpha and views.pixels.shape[-1] == 4:
        shown = np.asarray(views.pixels[own, 3] > 0).reshape(size)
    inside = np.ones(size, bool) if views.mask is None else np.asarray(views.mask[own]).reshape(size)
    return shown, inside


def _any_of(pixels, side):
    """Returns of tiles whether any of their pixels [H, W] is True."""
    if side == 1:
        return pixels
    height, width = (-(-length // side) for length in pixels.shape)
    padded = np.zeros((height * side, width * side), bool)
    padded[: pixels.shape[0], : pixels.shape[1]] = pixels
    return padded.reshape(height, side, width, side).any(axis=(1, 3))


def _may_hit(views, schedule, valid, view, pixels, *, ndc, chunk):
    """Returns whether rays [N] of views [N] through pixels [N, 2] meet a possible cell."""

    @jax.jit
    def meets(views, grid, view, pixels):
        rays = jax.vmap(lambda view, pixel: view_rays(views, view, pixel, ndc=ndc))(view, pixels)
        samples = march_rays(None, grid, rays, step_size=schedule.step_size, cell=schedule.cell)
        return ((samples.delta > 0) & is_occupied(grid, rays, samples.t)).any(axis=-1)

    colourless = dataclasses.replace(views, pixels=np.zeros((1, 1), np.uint8), mask=None)
    found, grid = np.zeros(view.size, bool), schedule.create(valid)
    for start in range(0, view.size, chunk):
        places = np.minimum(np.arange(start, start + chunk), view.size - 1)  # one compiled shape
        found[places] = meets(colourless, grid, view[places], pixels[places])
    return found


def _runs(views, index, side, shown, asked, met):
    """Returns the runs of a view's pixels in tiles [H, W] that are shown, or of those asked met."""
    live = shown.copy()
    live[tuple(asked[met].T)] = True
    if side > 1:
        height, width = views.size[index]
        wide = np.pad(live, 1)
        rows = wide[:-2] | wide[1:-1] | wide[2:]
        live = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
        live = live.repeat(side, axis=0)[:height].repeat(side, axis=1)[:, :width]
    inside = _known(views, index, False)[1]
    return runs_of((live & inside).reshape(-1), views.offset[index])


def runs_of(chosen, offset=0):
    """Returns first [R] and length [R] of the runs in which chosen [N] is True; ids count from an offset."""
    edges = np.flatnonzero(np.diff(chosen, prepend=False, append=False))
    return edges[::2] + offset, edges[1::2] - edges[::2]


def join(parts):
    """Returns the Runs of [(first, length), ...] in numpy, whose ids ascend."""
    first, length = (np.concatenate(column) for column in zip(*parts, strict=True))
    ends = np.cumsum(length)
    before = np.int32(ends - length)
    return PixelRuns(first=np.int32(first), before=before, size=np.int32(length.sum()))
