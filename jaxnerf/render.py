"""Renders images and a video of a run along a camera path: jaxnerf-render --workdir=DIR.

`python -m jaxnerf.render` is the same program. It writes DIR/renders/PATH-STEP/ and a video beside it.
"""

import sys

from absl import flags

from jaxnerf.evaluation import run_flags
from jaxnerf.runtime import cli

_SIDE = {"lower_bound": 1, "upper_bound": 16384}
_RUN = run_flags.RunFlags(
    "rendered", "uncertainty/0000.tiff, in units of colour, an image of it, and a video", required=True
)
_PATH = flags.DEFINE_string(
    "path",
    None,
    "turntable, arc, spiral, ellipse, interpolate, still (the first view's camera), or FILE.json. When it is not "
    "given, the program selects the kind that stays where the views' cameras are: a turntable only if they surround "
    "the object, otherwise an arc, or a spiral if all look one way.",
)
_FRAMES = flags.DEFINE_integer(
    "frames",
    None,
    "The number of frames. When it is not given, a turntable or a still camera has 48, an arc 96, a spiral or ellipse "
    "120, interpolate 6 for each view, but at most 240.",
    lower_bound=1,
    upper_bound=100_000,
)
_CLOSED = flags.DEFINE_bool("closed", False, "Whether --path=interpolate returns to the first view.")
_UP = flags.DEFINE_enum(
    "up",
    None,
    ["+x", "-x", "+y", "-y", "+z", "-z"],
    "The axis of the dataset's files that is up in a turntable, arc or ellipse. When it is not given, up follows from "
    "how the cameras are held; jaxnerf-check prints it.",
)
_WIDTH = flags.DEFINE_integer(
    "width", None, "The width in px. When it is not given, it follows --height, or the first view.", **_SIDE
)
_HEIGHT = flags.DEFINE_integer(
    "height", None, "The height in px. When it is not given, it follows --width, or the first view.", **_SIDE
)
_MAX_RAYS = flags.DEFINE_integer(
    "max_rays_per_pixel",
    16,
    "The most rays per pixel. A pixel that covers more of the scene than a ray of training, as in small images and "
    "from afar, is the mean of as many rays as training has there. 1 renders one ray per pixel.",
    lower_bound=1,
    upper_bound=4096,
)
_TIME = flags.DEFINE_string(
    "time",
    None,
    "Of a scene that moves: one time from 0 to 1, or FIRST:LAST, between which it runs. When it is not given, those of "
    "the path's file, or 0:1.",
)
_SECONDS = flags.DEFINE_float(
    "seconds",
    None,
    "The duration of the video. Without --frames it has 24 frames per second.",
    lower_bound=0.01,
    upper_bound=1e5,
)
_FPS = flags.DEFINE_float(
    "fps", None, "Frames per second. When it is not given, those of the path, or 24.", lower_bound=0.1, upper_bound=1e3
)
_VIDEO = flags.DEFINE_string(
    "video", "auto", "The format of the video: mp4, gif, none, or auto: mp4 if imageio finds ffmpeg, otherwise gif."
)
_DEPTH = flags.DEFINE_bool("depth", False, "Whether to make a video of the depth, too.")
_RGBA = flags.DEFINE_bool("rgba", False, "Whether to write rgba/0000.png, too: straight alpha, no background.")
_NAME = flags.DEFINE_string("name", None, "The name of the folder and the video. It overrides the path's.")
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Whether to delete the frames of an earlier call first.")
_SHARD = flags.DEFINE_string(
    "shard",
    None,
    "K/N renders each N-th frame from frame K on, where K counts from 0; auto takes K and N from srun or mpirun. "
    "Any number of processes may run at once; the last one to finish makes the video.",
)


def _times(text):
    """Returns the first and the last time of a flag; None without it."""
    if text is None:
        return None
    try:
        times = [float(part) for part in text.split(":")]
    except ValueError:
        times = []
    if not (0 < len(times) <= 2 and all(0 <= time <= 1 for time in times)):
        raise ValueError(f"--time is {text!r}, expected a number from 0 to 1, or two as FIRST:LAST; correct it")
    return times[0], times[-1]


def main(argv):
    del argv
    # Imported after the flags are parsed, so that a wrong flag is reported at once.
    from jaxnerf.evaluation.paths.render_path import Frames, Output, render_path
    from jaxnerf.runtime import shards

    predictor = _RUN.predictor()
    frames = Frames(
        path=_PATH.value,
        num_frames=_FRAMES.value,
        closed=_CLOSED.value,
        up=_UP.value,
        width=_WIDTH.value,
        height=_HEIGHT.value,
        time=_times(_TIME.value),
        seconds=_SECONDS.value,
        max_rays_per_pixel=_MAX_RAYS.value,
    )
    output = Output(
        name=_NAME.value,
        rgba=_RGBA.value,
        depth=_DEPTH.value,
        video=_VIDEO.value,
        fps=_FPS.value,
        overwrite=_OVERWRITE.value,
        shard=shards.parse(_SHARD.value),
    )
    run, workdir = _RUN.restore(), _RUN.workdir.value
    written = render_path(run, workdir, frames, output, step=_RUN.step.value, predictor=predictor)
    print(*written, sep="\n")
    if _VIDEO.value == "auto" and written[-1].suffix == ".gif":
        print("the video is a GIF, as imageio finds no ffmpeg; pip install imageio-ffmpeg for MP4", file=sys.stderr)


def run():
    """Runs the program."""
    cli.run(main, stopped=_stopped)


def _stopped():
    return f"between two frames; the same command{' without --overwrite' * _OVERWRITE.value} continues from there"


if __name__ == "__main__":
    run()
