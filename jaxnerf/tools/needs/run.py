"""Finds what the scene of a dataset needs, from the dataset to the files of the result."""

import functools
import json
import math
import os
import pathlib
from typing import NamedTuple

import jax
import numpy as np

from jaxnerf.core.views import Views
from jaxnerf.data import dataset
from jaxnerf.data.images.downscaled_copies import factor_for
from jaxnerf.registry import needs_folder
from jaxnerf.runtime.atomic_files import read_json, write_text
from jaxnerf.tools.needs import page
from jaxnerf.tools.needs.study import Outcome, Settings, Study
from jaxnerf.tools.needs.trial import Trainer, seconds
from jaxnerf.tools.needs.variants import facts_of, find_variants
from jaxnerf.training import auto_config
from jaxnerf.training.config import Config, RunConfig, changed, read_config
from jaxnerf.training.workdir import workdir_lock

_ORIGIN, _REMEDY = "study.json", "remove the folder, or give another --out"
_LEAST_VIEWS = 6
_LEAST_SIDE = 50  # px of a trial's images
_PIXELS_PER_SECOND = 800  # of training images, for each second of the budget
_LEAST_GAIN = 1.0  # dB over one colour, below which a dataset does not train


class Request(NamedTuple):
    """What is asked for.

    Attributes:
        config: of the complete model.
        settings: of the study.
        parts: that are tried; (): all.
        shrink: factor by which trials shrink images; 0: as the budget says.
    """

    config: Config
    settings: Settings
    parts: tuple[str, ...] = ()
    shrink: int = 0


def find_needs(request: Request, out: str | os.PathLike) -> Outcome:
    """Runs the trials that a folder does not hold yet, and writes the results there.

    Args:
        request: what is asked for.
        out: the folder; made if missing.

    Raises:
        ValueError: if the dataset has too few views, does not train, or the budget is too small; if the folder holds a
            study of something else.
    """
    started, asked = seconds(), read_config(request.config)
    config, views, resolved = _with_held_out(asked)
    full = Trainer(config, views)
    full_variants = {each.slug: each for each in find_variants(resolved.config, facts_of(*resolved[:2]))}
    factor = request.shrink or _kept_factor(pathlib.Path(out)) or shrink_factor(views, request.settings.budget)
    trainer = full
    if factor > 1:
        trainer = Trainer(*_shrunk(config, views, factor))
        resolved = trainer.resolved({})
    held_out = trainer.held_out()
    _check_images(held_out, config)
    variants = _chosen(find_variants(resolved.config, facts_of(*resolved[:2])), request.parts)
    folder = pathlib.Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    with workdir_lock(folder):
        _check_origin(folder, request, resolved.config, factor)
        if jax.default_backend() == "cpu":  # other programs seldom use an accelerator
            trainer.pacer = full.pacer = trainer.make_pacer(folder / "pace.json")
        _say(_images_line(views, trainer.views, held_out))
        study = Study(
            folder,
            request.settings,
            variants,
            trainer,
            full=(full, full_variants),
            check=functools.partial(_check_trained, held_out),
            say=_say,
            started=max(seconds() - started, 0),
        )
        outcome = study.search()
        lean = changed(asked, {key: value for each in outcome.lean for key, value in each.values.items()})
        page.write(folder, outcome, request.settings, asked, lean, held_out)
    return outcome


def _images_line(full, views, held_out):
    sides = sorted({f"{width} x {height} px" for height, width in views.size.tolist()})
    factor = full.size.max() / views.size.max()
    shrunk = f", shrunk by {factor:.3g}; the curve is of those that are not" if factor > 1 else ""
    sizes = " and ".join(sides[:3]) + (f" and {len(sides) - 3} other sizes" if len(sides) > 3 else "")
    return f"images        {len(views.size)} for training, {len(held_out.size)} held out, {sizes}{shrunk}"


def _say(line):
    print(line, flush=True)


def _with_held_out(config: RunConfig):
    """Returns the config with held-out views, the Views that it trains on, and the resolved config."""
    if not config.data.hold_out:
        data, _, capture = dataset.resolve(config.data)
        views = dataset.load_split(data, "train", capture=capture, with_pixels=False) if capture else None
        count = len((views or dataset.load_split(data, "train")).size)
        if count < _LEAST_VIEWS:
            raise ValueError(
                f"{config.data.dir or config.data.format}: has {count} training view{'s' * (count != 1)}, expected at "
                f"least {_LEAST_VIEWS}, as some are held out to judge the others by; add images"
            )
        config = changed(config, {"data.hold_out": min(max(count // 4, 2), 8)})
    full = auto_config.resolve(config)
    return config, full.views, full


def shrink_factor(views: Views, budget: float) -> int:
    """Returns the factor by which images are shrunk so that a trial sees each pixel about once.

    Args:
        views: of the split "train".
        budget: seconds of the study.
    """
    pixels, side = float(np.prod(views.size, axis=1).sum()), float(np.min(views.size))
    factor = math.ceil(math.sqrt(pixels / (_PIXELS_PER_SECOND * budget)))
    return max(min(factor, int(side // _LEAST_SIDE)), 1)


def _shrunk(config, views, factor):
    """Returns the config with images that are shrunk by about a further factor, and its Views."""
    if needs_folder(config.data.format):
        _, _, capture = dataset.resolve(config.data)
        nearest, _ = factor_for(capture, max(int(views.size[:, 1].max()) // factor, 1))
        config = changed(config, {"data.factor": nearest})
    else:
        config = changed(config, {"data.size": max(config.data.size // factor, 1)})
    return config, auto_config.resolve(config).views


def _check_images(held_out, config):
    """Raises a ValueError if the held-out images have nothing to learn, or are too few."""
    where = config.data.dir or config.data.format
    if len(held_out.size) < 2:
        raise ValueError(f"{where}: has {len(held_out.size)} held-out view, expected at least 2; lower data.hold_out")
    pixels = np.asarray(held_out.pixels)
    if (pixels == pixels[0]).all():
        raise ValueError(
            f"{where}: all held-out images have one colour, {pixels[0].tolist()}, so nothing can be judged"
        )


def _check_trained(held_out, result):
    """Raises a ValueError if the complete model is no better than the best colour for each image."""
    errors = []
    for index in range(len(held_out.size)):
        image = np.asarray(held_out.image(index)).reshape(-1, 3)
        errors.append(-10 * math.log10(max(float(image.var(axis=0).mean()), 1e-10)))
    if np.mean(result.psnr_colors) < np.mean(errors) + _LEAST_GAIN:
        raise ValueError(
            f"the complete model has {np.mean(result.psnr):.1f} dB after {result.seconds:.1f} s, and one colour for "
            f"each image {np.mean(errors):.1f} dB: it does not train, so no part can be judged; check the dataset with "
            "jaxnerf-check, or give a larger --budget and another --out"
        )


def _chosen(variants, parts):
    known = list(dict.fromkeys(each.part for each in variants))
    wrong = [part for part in parts if part not in known]
    if wrong:
        raise ValueError(f"--parts has {wrong[0]!r}, expected some of {', '.join(known)}; correct it")
    return [each for each in variants if not parts or each.part in parts]


def _kept_factor(folder):
    """Returns the factor by which the study in a folder shrinks images; 0 if there is none."""
    path = folder / _ORIGIN
    return int(read_json(path, _REMEDY).get("shrink", 0)) if path.exists() else 0


def _check_origin(folder, request, config, factor):
    """Raises a ValueError if the folder holds trials of something else; writes what they are of."""
    plain = json.loads(changed(config, {"data.dir": ""}).to_json())
    settings = request.settings._replace(budget=0.0, lean=True)._asdict()
    origin = json.loads(json.dumps({"config": plain, "settings": settings, "parts": request.parts, "shrink": factor}))
    path = folder / _ORIGIN
    if not path.exists():
        if any(child.name != "running" for child in folder.iterdir()):
            raise ValueError(f"{folder}: holds other files, expected a new folder or one of this program; give another")
        write_text(path, json.dumps(origin, indent=1) + "\n")
        return
    found = read_json(path, _REMEDY)
    if found != origin:
        differing = next(key for key in origin if found.get(key) != origin[key])
        raise ValueError(f"{folder}: holds a study with other {differing}; give another --out, or the old flags")
