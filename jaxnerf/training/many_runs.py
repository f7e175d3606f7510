"""Many runs in one program: the states of runs that differ in seed or scene, and the function that advances all.

A training step is a pure function of state and data, so `jax.vmap` makes one of many runs from it. All runs are at the
same step, which therefore has no axis of runs: branches that depend on the step alone, as the updates of the occupancy
grid do, stay branches under vmap instead of computing both sides.

On a CPU, the compiled step of one run is called for each run in turn. A step of one run already fills a core, and vmap
was slower there for small batches of both fields; each result then also equals that of the run alone, bit for bit.
experiments/many_runs/many_runs.py compares the time with that of the runs one after another.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf.training.state import TrainState
from jaxnerf.training.step import TrainData


def runs_in_turn() -> bool:
    """Returns whether this device computes a step of one run after the other, rather than of all at once."""
    return jax.devices()[0].platform == "cpu"


def stack_states(states: Sequence[TrainState]) -> TrainState:
    """Stacks the TrainStates of runs at the same step: each leaf is [M, ...], but the step stays []."""
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    return dataclasses.replace(stacked, step=states[0].step)


def state_of(states: TrainState | tuple[TrainState, ...], index: int) -> TrainState:
    """Returns the TrainState of one run, of stacked states or of a tuple of states."""
    if isinstance(states, tuple):
        return states[index]
    stacked = dataclasses.replace(states, step=None)
    return dataclasses.replace(jax.tree.map(lambda leaf: leaf[index], stacked), step=states.step)


def metrics_of(metrics: Any, index: int) -> Any:
    """Returns the metrics of one run, of stacked metrics [..., M] or of a tuple of metrics."""
    if isinstance(metrics, tuple):
        return metrics[index]
    return jax.tree.map(lambda leaf: leaf[..., index], metrics)


def stack_data(data: Sequence[Any], names: Sequence[str]) -> tuple[Any, list[bool]]:
    """Stacks what the steps of runs read; a leaf that is the same array in all runs is kept once.

    Args:
        data: TrainData of each run, or another pytree.
        names: of the runs, for the message.

    Returns:
        TrainData, and whether each of its leaves has an axis of runs.

    Raises:
        ValueError: if the arrays of two runs have different shapes; names them.
    """
    first = data[0]
    known = dict(jax.tree.leaves_with_path(first))
    for name, other in zip(names[1:], data[1:], strict=True):
        leaves = dict(jax.tree.leaves_with_path(other))
        for path in [*known, *leaves]:
            found, expected = (np.shape(part[path]) if path in part else None for part in (leaves, known))
            if found != expected:
                raise ValueError(
                    f"{name}: {jax.tree_util.keystr(path)} of its data has the shape {found}, expected {expected} as "
                    f"in {names[0]}: the runs of one program need as many images, of the same sizes, and grids with "
                    "as many valid cells; set scene.use_alpha to False and occupancy.min_views to 0, which makes "
                    "all cells valid, or train the run alone"
                )
    columns = list(zip(*map(jax.tree.leaves, data), strict=True))
    own = [not all(_is_same(leaf, column[0]) for leaf in column) for column in columns]
    leaves = [np.stack(column) if is_own else column[0] for column, is_own in zip(columns, own, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(first), leaves), own


def step_of_all(train_step: Callable[..., tuple], own: Sequence[bool]) -> Callable[..., tuple]:
    """Makes the training step of many runs from that of one, by `jax.vmap`.

    Args:
        train_step: see `make_train_step`.
        own: see `stack_data`.

    Returns:
        The function with the arguments of train_step, for the stacked state and data. Its metrics are [M].
    """

    def all_runs(state, data, positions, **options):
        leaves, treedef = jax.tree.flatten(data)

        def one(part, taken):
            given = _merged(leaves, taken, own)
            part = dataclasses.replace(part, step=state.step)
            after, metrics = train_step(part, jax.tree.unflatten(treedef, given), positions, **options)
            return dataclasses.replace(after, step=None), metrics

        after, metrics = jax.vmap(one)(dataclasses.replace(state, step=None), taken_leaves(data, own))
        return dataclasses.replace(after, step=state.step + 1), metrics

    return all_runs


def taken_leaves(data: TrainData, own: Sequence[bool]) -> list[Any]:
    """Returns the leaves of a run's data that are its own, see `stack_data`."""
    return [leaf for leaf, is_own in zip(jax.tree.leaves(data), own, strict=True) if is_own]


def in_turn(run: Callable[..., tuple], taken: Sequence[list[Any]], own: Sequence[bool]) -> Callable[..., tuple]:
    """Makes the function that takes a step of each run, one after the other, with the compiled step of one.

    Args:
        run: (state, data) -> (state, metrics).
        taken: of each run, see `taken_leaves`; the other leaves are those of the data that the function receives.
        own: see `stack_data`.

    Returns:
        (states, data) -> (states, metrics), of tuples.
    """

    def all_runs(states, data):
        leaves, treedef = jax.tree.flatten(data)
        given = (jax.tree.unflatten(treedef, _merged(leaves, each, own)) for each in taken)
        return tuple(zip(*map(run, states, given), strict=True))

    return all_runs


def _merged(leaves, taken, own):
    """Returns the leaves with those that are a run's own replaced by the next one taken."""
    taken = iter(taken)
    return [next(taken) if is_own else leaf for leaf, is_own in zip(leaves, own, strict=True)]


def _is_same(a, b):
    """Returns whether two leaves are one array, or equal numbers; large arrays are not compared."""
    return a is b or (np.size(a) == 1 and np.array_equal(a, b))
