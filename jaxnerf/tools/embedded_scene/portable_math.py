"""Arithmetic in numpy whose results have the same bits on every machine.

IEEE 754 defines sums, products, quotients and square roots to the last bit. It does not define exponentials, of which
each library, and each instruction set, has its own. Here they consist of what it does define.
"""

import math

import numpy as np
from jaxtyping import Float32

_TERMS = [1 / math.factorial(n) for n in range(8)]  # of the series of exp: within 1e-8 on [-ln 2 / 2, ln 2 / 2]
_LN2_HIGH, _LN2_LOW = 0.693359375, -2.12194440e-4  # the first times an integer is exact
_LIMIT = 87.0  # beyond, the result would over- or underflow


def exp(x: Float32[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Computes exp(x), within a fraction of 2e-7; beyond -87 and 87 that of the limit."""
    x = np.minimum(np.maximum(x, -_LIMIT), _LIMIT)
    power = np.rint(x * (1 / math.log(2)))
    x -= power * _LN2_HIGH
    x -= power * _LN2_LOW
    value = np.full_like(x, _TERMS[-1])
    for term in _TERMS[-2::-1]:
        value *= x
        value += term
    bits = (power.astype(np.int32) + 127) << 23
    value *= bits.view(np.float32)  # 2^power
    return value


def sigmoid(x: Float32[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Computes 1 / (1 + exp(-x)), within a fraction of 4e-7."""
    below = exp(-x)
    below += 1
    return np.reciprocal(below)
