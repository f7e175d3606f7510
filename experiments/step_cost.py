"""What a training step of the paper's size costs beside its matrix products alone.

    python experiments/step_cost.py [--config=configs/blender_paper.py]

Prints, from one process: the time of the step (batch 1024, both networks, Adam) for several block
sizes; the time of a plain chain of the same matrix products, forward and backward, at its best block
of rows and best layout; their ratio; and, from a fresh process, the time from start to first step.
The embedded scene stands in for the images, whose reading is not the step's cost.
"""

import importlib.util
import os
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
from absl import app, flags

from jaxnerf.engine import build, parallel
from jaxnerf.engine.state import create_state
from jaxnerf.engine.step import make_train_step

_CONFIG = flags.DEFINE_string("config", "configs/blender_paper.py", "Run whose step is measured.")
_REPEATS = flags.DEFINE_integer("repeats", 3, "Timings of each figure; the best counts.")
_FIRST_STEP = flags.DEFINE_bool("first_step", False, "Internal: take one step and leave.")


def main(argv):
    del argv
    experiment, config = _experiment()
    views = experiment.load_views("train")
    if _FIRST_STEP.value:
        run, state, data = _compiled(experiment, views, 0)
        jax.block_until_ready(run(state, data))
        return
    rays, coarse = config.train.batch_size, config.sampling.num_coarse
    fine = coarse + config.sampling.num_fine
    share = parallel.default_block(rays, fine, jax.default_backend())
    print(f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores, XLA_FLAGS={os.environ.get('XLA_FLAGS', '')!r}")
    chains = {}
    for rows in (1024, 2048, 4096, 8192, 16384, 32768):
        for layout in ("rows first", "features first"):
            seconds, products = _chain_seconds(config, rays * coarse, rays * fine, rows, layout)
            chains[rows, layout] = seconds
            print(f"chain of products, blocks of {rows:>6} rows, {layout:<14}: {seconds:7.3f} s, "
                  f"{products / seconds / 1e9:6.1f} GFLOP/s")  # fmt: skip
    best = min(chains.values())
    for block in sorted({16, 32, 64, 128, 256, share}):
        seconds = _step_seconds(experiment, views, block)
        mark = "  <- the default" if block == share else ""
        print(f"training step, {rays} rays in blocks of {block:>4}: {seconds:7.3f} s, {rays / seconds:6.0f} rays/s, "
              f"{100 * best / seconds:5.1f} % of the best chain{mark}")  # fmt: skip
    started = time.perf_counter()
    subprocess.run([sys.executable, *sys.argv, "--first_step"], check=True)
    print(f"from process start to the end of the first step: {time.perf_counter() - started:.1f} s")


def _experiment():
    spec = importlib.util.spec_from_file_location("config", _CONFIG.value)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    config = module.get_config()
    config.data.format = "synthetic"
    return build.build(config), config


def _compiled(experiment, views, block):
    step = make_train_step(experiment.model, experiment.optimizer, experiment.draw)
    state = create_state(experiment.model, experiment.optimizer, experiment.seed)
    sizes = {"batch_size": experiment.train.batch_size, "block_size": block}
    samples = experiment.samples_per_ray
    return parallel.compile_step(step, state, (views, None), samples_per_ray=samples, mode="jit", **sizes)


def _step_seconds(experiment, views, block):
    run, state, data = _compiled(experiment, views, block)
    times = []
    for _ in range(_REPEATS.value + 1):
        started = time.perf_counter()
        state, _ = jax.block_until_ready(run(state, data))
        times.append(time.perf_counter() - started)
    return min(times[1:])


def _chain_seconds(config, coarse_samples, fine_samples, rows, layout):
    """Returns seconds and FLOPs of the products of both networks over all samples, in blocks of rows."""
    total, flops = 0.0, 0.0
    for network, samples in ((config.coarse, coarse_samples), (config.fine, fine_samples)):
        sizes = _layers(network)
        blocks = -(-samples // rows)
        keys = jax.random.split(jax.random.key(0), len(sizes))
        kernels = [jax.random.normal(key, size) / 16 for key, size in zip(keys, sizes, strict=True)]
        inputs = {size: jnp.ones((rows, size) if layout == "rows first" else (size, rows)) for size in
                  {side for pair in sizes for side in pair}}  # fmt: skip
        chain = jax.jit(_chain, static_argnums=(2, 3))
        times = []
        for _ in range(_REPEATS.value + 1):
            started = time.perf_counter()
            jax.block_until_ready(chain(kernels, inputs, blocks, layout))
            times.append(time.perf_counter() - started)
        total += min(times[1:])
        # Forward, gradient of the kernel, gradient of the input (not of the first: nothing is behind it).
        flops += blocks * rows * sum(2 * a * b * (2 if i == 0 else 3) for i, (a, b) in enumerate(sizes))
    return total, flops


def _layers(network):
    """Returns (inputs, outputs) of each product that is made for every sample."""
    encoded, width = 3 * (1 + 2 * network.num_freqs), network.width
    trunk = [(encoded, width)] + [(width, width)] * (network.depth - 1)
    skip = [(encoded, width)] if network.skip_layer + 1 < network.depth else []
    head = [(width, width), (width, network.view_width), (network.view_width, 3)] if network.use_viewdirs else []
    return trunk + skip + [(width, 1)] + (head or [(width, 3)])


def _chain(kernels, inputs, blocks, layout):
    """Every product of a forward and a backward pass, and nothing between them."""

    def product(kernel, x):
        return x @ kernel if layout == "rows first" else jnp.tensordot(kernel, x, axes=(0, 0))

    def back(kernel, g):
        return g @ kernel.T if layout == "rows first" else jnp.tensordot(kernel, g, axes=(1, 0))

    def gradient(x, g):
        return x.T @ g if layout == "rows first" else jnp.tensordot(x, g, axes=(1, 1))

    def block(total, _):
        grads = []
        keep = 0.0
        for index, kernel in enumerate(kernels):
            # Each block's operands differ, so that no product can be left out or moved out of the loop.
            x = inputs[kernel.shape[0]] + total[0][0, 0]
            g = inputs[kernel.shape[1]] + total[0][0, 0]
            forward = product(kernel, x)
            keep += forward[0, 0] if index == 0 else forward[0, 0] + back(kernel, g)[0, 0]
            grads.append(gradient(x, g))
        return [old + new + keep for old, new in zip(total, grads, strict=True)], None

    zeros = [jnp.zeros_like(kernel) for kernel in kernels]
    return jax.lax.scan(block, zeros, length=blocks)[0]


if __name__ == "__main__":
    app.run(main)
