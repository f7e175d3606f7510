"""Scores configs/few_views.py by the protocols of the literature, with several seeds.

    JAXNERF_SCENES=... python experiments/few_views/protocols.py [--out=runs/few_views] [--rows="lego 200 px"] \
        [--seeds=0] [--configs=few_views,capture] [--seconds=300] [--page=docs/results/few_views.md]

Trains on the views that the literature names for as many seconds as few_views has, or for --seconds, and scores at most
25 test views, spread evenly over all, once. Writes OUT/protocols.json and prints a table of all that is there. The same
command resumes what was interrupted; other rows, seeds, configs or seconds are added.
"""

import pathlib
import statistics
import sys

import jax
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.runtime import cli
from jaxnerf.training import metric_log

_EIGHT = {"data.view_indices": (26, 86, 2, 55, 75, 93, 16, 73)}  # of arXiv:2104.00677
_WHITE = {"scene.use_alpha": False}  # the images have a white background, and no alpha
_FERN = {"data.dir": "fern", "data.factor": 8}
# By row: its changes of the config.
ROWS = {
    "lego 200 px": {"data.dir": "lego", "data.factor": 4, **_EIGHT, **_WHITE},
    "lego 200 px with alpha": {"data.dir": "lego", "data.factor": 4, **_EIGHT},
    "lego 400 px": {"data.dir": "lego", "data.factor": 2, **_EIGHT, **_WHITE},
    "lego 400 px with alpha": {"data.dir": "lego", "data.factor": 2, **_EIGHT},
    "mic 200 px": {"data.dir": "mic", "data.factor": 4, **_EIGHT, **_WHITE},
    "mic 200 px with alpha": {"data.dir": "mic", "data.factor": 4, **_EIGHT},
    "fern 504 px 3 views": {**_FERN, "data.view_indices": (0, 8, 16)},
    "fern 504 px 6 views": {**_FERN, "data.view_indices": (0, 3, 6, 10, 13, 16)},
    "fern 504 px 9 views": {**_FERN, "data.view_indices": (0, 2, 4, 6, 8, 10, 12, 14, 16)},
}
CONFIGS = ("few_views", "capture")
HEADS = ("row", "config", "seconds of training", "steps", "seeds", "test PSNR, dB")

_OUT = flags.DEFINE_string("out", "runs/few_views", "Folder of the runs and the measurements.")
_ROWS = flags.DEFINE_list("rows", list(ROWS), f"Of {', '.join(ROWS)}.")
_SEEDS = flags.DEFINE_list("seeds", ["0"], "Every row is trained with each.")
_CONFIGS = flags.DEFINE_list("configs", ["few_views"], f"Of {', '.join(CONFIGS)}.")
_SECONDS = flags.DEFINE_integer("seconds", None, "Of training; those of few_views when not given.", lower_bound=1)


def main(argv: list[str]) -> None:
    """Trains what is missing, then prints everything that is there."""
    del argv
    out = pathlib.Path(_OUT.value)
    kept = common.read_json(out / "protocols.json")
    seconds = _SECONDS.value or int(common.configuration("few_views").train.max_seconds)
    for config in common.chosen("--configs", _CONFIGS.value, CONFIGS):
        for name in common.chosen("--rows", _ROWS.value, ROWS):
            for seed in common.seeds_of("--seeds", _SEEDS.value):
                key = f"{name}; {config}; {seconds}"
                if str(seed) not in kept.setdefault(key, {}):
                    folder = "-".join(name.split())
                    kept[key][str(seed)] = _measure(
                        config,
                        {**ROWS[name], "train.max_seconds": seconds},
                        seed,
                        out / f"{folder}-{config}-{seconds}-{seed}",
                    )
                    common.write_json(out / "protocols.json", kept)
    common.publish([*common.provenance(), "", *report(kept)], "protocols")


def _measure(config, fields, seed, folder):
    """Returns the PSNR and the steps of one run."""
    quiet = {"train.preview_every": 0.0, "eval.summary_seconds": 0.0}
    if not train_and_evaluate(common.configuration(config, {**quiet, **fields}, seed=seed), folder):
        raise KeyboardInterrupt
    run = restore_run(folder)
    variables = run.variables(newest_step(run, folder))
    psnr = common.mean_psnr(run, variables, run.experiment.load_split("test"))
    jax.clear_caches()  # no other run has this step and this renderer
    return {"psnr": psnr, "steps": metric_log.read_rows(folder)[-1]["step"]}


def report(kept: dict[str, dict[str, dict[str, float]]]) -> list[str]:
    """Returns the lines of the table; PSNR is the mean over seeds and their standard deviation."""
    lines = []
    for key, runs in sorted(kept.items()):
        mean, deviation = common.spread([run["psnr"] for run in runs.values()])
        psnr = f"{mean:.2f} ± {deviation:.2f}" if len(runs) > 1 else f"{mean:.2f}"
        steps = statistics.fmean(run["steps"] for run in runs.values())
        lines.append((*key.split("; "), f"{steps:.0f}", str(len(runs)), psnr))
    return common.markdown(HEADS, lines)


if __name__ == "__main__":
    cli.run(main, stopped="between two runs; the same command continues from there")
