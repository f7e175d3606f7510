"""Samples of training: as many as a buffer holds, most of them where the occupancy grid expects the rays to end.

This is the importance sampling of arXiv:2003.08934 (Section 5.2) with the grid in place of the coarse network.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxnerf.core.loops import short_loop, vary_like
from jaxnerf.core.occupancy.grid import OccupancyGrid, estimate_optical_depth
from jaxnerf.core.occupancy.sample_runs import SampleRuns
from jaxnerf.core.sampling import uniform
from jaxnerf.core.types import Keys, PlacedSamples, Rays, Samples, check_shapes
from jaxnerf.core.volume_rendering import exclusive_sum, running_sum, running_sum_since

_PARTS = 2.0**16  # probabilities are multiples of its inverse: float32 then sums them exactly, in any order


def importance_samples(
    key: Keys,
    grid: OccupancyGrid,
    rays: Rays,
    candidates: Samples | SampleRuns,
    *,
    max_samples: int,
    uniform_fraction: float,
    max_optical_depth: Float[ArrayLike, ""] = jnp.inf,
) -> tuple[PlacedSamples, Bool[Array, " B"]]:
    """Places at most max_samples samples in the occupied cells along rays.

    The candidates in occupied cells are the segments of a ray in which samples may be. If all of them fit into the
    buffer, a ray has as many samples as candidates, at equal distances. Otherwise the rays with most candidates get
    fewer samples, all the same number. A fraction of these, on average, is placed evenly over the candidates; the
    others in proportion to the weights that the grid's density_mean gives to the candidates. Each sample stands for
    the occupied length halfway to its neighbours, so that the length of all samples of a ray is that of its
    candidates.

    Args:
        key: one key, or one per ray [B]; it moves all samples of a ray together.
        grid: OccupancyGrid. Its cells are the resolution of the weights.
        rays: Rays [B].
        candidates: Samples [B, S] of rule "segments", S <= 2^16 and B S < 2^31, usually of `march_rays`; or the
            SampleRuns of `march_near_matter`, which skip runs that cross no occupied cell, U W < 2^31.
        max_samples: K >= 1, the size of the buffer.
        uniform_fraction: in (0, 1]. The weights are estimates: without evenly placed samples, matter would not be
            found where the grid has none yet. At 1 the weights do not matter.
        max_optical_depth: candidates behind this optical depth, as estimated by the grid, are skipped.

    Returns:
        PlacedSamples, all in candidates in occupied cells; as the middle of a candidate decides, a few percent of the
        samples lie outside the cells, by up to half a candidate's length. And occluded [B], whether candidates of a
        ray in occupied cells were skipped. No ray with candidates is dropped unless there are more such rays than
        slots. A ray that is NaN has samples, so that it is visible.

    Raises:
        ValueError: on other shapes, another rule, max_samples < 1 or a uniform_fraction outside (0, 1].
    """
    # All sums below are along rays, whose candidates are one row of an array or several.
    along, axes, shapes = _AlongRays(None), "B S", {"near": (rays.near, "B")}
    if isinstance(candidates, SampleRuns):
        shapes |= {"first": (candidates.first, "B"), "count": (candidates.count, "B")}
        shapes["ray_index"] = (candidates.ray_index, "U")
        candidates, along, axes = candidates.samples, _AlongRays(candidates), "U W"
    check_shapes("importance_samples", **shapes, t=(candidates.t, axes), delta=(candidates.delta, axes))
    if candidates.rule != "segments" or max_samples < 1 or not 0 < uniform_fraction <= 1:
        raise ValueError(
            f"importance_samples: rule is {candidates.rule!r}, max_samples {max_samples} and uniform_fraction "
            f"{uniform_fraction}, expected 'segments', at least 1, and above 0 up to 1"
        )
    if not candidates.t.size:
        zeros, none = jnp.zeros(max_samples), jnp.zeros(rays.near.size, jnp.int32)
        index = jnp.zeros(max_samples, jnp.int32)
        return PlacedSamples(t=zeros, delta=zeros, ray_index=index, used=index > 0, num_dropped=none), none > 0
    # Candidates that the grid expects to be hidden are skipped; the others share out the slots of the buffer.
    occupied, optical_depth = estimate_optical_depth(grid, along.of_rows(rays), candidates)
    in_front = along.before(optical_depth)
    kept = occupied & ~(in_front > max_optical_depth)
    count = along.total(kept.sum(axis=-1, dtype=jnp.int32))
    number = divide_slots(count, max_samples)
    transmittance = jnp.exp(-in_front)
    weights = jnp.where(kept, transmittance - transmittance * jnp.exp(-optical_depth), 0)
    parts = _parts(along, weights, kept, number, count, uniform_fraction)
    cumulative = along.through(parts)
    delta = jnp.where(kept, candidates.delta, 0)
    length = along.through(delta)
    all_parts, whole_length = along.last(cumulative), along.last(length)
    slots = _fill_slots(key, number, all_parts, max_samples)
    ray = slots.ray
    begin, size = along.places_of(ray, candidates.t.shape[-1])

    def locate(at):
        """Returns the candidate that contains a place [K] on the scale of `cumulative`, and the fraction before it."""
        place = jnp.minimum(jnp.floor(at), all_parts[ray] - 1)
        found = _count_up_to(cumulative, begin, size, place, along.most_runs)
        index = jnp.divmod(begin + found, cumulative.shape[-1])
        inside = parts[index]
        return index, jnp.clip((at - (cumulative[index] - inside)) / jnp.maximum(inside, 1), 0, 1)

    # A sample lies in the middle of its parts, and stands for the length between their bounds.
    index, fraction = locate(slots.lower)
    before = length[index] - (1 - fraction) * delta[index]
    after = jnp.where(slots.is_last, whole_length[ray], jnp.roll(before, -1))
    index, fraction = locate((slots.lower + slots.upper) / 2)
    placed = PlacedSamples(
        t=jnp.where(slots.used, candidates.t[index] + (fraction - 0.5) * candidates.delta[index], 0),
        delta=jnp.where(slots.used, jnp.maximum(after - before, 0), 0),
        ray_index=ray,
        used=slots.used,
        num_dropped=jnp.where(number == 0, count, 0),
    )
    return placed, along.any((occupied & (in_front > max_optical_depth)).any(axis=-1))


def _parts(along, weights, kept, number, count, uniform_fraction):
    """Returns the probability of each candidate as a whole number of parts; 0 where it is not kept.

    A part of the probability is in proportion to the candidate's weight, only where the ray gets fewer samples than
    candidates, and the rest is even, so that the sum is about 1. Sums of parts are exact in float32 whatever the order;
    each candidate has at least one. Rays have number [B] samples and count [B] candidates.
    """
    weights = jnp.where(along.of_rows(number < count)[:, None], (1 - uniform_fraction) * weights, 0)
    even = (1 - along.total(weights.sum(axis=-1))) / jnp.maximum(count, 1)
    probability = weights + along.of_rows(even)[:, None]
    return jnp.where(kept, 1 + jnp.where(probability > 0, jnp.floor(_PARTS * probability), 0), 0)


class _Slots(NamedTuple):
    """Which part of which ray each slot of the buffer gets.

    Attributes:
        ray: [K] int32, ascending.
        used: [K] bool, False for unused slots, which come last.
        is_last: [K] bool, whether it is the last of its ray.
        lower, upper: [K], bounds on the scale of the ray's parts.
    """

    ray: Int[Array, " K"]
    used: Bool[Array, " K"]
    is_last: Bool[Array, " K"]
    lower: Float[Array, " K"]
    upper: Float[Array, " K"]


def _fill_slots(key, number, all_parts, max_samples):
    """Returns the _Slots of rays with number [B] samples: the parts of a ray are divided evenly among its slots."""
    # The ray of each slot: a cumulative sum of where rays end in the buffer takes the place of a search.
    first = jnp.cumsum(number, dtype=jnp.int32) - number
    slot = jnp.arange(max_samples, dtype=jnp.int32)
    ended = jnp.zeros(max_samples, jnp.int32).at[first + number].add(1, mode="drop")
    ray = jnp.minimum(jnp.cumsum(ended, dtype=jnp.int32), number.size - 1)
    # A random shift moves all inner bounds of a ray together.
    row, total = slot - first[ray], all_parts[ray]
    spacing = total / jnp.maximum(number[ray], 1)
    shift = uniform(key, (*number.shape, 1))[ray, 0] - 0.5
    is_last = row == number[ray] - 1
    return _Slots(
        ray=ray,
        used=slot < number.sum(),
        is_last=is_last,
        lower=jnp.where(row == 0, 0, (row + shift) * spacing),
        upper=jnp.where(is_last, total, (row + 1 + shift) * spacing),
    )


def divide_slots(count: Int[ArrayLike, " B"], num_slots: int) -> Int[Array, " B"]:
    """Returns the numbers [B] of slots of rays that want count [B] slots: all that they want, or at most m each.

    Here m is the largest number with sum_i min(count_i, m) <= num_slots. The slots that are then left go to the first
    rays that want more than m, one each.
    """
    count = jnp.asarray(count)
    ascending = jnp.sort(count)
    # The sum is the least of the lines below_k + above_k m, so m is the largest of their solutions.
    below, above = jnp.cumsum(ascending, dtype=jnp.int32) - ascending, jnp.arange(count.size, 0, -1, dtype=jnp.int32)
    most = jnp.maximum((num_slots - below) // above, 0).max()
    number = jnp.minimum(count, most)
    more = count > most
    return number + (more & (jnp.cumsum(more) <= num_slots - number.sum())).astype(number.dtype)


def _count_up_to(ascending, begin, size, value, most_runs):
    """Returns [K], how many of the `size` values after the first `begin` are at most value [K]; at most size - 1.

    Args:
        ascending: [U, W], row after row.
        most_runs: rows that `size` values can fill.
    """
    most = most_runs * ascending.shape[-1]
    largest = 1 << (most.bit_length() - 1)

    def search(level, found):
        place = found + (largest >> level)
        inside = place < size
        at = jnp.divmod(begin + jnp.minimum(place, size) - 1, ascending.shape[-1])
        return jnp.where(inside & (ascending[at] <= value), place, found)

    none = vary_like(jnp.zeros(value.shape, jnp.int32), ascending, begin, value)
    return short_loop(most.bit_length(), search, none)


class _AlongRays:
    """Sums along rays of values [U, W] of SampleRuns, 0 of a ray without runs; without runs each ray has one row."""

    def __init__(self, runs: SampleRuns | None):
        self._runs, self.most_runs = runs, 1 if runs is None else runs.max_count
        if runs is not None:
            self._starts = jnp.arange(runs.ray_index.size) == runs.first[runs.ray_index]
            self._last = jnp.maximum(runs.first + runs.count - 1, 0)

    def of_rows(self, tree: Any) -> Any:
        """Returns what belongs to the ray of each row, of arrays [B, ...]."""
        return tree if self._runs is None else jax.tree.map(lambda x: jnp.asarray(x)[self._runs.ray_index], tree)

    def total(self, values: Array) -> Array:
        """Returns the sum [B] of one value [U] of each row."""
        return self._of_last(self._since_start(values))

    def any(self, values: Bool[Array, " U"]) -> Bool[Array, " B"]:
        """Returns whether any row of a ray is true."""
        return self.total(values.astype(jnp.int32)) > 0

    def through(self, values: Float[Array, "U W"]) -> Float[Array, "U W"]:
        """Returns the running sum along each ray."""
        inside = running_sum(values)
        return self._with_rows_before(inside, inside)

    def before(self, values: Float[Array, "U W"]) -> Float[Array, "U W"]:
        """Returns the sum of what is in front of each value."""
        return self._with_rows_before(exclusive_sum(values), running_sum(values))

    def last(self, sums: Float[Array, "U W"]) -> Float[Array, " B"]:
        """Returns the last of running sums."""
        return self._of_last(sums[:, -1])

    def places_of(self, ray: Int[Array, " K"], width: int) -> tuple[Any, Any]:
        """Returns the flat index of the first value of each of some rays, and how many values it has."""
        first, count = (ray, 1) if self._runs is None else (self._runs.first[ray], self._runs.count[ray])
        return first * width, count * width

    def _of_last(self, values):
        return values if self._runs is None else jnp.where(self._runs.count > 0, values[self._last], 0)

    def _since_start(self, values):
        return values if self._runs is None else running_sum_since(self._starts, values, self._runs.max_count)

    def _with_rows_before(self, sums, inside):
        """Adds to sums within rows those of the rows before on the same ray."""
        if self._runs is None:
            return sums
        return sums + jnp.where(self._starts, 0, jnp.roll(self._since_start(inside[:, -1]), 1))[:, None]
