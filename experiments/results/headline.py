"""Prints the table of the README: quality against seconds on one CPU core, beside peers.

    python experiments/results/headline.py runs/speed/training.json [--page=README.md]

The curves are those of `experiments/speed/speed_vs_error.py`, the peers those of `experiments/speed/published.py`. With
--page the table in that file between the lines <!-- headline --> and <!-- end of headline --> is replaced.
"""

import pathlib
import sys

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from speed import published, training

from jaxnerf.runtime import cli

WORK = {
    "grid": "lego, 100 px",
    "grid without alpha": "lego, 100 px, alpha not used",
    "grid 400": "lego, 400 px",
    "grid 800": "lego, 800 px, its full size",
    "capture fox": "fox, phone images, 216 px wide",
    "capture fern": "fern, forward-facing, 201 px wide",
    "capture can": "can, phone images, 180 px wide",
}
# Names in published.TRAINING, of figures for all 200 test views on other hardware.
PUBLISHED = {"grid 800": ("NeRF paper", "JaxNeRF, 1M steps", "NGP paper")}
NOTES = (
    "Seconds of training exclude set-up and compilation. Those of others are CPU seconds of the whole process, or were "
    "published and not measured here.",
    "Lego is scored on 25 of its 200 test views, in published figures on all. The poses that come with `can` "
    "contradict each other; with those",
    "of `jaxnerf-cameras` the PSNR is [more than 3 dB higher](docs/results/captures.md). "
    "[Speed against error](docs/results/speed.md) has commands, commit and machine.",
)


def main(argv: list[str]) -> None:
    """Prints the table of the measurements in the JSON file named on the command line."""
    if len(argv) != 2:
        raise ValueError("name one training.json of experiments/speed/speed_vs_error.py")
    common.publish(table(common.read_json(pathlib.Path(argv[1]))), "headline")


def table(measured: dict) -> list[str]:
    """Returns the lines of the table; curves that were not measured are skipped."""
    rows = []
    for name, work in WORK.items():
        runs = measured["curves"].get(name, {}).get("runs")
        peers = published.PEERS.get(name, {})
        if runs:
            points = training.medians(runs)
            ours = {point["seconds"]: point["psnr"] for point in points}
            cells = [f"{peer}: {_scores(scores)}" for peer, scores in peers.items()]
            found = [entry for entry in published.TRAINING if entry["name"] in PUBLISHED.get(name, ())]
            cells += [f"{entry['name']}: {entry['psnr']:.1f} dB ({_duration(entry)})" for entry in found]
            rows.append((work, _scores(ours), f"{points[-1]['seconds_per_frame']:.2f} s", "; ".join(cells) or "-"))
    heads = ("dataset, one CPU core", "PSNR (seconds of training)", "a frame", "others (CPU seconds)")
    return [*common.markdown(heads, rows), "", *NOTES]


def _duration(entry):
    """Returns how long a published training took, and on what."""
    seconds, hardware = entry["seconds"], entry["hardware"]
    for unit, size in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= size:
            return f"{seconds / size:g} {unit}" + (f" on {hardware}" if hardware != "not said" else "")
    return f"{seconds:g} s"


def _scores(scores):
    """Returns {seconds: PSNR} as text."""
    return ", ".join(f"{psnr:.1f} dB ({seconds:.0f} s)" for seconds, psnr in scores.items())


if __name__ == "__main__":
    cli.run(main, positional=True)
