"""Where the pixels of a view may see matter, according to the dataset's sparse points."""

import functools
import os
import pathlib
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxnerf.core.views import Views
from jaxnerf.data.ray_batches import DEPTH_STRIDE
from jaxnerf.runtime import cores
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.runtime.user_cache import load_or_make

_MARGIN = 0.15  # of the depth: surfaces curve between points, and points have errors
_NEIGHBOURS = 8  # observations around one that it is compared with
_OUTLIER = 0.3  # relative difference from the median inverse depth of the neighbours
_FEW = 16  # observations in a view: fewer say too little
_SLOW = 0.5  # seconds of work from which depths are cached


def surface_range(
    views: Views, view: int, pixels: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Returns the depths [N] in t between which a view sees a surface through its pixels [N, 2].

    The observations of the dataset's points are triangulated in the image. The surface is between the nearest and the
    farthest of a triangle's three points, with a margin: it may curve between points, but hardly by more. This is
    wrong for objects without points of their own, and behind the edges of objects.

    Args:
        views: those without `sparse` or with few observations tell nothing.
        view: index.
        pixels: px, (x, y), any pixel_offset.

    Returns:
        near and far; `free_depth`, or 0 without, and infinity for pixels outside all triangles.
    """
    least = 0.0 if views.free_depth is None else float(views.free_depth[view])
    near, far = np.full(len(pixels), least, np.float32), np.full(len(pixels), np.inf, np.float32)
    found = _triangulated(views, view)
    if found is None:
        return near, far
    triangles, inverse = found
    simplex = triangles.find_simplex(pixels)
    corners = inverse[triangles.simplices[simplex]]
    inside = simplex >= 0
    near[inside] = np.maximum((1 - _MARGIN) / corners.max(axis=1), least)[inside]
    far[inside] = ((1 + _MARGIN) / corners.min(axis=1))[inside]
    return near, far


def interpolated_depths(views: Views) -> Float[np.ndarray, "V H W 2"]:
    """Returns the inverse depth and its confidence at the center of every square of 4 x 4 pixels of each view.

    The inverse depth is interpolated linearly in triangles of observations, so it is exact on planes if the lens does
    not distort. The confidence is the square of the least inverse depth of a triangle's corners over the largest one:
    a triangle between an object and what is behind it tells little. It is 0 outside all triangles. A result that takes
    a while to compute is kept in the user's cache.

    Args:
        views: of any sizes; the result has the largest of them, and 0 beyond the end of a view.
    """
    code = pathlib.Path(__file__).read_bytes()
    name = f"depths_{fingerprint(code, DEPTH_STRIDE, views.size, views.cameras.to_world, views.sparse)}"
    found = load_or_make(
        None,
        name,
        lambda: {"depths": _interpolated(views)},
        is_valid=lambda arrays: set(arrays) == {"depths"} and arrays["depths"].dtype == np.float32,
        min_seconds=_SLOW,
    )
    return found["depths"]


def _interpolated(views):
    height, width = -(-np.asarray(views.size).max(axis=0) // DEPTH_STRIDE)
    result = np.zeros((len(views.size), height, width, 2), np.float32)
    y, x = (places.reshape(-1) for places in np.mgrid[:height, :width])
    pixels = (np.stack([x, y], axis=-1) + 0.5) * DEPTH_STRIDE

    def fill(view):
        found = _triangulated(views, view)
        if found is None:
            return
        triangles, inverse = found
        simplex = triangles.find_simplex(pixels)
        corners, affine = inverse[triangles.simplices[simplex]], triangles.transform[simplex]
        weights = (affine[:, :2] * (pixels - affine[:, 2])[:, None]).sum(axis=-1)
        values = (weights * corners[:, :2]).sum(axis=-1) + (1 - weights[:, 0] - weights[:, 1]) * corners[:, 2]
        confidence = (corners.min(axis=1) / corners.max(axis=1)) ** 2
        result[view, y, x] = np.where((simplex >= 0)[:, None], np.stack([values, confidence], axis=-1), 0)

    list(cores.map_on_cores(fill, range(len(views.size))))
    return result


@functools.cache
def scipy_spatial() -> Any:
    """Imports scipy.spatial where it is used: it takes 50 MB, and a start that finds its results cached needs none.

    SciPy's OpenBLAS gets a single thread, unless it has been loaded before or $OPENBLAS_NUM_THREADS is set. A Delaunay
    triangulation inverts thousands of 2 x 2 matrices, and for each, OpenBLAS waits for all its threads: on two cores
    that took 35 ms an image, and seconds beside another program, in place of 5 ms.
    """
    name = "OPENBLAS_NUM_THREADS"
    is_set = name in os.environ
    os.environ.setdefault(name, "1")
    from scipy import spatial

    if not is_set:
        del os.environ[name]
    return spatial


def _triangulated(views, view):
    """Returns the triangles between a view's observations, without outliers, and the inverse depths; None: too few."""
    if views.sparse is None:
        return None
    spatial = scipy_spatial()
    first, end = np.searchsorted(views.sparse.view, [view, view + 1])
    at = np.asarray(views.sparse.pixel[first:end], np.float64)
    to_world = np.asarray(views.cameras.to_world[view], np.float64)
    points = np.asarray(views.sparse.positions, np.float64)[views.sparse.point[first:end]]
    depth = (to_world[:, 3] - points) @ to_world[:, 2]
    at, inverse = at[depth > 0], 1 / depth[depth > 0]
    if len(inverse) < _FEW:
        return None
    others = spatial.cKDTree(at).query(at, _NEIGHBOURS + 1)[1]
    typical = np.median(inverse[others], axis=1)
    kept = np.abs(inverse - typical) < _OUTLIER * typical
    try:
        return spatial.Delaunay(at[kept]), inverse[kept]
    except (spatial.QhullError, ValueError):  # all on a line
        return None
