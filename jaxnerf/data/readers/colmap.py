"""Captures with a sparse model of COLMAP, binary or text, beside a folder of photographs."""

import os
from pathlib import Path

import numpy as np

from jaxnerf.core.types import Camera
from jaxnerf.data.geometry.poses import check_pose
from jaxnerf.data.readers.base import Capture, Frame
from jaxnerf.data.readers.colmap_model import (
    AGAIN,
    UNDISTORT,
    count_images,
    model_file,
    model_suffix,
    read_model,
)
from jaxnerf.data.readers.validation import check_inside, is_number
from jaxnerf.registry import Reader

_LENSES = {  # kinds of cameras: how many focal lengths come before the centre, and our lens
    "SIMPLE_PINHOLE": (1, "pinhole"),
    "PINHOLE": (2, "pinhole"),
    "SIMPLE_RADIAL": (1, "opencv"),
    "RADIAL": (1, "opencv"),
    "OPENCV": (2, "opencv"),
    "FULL_OPENCV": (2, "opencv"),
    "SIMPLE_FISHEYE": (1, "fisheye"),
    "FISHEYE": (2, "fisheye"),
    "SIMPLE_RADIAL_FISHEYE": (1, "fisheye"),
    "RADIAL_FISHEYE": (1, "fisheye"),
    "OPENCV_FISHEYE": (2, "fisheye"),
}


def find_model(folder):
    """Returns the folder of the COLMAP model that `read_capture` would read, None where there is none.

    Of several models sparse/0, sparse/1, ... it is the one with most images.

    Raises:
        ValueError: if there are several, and one's images cannot be counted.
    """
    models = models_in(Path(folder))
    return models[0] if len(models) == 1 else max(models, key=count_images, default=None)


def read_capture(folder):
    """Returns what a COLMAP model says about the photographs in folder/images, or else in folder itself.

    Args:
        folder: has cameras, images and points3D, as .bin or else .txt, in sparse/0, sparse,
            colmap/sparse/0, colmap/sparse or itself.

    Returns:
        A Capture in the model's world. A registered image whose file is missing is left out, with a note. So
        is an observation of a point that points3D lacks: people thin and clean their points, and what
        remains is as right as it was. Without any point, points and the frames' seen are None.

    Raises:
        ValueError: names the file, what was found, what was wanted and what to do; also where more than half
            of the photographs are missing, or a lens is none of ours.
    """
    folder = Path(folder)
    model = find_model(folder)
    if model is None:
        raise ValueError(
            f"{folder}: has no cameras and images, .bin or .txt, in sparse/0, sparse, colmap/sparse/0 or "
            "itself, wanted a COLMAP model; correct the folder"
        )
    cameras, images, ids, points = read_model(model)
    present, notes = _find_photographs(images, folder, model_file(model, "images"))
    frames = [_frame(path, name, image, cameras[image.camera], ids) for path, name, image in present]
    notes += _check_seen(frames, present, model) + _other_models(folder, model)
    if not len(ids):
        points, frames = None, [frame._replace(seen=None, seen_at=None) for frame in frames]
    frames = tuple(sorted(frames, key=lambda frame: frame.name))
    return Capture("colmap", model, frames, points=points, notes=tuple(notes))


def models_in(folder):
    for base in (folder / "sparse", folder / "colmap" / "sparse"):
        numbered = [path for path in base.glob("*") if path.name.isdecimal() and model_suffix(path)]
        if numbered:
            return sorted(numbered, key=lambda path: int(path.name))
        if model_suffix(base):
            return [base]
    return [folder] if model_suffix(folder) else []


def _other_models(folder, model):
    others = [path.name for path in models_in(folder) if path != model]
    said = f"{model}: read, as it has most images; left out beside it: {', '.join(others)}"
    return [said] if others else []


def _find_photographs(images, folder, source):
    """Returns (path, name below the folder of photographs, Image) of those with a file, and the notes."""
    photographs = folder / "images" if (folder / "images").is_dir() else folder
    found, missing = {}, []
    for image in images:
        path = photographs / check_inside(image.name, key="its name", source=image.where)
        if path in found:
            raise ValueError(f"{image.where}: {image.name[:80]!r} occurs twice, wanted one pose for each; {AGAIN}")
        if os.path.isfile(path):  # Path.is_file would raise at a name that is too long
            found[path] = (path, path.relative_to(photographs).with_suffix("").as_posix(), image)
        else:
            missing.append(image.name)
    if not missing:
        return list(found.values()), []
    named = ", ".join(repr(name[:80]) for name in sorted(missing)[:5]) + ", ..." * (len(missing) > 5)
    said = f"{photographs}: lacks {len(missing)} of {len(images)} photographs of {source}, {named}"
    if len(missing) > len(images) / 2:
        raise ValueError(f"{said}; wanted at least half of them, copy them there")
    return list(found.values()), [f"{said}; they are left out"]


def _frame(path, name, image, intrinsics, ids):
    where = f"{image.where}, {image.name[:80]!r}"
    index = np.searchsorted(ids, image.points)
    known = np.isin(image.points, ids)
    camera = _camera(intrinsics, _to_world(image, where))
    return Frame(name, path, camera, turned=False, seen=index[known], seen_at=image.seen_at[known])


def _to_world(image, where):
    """Returns the pose [3, 4] of a Camera: the inverse of COLMAP's, which looks along +z with y down."""
    norm = np.linalg.norm(image.quaternion)
    if not abs(norm - 1) <= 1e-3:  # files carry six digits or more: beyond this it is a mistake, not rounding
        raise ValueError(f"{where}: its quaternion has length {norm:.4g}, wanted 1; {AGAIN}")
    w, x, y, z = image.quaternion / norm
    rotation = np.array(  # camera -> world, the transpose of the quaternion's
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    place = -rotation @ image.translation
    pose = np.concatenate([rotation * [1, -1, -1], place[:, None]], axis=-1)
    return check_pose(pose, source=where, shape=(3, 4))


def _camera(intrinsics, to_world):
    where, model, width, height, params = intrinsics
    if model not in _LENSES:
        raise ValueError(f"{where}: {model} is none of our lenses, wanted {', '.join(_LENSES)}; {UNDISTORT}")
    if min(width, height) < 1 or width * height >= 2**31:  # pixel ids are int32
        raise ValueError(f"{where}: is {width} x {height}, wanted px and less than 2^31 in all; {AGAIN}")
    count, lens = _LENSES[model]
    focal, center, distortion = params[:count], params[count : count + 2], params[count + 2 :]
    if not all(1e-6 < value / max(width, height) < 1e6 for value in focal):  # beyond, a ray has no direction
        raise ValueError(f"{where}: focal length {focal}, wanted px of {width} x {height}; {AGAIN}")
    if not all(is_number(value) for value in params):
        raise ValueError(f"{where}: parameters {params}, wanted finite numbers; {AGAIN}")
    size = 5 if model == "FULL_OPENCV" else 4
    if any(distortion[size:]):
        raise ValueError(f"{where}: {model} has k4, k5, k6 = {distortion[size:]}, wanted 0; {UNDISTORT}")
    padded = np.zeros(size)
    padded[: len(distortion[:size])] = distortion[:size]
    return Camera(
        to_world=to_world,
        focal=np.array(focal if count == 2 else focal * 2),
        center=np.array(center),
        distortion=None if lens == "pinhole" else padded,
        lens=lens,
        height=height,
        width=width,
    )


def _check_seen(frames, present, model):
    """Returns a note where observations were left out; ValueError where all were: points of another model."""
    total = sum(len(image.points) for *_, image in present)
    kept = sum(len(frame.seen) for frame in frames)
    path, shown = model_file(model, "points3D"), model_file(model, "images").name
    if total and not kept:
        raise ValueError(f"{path}: has none of the points that {shown} shows, wanted them; {AGAIN}")
    said = f"{path}: lacks the points of {total - kept} observations in {shown}; they are left out"
    return [said] if kept < total else []


READER = Reader(read_capture, detect=lambda folder: bool(models_in(folder)))
