"""Arithmetic that must hold in value and in slope, for all of the core."""

import jax
import jax.numpy as jnp


@jax.custom_jvp
def divide(a, b):
    """Returns a / b for arrays of one shape; its slope holds no 1 / b^2, which overflows before a / b^2."""
    return a / b


@divide.defjvp
def _divide_jvp(primals, tangents):
    quotient, inverse = primals[0] / primals[1], 1 / primals[1]
    return quotient, tangents[0] * inverse - (quotient * inverse) * tangents[1]


def clamp(x, lower, upper):
    """Returns x within lower and upper, else the nearer of them: a clip whose slope is whole at both."""
    return jnp.where(x < lower, lower, jnp.where(x > upper, upper, x))


def at_least_float32(*arrays):
    """Returns the arrays in the widest of their types and float32."""
    arrays = [jnp.asarray(array) for array in arrays]
    dtype = jnp.result_type(jnp.float32, *(array.dtype for array in arrays))
    return [array.astype(dtype) for array in arrays]


def norm(vectors):
    """Returns the length [...] of vectors [..., D] without over- or underflow; 0, with gradient 0, for 0."""
    largest = jnp.abs(vectors).max(axis=-1, keepdims=True)
    nonzero = largest != 0  # NaN stays NaN
    largest = jax.lax.stop_gradient(jnp.where(nonzero, largest, 1))
    squares = ((vectors / largest) ** 2).sum(axis=-1, keepdims=True)
    return jnp.where(nonzero, largest * jnp.sqrt(jnp.where(nonzero, squares, 1)), 0)[..., 0]


def normalize(vectors):
    """Returns vectors [..., D] at unit length; 0, with gradient 0, for a zero vector."""
    largest = jnp.abs(vectors).max(axis=-1, keepdims=True)
    nonzero = largest != 0  # NaN stays NaN
    scaled = vectors / jax.lax.stop_gradient(jnp.where(nonzero, largest, 1))
    squares = (scaled**2).sum(axis=-1, keepdims=True)
    return jnp.where(nonzero, scaled / jnp.sqrt(jnp.where(nonzero, squares, 1)), 0)
