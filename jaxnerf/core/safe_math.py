"""Arithmetic whose values and gradients stay correct at 0, at infinity and at the limits of the float type."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num


@jax.custom_jvp
def divide(a: Float[ArrayLike, "*shape"], b: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
    """Computes a / b; the derivative avoids 1 / b^2, which overflows before a / b^2 does."""
    return a / b


@divide.defjvp
def _divide_jvp(primals, tangents):
    quotient, inverse = primals[0] / primals[1], 1 / primals[1]
    return quotient, tangents[0] * inverse - (quotient * inverse) * tangents[1]


def clamp(
    x: Float[ArrayLike, "*#shape"], lower: Float[ArrayLike, "*#shape"], upper: Float[ArrayLike, "*#shape"]
) -> Float[Array, "*#shape"]:
    """Clips x to [lower, upper]; unlike jnp.clip, the gradient is not halved where x equals a bound."""
    return jnp.where(x < lower, lower, jnp.where(x > upper, upper, x))


def at_least_float32(*arrays: Num[ArrayLike, "..."]) -> list[Float[Array, "..."]]:
    """Converts arrays to their common type, which is at least float32."""
    arrays = [jnp.asarray(array) for array in arrays]
    dtype = jnp.result_type(jnp.float32, *(array.dtype for array in arrays))
    return [array.astype(dtype) for array in arrays]


def norm(vectors: Float[ArrayLike, "*batch D"]) -> Float[Array, "*batch"]:
    """Computes the length of vectors without over- or underflow; 0, with gradient 0, for a zero vector.

    Returns:
        [...], at least float32: the squares of half precision would lose digits.
    """
    (vectors,) = at_least_float32(vectors)
    largest = jnp.abs(vectors).max(axis=-1, keepdims=True)
    nonzero = largest != 0  # NaN stays NaN
    largest = jax.lax.stop_gradient(jnp.where(nonzero, largest, 1))
    squares = (divide_by_largest(vectors, largest) ** 2).sum(axis=-1, keepdims=True)
    return jnp.where(nonzero, largest * jnp.sqrt(jnp.where(nonzero, squares, 1)), 0)[..., 0]


def divide_by_largest(x: Float[ArrayLike, "*#shape"], largest: Float[ArrayLike, "*#shape"]) -> Float[Array, "*#shape"]:
    """Computes x / largest for |x| <= largest, without a result of 0 where largest is near the limit of the type.

    XLA may multiply by 1 / largest instead, which is subnormal above 8.5e37 in float32 and then counts as 0.
    """
    shrink = jnp.where(largest > 1, 1 / 16, 1.0)  # powers of two do not change the digits
    return (x * shrink) / (largest * shrink)


def normalize(vectors: Float[ArrayLike, "*batch D"]) -> Float[Array, "*batch D"]:
    """Scales vectors to unit length; 0, with gradient 0, for a zero vector. The result is at least float32."""
    (vectors,) = at_least_float32(vectors)
    largest = jnp.abs(vectors).max(axis=-1, keepdims=True)
    nonzero = largest != 0  # NaN stays NaN
    scaled = divide_by_largest(vectors, jax.lax.stop_gradient(jnp.where(nonzero, largest, 1)))
    squares = (scaled**2).sum(axis=-1, keepdims=True)
    return jnp.where(nonzero, scaled / jnp.sqrt(jnp.where(nonzero, squares, 1)), 0)
