"""Measures what each part of configs/few_views.py gains: alone, and left away from the whole.

    JAXNERF_SCENES=... python experiments/few_views/ablation.py --out=DIR [--scenes=lego,fern] [--steps=500] \
        [--seeds=0] [--only="none,whole"] [--page=docs/results/few_views.md]

Trains on the views that the literature names: lego with 8 views and without use of its alpha, fern with 3. PSNR is the
mean over held-out training views, which are not among these; settings were chosen there. The test views, of lego 25
spread over all, are scored for two variants: none of the parts, and the config. Writes DIR/ablation.json
and prints a table for each scene. The same command resumes what was interrupted; other seeds or variants are added.
"""

import pathlib
import sys

import jax
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.evaluation import evaluate, restore
from jaxnerf.runtime import cli
from jaxnerf.training.config import flatten

SCENES = {
    "lego": {
        "data.dir": "lego",
        "data.factor": 8,
        "data.view_indices": (26, 86, 2, 55, 75, 93, 16, 73),
        "data.hold_out": 11,
        "scene.use_alpha": False,
    },
    "fern": {"data.dir": "fern", "data.factor": 16, "data.view_indices": (0, 8, 16), "data.hold_out": 4},
}
PARTS = {
    "total_variation 1": {"losses.total_variation": 1.0},
    "total_variation 10": {"losses.total_variation": 10.0},
    "distortion 0.01": {"losses.distortion": 0.01},
}
NONE, WHOLE = "none", "few_views"
HEADS = ("variant", "held-out PSNR", "to none", "test PSNR")
_OUT = flags.DEFINE_string("out", None, "Folder of the runs and the measurements.", required=True)
_SCENES = flags.DEFINE_list("scenes", list(SCENES), f"Scenes to train on, of {tuple(SCENES)}.")
_STEPS = flags.DEFINE_integer("steps", 500, "Steps of every run.", lower_bound=1)
_SEEDS = flags.DEFINE_list("seeds", ["0"], "Seeds; every variant is trained with each.")
_ONLY = flags.DEFINE_list("only", None, "Names of the variants to train; all when not given.")


def variants() -> dict[str, dict]:
    """Returns {name: {"section.field": value}}, what each variant changes in configs/few_views.py."""
    off = {name: 0.0 for fields in PARTS.values() for name in fields}
    off["losses.distortion"] = common.configuration("capture").losses.distortion
    config = flatten(common.configuration("few_views").to_dict())
    used = [name for name in off if config[name] not in (off[name], "auto")]
    return {
        NONE: off,
        **{name: off | fields for name, fields in PARTS.items()},
        WHOLE: {},
        **{f"{WHOLE} without {name.partition('.')[2]}": {name: off[name]} for name in used},
    }


def main(argv: list[str]) -> None:
    """Trains what is missing, then reports everything that is there."""
    del argv
    out = pathlib.Path(_OUT.value)
    names = common.chosen("--only", _ONLY.value or list(variants()), list(variants()))
    kept = common.read_json(out / "ablation.json")
    if kept.setdefault("steps", _STEPS.value) != _STEPS.value:
        raise ValueError(f"{out / 'ablation.json'}: has runs of {kept['steps']} steps, expected {_STEPS.value}")
    for scene in common.chosen("--scenes", _SCENES.value, list(SCENES)):
        rows = kept.setdefault(scene, {})
        for seed in common.seeds_of("--seeds", _SEEDS.value):
            for name in names:
                if str(seed) not in rows.setdefault(name, {}):
                    print(f"{scene}, seed {seed}: {name}", file=sys.stderr, flush=True)
                    rows[name][str(seed)] = _measure(
                        scene, name, seed, out / f"{scene}-{name.replace(' ', '_')}-{seed}"
                    )
                    common.write_json(out / "ablation.json", kept)
    print("\n".join(common.provenance()))
    lines = []
    for scene in SCENES:
        if scene in kept:
            lines += [f"**{scene}**, {len(SCENES[scene]['data.view_indices'])} views", "", *report(kept[scene]), ""]
    common.publish(lines[:-1], "few_views")


def _measure(scene, name, seed, folder):
    """Returns the measurements of one run."""
    length = {"train.max_steps": _STEPS.value, "train.lr_steps": _STEPS.value, "train.max_seconds": 0.0}
    quiet = {"train.preview_every": 0.0, "eval.summary_seconds": 0.0}
    fields = {**length, **quiet, **SCENES[scene], **variants()[name]}
    if not evaluate.train_and_evaluate(common.configuration("few_views", fields, seed=seed), folder):
        raise ValueError(f"stopped; {folder} is saved, and the same command resumes")
    run = restore.restore_run(folder)
    variables = run.variables(run.steps()[-1])
    splits = ("held_out", "test") if name in (NONE, WHOLE) else ("held_out",)
    found = {split: common.mean_psnr(run, variables, run.experiment.load_split(split)) for split in splits}
    jax.clear_caches()  # no other run has this step and this renderer
    return found


def report(rows: dict) -> list[str]:
    """Returns the lines of the table of a scene; figures are means over seeds."""
    means = {
        name: {key: float(np.mean([run[key] for run in runs.values()])) for key in next(iter(runs.values()))}
        for name, runs in rows.items()
    }
    start = means.get(NONE, {}).get("held_out", np.nan)
    cells = []
    for name, mean in means.items():
        test = f"{mean['test']:.2f}" if "test" in mean else ""
        gain = f"{mean['held_out'] - start:+.2f}"
        cells.append((name, f"{mean['held_out']:.2f}", gain, test))
    return common.markdown(HEADS, cells)


if __name__ == "__main__":
    cli.run(main)
