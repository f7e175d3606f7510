"""The plot and the pictures of what ablation.py has run."""

import statistics
import sys

import imageio.v3 as iio
import numpy as np
from ablation_report import to_complete
from ablation_variants import COMPLETE, workdir_name
from PIL import Image, ImageDraw

from jaxnerf.evaluation import pictures

_SIDE, _LABEL, _COLUMNS = 150, 16, 6  # px of a picture, px above it, pictures in a row
_VIEW = "002"  # of the test views


def draw_pictures(kept, out, path):
    """Writes one test view of each scene as every variant's first seed renders it, the photograph first."""
    rows = []
    for scene, about in kept["scenes"].items():
        panels = []
        for name, runs in about["runs"].items():
            scored = _scored(out, scene, name, min(map(int, runs)))
            if not panels:
                panels.append(_panel(scored / "gt-color" / f"{_VIEW}.png", "photograph"))
            panels.append(_panel(scored / "color" / f"{_VIEW}.png", name))
        blank = np.full_like(panels[0], 255)
        panels += [blank] * (-len(panels) % _COLUMNS)
        rows += [np.concatenate(panels[i : i + _COLUMNS], 1) for i in range(0, len(panels), _COLUMNS)]
    pictures.write_whole(path, np.concatenate(rows))
    print(f"drew {path}")


def _scored(out, scene, name, seed):
    """Returns the folder of a run's newest score."""
    found = (out / workdir_name(scene, name, seed) / "eval").glob("*/results.json")
    return max((path.parent for path in found), key=lambda folder: int(folder.name))


def _panel(path, name):
    image = Image.new("RGB", (_SIDE, _SIDE + _LABEL), "white")
    image.paste(Image.fromarray(iio.imread(path)).resize((_SIDE, _SIDE)), (0, _LABEL))
    ImageDraw.Draw(image).text((3, 2), name, "black", font_size=10)
    return np.asarray(image)


def plot(kept, path):
    """Draws what each variant loses, a dot a seed, and PSNR against what a ray costs."""
    try:
        import matplotlib
    except ImportError:
        print("No plot, which needs matplotlib: pip install 'jaxnerf[experiments]'", file=sys.stderr)
        return
    matplotlib.use("Agg")
    from matplotlib import pyplot

    scenes = kept["scenes"]
    figure, axes = pyplot.subplots(len(scenes), 2, figsize=(12, 4.2 * len(scenes)), layout="constrained", squeeze=False)
    for (left, right), (scene, about) in zip(axes, scenes.items(), strict=True):
        names = [name for name in about["runs"] if name != COMPLETE][::-1]
        for height, name in enumerate(names):
            values = to_complete(name, about)
            if values:
                left.barh(height, statistics.fmean(values), color=f"C{height}", alpha=0.4)
                left.plot(values, [height] * len(values), "k.", markersize=4)
        left.set(yticks=range(len(names)), yticklabels=names, xlabel="PSNR less the complete model's, dB")
        left.axvline(0, color="k", linewidth=0.8)
        left.set_title(f"{scene}, {kept['steps']:,} steps; a dot a seed", fontsize=10)
        for name, cost in kept.get("cost", {}).items():
            scores = [run["psnr"] for run in about["runs"].get(name, {}).values()]
            if scores:
                color = f"C{names.index(name)}" if name in names else "k"
                where = cost["flops"] / 1e3, statistics.fmean(scores)
                right.errorbar(*where, yerr=[[where[1] - min(scores)], [max(scores) - where[1]]], color=color)
                right.plot(*where, "o", color=color)
                if name == COMPLETE:
                    right.annotate(name, where, fontsize=8, xytext=(6, 3), textcoords="offset points")
        right.margins(x=0.2)
        right.set_title("colours as on the left", fontsize=10)
        right.set(xlabel="kFLOP a ray of training", ylabel="PSNR on test views, dB")
        for axis in (left, right):
            axis.grid(alpha=0.3)
    figure.canvas.draw()
    pictures.write_whole(path, np.asarray(figure.canvas.buffer_rgba())[..., :3])
    pyplot.close(figure)
    print(f"drew {path}")
