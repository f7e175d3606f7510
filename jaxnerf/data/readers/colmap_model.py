"""Parsers of the three files of a COLMAP model, binary or text.

Files may come from strangers: every count is compared with the file's size before memory is allocated.
"""

import os
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxnerf.data.readers.validation import MAX_FLOAT32
from jaxnerf.runtime.atomic_files import read_bytes

MODELS = {  # COLMAP's number of a camera model: its name and number of parameters
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
AGAIN = "copy the model again or export it again"
UNDISTORT = "run `colmap image_undistorter` and give the folder that it writes"
# The undistorter copies panoramas as they are.
PANORAMA = (
    "panoramas are not read: give the folder that COLMAP's example python/examples/panorama_sfm.py writes with "
    "--pano_render_type=perspective_overlapping, views rendered from them with a model"
)
_NUMBER = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model number, width, height; followed by its parameters
_POSE = struct.Struct("<I7dI")  # id, quaternion and translation, camera; followed by name, 0, count, observations
_POINT = struct.Struct("<q3d3BdQ")  # id, position, colour, error, count; followed by the images that show it
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])  # point -1: none
_SMALLEST_IMAGE = _POSE.size + 1 + _NUMBER.size  # bytes
_MAX_NAME = 4096  # bytes, the limit of common operating systems


def convert(model: str, otherwise: str = UNDISTORT) -> str:
    """Returns what to do with images of a camera model that is not read; otherwise: if it is none of panoramas."""
    names = ("equirect", "spher", "latlong", "panorama", "omnidirect", "vr180")
    return PANORAMA if any(name in model.lower() for name in names) else otherwise


class Intrinsics(NamedTuple):
    """A camera without its pose. Pixel centres are at + 0.5, as in Camera.

    Attributes:
        where: file and entry, for messages.
        model: a name of MODELS.
        width: px.
        height: px.
        params: as COLMAP orders them.
    """

    where: str
    model: str
    width: int
    height: int
    params: tuple[float, ...]


class Image(NamedTuple):
    """A registered image with its pose, world -> camera: x right, y down, looking along +z.

    Attributes:
        where: file and entry, for messages.
        name: path of the image file, as the model states it.
        camera: key of its Intrinsics.
        quaternion: w, x, y, z.
        translation: world units.
        points: ids of the points that it shows.
        seen_at: px, where it shows them.
    """

    where: str
    name: str
    camera: int
    quaternion: Float[np.ndarray, "4"]
    translation: Float[np.ndarray, "3"]
    points: Int[np.ndarray, " M"]
    seen_at: Float[np.ndarray, "M 2"]


# Where models lie below a dataset's folder: COLMAP's, nerfstudio's, and the undistorter's, which has its own images.
MODEL_FOLDERS = ("sparse", "colmap/sparse", "dense/sparse", "dense/*/sparse")


def model_suffix(folder: Path) -> str | None:
    """Returns the suffix of the model's files in a folder, ".bin" before ".txt"; None if there is no model."""
    for suffix in (".bin", ".txt"):
        if all(os.path.isfile(folder / f"{name}{suffix}") for name in ("cameras", "images")):
            return suffix
    return None


def check_complete(folder: str | os.PathLike) -> None:
    """Raises a ValueError if a dataset's folder holds a part of a model, but not its cameras and images."""
    places = [place for base in MODEL_FOLDERS for place in (f"{base}/0", base)]
    for base in (*(path for place in places for path in sorted(Path(folder).glob(place))), Path(folder)):
        for suffix in (".bin", ".txt"):
            names = [f"{name}{suffix}" for name in ("cameras", "images", "points3D")]
            found = [name for name in names if os.path.isfile(base / name)]
            missing = [name for name in names[:2] if name not in found]
            if found and missing:
                raise ValueError(
                    f"{base}: has {' and '.join(found)} but no {' and '.join(missing)}, expected all "
                    f"files of a COLMAP model; {AGAIN}"
                )


def model_file(folder: Path, name: str) -> Path:
    """Returns the path of a model's file "cameras", "images" or "points3D"; the latter may be of the other kind."""
    suffix = model_suffix(folder)
    other = folder / f"{name}{'.txt' if suffix == '.bin' else '.bin'}"
    path = folder / f"{name}{suffix}"
    return other if not os.path.isfile(path) and os.path.isfile(other) else path


def count_images(folder: Path) -> int:
    """Returns the number of images that the model in a folder states."""
    path = model_file(folder, "images")
    if path.suffix == ".bin":
        return _count(path, _bytes(path), smallest=_SMALLEST_IMAGE)
    return sum(1 for _ in _image_lines(path))


def read_model(
    folder: Path,
) -> tuple[dict[int, Intrinsics], list[Image], Int[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
    """Returns a model's {id: Intrinsics}, images, point ids in ascending order, and points; none without points3D.

    Raises:
        ValueError: names the file, what was found, what is expected and what to do.
    """
    path, images_path, points_path = (model_file(folder, name) for name in ("cameras", "images", "points3D"))
    binary = path.suffix == ".bin"
    cameras = {}
    for key, camera in (_binary_cameras if binary else _text_cameras)(path):
        if cameras.setdefault(key, camera) is not camera:
            raise ValueError(f"{camera.where}: occurs twice, expected each camera once; {AGAIN}")
    images = list((_binary_images if binary else _text_images)(images_path))
    if not images:
        raise ValueError(f"{images_path}: holds no image, expected at least one; {AGAIN}")
    for image in images:
        _check_image(image, cameras, path)
    parse = _binary_points if points_path.suffix == ".bin" else _text_points
    rows = list(parse(points_path)) if os.path.lexists(points_path) else []
    ids = np.array([row[0] for row in rows], np.int64)
    points = np.array([row[1:] for row in rows], np.float64).reshape(-1, 3)
    _check_points(ids, points, points_path)
    order = np.argsort(ids)
    return cameras, images, ids[order], points[order]


def _check_image(image, cameras, path):
    if image.camera not in cameras:
        raise ValueError(f"{image.where}: has camera {image.camera}, which {path.name} lacks; {AGAIN}")
    for name in ("quaternion", "translation", "seen_at"):
        if not (np.abs(getattr(image, name)) <= MAX_FLOAT32).all():
            raise ValueError(f"{image.where}: {name} is not finite, expected finite numbers; {AGAIN}")


def _check_points(ids, points, path):
    if len(ids) and (ids.min() < 0 or len(np.unique(ids)) < len(ids)):
        found = "a negative id" if ids.min() < 0 else "an id twice"
        raise ValueError(f"{path}: has {found}, expected one id >= 0 for each point; {AGAIN}")
    wrong = ids[~(np.abs(points) <= MAX_FLOAT32).all(axis=-1)]
    if len(wrong):
        raise ValueError(f"{path}: point {wrong[0]} is not finite, expected finite numbers; {AGAIN}")


def _bytes(path):
    try:
        return read_bytes(path)
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}, expected a model of three files; {AGAIN}") from None


def _end_of(path, data, at, size):
    """Returns the position after size bytes from at; ValueError if the file is shorter. Called before allocation."""
    if at + size > len(data):
        raise ValueError(f"{path}: ends after {len(data)} bytes, expected at least {at + size}; {AGAIN}")
    return at + size


def _unpack(path, data, at, layout):
    end = _end_of(path, data, at, layout.size)
    return layout.unpack_from(data, at), end


def _count(path, data, *, smallest):
    """Returns the number of entries at the file's start; ValueError if that many cannot fit into the file."""
    (count,), at = _unpack(path, data, 0, _NUMBER)
    if count * smallest > len(data) - at:
        found = f"states {count} entries in {len(data)} bytes"
        raise ValueError(f"{path}: {found}, expected at least {smallest} bytes for each; {AGAIN}")
    return count


def _check_end(path, data, at):
    if at != len(data):
        raise ValueError(f"{path}: has {len(data) - at} bytes after its last entry, expected none; {AGAIN}")


def _binary_cameras(path):
    data, at = _bytes(path), _NUMBER.size
    for _ in range(_count(path, data, smallest=_CAMERA.size)):
        (key, number, width, height), at = _unpack(path, data, at, _CAMERA)
        if number not in MODELS:
            found = f"model number {number}, expected 0 to {max(MODELS)}"
            todo = "with the COLMAP that wrote it, run `colmap image_undistorter`, or for panoramas"
            raise ValueError(f"{path}, camera {key}: {found}; {todo}: {PANORAMA}")
        model, size = MODELS[number]
        params, at = _unpack(path, data, at, struct.Struct(f"<{size}d"))
        yield key, Intrinsics(f"{path}, camera {key}", model, width, height, params)
    _check_end(path, data, at)


def _binary_images(path):
    data, at = _bytes(path), _NUMBER.size
    for _ in range(_count(path, data, smallest=_SMALLEST_IMAGE)):
        (key, *motion, camera), at = _unpack(path, data, at, _POSE)
        where, end = f"{path}, image {key}", data.find(b"\0", at, at + _MAX_NAME)
        try:
            name = data[at:end].decode("utf-8")
        except UnicodeDecodeError:
            end = -1
        if end < 0:
            raise ValueError(f"{where}: its name has no end or is not UTF-8, expected a file name; {AGAIN}")
        (count,), at = _unpack(path, data, end + 1, _NUMBER)
        end = _end_of(path, data, at, count * _OBSERVATION.itemsize)
        rows = np.frombuffer(data, _OBSERVATION, count, at)
        rows, at = rows[rows["point"] != -1], end
        seen_at = np.stack([rows["x"], rows["y"]], axis=-1)
        yield Image(where, name, camera, np.array(motion[:4]), np.array(motion[4:]), rows["point"], seen_at)
    _check_end(path, data, at)


def _binary_points(path):
    """Yields (id, x, y, z). The images that show a point are skipped: the images' entries state them, too."""
    data, at = _bytes(path), _NUMBER.size
    for _ in range(_count(path, data, smallest=_POINT.size)):
        (*row, _, _, _, _, length), at = _unpack(path, data, at, _POINT)
        at = _end_of(path, data, at, length * 8)
        yield row
    _check_end(path, data, at)


def _lines(path):
    try:
        lines = _bytes(path).decode("utf-8-sig").split("\n")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: is no UTF-8 text, expected a model's text file; {AGAIN}") from None
    return ((f"{path}, line {number}", line.strip()) for number, line in enumerate(lines, 1))


def _entries(lines):
    return ((where, line) for where, line in lines if line and not line.startswith("#"))


def _image_lines(path):
    """Yields (where, line of the image, line of its observations, which may be empty or absent)."""
    image = None
    for where, line in _lines(path):
        if image and _is_image(line):
            yield *image, ""
            image = where, line
        elif image:
            yield *image, line
            image = None
        elif line and not line.startswith("#"):
            image = where, line
    if image:
        yield *image, ""


def _is_image(line):
    """Returns whether a line is an image's and not one of observations, which are numbers in threes."""
    *words, name = [*line.split(maxsplit=9), ""][:10]
    if not name or not _is_of(words, (int, *(float,) * 7, int)):
        return False
    rest = name.split()
    return len(rest) % 3 != 0 or not _is_of(rest, (float,) * len(rest))


def _is_of(words, kinds):
    try:
        for kind, word in zip(kinds, words, strict=False):
            kind(word)
    except (ValueError, OverflowError):
        return False
    return True


def _split(where, line, kinds, expected):
    """Returns the first words of a line, converted to kinds (int, float, ...), and the rest of the line."""
    words = line.split(maxsplit=len(kinds))
    try:
        values = [kind(word) for kind, word in zip(kinds, words[: len(kinds)], strict=True)]
    except (ValueError, OverflowError):
        raise _no_entry(where, line, expected) from None
    return values, "".join(words[len(kinds) :])


def _no_entry(where, line, expected):
    return ValueError(f"{where}: is {line[:40]!r}, expected {expected}; {AGAIN}")


def _text_cameras(path):
    sizes = dict(MODELS.values())
    for where, line in _entries(_lines(path)):
        expected = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
        (key, model, width, height), rest = _split(where, line, (int, str, int, int), expected)
        if model not in sizes:
            found = f"model {model[:40]!r}, expected one of COLMAP's"
            raise ValueError(f"{where}, camera {key}: {found}; {convert(model)}")
        params, more = _split(where, rest, (float,) * sizes[model], f"{sizes[model]} PARAMS of {model}")
        if more:
            raise _no_entry(where, more, f"{sizes[model]} PARAMS of {model} and no more")
        yield key, Intrinsics(f"{where}, camera {key}", model, width, height, tuple(params))


def _text_images(path):
    for where, line, observations in _image_lines(path):
        expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
        (key, *motion, camera), name = _split(where, line, (int, *(float,) * 7, int), expected)
        words = observations.split()
        try:
            seen_at = np.array([[float(x), float(y)] for x, y in zip(words[::3], words[1::3], strict=True)])
            points = np.fromiter(map(int, words[2::3]), np.int64)
        except (ValueError, OverflowError):
            points = None
        if not name or points is None or len(words) % 3:
            raise _no_entry(where, line, f"{expected}, and X Y POINT3D_ID in threes on the next line")
        where, kept, motion = f"{where}, image {key}", points != -1, np.array(motion)
        seen_at = seen_at.reshape(-1, 2)[kept]
        yield Image(where, name, camera, motion[:4], motion[4:], points[kept], seen_at)


def _text_points(path):
    """Yields (id, x, y, z)."""
    for where, line in _entries(_lines(path)):
        kinds = (np.int64, float, float, float, int, int, int, float)  # int64 rejects larger ids
        values, _ = _split(where, line, kinds, "POINT3D_ID X Y Z R G B ERROR TRACK[]")
        yield values[:4]
