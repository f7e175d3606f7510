"""Trains on images whose exposure and white balance differ by known factors, with and without `cameras.exposure`.

    JAXNERF_SCENES=... python experiments/benchmark/exposures.py [--dataset=fox] [--width=100] [--steps=1500] \
        [--seed=0] [--set=cameras.exposure_lr=2e-2] [--out=runs/exposures] [--page=docs/results/cameras.md]

Each training image is multiplied by a factor from 0.6 to 1.6, of which the logarithm is uniform, and each channel by
one more from 0.9 to 1.1, and is clipped and rounded to 8 bits again. The test images stay as they are. Their scores
are those after a gain per channel is fitted to each (`jaxnerf-eval --align=exposure`); for the last column it is fitted
to the left half, and the right half is scored. A finished run is not repeated.
"""

import pathlib
import sys

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from benchmark import settings
from benchmark.changed_views import changed, factors

from jaxnerf.runtime import cli
from jaxnerf.tools.curve.measure import SCORE

HEADS = ("run", "`cameras.exposure`", "steps", "PSNR, dB", "exposure aligned, dB", "right halves, dB")
_SCORES = ("psnr", "psnr_exposure_aligned", "psnr_exposure_half")
_KINDS = (("as taken", False), ("changed", True), ("changed", False))

_DATASET = flags.DEFINE_string("dataset", "fox", "Folder of a dataset.")
_WIDTH = flags.DEFINE_integer("width", 100, "px of an image's width, at least.", lower_bound=8)
_STEPS = flags.DEFINE_integer("steps", 1500, "Steps of training.", lower_bound=1)
_SEED = flags.DEFINE_integer("seed", 0, "Of the factors and of training.")
_SET = settings.define_set()
_OUT = flags.DEFINE_string("out", "runs/exposures", "Folder of the runs.")
_TABLE = flags.DEFINE_string("table", "exposures", "Name of the table in the marks of --page.")


def main(argv: list[str]) -> None:
    """Trains what is missing, and prints the table."""
    del argv
    rows = []
    for kind, exposure in _KINDS:
        name = f"{_DATASET.value}_{_WIDTH.value}_{kind.replace(' ', '_')}_{exposure}_{_STEPS.value}_seed{_SEED.value}"
        found = measured(pathlib.Path(_OUT.value) / name, exposure, kind == "changed")
        rows.append(row(f"{_DATASET.value}, {_WIDTH.value} px, {kind}", found, exposure, _STEPS.value))
        print(f"{name}: {found}", flush=True)
    common.publish([*common.markdown(HEADS, rows), "", *common.provenance()], _TABLE.value)


def row(name: str, found: dict[str, float], exposure: bool, steps: int) -> tuple[str, ...]:
    """Returns the cells of a row of the table."""
    scores = (found[key] for key in _SCORES)
    return (name, "on" if exposure else "off", f"{steps:,}", *(f"{score:.2f}" for score in scores))


def measured(folder: pathlib.Path, exposure: bool, is_changed: bool) -> dict[str, float]:
    """Trains a run if it is not there yet; returns its scores."""
    from jaxnerf.evaluation.evaluate import score_run
    from jaxnerf.evaluation.restore import restore_run
    from jaxnerf.tools.alignment.align_views import Aligner
    from jaxnerf.training.loop import train

    if done := common.read_json(folder / SCORE):
        return done
    options = {"data.dir": _DATASET.value, "data.width": _WIDTH.value, "cameras.exposure": exposure}
    options |= {"train.max_seconds": 0.0, "train.max_steps": _STEPS.value, "train.lr_steps": _STEPS.value}
    options |= {"train.preview_every": 0.0, **dict(settings.parse(_SET.value))}
    config = common.configuration("capture", options, seed=_SEED.value)
    views = common.load_split(config, "train")
    if is_changed:
        views = changed(views, factors(len(views.size), _SEED.value))
    if not train(config, folder, views=views):
        raise ValueError(f"{folder}: training was stopped; the same command continues it")
    found = score_run(restore_run(folder), folder, split="test", overwrite=True, aligner=Aligner(("exposure",)))
    found = {key: value for key, value in found.items() if key in _SCORES}
    common.write_json(folder / SCORE, found)
    return found


if __name__ == "__main__":
    cli.run(main, stopped="within a run, which is saved; the same command continues")
