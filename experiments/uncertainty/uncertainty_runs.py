"""The runs that the studies of uncertainty train, in a folder that is kept."""

import os
import pathlib
from collections.abc import Sequence
from typing import Any

import common

from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.training import metric_log
from test_scenes import synthetic_capture

_NUM_MEMBERS, _LESS = 3, {"room70": 2, "fern": 1, "fox": 1}  # of an ensemble; one run is none
_HOLD_OUT = {"fern": 4, "fox": 8, "room70": 8}
_CAPTURE = {"width": 96, "height": 72, "num_held_out": 10, "num_far": 12}  # of a capture
_LEGO_VIEWS = (26, 86, 2, 55, 75, 93, 16, 73)  # of DietNeRF and later papers


def config_of(scene: str, folder: pathlib.Path, *, seed: int = 0) -> Any:
    """Returns the config of a scene.

    Args:
        scene: "still", the embedded one; "demo", the same by configs/quickstart.py; "lego"; "lego8" with 8 training
            views; "can" and "fox", images of a phone; "fern"; "room20" or "room70", the embedded room with so many
            views, whose test views are far from them.
        folder: of all runs, where the captures of the room are.
        seed: of the run.
    """
    scenes = pathlib.Path(os.environ.get("JAXNERF_SCENES", "."))
    lego = {"data.dir": str(scenes / "lego")}
    if scene == "still":
        fields = {"data.size": 100, "data.hold_out": 5, "train.max_seconds": 20.0}
        return common.configuration("quickstart", fields, seed=seed)
    if scene == "demo":
        return common.configuration("quickstart", seed=seed)
    if scene == "lego":
        return common.configuration("lego_fast", {**lego, "data.hold_out": 10, "train.max_seconds": 40.0}, seed=seed)
    if scene == "lego8":
        fields = {"data.view_indices": _LEGO_VIEWS, "train.max_seconds": 40.0}
        return common.configuration("lego_fast", {**lego, **fields}, seed=seed)
    dataset = folder / f"{scene}_capture" if scene.startswith("room") else scenes / scene
    fields = {"data.dir": str(dataset), "data.hold_out": _HOLD_OUT.get(scene, 0), "train.max_seconds": 60.0}
    return common.configuration("capture", fields, seed=seed)


def trained(scene: str, folder: pathlib.Path, *, seed: int = 0) -> pathlib.Path:
    """Returns the workdir of a run, which is trained unless that has been done.

    Raises:
        ValueError: if the workdir holds a run with another config.
    """
    config, workdir = config_of(scene, folder, seed=seed), folder / f"{scene}-{seed}"
    done, origin = workdir / "trained.json", common.plain_config(config)
    if done.exists():
        common.check_origin(common.read_json(done), origin, workdir, "give another --folder, or remove it")
        return workdir
    if scene.startswith("room") and not (folder / f"{scene}_capture").exists():
        views = int(scene.removeprefix("room"))
        synthetic_capture.write_capture(folder / f"{scene}_capture", num_views=views, **_CAPTURE)
    if not train_and_evaluate(config, workdir):
        raise KeyboardInterrupt
    common.write_json(done, origin)
    return workdir


def training_seconds(workdir: pathlib.Path) -> float:
    """Returns the time of a training, without compilation."""
    return metric_log.read_rows(workdir)[-1]["seconds"]


def members_of(scene: str, folder: pathlib.Path) -> Sequence[str]:
    """Returns the workdirs of the other runs of an ensemble, trained."""
    return [str(trained(scene, folder, seed=seed)) for seed in range(1, _LESS.get(scene, _NUM_MEMBERS))]
