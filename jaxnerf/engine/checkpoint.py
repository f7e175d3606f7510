"""Checkpoints: atomic, the last few kept (orbax v1)."""

import dataclasses
import pathlib

import jax
from orbax.checkpoint import v1 as ocp


class Checkpoints:
    """The checkpoints under a workdir, step by step."""

    def __init__(self, workdir, *, keep=None):
        """Opens the folder; keep: how many of the newest stay, None for reading only."""
        self._folder = pathlib.Path(workdir).absolute() / "checkpoints"
        policies = ocp.training.preservation_policies
        self._keep = policies.LatestN(keep) if keep else None
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
                self._open().save(step, state, force=True)
            except Exception as error:  # orbax raises many kinds
                raise ValueError(
                    f"{self._folder / str(step)}: cannot be written ({_reason(error)}); make room and start "
                    "again, which goes on from the one before"
                ) from error

    def load(self, step, like):
        """Returns the state at a step, shaped and placed as like; counters newer than it are those of like.

        Raises:
            ValueError: if the checkpoint does not fit; names it.
        """
        abstract = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding), like)
        try:
            self._open().reload()  # another process may have written it since
            saved = self._open().metadata(step).metadata["counters"]
            known = {name: counter for name, counter in abstract.counters.items() if name in saved}
            state = self._open().load(step, dataclasses.replace(abstract, counters=known))
            return dataclasses.replace(state, counters={**like.counters, **state.counters})
        except Exception as error:  # orbax raises many kinds
            raise ValueError(
                f"{self._folder / str(step)}: cannot be read as this model's state ({_reason(error)}); "
                "remove it to go on from the one before"
            ) from error

    def close(self):
        if self._writer is not None:
            self._writer.close()

    def _open(self):
        if self._writer is None:
            # Opened late: it makes the folder, and a reader should make none.
            self._writer = ocp.training.Checkpointer(self._folder, preservation_policy=self._keep)
        return self._writer


def _reason(error):
    return (str(error).splitlines() or [type(error).__name__])[0][:400]
