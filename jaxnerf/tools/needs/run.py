"""Finds what the scene of a dataset needs, from the dataset to the files of the result."""

import json
import math
import os
import pathlib
from typing import Any, NamedTuple

import numpy as np

from jaxnerf.core.views import Views
from jaxnerf.data import dataset
from jaxnerf.registry import needs_folder
from jaxnerf.runtime.atomic_files import read_json, write_text
from jaxnerf.tools.needs import page
from jaxnerf.tools.needs.study import Outcome, Settings, Study
from jaxnerf.tools.needs.trial import Trainer
from jaxnerf.tools.needs.variants import Variant, facts_of, find_variants
from jaxnerf.training import auto_config
from jaxnerf.training.config import Config, RunConfig, changed, read_config
from jaxnerf.training.workdir import workdir_lock

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
    asked = read_config(request.config)
    config, views, full = _with_held_out(asked)
    factor = request.shrink or shrink_factor(views, request.settings.budget)
    config, views = _shrunk(config, views, factor)
    trainer = Trainer(config, views)
    held_out = trainer.held_out()
    _check_images(held_out, config)
    resolved = trainer.resolved({})
    variants = _chosen(find_variants(resolved.config, facts_of(resolved.config, resolved.views)), request.parts)
    folder = pathlib.Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    with workdir_lock(folder):
        _check_origin(folder, request, resolved.config)
        print(
            f"images        {len(views.size)} for training, {len(held_out.size)} held out, "
            f"{views.size[0][1]} x {views.size[0][0]} px{f', shrunk by {factor}' if factor > 1 else ''}"
        )
        study = Study(folder, request.settings, variants, trainer.run, forget=trainer.forget, say=_say)
        outcome = study.search()
        _check_trained(outcome, held_out, views)
        full_variants = {each.slug: each for each in find_variants(full.config, facts_of(full.config, full.views))}
        lean = changed(asked, _values([full_variants.get(each.slug, each) for each in outcome.lean]))
        page.write(folder, outcome, request.settings, asked, lean, held_out)
    return outcome


def _say(line):
    print(line, flush=True)


def _values(variants: list[Variant]) -> dict[str, Any]:
    return {key: value for each in variants for key, value in each.values.items()}


def _with_held_out(config: RunConfig):
    """Returns the config with held-out views, the Views that it trains on, and the resolved config."""
    if not config.data.hold_out:
        data, _, capture = dataset.resolve(config.data)
        views = dataset.load_split(data, "train", capture=capture, with_pixels=False) if capture else None
        count = len((views or dataset.load_split(data, "train")).size)
        if count < _LEAST_VIEWS:
            raise ValueError(
                f"{config.data.dir or config.data.format}: has {count} training views, expected at least "
                f"{_LEAST_VIEWS}, as some are held out to judge the others by; add images"
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
    if factor == 1:
        return config, views
    if needs_folder(config.data.format):
        data, _, _ = dataset.resolve(config.data)
        config = changed(config, {"data.factor": data.factor * factor})
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


def _check_trained(outcome, held_out, views):
    """Raises a ValueError if the complete model is no better than one colour."""
    errors = []
    for index in range(len(held_out.size)):
        image = np.asarray(held_out.image(index)).reshape(-1, 3)
        errors.append(-10 * math.log10(max(float(image.var(axis=0).mean()), 1e-10)))
    found = np.mean([np.mean(each.psnr) for each in outcome.complete.values()])
    if found < np.mean(errors) + _LEAST_GAIN:
        raise ValueError(
            f"the complete model has {found:.1f} dB after {outcome.plan.length:.1f} s, and one colour "
            f"{np.mean(errors):.1f} dB: it does not train, so no part can be judged; check the dataset with "
            "jaxnerf-check, or give a larger --budget and another --out"
        )


def _chosen(variants, parts):
    known = list(dict.fromkeys(each.part for each in variants))
    wrong = [part for part in parts if part not in known]
    if wrong:
        raise ValueError(f"--parts has {wrong[0]!r}, expected some of {', '.join(known)}; correct it")
    return [each for each in variants if not parts or each.part in parts]


def _check_origin(folder, request, config):
    """Raises a ValueError if the folder holds trials of something else; writes what they are of."""
    plain = json.loads(changed(config, {"data.dir": ""}).to_json())
    settings = request.settings._replace(budget=0.0)._asdict()
    origin = json.loads(json.dumps({"config": plain, "settings": settings, "parts": request.parts}))
    path = folder / "study.json"
    if not path.exists():
        if any(child.name != "running" for child in folder.iterdir()):
            raise ValueError(f"{folder}: holds other files, expected a new folder or one of this program; give another")
        write_text(path, json.dumps(origin, indent=1) + "\n")
        return
    found = read_json(path, "remove the folder, or give another --out")
    if found != origin:
        differing = next(key for key in origin if found.get(key) != origin[key])
        raise ValueError(f"{folder}: holds a study with other {differing}; give another --out, or the old flags")
