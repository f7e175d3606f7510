"""The export "cameras": the cameras that a run has refined, for the dataset they come from and for other programs.

They are in the units, axes and origin of the dataset's files and at the size of its images, as transforms.json and as
a COLMAP model. The points of a COLMAP dataset are triangulated again, from their observations and the refined cameras.
"""

import dataclasses
import json
import os
import pathlib
import struct
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxnerf.core.cameras import undistort
from jaxnerf.core.types import Camera
from jaxnerf.data import dataset
from jaxnerf.data.geometry.world import poses_in_file
from jaxnerf.data.images.image_files import image_size
from jaxnerf.data.readers.base import Frame, has_split_files, read_capture
from jaxnerf.data.readers.colmap_model import MODELS
from jaxnerf.evaluation.restore import TrainedRun
from jaxnerf.runtime import atomic_files
from jaxnerf.tools.exporters.base import ExportSource

_COEFFICIENTS = {"opencv": ("k1", "k2", "p1", "p2", "k3"), "fisheye": ("k1", "k2", "k3", "k4")}
_SURE = 1e-4  # of the eigenvalues of a point's rays: below, they are nearly parallel, and the point stays


def check_refined(run: TrainedRun) -> None:
    """Raises a ValueError unless a run has refined cameras and its dataset's files are there."""
    config = run.experiment.config
    if not config.cameras.refine:
        raise ValueError("the run has not refined its cameras; train with --config.cameras.refine=True")
    if not dataset.is_there(config.data) or not config.data.dir:
        raise ValueError("the names and sizes of images are in the dataset's files; give --data_dir of the dataset")


def export_cameras(source: ExportSource, folder: pathlib.Path) -> None:
    """Writes transforms.json and sparse/0/ with cameras.bin, images.bin and points3D.bin.

    Images that were not trained on keep their poses. Paths of images are those below the dataset's folder, where
    transforms.json belongs, and below its images/ in the COLMAP model.

    Raises:
        ValueError: if an image of the run is not in the dataset.
    """
    data, views = source.run.experiment.config.data, source.views
    base = dataset.dataset_folder(data.dir)
    split = {"split": "train"} if has_split_files(data.format) else {}
    capture = read_capture(base, data.format, **split)
    origin = np.zeros(3) if capture.origin is None else np.asarray(capture.origin)
    before = [_sized(frame) for frame in capture.frames]
    places = {frame.name: index for index, frame in enumerate(capture.frames)}
    if missing := [name for name in views.names if name not in places]:
        raise ValueError(f"{base}: has no image {missing[0]!r}, which the run was trained on; give its own --data_dir")
    given = source.run.experiment.load_split("train", images=None)
    zooms = np.float64(views.cameras.focal) / np.float64(given.cameras.focal)
    zoom = np.median(zooms, axis=0)
    after = [dataclasses.replace(camera, focal=np.float64(camera.focal) * zoom) for camera in before]
    for name, pose in zip(views.names, poses_in_file(views.cameras.to_world, views.to_file), strict=True):
        after[places[name]] = dataclasses.replace(after[places[name]], to_world=pose)
    points = _report(capture, before, after, source.say)
    after = [_moved(camera, origin) for camera in after]
    files = [os.path.relpath(frame.image, base) for frame in capture.frames]
    stated = [
        _stated(frame, file, camera, base) for frame, file, camera in zip(capture.frames, files, after, strict=True)
    ]
    text = json.dumps({"frames": stated}, indent=1)
    atomic_files.write_text(folder / "transforms.json", text + "\n")
    images = "images" if all(pathlib.PurePath(file).parts[0] == "images" for file in files) else "."
    names = [os.path.relpath(file, images) for file in files]
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    write_model(model, after, names, capture.frames, None if points is None else points + origin)
    source.say(f"{len(views.names)} refined cameras of {len(after)}; copy transforms.json or sparse/ to {base}")


def _sized(frame):
    """Returns a frame's camera with the height and width of its image."""
    camera = frame.camera
    if camera.height is not None and camera.width is not None:
        return camera
    width, height = image_size(frame.image, follow_exif=frame.follow_exif, center=np.asarray(camera.center))
    return dataclasses.replace(camera, height=height, width=width)


def _moved(camera, origin):
    pose = np.array(camera.to_world, np.float64)
    pose[:, 3] += origin
    return dataclasses.replace(camera, to_world=pose)


def _stated(frame, file, camera, base):
    """Returns the entry of transforms.json for a frame."""
    (fl_x, fl_y), (cx, cy) = np.float64(camera.focal).tolist(), np.float64(camera.center).tolist()
    lens = "OPENCV_FISHEYE" if camera.lens == "fisheye" else "OPENCV"
    entry = {"file_path": file, "camera_model": lens, "w": camera.width, "h": camera.height}
    entry |= {"fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy}
    if camera.lens != "pinhole" and camera.distortion is not None:
        entry |= dict(zip(_COEFFICIENTS[camera.lens], np.float64(camera.distortion).tolist(), strict=False))
    entry |= {} if frame.mask is None else {"mask_path": os.path.relpath(frame.mask, base)}
    entry |= {} if frame.time is None else {"time": frame.time}
    return {**entry, "transform_matrix": [*np.float64(camera.to_world).tolist(), [0.0, 0.0, 0.0, 1.0]]}


def _report(capture, before, after, say):
    """Triangulates the points of a Capture with new cameras, and says how its observations fit; None without points."""
    if capture.points is None or any(frame.seen_at is None for frame in capture.frames):
        return None
    at = _on_plane(capture.frames, before), _on_plane(capture.frames, after)
    points, errors = [], []
    for cameras, places in zip((before, after), at, strict=True):
        points.append(triangulated(capture.points, capture.frames, cameras, places))
        errors.append(_errors(points[-1], capture.frames, cameras, places))
    found = [float(np.median(np.concatenate(each))) for each in errors]
    say(f"points fit their observations within {found[1]:.3f} px, before {found[0]:.3f} px (medians)")
    return points[-1]


def _on_plane(frames: Sequence[Frame], cameras: Sequence[Camera]) -> list[Float[np.ndarray, "M 2"]]:
    """Returns where the observations of each frame are on the plane at distance 1, NaN without a preimage."""

    @jax.jit
    def place(focal, center, distortion, pixel):
        camera = Camera(to_world=jnp.eye(3, 4), focal=focal, center=center, distortion=distortion, lens=lens)
        found, converged = undistort(camera, pixel[None])
        return jnp.where(converged, found[0], jnp.nan)

    result = []
    for frame, camera in zip(frames, cameras, strict=True):
        lens, center = camera.lens, np.float64(camera.center)
        if lens == "pinhole" or camera.distortion is None:
            result.append((frame.seen_at - center) / np.float64(camera.focal))
            continue
        many = jax.vmap(place, in_axes=(None, None, None, 0))
        places = many(*map(np.float32, (camera.focal, camera.center, camera.distortion, frame.seen_at)))
        result.append(np.float64(places))
    return result


def triangulated(
    points: Float[np.ndarray, "N 3"],
    frames: Sequence[Frame],
    cameras: Sequence[Camera],
    places: Sequence[Float[np.ndarray, "M 2"]],
) -> Float[np.ndarray, "N 3"]:
    """Returns the points closest to the rays of their observations, by least squares; others stay as they are."""
    matrices, sums = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    for frame, camera, place in zip(frames, cameras, places, strict=True):
        kept = np.isfinite(place).all(axis=1)
        pose, (x, y) = np.float64(camera.to_world), place[kept].T
        rays = np.stack([x, -y, -np.ones_like(x)], axis=-1) @ pose[:, :3].T
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        np.add.at(matrices, frame.seen[kept], across)
        np.add.at(sums, frame.seen[kept], across @ pose[:, 3])
    values = np.linalg.eigvalsh(matrices)
    sure = values[:, 0] > _SURE * np.maximum(values[:, 2], 1e-30)
    found = np.array(points, np.float64)
    found[sure] = np.linalg.solve(matrices[sure], sums[sure][..., None])[..., 0]
    return found


def _errors(points, frames, cameras, places):
    """Returns how far points are from their observations in each image, px without the lens."""
    found = []
    for frame, camera, place in zip(frames, cameras, places, strict=True):
        pose = np.float64(camera.to_world)
        local = (points[frame.seen] - pose[:, 3]) @ pose[:, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = np.stack([local[:, 0], -local[:, 1]], axis=-1) / -local[:, 2:]
            error = np.linalg.norm((seen - place) * np.float64(camera.focal), axis=-1)
        found.append(error[(local[:, 2] < 0) & np.isfinite(error)])
    return found


def write_model(
    folder: pathlib.Path,
    cameras: Sequence[Camera],
    names: Sequence[str],
    frames: Sequence[Frame],
    points: Float[np.ndarray, "N 3"] | None,
) -> None:
    """Writes cameras.bin, images.bin and points3D.bin of a COLMAP model; equal intrinsics are one camera.

    Args:
        folder: exists.
        cameras: of the images, with height and width.
        names: of the images, as the model states them.
        frames: for the observations of points.
        points: in the world of the cameras; None: no points, and no observations.
    """
    numbers = {name: number for number, (name, _) in MODELS.items()}
    kinds: dict[Any, int] = {}
    used = [kinds.setdefault(_intrinsics(camera), len(kinds) + 1) for camera in cameras]
    content = [struct.pack("<Q", len(kinds))]
    for (model, width, height, params), number in kinds.items():
        content.append(struct.pack(f"<IiQQ{len(params)}d", number, numbers[model], width, height, *params))
    (folder / "cameras.bin").write_bytes(b"".join(content))
    content, tracks = [struct.pack("<Q", len(cameras))], {}
    for index, (camera, name, frame) in enumerate(zip(cameras, names, frames, strict=True), 1):
        pose = np.float64(camera.to_world)
        rotation = (pose[:, :3] * [1, -1, -1]).T  # world to camera: y down, z forwards
        content.append(struct.pack("<I7dI", index, *quaternion(rotation), *(-rotation @ pose[:, 3]), used[index - 1]))
        content.append(name.encode() + b"\0")
        seen = np.zeros(0, int) if points is None else np.asarray(frame.seen)
        content.append(struct.pack("<Q", len(seen)))
        for place, (point, at) in enumerate(zip(seen.tolist(), frame.seen_at if len(seen) else (), strict=True)):
            content.append(struct.pack("<ddq", *at, point + 1))
            tracks.setdefault(point, []).append((index, place))
    (folder / "images.bin").write_bytes(b"".join(content))
    content = [struct.pack("<Q", len(tracks))]
    for point, track in sorted(tracks.items()):
        content.append(struct.pack("<q3d3BdQ", point + 1, *points[point], 128, 128, 128, 0.0, len(track)))
        content.append(b"".join(struct.pack("<II", *each) for each in track))
    (folder / "points3D.bin").write_bytes(b"".join(content))


def _intrinsics(camera):
    """Returns the model, size and parameters of a camera as COLMAP states them."""
    terms = () if camera.lens == "pinhole" or camera.distortion is None else np.float64(camera.distortion).tolist()
    model = {0: "PINHOLE", 4: "OPENCV", 5: "FULL_OPENCV"}[len(terms)]
    model = "OPENCV_FISHEYE" if camera.lens == "fisheye" and terms else model
    terms = (*terms, 0.0, 0.0, 0.0) if len(terms) == 5 else tuple(terms)
    sides = np.float64([camera.focal, camera.center]).reshape(-1).tolist()
    return model, camera.width, camera.height, (*sides, *terms)


def quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Returns w, x, y, z of the rotation nearest to a matrix, in float64: the eigenvector of Bar-Itzhack (2000)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    found = np.linalg.eigh(matrix / 3)[1][:, -1]
    return found if found[0] >= 0 else -found
