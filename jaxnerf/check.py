"""python -m jaxnerf.check --data_dir=DIR: looks a capture over before hours of training are spent on it.

Exits 0 when nothing was found that would ruin training, 1 when something was or the capture is unreadable.
"""

import pathlib
import sys

from absl import flags

from jaxnerf.runtime import cli

_DATA_DIR = flags.DEFINE_string("data_dir", None, "The scene's folder.")
_FORMAT = flags.DEFINE_string("format", "auto", "blender, transforms, colmap or llff; auto: as training would.")
_NEAR = flags.DEFINE_float("near", None, "Where training's rays begin, in t; its default when not given.")
_FAR = flags.DEFINE_float("far", None, "Where they end.")
_OUT = flags.DEFINE_string("out", None, "PNG of cameras and points; check-<folder>.png here when not given.")
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Replace an earlier picture.")


def main(argv):
    del argv
    from jaxnerf.capture_check import camera_plot
    from jaxnerf.capture_check.report import inspect
    from jaxnerf.data.dataset import scene_folder
    from jaxnerf.data.readers.validation import check_range

    if not _DATA_DIR.value:
        raise ValueError("nothing to check: give --data_dir=DIR of a capture")
    if None not in (_NEAR.value, _FAR.value):
        check_range(_NEAR.value, _FAR.value)
    folder = scene_folder(_DATA_DIR.value)
    out = _picture(folder)
    report = inspect(folder, format=_FORMAT.value, near=_NEAR.value, far=_FAR.value)
    flagged = {index for finding in report.findings for index in finding.frames}
    camera_plot.plot_cameras(report.capture, report.poses, report.places, flagged=flagged).save(out)
    print(report.text())
    print(f"picture: {out}")
    sys.exit(1 if report.ruined else 0)


def _picture(folder):
    """Returns the path of the picture, outside of the capture's folder and not there yet."""
    out = pathlib.Path(_OUT.value or f"check-{folder.resolve().name}.png")
    if out.suffix.lower() != ".png":
        raise ValueError(f"--out is {str(out)!r}, wanted a name that ends in .png; correct it")
    if not out.parent.is_dir():
        raise ValueError(f"--out is {str(out)!r}, and {out.parent} is no folder; make it first")
    if folder.resolve() in out.resolve().parents:
        raise ValueError(f"the picture {out} would lie in the capture's folder, wanted another; give --out")
    if out.exists() and not _OVERWRITE.value:
        raise ValueError(f"{out} is there already; give --overwrite or another --out")
    return out


if __name__ == "__main__":
    cli.run(main)
