"""python -m jaxnerf.render --workdir=DIR: pictures and a video of a trained scene along a camera path."""

import sys

from absl import flags

from jaxnerf.runtime import cli

_SIDE = {"lower_bound": 1, "upper_bound": 16384}
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of the run.", required=True)
_DATA_DIR = flags.DEFINE_string("data_dir", None, "The scene's folder, in place of config.data.dir.")
_STEP = flags.DEFINE_integer("step", None, "Of the checkpoint; the newest when not given.")
_CHUNK = cli.define_count("chunk", "Rays at once, or auto: what fits; config.eval.chunk when not given.")
_BAKE_OCCUPANCY = flags.DEFINE_bool("bake_occupancy", None, "Leave out what is not seen of a dense model.")
_PATH = flags.DEFINE_string(
    "path", None, "turntable, spiral, ellipse, interpolate or FILE.json; chosen by the views when not given."
)
_FRAMES = flags.DEFINE_integer("frames", None, "Of the path; 48 a turn, else 120 or 6 a view.", lower_bound=1)
_CLOSED = flags.DEFINE_bool("closed", False, "Let --path=interpolate come back to the first view.")
_WIDTH = flags.DEFINE_integer("width", None, "px; the first view's when not given.", **_SIDE)
_HEIGHT = flags.DEFINE_integer("height", None, "px; as --width asks when not given.", **_SIDE)
_FPS = flags.DEFINE_float("fps", None, "Frames a second; the file's, or 24.", lower_bound=0.1)
_VIDEO = flags.DEFINE_string("video", "auto", "mp4, gif, none, or auto: mp4 where there is ffmpeg.")
_DEPTH = flags.DEFINE_bool("depth", False, "Make a video of the depth, too.")
_RGBA = flags.DEFINE_bool("rgba", False, "Write rgba/0000.png, too: straight alpha, no background.")
_NAME = flags.DEFINE_string("name", None, "Of the folder and video, in place of the path's.")
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Delete the frames of an earlier call first.")
_SHARD = flags.DEFINE_string(
    "shard",
    None,
    "K/N: only each N-th frame, from K on, where K counts from 0; auto: as srun or mpirun has started. Any "
    "number of calls may run at once; the one that finishes last makes the video.",
)


def main(argv):
    del argv
    from jaxnerf.evaluation.paths.render_path import render_path
    from jaxnerf.runtime import shards

    written = render_path(
        _WORKDIR.value,
        path=_PATH.value,
        step=_STEP.value,
        data_dir=_DATA_DIR.value,
        settings={} if _BAKE_OCCUPANCY.value is None else {"bake_occupancy": _BAKE_OCCUPANCY.value},
        size=(_WIDTH.value, _HEIGHT.value),
        num_frames=_FRAMES.value,
        closed=_CLOSED.value,
        fps=_FPS.value,
        chunk=_CHUNK.value,
        name=_NAME.value,
        rgba=_RGBA.value,
        depth=_DEPTH.value,
        kind=_VIDEO.value,
        overwrite=_OVERWRITE.value,
        shard=shards.parse(_SHARD.value),
    )
    print(*written, sep="\n")
    if _VIDEO.value == "auto" and written[-1].suffix == ".gif":
        print("a GIF, as there is no ffmpeg: pip install 'jaxnerf[video]' for MP4", file=sys.stderr)


if __name__ == "__main__":
    cli.run(main, stopped="between two frames; the same command goes on from there")
