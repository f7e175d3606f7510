"""Writes images of a Blender dataset at several sizes, as the multi-scale dataset of arXiv:2103.13415, Section 5."""

import json
import os
import pathlib

import numpy as np
from PIL import Image

from jaxnerf.data.images.image_files import average_tiles, read_image
from jaxnerf.data.readers import blender
from jaxnerf.runtime.atomic_files import write_text

WHITE = (1.0, 1.0, 1.0)


def write_scales(source: pathlib.Path, folder: pathlib.Path, *, factor: int, num_scales: int, repeat: int) -> None:
    """Writes the splits "train" and "test" of a dataset in Blender's format; a finished folder is kept.

    transforms_<split>.json lists each image at each size, with its own w, h and intrinsics, as r_0_d0, r_0_d1, ... The
    pixels of each size are the means over those of the original, with white behind them. Training draws all pixels
    alike, so that a training image is listed `repeat` times as often as at the next larger size: 4 draws as many rays
    of each size, as the paper's weights of the losses, the pixels' areas, count them.

    Args:
        source: the dataset's folder.
        folder: to write.
        factor: by which the largest size is shrunk.
        num_scales: sizes, each half of the one before.
        repeat: see above.
    """
    for split, times in (("train", repeat), ("test", 1)):
        listed = folder / f"transforms_{split}.json"
        if listed.exists():
            continue
        (folder / split).mkdir(parents=True, exist_ok=True)
        frames = []
        for frame in blender.read_capture(source, split=split).frames:
            pixels = read_image(frame.image)
            for scale in range(num_scales):
                names = [f"{split}/{frame.name}_d{scale}" + f"_{k}" * (k > 0) for k in range(times**scale)]
                entry = _write(pixels, frame.camera, factor * 2**scale, folder, names)
                frames += [{**entry, "file_path": name} for name in names]
        write_text(listed, json.dumps({"frames": frames}))


def _write(pixels, camera, factor, folder, names):
    """Writes an image, shrunk by a factor, under several names; returns its entries in the file."""
    height, width = (side // factor for side in pixels.shape[:2])
    small = average_tiles(pixels[: height * factor, : width * factor], factor, background=WHITE)
    paths = [folder / f"{name}.png" for name in names]
    Image.fromarray(np.rint(small / 257).astype(np.uint8)).save(paths[0])
    for path in paths[1:]:
        path.unlink(missing_ok=True)
        os.link(paths[0], path)
    focal, center = camera.focal / factor, camera.center / factor
    lens = {"fl_x": focal[0], "fl_y": focal[1], "cx": center[0], "cy": center[1]}
    pose = np.vstack([camera.to_world, [0, 0, 0, 1]]).tolist()
    return {"w": width, "h": height, **{key: float(each) for key, each in lens.items()}, "transform_matrix": pose}
