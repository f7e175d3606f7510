"""The tables of what speed_vs_error.py has measured."""

import math
import statistics

import speed_published
import table
from speed_figures import first_reached, medians, pareto_front, slope

BARS = (29.0, 30.0, 31.0, 32.0, 32.5, 33.5)


def report(measured):
    """Returns the lines of all parts that were measured, by name."""
    lines = []
    for part, tables in PARTS.items():
        if measured.get(part):
            lines += ([""] if lines else []) + tables(measured[part])
    return lines


def training(kept):
    """Returns the lines of curves, and of the times to fixed scores."""
    rows, reached = [], []
    for name, curve in kept["curves"].items():
        if not any(curve["runs"].values()):
            continue
        for point in medians(curve["runs"]):
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
        f"Training, scored on the test views; medians of the seeds. {kept['machine']}. Comparable seconds: "
        "times the GFLOP/s of a matrix product just before and after, over 93.",
        "",
        *table.markdown(heads, rows),
        "",
        "Seconds (comparable seconds) of training at the first score that reached:",
        "",
        *table.markdown(("curve", *(f"{bar:g} dB" for bar in BARS)), reached),
    ]


def published():
    """Returns the lines of what others have published, and of what was known before the start."""
    others = [
        (entry["name"], entry["what"], f"{entry['psnr']:.2f}", f"{entry['seconds']:,.0f}", entry["hardware"])
        + (entry["kind"], entry["source"])
        for entry in speed_published.TRAINING
    ]
    return [
        "Published by others, on their hardware; not measured here:",
        "",
        *table.markdown(("system", "on", "PSNR", "s", "hardware", "kind", "source"), others),
    ]


def _reached(runs, bar):
    times = [
        statistics.median_high(first_reached(points, bar, key) for points in runs.values())
        for key in ("seconds", "comparable")
    ]
    return "-" if math.isinf(times[0]) else "{:.0f} ({:.0f})".format(*times)


def rendering(kept):
    """Returns the lines of the run's own settings, in bold, and of those that nothing beats."""
    own, skipping = kept["rows"][0], kept["rows"][0]["settings"]["bake_occupancy"]
    front = [cost for cost, _ in pareto_front([(row["seconds"], -row["rms"]) for row in kept["rows"]])]
    cells = []
    for row in sorted(kept["rows"], key=lambda row: row["seconds"]):
        if row is not own and row["seconds"] not in front:
            continue
        names = [f"{name} {value}" for name, value in row["settings"].items() if name != "bake_occupancy"]
        names += [] if row["settings"]["bake_occupancy"] == skipping else ["skipping afterwards"]
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
    others = [
        (
            entry["name"],
            entry["what"],
            f"{entry['seconds']:.3g}",
            entry["hardware"],
            entry["kind"],
            entry["source"],
        )
        for entry in speed_published.RENDERING
    ]
    return [
        f"Rendering {kept['frames']} test views of {kept['workdir']} (step {kept['step']}); errors against "
        f"its own rendering with samples 4 and stop 0. Of {len(kept['rows'])} settings the run's own, bold, "
        f"and those that none beats in both time and RMS error. {kept['machine']}, matrix product "
        f"{statistics.mean(kept['gflops']):.0f} GFLOP/s.",
        *(f"{note}." for note in kept["notes"]),
        "",
        *table.markdown(heads, cells),
        "",
        "Published by others, on their hardware; not measured here:",
        "",
        *table.markdown(("system", "frame", "s", "hardware", "kind", "source"), others),
    ]


def limits(kept):
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
            f"{row['share']:.1%}",
        )
        for row in kept["rows"]
    ]
    heads = ("work", "ms", "samples asked", "FLOP a sample", "field GFLOP", "compiled GFLOP")
    heads += ("field GFLOP/s", "of the matrix product")
    return [
        f"Limits: the product of two 1024 x 1024 float32 matrices runs at {kept['gflops']:.0f} GFLOP/s. "
        f"{kept['machine']}.",
        "",
        *table.markdown(heads, cells),
    ]


def cost(kept):
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
        *table.markdown(("varied", "value", "ms a step", "MB held"), cells),
    ]


PARTS = {"training": training, "rendering": rendering, "limits": limits, "cost": cost}
