"""Scores of images that were made elsewhere, against a scene's photographs or a folder of references."""

import json
import pathlib

import numpy as np

from jaxnerf.data.images import read_image
from jaxnerf.engine import build, workdir
from jaxnerf.engine.evaluate import reference, score_predictions


def score_folder(folder, *, config=None, split=None, overwrite=False):
    """Scores a folder of images and writes results.json into it.

    Args:
        folder: holds the images, or color/ with them; sorted by name.
        config: ConfigDict whose scene is the reference; when None the folder's own gt-color/ is.
        split: of that scene; the configuration's eval.split when None.
        overwrite: whether an earlier results.json is replaced.

    Returns:
        What results.json holds.

    Raises:
        ValueError: if folder, images or references are missing or do not pair up.
    """
    folder = pathlib.Path(folder)
    target = folder / "results.json"
    if target.exists() and not overwrite:
        raise ValueError(f"{target}: is there already; give --overwrite to score again")
    paths = _images(folder / "color" if (folder / "color").is_dir() else folder)
    if config is None:
        truths = _images(folder / "gt-color")
        references = [_colors(path) for path in truths]
        conventions = {"reference": "gt-color"}
    else:
        experiment = build.build(config)
        split = split or experiment.eval.split
        views = experiment.load_views(split)
        truths = views.names
        references = [np.asarray(reference(views, index)) for index in range(len(truths))]
        conventions = {**experiment.conventions, "split": split}
    if len(paths) != len(truths):
        raise ValueError(
            f"{paths[0].parent}: has {len(paths)} images, the reference {len(truths)}; wanted one each"
        )
    results = score_predictions(map(_colors, paths), references, names=[path.name for path in paths])
    results["conventions"] = conventions
    workdir.write_text(target, json.dumps(results, indent=2) + "\n")
    return results


def _images(folder):
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in (".png", ".jpg", ".jpeg"))
    if not paths:
        raise ValueError(
            f"{folder}: has no PNG or JPEG images, wanted the images to score; correct the folder"
        )
    return paths


def _colors(path):
    pixels = read_image(path)[..., :3]
    return (pixels / np.iinfo(pixels.dtype).max).astype(np.float32)
