"""Trains and scores walks: PSNR and SSIM of their views that were not trained on, after some seconds.

    JAXNERF_SCENES=... taskset -c 0 python experiments/room/walks.py --data_dirs=walk,walk_points --seconds=120,300 \
        [--out=runs/walks] [--width=240] [--set=NAME=VALUE]... [--split=test] [--page=docs/results/captures.md]

Every run is configs/capture.py, on a core that nothing else uses. Finished runs are not trained again; an interrupted
one goes on. The split "held_out" is every 8th training view, then not trained on. --set changes all runs of a call;
runs of other calls with the same --out stay in the table.
"""

import ast
import pathlib
import sys

import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.runtime import cli

HEADS = ("dataset", "changed", "px", "seconds", "PSNR, dB", "SSIM", "steps", "passes", "seconds a frame")
_OUT = flags.DEFINE_string("out", "runs/walks", "Folder of the runs and the table.")
_DATA_DIRS = flags.DEFINE_list("data_dirs", ["walk"], "Folders, or names below $JAXNERF_SCENES.")
_SECONDS = flags.DEFINE_list("seconds", ["120"], "Lengths of training.")
_WIDTH = flags.DEFINE_integer("width", 240, "px, of the images.", lower_bound=8)
_SET = flags.DEFINE_multi_string("set", [], "Fields of the config, as train.lr_init=0.01.")
_SPLIT = flags.DEFINE_string("split", "test", "The views that are scored: held_out or test.")


def main(argv: list[str]) -> None:
    """Trains what is missing, then reports everything that is there."""
    del argv
    out, pairs = pathlib.Path(_OUT.value), [each.split("=", 1) for each in _SET.value]
    rows = common.read_json(out / "walks.json") if (out / "walks.json").exists() else {}
    for data_dir in _DATA_DIRS.value:
        for seconds in _SECONDS.value:
            overrides = {"data.dir": data_dir, "data.width": _WIDTH.value, "train.max_seconds": float(seconds)}
            overrides |= {"data.hold_out": 8 * (_SPLIT.value == "held_out"), "train.preview_every": 0.0}
            overrides |= {name: ast.literal_eval(value) for name, value in pairs}
            changed = ", ".join(_SET.value)
            name = "_".join([pathlib.Path(data_dir).name, str(_WIDTH.value), seconds, _SPLIT.value, *_SET.value])
            config = common.configuration("capture", overrides)
            results = common.run(config, out / name, split=_SPLIT.value)
            if results is None:
                return
            rows[name] = _row(
                pathlib.Path(data_dir).name, changed, seconds, common.load_split(config, "train"), results
            )
            common.write_json(out / "walks.json", rows)
    common.publish([*common.markdown(HEADS, list(rows.values())), "", *common.provenance()], "walks")


def _row(name, changed, seconds, views, results):
    width = round(float(np.asarray(views.size)[:, 1].mean()))
    passes = results["rays_seen"] / len(views.pixels)
    scores = [f"{results['psnr']:.2f}", f"{results['ssim']:.3f}", f"{results['step']:,}", f"{passes:.2f}"]
    return [name, changed, f"{width}", seconds, *scores, f"{results['seconds_per_frame']:.1f}"]


if __name__ == "__main__":
    cli.run(main)
