"""What each part of the method buys and costs: the rows of the paper's Table 2, at a size for one core.

    JAXNERF_SCENES=... python experiments/ablation.py --out=DIR [--data_dir=/path/to/lego] \
        [--scenes=lego,embedded] [--steps=6000 | --minutes=2] [--seeds=0,1,2] \
        [--only="no hierarchy,5 octaves"] [--readme=README.md]

Trains and scores configs/ablation.py and, for as many steps, what it is without one part, as
ablation_variants.py says; then times all their steps in turn. Writes DIR/ablation.json, ablation.png (which
needs the extra `experiments`) and pictures.png, and prints the tables. The same command goes on where it
was stopped; other seeds, scenes or variants are added to what is there. With --readme the tables replace
what lies between <!-- ablation --> and <!-- end of ablation --> in that file.
"""

import json
import pathlib
import sys

import paired_runs
import table  # which defines --readme
from ablation_variants import COMPLETE, variants, workdir_name
from absl import flags

from jaxnerf.runtime import cli

SCENES = {
    "lego": {"data.format": "blender", "data.dir": "lego", "data.factor": 8},
    "embedded": {"data.format": "synthetic", "data.dir": "", "data.factor": 1},
}
MARKS = ("<!-- ablation -->", "<!-- end of ablation -->")
_OUT = flags.DEFINE_string("out", None, "Folder of the runs and of what is measured.", required=True)
_SCENES = flags.DEFINE_list("scenes", list(SCENES), f"Of {tuple(SCENES)}.")
_DATA_DIR = flags.DEFINE_string("data_dir", None, "Folder of lego; else it is looked for in $JAXNERF_SCENES.")
_STEPS = flags.DEFINE_integer("steps", 0, "Of every run; 0: those of configs/ablation.py.", lower_bound=0)
_MINUTES = flags.DEFINE_float("minutes", 0.0, "In place of steps: as many as the complete model takes then.")
_SEEDS = flags.DEFINE_list("seeds", ["0", "1", "2"], "One run of every variant with each.")
_ONLY = flags.DEFINE_list("only", None, "Names of variants; all when not given.")


def main(argv):
    """Runs what is asked for and is not there yet, then reports all that is there."""
    del argv
    import ablation_plot
    import ablation_report

    out = pathlib.Path(_OUT.value)
    wanted = _asked()
    out.mkdir(parents=True, exist_ok=True)
    path = out / "ablation.json"
    kept = json.loads(path.read_text()) if path.exists() else {}
    for scene in _SCENES.value:
        if not _measure(scene, kept, lambda: _save(path, kept), out, wanted):
            raise ValueError(f"stopped; what was run is in {out}, and the same command goes on from there")
    lines = ablation_report.report(kept)
    print("\n".join(lines))
    if flags.FLAGS.readme:
        table.replace(pathlib.Path(flags.FLAGS.readme), lines, MARKS)
    ablation_plot.draw_pictures(kept, out, out / "pictures.png")
    ablation_plot.plot(kept, out / "ablation.png")


def _asked():
    """Returns the names of the variants and the seeds asked for; ValueError on what is not there."""
    known = list(variants(paired_runs.configuration("ablation"), 4))
    chosen = [name.strip() for name in _ONLY.value or known]
    lists = (("--only", chosen, known), ("--scenes", _SCENES.value, list(SCENES)))
    for flag, names, allowed in lists:
        wrong = [name for name in names if name not in allowed]
        if wrong:
            raise ValueError(f"{flag} has {wrong[0]!r}, wanted some of {', '.join(allowed)}")
    if not _SEEDS.value or not all(seed.strip().isdigit() for seed in _SEEDS.value):
        raise ValueError(f"--seeds is {','.join(_SEEDS.value)!r}, wanted whole numbers as 0,1,2")
    if _MINUTES.value < 0 or (_MINUTES.value and _STEPS.value):
        raise ValueError(f"--minutes is {_MINUTES.value} with --steps {_STEPS.value}; give one of them")
    return chosen, sorted({int(seed) for seed in _SEEDS.value})


def _measure(scene, kept, save, out, wanted):
    """Runs the variants of a scene, a seed after the other; returns whether all came to their end."""
    import ablation_cost

    names, seeds = wanted
    fields = SCENES[scene] | ({"data.dir": _DATA_DIR.value} if _DATA_DIR.value and scene == "lego" else {})
    base = paired_runs.configuration("ablation", fields)
    views = ablation_cost.load_views(base)
    changes = variants(base, len(views.offset))
    steps = _steps(kept, lambda: ablation_cost.steps_in(base, views, 60 * _MINUTES.value), base)
    about = kept.setdefault("scenes", {}).setdefault(scene, {"views": len(views.offset), "runs": {}})

    def configuration(name, seed):
        budget = {"train.max_steps": steps, "train.lr_steps": steps}
        return paired_runs.configuration("ablation", {**fields, **budget, **changes[name]}, seed=seed)

    for seed in seeds:
        for name in names:
            folder = out / workdir_name(scene, name, seed)
            print(f"{scene}, seed {seed}: {name}", file=sys.stderr, flush=True)
            results = paired_runs.run(configuration(name, seed), folder)
            if results is None:
                return False
            kept_of = ("psnr", "ssim", "training_seconds", "seconds_per_frame", "parameters", "views")
            about["runs"].setdefault(name, {})[str(seed)] = {key: results[key] for key in kept_of}
            save()
    # Times are told by that of the complete model, so it is always among them; the scene makes no difference.
    ablation_cost.measure(kept, {name: configuration(name, 0) for name in {*names, COMPLETE}}, views)
    save()
    return True


def _steps(kept, count, base):
    """Returns how many steps all runs take, which is kept; ValueError if earlier runs took others."""
    before = kept.get("steps")
    asked = _STEPS.value or (0 if _MINUTES.value else base.train.max_steps)
    if before and asked and before != asked:
        raise ValueError(f"{_OUT.value}: has runs of {before} steps, wanted {asked}; give another --out")
    kept["steps"] = before or asked or count()
    return kept["steps"]


def _save(path, kept):
    from jaxnerf.training.workdir import write_text

    write_text(path, json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    cli.run(main, stopped="and kept what was finished; the same command goes on from there")
