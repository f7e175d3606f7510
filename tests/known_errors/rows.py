"""Rows: a function, the range of its inputs, and its exact value."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

ZEROS = 1 / 16  # the fraction of the inputs of a range "log0" or "signed0" that are 0


@dataclasses.dataclass(frozen=True)
class Input:
    """The range of an array: uniform from low to high, or, for the other kinds, uniform in the exponent.

    Attributes:
        shape: of the array.
        kind: "uniform", "log", "signed" (of both signs), or "log0" and "signed0", which are 0 with a chance of ZEROS.
        low: smallest value, or magnitude.
        high: largest value, or magnitude.
    """

    shape: tuple[int, ...]
    kind: str
    low: float
    high: float

    def decode(self, z: np.ndarray) -> np.ndarray:
        """Returns the array for numbers z in [0, 1]."""
        if self.kind == "uniform":
            return self.low + (self.high - self.low) * z
        sign = 1.0
        if self.kind.startswith("signed"):
            sign, z = np.where(z < 0.5, -1.0, 1.0), np.abs(2 * z - 1)
        zero = z < (ZEROS if self.kind.endswith("0") else -1)
        if self.kind.endswith("0"):
            z = np.clip((z - ZEROS) / (1 - ZEROS), 0, 1)
        return np.where(zero, 0, sign * self.low * (self.high / self.low) ** z)


@dataclasses.dataclass(frozen=True)
class Row:
    """A function under test.

    Attributes:
        name: of a public function.
        variant: what tells it from other rows of that function.
        inputs: {name: Input}.
        run: the function of these arrays as keyword arguments; returns a tree of arrays.
        exact: the same in float64, by other formulas; NaN where the result is not defined.
        prepare: makes valid inputs [N, ...] of decoded ones, in float64 numpy, such as sorted edges.
        fixed: names of inputs that only the exact value needs: they are not moved, and not differentiated.
        constant: names of inputs that are not differentiated.
        whole: whether an error counts in units of the largest entry of its array, as it does for all gradients.
        gradient: whether the function has one.
        moves: inputs [N, 1, ...] -> {name: how far an input may be moved for the unit of the gradient, over 2^-24,
            beyond its own rounding}: a condition, which the page states.
        scale: (inputs, slopes) -> {name: what the unit of a gradient by that input is relative to, beside the gradient
            itself, at least}: another condition, for gradients that are differences of larger numbers.
        bfloat16: whether such inputs are tried; not where a scene computes in their type.
        noise: an error below it counts as 0, as of a gradient that is 0 whatever the inputs are.
        jumps: whether the function, or its gradient, does; see `known_errors`.
    """

    name: str
    variant: str
    inputs: Mapping[str, Input]
    run: Callable[..., Any]
    exact: Callable[..., Any]
    prepare: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]] = dict
    fixed: tuple[str, ...] = ()
    constant: tuple[str, ...] = ()
    whole: bool = False
    gradient: bool = True
    moves: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]] | None = None
    scale: Callable[[dict[str, np.ndarray], np.ndarray], dict[str, np.ndarray]] | None = None
    bfloat16: bool = True
    noise: float = 2.0**-120
    jumps: bool = False

    def __str__(self) -> str:
        return f"{self.name}, {self.variant}" if self.variant else self.name

    def size(self) -> int:
        """Returns how many numbers all inputs have."""
        return sum(math.prod(each.shape) for each in self.inputs.values())

    def decode(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Returns float32 inputs {name: [N, ...]} for z [N, size] in [0, 1]."""
        found, start = {}, 0
        for name, each in self.inputs.items():
            stop = start + math.prod(each.shape)
            found[name] = each.decode(z[:, start:stop]).reshape(-1, *each.shape)
            start = stop
        return {name: np.asarray(value, np.float32) for name, value in self.prepare(found).items()}


def flat(tree: Any) -> jax.Array:
    """Returns all numbers of a tree of arrays as one vector, at least float32."""
    leaves = [jnp.ravel(leaf) for leaf in jax.tree.leaves(tree)]
    return jnp.concatenate([leaf.astype(jnp.result_type(leaf.dtype, jnp.float32)) for leaf in leaves])


def rotations(vectors: np.ndarray) -> np.ndarray:
    """Returns rotations [N, 3, 3] made from any matrices [N, 3, 3]."""
    q, r = np.linalg.qr(vectors + 1e-3 * np.eye(3))
    q = q * np.sign(np.where(np.einsum("nii->ni", r) == 0, 1, np.einsum("nii->ni", r)))[:, None]
    return q * np.linalg.det(q)[:, None, None] ** np.array([0, 0, 1])


def ascending(values: np.ndarray) -> np.ndarray:
    """Returns values [N, S] in ascending order."""
    return np.sort(values, axis=-1)
