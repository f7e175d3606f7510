"""Exports a trained run for other programs: jaxnerf-export --workdir=DIR --kind=mesh.

It writes DIR/exports/KIND-STEP/, in the units and axes of the dataset's files: a mesh with colours or a texture, points
with normals, depth images with cameras, Gaussian splats, or a web page. All but the page need scikit-image, scipy and
trimesh: pip install 'jaxnerf[export]'.
"""

import sys

from absl import flags

from jaxnerf.evaluation import run_flags
from jaxnerf.runtime import cli
from jaxnerf.tools.exporters.registration import EXPORTERS

_WORKDIR = flags.DEFINE_string("workdir", None, "The run's folder.", required=True)
_KIND = flags.DEFINE_string(
    "kind", None, f"What to export: {', '.join(EXPORTERS.names())}, or a registered exporter.", required=True
)
_DATA_DIR = flags.DEFINE_string("data_dir", None, "The dataset's folder. It overrides config.data.dir.")
_STEP = flags.DEFINE_integer("step", None, "The checkpoint's step. When it is not given, the newest is exported.")
_MAX_UNCERTAINTY = cli.define_number("max_uncertainty", run_flags.MAX_UNCERTAINTY)
_RESOLUTION = flags.DEFINE_integer("resolution", 256, "mesh: the voxels along the longest side of the box.")
_BOX = flags.DEFINE_list(
    "box",
    None,
    "The box to export as X0,Y0,Z0,X1,Y1,Z1 in units of the dataset's files. When it is not given, it holds all "
    "surfaces, or in an unbounded scene those between the cameras.",
)
_SIZE = flags.DEFINE_integer(
    "size",
    None,
    "The longer side in px of the depth images from which everything is made. When it is not given, it is the "
    "resolution for a mesh, 1.25 times the resolution for points, and for depth that of the dataset's images.",
)
_NUM_VIEWS = flags.DEFINE_integer(
    "num_views",
    100,
    "The largest number of training views to render. For a mesh of a bounded scene half as many views from all around "
    "are added.",
)
_NUM_POINTS = flags.DEFINE_integer(
    "num_points",
    None,
    "points, splats: the largest number of points or Gaussians. When it is not given, it is 200,000 and 60,000.",
)
_FIT_STEPS = flags.DEFINE_integer(
    "fit_steps", 400, "splats: steps of fitting them to images of the field; 0: they stay as they are placed."
)
_FORMAT = flags.DEFINE_string("format", "ply", "mesh: ply, glb or obj.")
_UP = flags.DEFINE_enum(
    "up",
    None,
    ["+x", "-x", "+y", "-y", "+z", "-z"],
    "mesh: the axis of the dataset's files that is up in a glb. When it is not given, up follows from how the cameras "
    "are held.",
)
_MAX_FACES = flags.DEFINE_integer(
    "max_faces",
    0,
    "mesh: the number of triangles to which it is decimated; 0: it is not, or with --texture to 30,000.",
)
_TEXTURE = flags.DEFINE_integer(
    "texture",
    0,
    "mesh, as glb or obj: the side of a texture in px, which replaces the colours of vertices; 0: off.",
)
_CLOSED = flags.DEFINE_bool(
    "closed",
    False,
    "mesh: whether to close holes: with the surfaces that the field happens to hold where no training view looks, and "
    "else as if what is not seen were solid.",
)
_MIN_PIECE = flags.DEFINE_float(
    "min_piece", 0.005, "mesh: connected pieces with fewer triangles than this fraction of all are dropped."
)
_SPLIT = flags.DEFINE_bool("split", False, "web: whether the scene's data is in a file beside the page, for hosting.")
_CONCERN = {  # the flags that only some kinds read
    ("mesh",): (_FORMAT, _UP, _MAX_FACES, _TEXTURE, _CLOSED, _MIN_PIECE),
    ("points", "splats"): (_NUM_POINTS,),
    ("splats",): (_FIT_STEPS,),
    ("web",): (_SPLIT,),
}
_NAME = flags.DEFINE_string("name", None, "The name of the folder. It overrides KIND-STEP.")
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Whether to replace an existing folder of that name.")


def main(argv):
    del argv
    # Imported after the flags are parsed, so that a wrong flag is reported at once.
    from jaxnerf.tools.exporters.base import ExportSettings, export_run

    for kinds, holders in _CONCERN.items():
        given = [flag.name for flag in holders if flags.FLAGS[flag.name].present]
        if given and _KIND.value not in kinds and _KIND.value in ("mesh", "points", "splats", "depth", "web"):
            raise ValueError(
                f"--{given[0]} is given and --kind={_KIND.value}, expected --kind={' or --kind='.join(kinds)}; drop it"
            )
    names = {"size": _SIZE, "num_views": _NUM_VIEWS, "num_points": _NUM_POINTS, "format": _FORMAT}
    names |= {"resolution": _RESOLUTION, "max_faces": _MAX_FACES, "min_piece": _MIN_PIECE, "closed": _CLOSED, "up": _UP}
    names |= {"split": _SPLIT, "fit_steps": _FIT_STEPS, "texture": _TEXTURE}
    try:
        box = None if _BOX.value is None else tuple(map(float, _BOX.value))
    except ValueError:
        raise ValueError(f"box is {','.join(_BOX.value)}, expected six numbers; correct --box") from None
    settings = ExportSettings(box=box, **{name: flag.value for name, flag in names.items()})
    try:
        folder = export_run(
            _WORKDIR.value,
            _KIND.value,
            step=_STEP.value,
            data_dir=_DATA_DIR.value,
            max_uncertainty=_MAX_UNCERTAINTY.value,
            settings=settings,
            name=_NAME.value,
            overwrite=_OVERWRITE.value,
            say=lambda line: print(line, file=sys.stderr),
        )
    except ImportError as error:
        if error.name is None or error.name.partition(".")[0] == "jaxnerf":
            raise
        raise ValueError(f"the export needs {error.name}; run pip install 'jaxnerf[export]'") from error
    print(*sorted(path for path in folder.iterdir()), sep="\n")


def run():
    """Runs the program."""
    cli.run(main, stopped="before anything was written; the same command starts again")


if __name__ == "__main__":
    run()
