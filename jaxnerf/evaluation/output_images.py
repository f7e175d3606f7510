"""Image files that evaluation writes: colours, depths, a contact sheet."""

import pathlib
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import imageio.v3 as iio
import numpy as np
from jax.typing import ArrayLike

from jaxnerf.core.types import Rendering
from jaxnerf.data.images.image_files import read_stored
from jaxnerf.data.images.pixel_cache import num_workers
from jaxnerf.runtime import atomic_files

CONTACT_SHEET_ROWS = 4
_VIEW_FILES = {"color": "png", "gt-color": "png", "depth": "tiff"}
_CHANNELS = {"depth": (), "uncertainty": (), "rgba": (4,)}  # of images in a folder of that name; all others have (3,)
_FLOATS = ("depth", "uncertainty")  # folders whose images are float32; all others are uint8


def to_8_bits(image: ArrayLike) -> np.ndarray:
    """Converts colours in [0, 1] to uint8, rounded to nearest."""
    return np.rint(np.clip(np.asarray(image), 0, 1) * 255).astype(np.uint8)


def write_view(
    folder: pathlib.Path, name: str, rgb: ArrayLike, truth: ArrayLike, depth: ArrayLike, error: ArrayLike | None = None
) -> None:
    """Writes color/NAME.png, gt-color/NAME.png, depth/NAME.tiff and, if it is predicted, the error of each pixel.

    Depths, in the dataset's units, and uncertainty/NAME.tiff, in units of colour, are float32.
    """
    floats = [np.asarray(plane, np.float32) for plane in (depth, error) if plane is not None]
    paths = view_files(folder, name, errors=error is not None)
    for path, pixels in zip(paths, [to_8_bits(rgb), to_8_bits(truth), *floats], strict=True):
        path.parent.mkdir(exist_ok=True)
        write_image(path, pixels)


def view_files(folder: pathlib.Path, name: str, *, errors: bool) -> list[pathlib.Path]:
    """Returns the paths that `write_view` writes, with or without predicted errors."""
    kinds = {**_VIEW_FILES, **({"uncertainty": "tiff"} if errors else {})}
    return [pathlib.Path(folder) / kind / f"{name}.{suffix}" for kind, suffix in kinds.items()]


def readable(
    groups: Sequence[Sequence[pathlib.Path]],
    sizes: Sequence[tuple[int, int]],
    *,
    is_valid: Callable[[Any], bool] = lambda content: True,
) -> list[bool]:
    """Returns for each group of image and JSON files whether all exist and are whole; prints those that are not.

    Args:
        groups: of paths.
        sizes: (height, width) of the images of each group, except those in a folder contact_sheet.
        is_valid: returns whether the content of a JSON file is as expected.
    """

    def check(files, size):
        for file in files if all(file.is_file() for file in files) else ():
            try:
                if file.suffix == ".json":
                    valid = is_valid(atomic_files.read_json(file, ""))
                else:
                    pixels, kind = read_stored(file), file.parent.name
                    shape = (*(pixels.shape[:2] if kind == "contact_sheet" else size), *_CHANNELS.get(kind, (3,)))
                    valid = pixels.shape == shape and pixels.dtype == (np.float32 if kind in _FLOATS else np.uint8)
                if not valid:
                    raise ValueError("unexpected content")
            except (ValueError, OSError):
                if file.is_file():  # otherwise another process has finished and moved the folder
                    print(f"{file}: is damaged; its view is rendered again", file=sys.stderr)
                return False
        return all(file.is_file() for file in files)

    with ThreadPoolExecutor(num_workers()) as pool:
        return list(pool.map(check, groups, sizes))


def write_image(path: pathlib.Path, pixels: ArrayLike) -> None:
    """Writes an image into an existing folder, completely or not at all; the path's suffix selects the format."""
    with atomic_files.partial_file(path) as partial:
        iio.imwrite(partial, pixels, extension=path.suffix)


def straight_alpha(rgb: ArrayLike, opacity: ArrayLike, background: Sequence[float] | None) -> np.ndarray:
    """Removes the background from a rendering: [H, W, 4] uint8 with straight alpha.

    Compositing the result over the background gives rgb again. Colour is 0 where alpha rounds to 0.

    Args:
        rgb: [H, W, 3] in [0, 1], rendered over the background.
        opacity: [H, W] in [0, 1].
        background: [3], or None for black.
    """
    alpha = to_8_bits(opacity)[..., None] / 255  # rounded first, so that the colour compensates for the rounding
    emitted = np.asarray(rgb) - (1 - alpha) * np.asarray((0.0, 0.0, 0.0) if background is None else background)
    straight = np.where(alpha > 0, emitted / np.maximum(alpha, 1 / 255), 0)
    return to_8_bits(np.concatenate([straight, alpha], axis=-1))


def depth_range(depths: Iterable[np.ndarray], fraction: float = 0.98) -> tuple[ArrayLike, ArrayLike]:
    """Returns (near, far), between which a fraction of all finite, positive depths lies; (1, 2) without any."""
    samples = np.concatenate([np.ravel(depth)[::17] for depth in depths])  # enough to estimate the range
    samples = samples[np.isfinite(samples) & (samples > 0)]
    return tuple(np.quantile(samples, [0.5 - fraction / 2, 0.5 + fraction / 2])) if samples.size else (1.0, 2.0)


def largest_error(errors: Iterable[np.ndarray], fraction: float = 0.99) -> float:
    """Returns what a fraction of all predicted errors stay below; 0 without any."""
    samples = np.concatenate([np.ravel(error)[::17] for error in errors])
    return float(np.quantile(samples, fraction)) if samples.size else 0.0


def depth_image(depth: np.ndarray, near: ArrayLike, far: ArrayLike) -> np.ndarray:
    """Returns uint8 [H, W]: white at near, black at far and beyond, linear in 1 / depth as parallax is."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(depth >= 0, 1 / depth, 0.0)  # NaN is far
    return to_8_bits((inverse - 1 / far) / max(1 / near - 1 / far, 1e-30))


def write_contact_sheet(path: pathlib.Path, rows: Sequence[np.ndarray]) -> None:
    """Writes rows [H, W, 3] uint8 below each other; they may differ in width. See `contact_sheet_row`."""
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    write_image(path, np.concatenate(rows))


def contact_sheet_row(truth: ArrayLike, image: Rendering) -> np.ndarray:
    """Returns uint8: truth, rendering, error times 4, opacity and depth (near is bright), side by side.

    Args:
        truth: [H, W, 3] in [0, 1].
        image: Rendering [H, W].
    """
    truth = np.asarray(truth)
    step = -(-max(truth.shape) // 400)  # the sheet is an overview, so large images are subsampled
    rgb, opacity, depth = (np.asarray(x) for x in (image.rgb, image.opacity, image.depth))
    gray = [np.repeat(plane[..., None], 3, axis=-1) for plane in (opacity, _near_is_bright(depth))]
    panels = [truth, rgb, np.abs(rgb - truth) * 4, *gray]
    return to_8_bits(np.concatenate([panel[::step, ::step] for panel in panels], axis=1))


def _near_is_bright(depth):
    """Returns depth [H, W] as gray in [0, 1], black where the ray's depth is infinite."""
    finite = np.isfinite(depth)
    near, far = (depth[finite].min(), depth[finite].max()) if finite.any() else (0.0, 1.0)
    return np.where(finite, (far - np.where(finite, depth, far)) / max(far - near, 1e-9), 0.0)
