"""Scores predictions, images that were rendered elsewhere, against a dataset or a folder of references."""

import logging
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from jaxnerf.configs import default
from jaxnerf.data.geometry.path_poses import natural_key
from jaxnerf.data.images.image_files import IMAGE_SUFFIXES, is_hidden, read_image
from jaxnerf.data.readers.image_paths import fold
from jaxnerf.evaluation import protocol
from jaxnerf.evaluation.aggregate import means
from jaxnerf.evaluation.metrics import image_metrics, pixel_mask
from jaxnerf.evaluation.restore import dataset_at
from jaxnerf.runtime import atomic_files, cli
from jaxnerf.training import build
from jaxnerf.training.config import Config, RunConfig, read_config
from jaxnerf.training.workdir import load_config

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
        folder: holds the images, or color/ with them, in folders as the views' names have or in one. They are paired
            with the views by name, where any signs stand for the / between folders, or else by the numbers in each
            name. If names only count, as 000 and 001 do, they are paired in order: images in that of their names, r_9
            before r_10, views as the dataset lists them. A warning says how, unless names agree.
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
    place = folder / "color" if (folder / "color").is_dir() else folder
    paths = _image_paths(place)
    if config is None:
        truths = _image_paths(folder / "gt-color")
        names = _names(path.relative_to(folder / "gt-color") for path in truths)
        references, masks = [_colors(path) for path in truths], [None] * len(truths)
        about = protocol.of_images({"reference": "gt-color"}, [image.shape[:2] for image in references])
    else:
        views, split, conventions = build.load_split(config, split)
        names = _names(views.names)
        references = [np.asarray(views.image(index)) for index in range(len(names))]
        masks = [pixel_mask(views, index) for index in range(len(names))]
        about = protocol.of_views(conventions, views, split=split)
    beside = [path for path in paths if path.parent == place]  # others may be depths, say
    paths = beside if beside and len(paths) != len(names) else paths
    found = _names(path.relative_to(place) for path in paths)
    if len(paths) != len(names):
        raise ValueError(
            f"{place}: holds {len(paths)} images, expected {len(names)}, one for each reference"
            f"{_unpaired(found, names)}; add or remove images"
        )
    order, how = _paired(found, names, place)
    paths = [paths[index] for index in order]
    shown = [path.relative_to(place).as_posix() for path in paths]
    results = _scored(map(_colors, paths), references, masks, shown) | {"paired_by": how, **about}
    atomic_files.write_text(target, atomic_files.to_json(results))
    return results


def reference_config(config: Config | None, workdir: str | None, data_dir: str | None) -> RunConfig | None:
    """Returns the config whose dataset predictions are compared with: a given one, a workdir's, or the default.

    The dataset is the one in data_dir if that is given. None where there is nothing of the three.
    """
    if config is None and not workdir:
        return read_config(cli.use_data(default.get_config(), data_dir)) if data_dir else None
    return dataset_at(load_config(workdir) if config is None else read_config(config), data_dir)


def _scored(predictions, references, masks, names):
    """Returns the means of the metrics of pairs of images [H, W, 3], their number, and a row for each pair."""
    rows = []
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
    found, expected = map(_without_common_folders, (found, expected))
    if any("/" in name for name in expected) and not any("/" in name for name in found):
        found, expected = ([_words(name, "_") for name in names] for names in (found, expected))
    extra, missing = (sorted(set(a) - set(b), key=natural_key) for a, b in ((found, expected), (expected, found)))
    if len(missing) > len(expected) / 2:
        return ""
    parts = [(extra, "without a reference"), (missing, "missing")]
    return "".join(f"; {what}: {', '.join(some[:5])}{' ...' if some[5:] else ''}" for some, what in parts if some)


def _paired(found, names, folder):
    """Returns the indices of the images, named in natural order, of the references, and by what they were paired.

    Of several ways, the first counts by which each image has one reference and each reference one image.
    """
    short = [list(map(fold, _without_common_folders(each))) for each in (found, names)]
    ways = [
        ("name", found, names),
        ("name", *short),
        *(("name", *([_words(name, sign) for name in each] for each in short)) for sign in ("_", "")),
        ("name", *([name.rpartition("/")[2] for name in each] for each in short)),
        ("number", *([_numbers(name) for name in each] for each in short)),
    ]
    if any(len({re.sub(r"\d+(?=\D*$)", "", name) for name in each}) == 1 for each in short):
        ways.append(("number", *([_numbers(name)[-1:] for name in each] for each in short)))
    for how, have, want in ways:
        places = {key: index for index, key in enumerate(have)}
        if len(places) == len(have) and places.keys() == set(want):
            return _reported([places[key] for key in want], found, names, how, folder)
    if not _only_count(found, names):
        raise ValueError(
            f"{folder}: {', '.join(found[:3])} ... do not pair up with the references {', '.join(names[:3])} ..., "
            "expected their names; give each image that of its reference, with _ for /"
        )
    return _reported(range(len(found)), found, names, "order", folder)


def _reported(order, found, names, how, folder):
    """Returns the arguments order and how; warns of a pairing by anything but names."""
    if how != "name":
        pairs = ", ".join(f"{found[place]} with {name}" for place, name in zip(order[:3], names[:3], strict=True))
        by = "the numbers in them" if how == "number" else "order, as the numbers in them differ, too"
        _logger.warning("%s: names differ from those of the references; paired by %s: %s ...", folder, by, pairs)
    return order, how


def _only_count(found, names):
    """Returns whether names differ in one number only, which counts, and are not those of other references."""
    columns = [sorted(column) for column in zip(*map(_numbers, found), strict=False)]
    varying = [column for column in columns if column[0] < column[-1]]
    counts = len(varying) <= 1 and all(column == list(range(column[0], column[0] + len(found))) for column in varying)
    alike = len({re.sub(r"\d+", "", name) for name in found}) == 1
    return alike and counts and (not set(found) & set(names) or varying[0][0] == 0)


def _without_common_folders(names):
    """Returns names without the folders that all of them begin with."""
    parts = [name.split("/") for name in names]
    common = os.path.commonprefix([part[:-1] for part in parts])
    return ["/".join(part[len(common) :]) for part in parts]


def _words(name, sign):
    """Returns a name with one sign for all that separate its letters and digits."""
    return sign.join(re.findall(r"[^\W_]+", name))


def _numbers(name):
    return tuple(map(int, re.findall(r"\d+", name)))


def _names(paths):
    """Returns relative paths of images without any suffixes of images."""
    pattern = re.compile(rf"(?<=[^/])({'|'.join(map(re.escape, IMAGE_SUFFIXES))})+$", re.IGNORECASE)
    return [pattern.sub("", Path(path).as_posix()) for path in paths]


def _image_paths(folder):
    """Returns the images in a folder and in the folders below, in natural order."""
    found = [Path(place, name) for place, _, names in os.walk(folder) for name in names]
    found = [path for path in found if path.suffix.lower() in IMAGE_SUFFIXES]
    found = [path for path in found if not any(map(is_hidden, path.relative_to(folder).parts))]
    if not found:
        raise ValueError(
            f"{folder}: holds no images ({', '.join(IMAGE_SUFFIXES)}); correct the folder, or, if these are the "
            "references, name their dataset with --data_dir, --config or --workdir"
        )
    return sorted(found, key=lambda path: natural_key(*_names([path.relative_to(folder)])))


def _colors(path):
    pixels = read_image(path)
    if pixels.shape[-1] == 4:
        if pixels[..., 3].min() < np.iinfo(pixels.dtype).max:
            raise ValueError(f"{path}: is partly transparent, expected opaque colours; composite it first")
        pixels = pixels[..., :3]
    return (pixels / np.iinfo(pixels.dtype).max).astype(np.float32)
