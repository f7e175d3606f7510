"""What the machine does: its matrix product, by which times of different machines compare, and timings."""

import os
import statistics
import time

import jax
import jax.numpy as jnp

SIDE = 1024  # of the matrices
REFERENCE = 93.0  # GFLOP/s of the machine that the project's limits in seconds are written for


def describe():
    """Returns what times depend on."""
    device, cores = jax.devices()[0], len(os.sched_getaffinity(0))
    return f"{device.device_kind}, {cores} core(s), XLA_FLAGS={os.environ.get('XLA_FLAGS', '')!r}"


def matrix_gflops(repeats=12):
    """Returns what the float32 product of two matrices reaches here and now, the median of a dozen."""
    matrix = jnp.full((SIDE, SIDE), 1 / SIDE)
    product = jax.jit(lambda a, b: jnp.dot(a, b, precision="highest"))
    return 2 * SIDE**3 / 1e9 / statistics.median(times(lambda: product(matrix, matrix), repeats))


def comparable(seconds, gflops):
    """Returns how many seconds the machine of REFERENCE would have taken."""
    return seconds * gflops / REFERENCE


def times(call, repeats):
    """Returns the seconds of each of some calls, after one that may compile and warms the caches."""
    jax.block_until_ready(call())
    taken = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(call())
        taken.append(time.perf_counter() - started)
    return taken
