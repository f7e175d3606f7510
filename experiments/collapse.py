"""How often a training collapses to an image of one colour, with and without what engine/revival.py does.

    python experiments/collapse.py [--seeds=20] [--steps=600] [--out=runs/collapse] [--readme=README.md]

Trains the embedded scene with a network that invites it (ReLU density, eight narrow layers without a skip, a
high learning rate), each seed with train.max_reinits=0 and with the default. Prints a row a run, then the
table; --out keeps both as collapse.json; --readme replaces the table between <!-- collapse --> and
<!-- end of collapse -->. A run has collapsed when its network is dead at the end.
"""

import functools
import hashlib
import json
import pathlib
import statistics
import sys
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import table  # which defines --readme
from absl import flags

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent))  # for configs

from configs import default
from jaxnerf import pixel_grid, psnr
from jaxnerf.data.ray_batches import draw_batch
from jaxnerf.evaluation.evaluate import reference
from jaxnerf.runtime import cli, devices
from jaxnerf.training import dead_networks as dead_networks_module
from jaxnerf.training import workdir
from jaxnerf.training.build import build
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step

_SEEDS = flags.DEFINE_integer("seeds", 20, "Runs each way.", lower_bound=1)
_STEPS = flags.DEFINE_integer("steps", 600, "Of a run.", lower_bound=1)
_OUT = flags.DEFINE_string("out", None, "Folder that collapse.json goes to.")
MARKS = ("<!-- collapse -->", "<!-- end of collapse -->")
HEADS = (
    "train.max_reinits",
    "runs",
    "of one colour at the end",
    "begun anew",
    "found at step",
    "PSNR",
    "worst",
)


def main(argv):
    """Runs all seeds both ways and reports."""
    del argv
    study = Study(_STEPS.value)
    rows = []
    for seed in range(_SEEDS.value):
        for allowed in (0, default.get_config().train.max_reinits):
            rows.append(study.run(seed, allowed))
            print(json.dumps(rows[-1]), flush=True)
    lines = table.markdown(HEADS, [summary(group) for group in both(rows)]) + ["", same(rows)]
    print("\n".join(lines))
    if _OUT.value:
        pathlib.Path(_OUT.value).mkdir(parents=True, exist_ok=True)
        text = json.dumps({"rows": rows, "table": lines}, indent=2) + "\n"
        workdir.write_text(pathlib.Path(_OUT.value) / "collapse.json", text)
    if flags.FLAGS.readme:
        table.replace(pathlib.Path(flags.FLAGS.readme), lines, MARKS)


def inviting_config(steps):
    """Returns a configuration with which networks die."""
    config = default.get_config()
    config.data.size = 40
    network = config.fine
    network.depth, network.width, network.skip_layer = 8, 32, 8
    network.num_freqs, network.use_viewdirs = 5, False
    config.sampling.num_coarse, config.sampling.num_fine = 16, 0
    train = config.train
    train.batch_size, train.max_steps, train.lr_steps = 128, steps, steps
    train.lr_init, train.lr_final = 0.06, 0.001
    return config


class Study:
    """The runs of one configuration, compiled once: the seed is an argument."""

    def __init__(self, steps):
        config = inviting_config(steps)
        self._experiment = build(config)
        self._views = self._experiment.load_views("test")
        model, optimizer = self._experiment.model, self._experiment.optimizer

        def draw(step, positions, data):
            views, _, seed = data
            return draw_batch(seed, step, positions, views)

        self._create = jax.jit(lambda seed: create_state(model, optimizer, seed))
        self._step, _, self._data = devices.compile_step(
            make_train_step(model, optimizer, draw),
            functools.partial(self._create, 0),
            (self._experiment.load_views("train"), None, jnp.int32(0)),
            batch_size=config.train.batch_size,
            samples_per_ray=self._experiment.samples_per_ray,
            mode="jit",
        )
        self._render = jax.jit(lambda params, rays: model.view(params, None, rays).rgb)

    def run(self, seed, allowed):
        """Returns what became of a seed, as numbers, where dead networks begin anew so many times."""
        options = SimpleNamespace(**{**vars(self._experiment.train), "revive": allowed})
        look = dead_networks_module.make_reinitializer(
            self._experiment._replace(seed=seed, train=options), f"seed {seed}"
        )
        state, data = self._create(seed), (*self._data[:2], jnp.int32(seed))
        started, found, counted = time.perf_counter(), [], 0
        for step in range(1, options.max_steps + 1):
            state, metrics = look(step, *self._step(state, data))
            if step % dead_networks_module.LOOK_EVERY == 0 and int(metrics["num_reinits"]) > counted:
                found, counted = [*found, step], int(metrics["num_reinits"])
        dead = dead_networks_module.dead_networks(metrics)
        leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(state.params)]
        return {
            "seed": seed,
            "revive": allowed,
            "psnr": self._score(state.params),
            "dead": dead,
            "num_reinits": counted,
            "found": found,
            "seconds": time.perf_counter() - started,
            "parameters": hashlib.sha256(b"".join(leaves)).hexdigest(),
        }

    def _score(self, params):
        values = []
        for index, (height, width) in enumerate(np.asarray(self._views.size)):
            rays = self._experiment.view_rays(self._views, index, pixel_grid(height, width))
            values.append(float(psnr(self._render(params, rays), reference(self._views, index))))
        return statistics.mean(values)


def both(rows):
    """Returns the rows of the runs without and with new beginnings."""
    return [row for row in rows if not row["revive"]], [row for row in rows if row["revive"]]


def summary(rows):
    """Returns the cells of one way's runs."""
    scores, found = [row["psnr"] for row in rows], [step for row in rows for step in row["found"]]
    return (
        str(rows[0]["revive"]),
        str(len(rows)),
        str(sum(bool(row["dead"]) for row in rows)),
        f"{sum(row['num_reinits'] for row in rows)} times in {sum(row['num_reinits'] > 0 for row in rows)} runs",
        f"{statistics.median(found):g} (first {min(found)}, last {max(found)})" if found else "-",
        f"{statistics.median(scores):.2f} dB",
        f"{min(scores):.2f} dB",
    )


def same(rows):
    """Returns the sentence about the runs that had no need of it."""
    pairs = [pair for pair in zip(*both(rows), strict=True) if not pair[1]["num_reinits"]]
    equal = sum(a["parameters"] == b["parameters"] for a, b in pairs)
    return (
        f"Of {len(pairs)} runs in which no network died, {equal} end with the same parameters both ways, bit for bit."
    )


if __name__ == "__main__":
    cli.run(main)
