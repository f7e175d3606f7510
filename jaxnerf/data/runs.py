"""Lists of pixels as the runs that they come in: single ids would fill as much memory as the pixels."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf.core.structs import pytree


@pytree()
class Runs:
    """Ids of pixels, ascending: runs of neighbours, each with all ids from its first on."""

    first: jax.Array  # [R] int32, the id that a run begins with
    before: jax.Array  # [R] int32, how many ids the runs before it have
    size: jax.Array  # int32, how many ids there are

    def ids(self, places):
        """Returns the ids [...] at places [...] of the list, each below its size."""
        run = jnp.searchsorted(self.before, places, side="right") - 1
        return jnp.asarray(self.first)[run] + places - jnp.asarray(self.before)[run]

    def count_below(self, bounds):
        """Returns how many ids [...] of the list lie below bounds [...]."""
        run = jnp.maximum(jnp.searchsorted(self.first, bounds) - 1, 0)
        ends = jnp.append(self.before[1:], self.size)
        into = bounds - jnp.asarray(self.first)[run]
        return jnp.clip(jnp.asarray(self.before)[run] + into, 0, ends[run])

    def all_ids(self):
        """Returns [L] int32, in numpy on the host."""
        lengths = np.diff(np.append(self.before, self.size))
        return (np.arange(self.size) + np.repeat(self.first - self.before, lengths)).astype(np.int32)


def runs_of(chosen, offset=0):
    """Returns first [R] and length [R] of the runs in which chosen [N] is True; ids count from an offset."""
    edges = np.flatnonzero(np.diff(chosen, prepend=False, append=False))
    return edges[::2] + offset, edges[1::2] - edges[::2]


def join(parts):
    """Returns the Runs of [(first, length), ...] in numpy, whose ids ascend."""
    first, length = (np.concatenate(column) for column in zip(*parts, strict=True))
    ends = np.cumsum(length)
    before = np.int32(ends - length)
    return Runs(first=np.int32(first), before=before, size=np.int32(length.sum()))
