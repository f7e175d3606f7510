"""Measures what a baked occupancy grid gains for a run that was trained without one, and what it loses.

    JAXNERF_SCENES=... taskset -c 0 python experiments/speed/bake_occupancy.py --workdir=runs/lego_small \
        [--settings=sample_multiplier/early_stop_eps/chunk/max_samples,...] [--split=train] [--page=FILE.md]

Renders views of a split along whole rays, as `jaxnerf.eval` does without flags, and with each of the settings, view
by view, so that other load on the machine slows all of them alike. Choose settings on the training views; score the
choice with --split=test. With --page the table replaces what lies between <!-- skipping --> and
<!-- end of skipping --> in that file.
"""

import functools
import pathlib
import statistics
import sys

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf import pixel_grid, psnr
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.runtime import cli

HEADS = ("sample_multiplier", "early_stop_eps", "chunk", "max_samples", "s a frame", "times faster", "PSNR")
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of a run that was trained without a grid.", required=True)
_SETTINGS = flags.DEFINE_list(
    "settings",
    ["1/0.001/4096/auto", "0.43/0.1/4096/auto", "0.43/0.1/6144/256"],
    "Settings to compare: sample_multiplier, early_stop_eps, chunk and max_samples of each.",
)
_SPLIT = flags.DEFINE_string("split", "train", "Split that the views are taken from.")
_VIEWS = flags.DEFINE_integer("views", 9, "Number of views, spread evenly over the split.", lower_bound=1)
_REPEATS = flags.DEFINE_integer("repeats", 5, "Renderings of each view.", lower_bound=1)


def main(argv: list[str]) -> None:
    """Measures all settings and prints the table."""
    del argv
    folder, settings = _WORKDIR.value, [parse(setting) for setting in _SETTINGS.value]
    run = restore_run(folder)
    if run.experiment.model.grid_schedule is not None:
        raise ValueError(f"{folder}: was trained with a grid, expected a run with the sampler 'hierarchical'")
    step = newest_step(run, folder)
    renderers, variables = [_renderer(run, run.variables(step), run.experiment.config.eval.chunk)], None
    for setting in settings:
        baked = restore_run(folder, settings={"bake_occupancy": True} | setting)
        variables = variables or baked.variables(step)  # the grid is the same with all settings
        renderers.append(_renderer(baked, variables, setting["chunk"]))
    views = run.experiment.load_split(_SPLIT.value)
    chosen = np.unique(np.linspace(0, len(views.offset) - 1, _VIEWS.value).astype(int))
    gflops = common.matrix_gflops()
    seconds, scores = _measure(run, views, chosen, renderers)
    rows = [
        _row(setting, *each)
        for setting, *each in zip(settings, seconds[1:], seconds[0] / seconds[1:], scores[1:], strict=True)
    ]
    lines = [
        f"{len(chosen)} views of {_SPLIT.value!r} of {folder} (step {step}), each {_REPEATS.value} times; "
        f"{common.describe_machine()}, matrix product {gflops:.0f} and {common.matrix_gflops():.0f} "
        f"GFLOP/s. Along whole rays {statistics.median(seconds[0]):.3f} s a frame and {scores[0]:.2f} dB. "
        "Medians, and the range of the views.",
        "",
        *common.markdown(HEADS, rows),
    ]
    common.publish(lines, "skipping")


def _row(setting, seconds, faster, score):
    """Returns the cells of a setting, from the seconds [V] of its views, how much faster [V], and PSNR."""
    return (
        *map(str, setting.values()),
        f"{statistics.median(seconds):.4f}",
        f"{statistics.median(faster):.1f} ({min(faster):.1f} to {max(faster):.1f})",
        f"{score:.2f} dB",
    )


def parse(setting: str) -> dict[str, float | int | str]:
    """Returns the fields of the config's section eval that a setting gives."""

    def count(value):
        return value if value == "auto" else int(value)

    kinds = {"sample_multiplier": float, "early_stop_eps": float, "chunk": int, "max_samples": count}
    try:
        pairs = zip(kinds.items(), setting.split("/"), strict=True)
        return {name: kind(value) for (name, kind), value in pairs}
    except ValueError as error:
        raise ValueError(f"--settings contains {setting!r}, expected numbers as {'/'.join(kinds)}") from error


def _renderer(run, variables, chunk):
    """Returns rays [H, W] -> image [H, W, 3]."""
    return lambda rays: np.asarray(run.render_image(variables, rays, chunk=chunk).rgb)


def _measure(run, views, chosen, renderers):
    """Returns the seconds of each renderer and view [R, V], and the mean PSNR of each renderer [R]."""
    seconds, scores = np.zeros((2, len(renderers), len(chosen)))
    for place, index in enumerate(chosen):
        pixels = pixel_grid(*np.asarray(views.size[index]).tolist(), offset=run.experiment.config.data.pixel_offset)
        rays = jax.block_until_ready(run.experiment.view_rays(views, index, pixels.astype(jnp.float32)))
        truth = np.asarray(views.image(index))
        for number, render in enumerate(renderers):
            scores[number, place] = psnr(render(rays), truth)  # compiles, too
            taken = common.times(functools.partial(render, rays), _REPEATS.value)
            seconds[number, place] = statistics.median(taken)
    return seconds, scores.mean(axis=1)


if __name__ == "__main__":
    cli.run(main)
