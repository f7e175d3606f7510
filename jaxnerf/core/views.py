"""Views: images with their cameras, as datasets are read."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, UInt

from jaxnerf.core.cameras import pixel_grid, rays_from_pixels
from jaxnerf.core.types import Camera, Rays, SparsePoints, Vector, pytree


@pytree(static=("names", "background", "file_origin"))
class Views:
    """Images with their cameras; the pixels of all images are in one array.

    Attributes:
        pixels: [P, C] uint8 or uint16, row by row; the fourth channel, if any, is straight alpha. P is 0 where only
            the cameras are known.
        offset: [V] index of each view's first pixel.
        size: [V, 2] px, (height, width).
        cameras: stacked, [V, ...].
        near: [V] in t.
        far: [V] in t.
        mask: [P] False for pixels that are excluded from batches and scores; None where all count.
        names: V file names without folder and extension.
        background: the colour that alpha is composited over; None for images without alpha.
        box: [2, 3] lower and upper corner in world units; the dataset states that space outside is empty.
        free_depth: [V] in t, the depth up to which the dataset states that nothing stands in front of each camera, or
            its points tell; 0 where they do not, None: not known.
        to_file: [4, 4] maps this world to that of the dataset's files; None where they are the same.
        file_origin: the point of the files' world, in their units, that is 0 in the world that to_file maps to. It is
            0 unless the cameras are far away from theirs, as in geographic coordinates.
        sparse: points of the dataset's own model and their observations in these views; None without points.
        time: [V] in [0, 1], when each image was taken in a scene that moves; None: not stated.
        image_index: [V] int32, which training image each view counts as for a scene that asks for `image_index`; None:
            its own index here.
    """

    pixels: UInt[Array, "P C"]
    offset: Int[Array, " V"]
    size: Int[Array, "V 2"]
    cameras: Camera
    near: Float[Array, " V"]
    far: Float[Array, " V"]
    mask: Bool[Array, " P"] | None = None
    names: tuple[str, ...] = ()
    background: tuple[float, float, float] | None = None
    box: Float[Array, "2 3"] | None = None
    to_file: Float[Array, "4 4"] | None = None
    free_depth: Float[Array, " V"] | None = None
    file_origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sparse: SparsePoints | None = None
    time: Float[Array, " V"] | None = None
    image_index: Int[Array, " V"] | None = None

    def image(self, index: int) -> Float[Array, "H W 3"]:
        """Returns a view's colours [H, W, 3] in [0, 1]; alpha is composited over the background, or over black."""
        _check_index(self, index)
        check_pixels(self, "Views.image")
        height, width = (int(side) for side in self.size[index])
        first = int(self.offset[index])
        pixels = jnp.asarray(self.pixels[first : first + height * width])
        return pixel_colors(pixels, self.background).reshape(height, width, 3)

    def camera(self, index: Int[ArrayLike, ""]) -> Camera:
        """Returns a view's Camera; it has a height and a width if all views have the same."""
        _check_index(self, index)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], self.cameras)

    def rays(self, index: int) -> Rays:
        """Returns the Rays [H, W] through the centres of a view's pixels, between its near and its far, at its time."""
        _check_index(self, index)
        height, width = (int(side) for side in self.size[index])
        near, far = (jnp.asarray(bound)[index] for bound in (self.near, self.far))
        rays = rays_from_pixels(self.camera(index), pixel_grid(height, width), near=near, far=far)
        time = None if self.time is None else jnp.full_like(rays.near, self.time[index])
        return dataclasses.replace(rays, time=time)


def check_pixels(views: Views, user: str) -> None:
    """Raises a ValueError if only the cameras of views are known; user: what needs their pixels."""
    if jnp.shape(views.pixels)[:1] == (0,):
        raise ValueError(f"{user} needs images, and only their cameras are known here; give --data_dir")


def _check_index(views, index):
    """Raises an IndexError on the index of no view; JAX would return the last one."""
    count = len(views.near)
    if not isinstance(index, jax.core.Tracer) and not -count <= int(index) < count:
        raise IndexError(f"Views: the index is {index}, expected one of 0 to {count - 1}, as there are {count} views")


def pixel_colors(pixels: UInt[ArrayLike, "*batch C"], background: Vector | None) -> Float[ArrayLike, "*batch 3"]:
    """Returns the colours of uint8 or uint16 pixels in [0, 1].

    Pixels of C = 4 channels have straight alpha and are composited over background (None: black). Pixels of
    C = 3 channels are opaque.
    """
    largest = jnp.iinfo(pixels.dtype).max
    values = pixels.astype(jnp.float32) / largest
    if pixels.shape[-1] == 3:
        return values
    rgb, alpha = values[..., :3], values[..., 3:]
    if background is None:
        return rgb * alpha
    behind = jnp.broadcast_to(jnp.asarray(background, jnp.float32), rgb.shape)
    return rgb * alpha + behind * (1 - alpha)
