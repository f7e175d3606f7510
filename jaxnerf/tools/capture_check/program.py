"""Checks a dataset before training: jaxnerf-check --data_dir=DIR, or what a run's images cover: --workdir=RUN.

Of a dataset it prints a report and writes a plot of the cameras. It exits with 0 if it finds no error that would make
training useless, and with 1 if it does or if the dataset is unreadable. Of a run it prints from where the scene has
been seen too little and where to take the next images, and writes these as a camera path, and a plot.
"""

import pathlib
import sys

from absl import flags

from jaxnerf.runtime import cli, stages

_DATA_DIR = flags.DEFINE_string("data_dir", None, "The dataset's folder. With --workdir, it overrides config.data.dir.")
_WORKDIR = flags.DEFINE_string("workdir", None, "The folder of a trained run whose coverage is reported.")
_NEXT = flags.DEFINE_integer(
    "next_images", 5, "With --workdir: the number of further images to propose.", lower_bound=1, upper_bound=100
)
_STEP = cli.define_step("With --workdir: the checkpoint's step. When it is not given, the newest.")
_FORMAT = flags.DEFINE_string("format", "auto", "The dataset's format, or auto, which selects the one training uses.")
_NEAR = flags.DEFINE_float("near", None, "The t at which rays will begin. When it is not given, training's default.")
_FAR = flags.DEFINE_float("far", None, "The t at which rays will end. When it is not given, training's default.")
_UP = flags.DEFINE_enum(
    "up",
    None,
    ["+x", "-x", "+y", "-y", "+z", "-z"],
    "The axis of the dataset's files that is up. When it is not given, up follows from how the cameras are held.",
)
_OUT = flags.DEFINE_string(
    "out",
    None,
    "The PNG with the cameras and points. When it is not given, check-FOLDER.png of a dataset or "
    "next-images-FOLDER.png of a run is written here.",
)
_OVERWRITE = flags.DEFINE_bool(
    "overwrite", False, "Whether to replace the PNG if it is not an earlier plot of the same dataset or run."
)


def main(argv):
    del argv
    if _WORKDIR.value is None:
        _check_dataset()
    else:
        _check_coverage()


def _check_dataset():
    if _DATA_DIR.value is None:
        raise ValueError("neither --data_dir nor --workdir is given, expected one of them; give the dataset's folder")
    for flag in (_NEXT, _STEP):
        if flag.present:
            raise ValueError(f"--{flag.name} is given without --workdir, expected a trained run with it; drop the flag")
    try:
        import cv2  # noqa: F401
    except ImportError as error:
        raise ValueError(
            f"jaxnerf-check compares images with OpenCV, which is unavailable ({error}); install it with "
            "`pip install opencv-python-headless`"
        ) from None
    # Imported after the flags are parsed, so that a wrong flag is reported at once.
    from jaxnerf.data.dataset import dataset_folder
    from jaxnerf.tools.capture_check.report import inspect

    near, far = _NEAR.value or 0.0, float("inf") if _FAR.value is None else _FAR.value
    if not 0 <= near < far:
        raise ValueError(f"--near is {near:g} and --far {far:g}, expected 0 <= near < far; enclose the scene")
    folder = dataset_folder(_DATA_DIR.value)
    camera_plot, plot = _plot_of(folder)
    with stages.stage("checking the dataset"):
        report = inspect(folder, format=_FORMAT.value, near=_NEAR.value, far=_FAR.value, up=_UP.value)
    print(report.text())
    if camera_plot:
        camera_plot.save(camera_plot.plot_cameras(report), plot, folder)
    print(f"plot: {plot}")
    sys.exit(1 if report.num_errors else 0)


def _check_coverage():
    for flag in (_FORMAT, _NEAR, _FAR):
        if flag.present:
            raise ValueError(f"--{flag.name} is given with --workdir, whose config states it; drop the flag")
    from jaxnerf.tools.next_images.propose import propose_images, save_path

    folder = pathlib.Path(_WORKDIR.value)
    camera_plot, plot = _plot_of(folder)
    options = {"step": _STEP.value, "data_dir": _DATA_DIR.value, "up": _UP.value}
    report = propose_images(folder, _NEXT.value, **options)
    print(report.text())
    if camera_plot:
        title = f"{folder}: {len(report.views.size)} cameras (blue), {len(report.proposals)} next images (orange)"
        cells = report.positions, report.directions
        figure = camera_plot.plot_coverage(report.views.cameras, report.next_cameras, report.up, *cells, title)
        camera_plot.save(figure, plot, folder)
    path = save_path(report, folder)
    print(f"plot: {plot}")
    print(f"path: {path}; jaxnerf-render --workdir={folder} --path={path} renders it")


def _plot_of(folder):
    """Returns the module that plots and the path of the plot; None and the reason without matplotlib."""
    try:
        from jaxnerf.tools.capture_check import camera_plot
    except ImportError as error:
        return None, f"none: matplotlib is unavailable ({error}); install it with `pip install matplotlib`"
    is_run = _WORKDIR.value is not None
    return camera_plot, camera_plot.new_path(_OUT.value, folder, is_run=is_run, overwrite=_OVERWRITE.value)


def run():
    """Runs the program."""
    cli.run(main)


if __name__ == "__main__":
    run()
