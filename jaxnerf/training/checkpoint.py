"""Checkpoints: whole or not there, checked by a sum, the last few kept (orbax v1)."""

import dataclasses
import functools
import json
import os
import pathlib
import sys
import zlib

import jax
import numpy as np
from orbax.checkpoint import v1 as ocp

from jaxnerf.runtime import processes


class Checkpoints:
    """The checkpoints under a workdir, step by step."""

    def __init__(self, workdir, *, max_to_keep=None):
        """Opens the folder; max_to_keep: how many of the newest stay, None for reading only."""
        self._folder = pathlib.Path(workdir).absolute() / "checkpoints"
        policies = ocp.training.preservation_policies
        self._preservation = policies.LatestN(max_to_keep) if max_to_keep else None
        self._writer = None

    def steps(self):
        """Returns the steps of all finished checkpoints, ascending."""
        if not self._folder.is_dir():
            return []
        names = (path.name for path in self._folder.iterdir() if path.is_dir())
        return sorted(int(name) for name in names if name.isdigit())

    def save(self, state):
        """Writes the state under its step and returns when it is on the disk; once a step only."""
        step = int(state.step)
        if step not in self.steps():
            try:
                _hush()
                self._open().save(step, state, force=True, custom_metadata={"crc32": _sum(state)})
            except Exception as error:  # orbax raises many kinds
                raise ValueError(
                    f"{self._folder / str(step)}: cannot be written ({_reason(error)}); make room and start "
                    "again, which goes on from the one before"
                ) from error

    def load(self, step, like):
        """Returns the state at a step, shaped and placed as like; counters newer than it are those of like.

        Raises:
            ValueError: if the checkpoint does not fit, or is not what was saved; names it.
        """
        abstract = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding), like)
        _hush()
        try:
            self._open().reload()  # another process may have written it since
            saved = self._open().metadata(step).metadata["counters"]
            known = {name: counter for name, counter in abstract.counters.items() if name in saved}
            state = self._open().load(step, dataclasses.replace(abstract, counters=known))
            self._check_sum(step, state)
            return dataclasses.replace(state, counters={**like.counters, **state.counters})
        except Exception as error:  # orbax raises many kinds
            raise ValueError(
                f"{self._folder / str(step)}: cannot be read as this model's state ({_reason(error)}); "
                "remove it to go on from the one before"
            ) from error

    def load_newest(self, like):
        """Returns the state of the newest checkpoint that can be read, or like; and lines on the others.

        Those that are newer and cannot be read are renamed, never removed. Where none can be read, the
        fault is more likely ours than the disk's, and starting anew would waste the run.

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
        padded = processes.from_first(np.int32(steps + [-1] * (16 - len(steps))))
        return [int(step) for step in padded if step >= 0]

    def close(self):
        if self._writer is not None:
            self._writer.close()

    def _open(self):
        if self._writer is None:
            # Opened late: it makes the folder, and a reader should make none. Only the one that writes may
            # take an unfinished checkpoint for the rest of a killed process.
            self._writer = ocp.training.Checkpointer(
                self._folder,
                preservation_policy=self._preservation,
                cleanup_tmp_directories=self._preservation is not None,
                lightweight_initialize=True,  # else a damaged one would keep all from being read
            )
        return self._writer

    def _check_sum(self, step, state):
        """Raises a ValueError where a state is not the one that was saved: orbax notices no wrong number."""
        wanted = json.loads((self._folder / str(step) / "_CHECKPOINT_METADATA").read_text())
        wanted = (wanted.get("custom_metadata") or {}).get("crc32")  # which older runs do not have
        if wanted is not None and wanted != _sum(state):
            raise ValueError("its numbers are not those that were saved")

    def _set_aside(self, step, error):
        path, number = self._folder / f"{step}.unreadable", 1
        while path.exists():
            path, number = self._folder / f"{step}.unreadable-{number + 1}", number + 1
        processes.wait()
        if processes.is_first():
            os.replace(self._folder / str(step), path)
        processes.wait()
        self._writer.reload()  # else it would still count as there
        why = str(error).removesuffix("; remove it to go on from the one before")
        return f"{why}; kept as {path.name}, going on from the one before"


def _sum(state):
    """Returns a checksum of all numbers of a state."""
    value = 0
    for leaf in jax.tree.leaves(state):
        value = zlib.crc32(np.asarray(leaf).tobytes(), value)
    return value


@functools.cache
def _hush():
    """Leaves out what orbax's readers and writers say that are under way when another of them has failed."""
    before = sys.unraisablehook

    def hook(unraisable):
        if str(unraisable.exc_value) != "Event loop is closed":
            before(unraisable)

    sys.unraisablehook = hook


def _reason(error):
    while error.__cause__ is not None:  # orbax says last what it tried, and first what went wrong
        error = error.__cause__
    return (str(error).splitlines() or [type(error).__name__])[0][:400]
