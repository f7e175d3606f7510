"""Finds what a scene needs: the smallest model that is hardly worse than the complete one, as a config.

    python experiments/scene_needs/scene_needs.py --config=capture --out=DIR [--data_dir=...] [--loss=0.2]
        [--seeds=0,1,2] [--steps=800] [--only=view_dependence,width] [--page=FILE.md --table=NAME]

Trains the config's model, and the same with each of PARTS removed or made smaller, for a few steps with every seed,
and scores them on views held out of training. A part is not needed if its removal costs less than --loss dB: the
upper end of a one-sided 95 % interval over the seeds, as runs of one seed draw the same rays. Then parts that are not
needed, and whose removal saves seconds or parameters, are removed together, those that save most first, repeatedly,
as long as all together cost less than --loss. Writes DIR/needs.json, DIR/needs.md and DIR/needed.py, a config for
jaxnerf.train of the original length. The test views are not used. Runs that DIR holds are not repeated.
"""

import json
import pathlib
import pprint
import statistics
import sys
from typing import Any, NamedTuple

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.runtime import cli
from jaxnerf.runtime.atomic_files import write_text
from jaxnerf.training import auto_config
from jaxnerf.training.config import to_config_dict

HEADS = ("removed", "loss, dB", "up to, dB", "training time saved", "parameters saved", "verdict")


def view_dependence(config, alpha):
    """Colour does not depend on the view direction."""
    del alpha
    names = _sections(config)
    return {f"{name}.use_viewdirs": False for name in names if config[name].use_viewdirs}


def coarse_network(config, alpha):
    """One network along equal steps, which takes the other's samples, too."""
    del alpha
    sampling = config.sampling
    if config.sampler == "occupancy" or not sampling.num_fine:
        return {}
    return {"sampling.num_coarse": sampling.num_coarse + sampling.num_fine, "sampling.num_fine": 0}


def frequencies(config, alpha):
    """Two octaves of the position fewer; one level of a hash grid fewer, the finest."""
    del alpha
    if config.field == "hash_grid":
        levels = tuple(config.hash_grid.resolutions)
        return {"hash_grid.resolutions": levels[:-1]} if len(levels) > 1 else {}
    names = [name for name in _sections(config) if config[name].num_freqs > 2]
    return {f"{name}.num_freqs": config[name].num_freqs - 2 for name in names}


def width(config, alpha):
    """Layers of half the features."""
    del alpha
    name = _sections(config)[-1]
    section = config[name]
    if min(section.width, section.view_width) < 16:
        return {}
    return {f"{name}.width": section.width // 2, f"{name}.view_width": section.view_width // 2}


def depth(config, alpha):
    """Half the layers; with a hash grid, those of the colour."""
    del alpha
    key = "hash_grid.view_depth" if config.field == "hash_grid" else "fine.depth"
    section, field = key.split(".")
    layers = config[section][field]
    return {key: layers // 2} if layers > 1 else {}


def features(config, alpha):
    """Half the features per level of a hash grid."""
    del alpha
    count = config.hash_grid.features_per_level
    return {"hash_grid.features_per_level": count // 2} if config.field == "hash_grid" and count > 1 else {}


def samples(config, alpha):
    """Half the samples; with an occupancy grid, steps of twice the length."""
    del alpha
    if config.sampler == "occupancy":
        return {"occupancy.step_size": 2 * config.occupancy.step_size}
    names = [name for name in ("num_coarse", "num_fine") if config.sampling[name] >= 4]
    # Gauss points come in pairs.
    return {f"sampling.{name}": config.sampling[name] // 4 * 2 for name in names}


def precision(config, alpha):
    """Layers in bfloat16."""
    del alpha
    names = [] if config.field == "hash_grid" else _sections(config)
    return {f"{name}.compute_dtype": "bfloat16" for name in names if config[name].compute_dtype != "bfloat16"}


def background(config, alpha):
    """Nothing behind the scene or around its box. (Behind alpha there must be a colour.)"""
    if config.sampler == "occupancy" and config.scene.contracted:
        return {"scene.contracted": False}
    return {} if alpha or config.data.background == "none" else {"data.background": "none"}


# Each takes a resolved config and whether the images have alpha, and returns {"section.field": value}, the change
# that removes the part or makes it smaller; {} where that is impossible.
PARTS = {
    part.__name__: part
    for part in (
        view_dependence,
        coarse_network,
        frequencies,
        width,
        depth,
        features,
        samples,
        precision,
        background,
    )
}

_CONFIG = cli.define_config("Config of the complete model: a name, or the path of a file.", required=True)
_DATA_DIR = flags.DEFINE_string("data_dir", None, "Folder of the dataset, in place of config.data.dir.")
_OUT = flags.DEFINE_string("out", None, "Folder of all runs and results.", required=True)
_LOSS = flags.DEFINE_float("loss", 0.2, "dB that the result may lose.", lower_bound=0.0)
_SEEDS = flags.DEFINE_list("seeds", ["0", "1", "2"], "Seeds of each run, at least two.")
_STEPS = flags.DEFINE_integer("steps", 800, "Steps of each run.", lower_bound=1)
_ONLY = flags.DEFINE_list("only", list(PARTS), "Parts that are tried.")
_TABLE = flags.DEFINE_string("table", "needs", "Name of the table in the marks of --page.")


def _sections(config):
    """Returns the sections of the networks, the one that counts last."""
    if config.field == "hash_grid":
        return ("hash_grid",)
    return ("coarse", "fine") if config.sampling.num_fine and config.sampler != "occupancy" else ("fine",)


class Trial(NamedTuple):
    """One config, trained with every seed.

    Attributes:
        overrides: {"section.field": value} of the complete model's config.
        psnr: by seed, dB, of the held-out views.
        seconds: by seed, of a thousand training steps.
        parameters: their number.
    """

    overrides: dict[str, Any]
    psnr: dict[int, float]
    seconds: dict[int, float]
    parameters: int


class Loss(NamedTuple):
    """What a removal costs and saves.

    Attributes:
        mean: dB lost.
        margin: dB from there to the end of the interval.
        saved: fraction of the seconds of training.
        parameters: number saved.
    """

    mean: float
    margin: float
    saved: float
    parameters: int


class Found(NamedTuple):
    """The result of a search.

    Attributes:
        complete: the trial of the complete model.
        parts: each part removed alone.
        tried: names removed together, and whether that was kept.
        overrides: of the final config.
    """

    complete: Trial
    parts: dict[str, tuple[Trial, Loss]]
    tried: list[tuple[list[str], Loss, bool]]
    overrides: dict[str, Any]


def main(argv: list[str]) -> None:
    """Runs all trials and writes the results."""
    del argv
    seeds = common.seeds_of("--seeds", _SEEDS.value, least=2)
    names = common.chosen("--only", _ONLY.value, list(PARTS))
    out = pathlib.Path(_OUT.value)
    config = cli.use_data(_CONFIG.value, _DATA_DIR.value)
    complete, alpha = short(config, _STEPS.value)
    found = search(complete, alpha, out / "runs", seeds=seeds, loss=_LOSS.value, names=names)
    lines = write(out, config, found, {"loss": _LOSS.value, "steps": _STEPS.value, "seeds": seeds})
    common.publish(lines, _TABLE.value)
    print(f"wrote {out / 'needed.py'}")


def short(config, steps: int):
    """Returns the resolved config of a short run, and whether its images have alpha."""
    budget = {"max_steps": steps, "lr_steps": steps, "max_seconds": 0.0, "save_every": steps}
    changes = {f"train.{name}": value for name, value in budget.items()} | {"eval.at_end": False}
    config = common.changed(config, changes | {"data.hold_out": config.data.hold_out or 8})
    config, views, _ = auto_config.resolve(config)
    return to_config_dict(config), views.pixels.shape[-1] == 4


def search(complete, alpha: bool, folder: pathlib.Path, *, seeds: list[int], loss: float, names: list[str]) -> Found:
    """Searches with short runs.

    Args:
        complete: resolved config.
        alpha: whether the images have alpha.
        folder: of the workdirs.
        seeds: of each run.
        loss: dB.
        names: of PARTS.
    """
    changes = {name: PARTS[name](complete, alpha) for name in names}
    changes = {"complete": {}} | {name: change for name, change in changes.items() if change}
    # Seed by seed, so that runs that are compared lie close together in time.
    rows = [{name: _run(complete, change, folder / name, seed) for name, change in changes.items()} for seed in seeds]
    trials = {name: _trial(change, seeds, [row[name] for row in rows]) for name, change in changes.items()}
    base = trials.pop("complete")
    parts = {name: (trial, compare(base, trial)) for name, trial in trials.items()}
    tried, overrides = _combine(complete, alpha, folder, base, parts, seeds, loss)
    return Found(base, parts, tried, overrides)


def _combine(complete, alpha, folder, base, parts, seeds, loss):
    """Removes one part after the other; returns what was tried, and the last overrides that were kept."""
    queue = sorted(
        (name for name, (_, cost) in parts.items() if not_needed(cost, loss) and worthwhile(cost)),
        key=lambda name: -parts[name][1].saved,
    )
    kept, overrides, tried = [], {}, []
    while queue:
        name = queue.pop(0)
        change = PARTS[name](common.changed(complete, overrides), alpha)
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


def compare(base: Trial, trial: Trial) -> Loss:
    """Returns the Loss of one trial against another with the same seeds."""
    from scipy import stats  # jax depends on it

    lost = common.differences(base.psnr, trial.psnr)
    mean, deviation = common.spread(lost)
    saved = [1 - trial.seconds[seed] / base.seconds[seed] for seed in base.seconds]
    margin = float(stats.t.ppf(0.95, len(lost) - 1)) * deviation / len(lost) ** 0.5
    return Loss(mean, margin, statistics.median(saved), base.parameters - trial.parameters)


def not_needed(cost: Loss, loss: float) -> bool:
    """Returns whether a removal costs at most `loss` dB, with the margin."""
    return cost.mean + cost.margin <= loss


def worthwhile(cost: Loss) -> bool:
    """Returns whether a removal saves more time than a clock resolves, or parameters."""
    return cost.saved > 0.02 or cost.parameters > 0


def _run(complete, overrides, folder, seed):
    config = common.changed(complete, {**overrides, "seed": seed})
    results = common.run(config, folder / str(seed), split="held_out")
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


def write(out: pathlib.Path, config, found: Found, settings: dict[str, Any]) -> list[str]:
    """Writes needs.json, needs.md and needed.py, and returns the lines of the table.

    Args:
        out: the folder.
        config: of the complete model, of its own length.
        found: the result.
        settings: {"loss": dB, "steps": of each run, "seeds": [...]}.
    """
    lines = _page(found, settings)
    plain = {"settings": settings, "complete": found.complete._asdict(), "overrides": found.overrides}
    plain["parts"] = {name: trial._asdict() | cost._asdict() for name, (trial, cost) in found.parts.items()}
    plain["tried"] = [{"removed": names, **cost._asdict(), "kept": kept} for names, cost, kept in found.tried]
    common.write_json(out / "needs.json", plain)
    write_text(out / "needs.md", "\n".join(lines) + "\n")
    write_text(out / "needed.py", _config_file(config, found, settings))
    return lines


def _page(found, settings):
    """Returns the lines of the table."""
    complete, loss = found.complete, settings["loss"]
    scores = [f"{score:.2f}" for score in complete.psnr.values()]
    seconds = sum(complete.seconds.values()) / len(complete.seconds)
    rows = []
    for name, (_, cost) in found.parts.items():
        does = " ".join(PARTS[name].__doc__.split())
        rows.append((f"{name}: {does}", *_cells(cost), verdict(cost, loss)))
    for names, cost, kept in found.tried:
        rows.append((" + ".join(names), *_cells(cost), "removed" if kept else "too much together"))
    left = ", ".join(f"{key}={value}" for key, value in found.overrides.items()) or "nothing"
    return [
        f"{settings['steps']} steps, {len(settings['seeds'])} seeds, held-out views; the complete model: "
        f"{', '.join(scores)} dB, {complete.parameters:,} parameters, {seconds:.1f} s for 1,000 steps.",
        "",
        *common.markdown(HEADS, rows),
        "",
        f"Removed for at most {loss} dB: {left}.",
    ]


def verdict(cost: Loss, loss: float) -> str:
    """Returns in a word whether a part is needed."""
    if not_needed(cost, loss):
        return "not needed"
    return "needed" if cost.mean - cost.margin > loss else "kept: undecided with these seeds"


def _config_file(config, found, settings):
    """Returns the text of a config file: the complete model's without what is not needed."""
    needed = common.changed(config, found.overrides)
    cost = found.tried and next((cost for _, cost, kept in reversed(found.tried) if kept), None)
    price = f"{cost.mean:+.2f} dB" if cost else "nothing"
    about = f"What the scene needs, by scene_needs.py: costs {price} after {settings['steps']} steps."
    body = pprint.pformat(needed.to_dict(), indent=4, width=100, sort_dicts=False)
    return (
        f'"""{about}"""\n\nfrom ml_collections import ConfigDict\n\nFIELDS = {body}\n\n\n'
        "def get_config():\n    return ConfigDict(FIELDS)\n"
    )


def _cells(cost):
    return f"{cost.mean:+.3f}", f"{cost.mean + cost.margin:+.3f}", f"{cost.saved:.0%}", f"{cost.parameters:,}"


if __name__ == "__main__":
    cli.run(main, stopped="after saving; the same command resumes")
