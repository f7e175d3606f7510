"""An example of a scene that moves: a dataset of images with times, and a field that asks for the time.

`write_dataset` renders a closed-form moving scene with the package's own renderer and writes it in D-NeRF's format
(arXiv:2011.13961): Blender's transforms_<split>.json with the "time" of each frame in [0, 1]. The field takes the
encoded time as a fourth coordinate. Write the dataset and train on it by

    python moving_bodies.py data/moving
    jaxnerf-train --plugins=moving_bodies --config=embedded_small --data_dir=data/moving --config.field=timed_mlp \\
        --config.sampling.num_fine=0 --workdir=runs/moving

where moving_bodies.py is in the current folder or on PYTHONPATH. Any dataset in that format works.
"""

import dataclasses
import json
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen
from PIL import Image

import jaxnerf
from jaxnerf.extend import Field, Options, at_least, between, option


@dataclasses.dataclass(frozen=True)
class TimedOptions(Options):
    """The options of the field: the config's section `timed_mlp`."""

    depth: int = option(4, "layers", range=between(1, 64))
    width: int = option(128, "outputs of a layer", range=at_least(1))
    num_freqs: int = option(6, "octaves of the position's encoding", range=between(0, 64))
    num_time_freqs: int = option(4, "octaves of the time's encoding", range=between(0, 64))


ANGLE = 0.7  # radians, the horizontal field of view


def bodies(x, viewdirs, *, time):
    """Is the scene that is shown: a ball that rises, and one that circles it; x [..., S, 3], time [..., 1 or S].

    The renderer finds the keyword-only parameter `time` and passes that of each ray.
    """
    turn, zero = 2 * jnp.pi * time, jnp.zeros_like(time)
    rising = jnp.stack([zero, zero, 1.2 * time - 0.6], axis=-1)
    circling = jnp.stack([0.8 * jnp.cos(turn), 0.8 * jnp.sin(turn), zero], axis=-1)
    large, small = (
        40 * jax.nn.sigmoid(30 * (size - jnp.linalg.norm(x - center, axis=-1)))
        for center, size in ((rising, 0.4), (circling, 0.25))
    )
    stripes = 0.5 + 0.4 * jnp.sin(6 * (x - rising)[..., 2:])
    rgb = jnp.concatenate([stripes, 0.3 + 0 * stripes, 0.9 - stripes], axis=-1)
    orange = jnp.array([1.0, 0.6, 0.1]).reshape(*(1,) * (x.ndim - 1), 3)
    part = (small / (large + small + 1e-6))[..., None]
    return large + small, (1 - part) * rgb + part * orange


@jax.jit
def render_image(to_world, time, pixels):
    """Renders a frame [H, W, 4] of straight alpha."""
    height, width, _ = pixels.shape
    focal = jnp.full(2, 0.5 * width / jnp.tan(0.5 * ANGLE))
    camera = jaxnerf.Camera(to_world=to_world, focal=focal, center=jnp.array([width, height]) / 2)
    rays = jaxnerf.rays_from_pixels(camera, pixels, near=2.0, far=6.0)
    rays = dataclasses.replace(rays, time=jnp.full((height, width), time))
    image = jaxnerf.render_rays(None, bodies, rays, num_samples=128)
    opaque = jnp.maximum(image.opacity, 1e-3)[..., None]
    return jnp.concatenate([image.rgb / opaque, image.opacity[..., None]], axis=-1)


def write_dataset(folder, *, num_train=48, num_test=6, size=32):
    """Writes the splits "train" and "test": each frame has a camera and a time of its own."""
    pixels = jaxnerf.pixel_grid(size, size)
    for split, count, seed in (("train", num_train, 0), ("test", num_test, 1)):
        rng, frames = np.random.default_rng(seed), []
        (folder / split).mkdir(parents=True, exist_ok=True)
        for index, time in enumerate((np.arange(count) + rng.uniform(0, 1, count)) / count):
            height, turn = rng.uniform(-0.3, 0.8), rng.uniform(0, 2 * np.pi)
            around = np.sqrt(1 - height**2)
            eye = 4 * jnp.array([around * np.cos(turn), around * np.sin(turn), height])
            to_world = jaxnerf.look_at(eye, jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]))
            image = np.asarray(render_image(to_world, time, pixels))
            Image.fromarray(np.uint8(np.rint(255 * np.clip(image, 0, 1)))).save(folder / split / f"r_{index:03d}.png")
            matrix = [*np.asarray(to_world, float).tolist(), [0, 0, 0, 1]]
            frames.append({"file_path": f"./{split}/r_{index:03d}", "time": float(time), "transform_matrix": matrix})
        content = {"camera_angle_x": ANGLE, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content, indent=1))


def make_timed_mlp(options, box):
    """Makes the field from its options; it needs no box."""
    del box
    network = TimedNetwork(**dataclasses.asdict(options))

    def init(key):
        return network.init(key, jnp.zeros((1, 1, 3)), jnp.zeros((1, 1)))["params"]

    def apply(params, x, viewdirs, *, time):
        """Evaluates the field at time [..., 1 or S]; its colours do not depend on the direction."""
        return network.apply({"params": params}, x, time)

    return Field(init, apply)


class TimedNetwork(linen.Module):
    """A multilayer perceptron on the encoded position and the encoded time."""

    depth: int
    width: int
    num_freqs: int
    num_time_freqs: int

    @linen.compact
    def __call__(self, x, time):
        when = jaxnerf.positional_encoding(time[..., None], num_freqs=self.num_time_freqs)
        when = jnp.broadcast_to(when, (*x.shape[:-1], when.shape[-1]))
        where = jaxnerf.positional_encoding(x, num_freqs=self.num_freqs)
        encoded = hidden = jnp.concatenate([where, when], axis=-1)
        for layer in range(self.depth):
            hidden = jax.nn.relu(linen.Dense(self.width)(hidden))
            if layer == self.depth // 2:
                hidden = jnp.concatenate([hidden, encoded], axis=-1)
        out = linen.Dense(4)(hidden)
        return jax.nn.softplus(out[..., 0] - 1), jax.nn.sigmoid(out[..., 1:])


jaxnerf.register_field("timed_mlp", make_timed_mlp, options=TimedOptions)

if __name__ == "__main__":
    write_dataset(pathlib.Path(sys.argv[1]), size=48)
