"""Findings of a check: one line each, which ends in the file, field or flag to change."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxnerf.data.readers.base import Capture


class Finding(NamedTuple):
    """One problem of a dataset.

    Attributes:
        severity: "error" where training would be useless, or "warning".
        kind: "axes", "focal", "swap", "pose", "fold", "overlap", "points", "size", "file", "mask", "duplicate",
            "blur", "bounds", "leak" or "skipped".
        found: what the check found, with the name of the file.
        expected: what it expects there; empty for the note of a reader.
        change: the file, field or flag to change, and how.
        frames: indices of the frames concerned; empty if the finding concerns all frames.
    """

    severity: str
    kind: str
    found: str
    expected: str
    change: str
    frames: tuple[int, ...] = ()

    def line(self) -> str:
        """Returns the finding as one line of text; a note of a reader expects nothing."""
        if not self.expected:
            return f"{self.severity.upper():7} {self.found}"
        return f"{self.severity.upper():7} {self.found}; expected {self.expected}; change: {self.change}"


class _PoseFile(NamedTuple):
    """How a format stores camera poses.

    Attributes:
        poses: the matrices, in words.
        axes: [3, 3], the camera axes of jaxnerf in those of the file.
        lines: the part of a matrix that holds one axis: "columns" or "rows".
        mirror: how to mirror the world in one coordinate.
    """

    poses: str
    axes: np.ndarray
    lines: str
    mirror: str


_FLIP = np.diag([1.0, -1.0, -1.0])
_MIRROR_ROW = "also negate row 1 of every transform_matrix (the world is mirrored)"
_POSE_FILES = {
    "blender": _PoseFile("every transform_matrix of transforms_*.json", np.eye(3), "columns", _MIRROR_ROW),
    "transforms": _PoseFile("every transform_matrix of the JSON files", np.eye(3), "columns", _MIRROR_ROW),
    "llff": _PoseFile(
        "the 3 x 5 matrix in every row of poses_bounds.npy",
        np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        "columns",
        "also negate row 1 of every 3 x 5 matrix except in column 5 (the world is mirrored)",
    ),
    "colmap": _PoseFile(
        "every world-to-camera matrix [R | t] of the images file",
        _FLIP,
        "rows",
        "also negate column 1 of every R and x of every point (the world is mirrored)",
    ),
}


def axes_change(format: str, turn: Float[np.ndarray, "3 3"], inverted: bool) -> str:
    """Returns the edit that corrects a file whose cameras are stored in other axes.

    Args:
        format: of the dataset.
        turn: from the intended camera's axes to the stored one's, a signed permutation.
        inverted: whether the file stores world to camera.
    """
    file = _POSE_FILES.get(format, _PoseFile("every pose", np.eye(3), "columns", "also mirror the world"))
    in_file = file.axes @ turn @ file.axes.T
    rows = np.abs(in_file).argmax(axis=0)
    columns = [int(round(sign * (row + 1))) for row, sign in zip(rows, in_file[rows, np.arange(3)], strict=True)]
    steps = []
    if inverted:
        steps.append("invert it (it maps world to camera)")
    if [abs(column) for column in columns] != [1, 2, 3]:
        steps.append(f"replace its {file.lines} by {', '.join(f'{column:+d}' for column in columns)} of the old ones")
    elif columns != [1, 2, 3]:
        steps.append(f"negate {file.lines} {' and '.join(str(-column) for column in columns if column < 0)}")
    if np.linalg.det(turn) < 0:
        steps.append(file.mirror)
    return f"{file.poses}: {', then '.join(steps)}"


def axes_name(turn: Float[np.ndarray, "3 3"], inverted: bool) -> str:
    """Returns the name of the convention that camera axes follow; see `axes_change`."""
    if inverted:
        return "world-to-camera matrices"
    if np.array_equal(turn, _FLIP):
        return "OpenCV's axes (y down, looking along +z)"
    if np.linalg.det(turn) < 0:
        return "a mirrored world"
    return "axes turned by right angles"


def focal_change(capture: Capture, factor: float) -> str:
    """Returns the edit that multiplies the focal length of a dataset by a factor."""
    camera = capture.frames[0].camera
    focal = np.asarray(camera.focal) * factor
    if capture.format == "blender":
        angle = 2 * np.arctan(0.5 * camera.width / focal[0])
        return f"transforms_*.json: camera_angle_x to about {angle:.4g}"
    if capture.format == "llff":
        return f"poses_bounds.npy: row 3 of every column 5 to about {focal[0]:.5g}"
    if capture.format == "colmap":
        return f"the cameras file: every focal length times {factor:.3g}, or run COLMAP again"
    return f"{capture.source.name}: fl_x, fl_y (or camera_angle_x) to about {focal[0]:.5g}, {focal[1]:.5g}"


def percent(fraction: float, digits: int = 0) -> str:
    """Returns a fraction as text in percent."""
    return f"{100 * fraction:.{digits}f} %"


def named(capture: Capture, indices: Sequence[int]) -> str:
    """Returns the names of frames, the first five if there are more."""
    names = ", ".join(capture.frames[index].name for index in indices[:5])
    return names + (f" and {len(indices) - 5} more" if len(indices) > 5 else "")
