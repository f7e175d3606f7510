"""Where matter begins and ends along a camera's axis, as far as a capture tells."""

import numpy as np

from jaxnerf.data.poses import gaze_center
from jaxnerf.data.world import poses_of

_STRAYS = 1.0  # percent of points at each end that may be wrong matches
_MARGIN = 0.8  # what the points miss: near is that much nearer, far as much farther
_FEWEST = 8  # points that a view must show to tell
_OTHERS = 2  # views, beside its own, that must see a place for its matter to be placed
_FARTHEST = 10.0  # times the distance to what the cameras look at, where nothing tells more


def with_bounds(capture):
    """Returns the capture with bounds in every frame, in world units along the camera's axis.

    A frame that has some keeps them. Otherwise they come from the points that it shows; or, without, near is
    where two other cameras begin to see what it sees, and far is the end of the box that the format states.
    """
    if all(frame.bounds is not None for frame in capture.frames):
        return capture
    poses = poses_of(capture)
    shared = None
    frames = []
    for index, frame in enumerate(capture.frames):
        if frame.bounds is None:
            bounds = _of_points(capture, frame)
            if bounds is None:
                shared = _shared_depths(capture, poses) if shared is None else shared
                bounds = shared[index]
            frame = frame._replace(bounds=bounds)
        frames.append(frame)
    return capture._replace(frames=tuple(frames))


def depths(camera, points):
    """Returns the distances [N] of points [N, 3] along a camera's axis, > 0 in front."""
    pose = np.asarray(camera.to_world)
    return (pose[:, 3] - points) @ pose[:, 2]


def _of_points(capture, frame):
    if capture.points is None or frame.seen is None:
        return None
    along = depths(frame.camera, capture.points[frame.seen])
    along = along[along > 0]
    if len(along) < _FEWEST:
        return None
    near, far = np.percentile(along, [_STRAYS, 100 - _STRAYS])
    return float(near * _MARGIN), float(far / _MARGIN)


def _shared_depths(capture, poses):
    """Returns (near, far) of each view from the pyramids that the cameras see."""
    middle = gaze_center(poses)
    distance = float(np.median(np.linalg.norm(poses[:, :, 3] - middle, axis=-1)))
    steps = distance * np.geomspace(1e-2, _FARTHEST, 128)
    result = []
    for index, frame in enumerate(capture.frames):
        pose, slopes = poses[index], _slopes(frame.camera)
        places = pose[:, 3] + steps[:, None, None] * (slopes @ pose[:, :3].T)
        count = sum(_sees(other.camera, places) for j, other in enumerate(capture.frames) if j != index)
        wanted = min(_OTHERS, len(poses) - 1)
        found = np.flatnonzero((count >= wanted).any(axis=1)) if wanted else []
        near = float(steps[found[0]]) if len(found) else 0.1 * distance
        far = _FARTHEST * distance
        if capture.box is not None:
            corners = np.stack(np.meshgrid(*np.transpose(capture.box), indexing="ij"), axis=-1).reshape(-1, 3)
            far = max(float(depths(frame.camera, corners).max()), 2 * near)
        result.append((near, far))
    return result


def _slopes(camera, count=5):
    """Returns directions [M, 3] in the camera's axes through a grid of pixels, that reach depth 1."""
    size = 2 * np.asarray(camera.center) if None in (camera.width, camera.height) else None
    width, height = (camera.width, camera.height) if size is None else size
    x, y = np.meshgrid(np.linspace(0, width, count), np.linspace(0, height, count))
    x, y = ((p - c) / f for p, c, f in zip((x, y), camera.center, camera.focal, strict=True))
    return np.stack([x, -y, -np.ones_like(x)], axis=-1).reshape(-1, 3)


def _sees(camera, places):
    """Returns whether places [..., 3] lie in what a camera sees, its lens taken for a pinhole."""
    pose = np.asarray(camera.to_world)
    local = (places - pose[:, 3]) @ pose[:, :3]
    depth = -local[..., 2]
    seen = depth > 0
    for axis, sign in ((0, 1), (1, -1)):
        pixel = sign * local[..., axis] / np.where(seen, depth, 1) * camera.focal[axis] + camera.center[axis]
        limit = (camera.width, camera.height)[axis] or 2 * camera.center[axis]
        seen = seen & (pixel >= 0) & (pixel <= limit)
    return seen
