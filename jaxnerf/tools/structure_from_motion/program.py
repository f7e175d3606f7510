"""Estimates the cameras of a folder of images: jaxnerf-cameras --images=DIR --out=DIR.

It needs pycolmap: pip install 'jaxnerf[cameras]'. It writes a dataset for jaxnerf-check and jaxnerf-train: OUT/images
with copies of the images, OUT/sparse/0 with cameras and points, and OUT/cameras with what an interrupted call continues
from. Images in OUT/images are used where they are.
"""

from absl import flags

from jaxnerf.runtime import cli

_IMAGES = flags.DEFINE_string(
    "images", None, "The folder of the images of one static scene: JPEG, PNG, TIFF or BMP.", required=True
)
_OUT = flags.DEFINE_string("out", None, "The dataset's folder, which the program creates.", required=True)
_CAMERA_MODEL = flags.DEFINE_string(
    "camera_model",
    "OPENCV",
    "COLMAP's camera model: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, SIMPLE_RADIAL_FISHEYE, "
    "RADIAL_FISHEYE or OPENCV_FISHEYE.",
)
_SINGLE_CAMERA = flags.DEFINE_bool(
    "single_camera", True, "Whether all images of one size were taken with one camera, lens and zoom."
)
_MATCHING = flags.DEFINE_string(
    "matching",
    "auto",
    "exhaustive matches all pairs of images; sequential those that are close in the order of the names, as in a "
    "video; auto is exhaustive for up to 200 images.",
)
_MAX_SIZE = flags.DEFINE_integer(
    "max_size", 1600, "The longer side in px at which features are extracted.", lower_bound=64, upper_bound=65_536
)
_CAMERAS_OF = flags.DEFINE_string(
    "cameras_of",
    "",
    "The folder of a dataset in any format with the same images, whose cameras are kept: only points are found.",
)
_NUM_THREADS = flags.DEFINE_integer(
    "num_threads",
    None,
    "The number of threads. When it is not given, one for each core.",
    lower_bound=1,
    upper_bound=4096,
)
_OVERWRITE = flags.DEFINE_bool(
    "overwrite", False, "Whether to replace the cameras, copies and features that OUT holds from other calls."
)


def main(argv):
    del argv
    # Imported after the flags are parsed, so that a wrong flag is reported at once.
    from jaxnerf.runtime.printed_text import printable
    from jaxnerf.tools.structure_from_motion.estimate import Settings, estimate_cameras

    report = estimate_cameras(
        _IMAGES.value,
        _OUT.value,
        Settings(_CAMERA_MODEL.value, _SINGLE_CAMERA.value, _MATCHING.value, _MAX_SIZE.value, _CAMERAS_OF.value),
        num_threads=_NUM_THREADS.value,
        overwrite=_OVERWRITE.value,
        say=lambda line: print(printable(line), flush=True),
    )
    print(report.text())


def run():
    """Runs the program."""
    cli.run(main, stopped="between two stages or within one; the same command continues")


if __name__ == "__main__":
    run()
