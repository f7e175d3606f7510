"""Writes videos of images on disk: MP4 where imageio finds ffmpeg, GIF without."""

import glob
import importlib.util
import pathlib
import warnings
from collections.abc import Iterable

import imageio.v2
import numpy as np

from jaxnerf.data.images.image_files import read_stored
from jaxnerf.runtime import atomic_files

KINDS = ("auto", "mp4", "gif", "none")


def video_suffix(kind: str) -> str | None:
    """Returns ".mp4" or ".gif", or None for "none"; "auto" is MP4 where imageio finds ffmpeg.

    Raises:
        ValueError: on another kind, or on "mp4" without ffmpeg.
    """
    if kind not in KINDS:
        raise ValueError(f"video is {kind!r}, expected one of {', '.join(KINDS)}")
    ffmpeg = importlib.util.find_spec("imageio_ffmpeg")
    if kind == "mp4" and not ffmpeg:
        raise ValueError("video is 'mp4', but imageio finds no ffmpeg; pip install imageio-ffmpeg")
    if kind == "none":
        return None
    return ".mp4" if ffmpeg and kind != "gif" else ".gif"


def write_video(path: pathlib.Path, frames: Iterable[pathlib.Path], fps: float) -> None:
    """Writes a video, whole or not at all.

    Args:
        path: ends in .mp4 or .gif.
        frames: paths of PNGs of one size, grey or RGB; read one at a time.
        fps: frames per second. A GIF stores the duration of a frame in hundredths of a second.
    """
    unfinished = f".tmp{path.suffix}"  # ffmpeg infers the format from it
    with atomic_files.partial_file(path, unfinished) as partial, warnings.catch_warnings():
        # JAX warns of forks; this one runs ffmpeg at once and no Python.
        warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
        with imageio.v2.get_writer(partial, **_options(path.suffix, fps)) as writer:
            for frame in frames:
                pixels = read_stored(frame)
                pixels = np.repeat(pixels[..., None], 3, axis=-1) if pixels.ndim == 2 else pixels
                writer.append_data(_even(pixels) if path.suffix == ".mp4" else pixels)
    atomic_files.sweep(path.parent, f"{glob.escape(path.name)}.*{unfinished}")


def _options(suffix, fps):
    if suffix == ".gif":
        return {"duration": 1000 / fps, "loop": 0}
    return {"fps": fps, "codec": "libx264", "macro_block_size": 1, "quality": 8, "pixelformat": "yuv420p"}


def _even(pixels):
    """Crops an image to even sides, which the codec requires; a side of 1 is repeated."""
    pixels = np.pad(pixels, [(0, int(side == 1)) for side in pixels.shape[:2]] + [(0, 0)], mode="edge")
    height, width = (side - side % 2 for side in pixels.shape[:2])
    return pixels[:height, :width]
