"""What an exporter is, and the call that runs one: restore a run, export it, move the finished folder into place."""

import json
import os
import pathlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxnerf.core.views import Views
from jaxnerf.data.geometry.poses import axis_of
from jaxnerf.evaluation.restore import TrainedRun, newest_step, refined_views, restore_run
from jaxnerf.runtime import atomic_files
from jaxnerf.tools.exporters.registration import EXPORTERS
from jaxnerf.tools.uncertainty.cleaning import cleaned

MAX_RESOLUTION, MAX_SIZE, MAX_POINTS = 1024, 4096, 10_000_000
TEXTURE_SIZES = (64, 8192)
TEXTURED_FACES = 30_000  # the detail is in the texture
FORMATS = ("ply", "glb", "obj")


_PIXELS_PER_VOXEL = 1.25


class ExportSettings(NamedTuple):
    """What the flags of the program set. An exporter reads those that concern it.

    Attributes:
        resolution: voxels along the longest side of the box.
        box: [6] the lower and the upper corner of what is exported, in units of the dataset's files; None: all of a
            bounded scene, and of an unbounded one what is between the cameras. An exporter receives it relative to
            `Views.file_origin`.
        size: px, the longer side of the depth images that are rendered; None: it follows the resolution, see the
            exporters.
        num_views: the largest number of training views whose poses are rendered, spread evenly over all.
        num_points: the largest number of points or Gaussians; None: as many as the exporter selects.
        fit_steps: of fitting Gaussians; 0: they stay as they are placed.
        format: of a mesh, "ply", "glb" or "obj".
        up: the axis of the dataset's files that is up in a GLB, such as "+z"; None: that of the
            option `data.up`, or as the cameras are held.
        closed: whether a mesh has no holes: where no training view looks, it has the surfaces of the field, which was
            not trained there, and what nothing shows to be free is solid.
        max_faces: the number of triangles to which a mesh is decimated; 0: it is not, or with a texture to
            `TEXTURED_FACES`.
        texture: texels along a side of a mesh's texture; 0: its vertices have colours.
        min_piece: connected pieces of a mesh with fewer triangles than this fraction of all are dropped.
        split: whether the data of a web page is in a file beside it.
    """

    resolution: int = 256
    box: tuple[float, ...] | None = None
    size: int | None = None
    num_views: int = 100
    num_points: int | None = None
    fit_steps: int = 400
    format: str = "ply"
    up: str | None = None
    closed: bool = False
    max_faces: int = 0
    texture: int = 0
    min_piece: float = 0.005
    split: bool = False

    @property
    def image_size(self) -> int:
        """The longer side of the depth images of points and splats, px."""
        return self.size or round(_PIXELS_PER_VOXEL * self.resolution)


class ExportSource(NamedTuple):
    """A restored run, as an exporter receives it.

    Attributes:
        run: with an occupancy grid: that of training, or else one that is extracted from its visible density.
        step: of the checkpoint.
        variables: its parameters and grid, for `run.render_image`.
        views: of the split "train", with the cameras that the run has refined.
        settings: of the export.
        say: called with a line of text for the user.
    """

    run: TrainedRun
    step: int
    variables: Any
    views: Views
    settings: ExportSettings
    say: Callable[[str], None]


def export_run(
    workdir: str | os.PathLike,
    kind: str,
    *,
    step: int | None = None,
    data_dir: str | None = None,
    max_uncertainty: float | str | None = None,
    settings: ExportSettings | None = None,
    name: str | None = None,
    overwrite: bool = False,
    say: Callable[[str], None] = print,
) -> pathlib.Path:
    """Exports a trained run to the folder <workdir>/exports/<name>, which appears complete or not at all.

    Args:
        workdir: the folder that training wrote.
        kind: the name of an exporter.
        step: of the checkpoint; the newest when None.
        data_dir: see `restore_run`.
        max_uncertainty: of the cells of the grid, see `cleaned`.
        settings: its defaults when None.
        name: of the folder; KIND-STEP when None.
        overwrite: whether an existing folder of that name is replaced.
        say: called with each line for the user.

    Returns:
        The folder.

    Raises:
        ValueError: if there is no such run, checkpoint or exporter, a setting is out of range, or the folder exists.
    """
    exporter = EXPORTERS.get(kind)
    settings = settings or ExportSettings()
    _check_settings(settings)
    if name and (pathlib.Path(name).name != name or name.startswith(".")):
        raise ValueError(f"name is {name!r}, expected a plain file name; drop folders and a leading dot")
    run = restore_run(workdir, data_dir=data_dir)
    if exporter.check is not None:
        exporter.check(run)
    step = newest_step(run, workdir, step)
    target = pathlib.Path(workdir) / "exports" / (name or f"{kind}-{step}")
    atomic_files.check_tree(target.parent)
    if target.exists() and not overwrite:
        raise ValueError(f"{target}: exists already; give --overwrite to replace it, or another --name")
    if run.experiment.model.grid_schedule is None:  # whole rays through a dense network would take hours
        run = restore_run(workdir, data_dir=data_dir, settings={"bake_occupancy": True})
    variables = cleaned(run, workdir, max_uncertainty).variables(step)
    views = refined_views(run, run.experiment.load_split("train"), "train", variables[0])
    target.parent.mkdir(exist_ok=True)
    with atomic_files.partial_folder(target) as partial:
        if any(views.file_origin):  # in float32, which the formats hold, the sum would be rounded
            say(f"positions are relative to {views.file_origin} of the dataset's files, see file_origin.json")
        relative = relative_to(settings, views.file_origin)
        exporter.export(ExportSource(run, step, variables, views, relative, say), partial)
        if any(views.file_origin):
            (partial / "file_origin.json").write_text(json.dumps({"file_origin": views.file_origin}) + "\n")
    return target


def relative_to(settings: ExportSettings, origin: Sequence[float]) -> ExportSettings:
    """Returns settings whose box is relative to an origin, as positions in an export are; see `Views.file_origin`."""
    if settings.box is None:
        return settings
    return settings._replace(box=tuple((np.float64(settings.box).reshape(2, 3) - origin).reshape(-1).tolist()))


def check_memory(needed: float, available: float | None, remedy: str) -> None:
    """Raises a ValueError if bytes that are needed at once are not free; available: None where that is unknown."""
    if available is not None and needed > available:
        raise ValueError(
            f"the export needs about {needed / 1e9:.1f} GB of memory, and {available / 1e9:.1f} GB are free; {remedy}"
        )


def _check_settings(settings):
    limits = {"resolution": (16, MAX_RESOLUTION), "size": (16, MAX_SIZE), "num_points": (1, MAX_POINTS)}
    limits |= {"fit_steps": (0, 1_000_000), "num_views": (1, 100_000), "max_faces": (0, 10**9), "min_piece": (0.0, 1.0)}
    for field, (least, most) in limits.items():
        value = getattr(settings, field)
        if value is not None and not least <= value <= most:
            raise ValueError(f"{field} is {value}, expected {least} to {most:,}; correct --{field}")
    if settings.texture and not TEXTURE_SIZES[0] <= settings.texture <= TEXTURE_SIZES[1]:
        least, most = TEXTURE_SIZES
        raise ValueError(f"texture is {settings.texture}, expected {least} to {most:,}, or 0; correct --texture")
    if settings.texture and settings.format == "ply":
        raise ValueError(
            f"texture is {settings.texture} and format is 'ply', expected 'glb' or 'obj'; give --format=glb or drop it"
        )
    if settings.format not in FORMATS:
        raise ValueError(f"format is {settings.format!r}, expected one of {', '.join(FORMATS)}; correct --format")
    if settings.up is not None:
        axis_of(settings.up)
    box = settings.box
    if box is not None and not (len(box) == 6 and np.isfinite(box).all() and (np.subtract(box[3:], box[:3]) > 0).all()):
        found = ", ".join(map(str, box))
        raise ValueError(
            f"box is {found}, expected six numbers X0,Y0,Z0,X1,Y1,Z1 in units of the dataset's files, each lower one "
            "below its upper one; correct --box"
        )
