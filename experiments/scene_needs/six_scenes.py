"""Shows what six scenes need side by side, and scores the lean model of each beside the complete one on test views.

    taskset -c 0 python experiments/scene_needs/six_scenes.py --out=DIR [--scenes=lego,mic,fern,fox,can,trex]
        [--budget=10min] [--seconds=60] [--config=capture]
        [--parts=PART,...] [--trial=0] [--page=docs/results/scene_needs.md]

Runs jaxnerf-needs on each scene, which reads no test view. Then the complete model and the lean one train for as many
seconds each, on all training views and at the size of the config, and are scored on the test views once. On one core,
seconds are CPU time of the process. What DIR holds of an earlier start is not repeated.
"""

import importlib.util
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from absl import flags

sys.path += [str(folder) for folder in pathlib.Path(__file__).resolve().parents[:2]]
import common
from program import run_program

from jaxnerf.runtime import cli

MODELS = ("complete", "lean")
_OUT = flags.DEFINE_string("out", None, "Folder of all results.", required=True)
_SCENES = flags.DEFINE_list("scenes", ["lego", "mic", "fern", "fox", "can", "trex"], "Folders below $JAXNERF_SCENES.")
_BUDGET = flags.DEFINE_string("budget", "10min", "Of the program, for each scene.")
_PARTS = flags.DEFINE_list("parts", [], "Parts that are tried; all if none is named.")
_SECONDS = flags.DEFINE_float(
    "seconds", 60.0, "Training of a model that is scored on test views; 0: no lean model.", lower_bound=0.0
)
_TRIAL = flags.DEFINE_float(
    "trial", 0.0, "Seconds of training of each trial; 0: as the budget allows.", lower_bound=0.0
)
_CONFIG = flags.DEFINE_string("config", "capture", "Config of the complete model.")


def main(argv: list[str]) -> None:
    """Runs everything and prints the tables."""
    del argv
    out, needs, scores = pathlib.Path(_OUT.value), {}, {}
    origin = common.provenance()  # before the page changes the tree
    options = [f"--parts={','.join(_PARTS.value)}"] if _PARTS.value else []
    options += [f"--seconds={_TRIAL.value}"] if _TRIAL.value else []
    options += [] if _SECONDS.value else ["--nolean"]
    for scene in _SCENES.value:
        arguments = [f"--config={_CONFIG.value}", *options]
        needs[scene] = run_program(scene, out / scene / "needs", _BUDGET.value, *arguments)
        publish(needs, scores, origin)
    for scene in _SCENES.value if _SECONDS.value else ():
        scores[scene] = score(scene, out / scene, needs[scene]["lean"]["parts"])
        publish(needs, scores, origin)


def publish(needs: Mapping[str, dict[str, Any]], scores: Mapping[str, dict[str, Any]], origin: Sequence[str]) -> None:
    """Prints the tables of the scenes so far, and writes them to the page; origin: the table of the command."""
    tables = [parts_table(needs, _BUDGET.value)]
    tables += [lean_table(needs, scores, _SECONDS.value)] if scores else []
    tables += [origin]
    common.publish([line for table in tables for line in (*table, "")][:-1], "six")


def score(scene: str, folder: pathlib.Path, changed: Sequence[str]) -> dict[str, dict[str, float]]:
    """Returns what the complete and the lean model reach on the test views, by model.

    Args:
        scene: name.
        folder: of its results.
        changed: the parts in which the lean model differs; without one it is the complete model.
    """
    from jaxnerf.tools.needs.trial import Trainer
    from jaxnerf.training import auto_config

    path = folder / "test_views.json"
    found = common.read_json(path)
    for model in MODELS:
        if model in found:
            continue
        if model == "lean" and not changed:
            found[model] = found["complete"]
            continue
        base = common.configuration(_CONFIG.value) if model == "complete" else config_of(folder / "needs" / "lean.py")
        changes = {"data.dir": scene, "data.hold_out": 0, "train.max_seconds": _SECONDS.value}
        config, views, _ = auto_config.resolve(common.changed(base, changes))
        result, _ = Trainer(config, views, split="test").run({}, 0, _SECONDS.value)
        found[model] = {"psnr": sum(result.psnr) / len(result.psnr), "views": len(result.psnr), "steps": result.steps}
        found[model] |= {name: getattr(result, name) for name in ("parameters", "memory", "frame_seconds")}
        common.write_json(path, found)
    return found


def config_of(path: pathlib.Path) -> Any:
    """Returns the config of a file."""
    spec = importlib.util.spec_from_file_location("lean", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.get_config()


def parts_table(needs: Mapping[str, dict[str, Any]], budget: str) -> list[str]:
    """Returns the lines of the table of verdicts: a row a part and change, a column a scene."""
    rows = {}
    for scene, results in needs.items():
        for row in results["parts"]:
            rows.setdefault(f"{row['part']}, {row['change']}", {})[scene] = cell(row)
    body = [(name, *(cells.get(scene, "") for scene in needs)) for name, cells in rows.items()]
    trials = [f"{scene} {results['plan']['length']:.0f} s" for scene, results in needs.items()]
    complete = [f"{results['complete']['psnr']:.2f} dB" for results in needs.values()]
    about = f"A budget of {budget} a scene; a trial trains for: {', '.join(trials)}."
    took = [f"{results['spent']:.0f} s" for results in needs.values()]
    rows = [("the program took", *took), ("complete model", *complete), *body]
    return [about, "", *common.markdown(("part, change", *needs), rows)]


def cell(row: Mapping[str, Any]) -> str:
    """Returns the verdict of a row and what its part contributes, dB."""
    if row["effect"] is None:
        return "not tried"
    mean = f"{row['effect']['mean']:+.2f}"
    words = {"needed": f"**{mean}**", "not needed": mean}
    return words.get(row["verdict"], f"{mean} ?")


def lean_table(needs: Mapping[str, dict[str, Any]], scores: Mapping[str, dict[str, Any]], seconds: float) -> list[str]:
    """Returns the lines of the table of lean models, with the mean difference."""
    rows, gains = [], []
    for scene, found in scores.items():
        complete, lean = (found[model] for model in MODELS)
        gains.append(lean["psnr"] - complete["psnr"])
        pairs = [
            f"{complete['parameters'] / 1e6:.2f}, {lean['parameters'] / 1e6:.2f}",
            f"{complete['memory'] / 1e6:.0f}, {lean['memory'] / 1e6:.0f}",
            f"{complete['frame_seconds']:.2f}, {lean['frame_seconds']:.2f}",
        ]
        changes = "; ".join(needs[scene]["lean"]["parts"]) or "nothing"
        rows.append((scene, f"{complete['psnr']:.2f}", f"{lean['psnr']:.2f}", f"{gains[-1]:+.2f}", *pairs, changes))
    heads = ("scene", "complete, dB", "lean, dB", "gain", "million parameters", "MB", "s a frame", "changed")
    mean = f"{sum(gains) / len(gains):+.2f} dB"
    about = f"Test views after {seconds:.0f} s each, complete and lean; the mean gain is {mean}."
    return [about, "", *common.markdown(heads, rows)]


if __name__ == "__main__":
    cli.run(main, stopped="the same command continues")
