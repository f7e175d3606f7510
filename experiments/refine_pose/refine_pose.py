"""Recovers a camera by gradient descent through the renderer, with public names of jaxnerf only.

    python experiments/refine_pose/refine_pose.py [--workdir=RUN] [--seeds=6] [--steps=100] [--size=48] [--every=10]

For each seed an 8-bit image is rendered of the embedded scene in closed form, or of the trained model in a workdir
(of a scene within 1.4 of the origin on white, as the embedded one and Blender's). The camera is then turned by 2
degrees about a random axis, and its focal length made 5 % longer or shorter. Adam on the squared error of the
rendering corrects both. Prints the errors along the way and a table of the final ones; exits with 1 if a seed ends
beyond 0.1 degrees or 0.2 %.
"""

import argparse
import dataclasses
import functools
import sys
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxnerf
from jaxnerf.fields import still_life  # the subject; any other scene would do

DEGREES, ZOOM = 2.0, 0.05  # initial errors: angle, and fraction of the focal length
TOLERANCE = 0.1, 0.002  # of the final errors


def main(argv: Sequence[str] | None = None) -> int:
    """Recovers a camera for each seed; returns 0 if all were recovered, else 1."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--workdir", help="Folder of a trained run whose model is the subject.")
    parser.add_argument("--seeds", type=int, default=6, help="Number of cameras.")
    parser.add_argument("--steps", type=int, default=100, help="Steps of gradient descent.")
    parser.add_argument("--size", type=int, default=48, help="Height and width of the image, px.")
    parser.add_argument("--every", type=int, default=10, help="Steps between printed lines.")
    flags = parser.parse_args(argv)
    scene, render_truth = still_life.still_life, through(still_life.still_life, 384)
    if flags.workdir:
        scene, render_truth = jaxnerf.load_scene(flags.workdir)
    render = through(scene, 96)
    ends = []
    for seed in range(flags.seeds):
        angles, zooms = recover(seed, render_truth, render, size=flags.size, num_steps=flags.steps)
        for step in sorted({*range(0, flags.steps, flags.every), flags.steps}):
            print(f"seed {seed} step {step:3d}: {angles[step]:.4f} degrees, {100 * zooms[step]:.4f} %")
        ends.append((angles[-1], zooms[-1]))
    print("\n| seed | angle, degrees | focal length, % |\n| --- | --- | --- |")
    for seed, (angle, zoom) in enumerate(ends):
        print(f"| {seed} | {angle:.4f} | {100 * zoom:.4f} |")
    recovered = sum(angle < TOLERANCE[0] and zoom < TOLERANCE[1] for angle, zoom in ends)
    print(f"\n{recovered} of {len(ends)} within {TOLERANCE[0]} degrees and {100 * TOLERANCE[1]} %")
    return int(recovered < len(ends))


def through(scene: jaxnerf.SceneFn, num_samples: int) -> Callable[[jaxnerf.Rays], jaxnerf.Rendering]:
    """Returns a function Rays [...] -> Rendering [...] of a scene on white."""
    options = {"num_samples": num_samples, "background": jnp.ones(3)}
    return lambda rays: jaxnerf.render_rays(None, scene, rays, **options)


def recover(
    seed: int, render_truth: Callable, render: Callable, *, size: int, num_steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Recovers a camera and returns its errors before and after each step.

    Args:
        seed: of the camera and of its initial errors.
        render_truth: Rays [...] -> Rendering [...], which makes the image.
        render: the same, of the scene that gradients pass through.
        size: height and width, px.
        num_steps: N.

    Returns:
        Degrees [N + 1], and fractions of the focal length [N + 1].
    """
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    turn = np.float32(2 * np.tan(np.radians(DEGREES) / 2) * axis / np.linalg.norm(axis))
    zoom = np.float32(np.log1p(ZOOM * rng.choice([-1, 1])))
    truth = camera_at(rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 0.9), size)
    image = jaxnerf.round_to_8_bits(view(render_truth, truth))
    turns, zooms = refine(render, num_steps, corrected(truth, turn, zoom), image)
    found = np.asarray(jax.vmap(rotation)(jnp.concatenate([jnp.zeros((1, 3)), turns])))
    # sin(angle / 2) from the distance to no rotation at all: an arccosine of nearly 1 would be coarse.
    halves = np.linalg.norm(np.asarray(rotation(turn)) @ found - np.eye(3), axis=(1, 2)) / np.sqrt(8)
    return np.degrees(2 * np.arcsin(halves)), np.abs(np.expm1(zoom + np.append(0, zooms)))


def camera_at(azimuth: float, elevation: float, size: int) -> jaxnerf.Camera:
    """Returns a camera that looks at the origin from a distance of 4; angles in radians."""
    around = 4 * np.cos(elevation)
    eye = [around * np.cos(azimuth), around * np.sin(azimuth), 4 * np.sin(elevation)]
    pose = jaxnerf.look_at(eye, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    return jaxnerf.Camera(
        to_world=pose, focal=jnp.full(2, 1.36 * size), center=jnp.full(2, size / 2), height=size, width=size
    )


@functools.partial(jax.jit, static_argnums=0)
def view(render: Callable, camera: jaxnerf.Camera) -> jax.Array:
    """Returns the colours [H, W, 3] that a camera sees."""
    pixels = jaxnerf.pixel_grid(camera.height, camera.width)
    return render(jaxnerf.rays_from_pixels(camera, pixels, near=2.5, far=5.5)).rgb


@functools.partial(jax.jit, static_argnums=(0, 1))
def refine(render: Callable, num_steps: int, start: jaxnerf.Camera, image: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the corrections of a camera after each step: turns [N, 3] and logarithms of the zoom [N]."""
    optimizer = optax.adam(optax.cosine_decay_schedule(0.004, num_steps))

    def error(correction):
        return jaxnerf.mse(view(render, corrected(start, *correction)), image)

    def step(carry, _):
        correction, state = carry
        updates, state = optimizer.update(jax.grad(error)(correction), state)
        correction = optax.apply_updates(correction, updates)
        return (correction, state), correction

    still = jnp.zeros(3), jnp.zeros(())
    return jax.lax.scan(step, (still, optimizer.init(still)), length=num_steps)[1]


def corrected(camera: jaxnerf.Camera, turn: jax.Array, zoom: jax.Array) -> jaxnerf.Camera:
    """Returns the camera turned about its own axes by rotation(turn [3]), its focal length times e^zoom."""
    # Highest precision, as a matrix unit may round the camera to ten bits.
    axes = jnp.matmul(camera.to_world[:, :3], rotation(turn), precision="highest")
    to_world = jnp.concatenate([axes, camera.to_world[:, 3:]], axis=1)
    return dataclasses.replace(camera, to_world=to_world, focal=camera.focal * jnp.exp(zoom))


def rotation(turn: jax.Array) -> jax.Array:
    """Returns the rotation [3, 3] about turn [3] by 2 arctan(|turn| / 2) radians (Rodrigues 1840).

    The angle is smooth at 0, where the descent begins, and nearly |turn|.
    """
    x, y, z = turn
    cross = jnp.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    square = jnp.matmul(cross, cross, precision="highest")
    return jnp.eye(3) + (cross + square / 2) / (1 + (x**2 + y**2 + z**2) / 4)


if __name__ == "__main__":
    sys.exit(main())
