"""Facts about a dataset, from which the options of a run's parts are inferred."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxnerf.core.views import Views
from jaxnerf.data.geometry import poses
from jaxnerf.data.observations import num_shared
from jaxnerf.options import Facts

_OUTLIERS = 0.05  # fraction of views whose footprints may be larger than all others, or smaller
_MEAN_RUNS, _MEAN_RUN = 2**10, 2**10  # of pixels, of whose colours the mean is taken


def dataset_facts(views: Views, **known: Any) -> Facts:
    """Returns the facts about a dataset.

    Args:
        views: of the split "train".
        **known: the other attributes of the Facts; ndc, contracted, has_alpha and skips_empty_cells are needed.
    """
    return Facts(
        num_views=len(views.size),
        num_observations=num_shared(views) if known["contracted"] and known["skips_empty_cells"] else 0,
        side=float(np.sqrt(np.prod(views.size, axis=1)).mean()),
        footprint=2 / float(np.max(views.size[:, 1])) if known["ndc"] else LookAt(views).footprint,
        footprint_spread=footprint_spread(views),
        mean_alpha=float(sample_pixels(views)[:, 3].mean()) if known["has_alpha"] else 1.0,
        has_times=views.time is not None,
        travels=poses.travel(np.asarray(views.cameras.to_world, np.float64)),
        **known,
    )


class LookAt:
    """What the cameras look at.

    Attributes:
        center: [3] world units, the point nearest to the cameras' axes. If the axes are parallel, all
            cameras are at one point, or there is one view, no such point lies in front of the cameras; the
            center is then the mean of the middles of the views' depth ranges.
        distance: [V] from the cameras to the center.
        reach: half the side of the cube around the center that holds nine in ten cameras.
        half_size: [V, 2] half the width and height of the images at that distance.
        footprints: [V] the side of a pixel at that distance, world units.
        footprint: their median.
    """

    def __init__(self, views):
        to_world = np.asarray(views.cameras.to_world, np.float64)
        eyes, axes = to_world[:, :, 3], to_world[:, :, 2]
        near, far = np.asarray(views.near, np.float64), np.asarray(views.far, np.float64)
        middle = np.where(np.isfinite(far), near + far, 3 * np.where(near > 0, near, 1)) / 2
        self.center = poses.gaze_center(to_world)
        self.distance = np.linalg.norm(eyes - self.center, axis=-1)
        spread = np.linalg.eigvalsh(np.eye(3) - axes.T @ axes / len(axes))[0]
        if spread < 1e-6 or np.median(self.distance) < 1e-3 * np.median(np.where(near > 0, near, middle)):
            self.center = (eyes - middle[:, None] * axes).mean(axis=0)
            self.distance = middle
        self.reach = float(np.quantile(np.abs(eyes - self.center).max(axis=-1), 0.9))
        focal = np.asarray(views.cameras.focal, np.float64)
        self.half_size = self.distance[:, None] * np.asarray(views.size)[:, ::-1] / 2 / focal
        self.footprints = self.distance / focal[:, 0]
        self.footprint = float(np.median(self.footprints))

    @property
    def inner_half_side(self):
        """Half the side of the cube that most images show completely."""
        return float(np.median(self.half_size.min(axis=1)))


def footprints(views: Views) -> Float[np.ndarray, " V"]:
    """Returns the side of a pixel [V] in world units at the median depth of the points that each view shows.

    Without points it is that at the point that all cameras look at, which is a poor guess inside a room.
    """
    sides, sparse = LookAt(views).footprints, views.sparse
    if sparse is None:
        return sides
    view, focal = np.asarray(sparse.view), np.asarray(views.cameras.focal, np.float64)[:, 0]
    pose = np.asarray(views.cameras.to_world, np.float64)[view]
    depth = ((pose[:, :, 3] - np.asarray(sparse.positions)[np.asarray(sparse.point)]) * pose[:, :, 2]).sum(axis=1)
    for index, each in enumerate(np.split(depth, np.searchsorted(view, np.arange(1, len(focal))))):
        if (each > 0).any():
            sides[index] = np.median(each[each > 0]) / focal[index]
    return sides


def footprint_spread(views: Views) -> float:
    """Returns the largest of the `footprints` over the smallest, without outliers; 1 where the smallest is 0."""
    smallest, largest = np.quantile(footprints(views), [_OUTLIERS, 1 - _OUTLIERS])
    return float(largest / smallest) if smallest > 0 else 1.0


def footprint_radii(views: Views) -> tuple[float, float]:
    """Returns the smallest and the largest radius of the pixels' cones, world units, at the `footprints`.

    Args:
        views: of the split "train".

    Returns:
        The radii; the smallest is at least a thousandth of the largest, as a camera may stand at what all look at.
    """
    radii = 2 / math.sqrt(12) * footprints(views)
    largest = float(radii.max())
    return max(float(radii.min()), largest / 1000), largest


def mean_color(views: Views) -> tuple[float, float, float]:
    """Returns the mean colour of the views' pixels in [0, 1], alpha dropped; see `sample_pixels`."""
    return tuple(float(value) for value in sample_pixels(views)[:, :3].mean(axis=0))


def sample_pixels(views: Views) -> Float[np.ndarray, "N C"]:
    """Returns pixels of all views in [0, 1].

    Of more than 2^20 pixels some are chosen: runs of them at random places, as single pixels of a file on disk would
    take as long to read as all. Pixels that a mask excludes do not count, unless it excludes all that were chosen.
    """
    total, runs = len(views.pixels), _MEAN_RUNS * _MEAN_RUN
    chosen = np.arange(min(total, runs))
    if total > runs:
        starts = np.sort(np.random.default_rng(0).integers(0, total - _MEAN_RUN, _MEAN_RUNS))
        chosen = (starts[:, None] + np.arange(_MEAN_RUN)).reshape(-1)
    if views.mask is not None and views.mask[chosen].any():
        chosen = chosen[views.mask[chosen]]
    pixels = views.pixels[chosen]
    return pixels / np.iinfo(pixels.dtype).max
