"""Sums in a fixed order on accelerators, whose own additions to random places have none.

Float32 additions depend on their order, so that two runs with the same seed differ. Whole numbers do not.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxnerf.core.volume_rendering import running_sum_since


def add_rows(values: Float[ArrayLike, "M F"], rows: Int[ArrayLike, " M"], num_rows: int) -> Float[Array, "num_rows F"]:
    """Computes the sum of the values of each row, the same whatever their order.

    Values are rounded to multiples of a power of two, so that the largest possible sum is below 2^63 of them, and
    these whole numbers are summed. For 10^7 values, this changes each by at most 2^-38 of the largest. The sum is
    rounded to float32.

    Args:
        values: [M, F].
        rows: [M] in [0, num_rows); not checked.
        num_rows: of the result.

    Returns:
        [num_rows, F], float32; NaN if a value is not finite.
    """
    values = jnp.asarray(values, jnp.float32)
    bits = 62 - max(values.shape[0] - 1, 1).bit_length()
    largest = jnp.abs(values).max(initial=0)
    exponent = (jax.lax.bitcast_convert_type(largest, jnp.int32) >> 23) - 126  # the largest value is below 2^exponent
    power = jnp.clip(bits - exponent, -126, 126)
    whole = jnp.round(values * _two_to(power))
    with jax.enable_x64(True):
        zeros = jnp.zeros((num_rows, values.shape[1]), jnp.int64)
        sums = zeros.at[rows].add(whole.astype(jnp.int64), mode="promise_in_bounds", wrap_negative_indices=False)
        sums = sums.astype(jnp.float32)
    return jnp.where(jnp.isfinite(largest), sums * _two_to(-power), jnp.nan)


def _two_to(power):
    return jax.lax.bitcast_convert_type((power + 127) << 23, jnp.float32)


@functools.partial(jax.custom_vjp, nondiff_argnums=(4, 5))
def segment_sums(
    values: Float[ArrayLike, "K C"],
    segment: Int[ArrayLike, " K"],
    starts: Bool[ArrayLike, " K"],
    used: Bool[ArrayLike, " K"],
    count: int,
    longest: int,
) -> Float[Array, "count C"]:
    """Computes the sum of each segment, in an order that depends on its length alone.

    Args:
        values: [K, C].
        segment: [K] in [0, count), ascending.
        starts: [K] bool, the first value of each segment.
        used: [K] bool, False for values that do not count; they come after all others, as in PlacedSamples.
        count: of segments; the sum of one without values that count is 0, also if K is 0.
        longest: upper bound of the values of a segment that count.
    """
    if not len(used):
        return jnp.zeros((count, jnp.shape(values)[1]))
    sums = jax.vmap(lambda column: running_sum_since(starts, column, longest), 1, 1)(jnp.asarray(values))
    place = jnp.where(used, jnp.arange(len(sums)), -1)
    last = jax.ops.segment_max(place, segment, count, indices_are_sorted=True)
    return jnp.where(last[:, None] >= 0, sums[jnp.maximum(last, 0)], 0)


def _segment_sums_forward(values, segment, starts, used, count, longest):
    return segment_sums(values, segment, starts, used, count, longest), (segment, used)


def _segment_sums_backward(count, longest, residuals, change):
    segment, used = residuals
    return jnp.where(used[:, None], change[segment], 0), None, None, None


segment_sums.defvjp(_segment_sums_forward, _segment_sums_backward)
