"""What a training step of each variant costs: operations as the compiler counts them, and time in turn."""

import statistics
import time

import jax
import speed_machine
import speed_step
from ablation_variants import COMPLETE
from jaxnerf.data.subset import evenly, select_views

from jaxnerf.training import build

_ROUNDS, _STEPS = 7, 8  # of timings of all variants in turn; steps timed together


def load_views(config):
    """Returns the training views of a scene."""
    return build.load_views(config.data, "train")


def measure(kept, configs, views):
    """Adds to kept["cost"] what training costs each variant {name: config}, the complete one among them.

    "flops": of the compiled step, by ray. "time": its time over that of the complete model, the median over
    rounds in which each was timed once, so that a machine with other work counts for less. "ms": of a step.
    """
    if kept.get("cost", {}).keys() >= configs.keys():
        return
    kept["machine"] = speed_machine.describe()
    steps = {name: _compiled(config, views) for name, config in configs.items()}
    rounds = [{name: _seconds(step) for name, step in steps.items()} for _ in range(1 + _ROUNDS)][1:]
    for name, step in steps.items():
        cost = {"flops": flops_per_ray(step), "ms": 1e3 * statistics.median(row[name] for row in rounds)}
        cost["time"] = statistics.median(row[name] / row[COMPLETE] for row in rounds)
        kept.setdefault("cost", {})[name] = cost


def flops_per_ray(step):
    """Returns the floating point operations of a compiled speed_step.Step, by ray of its batch."""
    # The compiler counts the body of a loop over blocks once.
    whole = step.positions.shape[0] == 1
    return (step.run.cost_analysis()["flops"] if whole else step.count_flops()) / step.positions.size


def steps_in(config, views, seconds):
    """Returns how many steps a configuration takes in so much training, at least 1."""
    step = _compiled(config, views)
    return max(int(seconds / min(_seconds(step) for _ in range(4))), 1)


def _compiled(config, views):
    if config.data.num_views:
        indices = evenly("data.num_views", len(views.offset), config.data.num_views)
        views = select_views(views, indices)
    return speed_step.compiled(config, views)


def _seconds(step):
    """Returns the seconds of a step, the mean over a few from its first state."""
    state = jax.tree.map(jax.numpy.copy, step.state)
    jax.block_until_ready(state)
    started = time.perf_counter()
    for _ in range(_STEPS):
        state, metrics = step.run(state, step.data, step.positions)
    jax.block_until_ready(metrics)
    return (time.perf_counter() - started) / _STEPS
