"""The plot of what speed_vs_error.py has measured, beside what others have published."""

import speed_published
from speed_figures import medians, pareto_front


def draw(measured, path):
    """Draws score against seconds of training, and of rendering, for the parts that were measured."""
    try:
        import matplotlib
    except ImportError as error:
        raise ValueError("plots need matplotlib: pip install 'jaxnerf[experiments]'") from error
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 3, figsize=(19, 8), layout="constrained", width_ratios=(2.2, 1, 1))
    _training(axes[0], measured.get("training") or {"curves": {}, "machine": "no curve measured"})
    for axis, key in zip(axes[1:], ("psnr", "largest"), strict=True):
        rows = measured.get("rendering", {}).get("rows", [])
        _rendering(axis, rows, key) if rows else axis.set_visible(False)
    figure.savefig(path, dpi=100)
    print(f"drew {path}")


def _training(axis, kept):
    small = []
    for name, curve in kept["curves"].items():
        points = medians(curve["runs"]) if all(curve["runs"].values()) and curve["runs"] else []
        line = [(point["seconds"], point["psnr"]) for point in points]
        if not line:
            continue
        other = name.split()[-1] if name.split()[-1].isdigit() else ""
        axis.plot(*zip(*line, strict=True), ":" if other else "-", marker="o", markersize=4, label=name)
        small += [] if other else line
    if small:
        front = pareto_front(small)
        axis.plot(*zip(*front, strict=True), color="0.8", linewidth=7, zorder=0, label="Pareto front, 100x100")
    shapes = iter("*pPXDhds<>^v8H" * 3)
    for entry in speed_published.TRAINING:
        published = entry["kind"] == "published"
        text = f"{entry['kind']}: {entry['name']}, {entry['what']}, hardware: {entry['hardware']}"
        style = {"s": 80, "facecolors": "none", "edgecolors": "k"} if published else {"s": 25, "color": "0.5"}
        marker = next(shapes) if published else "x"
        axis.scatter(entry["seconds"], entry["psnr"], marker=marker, label=text if published else None, **style)
    before = [entry for entry in speed_published.TRAINING if entry["kind"] != "published"]
    axis.scatter(
        [],
        [],
        marker="x",
        color="0.5",
        label=f"{before[0]['kind']}: nerf-pytorch, JaxNeRF, {before[0]['what']}, {before[0]['hardware']}",
    )
    axis.set(xscale="log", xlabel=f"seconds of training ({kept['machine']})", ylabel="PSNR, dB", ylim=(9, 38))
    axis.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=2)
    axis.grid(alpha=0.3)


def _rendering(axis, rows, key):
    groups = {}
    for row in rows:
        name = f"samples {row['settings']['samples']}"
        groups.setdefault(name, []).append((row["seconds"], row[key]))
    for name, points in groups.items():
        axis.plot(*zip(*sorted(points), strict=True), "o", markersize=4, label=name)
    sign = 1 if key == "psnr" else -1
    front = pareto_front([(row["seconds"], sign * row[key]) for row in rows])
    seconds, values = zip(*front, strict=True)
    axis.plot(seconds, [sign * value for value in values], color="0.6", zorder=0, label="Pareto front")
    axis.legend(fontsize=7)
    axis.set(xscale="log", xlabel="seconds a frame", yscale="linear" if key == "psnr" else "log")
    axis.set_ylabel("PSNR, dB" if key == "psnr" else "largest error of a colour, to samples 4 and stop 0")
    axis.grid(alpha=0.3)
