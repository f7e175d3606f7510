"""What is wrong with a capture, in a line each that ends in the line to change."""

from typing import NamedTuple

import numpy as np


class Finding(NamedTuple):
    """One thing that is not as it should be."""

    severity: str  # "ruins": training on it is time lost, or "note"
    kind: str  # "axes", "focal", "swap", "pose", "size", "file", "mask", "bounds", "points", ...
    found: str
    wanted: str
    change: str  # file, field or flag, and what to do there
    frames: tuple[int, ...] = ()  # those it is about, where it is not about all

    def line(self):
        """Returns the finding in one line."""
        return f"{self.severity.upper():5} {self.found}; wanted {self.wanted}; change: {self.change}"


class _Place(NamedTuple):
    """Where a format keeps its cameras."""

    poses: str
    axes: np.ndarray  # [3, 3]: our camera axes, each by those of the file
    lines: str  # what there stands for an axis
    mirror: str  # how to undo a mirrored world


_FLIP = np.diag([1.0, -1.0, -1.0])
_MATRIX = "negate row 1 of every transform_matrix, too (the world is mirrored)"
_PLACES = {
    "blender": _Place("every transform_matrix of transforms_*.json", np.eye(3), "columns", _MATRIX),
    "transforms": _Place("every transform_matrix of transforms.json", np.eye(3), "columns", _MATRIX),
    "llff": _Place(
        "the 3 x 5 matrix in every row of poses_bounds.npy",
        np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        "columns",
        "negate row 1 of every 3 x 5 matrix but for its column 5, too (the world is mirrored)",
    ),
    "colmap": _Place(
        "every world-to-camera matrix [R | t] of the images file",
        _FLIP,
        "rows",
        "negate column 1 of every R and x of every point, too (the world is mirrored)",
    ),
}


def axes_change(format, axes):
    """Returns what to write into a file whose cameras are stated in the given consistency.Axes."""
    place = _PLACES[format]
    turn = place.axes @ axes.turn @ place.axes.T  # in the file's axes
    columns = [int(round(sign * (which + 1))) for which, sign in zip(*_entries(turn), strict=True)]
    steps = []
    if axes.inverted:
        steps.append("invert it (it is the other way round: world to camera)")
    if columns != [1, 2, 3]:
        if [abs(column) for column in columns] == [1, 2, 3]:
            negated = [str(-column) for column in columns if column < 0]
            steps.append(f"negate {place.lines} {' and '.join(negated)}")
        else:
            steps.append(f"make its {place.lines} {', '.join(f'{column:+d}' for column in columns)} of these")
    if np.linalg.det(axes.turn) < 0:
        steps.append(place.mirror)
    return f"{place.poses}: {', then '.join(steps)}"


def axes_name(axes):
    """Returns in a few words what axes a file's cameras are stated in."""
    if axes.inverted:
        return "world-to-camera matrices"
    if np.array_equal(axes.turn, _FLIP):
        return "OpenCV's axes (y down, looking along +z)"
    if np.linalg.det(axes.turn) < 0:
        return "a mirrored world"
    return "axes turned by right angles"


def focal_change(capture, factor):
    """Returns what to write into a file whose focal length is to be multiplied with a factor."""
    camera = capture.frames[0].camera
    focal = np.asarray(camera.focal) * factor
    if capture.format == "blender":
        angle = 2 * np.arctan(0.5 * camera.width / focal[0])
        return f"transforms_*.json: camera_angle_x to about {angle:.4g}"
    if capture.format == "llff":
        return f"poses_bounds.npy: row 3 of every column 5 to about {focal[0]:.5g}"
    if capture.format == "colmap":
        return f"the cameras file: every focal length times {factor:.3g}, or run COLMAP again"
    return f"transforms.json: fl_x, fl_y (or camera_angle_x) to about {focal[0]:.5g}, {focal[1]:.5g}"


def percent(share, digits=0):
    """Returns a share as text."""
    return f"{100 * share:.{digits}f} %"


def named(capture, indices):
    """Returns the names of the frames with these indices, of many only some."""
    names = ", ".join(capture.frames[index].name for index in indices[:5])
    return names + (f" and {len(indices) - 5} more" if len(indices) > 5 else "")


def _entries(turn):
    """Returns which axis each column of a signed permutation takes, and with which sign."""
    which = np.abs(turn).argmax(axis=0)
    return which, turn[which, np.arange(3)]
