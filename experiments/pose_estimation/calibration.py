"""Estimates the pose of noisy images of the embedded scene, and prints how often the truth is in the stated regions.

    python experiments/pose_estimation/calibration.py --page=docs/results/accuracy.md

Each trial has its own noise, start and pixels. The truth lies in the 90 % region if the square of the twist to it, in
the metric of the covariance, is below the 90 % quantile of chi-square with 6 degrees of freedom.
"""

import math
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags
from jax.scipy.spatial.transform import Rotation
from scipy.stats import chi2

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.core.cameras import pixel_grid, rays_from_pixels
from jaxnerf.core.pose_estimation import estimate_pose, moved
from jaxnerf.core.poses import look_at
from jaxnerf.core.rendering import render_rays
from jaxnerf.core.types import Camera
from jaxnerf.runtime import cli
from jaxnerf.tools.embedded_scene.still_life import still_life

_TRIALS = flags.DEFINE_integer("trials", 100, "Images.", lower_bound=10)

SIZE, NEAR, FAR, SAMPLES = 64, 2.0, 5.2, 64
LEVELS = (0.5, 0.9, 0.99)
NOISE = 0.02
START = 5.0  # degrees, and as many percent of a world unit
NUM_PIXELS = 1024


def trials(count: int, seed: int = 0) -> list[tuple[float, float]]:
    """Estimates poses; returns for each trial the probability of a region that the truth bounds, and the degrees."""
    pose = look_at((2.6, 1.6, 1.8), (0, 0, 0), (0, 0, 1))
    camera = Camera(to_world=pose, focal=jnp.full(2, 1.2 * SIZE), center=jnp.full(2, SIZE / 2))
    rays = rays_from_pixels(camera, pixel_grid(SIZE, SIZE), near=NEAR, far=FAR)
    options = {"num_samples": SAMPLES, "background": jnp.ones(3)}
    clean = np.asarray(jax.jit(lambda: render_rays(None, still_life, rays, **options).rgb)())
    found = []
    for trial in range(count):
        rng = np.random.default_rng([seed, trial])
        image = (clean + NOISE * rng.normal(size=clean.shape)).astype(np.float32)
        change = rng.normal(size=(2, 3))
        change *= [[math.radians(START)], [START / 100]] / np.linalg.norm(change, axis=1, keepdims=True)
        start = moved(camera, jnp.float32(change.reshape(-1))).to_world
        options |= {"near": NEAR, "far": FAR, "num_pixels": NUM_PIXELS, "key": jax.random.key(trial)}
        estimate = jax.tree.map(np.float64, estimate_pose(still_life, image, camera, start, **options))
        turn = Rotation.from_matrix(jnp.asarray(estimate.pose[:, :3] @ np.float64(pose[:, :3]).T)).as_rotvec()
        twist = np.array([*turn, *(estimate.pose - pose)[:, 3]])
        square = twist @ np.linalg.solve(estimate.covariance, twist) if estimate.converged else math.inf
        found.append((float(chi2.cdf(square, 6)), math.degrees(np.linalg.norm(turn))))
    return found


def main(argv):
    """Prints the table."""
    del argv
    probabilities, degrees = np.transpose(trials(_TRIALS.value))
    rows = [(f"{100 * level:g} %", f"{(probabilities <= level).sum()} of {len(probabilities)}") for level in LEVELS]
    lines = common.markdown(("stated region", "holds the true pose"), rows)
    lines += [
        "",
        f"{SIZE} x {SIZE} px with Gaussian noise of {NOISE}, {NUM_PIXELS:,} pixels; starts {START:g} degrees away, "
        f"ends {np.median(degrees):.3f} degrees (median).",
        "",
        *common.provenance(),
    ]
    common.publish(lines, "pose_estimation")


if __name__ == "__main__":
    cli.run(main)
