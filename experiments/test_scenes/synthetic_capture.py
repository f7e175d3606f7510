"""Captures of the embedded room or house as a phone makes them, written as a dataset with its ground truth beside it.

In the room a camera is carried around the table and looks roughly at it; through the house it is carried along a path
and looks around. Further views, which no training view is close to, measure
the reconstruction of free space and depth. ground_truth.npz holds what is unknown for a real capture: poses, exposures,
the depth of every pixel, and how many training views see its surface.
"""

import json
import math
import os
import pathlib
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from PIL import Image

from jaxnerf.core.cameras import pixel_grid, undistort
from jaxnerf.core.types import Camera
from jaxnerf.runtime.atomic_files import open_regular, partial_file, write_text
from jaxnerf.tools.exporters.points import write_ply
from test_scenes import house, room

PHONE_LENS = (-0.08, 0.03, 0.001, -0.0008)  # k1, k2, p1, p2
GROUND_TRUTH = "ground_truth.npz"
SPLITS = ("train", "val", "test")
_FOCAL = 0.82  # over the width: a horizontal field of view of 63 degrees
_ARC = 110.0  # degrees of azimuth to both sides that the training views cover
_FAR_ARC = 135.0  # the same, of the far views
_APART = 0.5  # world units from a far view to the nearest training view
_CLEARANCE = 0.15  # world units of free space around every camera
_NEAREST = 0.3  # world units from a far view to what it shows
_MIN_SEEN = 2  # training views that must see a surface for a far view to show it
_SEEN_FRACTION = 0.9  # of a far view's pixels
_SAME_DEPTH = 0.03  # relative difference of depths that are of one surface
_POINT_NOISE = 0.002  # standard deviation of a sparse point's position, over its depth
_SHIFT = 0.01  # world units of pose noise per degree
_SUFFIXES = {"png": ("PNG", {}), "jpg": ("JPEG", {"quality": 95, "subsampling": 0})}


class GroundTruth(NamedTuple):
    """What is known about a written capture. Views are in the order train, val, test; units are the file's.

    Attributes:
        names: [V] as in `Views.names`.
        split: [V] "train", "val" (near the path) or "test" (far from it).
        to_world: [V, 3, 4] the true poses. The file's deviate from them by the pose noise.
        file_to_world: [V, 3, 4] the poses in the file.
        focal, center: [2] px.
        distortion: [4] k1, k2, p1, p2; zeros for a pinhole.
        gains: [V, 3] factors of red, green and blue in the image, 1 outside of "train".
        depth: [V, H, W] along the camera's axis from the true pose, the t of `rays_from_pixels`.
        num_seen: [V, H, W] training views that see the pixel's surface; zeros for "train" itself.
        points: [N, 3] the sparse points, as in the file.
        points_seen: [num_train, N] the training views that see a point.
    """

    names: np.ndarray
    split: np.ndarray
    to_world: Float[np.ndarray, "V 3 4"]
    file_to_world: Float[np.ndarray, "V 3 4"]
    focal: Float[np.ndarray, "2"]
    center: Float[np.ndarray, "2"]
    distortion: Float[np.ndarray, "4"]
    gains: Float[np.ndarray, "V 3"]
    depth: Float[np.ndarray, "V H W"]
    num_seen: Int[np.ndarray, "V H W"]
    points: Float[np.ndarray, "N 3"]
    points_seen: Bool[np.ndarray, "T N"]


def read_ground_truth(folder: str | os.PathLike) -> GroundTruth:
    """Reads the GroundTruth of a capture that `write_capture` wrote.

    Raises:
        ValueError: if the folder has no such file.
    """
    path = pathlib.Path(folder) / GROUND_TRUTH
    if not path.is_file():
        raise ValueError(f"{path}: no such file, expected the ground truth of an embedded capture; write one first")
    with open_regular(path, "rb") as file, np.load(file) as arrays:
        return GroundTruth(**{name: arrays[name] for name in GroundTruth._fields})


def write_capture(
    folder: str | os.PathLike,
    *,
    num_views: int = 70,
    num_held_out: int = 10,
    num_far: int = 12,
    width: int = 200,
    height: int = 150,
    distortion: tuple[float, float, float, float] | None = PHONE_LENS,
    exposure: float = 0.0,
    white_balance: float = 0.0,
    pose_noise: float = 0.0,
    num_points: int = 4000,
    repetition: float = 0.0,
    image_format: str = "png",
    seed: int = 0,
    place: str = "room",
) -> GroundTruth:
    """Writes a capture of the room or house in nerfstudio's format: transforms.json, images/, and GROUND_TRUTH.

    Each pixel is a single ray through its center, as the pixels of a trained model are. Cameras depend on the
    seed and the numbers of views alone, so captures that differ in exposure, noise or lens show the same views.

    Args:
        folder: made if missing, and empty otherwise.
        num_views: of the split "train", along the path.
        num_held_out: of "val", between training views and up to some hundredths of a unit beside the path.
        num_far: of "test", at other heights, distances and azimuths. At least 90 % of their pixels show a surface
            that two training views see.
        width, height: px.
        distortion: k1, k2, p1, p2; None: a pinhole.
        exposure: standard deviation over the training views of the exposure, in stops. It drifts along the path,
            and its geometric mean is 1. Values that exceed 1 are clipped.
        white_balance: standard deviation of red and of blue against green, in stops.
        pose_noise: standard deviation about each axis of the errors of the training views' poses in the file, in
            degrees; positions have errors of 0.01 world units per degree.
        num_points: sparse points on textured surfaces that three training views see; 0: none.
        repetition: period of equal dots that replace the colours of all surfaces, world units; 0: the room's own
            colours. Matches between such images are ambiguous.
        image_format: "png", or "jpg" with quality 95.
        seed: of everything random.
        place: of PLACES.

    Returns:
        GroundTruth, as `read_ground_truth` reads it.

    Raises:
        ValueError: on wrong arguments, or if the folder is not empty.
        OSError: if it cannot be written, or is not empty any more; names the file.
    """
    folder = pathlib.Path(folder)
    _check(folder, (num_views, num_held_out, num_far), width, height, image_format)
    lens, tour = _Lens.make(width, height, distortion), PLACES[place]
    path = _path_poses(tour, num_views, num_held_out, seed)
    rgb, depth = _render_all(tour.place, lens, path)
    train = path[:num_views], depth[:num_views]
    far = _far_poses(tour, num_far, lens, *train, seed)
    far_rgb, far_depth = _render_all(tour.place, lens, far)
    poses, rgb, depth = (np.concatenate(pair) for pair in ((path, far), (rgb, far_rgb), (depth, far_depth)))
    if repetition:
        surfaces = (_surface(lens, *view) for view in zip(poses, depth, strict=True))
        rgb = np.stack([_dots(x, repetition) for x in surfaces]).reshape(rgb.shape)
    num_seen = np.zeros(depth.shape, np.uint16)
    for index in range(num_views, len(poses)):
        seen = _seen_by(_surface(lens, poses[index], depth[index]), lens, *train)
        num_seen[index] = seen.sum(axis=0).reshape(height, width)
    gains = np.ones((len(poses), 3))
    gains[:num_views] = _gains(num_views, exposure, white_balance, seed)
    points, colors, points_seen = _sparse_points(num_points, lens, rgb[:num_views], *train, seed)
    counts = (num_views, num_held_out, num_far)
    truth = GroundTruth(
        names=np.array([f"{name}_{k:03d}" for name, n in zip(SPLITS, counts, strict=True) for k in range(n)]),
        split=np.repeat(SPLITS, counts),
        to_world=poses,
        file_to_world=np.concatenate([_noisy(path[:num_views], pose_noise, seed), poses[num_views:]]),
        focal=lens.focal,
        center=lens.center,
        distortion=lens.distortion,
        gains=gains,
        depth=depth.astype(np.float32),
        num_seen=num_seen,
        points=points,
        points_seen=points_seen,
    )
    _write(folder, truth, rgb, colors, image_format)
    return truth


def _check(folder, counts, width, height, image_format):
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder}: exists and is not an empty folder; remove it, or write to another one")
    if image_format not in _SUFFIXES:
        raise ValueError(f"image_format is {image_format!r}, expected one of {', '.join(_SUFFIXES)}")
    if min(width, height) < 8 or counts[0] < 8 or min(counts) < 0:
        raise ValueError(
            f"the capture has {counts[0]} views of {width} x {height} px, {counts[1]} held out and {counts[2]} far; "
            "expected at least 8 views of 8 x 8 px, and no negative number"
        )


class _Lens(NamedTuple):
    """The intrinsics of all views.

    Attributes:
        width, height: px.
        focal, center: [2] px.
        distortion: [4].
        slopes: [H, W, 3] directions of the pixels' rays in camera axes, of depth 1.
    """

    width: int
    height: int
    focal: np.ndarray
    center: np.ndarray
    distortion: np.ndarray
    slopes: np.ndarray

    @classmethod
    def make(cls, width, height, distortion):
        focal = np.full(2, _FOCAL * width)
        center = np.array([0.5 * width, 0.5 * height])
        kind = "pinhole" if distortion is None else "opencv"
        distortion = np.zeros(4) if distortion is None else np.array(distortion, np.float64)
        camera = Camera(
            to_world=np.eye(3, 4, dtype=np.float32),
            focal=np.float32(focal),
            center=np.float32(center),
            distortion=np.float32(distortion),
            lens=kind,
        )
        plane, found = jax.jit(undistort)(camera, pixel_grid(height, width))
        if not found.all():
            raise ValueError(f"distortion is {distortion.tolist()}, which folds the image; expected a weaker lens")
        x, y = np.moveaxis(np.asarray(plane, np.float64), -1, 0)
        return cls(width, height, focal, center, distortion, np.stack([x, -y, -np.ones_like(x)], axis=-1))


def _render_all(place, lens, poses):
    """Returns the colours [V, H, W, 3] and depths [V, H, W] of views."""
    images = []
    for pose in poses:
        directions = lens.slopes @ pose[:, :3].T
        images.append(room.render(np.broadcast_to(pose[:, 3], directions.shape), directions, place))
    rgb, depth = zip(*images, strict=True) if images else ((), ())
    form = (len(poses), lens.height, lens.width)
    return np.reshape(rgb, (*form, 3)), np.reshape(depth, form)


def _surface(lens, pose, depth):
    """Returns the surface points [H * W, 3] of a depth map."""
    return (pose[:, 3] + depth[..., None] * (lens.slopes @ pose[:, :3].T)).reshape(-1, 3)


def _dots(x, period):
    """Returns the colour [..., 3] of surface points [..., 3]: equal blurred dots on a lattice."""
    phase = np.cos(2 * np.pi * x / period).sum(axis=-1, keepdims=True)
    shade = 1 / (1 + np.exp(-4 * (phase - 1)))
    return np.array([0.85, 0.8, 0.7]) + shade * (np.array([0.25, 0.2, 0.35]) - [0.85, 0.8, 0.7])


def _seen_by(x, lens, poses, depths):
    """Returns [V, N], whether views with given depth maps see points [N, 3]."""
    seen = np.zeros((len(poses), len(x)), bool)
    k1, k2, p1, p2 = lens.distortion
    for index, (pose, depth) in enumerate(zip(poses, depths, strict=True)):
        local = (x - pose[:, 3]) @ pose[:, :3]
        front = np.flatnonzero(local[:, 2] < -1e-3)
        z = -local[front, 2]
        u, v = local[front, 0] / z, -local[front, 1] / z
        square = u * u + v * v
        radial = 1 + square * (k1 + square * k2)
        at_x = lens.focal[0] * (u * radial + 2 * p1 * u * v + p2 * (square + 2 * u * u)) + lens.center[0]
        at_y = lens.focal[1] * (v * radial + 2 * p2 * u * v + p1 * (square + 2 * v * v)) + lens.center[1]
        # Far outside the image the polynomial of a lens may fold back into it.
        within = (square < 1) & (at_x >= 0) & (at_x < lens.width) & (at_y >= 0) & (at_y < lens.height)
        column, row = np.int64(at_x[within]), np.int64(at_y[within])
        seen[index, front[within]] = np.abs(depth[row, column] / z[within] - 1) < _SAME_DEPTH
    return seen


class _Tour(NamedTuple):
    """How a camera is carried through a place.

    Attributes:
        place: None: the room.
        path: (progress in [0, 1], [5] values of smooth random functions) -> eye [3], target [3].
        far: (random numbers, fraction of the views) -> eye [3], target [3] of a view apart from the path.
    """

    place: room.Place | None
    path: Callable[..., tuple[np.ndarray, np.ndarray]]
    far: Callable[..., tuple[np.ndarray, np.ndarray]]


def _around_table(progress, waves):
    distance, height, *aim = waves
    eye = _around(math.radians(_ARC * (2 * progress - 1)), 1.85 + 0.18 * distance, 1.45 + 0.22 * height)
    return eye, 0.12 * np.array(aim) + [0, 0, room.TABLE_TOP + 0.05]


def _far_from_table(rng, fraction):
    eye = _around(math.radians(_FAR_ARC * (2 * fraction - 1)), rng.uniform(0.9, 3.0), rng.uniform(0.6, 2.7))
    return eye, np.array([0, 0, room.TABLE_TOP])


def _through_house(progress, waves):
    """Returns a place on the path at eye height, and one straight ahead of it, or up to 130 degrees to its sides."""
    _, height, turn, pitch, _ = waves
    before, at, after = house.along_path(np.clip([progress - 0.005, progress, progress + 0.005], 0, 1))
    yaw = math.atan2(*(after - before)[::-1]) + math.radians(130) * math.sin(60 * progress + turn)
    ahead = [math.cos(yaw), math.sin(yaw), 0.2 * pitch - 0.15]
    eye = np.array([*at, house.FLOOR + 1.5 + 0.1 * height])
    return eye, eye + ahead


def _beside_path(rng, fraction):
    at, height = house.along_path(np.array([fraction]))[0], house.FLOOR + rng.uniform(0.9, 2.0)
    eye = np.array([*(at + rng.uniform(-1.2, 1.2, 2)), height])
    yaw = rng.uniform(-math.pi, math.pi)
    return eye, eye + 3 * np.array([math.cos(yaw), math.sin(yaw), rng.uniform(-0.4, 0.1)])


PLACES = {
    "room": _Tour(None, _around_table, _far_from_table),
    "house": _Tour(house.HOUSE, _through_house, _beside_path),
}


def _path_poses(tour, num_views, num_held_out, seed):
    """Returns the poses of the training views along a hand-held path, and of views between them."""
    rng = np.random.default_rng([seed, 0])
    waves = [_wave(rng) for _ in range(6)]
    between = (np.arange(num_held_out) + rng.uniform(0.3, 0.7, num_held_out)) / max(num_held_out, 1)
    # In the middle between two training views.
    between = (np.floor(between * (num_views - 1)) + 0.5) / (num_views - 1)
    poses = []
    for progress, shake in ((np.linspace(0, 1, num_views), 0.02), (between, 0.05)):
        *along, roll = (wave(progress) for wave in waves)
        for k, at in enumerate(progress):
            eye, target = tour.path(at, [part[k] for part in along])

            def draw(eye=eye, shake=shake):
                return eye + shake * rng.normal(size=3)

            target = target + 0.03 * rng.normal(size=3)
            eye = _in_free_space(tour.place, draw)
            poses.append(_look_at(eye, target, math.radians(2.5 * roll[k] + rng.normal())))
    return np.array(poses)


def _far_poses(tour, count, lens, poses, depths, seed):
    """Returns the poses of views that are apart from the training views and mostly show what those see."""
    rng, chosen = np.random.default_rng([seed, 1]), []
    coarse = lens._replace(slopes=lens.slopes[:: max(lens.height // 12, 1), :: max(lens.width // 16, 1)])
    for index in range(count):
        aim = {}

        def draw(index=index, aim=aim):
            eye, aim["target"] = tour.far(rng, (index + rng.uniform()) / count)
            return eye

        for _ in range(300):
            eye = _in_free_space(tour.place, draw)
            target = aim["target"] + 0.2 * rng.normal(size=3)
            pose = _look_at(eye, target, math.radians(3 * rng.normal()))
            if np.linalg.norm(poses[:, :, 3] - eye, axis=-1).min() < _APART:
                continue
            directions = coarse.slopes @ pose[:, :3].T
            depth = room.trace(np.broadcast_to(pose[:, 3], directions.shape), directions, tour.place).t
            if depth.min() < _NEAREST:
                continue
            seen = _seen_by(_surface(coarse, pose, depth), lens, poses, depths).sum(axis=0)
            if (seen >= _MIN_SEEN).mean() >= _SEEN_FRACTION:
                chosen.append(pose)
                break
        else:
            raise ValueError(
                f"found no far view {index} of {count} whose surfaces the {len(poses)} views see; expected more views"
            )
    return np.reshape(chosen, (count, 3, 4))


def _in_free_space(place, draw):
    """Returns the first position that draw() returns with free space around it."""
    ball = np.random.default_rng(0).normal(size=(64, 3))
    ball *= _CLEARANCE / np.linalg.norm(ball, axis=-1, keepdims=True)
    for _ in range(1000):
        eye = draw()
        if not room.is_matter(np.concatenate([eye + ball, eye + ball / 2, [eye]]), place).any():
            return eye
    raise ValueError("found no position in free space; expected another seed")


def _wave(rng):
    """Returns a random smooth function on [0, 1] with values in about [-1, 1]."""
    frequencies, phases = rng.uniform([1.0, 2.5], [2.0, 5.0]), rng.uniform(0, 2 * math.pi, 2)
    return lambda s: 0.65 * np.sin(2 * math.pi * np.multiply.outer(s, frequencies) + phases).sum(axis=-1)


def _around(azimuth, distance, height):
    return np.array([distance * math.cos(azimuth), distance * math.sin(azimuth), height])


def _look_at(eye, target, roll):
    """Returns the pose [3, 4] in float64 of a camera with a horizon that is turned by roll, in radians."""
    back = eye - target
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    cos, sin = math.cos(roll), math.sin(roll)
    return np.stack([cos * right + sin * up, cos * up - sin * right, back, eye], axis=-1)


def _noisy(poses, degrees, seed):
    """Returns poses with errors, see `write_capture`."""
    rng = np.random.default_rng([seed, 2])
    turns = np.radians(degrees) * rng.normal(size=(len(poses), 3))
    shifts = _SHIFT * degrees * rng.normal(size=(len(poses), 3))
    noisy = poses.copy()
    for pose, (x, y, z), shift in zip(noisy, turns, shifts, strict=True):
        # The Cayley transform of a skew matrix is exactly a rotation.
        half = 0.5 * np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        pose[:, :3] = pose[:, :3] @ np.linalg.solve(np.eye(3) - half, np.eye(3) + half)
        pose[:, 3] += shift
    return noisy


def _gains(count, exposure, white_balance, seed):
    """Returns the gains [V, 3] of the training views: smooth drifts with a geometric mean of 1."""
    rng = np.random.default_rng([seed, 3])
    drifts = np.stack([_wave(rng)(np.linspace(0, 1, count)) for _ in range(3)], axis=-1)
    drifts = drifts + 0.2 * rng.normal(size=drifts.shape)
    drifts = (drifts - drifts.mean(axis=0)) / drifts.std(axis=0)
    stops = exposure * drifts[:, :1] + white_balance * drifts * [0, 1, 1]
    return 2 ** stops[:, [1, 0, 2]]  # the second drift is of red, and green has that of the exposure alone


def _sparse_points(count, lens, rgb, poses, depths, seed):
    """Returns points [N, 3] on textured surfaces, their colours [N, 3] uint8, and the views [V, N] that see them."""
    rng, found, colors = np.random.default_rng([seed, 4]), [], []
    each = -(-2 * count // len(poses))  # about half of them are kept
    for image, pose, depth in zip(rgb, poses, depths, strict=True):
        down, across = np.gradient(image.mean(axis=-1))
        texture = (np.hypot(down, across) + 0.01).reshape(-1)
        index = rng.choice(texture.size, min(each, texture.size), replace=False, p=texture / texture.sum())
        noise = _POINT_NOISE * depth.reshape(-1)[index, None] * rng.normal(size=(len(index), 3))
        found.append(_surface(lens, pose, depth)[index] + noise)
        colors.append(np.uint8(np.rint(255 * image.reshape(-1, 3)[index])))
    xyz, colors = np.concatenate(found), np.concatenate(colors)
    seen = _seen_by(xyz, lens, poses, depths)
    kept = np.flatnonzero(seen.sum(axis=0) >= 3)
    kept = np.sort(rng.permutation(kept)[:count])
    return xyz[kept], colors[kept], seen[:, kept]


def _write(folder, truth, rgb, colors, image_format):
    """Writes the files of a capture, transforms.json last: without it, the folder is no dataset."""
    (folder / "images").mkdir(parents=True)  # an error if there is now a link, through which images would be written
    kind, options = _SUFFIXES[image_format]
    for name, image, gain in zip(truth.names, rgb, truth.gains, strict=True):
        pixels = np.uint8(np.rint(255 * np.clip(image * gain, 0, 1)))
        with partial_file(folder / "images" / f"{name}.{image_format}") as partial:
            Image.fromarray(pixels).save(partial, format=kind, **options)
    with partial_file(folder / GROUND_TRUTH, suffix=".tmp.npz") as partial:
        np.savez_compressed(partial, **truth._asdict())
    if len(truth.points):
        properties = dict(zip("xyz", truth.points.T, strict=True))
        with partial_file(folder / "sparse_pc.ply") as partial:
            write_ply(partial, properties | dict(zip(("red", "green", "blue"), colors.T, strict=True)))
    write_text(folder / "transforms.json", json.dumps(_transforms(truth, image_format), indent=1) + "\n")


def _transforms(truth, image_format):
    """Returns the content of transforms.json."""
    height, width = truth.depth.shape[1:]
    paths = [f"images/{name}.{image_format}" for name in truth.names]
    pinhole = not truth.distortion.any()
    content = {"camera_model": "PINHOLE" if pinhole else "OPENCV", "w": width, "h": height}
    content |= dict(zip(("fl_x", "fl_y", "cx", "cy"), [*truth.focal.tolist(), *truth.center.tolist()], strict=True))
    if not pinhole:
        content |= dict(zip(("k1", "k2", "p1", "p2"), truth.distortion.tolist(), strict=True))
    if len(truth.points):
        content["ply_file_path"] = "sparse_pc.ply"
    for split in SPLITS:
        content[f"{split}_filenames"] = [path for path, own in zip(paths, truth.split, strict=True) if own == split]
    poses = truth.file_to_world.tolist()
    content["frames"] = [
        {"file_path": path, "transform_matrix": [*pose, [0.0, 0.0, 0.0, 1.0]]}
        for path, pose in zip(paths, poses, strict=True)
    ]
    return content
