"""Published peaks of accelerators, measured ceilings of this one, and the configs that the runbook trains."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import common
import jax
import jax.numpy as jnp


class Peaks(NamedTuple):
    """What the vendor states about a device (dense, without sparsity).

    Attributes:
        bytes_per_second: of its memory.
        float32, tf32, bfloat16: FLOP/s of float32 arithmetic, and of matrix products in the two other precisions.
        launch_seconds: that a kernel costs at least when it is launched by the host; assumed, not published.
        visit_seconds: that the host takes to read a predicate from the device and go on; assumed, not published.
    """

    bytes_per_second: float
    float32: float
    tf32: float
    bfloat16: float
    launch_seconds: float = 3e-6
    visit_seconds: float = 20e-6


# Data sheets of the SXM parts (NVIDIA, "H100 Tensor Core GPU" and "H200 Tensor Core GPU"), halved where they state
# rates with sparsity.
PEAKS = {
    "H100": Peaks(3.35e12, 67e12, 494e12, 989e12),
    "H200": Peaks(4.8e12, 67e12, 494e12, 989e12),
}
SECTOR = 32  # bytes: the least that a read or an atomic addition at a random place moves

FULL_SIZE = {"data.factor": 1}
# The steps never end a run of limited time, and the learning rate follows the time.
TIMED = {"train.max_steps": 10**7, "train.lr_steps": 10**7}

_TINY = {
    "data.format": "synthetic",
    "data.dir": "",
    "data.size": 24,
    "data.factor": 1,
    "data.width": 24,
    "data.background": "white",
    "data.ndc": False,
    "hash_grid.table_size": 2**10,
    "hash_grid.width": 8,
    "hash_grid.view_width": 8,
    "hash_grid.resolutions": (8, 16),
    "train.batch_size": 64,
    "train.save_every": 20,
    "train.log_every": 10,
    "train.preview_every": 0.0,
    "eval.chunk": 256,
    "eval.summary_seconds": 0.0,
}
_TINY |= {f"{name}.{field}": 2 for name in ("coarse", "fine") for field in ("depth", "num_freqs", "num_view_freqs")}
_TINY |= {f"{name}.skip_layer": 0 for name in ("coarse", "fine")}
_TINY |= {f"{name}.{field}": 8 for name in ("coarse", "fine") for field in ("width", "view_width")}
_TINY |= {"sampling.num_coarse": 8, "sampling.num_fine": 8}


def configuration(base: str, overrides: dict[str, Any], *, tiny: bool):
    """Returns the config of that name with fields replaced; tiny: a network of seconds on the embedded scene."""
    return common.configuration(base, overrides | (_TINY if tiny else {}))


def measure_ceilings(tiny: bool) -> dict[str, float]:
    """Measures what this device reaches: matrix products, a copy, random reads and additions, and a dispatch."""
    found = {
        "float32_flops": product_flops(tiny),
        "tf32_flops": product_flops(tiny, precision="default"),
        "bfloat16_flops": product_flops(tiny, jnp.bfloat16, "default"),
    }
    count = 2**16 if tiny else 2**22 if _on_cpu() else 2**26
    values = jnp.ones(4 * count)
    double = jax.jit(lambda x: 2 * x)
    found["copy_bytes"] = 2 * values.nbytes / repeated(double, values)
    table = jnp.ones((2**12 if tiny else 2**21, 4))
    rows = jax.random.randint(jax.random.key(1), (count // 8,), 0, len(table))
    gather = jax.jit(lambda table, rows: table[rows].sum(axis=0))
    add = jax.jit(lambda table, rows: table.at[rows].add(1.0))
    found["gather_rows"] = rows.size / repeated(gather, table, rows)
    found["scatter_rows"] = rows.size / repeated(add, table, rows)
    tick = jax.jit(lambda x: x + 1)
    number = jnp.float32(0)
    found["dispatch_seconds"] = repeated(tick, number, repeats=100)
    return found


def product_flops(tiny: bool, dtype: Any = jnp.float32, precision: str = "highest") -> float:
    """Returns the FLOP/s of a product of square matrices, of a size that suits the device."""
    side = 256 if tiny else 1024 if _on_cpu() else 8192
    matrix = jax.random.normal(jax.random.key(0), (side, side)).astype(dtype)
    product = jax.jit(functools.partial(jnp.dot, precision=precision))
    return 2 * side**3 / repeated(product, matrix, matrix)


def _on_cpu():
    return jax.default_backend() == "cpu"


def repeated(function: Callable[..., Any], *arguments: Any, repeats: int = 10) -> float:
    """Returns the seconds of a call, the mean of several in a row after a first one that may compile."""

    def several():
        for _ in range(repeats):
            result = function(*arguments)
        return result

    return min(common.times(several, 3)) / repeats
