"""An example of an estimator: a pixel is less certain where no training camera saw its surface from its direction.

Run it by

    jaxnerf-eval --plugins=novelty_estimator --workdir=runs/demo --uncertainty=novelty

where novelty_estimator.py is in the current folder or on PYTHONPATH.
"""

import jax
import jax.numpy as jnp

import jaxnerf
from jaxnerf.extend import Estimate


def estimate_novelty(source):
    """Returns the Estimate of a run.

    Args:
        source: UncertaintySource, a checkpoint of the run and its training views.
    """
    cameras = jnp.asarray(source.views.cameras.to_world)[:, :, 3]

    def angle(seen):
        """Returns the smallest angle at a point x between a direction and those of cameras, in units of pi."""
        x, direction = seen
        towards = x[None] - cameras
        towards /= jnp.linalg.norm(towards, axis=-1, keepdims=True)
        cosine = (towards * direction[None]).sum(axis=-1).max()
        return jnp.arccos(jnp.clip(cosine, -1, 1)) / jnp.pi

    @jax.jit
    def angles(x, directions):
        flat = x.reshape(-1, 3), directions.reshape(-1, 3)
        # In parts, as every pixel of an image with every camera might not fit into memory.
        return jax.lax.map(angle, flat, batch_size=4096).reshape(x.shape[:-1])

    def score(rays):
        image = source.run.render_image(source.variables, rays)
        return angles(rays.origins + image.depth[..., None] * rays.directions, rays.viewdirs)

    return Estimate(score, identity=f"novelty, {len(cameras)} cameras")


jaxnerf.register_estimator("novelty", estimate_novelty)
