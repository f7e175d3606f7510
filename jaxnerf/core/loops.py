"""Loops: what is compiled otherwise for a CPU than for an accelerator, and the type of what they carry.

The carry of a loop must have one type. Inside jax.shard_map the type of an array tells over which axes of the mesh it
may vary. What begins as constants, equal on all devices, does not have the type of what the loop computes from sharded
arrays.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Int, Num

_Tree = TypeVar("_Tree")


def is_cpu() -> bool:
    """Returns whether functions are traced for a CPU: of two layouts of the same arrays it is then the faster one.

    Where the operations themselves differ, `jax.lax.platform_dependent` asks the device that a program is compiled for.
    """
    return jax.default_backend() == "cpu"


def short_loop(count: int, body: Callable[[Any, _Tree], _Tree], start: _Tree) -> _Tree:
    """Computes body(count - 1, ... body(1, body(0, start))).

    On a CPU it is a loop: unrolled, XLA makes a kernel of each iteration, which computes some of the earlier ones
    again. On an accelerator it is unrolled, since an iteration of a loop is several launches, each of which costs more
    than the arithmetic.

    Args:
        count: of iterations, known when the function is traced.
        body: (index, value) -> value.
        start: the first value, a tree of arrays.
    """

    def looped(value):
        return jax.lax.fori_loop(0, count, body, value)

    def unrolled(value):
        for index in range(count):
            value = body(index, value)
        return value

    return jax.lax.platform_dependent(start, cpu=looped, default=unrolled)


def search_sorted(
    ascending: Num[ArrayLike, " N"], values: Num[ArrayLike, "*batch"], *, side: str
) -> Int[Array, "*batch"]:
    """Computes jnp.searchsorted by bisection, as a short loop."""

    def search(method):
        return functools.partial(jnp.searchsorted, side=side, method=method)

    return jax.lax.platform_dependent(ascending, values, cpu=search("scan"), default=search("scan_unrolled"))


def vary_like(tree: _Tree, *others: object) -> _Tree:
    """Marks arrays as varying over all mesh axes over which others vary; outside jax.shard_map nothing changes.

    Args:
        tree: of arrays.
        *others: trees of arrays or of jax.ShapeDtypeStruct, such as the result of jax.eval_shape.

    Returns:
        The tree, with the same values.
    """
    axes = frozenset().union(*(_axes(leaf) for leaf in jax.tree.leaves(others)))

    def mark(leaf):
        missing = tuple(sorted(axes - _axes(leaf)))
        return jax.lax.pcast(leaf, missing, to="varying") if missing else leaf

    return jax.tree.map(mark, tree)


def _axes(leaf):
    kind = leaf if isinstance(leaf, jax.ShapeDtypeStruct) else jax.typeof(leaf)
    manual = getattr(kind, "manual_axis_type", None)
    return getattr(manual or kind, "varying" if manual else "vma", None) or frozenset()  # vma: JAX 0.10.0
