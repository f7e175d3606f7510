"""The tables and plots of what quadrature.py and trained_quadrature.py have measured.

    python experiments/quadrature_report.py [--out=runs/quadrature] [--readme=README.md] \
        [--plot=docs/quadrature.png]

Reads every *.json in --out, prints its tables, and draws error against evaluations and against time; of the
closed forms the first in float64 and the second in float32, as the times are. With --readme the tables
replace what lies between <!-- quadrature --> and <!-- /quadrature --> in that file.
"""

import json
import math
import os
import pathlib

import jax
import table
from absl import flags

from jaxnerf.runtime import cli

flags.DEFINE_string("out", "runs/quadrature", "Folder of the measured figures.")
_PLOT = flags.DEFINE_string("plot", None, "PNG to draw; out/quadrature.png when not given.")
FLAGS = flags.FLAGS

MARKS = ("<!-- quadrature -->", "<!-- /quadrature -->")
RULES = ("points", "segments", "gauss")
BOUNDS = (1e-3, 1e-5)  # of the closed forms
TRAINED_BOUNDS = (1e-2, 3e-3, 1e-3, 1e-4)


def main(argv):
    del argv
    report()


def machine():
    """Returns what times depend on."""
    cores = len(os.sched_getaffinity(0))
    return f"{jax.devices()[0].device_kind}, {cores} cores, XLA_FLAGS={os.environ.get('XLA_FLAGS', '')!r}"


def save(name, measured):
    path = pathlib.Path(FLAGS.out) / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(measured, indent=1) + "\n")


def report():
    """Prints the tables of all that is measured, draws it, and writes it into the README if asked."""
    out = pathlib.Path(FLAGS.out)
    measured = {path.stem: json.loads(path.read_text()) for path in sorted(out.glob("*.json"))}
    if not measured:
        raise ValueError(f"{out}: no *.json; run experiments/quadrature.py first")
    closed = measured.pop("closed", None)
    lines = closed_table(closed) if closed else []
    for run in measured.values():
        lines += ["", *trained_table(run)] if lines else trained_table(run)
    print("\n".join(lines))
    draw(
        ([closed] if closed else []) + list(measured.values()),
        pathlib.Path(_PLOT.value or out / "quadrature.png"),
    )
    if FLAGS.readme:
        table.replace(pathlib.Path(FLAGS.readme), lines, MARKS)


def closed_table(closed):
    """Returns lines: order, and evaluations and microseconds a ray for each bound."""
    rows = closed["rows"]
    media = list(dict.fromkeys(row["medium"] for row in rows))
    cells = []
    for rule, sampling in curves(rows):
        line = [rule, sampling]
        for medium in media:
            curve = select(rows, medium=medium, rule=rule, sampling=sampling)
            needs = [need(curve, bound) for bound in BOUNDS]
            costs = [
                "never" if row is None else f"{row['evaluations']} ({row['microseconds']:.1f} us)" for row in needs
            ]
            line.append(f"{round(order(curve), 1) + 0.0:.1f}: " + ("never" if needs[0] is None else ", ".join(costs)))
        cells.append(line)
    last = [select(rows, medium=medium, rule="gauss", sampling="uniform")[-1] for medium in media]
    floors = [f"{row['medium']} {row['rms32']:.0e}" for row in last if row["rms"] < 0.1 * row["rms32"]]
    bounds = " and ".join(f"{bound:.0e}" for bound in BOUNDS)
    return [
        f"Closed forms, {closed['rays']} rays each: order of the colour's RMS error in float64; evaluations, "
        f"with microseconds a ray in float32, for {bounds}. {closed['machine']}.",
        "",
        *table.markdown(("rule", "sampling", *media), cells),
        "",
        f"RMS error in float32 where rounding alone is left (gauss, {last[0]['evaluations']} evaluations): "
        f"{', '.join(floors) or 'nowhere'}.",
    ]


def trained_table(run):
    """Returns lines: what each rule needs for an error, the cheapest, and its score on the photographs."""
    rows, cells = run["rows"], []
    cheapest = {bound: min(cost(rows, bound).items(), key=lambda pair: pair[1]) for bound in TRAINED_BOUNDS}
    for rule, sampling in curves(rows):
        curve, line = select(rows, rule=rule, sampling=sampling), [rule, sampling]
        for bound in TRAINED_BOUNDS:
            row = need(curve, bound)
            best = cheapest[bound][0] == (rule, sampling) and row is not None
            text = "-" if row is None else f"{row['evaluations']}, {1e3 * row['seconds']:.0f} ms"
            line.append(f"**{text}**" if best else text)
        line += [f"{row['psnr']:.2f}" for row in curve[:3]]
        cells.append(line)
    heads = [f"RMS {bound:.0e}" for bound in TRAINED_BOUNDS]
    heads += [f"PSNR {row['evaluations']}" for row in curve[:3]]
    verdicts = [
        f"{bound:.0e}: " + ("no rule" if math.isinf(seconds) else f"{rule}, {sampling}")
        for bound, ((rule, sampling), seconds) in cheapest.items()
    ]
    return [
        f"{run['name']} (step {run['step']}), {run['rays']} test rays: evaluations of the fine network, and "
        f"time of all rays, for an RMS error of the colour. The truth, {run['reference']} float64 segments, "
        f"changed by at most {run['self_difference']:.0e} in its last doubling, scores {run['psnr']:.2f} dB "
        f"on the photos; PSNR beside it at so many evaluations. {run['machine']}.",
        "",
        *table.markdown(("rule", "sampling", *heads), cells),
        "",
        "Cheapest for an error of " + "; ".join(verdicts) + ".",
    ]


def curves(rows):
    return list(dict.fromkeys((row["rule"], row["sampling"]) for row in rows))


def select(rows, **names):
    return [row for row in rows if all(row[name] == value for name, value in names.items())]


def need(curve, bound):
    """Returns the first row from which on the error stays within the bound, or None."""
    kept = None
    for row in reversed(curve):
        if not row["rms"] <= bound:
            break
        kept = row
    return kept


def cost(rows, bound):
    """Returns the seconds of each curve for a bound, inf where it does not reach it."""
    found = {}
    for rule, sampling in curves(rows):
        row = need(select(rows, rule=rule, sampling=sampling), bound)
        found[rule, sampling] = math.inf if row is None else row["seconds"]
    return found


def order(curve):
    """Returns the order of convergence over the last factor of 4 that lies above rounding."""
    errors = [row["rms"] for row in curve if row["rms"] > 1e-12]  # rounding in float64 is below
    return math.log2(errors[-3] / errors[-1]) / 2 if len(errors) > 2 else math.nan


def draw(studies, path):
    """Draws a row of two plots for each medium or run."""
    try:
        import matplotlib
    except ImportError as error:
        raise ValueError("plots need matplotlib: pip install 'jaxnerf[experiments]'") from error
    matplotlib.use("Agg")
    from matplotlib import pyplot

    panels = []
    for study in studies:
        media = dict.fromkeys(row.get("medium", study.get("name")) for row in study["rows"])
        panels += [(name, [r for r in study["rows"] if r.get("medium", name) == name]) for name in media]
    figure, axes = pyplot.subplots(
        len(panels), 2, figsize=(11, 3.2 * len(panels)), squeeze=False, sharey="row", layout="constrained"
    )
    colours = dict(zip(RULES, ("tab:red", "tab:blue", "tab:green"), strict=True))
    styles = {"uniform": "-", "stratified": ":", "hierarchical": "--"}
    for (name, rows), (left, right) in zip(panels, axes, strict=True):
        for rule, sampling in curves(rows):
            curve = select(rows, rule=rule, sampling=sampling)
            times = [row.get("microseconds") or 1e3 * row["seconds"] for row in curve]
            counts, errors = [row["evaluations"] for row in curve], [row["rms"] for row in curve]
            single = [row.get("rms32", row["rms"]) for row in curve]
            for axis, across, upwards in ((left, counts, errors), (right, times, single)):
                axis.loglog(
                    across,
                    upwards,
                    styles[sampling],
                    color=colours[rule],
                    marker=".",
                    label=f"{rule}, {sampling}",
                )
        closed = "rms32" in rows[0]
        left.set(title=name, ylabel="RMS error of the colour")
        left.set_xlabel("evaluations a ray" + (", in float64" if closed else ""))
        right.set_xlabel("microseconds a ray, in float32" if closed else "milliseconds for all rays")
        for axis in (left, right):
            axis.grid(alpha=0.3)
    axes[0, 1].legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    print(f"drew {path}")


if __name__ == "__main__":
    cli.run(main)
