"""The pixels that training has to look at: those whose rays meet what may hold something."""

import dataclasses
import math

import jax
import numpy as np

from jaxnerf.core import occupancy
from jaxnerf.data import runs
from jaxnerf.data.batches import live_pixels, view_rays
from jaxnerf.engine.marching import samples_in_box

_EACH = 2**24  # pixels, up to which each is asked by itself
_TILES = 2**21  # that are asked in place of more: a ray takes some microseconds


def pixels_that_meet(views, space, possible, *, masks=False, ndc=False, pixel_offset=0.5, chunk=2**12):
    """Returns Runs of the pixels that show something or whose rays meet a possible cell; None for all.

    Of very many pixels square tiles are asked by the ray through their middle, and the tiles around one that
    shows or meets something count, too. Then some pixels are among them that meet nothing.

    Args:
        views: Views. A pixel outside their mask does not count.
        space: Space.
        possible: [X, Y, Z] bool.
        masks: whether a pixel with alpha shows something, so that its ray need not be followed.
        ndc, pixel_offset: see draw_batch.
        chunk: rays followed at once.

    Raises:
        ValueError: if there are none.
    """
    if space.contracted:
        return live_pixels(views)  # every ray does
    total = views.pixels.shape[0]
    side = 1 if total <= _EACH else math.ceil(math.sqrt(total / _TILES))
    tiles = [_known_tiles(views, index, side, masks) for index in range(len(views.offset))]
    asked = [np.argwhere(inside & ~shown) for shown, inside in tiles]
    view = np.repeat(np.arange(len(asked)), [len(places) for places in asked])
    middles = (np.concatenate(asked)[:, ::-1] * side + (side - 1) / 2 + pixel_offset).astype(np.float32)
    met = _meets(views, space, possible, view, middles, ndc=ndc, chunk=chunk)
    found = np.split(met, np.cumsum([len(places) for places in asked])[:-1])
    live = runs.join(
        [_runs(views, index, side, tiles[index][0], asked[index], part) for index, part in enumerate(found)]
    )
    if not live.size:
        raise ValueError(
            f"no ray of {len(views.offset)} views meets anything in the box {space.lower} to {space.upper}; "
            "correct space.lower and space.upper"
        )
    return live


def _known_tiles(views, index, side, masks):
    """Returns of a view's tiles [H, W] which show something, and which have pixels that count."""
    shown, inside = _known(views, index, masks)
    return _any_of(shown & inside, side), _any_of(inside, side)


def _known(views, index, masks):
    """Returns of a view's pixels [H, W] which show something, and which count."""
    size, first = tuple(views.size[index]), views.offset[index]
    own = slice(first, first + size[0] * size[1])
    shown = np.zeros(size, bool)
    if masks and views.pixels.shape[-1] == 4:
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


def _meets(views, space, possible, view, pixels, *, ndc, chunk):
    """Returns whether rays [N] of views [N] through pixels [N, 2] meet a possible cell."""

    @jax.jit
    def meets(views, grid, view, pixels):
        rays = jax.vmap(lambda view, pixel: view_rays(views, view, pixel, ndc=ndc))(view, pixels)
        samples = samples_in_box(None, grid, rays, step=space.step, cell=space.cell)
        return ((samples.delta > 0) & occupancy.occupied_at(grid, rays, samples.t)).any(axis=-1)

    colourless = dataclasses.replace(views, pixels=np.zeros((1, 1), np.uint8), mask=None)
    found, grid = np.zeros(view.size, bool), space.create(possible)
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
    return runs.runs_of((live & inside).reshape(-1), views.offset[index])
