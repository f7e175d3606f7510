"""Shows what the time of a frame of a trained run with an occupancy grid is spent on, and which samples it needs.

    JAXNERF_SCENES=... taskset -c 0 python experiments/speed/frame_parts.py --workdir=RUN [--split=test] [--view=4] \
        [--page=FILE.md]

Measured are one chunk of the view's rays, spread over the image: all of it; the marching that finds the samples in
occupied cells; and the field at the samples that are reached. A sample is reached if the transmittance in front of it
is above `eval.early_stop_eps`; the others of a ray are not evaluated. With --page the table between
<!-- frame parts --> and <!-- end of frame parts --> in that file is replaced.
"""

import pathlib
import statistics
import sys
import time

import jax
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.occupancy.packed import _occupied_words, render_packed
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.core.rendering import points_on_rays
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.fields.base import field_scene
from jaxnerf.runtime import cli

HEADS = ("what", "found")
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of a run with an occupancy grid.", required=True)
_SPLIT = flags.DEFINE_string("split", "test", "Split of the view.")
_VIEW = flags.DEFINE_integer("view", 4, "Index of the view.", lower_bound=0)
_REPEATS = 9
_MOST_SAMPLES = 2**20  # of a chunk, all in one buffer
_WEIGHTS = (1 / 2550, 1 / 255, 0.01)  # of samples that are counted


def main(argv: list[str]) -> None:
    """Measures the parts and prints the table."""
    del argv
    run = restore_run(_WORKDIR.value)
    if run.experiment.model.grid_schedule is None:
        raise ValueError(f"{_WORKDIR.value}: was trained without an occupancy grid; give a run with one")
    variables = run.variables(newest_step(run, _WORKDIR.value))
    views = run.experiment.load_split(_SPLIT.value)
    if _VIEW.value >= len(views.offset):
        raise ValueError(f"--view={_VIEW.value}: the split {_SPLIT.value!r} has {len(views.offset)} views")
    rays, whole = chunk_of(run, views, _VIEW.value)
    rows = measure(run, variables, rays, whole)
    common.publish([*common.provenance(), "", *common.markdown(HEADS, rows)], "frame parts")


def chunk_of(run, views, index):
    """Returns Rays [chunk] of a view, evenly spread over its image, and the number of all of its rays."""
    height, width = (int(side) for side in views.size[index])
    pixels = pixel_grid(height, width, offset=run.experiment.config.data.pixel_offset)
    rays = run.experiment.view_rays(views, index, pixels)
    number = min(run.experiment.config.eval.chunk, height * width)
    chosen = np.arange(number) * (height * width) // number
    return jax.tree.map(lambda leaf: leaf.reshape(height * width, *leaf.shape[2:])[chosen], rays), height * width


def measure(run, variables, rays, whole):
    """Returns rows with the CPU time of a chunk and of its parts, and with what samples it has."""
    options, field = run.experiment.config.eval, run.experiment.model.fields["fine"]

    @jax.jit
    def find(variables, rays):
        scene, grid = field_scene(field, variables[0]), variables[1]
        return render_packed(scene, grid, rays, _samples(run, grid, rays), max_samples=_MOST_SAMPLES).samples

    @jax.jit
    def march(grid, rays):
        return _occupied_words(grid, rays, _samples(run, grid, rays))

    @jax.jit
    def evaluate(params, x, viewdirs):
        return jax.lax.map(lambda at: field_scene(field, params)(*at), (x, viewdirs))

    packed = jax.device_get(find(variables, rays))
    t, ray, weights = (values[packed.used] for values in (packed.t, packed.ray_index, packed.weights.astype(float)))
    ends, first = np.cumsum(weights), np.flatnonzero(np.diff(ray, prepend=-1))
    starts = np.repeat(ends[first] - weights[first], np.diff(first, append=len(ray)))
    reached = 1 - (ends - weights - starts) > options.early_stop_eps
    each = jax.tree.map(lambda leaf: leaf[ray[reached]], rays)
    places = points_on_rays(each, t[reached][:, None]), each.viewdirs[:, None]
    whole_rounds = reached.sum() // options.max_samples * options.max_samples
    places = [leaf[:whole_rounds].reshape(-1, options.max_samples, 1, 3) for leaf in places]
    calls = {
        f"a chunk of {rays.near.size:,} rays of {whole:,}": lambda: run.render(variables, rays),
        "of it marching": lambda: march(variables[1], rays),
        f"of it the field, {options.max_samples:,} samples at a time": lambda: evaluate(variables[0], *places),
    }
    return [
        *((name, f"{1e3 * cpu_seconds(call):.1f} ms of CPU") for name, call in calls.items()),
        ("samples in occupied cells, per ray", f"{len(ray) / rays.near.size:.1f}"),
        ("of them reached, per ray", f"{reached.sum() / rays.near.size:.1f}"),
        *((f"of these with a weight above {w:.2g}", f"{(weights[reached] > w).mean():.3f}") for w in _WEIGHTS),
    ]


def cpu_seconds(call) -> float:
    """Returns the median CPU time of repeated calls, after one that may compile: other programs add little to it."""
    jax.block_until_ready(call())
    found = []
    for _ in range(_REPEATS):
        started = time.process_time()
        jax.block_until_ready(call())
        found.append(time.process_time() - started)
    return statistics.median(found)


def _samples(run, grid, rays):
    schedule, multiplier = run.experiment.model.grid_schedule, run.experiment.config.eval.sample_multiplier
    return march_rays(None, grid, rays, step_size=schedule.step_size / multiplier, cell=schedule.cell)


if __name__ == "__main__":
    cli.run(main, stopped="and wrote nothing")
