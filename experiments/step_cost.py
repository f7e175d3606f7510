"""What a training step of the paper's size costs beside its matrix products alone.

    python experiments/step_cost.py [--config=configs/blender_paper.py]

Prints, from one process and in turn: the time of a plain chain of the step's matrix products, forward
and backward, at its best block of rows and best layout; the time of the step (batch 1024, both networks,
Adam) for several block sizes; the median of their ratios; and, from a fresh process, the time from start
to first step.
The embedded scene stands in for the images, whose reading is not the step's cost.
"""

import functools
import importlib.util
import os
import statistics
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
from absl import app, flags

from jaxnerf.runtime import devices
from jaxnerf.training import build
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step

_CONFIG = flags.DEFINE_string("config", "configs/blender_paper.py", "Run whose step is measured.")
_REPEATS = flags.DEFINE_integer("repeats", 3, "Timings of each figure; the best counts.")
_STARTED = flags.DEFINE_float("started", 0.0, "Internal: when that process was started.")
_FIRST_STEP = flags.DEFINE_bool("first_step", False, "Internal: take one step and leave.")


def main(argv):
    del argv
    experiment, config = _experiment()
    views = experiment.load_views("train")
    if _FIRST_STEP.value:
        run, state, data = _compiled(experiment, views, 0)
        print(f"first step begins {time.time() - _STARTED.value:.1f} s after the process")
        jax.block_until_ready(run(state, data))
        print(f"first step ends   {time.time() - _STARTED.value:.1f} s after the process")
        return
    flags_set = os.environ.get("XLA_FLAGS", "")
    print(f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores, XLA_FLAGS={flags_set!r}")
    rays = config.train.batch_size
    share = devices.default_microbatch(rays, experiment.samples_per_ray, jax.default_backend())
    chains = {
        (rows, layout): _chain(config, rows, layout)
        for layout in ("rows first", "features first")
        for rows in (4096, 8192, 12288, 16384)
    }
    best = min(chains, key=lambda key: min(_seconds(chains[key]) for _ in range(2)))
    flops = _flops(config)
    print(f"best chain of products: blocks of {best[0]} rows, {best[1]}")
    for block in sorted({32, 64, 128, share}):
        step = _step(experiment, views, block)
        pairs = [(_seconds(chains[best]), _seconds(step)) for _ in range(_REPEATS.value)]
        chain, seconds = (statistics.median(times) for times in zip(*pairs, strict=True))
        ratio = statistics.median(a / b for a, b in pairs)
        print(
            f"step of {rays} rays in blocks of {block:>3}: {seconds:6.3f} s, {rays / seconds:5.0f} rays/s; "
            f"chain {chain:6.3f} s, {flops / chain / 1e9:5.1f} GFLOP/s; ratio {100 * ratio:5.1f} %"
            + ("  <- the default" if block == share else "")
        )
    subprocess.run([sys.executable, *sys.argv, "--first_step", f"--started={time.time()}"], check=True)


def _experiment():
    spec = importlib.util.spec_from_file_location("config", _CONFIG.value)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    config = module.get_config()
    config.data.format = "synthetic"
    return build.build(config), config


def _compiled(experiment, views, block):
    step = make_train_step(experiment.model, experiment.optimizer, experiment.draw)
    state = functools.partial(create_state, experiment.model, experiment.optimizer, experiment.seed)
    sizes = {"batch_size": experiment.train.batch_size, "microbatch_size": block}
    samples = experiment.samples_per_ray
    return devices.compile_step(step, state, (views, None), samples_per_ray=samples, mode="jit", **sizes)


def _step(experiment, views, block):
    """Returns a function that takes one training step."""
    run, state, data = _compiled(experiment, views, block)
    states = [state]

    def once():
        states[0], metrics = run(states[0], data)
        return metrics

    return once


def _chain(config, rows, layout):
    """Returns a function that makes the products of both networks over all samples, in blocks of rows."""
    parts = []
    for network, samples in _networks(config):
        sizes = _layers(network)
        keys = jax.random.split(jax.random.key(0), len(sizes))
        kernels = {
            name: jax.random.normal(key, size) / 16 for key, (name, size) in zip(keys, sizes.items(), strict=True)
        }
        encoded = sizes["trunk_0"][0]
        x = jnp.ones((rows, encoded) if layout == "rows first" else (encoded, rows))
        parts.append((kernels, x, -(-samples // rows)))
    chain = jax.jit(_products, static_argnums=(2, 3))
    return lambda: [chain(kernels, x, blocks, layout) for kernels, x, blocks in parts]


def _seconds(function):
    """Returns how long a call takes, after a first one that may compile."""
    if function not in _warm:
        jax.block_until_ready(function())
        _warm.add(function)
    started = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - started


_warm = set()


def _networks(config):
    rays, coarse = config.train.batch_size, config.sampling.num_coarse
    return (config.coarse, rays * coarse), (config.fine, rays * (coarse + config.sampling.num_fine))


def _flops(config):
    """Returns the operations of all products: forward, gradient of the kernel, gradient of the input.

    The first layer and the skip have no gradient of the input: nothing learned lies behind it.
    """
    total = 0
    for network, samples in _networks(config):
        for name, (a, b) in _layers(network).items():
            total += samples * 2 * a * b * (2 if name in ("trunk_0", "skip") else 3)
    return total


def _layers(network):
    """Returns (inputs, outputs) of each product that is made for every sample, by name."""
    encoded, width = 3 * (1 + 2 * network.num_freqs), network.width
    layers = {f"trunk_{i}": (width if i else encoded, width) for i in range(network.depth)}
    if network.skip_layer + 1 < network.depth:
        layers["skip"] = (encoded, width)
    layers["density"] = (width, 1)
    if network.use_viewdirs:
        layers["view"] = (width, network.view_width)  # with the bottleneck, as no activation parts them
    return layers | {"rgb": (network.view_width if network.use_viewdirs else width, 3)}


def _products(kernels, x, blocks, layout):
    """The forward and backward pass of the network without anything between its products."""

    def product(kernel, value):
        return value @ kernel if layout == "rows first" else jnp.tensordot(kernel, value, axes=(0, 0))

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

    def block(total, _):
        # Each block's input differs, so that no product can be moved out of the loop.
        outputs, pull = jax.vjp(lambda kernels: forward(kernels, x + total["density"][0, 0]), kernels)
        return jax.tree.map(jnp.add, total, *pull(outputs)), None

    return jax.lax.scan(block, jax.tree.map(jnp.zeros_like, kernels), length=blocks)[0]


if __name__ == "__main__":
    app.run(main)
