"""Checkpoints: complete or absent, verified by a fingerprint, the last few kept (orbax v1)."""

import contextlib
import functools
import os
import pathlib
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np
from orbax.checkpoint import v1 as ocp

from jaxnerf.runtime import atomic_files, processes
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.training.optimizer import image_params
from jaxnerf.training.state import PROGRESS, TrainState

_WHOLE, _RENDERED = "fingerprint", "fingerprint_of_rendered"  # in the metadata of a checkpoint
_SMALL = 2**25  # bytes of a state that is copied at once


class Checkpoints:
    """The checkpoints in a workdir, one folder per step."""

    def __init__(self, workdir: str | os.PathLike, *, max_to_keep: int | None = None):
        """Opens the folder; max_to_keep: how many of the newest to keep, None for reading only."""
        atomic_files.check_utf8(workdir)
        self._folder = pathlib.Path(workdir).absolute() / "checkpoints"
        policies = ocp.training.preservation_policies
        self._preservation = policies.LatestN(max_to_keep) if max_to_keep else None
        self._writer = None

    def steps(self) -> list[int]:
        """Returns the steps of all finished checkpoints, ascending."""
        if not self._folder.is_dir():
            return []
        names = (path.name for path in self._folder.iterdir() if path.is_dir())
        steps = {int(name): name for name in names if name.isascii() and name.isdigit()}
        return sorted(step for step, name in steps.items() if name == str(step) and step < 2**31)

    def save(self, state: TrainState) -> None:
        """Writes the state under its step unless it is there, and returns when it is on the disk.

        Raises:
            ValueError: if it cannot be written.
        """
        step = int(state.step)
        if step not in self.steps():
            try:
                _silence_orbax()
                with _one_array_at_a_time(state):
                    fingerprints = {_WHOLE: _fingerprint(state), _RENDERED: _fingerprint(_rendered(state))}
                    self._open().save(step, state, force=True, custom_metadata=fingerprints)
            except Exception as error:  # orbax raises many kinds
                raise ValueError(
                    f"{self._folder / str(step)}: cannot be written ({_reason(error)}); free disk space and "
                    "start again, which continues from the previous checkpoint"
                ) from error

    def load(self, step: int, like: TrainState) -> TrainState:
        """Returns the state at a step, with the shapes and shardings of `like`, which may be one of ShapeDtypeStruct.

        Raises:
            ValueError: if the checkpoint does not fit, or is not what was saved; names it.
        """
        with self._reading(step) as saved:
            shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding), like)
            state = self._open().load(step, shapes)
            _check(step, state.step, state, saved[_WHOLE])
            return state

    def load_rendered(
        self, step: int, like: tuple[dict[str, Any], Any], *, averaged: bool
    ) -> tuple[dict[str, Any], Any]:
        """Returns what renders images at a step, `image_params` and the grid, and does not read the rest of the state.

        Args:
            step: of the checkpoint.
            like: the shapes of the result, see `rendered_shapes`.
            averaged: whether training has averaged the parameters, see `with_averaging`.

        Raises:
            ValueError: as `load`.
        """
        (params, grid), step_shape = like, jax.ShapeDtypeStruct((), np.int32)
        networks = {name: part for name, part in params.items() if name != PROGRESS}
        part = {"step": step_shape, **({"opt_state": {"average": networks}} if averaged else {"params": networks})}
        part |= {"counters": {PROGRESS: params[PROGRESS]}} if PROGRESS in params else {}
        part |= {} if grid is None else {"grid": grid}
        device, context = jax.sharding.SingleDeviceSharding(jax.local_devices()[0]), ocp.Context()
        context.pytree.loading.partial_load = True
        with self._reading(step) as saved, context:
            part = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=device), part)
            state = self._open().load(step, part)
            params = state["opt_state"]["average"] if averaged else state["params"]
            rendered = {**params, **state.get("counters", {})}, state.get("grid")
            _check(step, state["step"], rendered, saved[_RENDERED])
            return rendered

    @contextlib.contextmanager
    def _reading(self, step) -> Iterator[dict[str, str]]:
        """Yields the fingerprints of a checkpoint; an error while it is read becomes a ValueError."""
        _silence_orbax()
        try:
            self._open().reload()  # another process may have written it since
            metadata = atomic_files.read_json(self._folder / str(step) / "_CHECKPOINT_METADATA", "it was changed")
            yield metadata["custom_metadata"]
        except Exception as error:  # orbax raises many kinds
            if isinstance(_cause(error), KeyboardInterrupt):
                raise _cause(error) from None
            raise ValueError(
                f"{self._folder / str(step)}: cannot be read as this model's state ({_reason(error)}); "
                "remove it to continue from the previous checkpoint"
            ) from error

    def load_newest(self, like: TrainState) -> tuple[TrainState, Sequence[str]]:
        """Returns the newest state that can be read, or `like` if there is none; and lines about the others.

        Newer checkpoints that cannot be read are renamed, never removed. If none can be read, the cause is more
        likely the program than the disk, and training from step 0 would discard the run.

        Raises:
            ValueError: if there are checkpoints and none can be read; names the newest.
        """
        failed = []
        for step in self._newest_steps():
            state, problem = None, None
            try:
                state = self.load(step, like)
            except ValueError as error:
                problem = error
            if not processes.any_of(problem is not None):
                return state, [self._set_aside(*each) for each in failed]
            failed.append((step, problem or ValueError("another process cannot read it")))
        if failed:
            raise failed[0][1]
        return like, []

    def _newest_steps(self):
        """Returns the steps of the newest 16 checkpoints, descending, as the first process sees them."""
        steps = self.steps()[::-1][:16]
        padded = processes.broadcast(np.int32(steps + [-1] * (16 - len(steps))))
        return [int(step) for step in padded if step >= 0]

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()

    def _open(self):
        if self._writer is None:
            atomic_files.check_tree(self._folder, links=True)  # tensorstore would wait for a pipe without end
            # Opened late, because this creates the folder, which a reader must not do. Only the process that
            # writes may remove an unfinished checkpoint: it knows that a killed process left it.
            self._writer = ocp.training.Checkpointer(
                self._folder,
                preservation_policy=self._preservation,
                cleanup_tmp_directories=self._preservation is not None,
                lightweight_initialize=True,  # otherwise a damaged checkpoint prevents reading the others
            )
        return self._writer

    def _set_aside(self, step, error):
        path, number = self._folder / f"{step}.unreadable", 1
        while path.exists():
            path, number = self._folder / f"{step}.unreadable-{number + 1}", number + 1
        processes.barrier()
        if processes.is_first():
            os.replace(self._folder / str(step), path)
        processes.barrier()
        self._writer.reload()  # otherwise it still lists the renamed one
        why = str(error).removesuffix("; remove it to continue from the previous checkpoint")
        return f"{why}; kept as {path.name}, continuing from the previous checkpoint"


def _rendered(state):
    return image_params(state), state.grid


def _fingerprint(tree):
    return fingerprint(jax.tree.map(np.asarray, tree))


def _check(step, found, read, saved):
    """Raises a ValueError if what was read is not what was saved; orbax does not detect changed numbers."""
    if _fingerprint(read) != saved:
        raise ValueError("its numbers are not those that were saved")
    if int(found) != step:
        raise ValueError(f"it holds step {int(found)}")


def _one_array_at_a_time(state):
    """Returns the context in which orbax has copies of arrays of no more bytes than the largest one has.

    A small state is written at once, as one array after another takes a third more of the disk.
    """
    sizes = [leaf.nbytes for leaf in jax.tree.leaves(state)]
    if sum(sizes) <= _SMALL:
        return contextlib.nullcontext()
    context = ocp.Context()
    context.memory.write_concurrent_bytes = 1 + max(sizes)  # strictly less than this
    return context


@functools.cache
def _silence_orbax():
    """Hides what orbax's pending readers and writers print after another of them has failed."""
    before = sys.unraisablehook

    def hook(unraisable):
        if str(unraisable.exc_value) != "Event loop is closed":
            before(unraisable)

    sys.unraisablehook = hook


def _cause(error):
    """Returns the first error of orbax's chain, which says what went wrong."""
    while error.__cause__ is not None:
        error = error.__cause__
    return error


def _reason(error):
    error = _cause(error)
    return (str(error).splitlines() or [type(error).__name__])[0][:400]
