"""Where matter begins and ends along a camera's axis, as far as a capture tells."""

import numpy as np

from jaxnerf.data.geometry.poses import gaze_center
from jaxnerf.data.geometry.world import poses_of

_STRAYS = 1.0  # percent of points at each end that may be wrong matches
_MARGIN = 0.8  # what the points miss: near is that much nearer, far as much farther
_FEWEST = 8  # points that a view must show to tell
_OTHERS = 2  # views, beside its own, that must see a place for its matter to be placed
_WITNESSES = 64  # other views at most, spread over all
_FARTHEST = 10.0  # times the distance to what the cameras look at, where nothing tells more


def with_bounds(capture):
    """Returns the capture with bounds in every frame, in world units along the camera's axis.

    A frame that has some keeps them. Otherwise they come from the points that it shows; or, without, near is
    where two other cameras begin to see what it sees, and far is the end of the box that the format states.
    """
    if all(frame.bounds is not None for frame in capture.frames):
        return capture
    found = [frame.bounds or _of_points(capture, frame) for frame in capture.frames]
    unknown = [index for index, bounds in enumerate(found) if bounds is None]
    for index, bounds in zip(unknown, _shared_depths(capture, unknown), strict=True):
        found[index] = bounds
    frames = [frame._replace(bounds=bounds) for frame, bounds in zip(capture.frames, found, strict=True)]
    return capture._replace(frames=tuple(frames))


def given(capture, near, far, to_file):
    """Returns the capture with near and far in place of its frames' bounds, each where it is not 0.

    Args:
        capture: Capture with bounds in every frame.
        near, far: in units of the capture's file, along the axis.
        to_file: [4, 4] from the capture's world to the file's.

    Raises:
        ValueError: if a frame's near is not less than its far then.
    """
    unit = np.cbrt(np.linalg.det(np.asarray(to_file)[:3, :3]))
    frames = []
    for frame in capture.frames:
        bounds = near / unit or frame.bounds[0], far / unit or frame.bounds[1]
        if not 0 <= bounds[0] < bounds[1]:
            raise ValueError(
                f"{capture.source}: {frame.name} has near {bounds[0] * unit:g} and far {bounds[1] * unit:g}, "
                "wanted near < far; correct data.near and data.far, or set them to 0"
            )
        frames.append(frame._replace(bounds=bounds))
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


def _shared_depths(capture, chosen):
    """Returns (near, far) of each of the chosen views, from the pyramids that the cameras see."""
    poses = poses_of(capture)
    middle = gaze_center(poses)
    distance = float(np.median(np.linalg.norm(poses[:, :, 3] - middle, axis=-1)))
    distance = max(distance, 1e-6 * (1 + float(np.abs(poses[:, :, 3]).max())))  # all may stand in one place
    # Cameras that look away from each other say nothing of how far off it is what they see.
    inwards = ((poses[:, :, 3] - middle) * poses[:, :, 2]).sum(axis=-1) > 0
    farthest = distance * (_FARTHEST if inwards.mean() > 0.5 else _FARTHEST**3)
    steps = distance * np.geomspace(1e-2, _FARTHEST, 128)
    others = np.unique(np.linspace(0, len(poses) - 1, _WITNESSES).astype(int))
    result = []
    for index in chosen:
        camera = capture.frames[index].camera
        slopes = _slopes(camera) @ poses[index, :, :3].T
        places = poses[index, :, 3] + steps[:, None, None] * slopes
        witnesses = others[others != index]
        count = sum(_sees(capture.frames[other].camera, places) for other in witnesses)
        found = np.flatnonzero((count >= min(_OTHERS, len(witnesses))).any(axis=1)) if len(witnesses) else []
        near = float(steps[found[0]]) if len(found) else 0.1 * distance
        far = farthest
        if capture.box is not None:
            corners = np.stack(np.meshgrid(*np.transpose(capture.box), indexing="ij"), axis=-1).reshape(-1, 3)
            far = max(float(depths(camera, corners).max()), 2 * near)
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
