"""Writes the gallery: of each run a test image, its rendering, the depth, and a short video along a camera path.

    python experiments/results/gallery.py WORKDIR ... --out=docs/gallery [--frames=24] [--width=240]

Each run was scored by `jaxnerf-eval` and rendered by `jaxnerf-render`; the newest of either is shown. The view is the
one in the middle of the scored views. Replaces OUT/RUN.jpg and OUT/RUN.webp and writes
the page OUT/index.md. In a page that exists, the part between the marks <!-- runs --> and <!-- end of runs --> is
replaced.
"""

import pathlib
import sys

import imageio.v3 as iio
import numpy as np
from absl import flags
from PIL import Image

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from results import table

from jaxnerf.data.images.image_files import read_stored
from jaxnerf.evaluation import output_images
from jaxnerf.runtime import cli
from jaxnerf.runtime.atomic_files import partial_file, read_json, write_text
from jaxnerf.training.workdir import load_config

_OUT = flags.DEFINE_string("out", None, "Folder of the page.", required=True)
_FRAMES = flags.DEFINE_integer("frames", 24, "Largest number of frames in a video.", lower_bound=2)
_WIDTH = flags.DEFINE_integer("width", 240, "Largest width of a video, px.", lower_bound=16)
_DURATION = 5.0  # s of a video
_QUALITY = {"webp": 70, "jpg": 90}


def main(argv: list[str]) -> None:
    """Writes the page of the workdirs named on the command line."""
    folders, out = [pathlib.Path(folder) for folder in argv[1:]], pathlib.Path(_OUT.value)
    if not folders:
        raise ValueError("no workdir is given; name those of runs that were scored and rendered")
    out.mkdir(parents=True, exist_ok=True)
    shown, page = [line for folder in folders for line in show(folder, out)], out / "index.md"
    if not page.exists():
        lines = ["# Gallery", "", *common.provenance(), ""]
        lines += ["Left to right: a view that was not trained on, its rendering, and the depth, where near is bright."]
        lines += ["Below: frames along a path of `jaxnerf-render`.", "", "<!-- runs -->", "<!-- end of runs -->", ""]
        write_text(page, "\n".join(lines))
    common.replace(page, shown, "runs")
    print(f"wrote {page}: {len(folders)} runs")


def show(folder: pathlib.Path, out: pathlib.Path) -> list[str]:
    """Writes the images of a run into a folder; returns the lines of the page.

    Raises:
        ValueError: if the run has not been scored or rendered.
    """
    scored, paths = table.scored(folder), list(folder.glob("renders/*/color"))
    if not scored or not paths:
        raise ValueError(f"{folder}: lacks scores or frames; run jaxnerf-eval and jaxnerf-render --workdir={folder}")
    path, renders = scored[-1], max(paths, key=lambda path: path.stat().st_mtime)
    results, name = read_json(path, "score it again"), folder.name
    shown = strip(path.parent)
    _write(out / f"{name}.jpg", shown)
    frames = sorted(renders.glob("*.png"))
    chosen = frames[:: -(-len(frames) // _FRAMES.value)]
    _write(
        out / f"{name}.webp",
        [_at_most(read_stored(frame), _WIDTH.value) for frame in chosen],
        duration=1000 * _DURATION / len(chosen),
        loop=0,
    )
    config = load_config(folder)
    return [
        f"## {name}",
        "",
        f"Format `{config.data.format}`, {shown.shape[1] // 3} x {shown.shape[0]} px, "
        f"{results['training_seconds']:.0f} s of training, PSNR {results['psnr']:.2f} dB and "
        f"SSIM {results['ssim']:.3f} on {results['views']} views, {results['seconds_per_frame']:.2f} s a frame.",
        "",
        f"[![{name}: image, rendering, depth]({name}.jpg)]({name}.jpg)",
        "",
        f"![{name}: {renders.parent.name}]({name}.webp)",
        "",
    ]


def strip(folder: pathlib.Path) -> np.ndarray:
    """Returns uint8: image, rendering and depth of a scored view side by side."""
    names = sorted(path.stem for path in (folder / "color").glob("*.png"))
    if not names:
        raise ValueError(f"{folder / 'color'}: has no images; score the run again with --overwrite")
    name = names[len(names) // 2]
    depth = read_stored(folder / "depth" / f"{name}.tiff")
    depth = output_images.depth_image(depth, *output_images.depth_range([depth]))
    image, rendering = (read_stored(folder / kind / f"{name}.png") for kind in ("gt-color", "color"))
    return np.concatenate([image, rendering, np.repeat(depth[..., None], 3, axis=-1)], axis=1)


def _at_most(pixels, width):
    height, own = pixels.shape[:2]
    if own <= width:
        return pixels
    return np.asarray(Image.fromarray(pixels).resize((width, round(height * width / own)), Image.Resampling.BOX))


def _write(path, pixels, **options):
    """Writes an image or, of several frames, an animation, whole or not at all."""
    kind = path.suffix[1:]
    with partial_file(path) as partial:
        iio.imwrite(partial, pixels, extension=f".{kind}", plugin="pillow", quality=_QUALITY[kind], **options)


if __name__ == "__main__":
    cli.run(main, positional=True)
