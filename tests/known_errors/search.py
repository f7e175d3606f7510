"""Measures the error of rows, and searches for the inputs with the largest.

The search keeps, for each column, the worst inputs found, and changes them: some numbers a little, to a bound of their
range, or to those of another bad input. It climbs where errors change gradually, and stays random where they do not.
"""

import functools
import zlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from known_errors.rows import Row, flat

WAYS = ("jitted", "op by op", "bfloat16")  # bfloat16 inputs, jitted
KINDS = ("value", "gradient")
SIGNS = 8  # patterns of moved inputs
EPS, HALF = 2.0**-23, 2.0**-24
LADDER = (0.5, 1, 1.5, 2, 3, 4, 6, 8, 12, 16, 24, 32, 64, 128, 1024, 4096, 16384, 65536)
FAST = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}  # to compile exact values
KEPT = 6  # worst inputs of a column that are changed further


class Worst(NamedTuple):
    """The largest error that was found, and where.

    Attributes:
        error: in units, see known_errors.
        z: [D] the numbers in [0, 1] of the inputs and of the slopes, see Meter.inputs; None for given inputs.
        inputs: {name: array} of it.
        slopes: [outputs], by which the gradient was pulled back.
    """

    error: float
    z: np.ndarray | None
    inputs: dict[str, np.ndarray]
    slopes: np.ndarray


class Meter:
    """The compiled functions of one row."""

    def __init__(self, row: Row, ways=WAYS):
        self.row, self.ways = (
            row,
            [way for way in ways if way != "bfloat16" or (row.bfloat16 and accepts_bfloat16(row))],
        )
        self.kinds = KINDS if row.gradient else KINDS[:1]
        one = row.decode(np.full((1, row.size()), 0.6))
        results = jax.eval_shape(lambda given: row.run(**given), _at(one, 0))
        free = {name: x for name, x in _at(one, 0).items() if name not in row.fixed + row.constant}
        # Which array each number is of; all others are arrays of their own.
        self._arrays = _places(results) if row.whole else np.arange(_places(results).size), _places(free)
        self.outputs = self._arrays[0].size
        self.size = row.size() + (self.outputs if row.gradient else 0)
        self._plain = jax.vmap(functools.partial(_both, row.run, row))
        self._jitted = jax.jit(self._plain)
        self._exact = jax.jit(jax.vmap(jax.vmap(functools.partial(_both, row.exact, row))), compiler_options=FAST)

    def errors(self, inputs: dict[str, np.ndarray], slopes: np.ndarray) -> dict[tuple[str, str], np.ndarray]:
        """Returns the errors [N] in units of inputs {name: [N, ...]}, of slopes [N, outputs], by way and kind."""
        found, exact = {}, None
        for way in self.ways:
            given = inputs
            if way == "bfloat16":
                given = {name: np.asarray(jnp.asarray(value).astype(jnp.bfloat16)) for name, value in inputs.items()}
            if exact is None or way == "bfloat16":
                exact = self.exact(given, slopes)
            run = self._plain if way == "op by op" else self._jitted
            got = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), run(given, slopes))
            most = [np.abs(np.asarray(x, np.float64).reshape(len(slopes), -1)).max(axis=-1) for x in given.values()]
            floor = self.row.noise * np.maximum(np.max(most, axis=0), 1)[:, None]  # what underflows, times inputs
            floors = {"value": floor, "gradient": floor + EPS * self._scale(given, slopes)}
            measure = _backward if self.row.jumps else _mixed
            # The gradient by an input has its type.
            eps = {"value": EPS, "gradient": 2.0**-7 if way == "bfloat16" else EPS}
            for kind, result, (want, moved), arrays in zip(self.kinds, got, exact, self._arrays, strict=False):
                found[way, kind] = measure(result, want, moved, eps[kind], floors[kind], arrays).max(axis=-1)
        return found

    def inputs(self, z: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Returns the inputs {name: [N, ...]} and the slopes [N, outputs], multiples of 1/2 from -1 to 1."""
        count = self.row.size()
        slopes = np.round(4 * z[:, count:] - 2) / 2 if self.row.gradient else np.zeros((len(z), self.outputs))
        return self.row.decode(z[:, :count]), slopes.astype(np.float32)

    def exact(self, inputs, slopes):
        """Returns, for value and gradient, the exact ones [N, M] and those of moved inputs [steps, N, patterns, M]."""
        rng = np.random.default_rng(0)
        wide = {name: np.asarray(value, np.float64)[:, None] for name, value in inputs.items()}
        signs = {name: self._signs(rng, x.shape[2:]) * (name not in self.row.fixed) for name, x in wide.items()}
        turned, found = self._signs(rng, slopes.shape[1:]), []
        further = [{}] + ([self.row.moves(wide)] if self.row.moves else [])
        with jax.enable_x64(True):
            for extra in further:
                changes = []
                for step in LADDER if self.row.jumps else (1,):
                    sizes = {name: step * HALF * (np.abs(x) + extra.get(name, 0)) for name, x in wide.items()}
                    moved = {name: x + signs[name][None] * sizes[name] for name, x in wide.items()}
                    bent = slopes.astype(np.float64)[:, None] * (1 + step * HALF * turned[None])
                    changes.append(jax.tree.map(np.asarray, self._exact(moved, bent)))
                found.append(changes)
        of_kinds = found[0], found[-1]
        return [(found[0][0][i][:, 0], np.stack([x[i][:, 1:] for x in of_kinds[i]])) for i in range(len(self.kinds))]

    def _scale(self, inputs, slopes):
        """Returns what the units of the gradient are relative to at least, see Row.scale: [N, M], or 0."""
        if not self.row.scale:
            return 0.0
        wide = {name: np.asarray(value, np.float64) for name, value in inputs.items()}
        scale = self.row.scale(wide, np.asarray(slopes, np.float64))
        free = sorted(set(wide) - set(self.row.fixed + self.row.constant))
        rows = [np.broadcast_to(scale.get(name, 0.0), wide[name].shape).reshape(len(slopes), -1) for name in free]
        return np.concatenate(rows, axis=1)

    def _signs(self, rng, shape):
        """Returns patterns of signs [1 + SIGNS, *shape], or twice as many, the first all 0, which moves nothing."""
        signs = rng.choice((-1.0, 1.0), (SIGNS, *shape))
        return np.concatenate([np.zeros((1, *shape)), signs, *([-signs] if self.row.jumps else [])])


def accepts_bfloat16(row: Row) -> bool:
    """Returns whether a function computes in float32 when it is given bfloat16."""
    one = jax.tree.map(lambda x: jnp.asarray(x).astype(jnp.bfloat16), _at(row.decode(np.full((1, row.size()), 0.6)), 0))
    try:
        leaves = jax.tree.leaves(jax.eval_shape(lambda given: row.run(**given), one))
    except (TypeError, ValueError):
        return False
    return all(leaf.dtype == jnp.float32 for leaf in leaves)


def climb(meter: Meter, *, generations: int, count: int = 256, seed: int = 0, known=()):
    """Searches for the largest errors of a row.

    Args:
        meter: of the row.
        generations: how often inputs are changed; 0 measures random and known ones only.
        count: inputs at a time.
        seed: of the search.
        known: pairs of inputs and slopes to measure, too, fewer than count.

    Returns:
        {(way, kind): Worst}.
    """
    rng = np.random.default_rng([seed, zlib.crc32(str(meter.row).encode())])
    z, worst = _random(rng, count, meter.size), {}
    for generation in range(generations + 1):
        inputs, slopes = meter.inputs(z)
        first = len(known) if not generation else 0
        for i, (given, turned) in enumerate(known[:first]):
            slopes[i] = turned
            for name, value in given.items():
                inputs[name][i] = value
        for column, errors in meter.errors(inputs, slopes).items():
            order = np.argsort(-errors)[:KEPT]
            found = [Worst(float(errors[i]), z[i] if i >= first else None, _at(inputs, i), slopes[i]) for i in order]
            worst[column] = sorted(worst.get(column, []) + found, key=lambda each: -each.error)[:KEPT]
        if generation < generations:
            parents = [each.z for column in worst.values() for each in column if each.z is not None]
            z = _changed(rng, parents or [*z], count)
    return {column: found[0] for column, found in worst.items()}


def _at(tree, i):
    return jax.tree.map(lambda x: x[i], tree)


def _random(rng, count, size):
    z = rng.uniform(size=(count, size))
    for i in range(0, count, 4):  # arrays of equal numbers, and bounds
        z[i] = np.where(rng.uniform(size=size) < 0.5, rng.uniform(), z[i])
        z[i + 1] = np.where(rng.uniform(size=size) < 0.2, rng.integers(0, 2, size), z[i + 1])
    return z


def _changed(rng, parents, count):
    parents = np.stack(parents)
    z = parents[rng.integers(0, len(parents), count)]
    other = parents[rng.integers(0, len(parents), count)]
    some = rng.uniform(size=z.shape) < 2.0 ** rng.uniform(-np.log2(z.shape[1]) - 1, 0, (count, 1))
    size = 10.0 ** rng.uniform(-7, -0.3, (count, 1))
    changes = np.stack(
        [z + size * rng.normal(size=z.shape), other, rng.uniform(size=z.shape), rng.integers(0, 2, z.shape)]
    )
    which = rng.choice(4, (count, 1), p=(0.7, 0.1, 0.15, 0.05))
    return np.clip(np.where(some, np.take_along_axis(changes, which[None], 0)[0], z), 0, 1)


def _both(function, row, given, slopes):
    """Returns the value [M], and the gradient by all inputs that are differentiated."""
    fixed = {name: given[name] for name in row.fixed + row.constant}

    def run(free):
        return flat(function(**free, **fixed))

    free = {name: value for name, value in given.items() if name not in fixed}
    if not row.gradient:
        return (run(free),)
    value, pull = jax.vjp(run, free)
    leaves = jax.tree.leaves(pull(slopes.astype(value.dtype))[0])
    return value, jnp.concatenate([jnp.ravel(leaf) for leaf in leaves])


def _places(tree):
    """Returns for each number of a tree which of its arrays it belongs to."""
    leaves = jax.tree.leaves(tree)
    return np.repeat(np.arange(len(leaves)), [leaf.size for leaf in leaves])


def _mixed(got, want, moved, eps, floor, arrays):
    """Returns the errors in units; 0 where the exact value is NaN, which it is where nothing is promised."""
    with np.errstate(all="ignore"):
        change = np.abs(moved[0] - want[:, None])
        unit = eps * np.abs(want) + np.where(np.isnan(change), np.inf, change).max(axis=1) + floor
        error = np.where(got == want, 0, np.abs(got - want) / _largest(unit, arrays))
    return np.where(np.isnan(want), 0, np.where(np.isnan(got), np.inf, error))


def _backward(got, want, moved, eps, floor, arrays):
    """Returns by how many half units the inputs must move for the exact results to lie around the computed one."""
    error = np.full(want.shape, np.inf)
    with np.errstate(all="ignore"):
        room = _largest(eps * np.abs(want) + floor, arrays)
        for step, exact in reversed(list(zip(LADDER, moved, strict=True))):
            around = np.concatenate([exact, want[:, None]], axis=1)
            inside = (got >= around.min(axis=1) - step * room) & (got <= around.max(axis=1) + step * room)
            error = np.where(inside, step, error)
    return np.where(np.isnan(want) | (got == want), 0, error)


def _largest(units, arrays):
    """Returns for each number [N, M] the largest unit of its array; that of a result which is not finite is 0."""
    units = np.where(np.isfinite(units), units, 0)
    return np.stack([units[:, arrays == array].max(axis=1) for array in range(arrays.max() + 1)], axis=1)[:, arrays]
