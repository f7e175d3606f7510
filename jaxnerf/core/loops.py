"""What is compiled otherwise for a CPU than for an accelerator: short loops, and the layout of arrays."""

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
