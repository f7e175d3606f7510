"""Measures a training step of the paper's size against its matrix products alone.

    python experiments/speed/step_cost.py [--config=configs/blender_paper.py]

Prints, from one process and in turn: the time of a plain chain of the step's matrix products, forward and backward,
with its fastest chunk of rows and layout; the time of the step for several microbatch sizes; the median of their
ratios; and, from a fresh process, the time from start to first step. The embedded scene replaces the dataset, as
reading images is no part of a step.
"""

import pathlib
import statistics
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.runtime import cli, devices
from jaxnerf.training.build import build_model

_CONFIG = cli.define_config("Config of the run whose step is measured: a name, or the path of a file.")
_REPEATS = flags.DEFINE_integer("repeats", 3, "Timings of each; the median counts.", lower_bound=1)
_STARTED = flags.DEFINE_float("started", 0.0, "Internal: when that process was started.")
_FIRST_STEP = flags.DEFINE_bool("first_step", False, "Internal: take one step and exit.")
_ROWS = (4096, 8192, 12288, 16384)  # of a chunk
flags.FLAGS.set_default("config", "blender_paper")


def main(argv: list[str]) -> None:
    """Measures the chain and the steps, then starts the process that takes the first step."""
    del argv
    config = common.changed(_CONFIG.value, {"data.format": "synthetic", "data.dir": "", "data.factor": 1})
    rays = config.train.batch_size
    if _FIRST_STEP.value:
        step = common.compile_step(config)
        print(f"first step begins {time.time() - _STARTED.value:.1f} s after the process")
        jax.block_until_ready(step.run(step.state, step.data, step.positions))
        print(f"first step ends   {time.time() - _STARTED.value:.1f} s after the process")
        return
    print(common.describe_machine())
    chains = {(rows, first): _chain(config, rows, first) for first in ("rows", "features") for rows in _ROWS}
    best = min(chains, key=lambda key: min(common.times(chains[key], 2)))
    flops = _flops(config)
    print(f"fastest chain of products: chunks of {best[0]} rows, {best[1]} first")
    default = devices.default_microbatch(rays, build_model(config).samples_per_ray, jax.default_backend())
    for size in sorted({size for size in (32, 64, 128, default) if rays % size == 0}):
        step = _step(common.compile_step(common.changed(config, {"train.microbatch_size": size})))
        jax.block_until_ready(step())
        pairs = [(common.seconds(chains[best]), common.seconds(step)) for _ in range(_REPEATS.value)]
        chain, seconds = (statistics.median(times) for times in zip(*pairs, strict=True))
        ratio = statistics.median(a / b for a, b in pairs)
        print(
            f"step of {rays} rays in microbatches of {size:>3}: {seconds:6.3f} s, {rays / seconds:5.0f} rays/s; "
            f"chain {chain:6.3f} s, {flops / chain / 1e9:5.1f} GFLOP/s; ratio {100 * ratio:5.1f} %"
            + ("  <- the default" if size == default else "")
        )
    subprocess.run([sys.executable, *sys.argv, "--first_step", f"--started={time.time()}"], check=True)


def _step(step):
    """Returns a function that takes one training step."""
    state = step.state

    def once():
        nonlocal state
        state, metrics = step.run(state, step.data, step.positions)
        return metrics

    return once


def _chain(config, rows, first):
    """Returns a function that computes the products of both networks over all samples, in chunks of rows."""
    parts = []
    for network, samples in _networks(config):
        sizes = _layers(network)
        keys = jax.random.split(jax.random.key(0), len(sizes))
        kernels = {
            name: jax.random.normal(key, size) / 16 for key, (name, size) in zip(keys, sizes.items(), strict=True)
        }
        encoded = sizes["trunk_0"][0]
        x = jnp.ones((rows, encoded) if first == "rows" else (encoded, rows))
        parts.append((kernels, x, -(-samples // rows)))
    chain = jax.jit(_products, static_argnums=(2, 3))
    return lambda: [chain(kernels, x, chunks, first) for kernels, x, chunks in parts]


def _networks(config):
    rays, coarse = config.train.batch_size, config.sampling.num_coarse
    return (config.coarse, rays * coarse), (config.fine, rays * (coarse + config.sampling.num_fine))


def _flops(config):
    """Returns the FLOPs of all products: forward, gradient of the kernel, gradient of the input.

    The first layer and the skip have no gradient of the input: nothing before them is learned.
    """
    total = 0
    for network, samples in _networks(config):
        for name, (a, b) in _layers(network).items():
            total += samples * 2 * a * b * (2 if name in ("trunk_0", "skip") else 3)
    return total


def _layers(network):
    """Returns (inputs, outputs) of each product that every sample takes part in, by name."""
    encoded, width = 3 * (1 + 2 * network.num_freqs), network.width
    layers = {f"trunk_{i}": (width if i else encoded, width) for i in range(network.depth)}
    if network.skip_layer + 1 < network.depth:
        layers["skip"] = (encoded, width)
    layers["density"] = (width, 1)
    if network.use_viewdirs:
        layers["view"] = (width, network.view_width)  # with the bottleneck, as no activation separates them
    return layers | {"rgb": (network.view_width if network.use_viewdirs else width, 3)}


def _products(kernels, x, chunks, first):
    """Computes the forward and backward pass of the network without anything between its products."""

    def product(kernel, value):
        return value @ kernel if first == "rows" else jnp.tensordot(kernel, value, axes=(0, 0))

    def forward(kernels, x):
        hidden, depth = x, sum(name.startswith("trunk") for name in kernels)
        for layer in range(depth):
            hidden = product(kernels[f"trunk_{layer}"], hidden)
            if layer == depth - 3 and "skip" in kernels:
                hidden = hidden + product(kernels["skip"], x)
        density = product(kernels["density"], hidden)
        for name in ("view", "rgb"):
            hidden = product(kernels[name], hidden) if name in kernels else hidden
        return density, hidden

    def chunk(total, _):
        # Each chunk's input differs, so that no product can be moved out of the loop.
        outputs, pull = jax.vjp(lambda kernels: forward(kernels, x + total["density"][0, 0]), kernels)
        return jax.tree.map(jnp.add, total, *pull(outputs)), None

    return jax.lax.scan(chunk, jax.tree.map(jnp.zeros_like, kernels), length=chunks)[0]


if __name__ == "__main__":
    cli.run(main)
