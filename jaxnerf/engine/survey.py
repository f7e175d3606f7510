"""What is known of a scene's box before training: the cells and the pixels worth a look."""

import hashlib
import pathlib

import jax
import numpy as np

from jaxnerf.data.cache import load_or_make
from jaxnerf.data.hull import visual_hull
from jaxnerf.data.runs import Runs
from jaxnerf.engine.live import pixels_that_meet

_SLOW = 0.5  # seconds that a survey takes, from which it is kept for the next start
_RUNS = ("first", "before", "size")


def survey(views, space, *, masks, ndc=False, pixel_offset=0.5):
    """Returns what is known before training: possible [X, Y, Z] bool, live Runs, and cells [M] int32.

    A survey that took a while is kept in the user's cache.

    Args:
        views: Views.
        space: Space.
        masks: whether pixels without alpha show that nothing is there.
        ndc, pixel_offset: see draw_batch.

    Returns:
        possible: which cells may hold something; live: see live.pixels_that_meet; cells: the flat indices of
        those that are possible.
    """
    options = {"masks": masks, "ndc": ndc, "pixel_offset": pixel_offset}

    def look():
        possible = possible_cells(views, space, masks=masks)
        live = pixels_that_meet(views, space, possible, **options)
        runs = {} if live is None else {name: getattr(live, name) for name in _RUNS}
        return {"possible": possible} | runs

    def fits(arrays):
        return arrays["possible"].shape == space.shape and set(arrays) in ({"possible"}, {"possible", *_RUNS})

    found = load_or_make(None, f"survey_{_fingerprint(views, space, options)}", look, fits=fits, worth=_SLOW)
    possible = found.pop("possible")
    return possible, Runs(**found) if found else None, np.flatnonzero(possible).astype(np.int32)


def possible_cells(views, space, *, masks):
    """Returns [X, Y, Z] bool, what the views' alpha leaves possible; all without masks."""
    if not masks or views.pixels.shape[-1] != 4:
        return np.ones(space.shape, bool)
    # The hull halves its cells, so it is fastest with few of them times a power of two along each axis.
    count, halvings = max(space.shape), 0
    while count > 31:
        count, halvings = -(-count // 2), halvings + 1
    count <<= halvings
    lower = np.asarray(space.lower)
    upper = lower + count * (np.asarray(space.upper) - lower) / space.shape
    x, y, z = space.shape
    return visual_hull(views, lower, upper, resolution=count)[:x, :y, :z]


def _fingerprint(views, space, options):
    """Returns a hash of all that a survey depends on: any of this package's code may be part of it."""
    digest = hashlib.sha256()
    for file in sorted(pathlib.Path(__file__).parents[1].rglob("*.py")):
        digest.update(file.read_bytes())
    plain = (space.lower, space.upper, space.shape, space.step, space.contracted, views.cameras.lens)
    digest.update(repr((plain, views.pixels.shape, options)).encode())
    arrays = (views.offset, views.size, views.near, views.far, views.mask, views.box, views.cameras)
    for leaf in jax.tree.leaves(arrays):
        digest.update(np.ascontiguousarray(leaf))
    if options["masks"] and views.pixels.shape[-1] == 4:
        for first, (height, width) in zip(views.offset, views.size, strict=True):
            digest.update(np.ascontiguousarray(views.pixels[first : first + height * width, 3]))
    return digest.hexdigest()[:24]
