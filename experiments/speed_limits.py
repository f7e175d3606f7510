"""The limits part of speed_vs_error.py: the arithmetic of a step and of a frame, and the share achieved.

XLA counts the body of a loop once, however often it runs. So a step is counted in one block and without a
look at the grid, and of a frame the rounds in which the field is asked are counted while it is rendered.
"""

import math
import statistics

import jax
import jax.numpy as jnp
import speed_machine
import speed_step

from jaxnerf import pixel_grid
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.models.occupancy import render_with_grid
from jaxnerf.training import build, workdir


def measure(config, folder):
    """Returns seconds, operations, and the share of the machine's matrix product that they come to.

    Args:
        config: of the run whose step is measured.
        folder: of a trained run whose frame is measured, or None.
    """
    speeds = [speed_machine.matrix_gflops()]
    rows = [_step_row(config)] + ([_frame_row(folder)] if folder else [])
    speeds.append(speed_machine.matrix_gflops())
    for row in rows:
        row["gflops"] = row["field_flops"] / row["seconds"] / 1e9
        row["share"] = row["gflops"] / statistics.mean(speeds)
    return {"machine": speed_machine.describe(), "gflops": statistics.mean(speeds), "rows": rows}


def _step_row(config):
    run = speed_step.compiled(config, build.load_views(config.data, "train"))
    rays = config.train.batch_size
    asked = {name: rays * count for name, count in _samples_per_ray(run.config).items()}
    params = run.state.params
    return {
        "what": f"training step of {rays} rays",
        "seconds": speed_step.seconds(run),
        "compiled_flops": run.count_flops(),
        # Forward; then the gradients of what is learned and, but in the first layer, of the input.
        "field_flops": 3 * sum(asked[name] * field_flops(params[name]) for name in asked),
        "samples": sum(asked.values()),
        "sample_flops": {name: field_flops(params[name]) for name in asked},
    }


def _samples_per_ray(config):
    """Returns how often each field is asked in a step, a ray; room in the pool counts as asked."""
    if config.sampler == "occupancy":
        return {"fine": config.occupancy.pool_samples_per_ray}
    coarse, fine = config.sampling.num_coarse, config.sampling.num_fine
    return {"coarse": coarse, "fine": coarse + fine} if fine else {"fine": coarse}


def _frame_row(folder):
    """Returns the row of the first scored view, in the run's own settings."""
    config = workdir.read_config(folder)
    run = restore_run(folder, config)
    weights = run.weights(newest_step(run, folder))
    options, model = run.experiment.eval, run.experiment.model
    views = run.experiment.load_views(options.split)
    height, width = (int(value) for value in views.size[0])
    rays = run.experiment.view_rays(views, 0, pixel_grid(height, width, offset=run.experiment.pixel_offset))
    rays = jax.tree.map(lambda leaf: leaf.reshape(height * width, *leaf.shape[2:]), rays)
    flops = run.render.lower(weights, rays).compile().cost_analysis()["flops"]
    asked = {name: rays.near.size * count for name, count in _samples_per_ray(config).items()}
    if model.grid_schedule is not None:
        max_samples = build.max_samples(config)
        rounds = _rounds(model, weights, rays, options, max_samples)
        one, far = jnp.zeros((1, max_samples, 3)), jnp.ones((1, max_samples, 3))
        scene = jax.jit(lambda params, *places: model.scene(params, weights[1])(*places))
        flops += (rounds - 1) * scene.lower(weights[0], one, far).compile().cost_analysis()["flops"]
        asked = {"fine": rounds * max_samples}
    sample_flops = {name: field_flops(weights[0][name]) for name in asked}
    return {
        "what": f"frame of {width} x {height}, all rays at once",
        "seconds": statistics.median(speed_machine.times(lambda: run.render(weights, rays), 5)),
        "compiled_flops": flops,
        "field_flops": math.fsum(asked[name] * sample_flops[name] for name in asked),
        "samples": sum(asked.values()),
        "sample_flops": sample_flops,
    }


def _rounds(model, weights, rays, options, max_samples):
    """Returns how often the field is asked for a full pool while rays are rendered."""
    params, grid = weights
    rounds, scene, schedule = [], model.scene(params, grid), model.grid_schedule

    def counted(x, viewdirs):
        jax.debug.callback(lambda: rounds.append(1))
        return scene(x, viewdirs)

    sizes = {
        "step": schedule.step_size / options.sample_multiplier,
        "cell": schedule.cell,
        "early_stop_eps": options.early_stop_eps,
    }
    jax.block_until_ready(
        jax.jit(lambda rays: render_with_grid(counted, grid, rays, max_samples=max_samples, **sizes))(rays)
    )
    jax.effects_barrier()
    return len(rounds)


def field_flops(params):
    """Returns the operations of one sample: twice the multiply-adds of its products and interpolations.

    The bottleneck is none of them: it is multiplied with the next layer, once for all samples.
    """
    sizes = [
        leaf.size
        for path, leaf in jax.tree.leaves_with_path(params)
        if leaf.ndim == 2 and not {"table", "bottleneck"} & {part.key for part in path}
    ]
    corners = 8 * params["kernel"].shape[0] if "table" in params else 0
    return 2 * (sum(sizes) + corners)
