"""Videos of pictures that lie on disk: MP4 with the video extra, GIF without."""

import glob
import importlib.util
import warnings

import imageio.v2
import imageio.v3 as iio
import numpy as np

from jaxnerf.runtime import shards

KINDS = ("auto", "mp4", "gif", "none")


def video_suffix(kind):
    """Returns ".mp4" or ".gif", or None for "none"; "auto" is MP4 where imageio finds ffmpeg.

    Raises:
        ValueError: on another kind, or on "mp4" without ffmpeg.
    """
    if kind not in KINDS:
        raise ValueError(f"video is {kind!r}, wanted one of {', '.join(KINDS)}")
    ffmpeg = importlib.util.find_spec("imageio_ffmpeg")
    if kind == "mp4" and not ffmpeg:
        raise ValueError("video is 'mp4', but imageio finds no ffmpeg; pip install 'jaxnerf[video]'")
    if kind == "none":
        return None
    return ".mp4" if ffmpeg and kind != "gif" else ".gif"


def write_video(path, pictures, fps):
    """Writes a video so that it is there whole or not at all.

    Args:
        path: ends in .mp4 or .gif.
        pictures: paths of PNGs of one size, grey or RGB; read one at a time.
        fps: frames a second. A GIF holds it in hundredths of a second a frame.
    """
    unfinished = f".tmp{path.suffix}"  # by whose end ffmpeg knows the format
    with shards.partial_of(path, unfinished) as partial, warnings.catch_warnings():
        # JAX warns of forks; this one becomes ffmpeg at once and runs nothing of ours.
        warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
        with imageio.v2.get_writer(partial, **_options(path.suffix, fps)) as writer:
            for picture in pictures:
                pixels = iio.imread(picture)
                pixels = np.repeat(pixels[..., None], 3, axis=-1) if pixels.ndim == 2 else pixels
                writer.append_data(_even(pixels) if path.suffix == ".mp4" else pixels)
    shards.sweep(path.parent, f"{glob.escape(path.name)}.*{unfinished}")


def _options(suffix, fps):
    if suffix == ".gif":
        return {"duration": 1000 / fps, "loop": 0}
    return {"fps": fps, "codec": "libx264", "macro_block_size": 1, "quality": 8, "pixelformat": "yuv420p"}


def _even(pixels):
    """Returns the picture in even sides, what the codec takes: an odd one loses its last row or column."""
    pixels = np.pad(pixels, [(0, int(side == 1)) for side in pixels.shape[:2]] + [(0, 0)], mode="edge")
    height, width = (side - side % 2 for side in pixels.shape[:2])
    return pixels[:height, :width]
