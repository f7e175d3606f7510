"""Several rays a pixel in the last part of training.

A pixel of an image that was shrunk by area is a mean over what it covers. A field that is trained to show it along one
ray blurs what is finer than a pixel; the mean over several rays leaves that sharp.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from jaxnerf.core.types import Rendering


class PixelRays(NamedTuple):
    """The rays of a pixel on a regular grid, each in its cell's middle, from some progress of training on.

    Both parts of training are one program: the rays of a step are as many, and a second one would have to be compiled.

    Attributes:
        side: rays along a side of a pixel in the last part; at least 2.
        start: the progress at which that part begins; before it, a pixel has one ray.
    """

    side: int
    start: float

    def side_at(self, progress: Float[ArrayLike, ""]) -> Int[Array, ""]:
        """Returns the rays along a side of a pixel at a progress of training."""
        return jnp.where(progress >= self.start, self.side, 1)

    def averaged(self, rendering: Rendering, rays_per_side: Int[ArrayLike, ""]) -> Rendering:
        """Returns a Rendering [B] in which each ray has what its pixel shows, the mean over the pixel's rays.

        A ray whose pixel has a ray with dropped samples has them, too. Weights and samples stay those of each ray.

        Args:
            rendering: of rays of which each side^2 are of one pixel.
            rays_per_side: `side` or 1; for 1 the Rendering stays as it is.

        Raises:
            ValueError: if the rays are not those of whole pixels.
        """
        count = self.side**2
        if rendering.num_dropped.size % count:
            raise ValueError(
                f"{rendering.num_dropped.size} rays of a microbatch on a device, expected a multiple of {count}, the "
                "rays of a pixel; change train.batch_size, train.microbatch_size or train.rays_per_side"
            )

        def of_pixels(values: jax.Array, reduce=jnp.mean) -> jax.Array:
            rays = values.reshape(-1, count, *values.shape[1:])
            return jnp.where(rays_per_side > 1, reduce(rays, axis=1, keepdims=True), rays).reshape(values.shape)

        means = {name: of_pixels(getattr(rendering, name)) for name in ("rgb", "opacity", "depth", "disparity")}
        return dataclasses.replace(rendering, num_dropped=of_pixels(rendering.num_dropped, jnp.sum), **means)
