"""The parts "cost" and "limits" of speed_vs_error.py: what the time of a step grows with, and how near it is to peak.

In each row of the cost one setting differs from configs/lego_fast.py; sizes that are inferred follow from it. The
limits compare the arithmetic of a step and of a frame with the machine's matrix product. XLA counts the body of a
loop once, however often it runs. So a step is counted as one microbatch and without an update of the grid, and the
rounds in which a frame evaluates the field are counted while it is rendered.
"""

import functools
import math
import statistics
from collections.abc import Callable
from typing import Any

import common
import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf import pixel_grid
from jaxnerf.data.view_selection import select_views
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.models.occupancy import render_with_grid
from jaxnerf.training import auto_config
from jaxnerf.training.workdir import load_config

PERIOD = 64  # steps timed together, so that updates of the grid are among them
RAYS, BUFFERS, FACTORS, VIEWS = (256, 512, 1024, 2048), (0.5, 1, 2), (8, 4, 2), (25, 50, 100)


def measure_cost(kept: dict[str, Any], save: Callable[[dict], None], config) -> None:
    """Measures the step of a config for each size of its work; kept rows are not measured again."""
    kept.setdefault("machine", common.describe_machine())
    rows = kept.setdefault("rows", [])
    resolved, _, _ = auto_config.resolve(config, common.load_split(config, "train"))
    for what, changes, count in _cases(resolved):
        if any((row["what"], row["changes"], row["views"]) == (what, changes, count) for row in rows):
            continue
        changed = common.changed(config, changes)
        views = common.load_split(changed, "train")
        if count:
            views = select_views(views, np.linspace(0, len(views.offset) - 1, count).round().astype(int))
        step = common.compile_step(changed, views)
        value = {
            "rays": changed.train.batch_size,
            "samples a ray": changed.occupancy.pool_samples_per_ray,
            "pixels a view": int(np.prod(views.size[0])),
            "views": len(views.offset),
        }[what]
        measured = {"value": value, "seconds": step_seconds(step), "bytes": _memory(step)}
        rows.append({"what": what, "changes": changes, "views": count, **measured})
        save(kept)
        print(f"{what} {value}: {1e3 * measured['seconds']:.1f} ms", flush=True)


def _cases(resolved):
    """Yields what varies, the changes of the config, and the number of views (0: all)."""
    for rays in RAYS:
        yield "rays", {"train.batch_size": rays}, 0
    for ratio in BUFFERS:
        changes = {
            "occupancy.pool_samples_per_ray": ratio * resolved.occupancy.pool_samples_per_ray,
            "occupancy.step_size": resolved.occupancy.step_size / ratio,
        }
        yield "samples a ray", changes, 0
    for factor in FACTORS:
        yield "pixels a view", {"data.factor": factor}, 0
    for count in VIEWS:
        yield "views", {}, count


def step_seconds(step: common.Step, repeats: int = 3) -> float:
    """Returns the seconds of a step from the initial state, the median of means over PERIOD steps."""
    state = jax.tree.map(jnp.copy, step.state)

    def period():
        nonlocal state
        for _ in range(PERIOD):
            state, metrics = step.run(state, step.data, step.positions)
            jax.block_until_ready(metrics)

    return statistics.median(common.times(period, repeats)) / PERIOD


def _memory(step):
    """Returns the bytes that a step holds at most: arguments, results and temporaries."""
    stats = step.run.memory_analysis()
    held = stats.argument_size_in_bytes + stats.output_size_in_bytes + stats.temp_size_in_bytes
    return held - stats.alias_size_in_bytes  # results that replace arguments


def measure_limits(config, folder: str | None) -> dict[str, Any]:
    """Returns seconds, FLOPs, and the fraction of the machine's matrix product that they amount to.

    Args:
        config: of the run whose step is measured.
        folder: of a trained run whose frame is measured, or None.
    """
    speeds = [common.matrix_gflops()]
    rows = [_step_row(config)] + ([_frame_row(folder)] if folder else [])
    speeds.append(common.matrix_gflops())
    for row in rows:
        row["gflops"] = row["field_flops"] / row["seconds"] / 1e9
        row["fraction"] = row["gflops"] / statistics.mean(speeds)
    return {"machine": common.describe_machine(), "gflops": statistics.mean(speeds), "rows": rows}


def _step_row(config):
    step = common.compile_step(config)
    rays, params = step.config.train.batch_size, step.state.params
    counts = {name: rays * count for name, count in _samples_per_ray(step.config).items()}
    return {
        "what": f"training step of {rays} rays",
        "seconds": step_seconds(step),
        "compiled_flops": step.count_flops(),
        # Forward; then the gradients of the parameters and, except in the first layer, of the input.
        "field_flops": 3 * sum(counts[name] * field_flops(params[name]) for name in counts),
        "samples": sum(counts.values()),
        "sample_flops": {name: field_flops(params[name]) for name in counts},
    }


def _samples_per_ray(config):
    """Returns how often a step evaluates each field per ray; unused places of the buffer count, too."""
    if config.sampler == "occupancy":
        return {"fine": config.occupancy.pool_samples_per_ray}
    coarse, fine = config.sampling.num_coarse, config.sampling.num_fine
    return {"coarse": coarse, "fine": coarse + fine} if fine else {"fine": coarse}


def _frame_row(folder):
    """Returns the row of the first scored view, in the run's own settings."""
    run = restore_run(folder)
    variables = run.variables(newest_step(run, folder))
    options, model = run.experiment.config.eval, run.experiment.model
    views = run.experiment.load_split(options.split)
    height, width = (int(value) for value in views.size[0])
    rays = run.experiment.view_rays(views, 0, pixel_grid(height, width, offset=run.experiment.config.data.pixel_offset))
    rays = jax.tree.map(lambda leaf: leaf.reshape(height * width, *leaf.shape[2:]), rays)
    flops = run.render.lower(variables, rays).compile().cost_analysis()["flops"]
    counts = {name: rays.near.size * count for name, count in _samples_per_ray(load_config(folder)).items()}
    if model.grid_schedule is not None:
        rounds, size = _rounds(model, variables, rays, options), options.max_samples
        scene = jax.jit(lambda params, *places: model.scene(params, variables[1])(*places))
        places = jnp.zeros((1, size, 3)), jnp.ones((1, size, 3))
        flops += (rounds - 1) * scene.lower(variables[0], *places).compile().cost_analysis()["flops"]
        counts = {"fine": rounds * size}
    sample_flops = {name: field_flops(variables[0][name]) for name in counts}
    return {
        "what": f"frame of {width} x {height}, all rays at once",
        "seconds": statistics.median(common.times(lambda: run.render(variables, rays), 5)),
        "compiled_flops": flops,
        "field_flops": math.fsum(counts[name] * sample_flops[name] for name in counts),
        "samples": sum(counts.values()),
        "sample_flops": sample_flops,
    }


def _rounds(model, variables, rays, options):
    """Returns how often the field is evaluated for a full buffer while rays are rendered."""
    params, grid = variables
    rounds, scene, schedule = [], model.scene(params, grid), model.grid_schedule

    def counted(x, viewdirs):
        jax.debug.callback(lambda: rounds.append(1))
        return scene(x, viewdirs)

    render = functools.partial(
        render_with_grid,
        counted,
        grid,
        step_size=schedule.step_size / options.sample_multiplier,
        cell=schedule.cell,
        early_stop_eps=options.early_stop_eps,
        max_samples=options.max_samples,
    )
    jax.block_until_ready(jax.jit(render)(rays))
    jax.effects_barrier()
    return len(rounds)


def field_flops(params) -> int:
    """Returns the FLOPs of one sample: twice the multiply-adds of its matrix products and interpolations.

    The bottleneck is not among them: it is multiplied with the next layer once for all samples.
    """
    sizes = [
        leaf.size
        for path, leaf in jax.tree.leaves_with_path(params)
        if leaf.ndim == 2 and not {"table", "bottleneck"} & {part.key for part in path}
    ]
    corners = 8 * params["kernel"].shape[0] if "table" in params else 0
    return 2 * (sum(sizes) + corners)
