"""Findings of a check: one line each, which ends in the file, field or flag to change."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxnerf.data.readers.base import CameraFiles, Capture

NOTES = "jaxnerf_notes.txt"  # beside a COLMAP model: what jaxnerf-cameras found that may be wrong with it


class Finding(NamedTuple):
    """One problem of a dataset.

    Attributes:
        severity: "error" where training would be useless, or "warning".
        kind: "axes", "focal", "lens", "swap", "pose", "fold", "overlap", "points", "size", "file", "mask", "training",
            "accuracy", "duplicate", "blur", "bounds", "leak" or "skipped".
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


_FLIP = np.diag([1.0, -1.0, -1.0])


def axes_change(files: CameraFiles, turn: Float[np.ndarray, "3 3"], inverted: bool) -> str:
    """Returns the edit that corrects a file whose cameras are stored in other axes.

    Args:
        files: see `Capture.files`.
        turn: from the intended camera's axes to the stored one's, a signed permutation.
        inverted: whether the file stores world to camera.
    """
    in_file = files.axes @ turn @ files.axes.T
    rows = np.abs(in_file).argmax(axis=0)
    columns = [int(round(sign * (row + 1))) for row, sign in zip(rows, in_file[rows, np.arange(3)], strict=True)]
    steps = []
    if inverted:
        steps.append("invert it (it maps world to camera)")
    if [abs(column) for column in columns] != [1, 2, 3]:
        steps.append(f"replace its {files.lines} by {', '.join(f'{column:+d}' for column in columns)} of the old ones")
    elif columns != [1, 2, 3]:
        steps.append(f"negate {files.lines} {' and '.join(str(-column) for column in columns if column < 0)}")
    if np.linalg.det(turn) < 0:
        steps.append(files.mirror)
    return f"{files.poses}: {', then '.join(steps)}"


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
    x, y = np.asarray(camera.focal) * factor
    angle = 2 * np.arctan(0.5 * (camera.width or 2 * camera.center[0]) / x)
    return capture.files.focal.format(file=capture.source.name, x=x, y=y, factor=factor, angle=angle)


def percent(fraction: float, digits: int = 0) -> str:
    """Returns a fraction as text in percent."""
    return f"{100 * fraction:.{digits}f} %"


def named(capture: Capture, indices: Sequence[int]) -> str:
    """Returns the names of frames, the first five if there are more."""
    names = ", ".join(capture.frames[index].name for index in indices[:5])
    return names + (f" and {len(indices) - 5} more" if len(indices) > 5 else "")
