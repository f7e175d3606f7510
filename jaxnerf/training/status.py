"""What a training says of itself: what runs on what, then rows of metrics, each also as a line to read."""

import jax
import numpy as np

from jaxnerf.core.metrics import decibels
from jaxnerf.runtime.devices import devices_of
from jaxnerf.training import dead_networks as dead_networks_module


def header(experiment, views, state, survey_seconds, compile_seconds):
    """Returns the lines that say once what runs on what."""
    devices = devices_of(experiment.train.parallel)
    machines = f", in {jax.process_count()} processes" if jax.process_count() > 1 else ""
    counts = {name: sum(leaf.size for leaf in jax.tree.leaves(part)) for name, part in state.params.items()}
    eyes = np.asarray(views.cameras.to_world)[:, :, 3]
    near, far = np.min(views.near), np.max(views.far)
    dtype = jax.tree.leaves(state.params)[0].dtype
    shares = ", ".join(f"{name} {count:,}" for name, count in counts.items())
    schedule = []
    if state.grid is not None:
        cells = "x".join(map(str, state.grid.valid.shape))
        share = float(state.grid.valid.mean())
        schedule = [f"space       {share:.1%} of {cells} cells possible, found in {survey_seconds:.1f} s"]
    return "\n".join(
        [
            f"device      {len(devices)} x {devices[0].device_kind} ({devices[0].platform}){machines}",
            f"precision   parameters {dtype}; compiled in {compile_seconds:.1f} s",
            f"parameters  {sum(counts.values()):,} ({shares})",
            f"views       {len(views.offset)}, {views.pixels.shape[0]:,} pixels, t from {near:g} to {far:g}",
            *schedule,
            f"cameras     within {_point(eyes.min(0))} to {_point(eyes.max(0))}",
            f"steps       {int(state.step)} of {experiment.train.max_steps} taken, "
            f"{experiment.train.batch_size} rays each",
        ]
    )


def row(experiment, step, recent, clock, compile_seconds):
    """Returns the metrics since the last row: means of the errors, the rest as it stands."""
    values = {name: np.array([float(metrics[name]) for metrics in recent]) for name in recent[0]}
    rays_dropped = int(values["rays_dropped"][-1]) if "rays_dropped" in values else 0
    rays = step * experiment.train.batch_size - rays_dropped
    return {
        "step": step,
        "seconds": clock.seconds(),
        "compile_seconds": compile_seconds,
        "rays": rays,
        "rays_per_second": clock.rate(rays),
        "loss": values["loss"].mean(),
        "psnr_coarse": float(decibels(values["mse_coarse"].mean())),
        "psnr_fine": float(decibels(values["mse"].mean())),
        "lr": float(experiment.schedule(step - 1)),
        "grad_norm": values["grad_norm"][-1],
        "nonfinite": int(values["nonfinite"][-1]),
        "nonfinite_in_a_row": int(values["nonfinite_in_a_row"][-1]),
        "rays_dropped": rays_dropped,
        **{name: int(values[name][-1]) for name in values if name == "num_reinits" or name.startswith("dead_")},
    }


def line(row, options, late):
    left = (options.max_steps - row["step"]) * options.batch_size / max(row["rays_per_second"], 1e-9)
    if options.max_seconds:
        left = min(left, options.max_seconds - row["seconds"])
    missed = f"  {row['nonfinite']} steps not finite" if row["nonfinite"] else ""
    if row["rays_dropped"]:
        drawn = row["rays"] + row["rays_dropped"]
        missed += f"  {row['rays_dropped'] / drawn:.0%} of rays found the pool full"
    missed += "".join(f"  {name} network dead" for name in dead_networks_module.dead_networks(row))
    missed += f"  networks begun anew: {row['num_reinits']}" if row["num_reinits"] else ""
    return (
        f"{row['psnr_fine']:.2f} dB  {row['rays_per_second']:,.0f} rays/s  "
        f"{_minutes(row['seconds'])} done, {_minutes(0.0 if late else left)} left{missed}"
    )


def _minutes(seconds):
    minutes, seconds = divmod(int(seconds), 60)
    return f"{minutes}:{seconds:02d}"


def _point(values):
    return "(" + ", ".join(f"{value:.2f}" for value in values) + ")"
