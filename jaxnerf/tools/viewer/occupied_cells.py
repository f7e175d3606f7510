"""What of an occupancy grid the viewer draws."""

import numpy as np
from jaxtyping import Float

from jaxnerf.core import contraction
from jaxnerf.core.occupancy.grid import OccupancyGrid
from jaxnerf.core.views import Views

_MAX_CELLS = 30_000


def surface_cells(grid: OccupancyGrid, views: Views | None = None) -> tuple[Float[np.ndarray, "N 3"], float]:
    """Returns the centres [N, 3] of occupied cells with an empty neighbour, world units, and a cell's size.

    Args:
        grid: of whose such cells at most 30,000 are returned, evenly.
        views: whose first camera defines normalised device coordinates, in which the grid is; None: it is not.
    """
    occupied = np.asarray(grid.occupied)
    around = np.pad(occupied, 1)
    inside = np.ones_like(occupied)
    for axis in range(3):
        for start in (0, 2):
            part = [slice(1, -1)] * 3
            part[axis] = slice(start, start + occupied.shape[axis])
            inside &= around[tuple(part)]
    cells = np.argwhere(occupied & ~inside)
    cells = cells[:: max(-(-len(cells) // _MAX_CELLS), 1)]
    lower, upper = np.asarray(grid.lower, np.float64), np.asarray(grid.upper, np.float64)
    size = (upper - lower) / occupied.shape
    points = lower + (cells + 0.5) * size
    if grid.contracted and len(points):
        middle, quarter = (lower + upper) / 2, (upper - lower) / 4
        local = (points - middle) / quarter
        near = np.abs(local).max(axis=1) < 1.9  # farther cells are larger than the scene
        points = middle + quarter * np.asarray(contraction.expand(np.float32(local[near])))
    return points if views is None else _from_ndc(points, views), float(size.min())


def _from_ndc(points, views):
    """Returns where points [N, 3] of NDC are in the world, see `ndc_rays`; the near plane is at z = -1."""
    height, width = (float(side) for side in views.size[0])
    focal = np.asarray(views.cameras.focal, np.float64)[0]
    depth = 2 / (1 - np.minimum(points[:, 2], 1 - 1e-3))
    across = points[:, :2] * depth[:, None] * [width, height] / (2 * focal)
    return np.column_stack([across, -depth])
