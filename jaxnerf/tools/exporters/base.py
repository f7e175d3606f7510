"""What an exporter is, and the call that runs one: restore a run, export it, move the finished folder into place."""

import json
import os
import pathlib
from collections.abc import Callable
from typing import Any, NamedTuple

from jaxnerf.core.views import Views
from jaxnerf.data import dataset
from jaxnerf.evaluation.restore import TrainedRun, newest_step, refined_views, restore_run
from jaxnerf.options import read, values_of
from jaxnerf.runtime import atomic_files
from jaxnerf.tools.exporters.options import ExportOptions
from jaxnerf.tools.exporters.partial_folder import partial_folder
from jaxnerf.tools.exporters.registration import EXPORTERS
from jaxnerf.tools.uncertainty.cleaning import cleaned


class ExportSource(NamedTuple):
    """A restored run, as an exporter receives it.

    Attributes:
        run: with an occupancy grid: that of training, or else one that is extracted from its visible density.
        step: of the checkpoint.
        variables: its parameters and grid, for `run.render_image`.
        views: of the split "train", with the cameras that the run has refined; without pixels if the dataset is not
            there.
        settings: the exporter's options; a box is relative to `Views.file_origin`.
        say: called with a line of text for the user.
    """

    run: TrainedRun
    step: int
    variables: Any
    views: Views
    settings: Any
    say: Callable[[str], None]


def export_run(
    workdir: str | os.PathLike,
    kind: str,
    *,
    step: int | None = None,
    data_dir: str | None = None,
    max_uncertainty: float | str | None = None,
    time: float | None = None,
    name: str | None = None,
    overwrite: bool = False,
    say: Callable[[str], None] = print,
    **settings: Any,
) -> pathlib.Path:
    """Exports a trained run to the folder <workdir>/exports/<name>, which appears complete or not at all.

    Args:
        workdir: the folder that training wrote.
        kind: the name of an exporter.
        step: of the checkpoint; the newest when None.
        data_dir: see `restore_run`.
        max_uncertainty: of the cells of the grid, see `cleaned`.
        time: in [0, 1], of a scene that moves, of which one instant is exported; when None 0, and `say` is told.
        name: of the folder; when None KIND-STEP, or KIND-STEP-timeTIME with a time.
        overwrite: whether an existing folder of that name is replaced.
        say: called with each line for the user.
        **settings: options of the exporter by name.

    Returns:
        The folder.

    Raises:
        ValueError: if there is no such run, checkpoint or exporter, a setting is out of range, or the folder exists.
    """
    exporter = EXPORTERS.get(kind)
    options = read(exporter.options, {**values_of(exporter.options()), **settings}, "")
    options.check()
    if name and (pathlib.Path(name).name != name or name.startswith(".")):
        raise ValueError(f"name is {name!r}, expected a plain file name; drop folders and a leading dot")
    run = restore_run(workdir, data_dir=data_dir, time=time)
    if exporter.check is not None:
        exporter.check(run)
    step = newest_step(run, workdir, step)
    at_time = "" if time is None else f"-time{time:g}"
    target = pathlib.Path(workdir) / "exports" / (name or f"{kind}-{step}{at_time}")
    atomic_files.check_tree(target.parent)
    if target.exists() and not overwrite:
        raise ValueError(f"{target}: exists already; give --overwrite to replace it, or another --name")
    run = _one_instant(run, workdir, data_dir, time, say)
    variables = cleaned(run, workdir, max_uncertainty).variables(step)
    views = refined_views(run, run.experiment.load_split("train", images=None), "train", variables[0])
    target.parent.mkdir(exist_ok=True)
    with partial_folder(target) as partial:
        relative = any(views.file_origin) and not exporter.is_absolute
        if relative:  # in float32, which the formats hold, the sum would be rounded
            say(f"positions are relative to {views.file_origin} of the dataset's files, see file_origin.json")
        if isinstance(options, ExportOptions):
            options = options.relative_to(views.file_origin)
        exporter.export(ExportSource(run, step, variables, views, options, say), partial)
        if relative:
            (partial / "file_origin.json").write_text(json.dumps({"file_origin": views.file_origin}) + "\n")
    return target


def _one_instant(run, workdir, data_dir, time, say):
    """Returns the run with an occupancy grid, and at a time if its scene moves."""
    moves, has_grid = "time" in run.experiment.model.needs, run.experiment.model.grid_schedule is not None
    if moves:
        say("the scene moves, and the export shows time 0; --time=T selects another from 0 to 1")
    if has_grid and not moves:
        return run
    baked = {} if has_grid else {"bake_occupancy": True}  # whole rays through a dense network would take hours
    return restore_run(workdir, data_dir=data_dir, settings=baked, time=0.0 if moves else time)


def can_be_scored(source: ExportSource) -> bool:
    """Returns whether the dataset is there, to score an export on the split `eval.split`; says so if it is not."""
    data, split = source.run.experiment.config.data, source.run.experiment.config.eval.split
    found = dataset.is_there(data)
    if not found:
        source.say(f"not scored, as that needs the images of the split {split!r}; give --data_dir of the dataset")
    return found


def check_memory(needed: float, available: float | None, remedy: str) -> None:
    """Raises a ValueError if bytes that are needed at once are not free; available: None where that is unknown."""
    if available is not None and needed > available:
        raise ValueError(
            f"the export needs about {needed / 1e9:.1f} GB of memory, and {available / 1e9:.1f} GB are free; {remedy}"
        )
