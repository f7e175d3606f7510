"""Bounds of the matter along each camera's axis, as the dataset states or implies them."""

import numpy as np
from jaxtyping import Float

from jaxnerf.core.types import Camera
from jaxnerf.data.geometry.poses import gaze_center
from jaxnerf.data.geometry.world import poses_of, unit_of
from jaxnerf.data.readers.base import Capture

_OUTLIERS = 1.0  # percent of points at each end that may be wrong matches
_MARGIN = 0.8  # for matter without points: near is multiplied, far divided by it
_MIN_POINTS = 8  # points that a view must show for bounds
_MIN_WITNESSES = 2  # other views that must see a place
_MAX_WITNESSES = 64  # other views that are considered, spread over all
_FARTHEST = 10.0  # far over the distance to what the cameras look at, if nothing else is known


def with_bounds(capture: Capture) -> Capture:
    """Returns the Capture with bounds in every frame, in world units along the camera's axis.

    Existing bounds are kept. Otherwise they come from the points that the frame shows, or are those of the Capture.
    Without either, near is the depth from which two other cameras see what the frame sees, and far is the end of the
    dataset's box.
    """
    if all(frame.bounds is not None for frame in capture.frames):
        return capture
    found = [frame.bounds or _of_points(capture, frame) or capture.bounds for frame in capture.frames]
    unknown = [index for index, bounds in enumerate(found) if bounds is None]
    for index, bounds in zip(unknown, _shared_depths(capture, unknown), strict=True):
        found[index] = bounds
    frames = [frame._replace(bounds=bounds) for frame, bounds in zip(capture.frames, found, strict=True)]
    return capture._replace(frames=tuple(frames))


def known_bounds(capture: Capture) -> list[bool]:
    """Returns for each frame whether its bounds are stated or follow from the points that it shows."""
    return [frame.bounds is not None or _of_points(capture, frame) is not None for frame in capture.frames]


def unsuited_to_ndc(capture: Capture) -> str:
    """Returns why NDC do not suit cameras that look one way; empty if they do.

    NDC spread depths between near and infinity, so nothing in front of near exists in them: without points or stated
    bounds of most views it is unknown. They suit scenes that are deep beside how far their cameras are apart. In a
    survey, as from above the ground, the farthest matter is less than twice as far as the nearest, and the cameras are
    farther apart than half of that distance; or less than four times, if the cameras are farther apart than all of it:
    bounds from points have margins, which alone make far 1.6 times near.
    """
    if np.mean(known_bounds(capture)) < 0.5:
        return "nothing tells how far away what they see is, which NDC need"
    near, far = np.median([frame.bounds for frame in with_bounds(capture).frames], axis=0)
    positions = poses_of(capture)[:, :, 3]
    apart = np.linalg.norm(positions - positions.mean(axis=0), axis=1).max() * 2
    survey = 0 < far < (4 if apart > near else 2) * near and apart > near / 2
    return "at a layer that is thin beside how far they are apart" if survey else ""


def override_bounds(capture: Capture, near: float, far: float, to_file: Float[np.ndarray, "4 4"]) -> Capture:
    """Returns the Capture with near and far in place of its frames' bounds, each unless it is 0.

    Args:
        capture: with bounds in every frame.
        near, far: in the file's units, along the axis.
        to_file: from the Capture's world to the file's.

    Raises:
        ValueError: if a frame's near is not less than its far.
    """
    unit = unit_of(to_file)
    frames = []
    for frame in capture.frames:
        bounds = near / unit or frame.bounds[0], far / unit or frame.bounds[1]
        if not 0 <= bounds[0] < bounds[1] < np.inf:
            raise ValueError(
                f"{capture.source}: {frame.name} has near {bounds[0] * unit:g} and far {bounds[1] * unit:g}, "
                "expected near < far; correct data.near and data.far, or set them to 0"
            )
        frames.append(frame._replace(bounds=bounds))
    return capture._replace(frames=tuple(frames))


def depths(camera: Camera, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Returns the distances of points along a camera's axis, positive in front of it."""
    pose = np.asarray(camera.to_world)
    return (pose[:, 3] - points) @ pose[:, 2]


def _of_points(capture, frame):
    if capture.points is None or frame.seen is None:
        return None
    along = depths(frame.camera, capture.points[frame.seen])
    along = along[along > 0]
    if len(along) < _MIN_POINTS:
        return None
    near, far = np.percentile(along, [_OUTLIERS, 100 - _OUTLIERS])
    return float(near * _MARGIN), float(far / _MARGIN)


def _shared_depths(capture, chosen):
    """Returns (near, far) of each of the chosen views, from the intersections of the cameras' frusta."""
    poses = poses_of(capture)
    middle = gaze_center(poses)
    distance = float(np.median(np.linalg.norm(poses[:, :, 3] - middle, axis=-1)))
    distance = max(distance, 1e-6 * (1 + float(np.abs(poses[:, :, 3]).max())))  # all may be in one place
    # The axes of cameras that look outwards do not bound the distance of what they see.
    inwards = ((poses[:, :, 3] - middle) * poses[:, :, 2]).sum(axis=-1) > 0
    farthest = distance * (_FARTHEST if inwards.mean() > 0.5 else _FARTHEST**3)
    steps = distance * np.geomspace(1e-2, _FARTHEST, 128)
    others = np.unique(np.linspace(0, len(poses) - 1, _MAX_WITNESSES).astype(int))
    result = []
    for index in chosen:
        camera = capture.frames[index].camera
        slopes = _slopes(camera) @ poses[index, :, :3].T
        places = poses[index, :, 3] + steps[:, None, None] * slopes
        witnesses = others[others != index]
        count = sum(_sees(capture.frames[other].camera, places) for other in witnesses)
        found = np.flatnonzero((count >= min(_MIN_WITNESSES, len(witnesses))).any(axis=1)) if len(witnesses) else []
        near = float(steps[found[0]]) if len(found) else 0.1 * distance
        far = farthest
        if capture.box is not None:
            corners = np.stack(np.meshgrid(*np.transpose(capture.box), indexing="ij"), axis=-1).reshape(-1, 3)
            far = max(float(depths(camera, corners).max()), 2 * near)
        result.append((near, far))
    return result


def _slopes(camera, count=5):
    """Returns directions [M, 3] in the camera's axes through a grid of pixels; each ends at depth 1."""
    size = 2 * np.asarray(camera.center) if None in (camera.width, camera.height) else None
    width, height = (camera.width, camera.height) if size is None else size
    x, y = np.meshgrid(np.linspace(0, width, count), np.linspace(0, height, count))
    x, y = ((p - c) / f for p, c, f in zip((x, y), camera.center, camera.focal, strict=True))
    return np.stack([x, -y, -np.ones_like(x)], axis=-1).reshape(-1, 3)


def _sees(camera, places):
    """Returns whether points [..., 3] lie in a camera's frustum; distortion is ignored."""
    pose = np.asarray(camera.to_world)
    local = (places - pose[:, 3]) @ pose[:, :3]
    depth = -local[..., 2]
    seen = depth > 0
    for axis, sign in ((0, 1), (1, -1)):
        pixel = sign * local[..., axis] / np.where(seen, depth, 1) * camera.focal[axis] + camera.center[axis]
        limit = (camera.width, camera.height)[axis] or 2 * camera.center[axis]
        seen = seen & (pixel >= 0) & (pixel <= limit)
    return seen
