"""Scores predictions, images that were rendered elsewhere, against a dataset or a folder of references."""

import json
import logging
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from jaxnerf.data.geometry.path_poses import natural_key
from jaxnerf.data.images.image_files import IMAGE_SUFFIXES, is_hidden, read_image
from jaxnerf.evaluation import protocol
from jaxnerf.evaluation.aggregate import means
from jaxnerf.evaluation.metrics import image_metrics, pixel_mask
from jaxnerf.runtime import atomic_files
from jaxnerf.training import build
from jaxnerf.training.config import Config

_logger = logging.getLogger(__name__)


def score_folder(
    folder: str | os.PathLike,
    *,
    config: Config | None = None,
    split: str | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Scores a folder of predictions and writes results.json into it.

    Args:
        folder: holds the images, or color/ with them. They are paired with the views by name if all names agree,
            otherwise by the last number in each name if these agree, otherwise in order: images in that of their names,
            r_9 before r_10, views as the dataset lists them. A warning says how, unless names agree.
        config: its dataset is the reference; None: the folder's own gt-color/.
        split: of that dataset; the config's eval.split when None.
        overwrite: whether an earlier results.json is replaced.

    Returns:
        What results.json holds.

    Raises:
        ValueError: if folder, images or references are missing or do not pair up.
    """
    folder = Path(folder)
    target = folder / "results.json"
    if target.exists() and not overwrite:
        raise ValueError(f"{target}: exists already; give --overwrite to score again")
    paths = _image_paths(folder / "color" if (folder / "color").is_dir() else folder)
    if config is None:
        truths = _image_paths(folder / "gt-color")
        references, masks = [_colors(path) for path in truths], None
        about = protocol.of_images({"reference": "gt-color"}, [image.shape[:2] for image in references])
    else:
        views, split, conventions = build.load_split(config, split)
        truths = views.names
        references = [np.asarray(views.image(index)) for index in range(len(truths))]
        masks = [pixel_mask(views, index) for index in range(len(truths))]
        about = protocol.of_views(conventions, views, split=split)
    names = [Path(str(truth)).stem for truth in truths]
    if len(paths) != len(truths):
        raise ValueError(
            f"{paths[0].parent}: holds {len(paths)} images, expected {len(truths)}, one for each reference"
            f"{_unpaired([path.stem for path in paths], names)}; add or remove images"
        )
    paths, how = _paired(paths, names)
    names = [path.name for path in paths]
    results = score_predictions(map(_colors, paths), references, names=names, masks=masks) | {"paired_by": how, **about}
    atomic_files.write_text(target, json.dumps(results, indent=2) + "\n")
    return results


def score_predictions(
    predictions: Iterable[ArrayLike],
    references: Iterable[ArrayLike],
    *,
    names: Sequence[str],
    masks: Sequence[ArrayLike | None] | None = None,
) -> dict[str, Any]:
    """Scores images that were rendered elsewhere with the metrics of `evaluate`.

    Args:
        predictions, references: [H, W, 3] colours in [0, 1], in the same order.
        names: one for each pair.
        masks: one for each pair, see `image_metrics`; None for none.

    Returns:
        The means, the number of views, and a row for each image.

    Raises:
        ValueError: if the sizes of a pair differ; names it.
    """
    rows = []
    masks = [None] * len(names) if masks is None else masks
    for name, image, truth, mask in zip(names, predictions, references, masks, strict=True):
        if image.shape != truth.shape:
            times = max(truth.shape[0] // image.shape[0], 1)
            smaller = times > 1 and tuple(side // times for side in truth.shape[:2]) == image.shape[:2]
            hint = f"; --config=default --config.data.factor={times} reads a dataset at that size" if smaller else ""
            raise ValueError(f"{name}: has shape {image.shape}, its reference {truth.shape}; give both one size{hint}")
        rows.append({"name": name, **image_metrics(image, truth, mask)})
    return {**means(rows), "views": len(rows), "images": rows}


def _unpaired(found, expected):
    """Returns which names have no reference, and which references no image, if most names agree."""
    extra, missing = (sorted(set(a) - set(b), key=natural_key) for a, b in ((found, expected), (expected, found)))
    if len(missing) > len(expected) / 2:
        return ""
    parts = [(extra, "without a reference"), (missing, "missing")]
    return "".join(f"; {what}: {', '.join(some[:5])}{' ...' if some[5:] else ''}" for some, what in parts if some)


def _paired(paths, names):
    """Returns the paths, given in natural order, in the order of the references, and by what they were paired."""
    for how, key in {"name": str, "number": _last_number}.items():
        found, expected = {key(path.stem): path for path in paths}, [key(name) for name in names]
        if len(found) == len(set(expected)) == len(paths) and found.keys() == set(expected):
            return _reported([found[each] for each in expected], names, how)
    return _reported(paths, names, "order")


def _reported(paths, names, how):
    """Returns the arguments paths and how; warns of a pairing by anything but names."""
    if how != "name":
        pairs = ", ".join(f"{path.name} with {name}" for path, name in zip(paths[:3], names[:3], strict=True))
        by = "the numbers in them" if how == "number" else "order, as the numbers in them differ, too"
        folder = paths[0].parent
        _logger.warning("%s: names differ from those of the references; paired by %s: %s ...", folder, by, pairs)
    return paths, how


def _last_number(name):
    """Returns the last number in a name, as an integer; the name itself without one."""
    numbers = re.findall(r"\d+", name)
    return int(numbers[-1]) if numbers else name


def _image_paths(folder):
    found = [path for path in folder.glob("*") if path.suffix.lower() in IMAGE_SUFFIXES]
    paths = sorted((path for path in found if not is_hidden(path.name)), key=lambda path: natural_key(path.stem))
    if not paths:
        raise ValueError(
            f"{folder}: holds no images ({', '.join(IMAGE_SUFFIXES)}); correct the folder, or, if these are the "
            "references, name their dataset with --data_dir, --config or --workdir"
        )
    return paths


def _colors(path):
    pixels = read_image(path)
    if pixels.shape[-1] == 4:
        if pixels[..., 3].min() < np.iinfo(pixels.dtype).max:
            raise ValueError(f"{path}: is partly transparent, expected opaque colours; composite it first")
        pixels = pixels[..., :3]
    return (pixels / np.iinfo(pixels.dtype).max).astype(np.float32)
