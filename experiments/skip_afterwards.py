"""A network trained along whole rays, rendered with empty space left out: how much faster, and at what loss.

    JAXNERF_SCENES=... taskset -c 0 python experiments/skip_afterwards.py --workdir=runs/lego_small \
        [--settings=samples/stop/chunk/samples_at_once,...] [--split=train] [--readme=README.md]

Renders views of a split along whole rays, as eval does without flags, and with each of the settings, view by
view: what else the machine does then slows all of them down alike. Settings are to be chosen on the training
views; --split=test scores what was chosen.
"""

import functools
import pathlib
import statistics

import jax
import jax.numpy as jnp
import numpy as np
import speed_machine
import table
from absl import flags

from jaxnerf import pixel_grid, psnr
from jaxnerf.evaluation.evaluate import reference
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.runtime import cli
from jaxnerf.training import workdir

flags.DEFINE_string("workdir", None, "Folder of a run trained along whole rays.", required=True)
flags.DEFINE_list(
    "settings",
    ["1/0.001/4096/0", "0.43/0.1/4096/0", "0.43/0.1/6144/256"],
    "Samples, stop, chunk and samples_at_once of each.",
)
flags.DEFINE_string("split", "train", "Of the views.")
flags.DEFINE_integer("views", 9, "How many, spread over the split.", lower_bound=1)
flags.DEFINE_integer("repeats", 5, "Renderings of each view.", lower_bound=1)
FLAGS = flags.FLAGS
MARKS = ("<!-- skipping -->", "<!-- end of skipping -->")
HEADS = ("sample_multiplier", "early_stop_eps", "chunk", "at once", "s a frame", "times faster", "PSNR")


def main(argv):
    """Measures, and prints the table."""
    del argv
    folder, config = FLAGS.workdir, workdir.read_config(FLAGS.workdir)
    run = restore_run(folder, config)
    if run.experiment.model.grid_schedule is not None:
        raise ValueError(f"{folder}: skips empty space already; give a run trained along whole rays")
    step, settings = newest_step(run, folder), [parsed(setting) for setting in FLAGS.settings]
    renderers, weights = [renderer(run, run.weights(step), config.eval.chunk)], None
    for setting in settings:
        skipping = restore_run(folder, config, settings={"bake_occupancy": True} | setting)
        weights = weights or skipping.weights(step)  # the grid is the same with all settings
        renderers.append(renderer(skipping, weights, setting["chunk"]))
    views = run.experiment.load_views(FLAGS.split)
    chosen = np.unique(np.linspace(0, len(views.offset) - 1, FLAGS.views).astype(int))
    gflops = speed_machine.matrix_gflops()
    seconds, scores = measure(run, views, chosen, renderers)
    rows = [
        row(setting, *each)
        for setting, *each in zip(settings, seconds[1:], seconds[0] / seconds[1:], scores[1:], strict=True)
    ]
    lines = [
        f"{len(chosen)} views of {FLAGS.split!r} of {folder} (step {step}), each {FLAGS.repeats} times; "
        f"{speed_machine.describe()}, matrix product {gflops:.0f} and {speed_machine.matrix_gflops():.0f} "
        f"GFLOP/s. Along whole rays {statistics.median(seconds[0]):.3f} s a frame and {scores[0]:.2f} dB. "
        "Medians, and the range of the views.",
        "",
        *table.markdown(HEADS, rows),
    ]
    print("\n".join(lines))
    if FLAGS.readme:
        table.replace(pathlib.Path(FLAGS.readme), lines, MARKS)


def row(setting, seconds, faster, score):
    """Returns the cells of a setting, from the seconds [V] of its views, how much faster [V], and PSNR."""
    return (
        *map(str, setting.values()),
        f"{statistics.median(seconds):.4f}",
        f"{statistics.median(faster):.1f} ({min(faster):.1f} to {max(faster):.1f})",
        f"{score:.2f} dB",
    )


def parsed(setting):
    """Returns the fields of config.eval that a setting names."""
    kinds = {"sample_multiplier": float, "early_stop_eps": float, "chunk": int, "max_samples": int}
    try:
        pairs = zip(kinds.items(), setting.split("/"), strict=True)
        return {name: kind(value) for (name, kind), value in pairs}
    except ValueError as error:
        raise ValueError(f"--settings has {setting!r}, wanted numbers as {'/'.join(kinds)}") from error


def renderer(run, weights, chunk):
    """Returns rays [H, W] -> the picture [H, W, 3]."""
    return lambda rays: np.asarray(run.image(weights, rays, chunk=chunk).rgb)


def measure(run, views, chosen, renderers):
    """Returns the seconds of each renderer and view [R, V], and the mean PSNR of each renderer [R]."""
    seconds, scores = np.zeros((2, len(renderers), len(chosen)))
    for place, index in enumerate(chosen):
        pixels = pixel_grid(*np.asarray(views.size[index]).tolist(), offset=run.experiment.pixel_offset)
        rays = jax.block_until_ready(run.experiment.view_rays(views, index, pixels.astype(jnp.float32)))
        truth = np.asarray(reference(views, index))
        for number, render in enumerate(renderers):
            scores[number, place] = psnr(render(rays), truth)  # compiles, too
            taken = speed_machine.times(functools.partial(render, rays), FLAGS.repeats)
            seconds[number, place] = statistics.median(taken)
    return seconds, scores.mean(axis=1)


if __name__ == "__main__":
    cli.run(main)
