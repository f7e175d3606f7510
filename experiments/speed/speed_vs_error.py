"""Measures error against seconds, of training and of rendering, and where the time of a training step goes.

    JAXNERF_SCENES=... python experiments/speed/speed_vs_error.py --out=DIR \
        [--parts=training,rendering,limits,cost,parts] [--curves=grid,dense] \
        [--workdir=DIR of a trained run, or none] [--page=FILE.md]

Writes DIR/<part>.json, DIR/published.json (what others report, with its source) and DIR/speed_vs_error.png, and
prints the tables. What DIR holds already is kept: the same command resumes after an interruption. The parts
rendering and limits take the run of --workdir, or the longest of the curve "grid"; with "none" they do without.
With --page the tables replace what lies between <!-- speed --> and <!-- end of speed --> in that file.
"""

import math
import pathlib
import statistics
import sys

import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from speed import published, rendering, step, step_parts, training

from jaxnerf.runtime import cli

_CURVE = "grid"  # whose run the other parts take
PARTS = ("training", "rendering", "limits", "cost", "parts")
BARS = (29.0, 30.0, 31.0, 32.0, 32.5, 33.5)
_OUT = flags.DEFINE_string("out", None, "Folder of the measurements.", required=True)
_PARTS = flags.DEFINE_list("parts", list(PARTS), f"Parts to measure, of {PARTS}; 'report' alone measures nothing.")
_CURVES = flags.DEFINE_list("curves", None, "Names of training curves; all when not given.")
_SEEDS = flags.DEFINE_list(
    "seeds", ["0", "1", "2"], f"Seeds of the curves {training.SEEDED}; the others take the first."
)
_SECONDS = flags.DEFINE_list("seconds", [], "Seconds of training, in place of the curves' own.")
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of a trained run, or 'none'.")
_VIEWS = flags.DEFINE_integer("views", 3, "Number of test views to render with each setting.", lower_bound=1)


def main(argv: list[str]) -> None:
    """Measures the parts in turn, then reports everything that is there."""
    del argv
    out = pathlib.Path(_OUT.value)
    common.write_json(out / "published.json", {"training": published.TRAINING, "rendering": published.RENDERING})
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
    plot(measured, out / "speed_vs_error.png")


def _measure(part, out):
    """Measures a part; returns whether it was completed."""
    path = out / f"{part}.json"
    kept, config = common.read_json(path), training.configuration(_CURVE)

    def save(kept):
        common.write_json(path, kept)

    seeds = common.seeds_of("--seeds", _SEEDS.value)
    longest = training.workdir_name(_CURVE, seeds[0], max(training.CURVES[_CURVE]["seconds"]))
    default = out / "runs" / longest
    folder = None if _WORKDIR.value == "none" else _WORKDIR.value or str(default)
    if part == "training":
        names = common.chosen("--curves", _CURVES.value or list(training.CURVES), list(training.CURVES))
        return training.measure(
            kept, save, out / "runs", names, seeds, [float(time_limit) for time_limit in _SECONDS.value]
        )
    if part == "cost":
        step.measure_cost(kept, save, config)
    if part == "parts":
        step_parts.measure_all(kept, save)
    if part == "rendering":
        if folder is None:
            print("rendering is skipped: it needs a trained run, see --workdir")
        else:
            rendering.measure(kept, save, folder, _VIEWS.value)
    if part == "limits" and (not kept or kept["workdir"] != folder):
        save({"workdir": folder, **step.measure_limits(config, folder)})
    return True


def report(measured: dict[str, dict]) -> list[str]:
    """Returns the lines of all parts that were measured."""
    tables = {
        "training": _training,
        "rendering": _rendering,
        "limits": _limits,
        "cost": _cost,
        "parts": step_parts.table,
    }
    lines = []
    for part, table in tables.items():
        if measured.get(part):
            lines += ([""] if lines else []) + table(measured[part])
    return lines


def _training(kept):
    """Returns the lines of the curves, and of the times to fixed scores."""
    rows, reached = [], []
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
        reached.append((name, *(_reached(curve["runs"], bar) for bar in BARS)))
    heads = ("curve", "s", "comparable s", "PSNR", "SSIM", "rays", "compiling s", "set-up s", "s a frame")
    return [
        f"Training, scored on the test views; medians of the seeds. {kept['machine']}. Comparable seconds: seconds "
        f"times the GFLOP/s of a matrix product just before and after the run, over {common.REFERENCE_GFLOPS:.0f}.",
        "",
        *common.markdown(heads, rows),
        "",
        "Shortest training, in seconds (comparable seconds), whose PSNR reached the bar; only the times above were "
        "tried:",
        "",
        *common.markdown(("curve", *(f"{bar:g} dB" for bar in BARS)), reached),
    ]


def published_tables() -> list[str]:
    """Returns the lines of what others report, and of what was known before the start."""
    heads = ("system", "on", "PSNR", "s", "hardware", "kind", "source")
    peers = [
        (curve, peer, ", ".join(f"{psnr} dB ({seconds} s)" for seconds, psnr in scores.items()))
        for curve, measured in published.PEERS.items()
        for peer, scores in measured.items()
    ]
    return [
        *_others(heads, published.TRAINING, psnr="{:.2f}", seconds="{:,.0f}"),
        "",
        "Other programs, in CPU seconds of the whole process, start-up included. They were run once each, by hand, on "
        "one core of a machine with AVX2. TensoRF (PyTorch) does not use alpha. OpenSplat (its build for CPUs) starts "
        "from 10,000 points on the visual hull of lego, and from COLMAP's points of `can`.",
        "",
        *common.markdown(("as the curve", "program", "PSNR of the same test views"), peers),
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


def _reached(runs, bar):
    times = [
        statistics.median_high(first_reached(points, bar, key) for points in runs.values())
        for key in ("seconds", "comparable")
    ]
    return "-" if math.isinf(times[0]) else "{:.0f} ({:.0f})".format(*times)


def _rendering(kept):
    """Returns the lines of the run's own settings, in bold, and of those that nothing beats."""
    own = kept["rows"][0]
    baked = own["settings"]["bake_occupancy"]
    front = [cost for cost, _ in pareto_front([(row["seconds"], -row["rms"]) for row in kept["rows"]])]
    cells = []
    for row in sorted(kept["rows"], key=lambda row: row["seconds"]):
        if row is not own and row["seconds"] not in front:
            continue
        names = [f"{name} {value}" for name, value in row["settings"].items() if name != "bake_occupancy"]
        names += [] if row["settings"]["bake_occupancy"] == baked else ["bake_occupancy"]
        text = ", ".join(names)
        large = "-" if row["seconds_800"] is None else f"{row['seconds_800']:.2f}"
        cells.append(
            (
                f"**{text}**" if row is own else text,
                f"{row['seconds']:.3f}",
                large,
                f"{row['psnr']:.3f}",
                f"{row['rms']:.5f}",
                f"{row['largest']:.4f}",
            )
        )
    heads = ("settings", "s a frame", "s at 800x800", "PSNR", "RMS error", "largest error")
    return [
        f"Rendering {kept['frames']} test views of {kept['workdir']} (step {kept['step']}); errors against "
        "its own rendering with sample_multiplier 4 and early_stop_eps 0. Of "
        f"{len(kept['rows'])} settings the run's own, bold, and those that none beats in both time and RMS error. "
        f"{kept['machine']}, matrix product "
        f"{statistics.mean(kept['gflops']):.0f} GFLOP/s.",
        *(f"{note}." for note in kept["notes"]),
        "",
        *common.markdown(heads, cells),
        "",
        *_others(("system", "frame", "s", "hardware", "kind", "source"), published.RENDERING, seconds="{:.3g}"),
    ]


def _limits(kept):
    """Returns the lines of the arithmetic that is needed, and of what the machine reaches."""
    cells = [
        (
            row["what"],
            f"{1e3 * row['seconds']:.1f}",
            f"{row['samples']:,}",
            ", ".join(f"{name} {count:,}" for name, count in row["sample_flops"].items()),
            f"{row['field_flops'] / 1e9:.3f}",
            f"{row['compiled_flops'] / 1e9:.3f}",
            f"{row['gflops']:.1f}",
            f"{row['fraction']:.1%}",
        )
        for row in kept["rows"]
    ]
    heads = ("work", "ms", "samples evaluated", "FLOP a sample", "field GFLOP", "compiled GFLOP")
    heads += ("field GFLOP/s", "of the matrix product")
    return [
        f"Limits: the product of two 1024 x 1024 float32 matrices runs at {kept['gflops']:.0f} GFLOP/s. "
        f"{kept['machine']}.",
        "",
        *common.markdown(heads, cells),
    ]


def _cost(kept):
    """Returns the lines of cost against work; a slope of 1 is linear."""
    cells = []
    for what in dict.fromkeys(row["what"] for row in kept["rows"]):
        rows = [row for row in kept["rows"] if row["what"] == what]
        for row in rows:
            cells.append((what, f"{row['value']:,}", f"{1e3 * row['seconds']:.1f}", f"{row['bytes'] / 1e6:.1f}"))
        if len(rows) > 1:
            values = [row["value"] for row in rows]
            slopes = [slope(values, [row[key] for row in rows]) for key in ("seconds", "bytes")]
            cells.append((what, "**slope**", *(f"**{value:.2f}**" for value in slopes)))
    return [
        f"Cost of a training step of lego_fast, one thing varied at a time; slope in log-log: 1 is linear, 0 "
        f"is free. {kept['machine']}.",
        "",
        *common.markdown(("varied", "value", "ms a step", "MB held"), cells),
    ]


def pareto_front(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Returns the points (cost, value) that no other point beats in both, cheapest first."""
    front = []
    for cost, value in sorted(points, key=lambda point: (point[0], -point[1])):
        if not front or value > front[-1][1]:
            front.append((cost, value))
    return front


def first_reached(points: list[dict], bar: float, key: str = "seconds") -> float:
    """Returns the time of the first of a run's points that scores at least `bar` dB, or infinity."""
    return min((point[key] for point in points if point["psnr"] >= bar), default=math.inf)


def slope(values: list[float], costs: list[float]) -> float:
    """Returns the exponent p of costs ~ values^p: 1 is linear."""
    return float(np.polyfit(np.log(values), np.log(costs), 1)[0])


def plot(measured: dict[str, dict], path: pathlib.Path) -> None:
    """Plots PSNR against seconds of training, and of rendering, for the parts that were measured."""
    pyplot = common.pyplot()
    if pyplot is None:
        return
    figure, axes = pyplot.subplots(1, 3, figsize=(19, 8), layout="constrained", width_ratios=(2.2, 1, 1))
    _plot_training(axes[0], measured.get("training") or {"curves": {}, "machine": "no curve measured"})
    for axis, key in zip(axes[1:], ("psnr", "largest"), strict=True):
        rows = measured.get("rendering", {}).get("rows", [])
        _plot_rendering(axis, rows, key) if rows else axis.set_visible(False)
    common.save_figure(figure, path)


def _plot_training(axis, kept):
    small = []
    for name, curve in kept["curves"].items():
        points = training.medians(curve["runs"]) if all(curve["runs"].values()) and curve["runs"] else []
        line = [(point["seconds"], point["psnr"]) for point in points]
        if not line:
            continue
        other = name.split()[-1].isdigit() or curve["config"] == "capture"  # of another size or scene
        axis.plot(*zip(*line, strict=True), ":" if other else "-", marker="o", markersize=4, label=name)
        small += [] if other else line
    if small:
        front = pareto_front(small)
        axis.plot(*zip(*front, strict=True), color="0.8", linewidth=7, zorder=0, label="Pareto front, 100x100")
    shapes = iter("*pPXDhds<>^v8H" * 3)
    for entry in published.TRAINING:
        is_published = entry["kind"] == "published"
        text = f"{entry['kind']}: {entry['name']}, {entry['what']}, hardware: {entry['hardware']}"
        style = {"s": 80, "facecolors": "none", "edgecolors": "k"} if is_published else {"s": 25, "color": "0.5"}
        marker = next(shapes) if is_published else "x"
        axis.scatter(entry["seconds"], entry["psnr"], marker=marker, label=text if is_published else None, **style)
    before = [entry for entry in published.TRAINING if entry["kind"] != "published"]
    label = f"{before[0]['kind']}: nerf-pytorch, JaxNeRF, {before[0]['what']}, {before[0]['hardware']}"
    axis.scatter([], [], marker="x", color="0.5", label=label)
    axis.set(xscale="log", xlabel=f"seconds of training ({kept['machine']})", ylabel="PSNR, dB", ylim=(9, 38))
    axis.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=2)
    axis.grid(alpha=0.3)


def _plot_rendering(axis, rows, key):
    groups = {}
    for row in rows:
        name = f"sample_multiplier {row['settings']['sample_multiplier']}"
        groups.setdefault(name, []).append((row["seconds"], row[key]))
    for name, points in groups.items():
        axis.plot(*zip(*sorted(points), strict=True), "o", markersize=4, label=name)
    sign = 1 if key == "psnr" else -1
    front = pareto_front([(row["seconds"], sign * row[key]) for row in rows])
    seconds, values = zip(*front, strict=True)
    axis.plot(seconds, [sign * value for value in values], color="0.6", zorder=0, label="Pareto front")
    axis.legend(fontsize=7)
    axis.set(xscale="log", xlabel="seconds a frame", yscale="linear" if key == "psnr" else "log")
    axis.set_ylabel("PSNR, dB" if key == "psnr" else "largest error of a colour, to the exact rendering")
    axis.grid(alpha=0.3)


if __name__ == "__main__":
    cli.run(main)
