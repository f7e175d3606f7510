"""Measures what training's choice of samples costs: renders rays of training images as a training step does.

    python experiments/speed/sampling_error.py --workdir=RUN [--limits=2,4,6,12,0] [--slots=5,100]

RUN was trained with the sampler "occupancy". Each row has another max_optical_depth, behind which samples are skipped
(0: none is), and another number of slots per ray. "of the mean" is the PSNR of the mean over draws of the samples: what
is left is error that no number of steps averages out.
"""

import pathlib
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.core.metrics import decibels
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.runtime import cli
from jaxnerf.training import auto_config, build, workdir
from jaxnerf.training.config import changed

_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of the run.", required=True)
_LIMITS = flags.DEFINE_list("limits", ["2", "4", "6", "12", "0"], "Values of occupancy.max_optical_depth.")
_SLOTS = flags.DEFINE_list("slots", ["5", "100"], "Values of occupancy.pool_samples_per_ray.")
_BATCHES = flags.DEFINE_integer("batches", 8, "Batches of 1,024 rays.", lower_bound=1)
_DRAWS = flags.DEFINE_integer("draws", 4, "Draws of the samples of each batch.", lower_bound=2)
_TABLE = flags.DEFINE_string("table", "sampling", "Name of the table in --page.")
_RAYS = 1024
HEADS = (
    "max_optical_depth",
    "slots a ray",
    "samples a ray",
    "PSNR",
    "of the mean",
    "of a draw against the mean",
)


def main(argv: list[str]) -> None:
    """Prints a row for each setting."""
    del argv
    config, _ = auto_config.resolve_for_device(workdir.load_config(_WORKDIR.value))
    if config.sampler != "occupancy":
        raise ValueError(
            f"{_WORKDIR.value}: has the sampler {config.sampler!r}, expected 'occupancy'; give another run"
        )
    run = restore_run(_WORKDIR.value)
    step, first = newest_step(run, _WORKDIR.value), config.occupancy.occlusion_start_step
    if run.experiment.cameras is not None:
        raise ValueError(f"{_WORKDIR.value}: trained cameras, too, which this program ignores; give another run")
    if step < first:
        raise ValueError(f"{_WORKDIR.value}: ends at step {step}, before samples are skipped at {first}; train longer")
    experiment = build.build(config)
    _, data = experiment.prepare(experiment.load_split("train"))
    draw = jax.jit(experiment.draw)
    batches = [draw(step + index, jnp.arange(_RAYS), data) for index in range(_BATCHES.value)]
    rows = []
    for limit in map(float, _LIMITS.value):
        for slots in map(float, _SLOTS.value):
            limits = {"occupancy.max_optical_depth": limit, "occupancy.pool_samples_per_ray": slots}
            found = measure(
                build.build_model(changed(config, limits)), run.variables(step), batches, step, _DRAWS.value
            )
            numbers = [f"{found[name]:.2f}" for name in ("samples", "psnr", "psnr_of_mean", "noise")]
            rows.append((f"{limit:g}", f"{slots:g}", *numbers))
    common.publish(common.markdown(HEADS, rows), _TABLE.value)


def measure(model: Any, variables: tuple, batches: list[tuple], step: int, draws: int) -> dict[str, float]:
    """Returns the samples of a ray, and PSNRs of a model's training renderings; see the top of this file.

    Args:
        model: Model of the sampler "occupancy".
        variables: (params, grid).
        batches: pairs of keys [B] and a Batch [B].
        step: the training step, on which the choice of samples may depend.
        draws: at least 2, of the samples of each batch.
    """
    params, grid = variables

    @jax.jit
    def render(keys, rays):
        rendering = model.render(keys, params, grid, rays, step)[-1]
        return rendering.rgb, rendering.samples.used.sum()

    errors, variances, used = [], [], []
    for keys, batch in batches:
        renderings = [
            render(jax.vmap(jax.random.fold_in, (0, None))(keys, index), batch.rays) for index in range(draws)
        ]
        rgb = np.stack([np.float64(rgb) for rgb, _ in renderings])
        errors.append(np.mean((rgb - batch.rgb) ** 2))
        variances.append(rgb.var(axis=0, ddof=1).mean())
        used += [float(count) / len(rgb[0]) for _, count in renderings]
    error, variance = np.mean(errors), np.mean(variances)
    return {
        "samples": float(np.mean(used)),
        "psnr": float(decibels(error)),
        "psnr_of_mean": float(decibels(max(error - variance, 0))),
        "noise": float(decibels(variance)),
    }


if __name__ == "__main__":
    cli.run(main)
