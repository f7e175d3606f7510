"""The visual hull: the part of a box that the views' alpha does not prove to be empty (Laurentini 1994).

Where a view has alpha 0 there is no matter along the ray, so a single view suffices to empty a cell. The hull is
computed by numpy on the host: it needs no gradients, and nothing is compiled.
"""

import functools
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxnerf.core.cameras import project, undistort
from jaxnerf.core.types import Camera, Vector
from jaxnerf.core.views import Views
from jaxnerf.runtime import cores, stages

_MARGIN = 1  # px around a box: matter that covers only a pixel's corner may have left no alpha
_MAX_TANGENT = 3.0  # of the angle from the axis up to which a distorted image is used
_COARSEST = 16  # cells along each axis of the first level, or up to twice as many
_CHUNK = 4096  # coarse cells at once, so that their arrays fit the processor's cache
_MAX_VIEWS = 256  # that are used: more views, from all around, hardly empty more cells


def visual_hull(views: Views, lower: Vector, upper: Vector, *, resolution: int) -> Bool[np.ndarray, "R R R"]:
    """Returns which cells of a box may contain matter.

    A cell is empty if one view that sees all of it has alpha 0 on every pixel that the cell may touch and on
    their neighbours. Cells that no view decides stay True. Only matter that leaves no alpha is lost: matter
    thinner than a pixel, or fainter than half a quantisation step of the file.

    Args:
        views: with straight alpha, C = 4. Pixels outside the mask are ignored.
        lower, upper: [3] world units, the box.
        resolution: R, cells along each axis. Fastest if it can be halved down to 16 to 31: 64, 96, 128.

    Returns:
        x first, as `create_grid` takes it.

    Raises:
        ValueError: if the views have no alpha, or the box is empty.
    """
    lower, upper = _check(views, lower, upper, resolution)
    levels = [resolution]
    while levels[0] % 2 == 0 and levels[0] >= 2 * _COARSEST:
        levels.insert(0, levels[0] // 2)
    # An octree: cell i of a level contains the cells 8 i to 8 i + 7 of the next. False: empty.
    tree = [np.ones(levels[0] ** 3 * 8**depth, bool) for depth in range(len(levels))]
    roots = np.indices((levels[0],) * 3, np.float32).reshape(3, -1)
    # Consecutive views are similar; a random order empties the coarse cells sooner.
    order = np.random.default_rng(0).permutation(len(views.offset))[:_MAX_VIEWS]

    def carve(index):
        view = _silhouette(views, index)
        projections = [_projection(view, lower, (upper - lower) / level) for level in levels]
        alive = np.flatnonzero(tree[0].copy())  # which counts before it fills
        for chosen in np.array_split(alive, alive.size // _CHUNK + 1):
            _carve(tree, view.table, projections, chosen, roots[:, chosen])

    # Several views carve the tree at once: whether a view finds a cell empty does not depend on the others.
    with stages.stage("finding the visual hull, by images") as stage:
        for done, _ in enumerate(cores.map_on_cores(carve, order, compiles=True), 1):
            stage.update(done, len(order))
    for above, below in zip(tree[:-1], tree[1:], strict=True):
        below &= np.repeat(above, 8)
    # The axes are x y z of the roots, then x y z of each halving; all of one direction become adjacent.
    halvings = tree[-1].reshape((levels[0],) * 3 + (2, 2, 2) * (len(levels) - 1))
    order = [axis for start in range(3) for axis in range(start, halvings.ndim, 3)]
    return halvings.transpose(order).reshape((resolution,) * 3)


def hull_bounds(
    views: Views, lower: Vector, upper: Vector, *, resolution: int = 64
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Returns the bounding box of the visual hull in a box, for a visual hull of finer cells.

    Args:
        views, lower, upper, resolution: see `visual_hull`.

    Returns:
        lower, upper: float64 world units. They enclose the cells that may contain matter and one more on each
        side, within the given box. Cells that no view sees completely stay in, such as those far from the object.

    Raises:
        ValueError: as `visual_hull`, and if all cells are empty.
    """
    cells = np.argwhere(visual_hull(views, lower, upper, resolution=resolution))
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    if not len(cells):
        raise ValueError(
            f"hull_bounds: {len(views.offset)} views show all of {resolution}^3 cells from {lower.tolist()} to "
            f"{upper.tolist()} empty, expected some with matter; enlarge the box, or correct poses or alpha"
        )
    size = (upper - lower) / resolution
    low, high = lower + (cells.min(0) - 1) * size, lower + (cells.max(0) + 2) * size
    return np.maximum(low, lower), np.minimum(high, upper)


def _check(views, lower, upper, resolution):
    if views.pixels.shape[-1] != 4:
        raise ValueError(
            f"visual_hull: pixels have shape {tuple(views.pixels.shape)}, expected [P, 4] with alpha last; "
            "without alpha no cell is known to be empty, so use a grid whose cells are all valid"
        )
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    good = lower.shape == upper.shape == (3,) and (lower < upper).all() and np.isfinite(upper - lower).all()
    if not good or resolution < 1:
        raise ValueError(
            f"visual_hull: the box is {lower.tolist()} to {upper.tolist()} in {resolution} cells, expected "
            "three finite numbers each, lower < upper, and at least one cell"
        )
    return lower, upper


def _projection(view, lower, size):
    """Returns matrix, start, half size and center that map a level's cells to px times z."""
    scale = np.append(view.focal, 1)  # float64 until the eye is subtracted: the box may be far away
    start = scale * (view.turn @ (lower + 0.5 * size - view.eye))
    half = scale * (np.abs(view.turn) @ (0.5 * size))
    columns = (np.float32(value)[:, None] for value in (start, half, view.center))
    return np.float32(scale[:, None] * view.turn * size), *columns


def _carve(tree, table, projections, ids, cells):
    """Marks the empty ones of the cells [3, N] with ids [N], and of their descendants, in the tree."""
    blocked, area = _count(table, *_footprints(projections[0], cells))
    tree[0][ids[blocked == 0]] = False
    if len(tree) == 1:
        return
    # Descendants of a cell whose pixels are all blocked are undecided, too; most cells in an object are such.
    mixed = (blocked > 0) & (blocked < area)
    ids = (8 * ids[mixed, None] + np.arange(8)).reshape(-1)
    corners = np.indices((2, 2, 2), np.float32).reshape(3, 1, 8)
    cells = (2 * cells[:, mixed, None] + corners).reshape(3, -1)
    left = tree[1][ids]
    _carve(tree[1:], table, projections[1:], ids[left], cells[:, left])


def _footprints(projection, cells):
    """Returns boxes low, high [2, N] px that contain the images of cells [3, N].

    Within a cell, x / z differs from its value at the center by (dx - (x / z) dz) / (z + dz), which is at most
    spread. The box is the whole image and its rim for cells that reach the camera.
    """
    matrix, start, half, center = projection
    # Not a matrix product: for so small a matrix, BLAS only waits for its threads.
    middle = sum(matrix[:, axis, None] * cells[axis] for axis in range(3)) + start
    place = middle[:2] / np.maximum(middle[2], 1e-9 * half[2])
    spread = (half[:2] + np.abs(place) * half[2]) / np.maximum(middle[2] - half[2], 1e-9 * half[2])
    return place + center - spread, place + center + spread


class _Silhouette(NamedTuple):
    """The blocked pixels of one view, as the image of a pinhole: those with alpha > 0 or outside the mask.

    Attributes:
        table: summed-area table of the blocked pixels and of a blocked rim around the image.
        focal: px, (x, y).
        center: px, (x, y).
        turn: rotation from the world to x right, y down, z along the axis.
        eye: world units.
    """

    table: Int[np.ndarray, "H+3 W+3"]
    focal: Float[np.ndarray, "2"]
    center: Float[np.ndarray, "2"]
    turn: Float[np.ndarray, "3 3"]
    eye: Float[np.ndarray, "3"]


def _silhouette(views, index):
    """Returns the _Silhouette of a view with alpha. The image of a lens is rectified first."""
    (height, width), first = np.asarray(views.size)[index], np.asarray(views.offset)[index]
    pixels = slice(first, first + height * width)
    blocked = np.asarray(views.pixels)[pixels, 3] > 0
    if views.mask is not None:
        blocked |= ~np.asarray(views.mask)[pixels]
    table = _sums(blocked.reshape(height, width))
    camera = jax.tree.map(lambda leaf: np.asarray(leaf)[index], views.cameras)
    focal, center = camera.focal, camera.center
    if camera.distortion is not None and camera.lens != "pinhole":
        numbers = (tuple(np.ravel(value).tolist()) for value in (focal, center, camera.distortion))
        low, high, focal, center = _rectify(height, width, camera.lens, *numbers)
        table = _sums((_count(table, low, high)[0] > 0).reshape(height, width))
    turn = np.float64(camera.to_world[:, :3]).T * [[1], [-1], [-1]]
    return _Silhouette(table, np.float64(focal), np.float64(center), turn, np.float64(camera.to_world[:, 3]))


def _count(table, low, high):
    """Counts the blocked pixels in boxes with their margin.

    Args:
        table: of a _Silhouette.
        low, high: [2, N] float px, (x, y), low <= high. They are clipped to the rim.

    Returns:
        The number of blocked pixels [N] and of all pixels [N], all of the latter > 0.
    """
    rim = np.array(table.shape[::-1], low.dtype)[:, None] - 2
    left, top = np.clip(low + (1 - _MARGIN), 0, rim).astype(np.intp)  # not negative, so this rounds down
    right, bottom = np.clip(high + (2 + _MARGIN), 1, rim + 1).astype(np.intp)
    area = (right - left) * (bottom - top)
    top, bottom, table = top * table.shape[1], bottom * table.shape[1], table.reshape(-1)
    return table[bottom + right] - table[top + right] - table[bottom + left] + table[top + left], area


def _sums(blocked):
    table = np.zeros((blocked.shape[0] + 3, blocked.shape[1] + 3), np.int32)
    np.pad(blocked, 1, constant_values=True).cumsum(0, np.int32).cumsum(1, out=table[1:, 1:])
    return table


@functools.lru_cache(8)  # a dataset has few lenses
def _rectify(height, width, lens, focal, center, distortion):
    """Returns boxes low, high [2, H W] px of a lens's image that each pixel of a pinhole covers, and the pinhole.

    The pinhole has as many pixels. They are so small that the lens bends each by much less than the margin.
    """
    camera = Camera(
        to_world=np.eye(3, 4, dtype=np.float32),
        focal=np.float32(focal),
        center=np.float32(center),
        distortion=np.float32(distortion),
        lens=lens,
    )
    probe = np.stack(np.meshgrid(np.linspace(0, width, 33), np.linspace(0, height, 33)), -1)
    points = np.asarray(jax.jit(undistort)(camera, np.float32(probe))[0]).reshape(-1, 2)
    # No plane holds 180 degrees. Any part of the image is valid, as the remaining pixels count as blocked.
    lower, upper = (np.clip(bound, -_MAX_TANGENT, _MAX_TANGENT) for bound in (points.min(0), points.max(0) + 1e-6))
    focal = np.array([width, height]) / (upper - lower)
    x, y = (np.arange(size + 1) / focal[axis] + lower[axis] for axis, size in enumerate((width, height)))
    x, y = np.meshgrid(x, y)
    seen = np.asarray(jax.jit(project)(camera, np.float32(np.stack([x, -y, -np.ones_like(x)], -1)))[0])
    four = np.stack([seen[:-1, :-1], seen[1:, :-1], seen[:-1, 1:], seen[1:, 1:]])
    low, high = (bound.reshape(-1, 2).T for bound in (four.min(0), four.max(0)))
    return low, high, focal, -lower * focal
