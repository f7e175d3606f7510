"""What a reader of a format finds in a folder: posed photographs, not yet opened, in the file's own world."""

import hashlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnerf.core.types import Camera
from jaxnerf.registry import READERS


class Frame(NamedTuple):
    """One photograph and its camera."""

    name: str  # of the file below its folder of images, without extension, with / between folders
    image: Path  # exists
    camera: Camera  # float64; height and width are what the format states for the photograph, or None
    mask: Path | None = None  # exists; grey, where 0 the photograph is to be ignored
    turned: bool = True  # whether EXIF orientation is followed: COLMAP counts pixels as they are stored
    bounds: tuple[float, float] | None = None  # nearest and farthest matter, world units along the axis
    seen: Any = None  # [M] indices of the Capture's points that this photograph shows; None: not known
    seen_at: Any = None  # [M, 2] px where


class Capture(NamedTuple):
    """The photographs of a folder, in the order of their names."""

    format: str  # "colmap", "llff", "transforms" or "blender"
    source: Path  # the file or folder that the cameras were read from
    frames: tuple[Frame, ...]
    splits: dict[str, tuple[int, ...]] | None = None  # by name, indices of frames; None: the file has none
    points: np.ndarray | None = None  # [N, 3] float64, matter on surfaces; None: not known
    box: tuple | None = None  # (lower [3], upper [3]) outside which the format says there is nothing
    notes: tuple[str, ...] = ()  # a line each: what was left out of the folder, and why


def fingerprint(capture):
    """Returns a line that is the same as long as a Capture's photographs, cameras and splits are the same."""
    digest = hashlib.sha256(repr(capture.splits).encode())
    for frame in capture.frames:
        camera = frame.camera
        digest.update(repr((frame.name, camera.lens, camera.height, camera.width)).encode())
        for array in (camera.to_world, camera.focal, camera.center, camera.distortion):
            digest.update(b"" if array is None else np.float32(array).tobytes())
    return f"{len(capture.frames)} photographs, {digest.hexdigest()[:8]}"


def formats_in(folder) -> list[str]:
    """Returns the names of the formats whose files lie in a folder, the one that is read first.

    Raises:
        ValueError: if there is none.
    """
    folder = Path(folder)
    found = [name for name in READERS.names() if READERS.get(name).detect(folder)]
    if not found:
        raise ValueError(
            f"{folder}: holds no dataset, expected transforms_train.json (Blender), transforms.json, a COLMAP "
            "model in sparse/0, or poses_bounds.npy (LLFF); correct the folder"
        )
    return found


def read_capture(folder, format: str = "auto") -> Capture:
    """Reads the Capture in a folder, in a given format or in the first that is found.

    Raises:
        ValueError: names the file, what was found, what is expected and what to do.
    """
    return READERS.get(formats_in(folder)[0] if format == "auto" else format).read(folder)
