"""Measures error against evaluations and against time of each quadrature rule, on closed forms and trained scenes.

    XLA_FLAGS="--xla_cpu_multi_thread_eigen=false" taskset -c 0 python experiments/quadrature/quadrature.py \
        [--out=runs/quadrature] [--page=FILE.md] [--plot=docs/results/quadrature.png]
    JAXNERF_SCENES=... python experiments/quadrature/quadrature.py --workdir=runs/a,runs/b [--out=...] ...
    python experiments/quadrature/quadrature.py --report_only [--out=...] ...

Without --workdir the scenes are media with closed forms. Errors are of the colour, in float64 and in float32, over
random rays. Times are in float32 on one thread, with the flags above. Hierarchical sampling evaluates the scene a
third of the time in its coarse pass and the rest in its fine one.

With --workdir rays of the test views are rendered with the newest checkpoint of each run. The truth is the fine
network in float64 with midpoint segments, doubled until that changes little. Renderings and times are in float32; the
hierarchical ones are guided by the trained coarse network. Evaluations are of the fine network.

Writes closed.json or trained_NAME.json into --out, prints the tables of all *.json there, and plots error against
evaluations and against time; for the closed forms the former in float64 and the latter in float32, as the times are.
With --page the tables replace what lies between <!-- quadrature --> and <!-- /quadrature --> in that file.
"""

import functools
import json
import math
import pathlib
import statistics
import sys

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf import Rays, render_hierarchical, render_rays
from jaxnerf.core.views import pixel_colors
from jaxnerf.evaluation import restore
from jaxnerf.fields.mlp import mlp_field
from jaxnerf.runtime import cli
from jaxnerf.training import workdir
from jaxnerf.training.config import to_config_dict
from test_scenes import analytic

flags.DEFINE_string("out", "runs/quadrature", "Folder of the measurements.")
flags.DEFINE_string("plot", None, "PNG to write; out/quadrature.png when not given.")
flags.DEFINE_bool("report_only", False, "Measure nothing.")
flags.DEFINE_integer("repeats", 5, "Timings of each, in turn; the median counts.")
flags.DEFINE_integer("rays", 256, "Closed forms: number of rays per medium.")
flags.DEFINE_integer("largest", 1536, "Closed forms: evaluations at the end of the doubling, which begins at 12.")
flags.DEFINE_list("workdir", None, "Folders of trained runs.")
flags.DEFINE_integer("test_rays", 1024, "Trained scenes: number of rays, spread over the test views.")
flags.DEFINE_integer("dense", 4096, "Trained scenes: segments of the coarser of the first two references.")
flags.DEFINE_integer("densest", 32768, "Trained scenes: segments at which the doubling ends.")
flags.DEFINE_float("change", 1e-6, "Trained scenes: largest change of a colour in the last doubling.")
flags.DEFINE_list(
    "numbers", ["16", "32", "64", "128", "256", "512"], "Trained scenes: evaluations of the fine network."
)
FLAGS = flags.FLAGS

RULES = ("points", "segments", "gauss")
BOUNDS = (1e-3, 1e-5)  # of the closed forms
TRAINED_BOUNDS = (1e-2, 3e-3, 1e-3, 1e-4)
SAMPLINGS = ("uniform", "stratified", "hierarchical")
_SAMPLES_PER_CHUNK = 8192  # enough for a product to run at full speed, few enough for a cache
_SLOPE = ((0.0, 0.0, 0.2), (0.1, -0.1, -0.15), (0.05, 0.05, -0.2))
_COLOURED = {"rgb": (0.4, 0.5, 0.6), "rgb_slope": _SLOPE}
MEDIA = {
    "homogeneous fog": analytic.slab(1.0, lower=-10.0, upper=10.0, **_COLOURED),
    "linear density": analytic.linear(1.0, **_COLOURED),
    "exponential atmosphere": analytic.atmosphere(8.0, scale_height=0.07, **_COLOURED),
    "Gaussian blob": analytic.blob(3.0, center=(0.0, 0.0, 1.5), deviation=0.5, **_COLOURED),
    "ball with an edge": analytic.ball(2.0, center=(0.0, 0.0, 1.5), **_COLOURED),
}


def main(argv: list[str]) -> None:
    """Measures, except with --report_only, and reports all measurements in the folder."""
    del argv
    out = pathlib.Path(FLAGS.out)
    print(common.describe_machine())
    if not FLAGS.report_only:
        if not FLAGS.workdir:
            common.write_json(out / "closed.json", measure_closed_forms())
        for folder in FLAGS.workdir or ():
            common.write_json(out / f"trained_{pathlib.Path(folder).name}.json", measure_run(folder))
    measured = {path.stem: json.loads(path.read_text()) for path in sorted(out.glob("*.json"))}
    if not measured:
        raise ValueError(f"{out}: has no *.json; measure first, without --report_only")
    closed = measured.pop("closed", None)
    lines = closed_table(closed) if closed else []
    for run in measured.values():
        lines += ["", *trained_table(run)] if lines else trained_table(run)
    common.publish(lines, "quadrature")
    plot(([closed] if closed else []) + list(measured.values()), pathlib.Path(FLAGS.plot or out / "quadrature.png"))


def measure_closed_forms() -> dict:
    """Returns the errors and times of all rules and samplings on MEDIA."""
    numbers = [12 * 2**i for i in range(20) if 12 * 2**i <= FLAGS.largest]
    with jax.enable_x64(True):
        rays = random_rays(FLAGS.rays)
        truths = [np.asarray(jax.jit(medium.exact)(rays).rgb) for medium in MEDIA.values()]
    rows, calls = [], {}
    for rule in RULES:
        for sampling in SAMPLINGS:
            for number in numbers:
                doubled = _colors(rule, sampling, number, rays, jnp.float64)
                single = _colors(rule, sampling, number, rays, jnp.float32, calls)
                for medium, truth, fine, coarse in zip(MEDIA, truths, doubled, single, strict=True):
                    names = {"medium": medium, "rule": rule, "sampling": sampling, "evaluations": number}
                    rows.append(names | _error(fine - truth) | {"rms32": _error(coarse - truth)["rms"]})
    seconds = _median_seconds(calls)
    for row in rows:
        key = row["rule"], row["sampling"], row["evaluations"], row["medium"]
        row["microseconds"] = 1e6 * seconds[key] / FLAGS.rays
    return {"machine": common.describe_machine(), "rays": FLAGS.rays, "rows": rows}


def random_rays(count: int) -> Rays:
    """Returns Rays between two random points, the first above the blob, the second near z = 0."""
    rng = np.random.default_rng(0)
    begin = rng.uniform((-1.5, -1.5, 2.7), (1.5, 1.5, 3.5), (count, 3))
    end = rng.uniform((-1.0, -1.0, 0.02), (1.0, 1.0, 0.2), (count, 3))
    # Numbers that float32 holds, so that both precisions see the same rays.
    origins, directions = (np.float64(np.float32(x)) for x in (begin, (end - begin) / 4))
    viewdirs = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    near = np.zeros(count)
    return Rays(origins=origins, directions=directions, viewdirs=viewdirs, near=near, far=near + 4)


def _colors(rule, sampling, number, rays, dtype, calls=None):
    """Returns each medium's colours [R, 3] in a precision, and adds the calls to those that are timed."""
    with jax.enable_x64(dtype == jnp.float64):
        rays = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), rays)
        keys = jax.random.split(jax.random.key(0), len(rays.near)) if sampling == "stratified" else None
        run = jax.jit(functools.partial(_render_medium, rule=rule, sampling=sampling, number=number))
        found = [np.asarray(run(keys, rays, medium)) for medium in range(len(MEDIA))]
    if calls is not None:
        for medium, name in enumerate(MEDIA):
            calls[rule, sampling, number, name] = functools.partial(run, keys, rays, medium)
    return found


def _render_medium(keys, rays, medium, *, rule, sampling, number):
    """Returns colours [R, 3] of the medium of that number: one compilation serves all media."""

    def scene(x, viewdirs):
        return jax.lax.switch(medium, [medium.scene for medium in MEDIA.values()], x, viewdirs)

    if sampling != "hierarchical":
        return render_rays(keys, scene, rays, num_samples=number, rule=rule).rgb
    third = {"num_coarse": number // 3, "num_fine": number // 3}
    return render_hierarchical(keys, scene, scene, rays, rule=rule, **third)[1].rgb


def measure_run(folder: str) -> dict:
    """Returns the errors and times of all rules and samplings on a trained run."""
    config, run = to_config_dict(workdir.load_config(folder)), restore.restore_run(folder)
    step = restore.newest_step(run, folder)
    params, _ = run.variables(step)
    rays, truth_of_images = test_rays(run.experiment, FLAGS.test_rays)
    options = {"background": run.experiment.background, "in_disparity": config.sampling.in_disparity}
    segments, truth, difference = _reference(config, params, rays, options)
    rows, timed = [], {}
    names = ("coarse", "fine") if "coarse" in params else ("fine",)
    fields = [functools.partial(_field(config[name]).apply, params[name]) for name in names]
    for rule in RULES:
        for sampling in ("uniform", "hierarchical")[: len(fields)]:
            for number in map(int, FLAGS.numbers):
                scenes = fields if sampling == "hierarchical" else fields[-1:]
                call = functools.partial(_in_chunks, scenes, number, options | {"rule": rule}, rays)
                key = rule, sampling, number
                timed[key] = jax.jit(call).lower().compile()
                rgb = np.asarray(timed[key](), np.float64)
                names = {"rule": rule, "sampling": sampling, "evaluations": number}
                rows.append(names | _error(rgb - truth) | {"psnr": _psnr(rgb, truth_of_images)})
    seconds = _median_seconds(timed)
    for row in rows:
        row["seconds"] = seconds[row["rule"], row["sampling"], row["evaluations"]]
    return {
        "name": pathlib.Path(folder).name,
        "machine": common.describe_machine(),
        "step": step,
        "rays": FLAGS.test_rays,
        "reference": segments,
        "self_difference": difference,
        "psnr": _psnr(truth, truth_of_images),
        "rows": rows,
    }


def test_rays(experiment, count: int) -> tuple[Rays, np.ndarray]:
    """Returns Rays [count] spread evenly over all pixels of the test views, and their colours [count, 3]."""
    views = experiment.load_split("test")
    index = np.int64((np.arange(count) + 0.5) * len(views.pixels) / count)
    view = np.searchsorted(views.offset, index, side="right") - 1
    place, width = index - np.asarray(views.offset)[view], np.asarray(views.size)[view, 1]
    pixels = np.float32(np.stack([place % width, place // width], axis=-1) + experiment.config.data.pixel_offset)
    rays = jax.jit(jax.vmap(lambda view, pixel: experiment.view_rays(views, view, pixel)))(view, pixels)
    colors = pixel_colors(jnp.asarray(np.asarray(views.pixels)[index]), views.background)
    return jax.tree.map(np.asarray, rays), np.asarray(colors, np.float64)


def _field(section, **changes):
    options = dict(section) | changes
    return mlp_field(**options | {"compute_dtype": jnp.dtype(options["compute_dtype"])})


def _reference(config, params, rays, options):
    """Returns the number of segments, colours [R, 3] in float64, and how much the last doubling changed them."""
    with jax.enable_x64(True):
        params, rays = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), (params["fine"], rays))
        scene = functools.partial(_field(config.fine, compute_dtype="float64").apply, params)

        def colors(number, rule="segments"):
            return np.asarray(jax.jit(functools.partial(_in_chunks, [scene], number, options | {"rule": rule}))(rays))

        number, truth = FLAGS.dense, colors(FLAGS.dense)
        while True:
            number, before, truth = 2 * number, truth, colors(2 * number)
            change = _error(truth - before)
            print(f"reference: {number // 2} to {number} segments, colour changes by {change}", flush=True)
            if change["max"] <= FLAGS.change or number >= FLAGS.densest:
                break
        other = _error(colors(number // 2, "gauss") - truth)
        print(f"reference: {number} segments differ from {number // 2} Gauss points by {other}", flush=True)
    return number, truth, change["max"]


def _in_chunks(scenes, number, options, rays):
    """Returns colours [R, 3] with so many evaluations of the last scene, in chunks that fit a cache."""

    def render(rays):
        if len(scenes) == 1:
            return render_rays(None, *scenes, rays, num_samples=number, **options).rgb
        half = {"num_coarse": number // 2, "num_fine": number - number // 2}
        return render_hierarchical(None, *scenes, rays, **half, **options)[1].rgb

    chunk = max(1, _SAMPLES_PER_CHUNK // number)
    rays = jax.tree.map(jnp.asarray, rays)
    return jax.lax.map(render, rays, batch_size=min(chunk, len(rays.near)))


def _psnr(rgb, truth):
    return float(-10 * np.log10(np.mean((np.clip(rgb, 0, 1) - truth) ** 2)))


def _error(difference):
    return {"rms": float(np.sqrt(np.mean(difference**2))), "max": float(np.abs(difference).max())}


def _median_seconds(calls):
    """Returns the median seconds of each call; all calls take turns, and the first turn warms the caches."""
    turns = [{key: common.seconds(call) for key, call in calls.items()} for _ in range(FLAGS.repeats + 1)][1:]
    return {key: statistics.median(turn[key] for turn in turns) for key in calls}


def closed_table(closed: dict) -> list[str]:
    """Returns the lines of the closed forms: order, and evaluations and microseconds per ray for each bound."""
    rows = closed["rows"]
    media = list(dict.fromkeys(row["medium"] for row in rows))
    cells = []
    for rule, sampling in _curves(rows):
        line = [rule, sampling]
        for medium in media:
            curve = _select(rows, medium=medium, rule=rule, sampling=sampling)
            needs = [_need(curve, bound) for bound in BOUNDS]
            costs = [
                "never" if row is None else f"{row['evaluations']} ({row['microseconds']:.1f} us)" for row in needs
            ]
            line.append(f"{round(_order(curve), 1) + 0.0:.1f}: " + ("never" if needs[0] is None else ", ".join(costs)))
        cells.append(line)
    last = [_select(rows, medium=medium, rule="gauss", sampling="uniform")[-1] for medium in media]
    floors = [f"{row['medium']} {row['rms32']:.0e}" for row in last if row["rms"] < 0.1 * row["rms32"]]
    bounds = " and ".join(f"{bound:.0e}" for bound in BOUNDS)
    return [
        f"Closed forms, {closed['rays']} rays each: order of the colour's RMS error in float64; evaluations, "
        f"with microseconds a ray in float32, for {bounds}. {closed['machine']}.",
        "",
        *common.markdown(("rule", "sampling", *media), cells),
        "",
        f"RMS error in float32 where rounding alone is left (gauss, {last[0]['evaluations']} evaluations): "
        f"{', '.join(floors) or 'nowhere'}.",
    ]


def trained_table(run: dict) -> list[str]:
    """Returns the lines of a run: what each rule needs for an error, the cheapest, and its PSNR on the images."""
    rows, cells = run["rows"], []
    cheapest = {bound: min(_cost(rows, bound).items(), key=lambda pair: pair[1]) for bound in TRAINED_BOUNDS}
    for rule, sampling in _curves(rows):
        curve, line = _select(rows, rule=rule, sampling=sampling), [rule, sampling]
        for bound in TRAINED_BOUNDS:
            row = _need(curve, bound)
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
        f"on the images; PSNR beside it at so many evaluations. {run['machine']}.",
        "",
        *common.markdown(("rule", "sampling", *heads), cells),
        "",
        "Cheapest for an error of " + "; ".join(verdicts) + ".",
    ]


def _curves(rows):
    return list(dict.fromkeys((row["rule"], row["sampling"]) for row in rows))


def _select(rows, **names):
    return [row for row in rows if all(row[name] == value for name, value in names.items())]


def _need(curve, bound):
    """Returns the first row from which on the error stays within the bound, or None."""
    kept = None
    for row in reversed(curve):
        if not row["rms"] <= bound:
            break
        kept = row
    return kept


def _cost(rows, bound):
    """Returns the seconds of each curve for a bound, inf where it does not reach it."""
    found = {}
    for rule, sampling in _curves(rows):
        row = _need(_select(rows, rule=rule, sampling=sampling), bound)
        found[rule, sampling] = math.inf if row is None else row["seconds"]
    return found


def _order(curve):
    """Returns the order of convergence over the last factor of 4 that lies above rounding."""
    errors = [row["rms"] for row in curve if row["rms"] > 1e-12]  # rounding in float64 is below
    return math.log2(errors[-3] / errors[-1]) / 2 if len(errors) > 2 else math.nan


def plot(studies: list[dict], path: pathlib.Path) -> None:
    """Plots a row of two diagrams for each medium or run."""
    pyplot = common.pyplot()
    if pyplot is None:
        return
    panels = []
    for study in studies:
        media = dict.fromkeys(row.get("medium", study.get("name")) for row in study["rows"])
        panels += [(name, [r for r in study["rows"] if r.get("medium", name) == name]) for name in media]
    figure, axes = pyplot.subplots(
        len(panels), 2, figsize=(11, 3.2 * len(panels)), squeeze=False, sharey="row", layout="constrained"
    )
    colors = dict(zip(RULES, ("tab:red", "tab:blue", "tab:green"), strict=True))
    styles = {"uniform": "-", "stratified": ":", "hierarchical": "--"}
    for (name, rows), (left, right) in zip(panels, axes, strict=True):
        for rule, sampling in _curves(rows):
            curve = _select(rows, rule=rule, sampling=sampling)
            times = [row.get("microseconds") or 1e3 * row["seconds"] for row in curve]
            counts, errors = [row["evaluations"] for row in curve], [row["rms"] for row in curve]
            single = [row.get("rms32", row["rms"]) for row in curve]
            for axis, across, upwards in ((left, counts, errors), (right, times, single)):
                label = f"{rule}, {sampling}"
                axis.loglog(across, upwards, styles[sampling], color=colors[rule], marker=".", label=label)
        closed = "rms32" in rows[0]
        left.set(title=name, ylabel="RMS error of the colour")
        left.set_xlabel("evaluations a ray" + (", in float64" if closed else ""))
        right.set_xlabel("microseconds a ray, in float32" if closed else "milliseconds for all rays")
        for axis in (left, right):
            axis.grid(alpha=0.3)
    axes[0, 1].legend(fontsize=7)
    common.save_figure(figure, path)


if __name__ == "__main__":
    cli.run(main)
