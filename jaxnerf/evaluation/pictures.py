"""The files that evaluation writes: colours, depths, a sheet to look at."""

import pathlib

import imageio.v3 as iio
import numpy as np

from jaxnerf.runtime import shards

SHEET_ROWS = 4


def to_8_bits(image):
    """Returns uint8 of colours in [0, 1], rounded to nearest."""
    return np.rint(np.clip(np.asarray(image), 0, 1) * 255).astype(np.uint8)


def write_view(folder, name, rgb, truth, depth):
    """Writes color/<name>.png, gt-color/<name>.png and depth/<name>.tiff (float32, the capture's units)."""
    files = {"color": to_8_bits(rgb), "gt-color": to_8_bits(truth), "depth": np.asarray(depth, np.float32)}
    for path, pixels in zip(view_files(folder, name), files.values(), strict=True):
        write_whole(path, pixels, make_folder=False)


def view_files(folder, name):
    """Returns the paths that write_view writes, in folders that are there."""
    kinds = {"color": "png", "gt-color": "png", "depth": "tiff"}
    return [pathlib.Path(folder) / kind / f"{name}.{suffix}" for kind, suffix in kinds.items()]


def write_whole(path, pixels, *, make_folder=True):
    """Writes an image so that it is there whole or not at all; the suffix of its path names the format."""
    if make_folder:
        path.parent.mkdir(parents=True, exist_ok=True)
    with shards.partial_of(path) as partial:
        iio.imwrite(partial, pixels, extension=path.suffix)


def cut_out(rgb, opacity, background):
    """Returns [H, W, 4] uint8, straight alpha, of what was rendered over a background (None: black).

    Compositing it over that background again gives rgb. Colour is 0 where alpha rounds to 0.
    """
    alpha = to_8_bits(opacity)[..., None] / 255  # rounded first, so that the colour makes up for it
    own = np.asarray(rgb) - (1 - alpha) * np.asarray((0.0, 0.0, 0.0) if background is None else background)
    straight = np.where(alpha > 0, own / np.maximum(alpha, 1 / 255), 0)
    return to_8_bits(np.concatenate([straight, alpha], axis=-1))


def depth_range(depths, share=0.98):
    """Returns (near, far), between which that share of the finite, positive depths of an iterable lies."""
    samples = np.concatenate([np.ravel(depth)[::17] for depth in depths])  # enough to know the range by
    samples = samples[np.isfinite(samples) & (samples > 0)]
    return tuple(np.quantile(samples, [0.5 - share / 2, 0.5 + share / 2])) if samples.size else (1.0, 2.0)


def depth_picture(depth, near, far):
    """Returns uint8 [H, W]: white at near, black at far and beyond, even in 1 / depth as parallax is."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(depth >= 0, 1 / depth, 0.0)  # NaN is far
    return to_8_bits((inverse - 1 / far) / max(1 / near - 1 / far, 1e-30))


def write_sheet(path, rows):
    """Writes a sheet of rows, uint8 [H, W, 3], that may differ in width; see sheet_row."""
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    write_whole(path, np.concatenate(rows), make_folder=False)


def sheet_row(truth, image):
    """Returns uint8: photograph, rendering, error times 4, opacity, depth (near is bright), side by side.

    Args:
        truth: [H, W, 3].
        image: Rendering [H, W].
    """
    truth = np.asarray(truth)
    step = -(-max(truth.shape) // 400)  # a sheet is to be looked at, not measured
    rgb, opacity, depth = (np.asarray(x) for x in (image.rgb, image.opacity, image.depth))
    grey = [np.repeat(plane[..., None], 3, axis=-1) for plane in (opacity, _near_is_bright(depth))]
    panels = [truth, rgb, np.abs(rgb - truth) * 4, *grey]
    return to_8_bits(np.concatenate([panel[::step, ::step] for panel in panels], axis=1))


def _near_is_bright(depth):
    """Returns depth [H, W] as grey in [0, 1], black where nothing stops the ray before infinity."""
    finite = np.isfinite(depth)
    near, far = (depth[finite].min(), depth[finite].max()) if finite.any() else (0.0, 1.0)
    return np.where(finite, (far - np.where(finite, depth, far)) / max(far - near, 1e-9), 0.0)
