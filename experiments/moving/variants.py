"""Trains and scores variants of a config on one dataset, at equal CPU seconds or steps.

    JAXNERF_SCENES=... taskset -c 0 python experiments/moving/variants.py --data_dir=dnerf_lego --factor=4 \
        --seconds=120 [--steps=600] [--config=moving,lego_fast] [--set=losses.opacity=0] [--splits=val] [--seeds=0,1] \
        [--page=docs/results/benchmark.md --table=NAME]

--set adds, for each config, a variant with that change. Seconds are CPU time of one core, without compilation; runs of
so many --steps replace them. Scored are the views of each of --splits; "held_out", which stands alone, is every 8th
training view, then not trained on.
"""

import pathlib
import statistics
import sys

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from benchmark import settings

from jaxnerf.data import dataset
from jaxnerf.runtime import cli
from jaxnerf.tools.needs import trial
from jaxnerf.training.config import changed, read_config

HEADS = ("dataset, config", "changed", "px", "CPU s", "steps")
_CONFIGS = flags.DEFINE_list("config", ["moving"], "Names of configs.")
_DATA_DIR = flags.DEFINE_string("data_dir", "dnerf_lego", "A folder, or a name below $JAXNERF_SCENES.")
_FACTOR = flags.DEFINE_integer("factor", 4, "By which the images are downscaled.", lower_bound=1)
_SECONDS = flags.DEFINE_list("seconds", ["120"], "Lengths of training.")
_STEPS = flags.DEFINE_integer("steps", 0, "Steps of training, in place of --seconds; 0: none.", lower_bound=0)
_SPLITS = flags.DEFINE_list("splits", ["val"], "The views that are scored: val, test or held_out.")
_SEEDS = flags.DEFINE_list("seeds", ["0"], "Seeds; every variant is trained with each.")
_TABLE = flags.DEFINE_string("table", "variants", "Name of the table in --page.")
_SET = flags.DEFINE_multi_string("set", [], "A change of options, such as losses.opacity=0; each is a variant.")


def main(argv: list[str]) -> None:
    """Trains all variants in turn, and prints the table."""
    del argv
    rows, seeds = [], common.seeds_of("--seeds", _SEEDS.value)
    for config in _CONFIGS.value:
        trainer = make_trainer(config)
        for change in ("", *_SET.value):
            for seconds in ["-"] if _STEPS.value else _SECONDS.value:
                found = [scores(trainer, settings.parse([change] if change else []), seed, seconds) for seed in seeds]
                rows.append([f"{_DATA_DIR.value}, {config}", change or "-", *figures(trainer, seconds, found)])
                print(rows[-1], file=sys.stderr, flush=True)
    heads = [*HEADS, *(f"{split} by seed, dB" for split in _SPLITS.value)]
    common.publish([*common.provenance(), "", *common.markdown(heads, rows)], _TABLE.value)


def make_trainer(name):
    """Returns the Trainer of a config by name."""
    overrides = {"data.dir": _DATA_DIR.value, "data.format": "blender", "data.factor": _FACTOR.value}
    overrides |= {"data.hold_out": 8 * (_SPLITS.value == ["held_out"])}
    config = changed(read_config(common.configuration(name)), overrides)
    data, _, capture = dataset.resolve(config.data)
    return trial.Trainer(config, dataset.load_split(data, "train", capture=capture), split=_SPLITS.value[0])


def scores(trainer, values, seed, seconds):
    """Returns the steps of a run, and the mean PSNR of each split."""
    length = 0.0 if _STEPS.value else float(seconds)
    result = trainer.run(values, seed, length, steps=_STEPS.value)[0]
    return result.steps, [statistics.fmean(each) for each in (result.psnr, *map(trainer.psnr_of, _SPLITS.value[1:]))]


def figures(trainer, seconds, found):
    """Returns the last cells of a row."""
    steps = statistics.fmean(steps for steps, _ in found)
    by_split = [", ".join(f"{psnr:.2f}" for psnr in each) for each in zip(*(psnrs for _, psnrs in found), strict=True)]
    return [str(trainer.held_out().size[0][1]), seconds, f"{steps:,.0f}", *by_split]


if __name__ == "__main__":
    cli.run(main)
