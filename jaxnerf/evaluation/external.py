"""Scores of images that were made elsewhere, against a scene's photographs or a folder of references."""

import json
from pathlib import Path

import numpy as np

from jaxnerf.data.images.image_files import read_image
from jaxnerf.evaluation import protocol
from jaxnerf.evaluation.aggregate import means
from jaxnerf.evaluation.evaluate import live_mask, reference, scores
from jaxnerf.training import build, workdir


def score_folder(folder, *, config=None, split=None, overwrite=False):
    """Scores a folder of images and writes results.json into it.

    Args:
        folder: holds the images, or color/ with them. They pair with the views of the same names where
            all names are those, else in the order of their own.
        config: ConfigDict whose scene is the reference; when None the folder's own gt-color/ is.
        split: of that scene; the configuration's eval.split when None.
        overwrite: whether an earlier results.json is replaced.

    Returns:
        What results.json holds.

    Raises:
        ValueError: if folder, images or references are missing or do not pair up.
    """
    folder = Path(folder)
    target = folder / "results.json"
    if target.exists() and not overwrite:
        raise ValueError(f"{target}: is there already; give --overwrite to score again")
    paths = _images(folder / "color" if (folder / "color").is_dir() else folder)
    if config is None:
        truths = _images(folder / "gt-color")
        references = [_colors(path) for path in truths]
        masks = None
        about = protocol.card_of({"reference": "gt-color"}, [image.shape[:2] for image in references])
    else:
        views, split, conventions = build.photographs(config, split)
        truths = views.names
        references = [np.asarray(reference(views, index)) for index in range(len(truths))]
        masks = [live_mask(views, index) for index in range(len(truths))]
        about = protocol.metric_card(conventions, views, split=split)
    if len(paths) != len(truths):
        raise ValueError(f"{paths[0].parent}: has {len(paths)} images, the reference {len(truths)}; wanted one each")
    names = [Path(str(truth)).stem for truth in truths]
    if sorted(names) == sorted(path.stem for path in paths):
        paths.sort(key=lambda path: names.index(path.stem))
    names = [path.name for path in paths]
    results = score_predictions(map(_colors, paths), references, names=names, masks=masks)
    results |= about
    workdir.write_text(target, json.dumps(results, indent=2) + "\n")
    return results


def score_predictions(predictions, references, *, names, masks=None):
    """Returns results for images made elsewhere: the same metrics on 8-bit images, row by row.

    Args:
        predictions, references: iterables of [H, W, 3] colours in [0, 1], in the same order.
        names: one a pair.
        masks: one a pair, see scores; None for none.

    Raises:
        ValueError: if a pair's sizes differ; names it.
    """
    rows = []
    masks = [None] * len(names) if masks is None else masks
    for name, image, truth, mask in zip(names, predictions, references, masks, strict=True):
        if image.shape != truth.shape:
            raise ValueError(f"{name}: is {image.shape}, its reference {truth.shape}; make both one size")
        rows.append({"name": name, **scores(image, truth, mask)})
    return {**means(rows), "views": len(rows), "images": rows}


def _images(folder):
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in (".png", ".jpg", ".jpeg"))
    if not paths:
        raise ValueError(f"{folder}: has no PNG or JPEG images, wanted the images to score; correct the folder")
    return paths


def _colors(path):
    pixels = read_image(path)
    if pixels.shape[-1] == 4:
        if pixels[..., 3].min() < np.iinfo(pixels.dtype).max:
            raise ValueError(f"{path}: is partly transparent, wanted the colours to score; composite it first")
        pixels = pixels[..., :3]
    return (pixels / np.iinfo(pixels.dtype).max).astype(np.float32)
