"""The files that evaluation writes: colours, depths, a sheet to look at."""

import pathlib

import imageio.v3 as iio
import numpy as np

SHEET_ROWS = 4


def to_8_bits(image):
    """Returns uint8 of colours in [0, 1], rounded to nearest."""
    return np.rint(np.clip(np.asarray(image), 0, 1) * 255).astype(np.uint8)


def write_view(folder, name, rgb, truth, depth):
    """Writes color/<name>.png, gt-color/<name>.png and depth/<name>.tiff (float32, world units)."""
    folder = pathlib.Path(folder)
    files = {"color": to_8_bits(rgb), "gt-color": to_8_bits(truth), "depth": np.asarray(depth, np.float32)}
    for kind, pixels in files.items():
        (folder / kind).mkdir(parents=True, exist_ok=True)
        iio.imwrite(folder / kind / f"{name}.{'tiff' if kind == 'depth' else 'png'}", pixels)


def write_sheet(path, pairs):
    """Writes a sheet, a row a view: photograph, rendering, error times 4, opacity, depth (near is bright).

    Args:
        path: of the PNG.
        pairs: list of (truth [H, W, 3], Rendering [H, W]).
    """
    rows = [_sheet_row(np.asarray(truth), image) for truth, image in pairs]
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=1) for row in rows]
    iio.imwrite(path, to_8_bits(np.concatenate(rows)))


def _sheet_row(truth, image):
    step = -(-max(truth.shape) // 400)  # a sheet is to be looked at, not measured
    rgb, opacity, depth = (np.asarray(x) for x in (image.rgb, image.opacity, image.depth))
    grey = [np.repeat(plane[..., None], 3, axis=-1) for plane in (opacity, _near_is_bright(depth))]
    panels = [truth, rgb, np.abs(rgb - truth) * 4, *grey]
    return np.concatenate([panel[::step, ::step] for panel in panels], axis=1)


def _near_is_bright(depth):
    """Returns depth [H, W] as grey in [0, 1], black where nothing stops the ray before infinity."""
    finite = np.isfinite(depth)
    near, far = (depth[finite].min(), depth[finite].max()) if finite.any() else (0.0, 1.0)
    return np.where(finite, (far - np.where(finite, depth, far)) / max(far - near, 1e-9), 0.0)
