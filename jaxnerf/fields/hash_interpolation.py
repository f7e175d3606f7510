"""Interpolation in the table of a hash grid, and what XLA makes of it: as fast on a CPU as on an accelerator.

The table's rows are at random places of memory, and reading them, and adding to them in the gradient, is most of the
time of a hash grid. What makes that fast differs between a CPU, which runs one loop after the other, and an
accelerator, whose neighbouring threads should do the same.
"""

import functools
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.core.fixed_order import add_rows
from jaxnerf.core.loops import is_cpu
from jaxnerf.core.safe_math import clamp
from jaxnerf.core.types import check_shapes

_PRIMES = (1, 2654435761, 805459861)  # of the spatial hash, arXiv:2201.05989, Eq. 4


class TableLevel(NamedTuple):
    """A level of the table of a hash grid.

    Attributes:
        size: vertices along x, y and z.
        rows: range of the table's rows; fewer than vertices where the level is hashed.
    """

    size: tuple[int, int, int]
    rows: range


def interpolate(
    table: Float[ArrayLike, "rows features"],
    place: Sequence[Float[ArrayLike, " N"]],
    levels: Sequence[TableLevel],
    *,
    fixed_order: bool = False,
) -> Float[Array, "N levels_and_features"]:
    """Interpolates features linearly between the 8 vertices around each place, for each level.

    Args:
        table: [T, F] features of vertices.
        place: three arrays [N], x, y and z as fractions of the box; clamped to it.
        levels: L levels. Each has one row of the table per vertex, z fastest, or fewer rows, which vertices share by
            the hash of arXiv:2201.05989 (Eq. 4). All hashed levels have the same number of rows.
        fixed_order: whether the gradient of a row is summed in a fixed order, for accelerators, whose own additions to
            rows have none. There are then no forward-mode derivatives.

    Returns:
        [N, L F], level by level, at least float32. The derivative with respect to place is that of the linear pieces,
        also on a face of the box.

    Raises:
        ValueError: on another shape of the table, or if hashed levels have different numbers of rows.
    """
    check_shapes("interpolate", table=(table, "T F"), x=(place[0], "N"), y=(place[1], "N"), z=(place[2], "N"))
    counts = {len(level.rows) for level in levels if _is_hashed(level)}
    if len(counts) > 1:
        raise ValueError(f"interpolate: hashed levels have {sorted(counts)} rows, expected the same number in each")
    chosen = _interpolate_in_fixed_order if fixed_order else _interpolate
    return chosen(tuple(levels), jnp.asarray(table), tuple(map(jnp.asarray, place)))


def _interpolated(levels, table, place):
    """Interpolates level by level, which on a CPU is faster than by `_all_corners` where no derivative is needed."""
    if not is_cpu():
        return _together(*_all_corners(levels, place), table)
    weights, features = [], []
    for level in levels:
        low, fractions = _cells(level.size, place)
        weights.append(_of_corners(jnp.multiply, [(1 - fraction, fraction) for fraction in fractions]))
        features.append([_read(table, row) for row in _corner_rows(low, level)])
    return _weighted_sums(weights, features)


_interpolate = jax.custom_jvp(_interpolated, nondiff_argnums=(0,))


@functools.partial(_interpolate.defjvp, symbolic_zeros=True)
def _interpolate_jvp(levels, primals, tangents):
    """Gathers the rows of all levels and vertices at once.

    Otherwise the gradient would compile loops of its own for the rows of each vertex of each level. The gathered
    features are split by vertex, as a loop over several vertices would divide an index for each element.
    """
    (table, place), (change, moved) = primals, tangents
    rows, weights = _all_corners(levels, place)
    tangent = 0.0
    if not isinstance(change, SymbolicZero) and not is_cpu():
        tangent = _change_together(rows, weights, change)
    elif not isinstance(change, SymbolicZero):
        read = jax.lax.split(_read(change, rows.reshape(-1)), [rows.shape[2]] * (rows.shape[0] * 8))
        tangent = _weighted_sums(weights, [read[start : start + 8] for start in range(0, len(read), 8)])
    if not all(isinstance(each, SymbolicZero) for each in moved):
        moved = tuple(
            jnp.zeros_like(value) if isinstance(each, SymbolicZero) else each
            for value, each in zip(place, moved, strict=True)
        )
        tangent += jax.jvp(functools.partial(_interpolated, levels, table), (place,), (moved,))[1]
    if not is_cpu():
        return _together(rows, weights, table), tangent
    return _weighted_sums(weights, [[_read(table, row) for row in level] for level in rows]), tangent


def _together(rows, weights, table):
    """Returns the weighted sums [N, L F] over the vertices [L, 8, N]: all levels at once, in the same way.

    The neighbouring threads of an accelerator then have the same work.
    """
    corners = (weights[:, corner, :, None] * _read(table, rows[:, corner]) for corner in range(8))
    return _by_sample(functools.reduce(jnp.add, corners))


def _change_together(rows, weights, change):
    """Returns what `_together` does, from one array of all rows: its transpose is a single scatter."""
    read = _read(change, rows.reshape(-1)).reshape(*rows.shape, -1)
    return _by_sample(jnp.sum(weights[..., None] * read, axis=1))


def _by_sample(features):
    """Returns [N, L F] for features [L, N, F]."""
    levels, samples, size = features.shape
    return jnp.moveaxis(features, 0, 1).reshape(samples, levels * size)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _interpolate_in_fixed_order(levels, table, place):
    return _together(*_all_corners(levels, place), table)


def _forward_in_fixed_order(levels, table, place):
    return _interpolate_in_fixed_order(levels, table, place), (table, place)


def _backward_in_fixed_order(levels, residuals, change):
    table, place = residuals
    rows, weights = _all_corners(levels, place)
    change_of_level = jnp.moveaxis(change.reshape(*rows.shape[2:], len(levels), table.shape[-1]), 1, 0)
    values = weights[..., None] * change_of_level[:, None]
    sums = add_rows(values.reshape(-1, values.shape[-1]), rows.reshape(-1), len(table))
    moved = jax.vjp(lambda place: _interpolated(levels, table, place), place)[1](change)[0]
    return sums.astype(table.dtype), moved


_interpolate_in_fixed_order.defvjp(_forward_in_fixed_order, _backward_in_fixed_order)


def _weighted_sums(weights, features):
    """Returns the sums over the vertices [N, L F] of weights and features by level and vertex, [N] and [N, F] each.

    Not as sums over an axis, for which XLA would write all products to memory.
    """
    return jnp.concatenate(
        [
            functools.reduce(jnp.add, (w[:, None] * f for w, f in zip(*level, strict=True)))
            for level in zip(weights, features, strict=True)
        ],
        axis=-1,
    )


def stored(values: Sequence[Float[ArrayLike, " N"]]) -> list[Float[Array, " N"]]:
    """Returns the same arrays, written to memory once.

    On a CPU, XLA would otherwise compute them again in the loops of each level and vertex, which it then does not
    vectorize. It never computes a reduction twice, hence a sum with zeros; an optimization_barrier does not help.
    """
    diagonal = jnp.eye(len(values), dtype=bool)[..., None]
    return list(jnp.where(diagonal, jnp.stack(values)[None], 0).sum(axis=1))


@jax.custom_jvp
def transposed_product(kernel: Float[ArrayLike, "D F"], features: Float[ArrayLike, "N D"]) -> Float[Array, "F N"]:
    """Computes the product of features and a kernel with the samples last.

    The table yields one row per sample, but the layers that follow are faster with features first.
    """
    return jnp.einsum("df,nd->fn", kernel, features)


@transposed_product.defjvp
def _transposed_product_jvp(primals, tangents):
    """Differentiates the product with the features transposed, as the backward pass is then faster on a CPU.

    The barrier keeps XLA from merging the transpositions into the products. Without derivatives the transposition
    would only cost time.
    """
    kernel, features = primals
    features, change = (jax.lax.optimization_barrier(each.T) for each in (features, tangents[1]))

    def product(kernel, features):
        return jnp.einsum("df,dn->fn", kernel, features)

    return product(kernel, features), product(tangents[0], features) + product(kernel, change)


def _cells(size, place):
    """Returns, for each axis, the lower vertices of the cells around places, and the fractions of cells below them."""
    spread = [clamp(value, 0, 1) * np.float32(count - 1) for value, count in zip(place, size, strict=True)]
    low = [jnp.minimum(value.astype(jnp.int32), count - 2) for value, count in zip(spread, size, strict=True)]
    return low, [value - start for value, start in zip(spread, low, strict=True)]


def _corner_rows(low, level):
    """Returns the rows [N] of the 8 vertices around places; low holds the lowest along each axis."""
    if not _is_hashed(level):
        strides = (level.size[1] * level.size[2], level.size[2], 1)
        along = [(v * stride, v * stride + stride) for v, stride in zip(low, strides, strict=True)]
        return [level.rows.start + row for row in _of_corners(jnp.add, along)]
    first = [v.astype(jnp.uint32) for v in low]
    along = [(v * prime, (v + 1) * prime) for v, prime in zip(first, map(jnp.uint32, _PRIMES), strict=True)]
    scattered = _of_corners(jnp.bitwise_xor, along)
    return [level.rows.start + (row % jnp.uint32(len(level.rows))).astype(jnp.int32) for row in scattered]


def _of_corners(combine, along):
    """Returns the 8 combinations of two values along each of three axes, z fastest."""
    x, y, z = along
    pairs = [combine(*pair) for pair in itertools.product(x, y)]
    return [combine(*pair) for pair in itertools.product(pairs, z)]


def _all_corners(levels, place):
    """Returns the rows and the weights [L, 8, N] of the 8 vertices around places, z fastest."""
    size = np.array([level.size for level in levels], np.int32).T[..., None, None]
    corners = np.array(list(itertools.product((0, 1), repeat=3)), np.int32).T[:, None, :, None]
    low, fractions = _cells(size, [value[None, None] for value in place])
    weights = [jnp.where(corner == 1, value, 1 - value) for corner, value in zip(corners, fractions, strict=True)]
    vertices = list(map(jnp.add, low, corners))
    rows = functools.reduce(jnp.add, map(jnp.multiply, vertices, (size[1] * size[2], size[2], 1)))
    hashed = np.array([_is_hashed(level) for level in levels])
    if hashed.any():
        scattered = [v.astype(jnp.uint32) * jnp.uint32(prime) for v, prime in zip(vertices, _PRIMES, strict=True)]
        scattered = functools.reduce(jnp.bitwise_xor, scattered) % jnp.uint32(len(levels[hashed.argmax()].rows))
        rows = jnp.where(hashed[:, None, None], scattered.astype(jnp.int32), rows)
    starts = np.array([level.rows.start for level in levels], np.int32)
    # The remainder changes nothing, but without it XLA computes the rows once more for the gradient on a CPU.
    rows = jax.lax.rem(rows + starts[:, None, None], jnp.full(rows.shape, np.iinfo(np.int32).max, jnp.int32))
    return rows, functools.reduce(jnp.multiply, weights)


def _is_hashed(level):
    return len(level.rows) < np.prod(level.size)


def _read(table, rows):
    return jnp.asarray(table).at[rows].get(mode="promise_in_bounds", wrap_negative_indices=False)
