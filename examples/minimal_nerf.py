"""NeRF (arXiv:2003.08934) in one file, on public names of jaxnerf only: reads a dataset, trains, scores, saves images.

    python examples/minimal_nerf.py [--data_dir=FOLDER] [--steps=1000] [--out=minimal_nerf.png]

Without --data_dir it trains on the embedded scene, which needs no download. The networks are small, so that this takes
about two minutes on one CPU core. `jaxnerf-train` adds what this file leaves out: checkpoints, several devices,
schedules, occupancy grids, and checks of the dataset.
"""

import argparse
import functools

import imageio.v3 as imageio
import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxnerf

BATCH_SIZE, CHUNK = 512, 4096  # rays per training step, and per rendered chunk
NUM_COARSE, NUM_FINE = 24, 16  # samples per ray; the paper has 64 and 128
BACKGROUND = jnp.ones(3)  # colour behind the scene and behind the images' alpha

# A scene is a function (x, viewdirs) -> (density, rgb). A field makes one from parameters: here the network of
# Figure 7, with positional encoding (Eq. 4). The coarse network only guides the samples of the fine one.
NETWORK = {"density_activation": "softplus", "density_bias": -1.0}
COARSE = jaxnerf.mlp_field(depth=2, width=32, num_freqs=6, use_viewdirs=False, **NETWORK)
FINE = jaxnerf.mlp_field(depth=4, width=64, view_width=32, num_freqs=7, **NETWORK)


def render(params, keys, rays):
    """Renders Rays [B] by hierarchical sampling (Section 5.2): a coarse and a fine Rendering [B]."""
    coarse = functools.partial(COARSE.apply, params["coarse"])
    fine = functools.partial(FINE.apply, params["fine"])
    numbers = {"num_coarse": NUM_COARSE, "num_fine": NUM_FINE}
    return jaxnerf.render_hierarchical(keys, coarse, fine, rays, background=BACKGROUND, **numbers)


def loss(params, keys, batch):
    """Computes the squared error of both renderings (Eq. 6)."""
    return sum(jnp.mean((rendering.rgb - batch.rgb) ** 2) for rendering in render(params, keys, batch.rays))


def make_train_step(optimizer, views, seed=0):
    """Makes the compiled step: a random batch of rays, the gradient of the loss, and an update by Adam."""

    @functools.partial(jax.jit, donate_argnums=(0, 1))
    def train_step(params, state, step):
        keys, batch = jaxnerf.draw_batch(seed, step, jnp.arange(BATCH_SIZE), views)
        value, gradient = jax.value_and_grad(loss)(params, keys, batch)
        updates, state = optimizer.update(gradient, state, params)
        return optax.apply_updates(params, updates), state, value

    return train_step


def train(views, steps):
    """Trains on Views for a number of steps; returns the parameters."""
    coarse_key, fine_key = jax.random.split(jax.random.key(0))
    params = {"coarse": COARSE.init(coarse_key), "fine": FINE.init(fine_key)}
    optimizer = optax.adam(optax.warmup_exponential_decay_schedule(0.0, 5e-3, 50, steps, 0.1, end_value=5e-4))
    state = optimizer.init(params)
    train_step = make_train_step(optimizer, jax.device_put(views))
    for step in range(steps):
        params, state, value = train_step(params, state, step)
        if (step + 1) % 200 == 0:
            print(f"step {step + 1} of {steps}: loss {value:.5f}", flush=True)
    return params


@jax.jit
def render_chunk(params, rays):
    return render(params, None, rays)[1]  # without a key, samples are at fixed places


def render_view(params, views, index):
    """Renders a view of Views: rgb [H, W, 3]."""
    image = jaxnerf.render_image(functools.partial(render_chunk, params), views.rays(index), chunk=CHUNK)
    return jaxnerf.round_to_8_bits(image.rgb)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data_dir", default="", help="Folder of a dataset; empty: the embedded scene.")
    parser.add_argument("--factor", type=int, default=1, help="Images are shrunk by this factor.")
    parser.add_argument("--steps", type=int, default=1000, help="Training steps.")
    parser.add_argument("--out", default="minimal_nerf.png", help="File for a test image beside its rendering.")
    flags = parser.parse_args()

    options = {"factor": flags.factor} if flags.data_dir else {"format": "synthetic"}
    params = train(jaxnerf.load_dataset(flags.data_dir, split="train", **options), flags.steps)
    test = jaxnerf.load_dataset(flags.data_dir, split="test", **options)
    images = [(test.image(index), render_view(params, test, index)) for index in range(len(test.names))]
    print(f"PSNR {np.mean([jaxnerf.psnr(*pair) for pair in images]):.2f} dB on {len(images)} test views")
    imageio.imwrite(flags.out, np.uint8(np.round(255 * np.concatenate(images[0], axis=1))))
    print(f"wrote {flags.out}: a test image and its rendering")


if __name__ == "__main__":
    main()
