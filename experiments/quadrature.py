"""Error against evaluations and against time of each quadrature rule, on media with closed forms.

    XLA_FLAGS="--xla_cpu_multi_thread_eigen=false" taskset -c 0 python experiments/quadrature.py \
        [--out=runs/quadrature] [--readme=README.md] [--plot=docs/quadrature.png]

Errors are of the colour, in float64 and in float32, over random rays. Times are in float32 on what the
flags above leave: one thread. An evaluation is one question to the scene: hierarchical sampling asks a
third of them in its coarse pass and the rest in its fine one. Writes closed.json into --out;
experiments/quadrature_report.py makes the tables and plots of it, and of what
experiments/trained_quadrature.py measures on trained scenes.
"""

import functools
import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np
import quadrature_report
from absl import flags

from jaxnerf import Rays, render_hierarchical, render_rays
from jaxnerf.fields import analytic
from jaxnerf.runtime import cli

flags.DEFINE_integer("rays", 256, "Rays a medium.")
flags.DEFINE_integer("largest", 1536, "Evaluations at the end of the doubling, which begins at 12.")
flags.DEFINE_integer("repeats", 5, "Timings of each, in turn; the median counts.")
FLAGS = flags.FLAGS

SLOPE = ((0.0, 0.0, 0.2), (0.1, -0.1, -0.15), (0.05, 0.05, -0.2))
COLOURED = {"rgb": (0.4, 0.5, 0.6), "rgb_slope": SLOPE}
MEDIA = {
    "homogeneous fog": analytic.slab(1.0, lower=-10.0, upper=10.0, **COLOURED),
    "linear density": analytic.linear(1.0, **COLOURED),
    "exponential atmosphere": analytic.atmosphere(8.0, scale_height=0.07, **COLOURED),
    "Gaussian blob": analytic.blob(3.0, center=(0.0, 0.0, 1.5), deviation=0.5, **COLOURED),
    "ball with an edge": analytic.ball(2.0, center=(0.0, 0.0, 1.5), **COLOURED),
}
SAMPLINGS = ("uniform", "stratified", "hierarchical")


def main(argv):
    """Measures all and reports."""
    del argv
    machine = quadrature_report.machine()
    print(machine)
    numbers = [12 * 2**i for i in range(20) if 12 * 2**i <= FLAGS.largest]
    with jax.enable_x64(True):
        rays = random_rays(FLAGS.rays)
        wanted = [np.asarray(jax.jit(medium.exact)(rays).rgb) for medium in MEDIA.values()]
    rows, timed = [], {}
    for rule in quadrature_report.RULES:
        for sampling in SAMPLINGS:
            for number in numbers:
                doubled = colours(rule, sampling, number, rays, jnp.float64)
                single = colours(rule, sampling, number, rays, jnp.float32, timed)
                for medium, truth, fine, coarse in zip(MEDIA, wanted, doubled, single, strict=True):
                    names = {"medium": medium, "rule": rule, "sampling": sampling, "evaluations": number}
                    rows.append(names | error(fine - truth) | {"rms32": error(coarse - truth)["rms"]})
    seconds = measure(timed, FLAGS.repeats)
    for row in rows:
        key = row["rule"], row["sampling"], row["evaluations"], row["medium"]
        row["microseconds"] = 1e6 * seconds[key] / FLAGS.rays
    quadrature_report.save("closed.json", {"machine": machine, "rays": FLAGS.rays, "rows": rows})
    quadrature_report.report()


def random_rays(count):
    """Returns Rays between two random points, the first above the blob, the second near z = 0."""
    rng = np.random.default_rng(0)
    begin = rng.uniform((-1.5, -1.5, 2.7), (1.5, 1.5, 3.5), (count, 3))
    end = rng.uniform((-1.0, -1.0, 0.02), (1.0, 1.0, 0.2), (count, 3))
    # Numbers that float32 holds, so that both precisions see the same rays.
    origins, directions = (np.float64(np.float32(x)) for x in (begin, (end - begin) / 4))
    viewdirs = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    near = np.zeros(count)
    return Rays(origins=origins, directions=directions, viewdirs=viewdirs, near=near, far=near + 4)


def colours(rule, sampling, number, rays, dtype, timed=None):
    """Returns each medium's colours [R, 3] in a precision, and adds the calls to those to be timed."""
    with jax.enable_x64(dtype == jnp.float64):
        rays = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), rays)
        keys = jax.random.split(jax.random.key(0), len(rays.near)) if sampling == "stratified" else None
        run = jax.jit(functools.partial(render, rule=rule, sampling=sampling, number=number))
        found = [np.asarray(run(keys, rays, medium)) for medium in range(len(MEDIA))]
    if timed is not None:
        for medium, name in enumerate(MEDIA):
            timed[rule, sampling, number, name] = functools.partial(run, keys, rays, medium)
    return found


def render(keys, rays, medium, *, rule, sampling, number):
    """Returns colours [R, 3] of the medium of that number: one compilation serves all media."""

    def scene(x, viewdirs):
        return jax.lax.switch(medium, [medium.scene for medium in MEDIA.values()], x, viewdirs)

    if sampling != "hierarchical":
        return render_rays(keys, scene, rays, num_samples=number, rule=rule).rgb
    third = {"num_coarse": number // 3, "num_fine": number // 3}
    return render_hierarchical(keys, scene, scene, rays, rule=rule, **third)[1].rgb


def error(difference):
    return {"rms": float(np.sqrt(np.mean(difference**2))), "max": float(np.abs(difference).max())}


def measure(calls, repeats):
    """Returns the median seconds of each call; all calls take turns."""
    times = {key: [] for key in calls}
    for turn in range(repeats + 1):
        for key, call in calls.items():
            started = time.perf_counter()
            jax.block_until_ready(call())
            if turn:  # the first warms the caches
                times[key].append(time.perf_counter() - started)
    return {key: statistics.median(values) for key, values in times.items()}


if __name__ == "__main__":
    cli.run(main)
