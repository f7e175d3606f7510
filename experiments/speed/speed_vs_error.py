"""Measures error against seconds of training, and where the time of a training step goes.

    JAXNERF_SCENES=... python experiments/speed/speed_vs_error.py --out=DIR \
        [--parts=training,parts] [--curves=dense,paper] [--page=FILE.md]

Writes DIR/<part>.json and prints the tables. What DIR holds already is kept: the same command resumes after an
interruption. With --page the tables replace what lies between <!-- speed --> and <!-- end of speed --> in that file.
"""

import pathlib
import sys

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from speed import published, step_parts, training

from jaxnerf.runtime import cli

PARTS = ("training", "parts")
_OUT = flags.DEFINE_string("out", None, "Folder of the measurements.", required=True)
_PARTS = flags.DEFINE_list("parts", list(PARTS), f"Parts to measure, of {PARTS}; 'report' alone measures nothing.")
_CURVES = flags.DEFINE_list("curves", None, "Names of training curves; all when not given.")
_SEEDS = flags.DEFINE_list("seeds", ["0"], "Seeds of each curve.")
_SECONDS = flags.DEFINE_list("seconds", [], "Seconds of training, in place of the curves' own.")


def main(argv: list[str]) -> None:
    """Measures the parts in turn, then reports everything that is there."""
    del argv
    out = pathlib.Path(_OUT.value)
    for part in common.chosen("--parts", _PARTS.value, (*PARTS, "report")):
        try:
            completed = _measure(part, out)
        except KeyboardInterrupt:
            completed = False
        if not completed:
            raise ValueError(f"stopped; measurements are in {out}, and the same command resumes")
    measured = {part: common.read_json(out / f"{part}.json") for part in PARTS}
    common.publish(report(measured), "speed")
    print("\n".join(["", *published_tables()]))


def _measure(part, out):
    """Measures a part; returns whether it was completed."""
    path = out / f"{part}.json"
    kept = common.read_json(path)

    def save(kept):
        common.write_json(path, kept)

    if part == "training":
        names = common.chosen("--curves", _CURVES.value or list(training.CURVES), list(training.CURVES))
        seeds, limits = common.seeds_of("--seeds", _SEEDS.value), [float(limit) for limit in _SECONDS.value]
        return training.measure(kept, save, out / "runs", names, seeds, limits)
    if part == "parts":
        step_parts.measure_all(kept, save)
    return True


def report(measured: dict[str, dict]) -> list[str]:
    """Returns the lines of all parts that were measured."""
    lines = []
    for part, table in (("training", _training), ("parts", step_parts.table)):
        if measured.get(part):
            lines += ([""] if lines else []) + table(measured[part])
    return lines


def _training(kept):
    """Returns the lines of the curves."""
    rows = []
    for name, curve in kept["curves"].items():
        if not any(curve["runs"].values()):
            continue
        for point in training.medians(curve["runs"]):
            spread = f" ({min(point['seeds']):.2f} to {max(point['seeds']):.2f})" if len(point["seeds"]) > 1 else ""
            rows.append(
                (
                    name,
                    f"{point['seconds']:.0f}",
                    f"{point['comparable']:.0f}",
                    f"{point['psnr']:.2f}{spread}",
                    f"{point['ssim']:.4f}",
                    f"{point['rays']:,.0f}",
                    f"{point['compile_seconds']:.0f}",
                    "-" if point.get("setup_seconds") is None else f"{point['setup_seconds']:.0f}",
                    f"{point['seconds_per_frame']:.2f}",
                )
            )
    heads = ("curve", "s", "comparable s", "PSNR", "SSIM", "rays", "compiling s", "set-up s", "s a frame")
    return [
        f"Training, scored on the test views; medians of the seeds. {kept['machine']}. Comparable seconds: seconds "
        f"times the GFLOP/s of a matrix product just before and after the run, over {common.REFERENCE_GFLOPS:.0f}.",
        "",
        *common.markdown(heads, rows),
    ]


def published_tables() -> list[str]:
    """Returns the lines of what others report."""
    heads = ("system", "on", "PSNR", "s", "hardware", "kind", "source")
    return [
        *_others(heads, published.TRAINING, psnr="{:.2f}", seconds="{:,.0f}"),
        "",
        *_others(("system", "frame", "s", "hardware", "kind", "source"), published.RENDERING, seconds="{:.3g}"),
    ]


def _others(heads, entries, **formats):
    """Returns the lines of published entries; formats are those of their numbers."""
    keys = ("name", "what", *formats, "hardware", "kind", "source")
    rows = [[formats.get(key, "{}").format(entry[key]) for key in keys] for entry in entries]
    return [
        "Published by others, on their hardware, or measured by hand, as the kind says:",
        "",
        *common.markdown(heads, rows),
    ]


if __name__ == "__main__":
    cli.run(main)
