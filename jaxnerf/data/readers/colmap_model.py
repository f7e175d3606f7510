"""The three files of a COLMAP model, binary or text, as plain records. A count is believed if it fits."""

import os
import struct
from typing import NamedTuple

import numpy as np

from jaxnerf.data.readers.validation import LARGEST

MODELS = {  # COLMAP's number of a kind of camera: its name and how many parameters it has
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
_NUMBER = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, number of its kind, width, height; then its parameters
_POSE = struct.Struct("<I7dI")  # id, quaternion and translation, camera; then name, 0, count, observations
_POINT = struct.Struct("<q3d3BdQ")  # id, place, colour, error, count; then the images that show it
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])  # point is -1 where there is none
_SMALLEST_IMAGE = _POSE.size + 1 + _NUMBER.size  # bytes
_LONGEST = 4096  # bytes of a name that an operating system takes


class Intrinsics(NamedTuple):
    """A camera without its pose. COLMAP's pixel centres are at + 0.5, as ours."""

    where: str  # it stands, for messages
    model: str  # a name of MODELS
    width: int  # px
    height: int  # px
    params: tuple[float, ...]


class Image(NamedTuple):
    """A registered photograph: world -> camera, x right, y down, looking along +z."""

    where: str  # it stands, for messages
    name: str  # path of its file, as the model states it
    camera: int  # key of its Intrinsics
    quaternion: np.ndarray  # [4] w, x, y, z
    translation: np.ndarray  # [3]
    points: np.ndarray  # [M] int64, ids of the points it shows
    seen_at: np.ndarray  # [M, 2] px where


def model_suffix(folder):
    """Returns ".bin" or ".txt", whichever a folder holds a model in (the first, if both), or None."""
    for suffix in (".bin", ".txt"):
        if all(os.path.isfile(folder / f"{name}{suffix}") for name in ("cameras", "images")):
            return suffix
    return None


def model_file(folder, name):
    """Returns the path of a model's cameras, images or points3D."""
    return folder / f"{name}{model_suffix(folder)}"


def count_images(folder):
    """Returns how many images the model in a folder says it has."""
    path = model_file(folder, "images")
    if path.suffix == ".bin":
        return _count(path, _bytes(path), smallest=_SMALLEST_IMAGE)
    return sum(1 for _ in _image_lines(path))


def read_model(folder):
    """Returns a model's ({id: Intrinsics}, [Image], point ids [N] int64 ascending, points [N, 3] float64).

    Raises:
        ValueError: names the file, what was found, what was wanted and what to do.
    """
    path, images_path, points_path = (model_file(folder, name) for name in ("cameras", "images", "points3D"))
    binary = path.suffix == ".bin"
    cameras = {}
    for key, camera in (_binary_cameras if binary else _text_cameras)(path):
        if cameras.setdefault(key, camera) is not camera:
            raise ValueError(f"{camera.where}: stands there twice, wanted each camera once; {AGAIN}")
    images = list((_binary_images if binary else _text_images)(images_path))
    if not images:
        raise ValueError(f"{images_path}: holds no image, wanted at least one; {AGAIN}")
    for image in images:
        _check_image(image, cameras, path)
    rows = list((_binary_points if binary else _text_points)(points_path))
    ids = np.array([row[0] for row in rows], np.int64)
    points = np.array([row[1:] for row in rows], np.float64).reshape(-1, 3)
    _check_points(ids, points, points_path)
    order = np.argsort(ids)
    return cameras, images, ids[order], points[order]


def _check_image(image, cameras, path):
    if image.camera not in cameras:
        raise ValueError(f"{image.where}: has camera {image.camera}, which {path.name} lacks; {AGAIN}")
    for name in ("quaternion", "translation", "seen_at"):
        if not (np.abs(getattr(image, name)) <= LARGEST).all():
            raise ValueError(f"{image.where}: {name} is not finite, wanted numbers; {AGAIN}")


def _check_points(ids, points, path):
    if len(ids) and (ids.min() < 0 or len(np.unique(ids)) < len(ids)):
        found = "a negative id" if ids.min() < 0 else "an id twice"
        raise ValueError(f"{path}: has {found}, wanted one id >= 0 for each point; {AGAIN}")
    wrong = ids[~(np.abs(points) <= LARGEST).all(axis=-1)]
    if len(wrong):
        raise ValueError(f"{path}: point {wrong[0]} is not finite, wanted numbers; {AGAIN}")


def _bytes(path):
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}, wanted a whole model of three files; {AGAIN}") from None


def _room(path, data, at, size):
    """Returns the byte after size bytes from at. It comes before whatever allocates them."""
    if at + size > len(data):
        raise ValueError(f"{path}: ends after {len(data)} bytes, wanted {at + size} or more; {AGAIN}")
    return at + size


def _unpack(path, data, at, layout):
    end = _room(path, data, at, layout.size)
    return layout.unpack_from(data, at), end


def _count(path, data, *, smallest):
    """Returns the number of entries, which a file begins with, if as many smallest ones fit into it."""
    (count,), at = _unpack(path, data, 0, _NUMBER)
    if count * smallest > len(data) - at:
        found = f"says that it holds {count} entries in {len(data)} bytes"
        raise ValueError(f"{path}: {found}, wanted {smallest} bytes or more for each; {AGAIN}")
    return count


def _check_end(path, data, at):
    if at != len(data):
        raise ValueError(f"{path}: has {len(data) - at} bytes after its last entry, wanted none; {AGAIN}")


def _binary_cameras(path):
    data, at = _bytes(path), _NUMBER.size
    for _ in range(_count(path, data, smallest=_CAMERA.size)):
        (key, number, width, height), at = _unpack(path, data, at, _CAMERA)
        if number not in MODELS:
            wanted = f"wanted 0 to {max(MODELS)}; {UNDISTORT}"
            raise ValueError(f"{path}, camera {key}: model number {number}, {wanted}")
        model, size = MODELS[number]
        params, at = _unpack(path, data, at, struct.Struct(f"<{size}d"))
        yield key, Intrinsics(f"{path}, camera {key}", model, width, height, params)
    _check_end(path, data, at)


def _binary_images(path):
    data, at = _bytes(path), _NUMBER.size
    for _ in range(_count(path, data, smallest=_SMALLEST_IMAGE)):
        (key, *motion, camera), at = _unpack(path, data, at, _POSE)
        where, end = f"{path}, image {key}", data.find(b"\0", at, at + _LONGEST)
        try:
            name = data[at:end].decode("utf-8")
        except UnicodeDecodeError:
            end = -1
        if end < 0:
            raise ValueError(f"{where}: its name has no end or is not UTF-8, wanted a file name; {AGAIN}")
        (count,), at = _unpack(path, data, end + 1, _NUMBER)
        end = _room(path, data, at, count * _OBSERVATION.itemsize)
        rows = np.frombuffer(data, _OBSERVATION, count, at)
        rows, at = rows[rows["point"] != -1], end
        seen_at = np.stack([rows["x"], rows["y"]], axis=-1)
        yield Image(where, name, camera, np.array(motion[:4]), np.array(motion[4:]), rows["point"], seen_at)
    _check_end(path, data, at)


def _binary_points(path):
    """Yields (id, x, y, z). Which images show a point is known from the images."""
    data, at = _bytes(path), _NUMBER.size
    for _ in range(_count(path, data, smallest=_POINT.size)):
        (*row, _, _, _, _, length), at = _unpack(path, data, at, _POINT)
        at = _room(path, data, at, length * 8)
        yield row
    _check_end(path, data, at)


def _lines(path):
    try:
        lines = _bytes(path).decode("utf-8-sig").split("\n")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: is no UTF-8 text, wanted a model's text file; {AGAIN}") from None
    return ((f"{path}, line {number}", line.strip()) for number, line in enumerate(lines, 1))


def _entries(lines):
    return ((where, line) for where, line in lines if line and not line.startswith("#"))


def _image_lines(path):
    """Yields (where, its line, the line of its observations, which may be empty) for each image."""
    lines = _lines(path)
    for where, line in _entries(lines):
        yield where, line, next(lines, ("", ""))[1]


def _split(where, line, kinds, wanted):
    """Returns the first words of a line as the kinds say (int, float, ...), and the rest of it or ""."""
    words = line.split(maxsplit=len(kinds))
    try:
        values = [kind(word) for kind, word in zip(kinds, words[: len(kinds)], strict=True)]
    except (ValueError, OverflowError):
        raise _no_entry(where, line, wanted) from None
    return values, "".join(words[len(kinds) :])


def _no_entry(where, line, wanted):
    return ValueError(f"{where}: is {line[:40]!r}, wanted {wanted}; {AGAIN}")


def _text_cameras(path):
    sizes = dict(MODELS.values())
    for where, line in _entries(_lines(path)):
        wanted = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
        (key, model, width, height), rest = _split(where, line, (int, str, int, int), wanted)
        if model not in sizes:
            found = f"model {model[:40]!r}, wanted one of COLMAP's"
            raise ValueError(f"{where}, camera {key}: {found}; {UNDISTORT}")
        params, more = _split(where, rest, (float,) * sizes[model], f"{sizes[model]} PARAMS of {model}")
        if more:
            raise _no_entry(where, more, f"{sizes[model]} PARAMS of {model} and no more")
        yield key, Intrinsics(f"{where}, camera {key}", model, width, height, tuple(params))


def _text_images(path):
    for where, line, observations in _image_lines(path):
        wanted = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
        (key, *motion, camera), name = _split(where, line, (int, *(float,) * 7, int), wanted)
        words = observations.split()
        try:
            seen_at = np.array([[float(x), float(y)] for x, y in zip(words[::3], words[1::3], strict=True)])
            points = np.fromiter(map(int, words[2::3]), np.int64)
        except (ValueError, OverflowError):
            points = None
        if not name or points is None or len(words) % 3:
            raise _no_entry(where, line, f"{wanted}, and X Y POINT3D_ID in threes on the next line")
        where, kept, motion = f"{where}, image {key}", points != -1, np.array(motion)
        seen_at = seen_at.reshape(-1, 2)[kept]
        yield Image(where, name, camera, motion[:4], motion[4:], points[kept], seen_at)


def _text_points(path):
    """Yields (id, x, y, z)."""
    for where, line in _entries(_lines(path)):
        kinds = (np.int64, float, float, float, int, int, int, float)  # int64: a larger id is a mistake
        values, _ = _split(where, line, kinds, "POINT3D_ID X Y Z R G B ERROR TRACK[]")
        yield values[:4]
