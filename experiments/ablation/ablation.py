"""Measures what each part of the method gains and costs: the rows of the paper's Table 2, and stratification.

    JAXNERF_SCENES=... python experiments/ablation/ablation.py --out=DIR [--data_dir=/path/to/lego] \
        [--scenes=lego,embedded] [--steps=6000 | --minutes=2] [--seeds=0,1,2] \
        [--only="no hierarchy,5 octaves"] [--page=FILE.md]

Trains and scores the paper's model, scaled down (see `configuration`), and, for as many steps, its variants without
one part; then times their steps in turn. Writes DIR/ablation.json, DIR/pictures.png and, with the extra `experiments`,
DIR/ablation.png, and prints the tables. The same command resumes what was interrupted; other seeds, scenes or variants
are added. With --page the tables replace what lies between <!-- ablation --> and <!-- end of ablation --> in that file.
"""

import pathlib
import statistics
import sys
import types
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from absl import flags
from PIL import Image, ImageDraw

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.configs import lego_small
from jaxnerf.data.images.image_files import read_stored
from jaxnerf.evaluation import output_images
from jaxnerf.runtime import cli

COMPLETE = "complete"
HEADS = ("variant", "PSNR", "by seed, to complete", "", "SSIM", "parameters", "kFLOP a ray", "step's time")
SCENES = {
    "lego": {"data.format": "blender", "data.dir": "lego", "data.factor": 8},
    "embedded": {"data.format": "synthetic", "data.dir": "", "data.factor": 1},
}
_OUT = flags.DEFINE_string("out", None, "Folder of the runs and the measurements.", required=True)
_SCENES = flags.DEFINE_list("scenes", list(SCENES), f"Scenes to train on, of {tuple(SCENES)}.")
_DATA_DIR = flags.DEFINE_string("data_dir", None, "Folder of lego; it is expected in $JAXNERF_SCENES otherwise.")
_STEPS = flags.DEFINE_integer("steps", 0, "Steps of every run; 0: those of `configuration`.", lower_bound=0)
_MINUTES = flags.DEFINE_float("minutes", 0.0, "Instead of --steps: as many as the complete model takes in this time.")
_SEEDS = flags.DEFINE_list("seeds", ["0", "1", "2"], "Seeds; every variant is trained with each.")
_ONLY = flags.DEFINE_list("only", None, "Names of the variants to train; all when not given.")
_ROUNDS, _TIMED_STEPS = 7, 8  # of timings of all variants in turn; steps timed together
_SIDE, _LABEL, _COLUMNS = 150, 16, 6  # px of an image, px of the text above it, images in a row
_VIEW = "002"  # of the test views


def configuration(overrides: Mapping[str, Any] = types.MappingProxyType({}), *, seed: int = 0):
    """Returns the config of lego at 100 x 100: the paper's model scaled down in proportion, with some fields changed.

    The two networks have equal sizes: half the paper's depth and a fifth of its width. Pixels are eight times as
    large, so the model has an eighth of the samples (their distance in pixels stays the same) and three octaves less.
    Softplus and the learning rate are those of `lego_small`. Adam updates all parameters, as in the paper.
    """
    config = lego_small.get_config()
    for network in (config.coarse, config.fine):
        network.depth, network.width, network.skip_layer, network.view_width = 4, 48, 2, 24
        network.num_freqs, network.num_view_freqs, network.use_viewdirs = 7, 4, True
    config.sampling.num_coarse, config.sampling.num_fine = 8, 16
    config.sampling.rule = "segments"
    train = config.train
    train.max_steps, train.lr_steps, train.max_seconds = 1000, 1000, 0.0
    train.save_every, train.muon = 250, 0.0
    return common.changed(config, {**overrides, "seed": seed})


def variants(config, num_views: int) -> dict[str, dict]:
    """Returns {name: {"section.field": value}}, what each variant changes in the complete model.

    As in the paper, without hierarchy one network is evaluated as often as both are with it, and the octaves of
    the direction change in proportion to those of the position.

    Args:
        config: of the complete model.
        num_views: number of training views of the scene.
    """
    counts = config.sampling.num_coarse, config.sampling.num_fine
    no_encoding = _networks(encode=False)
    no_viewdirs = _networks(use_viewdirs=False)
    no_hierarchy = {"sampling.num_coarse": 2 * counts[0] + counts[1], "sampling.num_fine": 0}
    return {
        COMPLETE: {},
        "no positional encoding": no_encoding,
        "no view dependence": no_viewdirs,
        "no hierarchy": no_hierarchy,
        "none of the three": no_encoding | no_viewdirs | no_hierarchy,
        "no stratification": {"sampling.stratified": False},
        "a quarter of the images": {"data.num_views": num_views // 4},
        "half of the images": {"data.num_views": num_views // 2},
        "5 octaves": _networks(num_freqs=5, num_view_freqs=2),
        "15 octaves": _networks(num_freqs=15, num_view_freqs=6),
    }


def _networks(**fields):
    return {f"{network}.{field}": value for network in ("coarse", "fine") for field, value in fields.items()}


def main(argv: list[str]) -> None:
    """Trains what is missing, then reports everything that is there."""
    del argv
    out = pathlib.Path(_OUT.value)
    known = list(variants(configuration(), 4))
    names = common.chosen("--only", _ONLY.value or known, known)
    common.chosen("--scenes", _SCENES.value, list(SCENES))
    seeds = sorted(common.seeds_of("--seeds", _SEEDS.value))
    if _MINUTES.value < 0 or (_MINUTES.value and _STEPS.value):
        raise ValueError(f"--minutes is {_MINUTES.value} and --steps {_STEPS.value}, expected one of them")
    kept = common.read_json(out / "ablation.json")
    for scene in _SCENES.value:
        if not _measure(scene, kept, lambda: common.write_json(out / "ablation.json", kept), out, names, seeds):
            raise ValueError(f"stopped; finished runs are in {out}, and the same command resumes")
    common.publish(report(kept), "ablation")
    draw_images(kept, out, out / "pictures.png")
    plot(kept, out / "ablation.png")


def _measure(scene, kept, save, out, names, seeds):
    """Trains the variants of a scene, one seed after the other; returns whether all were completed."""
    fields = SCENES[scene] | ({"data.dir": _DATA_DIR.value} if _DATA_DIR.value and scene == "lego" else {})
    base = configuration(fields)
    num_views = len(common.load_split(base, "train").offset)
    changes = variants(base, num_views)
    steps = _steps(kept, base)
    about = kept.setdefault("scenes", {}).setdefault(scene, {"views": num_views, "runs": {}})

    def config_of(name, seed):
        budget = {"train.max_steps": steps, "train.lr_steps": steps}
        return configuration({**fields, **budget, **changes[name]}, seed=seed)

    for seed in seeds:
        for name in names:
            print(f"{scene}, seed {seed}: {name}", file=sys.stderr, flush=True)
            results = common.run(config_of(name, seed), _workdir(out, scene, name, seed))
            if results is None:
                return False
            kept_of = ("psnr", "ssim", "training_seconds", "seconds_per_frame", "parameters", "views")
            about["runs"].setdefault(name, {})[str(seed)] = {key: results[key] for key in kept_of}
            save()
    # Times are relative to the complete model, so it is always among them; the scene makes no difference.
    _measure_cost(kept, {name: config_of(name, 0) for name in {*names, COMPLETE}})
    save()
    return True


def _steps(kept, base):
    """Returns the number of steps of all runs and keeps it; raises ValueError if earlier runs took others."""
    before = kept.get("steps")
    steps = _STEPS.value or (0 if _MINUTES.value else base.train.max_steps)
    if before and steps and before != steps:
        raise ValueError(f"{_OUT.value}: has runs of {before} steps, expected {steps}; give another --out")
    kept["steps"] = before or steps or max(int(60 * _MINUTES.value / _fastest_step(base)), 1)
    return kept["steps"]


def _workdir(out, scene, name, seed):
    return out / f"{scene}/{name.replace(' ', '_')}-{seed}"


def _measure_cost(kept, configs):
    """Adds to kept["cost"] what training costs each variant {name: config}, the complete one among them.

    "flops": of the compiled step, per ray. "time": over that of the complete model, the median over rounds in which
    each is timed once, so that other load on the machine matters less. "ms": of a step.
    """
    if kept.get("cost", {}).keys() >= configs.keys():
        return
    kept["machine"] = common.describe_machine()
    steps = {name: common.compile_step(config) for name, config in configs.items()}
    rounds = [{name: _seconds(step) for name, step in steps.items()} for _ in range(1 + _ROUNDS)][1:]
    for name, step in steps.items():
        cost = {"flops": _flops_per_ray(step), "ms": 1e3 * statistics.median(row[name] for row in rounds)}
        cost["time"] = statistics.median(row[name] / row[COMPLETE] for row in rounds)
        kept.setdefault("cost", {})[name] = cost


def _flops_per_ray(step):
    # XLA counts the body of the loop over microbatches once.
    whole = step.positions.shape[0] == 1
    return (step.run.cost_analysis()["flops"] if whole else step.count_flops()) / step.positions.size


def _fastest_step(config):
    step = common.compile_step(config)
    return min(_seconds(step) for _ in range(4))


def _seconds(step):
    """Returns the mean seconds of a few steps from the initial state."""
    state = jax.block_until_ready(jax.tree.map(jax.numpy.copy, step.state))

    def some_steps():
        current = state
        for _ in range(_TIMED_STEPS):
            current, metrics = step.run(current, step.data, step.positions)
        return metrics

    return common.seconds(some_steps) / _TIMED_STEPS


def report(kept: dict) -> list[str]:
    """Returns the lines of the tables, one per scene."""
    lines = []
    for scene, about in kept["scenes"].items():
        seeds = sorted({int(seed) for runs in about["runs"].values() for seed in runs})
        views = next(iter(next(iter(about["runs"].values())).values()))["views"]
        lines += [
            f"{scene}: {about['views']} training views, {views} test views, {kept['steps']:,} steps of every "
            f"run, seeds {', '.join(map(str, seeds))}. Figures are means +- standard deviation over seeds. "
            f"Times: {kept.get('machine', 'not measured')}.",
            "",
            *common.markdown(HEADS, [_row(name, about, kept.get("cost", {}).get(name)) for name in about["runs"]]),
            "",
            _agreement(about),
            "",
        ]
    return lines[:-1]


def _agreement(about):
    """Returns a line that compares with the paper's Table 2, where every variant is worse."""
    found = {}
    for name in about["runs"]:
        if name != COMPLETE:
            found.setdefault(verdict(to_complete(name, about)), []).append(name)
    parts = [f"{what}: {', '.join(names)}" for what, names in found.items() if what != "-"]
    return f"In the paper's Table 2, which has no row on stratification, all are worse. Here {'; '.join(parts)}."


def _row(name, about, cost):
    """Returns the cells of a variant; cost is None where it was not measured."""
    runs = about["runs"][name]
    to_complete_by_seed = to_complete(name, about)
    return (
        name,
        _mean([run["psnr"] for run in runs.values()], 2),
        ", ".join(f"{value:+.2f}" for value in to_complete_by_seed) or "-",
        verdict(to_complete_by_seed) if name != COMPLETE else "",
        _mean([run["ssim"] for run in runs.values()], 3),
        f"{next(iter(runs.values()))['parameters']:,}",
        f"{cost['flops'] / 1e3:,.0f}" if cost else "-",
        f"{cost['time']:.2f}" if cost else "-",
    )


def to_complete(name: str, about: dict) -> list[float]:
    """Returns a variant's PSNR minus the complete model's of the same seed, by ascending seed."""
    if name == COMPLETE:
        return []
    scores = [
        {int(seed): run["psnr"] for seed, run in about["runs"].get(which, {}).items()} for which in (name, COMPLETE)
    ]
    return common.differences(*scores)


def verdict(differences: list[float]) -> str:
    """Returns what all seeds agree on."""
    if not differences:
        return "-"
    if min(differences) < 0 < max(differences) or not any(differences):
        return "undecided"
    return ("worse" if min(differences) < 0 else "better") + (" (one seed)" if len(differences) == 1 else "")


def _mean(values, digits):
    mean, deviation = common.spread(values)
    return f"{mean:.{digits}f}" + (f" +- {deviation:.{digits}f}" if len(values) > 1 else "")


def draw_images(kept: dict, out: pathlib.Path, path: pathlib.Path) -> None:
    """Writes one test view of each scene as the first seed of every variant renders it, after the truth."""
    rows = []
    for scene, about in kept["scenes"].items():
        panels = []
        for name, runs in about["runs"].items():
            scores = (_workdir(out, scene, name, min(map(int, runs))) / "eval").glob("*/results.json")
            newest = max((path.parent for path in scores), key=lambda folder: int(folder.name))
            if not panels:
                panels.append(_panel(newest / "gt-color" / f"{_VIEW}.png", "truth"))
            panels.append(_panel(newest / "color" / f"{_VIEW}.png", name))
        panels += [np.full_like(panels[0], 255)] * (-len(panels) % _COLUMNS)
        rows += [np.concatenate(panels[i : i + _COLUMNS], 1) for i in range(0, len(panels), _COLUMNS)]
    output_images.write_image(path, np.concatenate(rows))
    print(f"wrote {path}")


def _panel(path, name):
    image = Image.new("RGB", (_SIDE, _SIDE + _LABEL), "white")
    image.paste(Image.fromarray(read_stored(path)).resize((_SIDE, _SIDE)), (0, _LABEL))
    ImageDraw.Draw(image).text((3, 2), name, "black", font_size=10)
    return np.asarray(image)


def plot(kept: dict, path: pathlib.Path) -> None:
    """Plots what each variant loses, one dot per seed, and PSNR against the FLOPs of a ray."""
    pyplot = common.pyplot()
    if pyplot is None:
        return
    scenes = kept["scenes"]
    figure, axes = pyplot.subplots(len(scenes), 2, figsize=(12, 4.2 * len(scenes)), layout="constrained", squeeze=False)
    for (left, right), (scene, about) in zip(axes, scenes.items(), strict=True):
        names = [name for name in about["runs"] if name != COMPLETE][::-1]
        for height, name in enumerate(names):
            values = to_complete(name, about)
            if values:
                left.barh(height, statistics.fmean(values), color=f"C{height}", alpha=0.4)
                left.plot(values, [height] * len(values), "k.", markersize=4)
        left.set(yticks=range(len(names)), yticklabels=names, xlabel="PSNR minus the complete model's, dB")
        left.axvline(0, color="k", linewidth=0.8)
        left.set_title(f"{scene}, {kept['steps']:,} steps; one dot per seed", fontsize=10)
        for name, cost in kept.get("cost", {}).items():
            scores = [run["psnr"] for run in about["runs"].get(name, {}).values()]
            if scores:
                color = f"C{names.index(name)}" if name in names else "k"
                where = cost["flops"] / 1e3, statistics.fmean(scores)
                right.errorbar(*where, yerr=[[where[1] - min(scores)], [max(scores) - where[1]]], color=color)
                right.plot(*where, "o", color=color)
                if name == COMPLETE:
                    right.annotate(name, where, fontsize=8, xytext=(6, 3), textcoords="offset points")
        right.margins(x=0.2)
        right.set_title("colours as on the left", fontsize=10)
        right.set(xlabel="kFLOP per ray of training", ylabel="PSNR on test views, dB")
        for axis in (left, right):
            axis.grid(alpha=0.3)
    common.save_figure(figure, path)


if __name__ == "__main__":
    cli.run(main, stopped="after saving the finished runs; the same command resumes")
