"""Reader of COLMAP datasets: a sparse model, binary or text, beside a folder of images."""

import os
from pathlib import Path

import numpy as np

from jaxnerf.core.types import Camera
from jaxnerf.data.geometry.poses import check_pose
from jaxnerf.data.readers.base import CameraFiles, Capture, Frame
from jaxnerf.data.readers.colmap_model import (
    AGAIN,
    MODEL_FOLDERS,
    UNDISTORT,
    check_complete,
    convert,
    count_images,
    model_file,
    model_suffix,
    read_model,
)
from jaxnerf.data.readers.image_paths import ImageFinder, nearly
from jaxnerf.data.readers.validation import check_inside, is_number
from jaxnerf.registry import Reader

_FILES = CameraFiles(
    poses="every world-to-camera matrix [R | t] of the images file",
    axes=np.diag([1.0, -1.0, -1.0]),
    lines="rows",
    mirror="also negate column 1 of every R and x of every point (the world is mirrored)",
    focal="the cameras file: every focal length times {factor:.3g}, or run COLMAP again",
)
_LENSES = {  # COLMAP's camera model: its number of focal lengths, and the lens of Camera
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


def read_capture(folder: str | os.PathLike) -> Capture:
    """Returns the Capture of the COLMAP model in a folder, of several the one with most images, in the model's world.

    Registered images whose file is missing are skipped, and so are observations of points that points3D lacks:
    users delete points, and the remaining ones stay correct. Both are noted. If there are no points, or no
    points3D, `points` and the frames' `seen` are None.

    Args:
        folder: has cameras, images and points3D, as .bin or else .txt, in sparse/0, sparse, colmap/sparse/0,
            colmap/sparse, dense/0/sparse, dense/sparse or itself, and the image files in images/ (of a model in
            dense/, in images/ beside it) or itself. A name may begin with images/, and differ in case.

    Raises:
        ValueError: names the file, what was found, what is expected and what to do; also if more than half of
            the images are missing, or a camera model is not supported.
    """
    folder = Path(folder)
    models = models_in(folder)
    if not models:
        check_complete(folder)
        raise ValueError(
            f"{folder}: has no cameras and images, .bin or .txt, in sparse/0, sparse, colmap/sparse/0, dense/0/sparse "
            "or itself, expected a COLMAP model; correct the folder"
        )
    model = models[0] if len(models) == 1 else max(models, key=count_images)
    cameras, images, ids, points = read_model(model)
    present, notes = _find_images(images, _image_folder(folder, model), model_file(model, "images"))
    frames = [_frame(path, name, image, cameras[image.camera], ids) for path, name, image in present]
    notes += _check_seen(frames, present, model) + _other_models(models, model)
    if not len(ids):
        points, frames = None, [frame._replace(seen=None, seen_at=None) for frame in frames]
    frames = tuple(sorted(frames, key=lambda frame: frame.name))
    return Capture("colmap", model, frames, points=points, notes=tuple(notes), files=_FILES)


def models_in(folder: Path) -> list[Path]:
    """Returns the folders of all COLMAP models of a dataset, in the order of their numbers."""
    dense = [base for base in sorted(folder.glob(MODEL_FOLDERS[-1])) if model_suffix(base)]
    for base in (folder / place for place in MODEL_FOLDERS[:-1]):
        numbered = [path for path in base.glob("*") if path.name.isdecimal() and model_suffix(path)]
        if numbered:
            return sorted(numbered, key=lambda path: int(path.name))
        if model_suffix(base):
            return [base]
    return dense or ([folder] if model_suffix(folder) else [])


def _image_folder(folder, model):
    """Returns the folder of a model's images: images/, beside a model in dense/, or else the dataset's folder."""
    if model.is_relative_to(folder / "dense"):
        folder = model.parent if model.name == "sparse" else model.parent.parent
    return folder / "images" if (folder / "images").is_dir() else folder


def _other_models(models, model):
    base = os.path.commonpath(models)
    others = [os.path.relpath(path, base) for path in models if path != model]
    note = f"{model}: used, as it has most images; other models skipped: {', '.join(others)}"
    return [note] if others else []


def _find_images(images, root, source):
    """Returns (path, name below the folder of images, Image) of those with a file, and the notes."""
    found, missing, finder = {}, [], ImageFinder(root)
    for image in images:
        name = check_inside(image.name, key="its name", source=image.where)
        path = finder.find_exact(name) or finder.find_exact(name.removeprefix(f"{root.name}/")) or root / name
        if path in found:
            raise ValueError(
                f"{image.where}: {image.name[:80]!r} occurs twice, expected one pose for each image; {AGAIN}"
            )
        if os.path.isfile(path):
            found[path] = (path, path.relative_to(root).with_suffix("").as_posix(), image)
        else:
            missing.append(image.name)
    notes = finder.notes(source)
    if not missing:
        return list(found.values()), notes
    named = ", ".join(repr(name[:80]) for name in sorted(missing)[:5]) + ", ..." * (len(missing) > 5)
    hint = nearly(finder, *sorted(missing))
    note = f"{root}: lacks {len(missing)} of {len(images)} images of {source}, {named}"
    if len(missing) > len(images) / 2:
        raise ValueError(f"{note}; expected at least half of them{hint or '; copy them there'}")
    return list(found.values()), [*notes, f"{note}; they are skipped{hint}"]


def _frame(path, name, image, intrinsics, ids):
    where = f"{image.where}, {image.name[:80]!r}"
    index = np.searchsorted(ids, image.points)
    known = np.isin(image.points, ids)
    camera = _camera(intrinsics, _to_world(image, where))
    return Frame(name, path, camera, follow_exif=False, seen=index[known], seen_at=image.seen_at[known])


def _to_world(image, where):
    """Returns the pose [3, 4] of a Camera: the inverse of COLMAP's world to camera, whose z points forwards."""
    norm = np.linalg.norm(image.quaternion)
    if not abs(norm - 1) <= 1e-3:  # files have six digits or more, so this is no rounding error
        raise ValueError(f"{where}: its quaternion has length {norm:.4g}, expected 1; {AGAIN}")
    w, x, y, z = image.quaternion / norm
    rotation = np.array(  # camera -> world, the transpose of the quaternion's matrix
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
        raise ValueError(f"{where}: {model} is not supported, expected {', '.join(_LENSES)}; {convert(model)}")
    if min(width, height) < 1 or width * height >= 2**31:  # pixel ids are int32
        raise ValueError(f"{where}: is {width} x {height}, expected at least 1 and fewer than 2^31 pixels; {AGAIN}")
    count, lens = _LENSES[model]
    focal, center, distortion = params[:count], params[count : count + 2], params[count + 2 :]
    if not all(
        1e-6 < value / max(width, height) < 1e6 for value in focal
    ):  # outside, rays have no direction in float32
        raise ValueError(f"{where}: focal length {focal}, expected px of {width} x {height}; {AGAIN}")
    if not all(is_number(value) for value in params):
        raise ValueError(f"{where}: parameters {params}, expected finite numbers; {AGAIN}")
    size = 5 if model == "FULL_OPENCV" else 4
    if any(distortion[size:]):
        raise ValueError(f"{where}: {model} has k4, k5, k6 = {distortion[size:]}, expected 0; {UNDISTORT}")
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
    """Returns a note if observations were skipped; ValueError if all were: the points are another model's."""
    total = sum(len(image.points) for *_, image in present)
    kept = sum(len(frame.seen) for frame in frames)
    path, images = model_file(model, "points3D"), model_file(model, "images").name
    if not os.path.lexists(path):
        others = ", ".join(sorted(other.name for other in model.glob("points3D*")))
        beside = f", and {others} is not read" if others else ""
        return [f"{path}: no such file{beside}, so depths are inferred from the cameras alone"]
    if total and not kept:
        raise ValueError(f"{path}: has none of the points that {images} refers to, expected them; {AGAIN}")
    note = f"{path}: lacks the points of {total - kept} observations in {images}; they are skipped"
    return [note] if kept < total else []


READER = Reader(read_capture, detect=lambda folder: bool(models_in(folder)))
