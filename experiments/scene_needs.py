"""What a scene needs: the smallest model that is hardly worse than the complete one, as a configuration.

    python experiments/scene_needs.py --config=configs/quickstart.py --out=DIR [--data_dir=...] [--loss=0.2]
        [--seeds=0,1,2] [--steps=800] [--only=view_dependence,width] [--readme=README.md --table=NAME]

Trains the configuration's model, and the same with each part of scene_parts.py left off or made smaller, each
for a few steps with every seed, and scores them on views held out of training. A part is not needed if
leaving it off costs less than --loss dB: the upper end of a one-sided interval of 95 % over the seeds, as
runs of one seed draw the same rays. Then parts that are not needed, and save seconds or parameters, are left
off one upon the other, those that save most first, again and again as long as all together cost less than
--loss. Writes DIR/needs.json, DIR/needs.md and DIR/needed.py, a configuration for jaxnerf.train of the
original length. The test views are not looked at. Runs that were finished under DIR are not repeated.
"""

import json
import pathlib
import statistics
from typing import Any, NamedTuple

import needs_report
import paired_runs
import scene_parts
from absl import flags
from ml_collections import config_flags

from jaxnerf.runtime import cli

_CONFIG = config_flags.DEFINE_config_file("config", None, "The complete model.", lock_config=True)
_DATA_DIR = flags.DEFINE_string("data_dir", None, "The scene's folder, in place of config.data.dir.")
_OUT = flags.DEFINE_string("out", None, "Folder of all runs and results.", required=True)
_LOSS = flags.DEFINE_float("loss", 0.2, "dB that the result may lose.", lower_bound=0.0)
_SEEDS = flags.DEFINE_list("seeds", ["0", "1", "2"], "Of each run; two at least.")
_STEPS = flags.DEFINE_integer("steps", 800, "Of each run.", lower_bound=1)
_ONLY = flags.DEFINE_list("only", list(scene_parts.PARTS), "Parts that are tried.")
flags.mark_flag_as_required("config")


class Trial(NamedTuple):
    """One configuration, trained with every seed."""

    overrides: dict[str, Any]
    psnr: dict[int, float]  # by seed, dB, of the held-out views
    seconds: dict[int, float]  # of training a thousand steps
    parameters: int


class Loss(NamedTuple):
    """What leaving something off costs and saves."""

    mean: float  # dB
    margin: float  # dB, from there to the end of the interval
    saved: float  # share of the seconds of training
    parameters: int


class Found(NamedTuple):
    """What a search has found."""

    complete: Trial
    parts: dict[str, tuple[Trial, Loss]]  # each left off alone
    tried: list[tuple[list[str], Loss, bool]]  # names left off together, and whether that was kept
    overrides: dict[str, Any]  # what is left off in the end


def main(argv):
    """Runs all trials and writes the results."""
    del argv
    seeds = [int(seed) for seed in _SEEDS.value]
    unknown = sorted(set(_ONLY.value) - set(scene_parts.PARTS))
    if len(set(seeds)) < 2 or unknown:
        wrong = f"--only={unknown[0]}" if unknown else f"--seeds={','.join(_SEEDS.value)}"
        raise ValueError(f"{wrong}: wanted two seeds at least, and parts of {', '.join(scene_parts.PARTS)}")
    out = pathlib.Path(_OUT.value)
    config = cli.use_data(_CONFIG.value, _DATA_DIR.value)
    complete, alpha = short(config, _STEPS.value)
    found = search(complete, alpha, out / "runs", seeds=seeds, loss=_LOSS.value, names=_ONLY.value)
    settings = {"loss": _LOSS.value, "steps": _STEPS.value, "seeds": seeds}
    placed = {"readme": flags.FLAGS.readme, "table_name": flags.FLAGS.table}  # flags of table.py
    needs_report.write(out, config, found, settings, **placed)


def short(config, steps):
    """Returns the configuration of a short run without open sizes, and whether its photographs have alpha."""
    from jaxnerf.data import dataset
    from jaxnerf.training import auto_config

    config = scene_parts.changed(config, {"train.max_steps": steps, "train.lr_steps": steps})
    config.train.max_seconds, config.train.save_every = 0.0, steps
    config.data.hold_out = config.data.hold_out or 8
    config.eval.at_end = False
    config, _ = auto_config.resolve_data(config)
    views = dataset.load_views(config.data, "train")
    return auto_config.resolve_sizes(config, views)[0], views.pixels.shape[-1] == 4


def search(complete, alpha, folder, *, seeds, loss, names):
    """Returns the Found of short runs.

    Args:
        complete: ConfigDict without open sizes.
        alpha: whether the photographs have alpha.
        folder: of the workdirs.
        seeds: ints.
        loss: dB.
        names: of scene_parts.PARTS.
    """
    changes = {name: scene_parts.without(name, complete, alpha=alpha) for name in names}
    changes = {"complete": {}} | {name: change for name, change in changes.items() if change}
    # Seed by seed, so that runs that are compared lie close together in time.
    rows = [{name: _run(complete, change, folder / name, seed) for name, change in changes.items()} for seed in seeds]
    trials = {name: _trial(change, seeds, [row[name] for row in rows]) for name, change in changes.items()}
    base = trials.pop("complete")
    parts = {name: (trial, compare(base, trial)) for name, trial in trials.items()}
    tried, overrides = _combine(complete, alpha, folder, base, parts, seeds, loss)
    return Found(base, parts, tried, overrides)


def _combine(complete, alpha, folder, base, parts, seeds, loss):
    """Leaves off one part upon the other; returns what was tried, and the last overrides that were kept."""
    queue = sorted(
        (name for name, (_, cost) in parts.items() if not_needed(cost, loss) and worthwhile(cost)),
        key=lambda name: -parts[name][1].saved,
    )
    kept, overrides, tried = [], {}, []
    while queue:
        name = queue.pop(0)
        change = scene_parts.without(name, scene_parts.changed(complete, overrides), alpha=alpha)
        if not change:
            continue
        together, combined = [*kept, name], overrides | change
        path = folder / "+".join(together)
        trial = _trial(combined, seeds, [_run(complete, combined, path, seed) for seed in seeds])
        cost = compare(base, trial)
        tried.append((together, cost, not_needed(cost, loss)))
        if tried[-1][2]:
            kept, overrides = together, combined
            queue.append(name)  # what was halved may be halved again
    return tried, overrides


def compare(base, trial):
    """Returns the Loss of one Trial against another of the same seeds."""
    lost = paired_runs.differences(base.psnr, trial.psnr)
    mean, deviation = paired_runs.spread(lost)
    shares = [1 - trial.seconds[seed] / base.seconds[seed] for seed in base.seconds]
    margin = _student(len(lost) - 1) * deviation / len(lost) ** 0.5
    return Loss(mean, margin, statistics.median(shares), base.parameters - trial.parameters)


def not_needed(cost, loss):
    return cost.mean + cost.margin <= loss


def worthwhile(cost):
    """Whether leaving something off saves more than a clock can tell, or parameters."""
    return cost.saved > 0.02 or cost.parameters > 0


def _student(freedom):
    from scipy import stats  # which jax brings

    return float(stats.t.ppf(0.95, freedom))


def _run(complete, overrides, folder, seed):
    config = scene_parts.changed(complete, {**overrides, "seed": seed})
    results = paired_runs.run(config, folder / str(seed), split="held_out")
    if results is None:  # stopped and saved
        raise KeyboardInterrupt
    print(json.dumps({"run": f"{folder.name}/{seed}", "psnr": results["psnr"]}), flush=True)
    return results


def _trial(overrides, seeds, results):
    return Trial(
        overrides,
        {seed: result["psnr"] for seed, result in zip(seeds, results, strict=True)},
        {seed: 1000 * result["training_seconds"] / result["step"] for seed, result in zip(seeds, results, strict=True)},
        results[0]["parameters"],
    )


if __name__ == "__main__":
    cli.run(main, stopped="and saved; the same command goes on from there")
