"""python -m jaxnerf.render --workdir=DIR: renders a turn around a trained scene."""

from absl import flags

from jaxnerf import app

_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of the run.", required=True)
_DATA_DIR = flags.DEFINE_string("data_dir", None, "The scene's folder, in place of config.data.dir.")
_STEP = flags.DEFINE_integer("step", None, "Of the checkpoint; the newest when not given.")
_CHUNK = flags.DEFINE_integer("chunk", None, "Rays at once; config.eval.chunk when not given.", lower_bound=1)
_FRAMES = flags.DEFINE_integer("frames", 48, "Of the turn.", lower_bound=1)
_FPS = flags.DEFINE_float("fps", 24.0, "Frames a second.", lower_bound=0.1)
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Replace an earlier video.")


def main(argv):
    del argv
    from jaxnerf.engine.turntable import render_turntable

    path = render_turntable(
        _WORKDIR.value,
        step=_STEP.value,
        data_dir=_DATA_DIR.value,
        num_frames=_FRAMES.value,
        frames_per_second=_FPS.value,
        chunk=_CHUNK.value,
        overwrite=_OVERWRITE.value,
    )
    print(path)


if __name__ == "__main__":
    app.run(main)
