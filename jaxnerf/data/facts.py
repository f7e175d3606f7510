"""Facts about a dataset, from which the options of a run's parts are inferred."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxnerf.core.views import Views
from jaxnerf.data.geometry import poses, visual_hull
from jaxnerf.data.observations import num_shared
from jaxnerf.data.ray_batches import view_rays
from jaxnerf.options import Facts, is_auto

# Space is not contracted as far as the cameras, so that cells near them are small: large ones fill with fog. But the
# cube is at most this many times as large as that which most images show: what they look at gets fewer cells then.
_MAX_INNER_BOX = 3.0
# Times twice the side of the cube that most images show; a stated box that is larger is no better than contraction.
_MAX_STATED_BOX = 3.0
_OUTLIERS = 0.05  # fraction of views whose footprints may be larger than all others, or smaller
_MEAN_RUNS, _MEAN_RUN = 2**10, 2**10  # of pixels, of whose colours the mean is taken


def dataset_facts(
    views: Views,
    *,
    ndc: bool,
    world: str,
    use_alpha: bool,
    sampler: str,
    contracted: Any,
    lower: Any,
    upper: Any,
) -> Facts:
    """Returns the facts about a dataset.

    Args:
        views: of the split "train".
        ndc: whether rays are in normalised device coordinates.
        world: see `DataOptions`.
        use_alpha: whether alpha may bound the scene.
        sampler: the name of the run's sampler.
        contracted, lower, upper: of the box where they are set; otherwise "auto".

    Raises:
        ValueError: if the box is empty.
    """
    has_alpha = use_alpha and views.pixels.shape[-1] == 4 and not ndc
    why = bound = ""
    if is_auto(contracted):
        contracted, why = _contracted(views, has_alpha, ndc=ndc, world=world)
    if is_auto(lower) or is_auto(upper):
        *corners, bound = _box(views, has_alpha, ndc=ndc, contracted=contracted)
        digits = 4 - math.floor(math.log10(max(corners[1] - corners[0])))
        found = [tuple(round(float(x), digits) for x in corner) for corner in corners]
        lower, upper = (new if is_auto(old) else old for new, old in zip(found, (lower, upper), strict=True))
    facts = Facts(
        num_views=len(views.size),
        side=float(np.sqrt(np.prod(views.size, axis=1)).mean()),
        footprint=2 / float(np.max(views.size[:, 1])) if ndc else LookAt(views).footprint,
        footprint_spread=footprint_spread(views),
        has_alpha=has_alpha,
        ndc=ndc,
        lower=lower,
        upper=upper,
        box_reason=bound,
        contracted=contracted,
        contraction_reason=why,
        sampler=sampler,
    )
    if not facts.longest > 0:
        raise ValueError(f"occupancy.lower is {lower} and occupancy.upper {upper}, expected lower < upper")
    return facts._replace(
        mean_alpha=float(sample_pixels(views)[:, 3].mean()) if has_alpha else 1.0,
        num_observations=num_shared(views) if facts.fills_space else 0,
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


def _contracted(views, has_alpha, *, ndc, world):
    """Returns whether the box holds all of space, and why."""
    if ndc:
        return False, "normalised device coordinates hold everything in view"
    if world != "around":
        return False, f"the world is {world!r}"
    if views.box is not None:
        side = float(np.max(np.asarray(views.box[1]) - np.asarray(views.box[0])))
        if side <= _MAX_STATED_BOX * 4 * LookAt(views).inner_half_side:
            return False, "the dataset states the scene's bounds"
    if has_alpha:
        return False, "alpha bounds the object"
    return True, "nothing bounds the surroundings"


def _box(views, use_alpha, *, ndc, contracted):
    """Returns lower [3], upper [3], and how they were found."""
    if ndc:
        return *_ends_of_rays(views), "the bounds of all rays"
    if views.box is not None and not contracted:
        return *np.asarray(views.box, np.float64), "as the dataset states"
    look_at = LookAt(views)
    if contracted:
        seen = look_at.inner_half_side
        half, why = max((seen, "as far as most images show"), (look_at.reach, "where the cameras are"))
        if half > _MAX_INNER_BOX * seen:
            half, why = _MAX_INNER_BOX * seen, f"{_MAX_INNER_BOX:g} times as far as most images show"
        why = f"not contracted within {half:.2g} of its centre, {why}"
        return look_at.center - 2 * half, look_at.center + 2 * half, why
    half = look_at.half_size.max()
    lower, upper = look_at.center - half, look_at.center + half
    if not use_alpha:
        return lower, upper, "as large as the images at the point that all cameras look at"
    return *visual_hull.hull_bounds(views, lower, upper), "the bounds of the visual hull"


def _ends_of_rays(views):
    """Returns lower [3] and upper [3] of all rays: NDC rays are straight, so the corners' rays bound all."""
    ends = []
    for index, (height, width) in enumerate(np.asarray(views.size)):
        corners = np.float32([[0, 0], [width, 0], [0, height], [width, height]])
        rays = view_rays(views, index, corners, ndc=True)
        for t in (rays.near, rays.far):
            ends.append(np.asarray(rays.origins + t[:, None] * rays.directions))
    ends = np.concatenate(ends)
    return ends.min(axis=0), ends.max(axis=0)


def mean_color(views: Views) -> tuple[float, float, float]:
    """Returns the mean colour of the views' pixels in [0, 1], alpha dropped; see `sample_pixels`."""
    return tuple(float(value) for value in sample_pixels(views)[:, :3].mean(axis=0))


def sample_pixels(views: Views) -> Float[np.ndarray, "N C"]:
    """Returns pixels of all views in [0, 1].

    Of more than 2^20 pixels some are chosen: runs of them at random places, as single pixels of a file on disk would
    take as long to read as all. Pixels that a mask excludes do not count, unless it excludes all that were chosen.
    """
    total, chosen = len(views.pixels), np.arange(len(views.pixels))
    if total > _MEAN_RUNS * _MEAN_RUN:
        starts = np.sort(np.random.default_rng(0).integers(0, total - _MEAN_RUN, _MEAN_RUNS))
        chosen = (starts[:, None] + np.arange(_MEAN_RUN)).reshape(-1)
    if views.mask is not None and views.mask[chosen].any():
        chosen = chosen[views.mask[chosen]]
    pixels = views.pixels[chosen]
    return pixels / np.iinfo(pixels.dtype).max
