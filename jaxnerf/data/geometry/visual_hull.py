"""The visual hull: what the alpha of the views leaves possible of a box (Laurentini 1994).

Where a view has alpha 0 nothing stands anywhere along the ray, so one such view empties a cell for good.
numpy on the host: there is nothing to differentiate, and it compiles nothing.
"""

import numpy as np

from jaxnerf.data.geometry.silhouettes import count, silhouette

_COARSEST = 16  # cells along each axis to begin with, or up to twice as many
_CHUNK = 4096  # of these at once: their arrays stay in the processor's cache
_MOST_VIEWS = 256  # that are looked at: more, from all around, would hardly empty a cell more


def visual_hull(views, lower, upper, *, resolution):
    """Returns which cells of a box may hold something, as far as the alpha of the views tells.

    A cell is empty where one view that sees all of it has alpha 0 on every pixel that it may touch and on
    their neighbours. What no view decides stays possible, and of many views only some are looked at. So no
    matter is lost but what left no alpha around its place: thinner than a pixel, or fainter than half a step
    of the file's bits.

    Args:
        views: Views with straight alpha, C = 4. A pixel outside their mask tells nothing.
        lower, upper: [3] world units, the box.
        resolution: R, cells along each axis. Fastest if it can be halved down to 16 to 31: 64, 96, 128.

    Returns:
        [R, R, R] bool, x first, as create_grid takes it; numpy.

    Raises:
        ValueError: if the views have no alpha, or the box no inside.
    """
    lower, upper = _check(views, lower, upper, resolution)
    levels = [resolution]
    while levels[0] % 2 == 0 and levels[0] >= 2 * _COARSEST:
        levels.insert(0, levels[0] // 2)
    # A tree: cell i of a level has the cells 8 i to 8 i + 7 of the next. False is empty for good.
    tree = [np.ones(levels[0] ** 3 * 8**depth, bool) for depth in range(len(levels))]
    roots = np.indices((levels[0],) * 3, np.float32).reshape(3, -1)
    # Neighbours in a list look alike; views from all around empty the coarse cells sooner.
    for index in np.random.default_rng(0).permutation(len(views.offset))[:_MOST_VIEWS]:
        view = silhouette(views, index)
        projections = [_projection(view, lower, (upper - lower) / level) for level in levels]
        alive = np.flatnonzero(tree[0])
        for chosen in np.array_split(alive, alive.size // _CHUNK + 1):
            _carve(tree, view.table, projections, chosen, roots[:, chosen])
    for above, below in zip(tree[:-1], tree[1:], strict=True):
        below &= np.repeat(above, 8)
    # Axes x y z of the roots, then of each halving: each axis's own come together.
    halvings = tree[-1].reshape((levels[0],) * 3 + (2, 2, 2) * (len(levels) - 1))
    order = [axis for start in range(3) for axis in range(start, halvings.ndim, 3)]
    return halvings.transpose(order).reshape((resolution,) * 3)


def hull_bounds(views, lower, upper, *, resolution=64):
    """Returns lower and upper [3] of what the views leave possible in a box: a tighter box for visual_hull.

    Args:
        views, lower, upper, resolution: see visual_hull.

    Returns:
        lower, upper: [3] float64 world units: the possible cells and one more all around, within the given
        box. Far from the object a box has cells that no view sees whole, which stay possible.

    Raises:
        ValueError: as visual_hull, and if nothing at all is possible.
    """
    cells = np.argwhere(visual_hull(views, lower, upper, resolution=resolution))
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    if not len(cells):
        raise ValueError(
            f"hull_bounds: {len(views.offset)} views leave none of {resolution}^3 cells possible from "
            f"{lower.tolist()} to {upper.tolist()}; give a box that holds the object, or mend poses or alpha"
        )
    size = (upper - lower) / resolution
    low, high = lower + (cells.min(0) - 1) * size, lower + (cells.max(0) + 2) * size
    return np.maximum(low, lower), np.minimum(high, upper)


def _check(views, lower, upper, resolution):
    if views.pixels.shape[-1] != 4:
        raise ValueError(
            f"visual_hull: pixels have shape {tuple(views.pixels.shape)}, wanted [P, 4] with alpha last; "
            "without alpha nothing is known to be empty, so take all cells as possible"
        )
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    good = lower.shape == upper.shape == (3,) and (lower < upper).all() and np.isfinite(upper - lower).all()
    if not good or resolution < 1:
        raise ValueError(
            f"visual_hull: the box is {lower.tolist()} to {upper.tolist()} in {resolution} cells, wanted "
            "three finite numbers each, lower < upper, and at least one cell"
        )
    return lower, upper


def _projection(view, lower, size):
    """Returns, of the cells of one level seen in px times z: matrix, start, half of a cell, and center."""
    scale = np.append(view.focal, 1)  # float64 until the eye is taken off: the box may lie far out
    start = scale * (view.turn @ (lower + 0.5 * size - view.eye))
    half = scale * (np.abs(view.turn) @ (0.5 * size))
    columns = (np.float32(value)[:, None] for value in (start, half, view.center))
    return np.float32(scale[:, None] * view.turn * size), *columns


def _carve(tree, table, projections, ids, cells):
    """Marks in the tree which of the cells [3, N] with these ids [N], and of all below them, are empty."""
    blocked, area = count(table, *_footprints(projections[0], cells))
    tree[0][ids[blocked == 0]] = False
    if len(tree) == 1:
        return
    # Where all is blocked the view decides nothing further down either: mostly so, inside an object.
    mixed = (blocked > 0) & (blocked < area)
    ids = (8 * ids[mixed, None] + np.arange(8)).reshape(-1)
    corners = np.indices((2, 2, 2), np.float32).reshape(3, 1, 8)
    cells = (2 * cells[:, mixed, None] + corners).reshape(3, -1)
    left = tree[1][ids]
    _carve(tree[1:], table, projections[1:], ids[left], cells[:, left])


def _footprints(projection, cells):
    """Returns boxes low, high [2, N] px that hold the images of cells [3, N].

    In a cell, x / z is off its value in the middle by (dx - (x / z) dz) / (z + dz), which is at most
    spread. That becomes all of the image and its rim where the cell reaches the camera.
    """
    matrix, start, half, center = projection
    middle = matrix @ cells + start
    place = middle[:2] / np.maximum(middle[2], 1e-9 * half[2])
    spread = (half[:2] + np.abs(place) * half[2]) / np.maximum(middle[2] - half[2], 1e-9 * half[2])
    return place + center - spread, place + center + spread
