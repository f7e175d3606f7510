"""Intrinsics of one image as JSON files of instant-ngp, nerfstudio, torch-ngp and Blender state them."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from jaxnerf.core.types import Camera
from jaxnerf.data.images.image_files import image_size
from jaxnerf.data.readers.colmap_model import convert
from jaxnerf.data.readers.validation import is_number
from jaxnerf.options import short_repr

_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")  # nerfstudio's order of distortion_params
_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_UNSUPPORTED = ("ftheta_p0", "latlong", "equirectangular")  # instant-ngp's other lenses
_ANGLES = ("camera_angle_x", "camera_angle_y")
_OTHERS = ("camera_model", "is_fisheye", "w", "h", "fl_x", "fl_y", "cx", "cy")
# Fields that say more of a camera than the angle and the size in files of Blender's renders.
STATED = ("fl_x", "fl_y", "cx", "cy", "camera_model", "is_fisheye", *_COEFFICIENTS, "distortion_params", *_UNSUPPORTED)
_UNUSED = {  # facts of other programs: why they are not used
    **dict.fromkeys(("k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2", "skew"), "no lens of jaxnerf has that term"),
    **dict.fromkeys(("timestamp", "fid", "time_id", "timestep", "timestep_index"), "time is read"),
    "rolling_shutter": "all pixels of an image have one pose",
    **dict.fromkeys(("transform_matrix_start", "transform_matrix_end"), "transform_matrix is the pose"),
    **dict.fromkeys(("K", "intrinsics", "intrinsic_matrix"), "fl_x, fl_y, cx and cy are read"),
    "near": "it follows from the cameras; data.near sets it",
    "far": "it follows from the cameras; data.far sets it",
    **dict.fromkeys(("shift_x", "shift_y"), "cx and cy are read"),
}
_TERMS = {"SIMPLE_PINHOLE": (), "PINHOLE": (), "SIMPLE_RADIAL": ("k1",), "RADIAL": ("k1", "k2")}
_ZERO = (None, 0, [], [0, 0, 0], [0, 0, 0, 0])
_ROUNDING = 0.01  # of a focal length that is stated twice
_ALIKE = 1.1  # of two ratios, along x and y: an image is smaller by both, not cropped
_CROPPED = 1.3  # by which the principal point may be off the middle of an image, as if it was cropped


def read_camera(levels: list[tuple[Any, dict]], *, to_world: np.ndarray, image: Path) -> Camera:
    """Returns the float64 camera of one image.

    The center defaults to the middle of the image, the focal length in y to that in x. A perspective lens
    whose coefficients are all 0 is a pinhole. The size is the stated one. If it is not stated and center or
    focal depend on it, it is the image's, as stored or as fits the center; otherwise it is None.

    Args:
        levels: [(where, entries)]: the file's, then the frame's. Later levels override earlier ones field by
            field; a later level's angle overrides an earlier one's focal length. where: for messages.
        to_world: [3, 4].
        image: opened only if no size is stated.

    Raises:
        ValueError: names where, what was found, what is expected and what to do.
    """
    fields, where = _fields(levels), levels[-1][0]
    size = [_size(fields, key) for key in "wh"]
    if None in size:
        found = _image_size(fields, image)
        if size != [None, None] or not {"cx", "cy", "fl_x"} <= fields.keys():
            size = [have if stated is None else stated for stated, have in zip(size, found, strict=True)]
    lens, distortion = _lens(fields, where)
    center = [
        number_in(fields, key, "a number of px") if key in fields else length / 2
        for key, length in zip(("cx", "cy"), size, strict=True)
    ]
    return Camera(
        to_world=to_world,
        focal=_focal(fields, size, where),
        center=np.array(center, np.float64),
        distortion=distortion,
        lens=lens,
        height=size[1],
        width=size[0],
    )


def _image_size(fields, image):
    """Returns the (width, height) of an image whose camera states none; ValueError if its center is another image's."""
    if not {"cx", "cy"} <= fields.keys():
        return image_size(image, follow_exif=False)
    center = np.array([number_in(fields, key, "a number of px") for key in ("cx", "cy")])
    size = image_size(image, center=center)
    times = 2 * center / size
    scaled = times.max() < _ALIKE * times.min() and not 1 / _CROPPED < times.mean() < _CROPPED
    if scaled or not ((times >= 0) & (times <= 2)).all():
        expected = f"{size[0] / 2:g}, {size[1] / 2:g} or so, the middle of {image} of {size[0]} x {size[1]} px"
        raise ValueError(
            f"{fields['cx'][1]}: cx, cy are {center[0]:.6g}, {center[1]:.6g} without w and h, expected {expected}; add "
            "w and h, the size in px that they and fl_x refer to"
        )
    return size


def ignored_facts(levels: list[tuple[Any, dict]], camera: Camera, image: Path) -> dict[str, str]:
    """Returns {field: what it says and why it is not used} of the camera facts that `read_camera` does not use.

    Args:
        levels, image: see `read_camera`.
        camera: what it returned.
    """
    fields, found = _fields(levels), {}
    for where, level in levels:
        for key, why in _UNUSED.items():
            if key in level and level[key] not in _ZERO:
                found[key] = f"{where}: {key} is not used, as {why}"
        given = dict(zip(_COEFFICIENTS, level.get("distortion_params", ()), strict=False))
        for key, value in given.items():
            if level.get(key, value) != value:
                found[key] = f"{where}: {key} is {short_repr(level[key])}, distortion_params has {value}, which is used"
    model, where = fields.get("camera_model", (None, None))
    extra = [key for key in _COEFFICIENTS if model in _TERMS and key in fields and key not in _TERMS[model]]
    if extra := [key for key in extra if fields[key][0]]:
        found["camera_model"] = f"{where}: camera_model {model} has no {', '.join(extra)}, used as stated all the same"
    return found | _other_angles(fields, camera, image)


def _other_angles(fields, camera, image):
    """Returns the part of `ignored_facts` about angles of view that contradict the focal lengths beside them."""
    found = {}
    for axis, key in enumerate(_ANGLES):
        if key not in fields or "fl_x" not in fields or fields[key][1] != fields["fl_x"][1]:
            continue
        pixels = (camera.width, camera.height)[axis] or image_size(image)[axis]
        focal, used = 0.5 * pixels / math.tan(0.5 * _angle(fields, key)), camera.focal[axis]
        if abs(focal / used - 1) > _ROUNDING:
            angle = f"{fields[key][1]}: {key} {fields[key][0]:.5g} is a focal length of {focal:.5g} of {pixels} px"
            found[key] = f"{angle}, {used:.5g} px is stated, too, and used"
    return found


def _angle(fields, key):
    return number_in(fields, key, "radians between 0 and pi, not degrees", 1e-6, math.pi - 1e-6)


def number_in(
    fields: dict[str, tuple[Any, Any]], key: str, expected: str, low: float = -math.inf, high: float = math.inf
) -> float:
    """Returns the float in fields, {key: (value, where)}; ValueError unless it is a number in [low, high]."""
    value, where = fields[key]
    if not is_number(value) or not low <= value <= high:
        raise wrong_value(where, key, value, f"{expected}; correct it or export the file again")
    return float(value)


def wrong_value(where: Any, key: str, value: Any, expected: str) -> ValueError:
    """Returns the error of a field whose value is not the expected one."""
    return ValueError(f"{where}: {key} is {short_repr(value)}, expected {expected}")


def _fields(levels):
    """Returns {key: (value, where it is stated)} of all fields of a camera."""
    fields, keys = {}, (*_OTHERS, *_ANGLES, *_COEFFICIENTS, *_UNSUPPORTED)
    for where, level in levels:
        if "fl_x" not in level and any(key in level for key in _ANGLES):
            fields = {key: field for key, field in fields.items() if key not in ("fl_x", "fl_y")}
        fields |= {key: (level[key], where) for key in keys if key in level}
        if "distortion_params" in level:
            values = level["distortion_params"]
            if not isinstance(values, list) or len(values) != 6:
                raise wrong_value(
                    where, "distortion_params", values, "the numbers k1 k2 k3 k4 p1 p2; export the file again"
                )
            fields |= {key: (value, where) for key, value in zip(_COEFFICIENTS, values, strict=True)}
    return fields


def _focal(fields, size, where):
    lengths = []
    for axis, pixels in zip("xy", size, strict=True):
        if f"fl_{axis}" in fields:
            lengths.append(number_in(fields, f"fl_{axis}", "px between 0.001 and 1e9", 1e-3, 1e9))
        elif f"camera_angle_{axis}" in fields and "fl_x" not in fields:
            lengths.append(0.5 * pixels / math.tan(0.5 * _angle(fields, f"camera_angle_{axis}")))
    if not lengths:
        raise ValueError(
            f"{where}: has no fl_x or camera_angle_x, nor has the file; expected one; export the file again"
        )
    return np.array([lengths[0], lengths[-1]], np.float64)


def _lens(fields, where):
    """Returns the lens and its coefficients; the latter are None for a pinhole."""
    model, place = fields.get("camera_model", (None, where))
    fisheye, flag = fields.get("is_fisheye", (model == "OPENCV_FISHEYE", where))
    other = [key for key in _UNSUPPORTED if key in fields]
    if other or model not in (None, *_PERSPECTIVE, "OPENCV_FISHEYE"):
        found = f"has {other[0]}" if other else f"camera_model is {short_repr(model)}"
        expected = f"{', '.join(_PERSPECTIVE)} or OPENCV_FISHEYE"
        todo = convert(str(model or other), "undistort the images to one of these and export the file again")
        raise ValueError(f"{place}: {found}, expected {expected}; {todo}")
    if not isinstance(fisheye, bool) or (model is not None and fisheye != (model == "OPENCV_FISHEYE")):
        expected = "true or false" if model is None else f"the value that camera_model {model} implies"
        raise wrong_value(flag, "is_fisheye", fisheye, f"{expected}; correct or remove it")
    values = {key: number_in(fields, key, "a number") if key in fields else 0.0 for key in _COEFFICIENTS}
    for key in ("p1", "p2") if fisheye else ("k4",):
        if values[key]:
            kind = "fisheye lens has k1 k2 k3 k4" if fisheye else "perspective lens has k1 k2 k3 p1 p2"
            raise wrong_value(fields[key][1], key, values[key], f"0, as a {kind}; calibrate without it")
    if fisheye:
        return "fisheye", np.array([values[key] for key in ("k1", "k2", "k3", "k4")])
    keys = ("k1", "k2", "p1", "p2", "k3") if values["k3"] else ("k1", "k2", "p1", "p2")
    distortion = np.array([values[key] for key in keys])
    return ("opencv", distortion) if distortion.any() else ("pinhole", None)


def _size(fields, key):
    if key not in fields:
        return None
    pixels = number_in(fields, key, "whole pixels from 1 to 1000000", 1, 1e6)
    if pixels != int(pixels):
        raise wrong_value(fields[key][1], key, pixels, "whole pixels; correct or remove it")
    return int(pixels)
