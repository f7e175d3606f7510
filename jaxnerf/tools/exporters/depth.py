"""The export "depth": median depth images, their colours and their cameras."""

import json
import pathlib

import numpy as np

from jaxnerf.evaluation.output_images import write_image
from jaxnerf.options import is_auto
from jaxnerf.runtime import atomic_files
from jaxnerf.tools.exporters.base import ExportSource
from jaxnerf.tools.exporters.surfaces import inside, render_depth_images


def export_depth(source: ExportSource, folder: pathlib.Path) -> None:
    """Writes depth/NAME.tiff, images/NAME.png and transforms.json, with which other programs can fuse the depths.

    A depth is float32, along the camera's axis, in the units of the dataset's files; 0 where a pixel shows no surface
    or one outside the box. The cameras are pinholes, in the layout of nerfstudio's transforms.json.
    """
    for name in ("depth", "images"):
        (folder / name).mkdir()
    size, box = source.settings.size, source.settings.corners
    frames, images = [], render_depth_images(source, None if is_auto(size) else size)
    files = [pathlib.PurePath(image.name).name for image in images]
    if len(set(files)) < len(files):  # of images in several folders
        files = [f"{index:04d}_{file}" for index, file in enumerate(files)]
    for file, image in zip(files, images, strict=True):
        kept = np.isfinite(image.depth) & inside(image.points(), box)
        write_image(folder / "depth" / f"{file}.tiff", np.where(kept, image.depth, 0))
        write_image(folder / "images" / f"{file}.png", image.rgb)
        matrix = np.concatenate([np.float64(image.camera.to_world), [[0, 0, 0, 1]]])
        paths = {"file_path": f"images/{file}.png", "depth_file_path": f"depth/{file}.tiff"}
        frames.append({**paths, "transform_matrix": matrix.tolist()})
    camera = images[0].camera
    names = ("fl_x", "fl_y", "cx", "cy")
    lens = dict(zip(names, map(float, [*camera.focal, *camera.center]), strict=True))
    content = {"camera_model": "OPENCV", "w": camera.width, "h": camera.height, **lens, "depth_unit_scale_factor": 1.0}
    atomic_files.write_text(folder / "transforms.json", json.dumps({**content, "frames": frames}, indent=1) + "\n")
    source.say(f"{len(images)} depth images of {camera.width} x {camera.height} px, float32, in the dataset's units")
