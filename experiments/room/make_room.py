"""Writes a capture of the embedded room or house: images with lens, a hand-held path, far views, ground truth.

    python experiments/room/make_room.py --out=DIR [--place=house] [--nolens] [--exposure=0.25] [--white_balance=0.08]
        [--pose_noise=0.3] [--width=200] [--height=150] [--views=70] [--points=4000] [--image_format=png] [--seed=0]
        [--model=DIR]

Then `jaxnerf-train --config=capture --data_dir=DIR --workdir=W`, and score_room.py with the same folders. --model
writes the training views a second time, as a COLMAP model whose points have observations.
"""

import pathlib
import sys
import time

import jax
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
from jaxnerf.core.cameras import project
from jaxnerf.core.types import Camera
from jaxnerf.data.readers.base import Frame
from jaxnerf.runtime import cli
from jaxnerf.tools.exporters.cameras import write_model
from test_scenes import synthetic_capture

_OUT = flags.DEFINE_string("out", None, "Folder of the capture, missing or empty.", required=True)
_PLACE = flags.DEFINE_enum("place", "room", list(synthetic_capture.PLACES), "The room, or a walk through the house.")
_LENS = flags.DEFINE_bool("lens", True, "Whether the lens distorts as a phone's.")
_EXPOSURE = flags.DEFINE_float("exposure", 0.0, "Standard deviation of the exposure, stops.", lower_bound=0.0)
_WHITE_BALANCE = flags.DEFINE_float(
    "white_balance", 0.0, "Standard deviation of red and of blue, stops.", lower_bound=0.0
)
_POSE_NOISE = flags.DEFINE_float("pose_noise", 0.0, "Standard deviation of rotations, degrees.", lower_bound=0.0)
_WIDTH = flags.DEFINE_integer("width", 200, "px", lower_bound=8)
_HEIGHT = flags.DEFINE_integer("height", 150, "px", lower_bound=8)
_VIEWS = flags.DEFINE_integer("views", 70, "Number of training views.", lower_bound=8)
_HELD_OUT = flags.DEFINE_integer("held_out", 10, "Number of held-out views near the path.", lower_bound=0)
_FAR = flags.DEFINE_integer("far", 12, "Number of far novel views.", lower_bound=0)
_POINTS = flags.DEFINE_integer("points", 4000, "Number of sparse points.", lower_bound=0)
_FORMAT = flags.DEFINE_enum("image_format", "png", ["png", "jpg"], "Format of the images.")
_MODEL = flags.DEFINE_string("model", None, "Folder of the COLMAP model, missing; none when not given.")
_SEED = flags.DEFINE_integer("seed", 0, "Of everything random.", lower_bound=0)
_PIXEL_NOISE = 0.2  # px, of the observations of points
_project = jax.jit(project)


def main(argv: list[str]) -> None:
    """Writes the capture."""
    del argv
    started = time.perf_counter()
    truth = synthetic_capture.write_capture(
        _OUT.value,
        num_views=_VIEWS.value,
        num_held_out=_HELD_OUT.value,
        num_far=_FAR.value,
        width=_WIDTH.value,
        height=_HEIGHT.value,
        distortion=synthetic_capture.PHONE_LENS if _LENS.value else None,
        exposure=_EXPOSURE.value,
        white_balance=_WHITE_BALANCE.value,
        pose_noise=_POSE_NOISE.value,
        num_points=_POINTS.value,
        image_format=_FORMAT.value,
        seed=_SEED.value,
        place=_PLACE.value,
    )
    found = f"{len(truth.names)} views, {len(truth.points)} points, {time.perf_counter() - started:.0f} s"
    print(f"wrote {_OUT.value}: {found}")
    if _MODEL.value:
        _write_model(pathlib.Path(_MODEL.value), truth, np.random.default_rng([_SEED.value, 5]))


def _write_model(folder, truth, rng):
    """Writes the training views as a COLMAP model, with links to the images and noisy observations of the points."""
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "images").symlink_to(pathlib.Path(_OUT.value, "images").resolve())
    height, width = truth.depth.shape[1:]
    names, frames = [f"{name}.{_FORMAT.value}" for name in truth.names[truth.split == "train"]], []
    lens = {"focal": truth.focal, "center": truth.center, "distortion": truth.distortion, "lens": "opencv"}
    for name, pose, seen in zip(names, truth.file_to_world, truth.points_seen, strict=False):
        camera, seen = Camera(to_world=pose, **lens, height=height, width=width), np.flatnonzero(seen)
        at = np.asarray(_project(camera, truth.points)[0])[seen] + _PIXEL_NOISE * rng.normal(size=(len(seen), 2))
        shown = ((at > 0) & (at < [width, height])).all(axis=1)
        image = folder / "images" / name
        frames.append(Frame(name, image, camera, seen=seen[shown], seen_at=at[shown]))
    write_model(folder / "sparse" / "0", [frame.camera for frame in frames], names, frames, truth.points)
    print(f"wrote {folder}: {sum(len(frame.seen) for frame in frames):,} observations")


if __name__ == "__main__":
    cli.run(main)
