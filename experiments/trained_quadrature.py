"""Error against evaluations and against time of each quadrature rule, on trained scenes.

    JAXNERF_SCENES=... python experiments/trained_quadrature.py --workdir=runs/a,runs/b \
        [--out=runs/quadrature] [--readme=README.md] [--plot=docs/quadrature.png]

Renders rays of the test views with the newest checkpoint. The truth is the fine network in float64 with
midpoint segments, doubled until that changes little. Renderings and times are in float32; the hierarchical
ones are guided by the trained coarse network. Evaluations are of the fine network. Writes a
trained_NAME.json for each run into --out, for experiments/quadrature_report.py.
"""

import functools
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import quadrature_report
from absl import flags
from quadrature import error, measure

from jaxnerf import render_hierarchical, render_rays
from jaxnerf.data.dataset import background_of
from jaxnerf.data.ray_batches import pixel_colors
from jaxnerf.evaluation import restore
from jaxnerf.fields.mlp import mlp_field
from jaxnerf.runtime import cli
from jaxnerf.training import workdir

flags.DEFINE_list("workdir", None, "Folders of trained runs.", required=True)
flags.DEFINE_integer("test_rays", 1024, "Rays, spread over the test views.")
flags.DEFINE_integer("dense", 4096, "Segments of the coarser of the first two references.")
flags.DEFINE_integer("densest", 32768, "Segments where the doubling ends.")
flags.DEFINE_float("change", 1e-6, "Largest change of a colour in the last doubling.")
flags.DEFINE_list("numbers", ["16", "32", "64", "128", "256", "512"], "Evaluations of the fine network.")
FLAGS = flags.FLAGS
SAMPLES_A_BLOCK = 8192  # enough for a product to run at full speed, few enough for a cache


def main(argv):
    """Measures every run and reports."""
    del argv
    print(quadrature_report.machine())
    for folder in FLAGS.workdir:
        quadrature_report.save(f"trained_{pathlib.Path(folder).name}.json", study(folder))
    quadrature_report.report()


def study(folder):
    """Returns the figures of one run."""
    config = workdir.read_config(folder)
    run = restore.restore_run(folder, config)
    step = restore.newest_step(run, folder)
    params, _ = run.weights(step)
    rays, photographed = test_rays(run.experiment, FLAGS.test_rays)
    background = background_of(config.data)
    options = {"background": background, "in_disparity": config.sampling.in_disparity}
    segments, truth, difference = reference(config, params, rays, options)
    rows, timed = [], {}
    names = ("coarse", "fine") if "coarse" in params else ("fine",)
    fields = [functools.partial(field(config[name]).apply, params[name]) for name in names]
    for rule in quadrature_report.RULES:
        for sampling in ("uniform", "hierarchical")[: len(fields)]:
            for number in map(int, FLAGS.numbers):
                scenes = fields if sampling == "hierarchical" else fields[-1:]
                call = functools.partial(in_blocks, scenes, number, options | {"rule": rule}, rays)
                key = rule, sampling, number
                timed[key] = jax.jit(call).lower().compile()
                rgb = np.asarray(timed[key](), np.float64)
                names = {"rule": rule, "sampling": sampling, "evaluations": number}
                rows.append(names | error(rgb - truth) | {"psnr": psnr(rgb, photographed)})
    seconds = measure(timed, FLAGS.repeats)
    for row in rows:
        row["seconds"] = seconds[row["rule"], row["sampling"], row["evaluations"]]
    return {
        "name": pathlib.Path(folder).name,
        "machine": quadrature_report.machine(),
        "step": step,
        "rays": FLAGS.test_rays,
        "reference": segments,
        "self_difference": difference,
        "psnr": psnr(truth, photographed),
        "rows": rows,
    }


def test_rays(experiment, count):
    """Returns Rays [count] spread evenly over all pixels of the test views, and their colours [count, 3]."""
    views = experiment.load_views("test")
    index = np.int64((np.arange(count) + 0.5) * len(views.pixels) / count)
    view = np.searchsorted(views.offset, index, side="right") - 1
    place, width = index - np.asarray(views.offset)[view], np.asarray(views.size)[view, 1]
    pixels = np.float32(np.stack([place % width, place // width], axis=-1) + experiment.pixel_offset)
    rays = jax.jit(jax.vmap(lambda view, pixel: experiment.view_rays(views, view, pixel)))(view, pixels)
    colours = pixel_colors(jnp.asarray(np.asarray(views.pixels)[index]), views.background)
    return jax.tree.map(np.asarray, rays), np.asarray(colours, np.float64)


def field(section, **changes):
    options = dict(section) | changes
    return mlp_field(**options | {"compute_dtype": jnp.dtype(options["compute_dtype"])})


def reference(config, params, rays, options):
    """Returns the number of segments, colours [R, 3] in float64, and how much the last doubling changed."""
    with jax.enable_x64(True):
        params, rays = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), (params["fine"], rays))
        scene = functools.partial(field(config.fine, compute_dtype="float64").apply, params)

        def colours(number, rule="segments"):
            return np.asarray(jax.jit(functools.partial(in_blocks, [scene], number, options | {"rule": rule}))(rays))

        number, truth = FLAGS.dense, colours(FLAGS.dense)
        while True:
            number, before, truth = 2 * number, truth, colours(2 * number)
            change = error(truth - before)
            print(f"reference: {number // 2} to {number} segments, colour changes by {change}", flush=True)
            if change["max"] <= FLAGS.change or number >= FLAGS.densest:
                break
        other = error(colours(number // 2, "gauss") - truth)
        print(f"reference: {number} segments differ from {number // 2} Gauss points by {other}", flush=True)
    return number, truth, change["max"]


def in_blocks(scenes, number, options, rays):
    """Returns colours [R, 3] with so many evaluations of the last scene, in blocks that fit a cache."""

    def render(rays):
        if len(scenes) == 1:
            return render_rays(None, *scenes, rays, num_samples=number, **options).rgb
        half = {"num_coarse": number // 2, "num_fine": number - number // 2}
        return render_hierarchical(None, *scenes, rays, **half, **options)[1].rgb

    block = max(1, SAMPLES_A_BLOCK // number)
    rays = jax.tree.map(jnp.asarray, rays)
    return jax.lax.map(render, rays, batch_size=min(block, len(rays.near)))


def psnr(rgb, photographed):
    return float(-10 * np.log10(np.mean((np.clip(rgb, 0, 1) - photographed) ** 2)))


if __name__ == "__main__":
    cli.run(main)
