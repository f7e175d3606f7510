"""One training step, compiled to be timed, counted and weighed; and the cost part: what it grows with.

In each row of the cost one thing differs from configs/lego_fast.py. What follows from it (sizes that fit the
images, blocks that fit the cache) is left to follow.
"""

import functools
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import speed_machine
from jaxnerf.data.subset import select_views

from jaxnerf.runtime import devices
from jaxnerf.training import build
from jaxnerf.training.auto_config import resolve_sizes
from jaxnerf.training.state import create_state
from jaxnerf.training.step import TrainData, make_train_step

PERIOD = 64  # steps timed together, so that looks at the grid are among them
RAYS, ROOM, FACTORS, VIEWS = (256, 512, 1024, 2048), (0.5, 1, 2), (8, 4, 2), (25, 50, 100)


class Step(NamedTuple):
    """A compiled step and what it needs."""

    config: Any  # without open sizes
    run: Callable[..., tuple]  # (state, data, positions) -> (state, metrics); takes the state's memory
    state: Any
    data: TrainData
    positions: Any
    count_flops: Callable[[], float]


def compiled(config, views):
    """Returns the Step of a configuration on one device."""
    config, _ = resolve_sizes(config, views)
    experiment = build.build(config)
    valid, data = experiment.survey(views)
    state = create_state(experiment.model, experiment.optimizer, experiment.seed, valid)
    step = make_train_step(experiment.model, experiment.optimizer, experiment.draw)
    rays, platform = config.train.batch_size, jax.default_backend()
    block = config.train.microbatch_size or devices.default_microbatch(rays, experiment.samples_per_ray, platform)
    positions = jnp.asarray(devices.split_positions(rays, 1, block)[0])

    def count_flops():
        without_looks = data._replace(cells=None if data.cells is None else data.cells[:0])
        return jax.jit(step).lower(state, without_looks, positions.reshape(1, -1)).compile().cost_analysis()["flops"]

    run = jax.jit(step, donate_argnums=0).lower(state, data, positions).compile()
    return Step(config, run, state, jax.device_put(data), positions, count_flops)


def seconds(step, repeats=3):
    """Returns the seconds of a step from a fresh start, the median of some means over PERIOD."""
    state, taken = jax.tree.map(jnp.copy, step.state), []
    for _ in range(1 + repeats):
        started = time.perf_counter()
        for _ in range(PERIOD):
            state, metrics = step.run(state, step.data, step.positions)
            jax.block_until_ready(metrics)
        taken.append((time.perf_counter() - started) / PERIOD)
    return statistics.median(taken[1:])


def memory(step):
    """Returns the bytes that a step holds at most: arguments, results and what lies between."""
    stats = step.run.memory_analysis()
    held = stats.argument_size_in_bytes + stats.output_size_in_bytes + stats.temp_size_in_bytes
    return held - stats.alias_size_in_bytes  # results that take the place of arguments


def measure(kept, save, config):
    """Measures the step for each size of its work; what is kept is not measured again."""
    kept.setdefault("machine", speed_machine.describe())
    rows = kept.setdefault("rows", [])
    read = functools.cache(lambda factor: build.load_views(_changed(config, {"data.factor": factor}).data, "train"))
    for what, changes, count in _cases(resolve_sizes(config, read(config.data.factor))[0]):
        if any((row["what"], row["changes"], row["views"]) == (what, changes, count) for row in rows):
            continue
        changed = _changed(config, changes)
        views = read(changed.data.factor)
        if count:
            views = select_views(views, np.linspace(0, len(views.offset) - 1, count).round().astype(int))
        step = compiled(changed, views)
        value = {
            "rays": changed.train.batch_size,
            "samples a ray": changed.occupancy.pool_samples_per_ray,
            "pixels a view": int(np.prod(views.size[0])),
            "views": len(views.offset),
        }[what]
        measured = {"value": value, "seconds": seconds(step), "bytes": memory(step)}
        rows.append({"what": what, "changes": changes, "views": count, **measured})
        save(kept)
        print(f"{what} {value}: {1e3 * measured['seconds']:.1f} ms", flush=True)


def _cases(fitted):
    """Yields what is varied, the changes of the configuration, and how many views (0: all)."""
    for rays in RAYS:
        yield "rays", {"train.batch_size": rays}, 0
    for share in ROOM:
        schedule = {
            "samples_per_ray": share * fitted.occupancy.pool_samples_per_ray,
            "step": fitted.occupancy.step_size / share,
        }
        yield "samples a ray", {f"space.{key}": value for key, value in schedule.items()}, 0
    for factor in FACTORS:
        yield "pixels a view", {"data.factor": factor}, 0
    for count in VIEWS:
        yield "views", {}, count


def _changed(config, changes):
    config = config.copy_and_resolve_references()
    with config.ignore_type():
        config.update_from_flattened_dict(changes)
    return config
