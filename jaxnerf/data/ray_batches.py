"""Training rays, drawn on the device from the pixels of all views."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf.core.cameras import ndc_rays, ndc_to_t, rays_from_pixels
from jaxnerf.core.safe_math import norm
from jaxnerf.core.types import Batch, pytree

BATCHINGS = ("all_images", "single_image")


@pytree(static=("shape",))
class Gathered:
    """In place of all pixels of Views, those of one step's batch, where a device has no room for more."""

    rows: jax.Array  # [batch, C], by position in the batch
    shape: tuple[int, int]  # of all pixels [P, C]


def pixel_colors(pixels, background):
    """Returns colours [..., 3] in [0, 1] of pixels [..., C] of uint8 or uint16.

    With C = 4 the colour is composited over background [3] (None: black); with C = 3 it is opaque.
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


def view_rays(views, index, pixels, *, ndc=False):
    """Returns Rays [...] of one view through pixels [..., 2]; index is a number, traced or not."""
    camera = jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], views.cameras)
    near, far = jnp.asarray(views.near)[index], jnp.asarray(views.far)[index]
    rays = rays_from_pixels(camera, pixels, near=near, far=far)
    return ndc_rays(rays, camera) if ndc else rays


def world_depth(views, index, pixels, depth, *, ndc=False):
    """Returns the distance [...] along the rays of view_rays of depth [...] in their t.

    It is in world units of the capture's file, whatever the reader made of them: views.to_file says.
    """
    rays = view_rays(views, index, pixels)
    t = depth
    if ndc:  # a ray that turns away from the box meets nothing in it
        t = jnp.where(rays.directions[..., 2] < 0, ndc_to_t(depth, rays), jnp.inf)
    distance = t * norm(rays.directions)
    if views.to_file is None:
        return distance
    return distance * norm(jnp.asarray(views.to_file)[:3, 0])  # each axis of a similarity has its scale


def draw_batch(
    seed,
    step,
    positions,
    views,
    active_pixels=None,
    *,
    batching="all_images",
    pixel_offset=0.5,
    ndc=False,
    extras=(),
):
    """Returns one key a ray and the rays and colours of a part of one step's batch.

    Everything depends on the seed, the step and the ray's position in the whole batch alone, so
    it is the same however the batch is split over devices.

    Args:
        seed: int.
        step: int32 scalar.
        positions: [B] int32, of the rays in the step's whole batch.
        views: Views, on the device. Their pixels may be Gathered.
        active_pixels: PixelRuns, the pixels to draw from; None: all.
        batching: "all_images": each ray from any pixel of any view; "single_image": all rays of a
            step from one view, as in the paper's synthetic runs.
        pixel_offset: where in its square a pixel is looked through, see pixel_grid.
        ndc: rays in normalised device coordinates.
        extras: names of the optional fields of Batch to fill: "image_index", "pixel" and "alpha".

    Returns:
        keys [B], for sampling along the rays; and Batch [B].

    Raises:
        ValueError: on an unknown batching.
    """
    keys, index = draw_pixels(seed, step, positions, views, active_pixels, batching=batching)
    view = jnp.searchsorted(views.offset, index, side="right", method="compare_all") - 1
    place = index - views.offset[view]
    width = views.size[view, 1]
    pixels = jnp.stack([place % width, place // width], axis=-1) + pixel_offset
    rays = jax.vmap(lambda view, pixel: view_rays(views, view, pixel, ndc=ndc))(view, pixels)
    seen = views.pixels
    colors = seen.rows[positions] if isinstance(seen, Gathered) else seen[index]
    batch = Batch(rays=rays, rgb=pixel_colors(colors, views.background))
    if not extras:
        return keys, batch
    known = {"image_index": view.astype(jnp.int32), "pixel": pixels, "alpha": _alpha(colors)}
    return keys, dataclasses.replace(batch, **{name: known[name] for name in extras})


def _alpha(pixels):
    """Returns the alpha [...] of pixels [..., C]; 1 where they have none."""
    if pixels.shape[-1] == 3:
        return jnp.ones(pixels.shape[:-1], jnp.float32)
    return pixels[..., 3].astype(jnp.float32) / jnp.iinfo(pixels.dtype).max


def draw_pixels(seed, step, positions, views, active_pixels=None, *, batching="all_images"):
    """Returns the keys [B] of draw_batch and the ids [B] int32 of the pixels that its rays go through."""
    if batching not in BATCHINGS:
        raise ValueError(f"draw_batch: batching is {batching!r}, wanted one of {BATCHINGS}")
    key = step_key(seed, step)
    ray_keys = jax.vmap(lambda position: jax.random.fold_in(key, position))(positions)
    pixel_keys, keys = jax.vmap(lambda key: tuple(jax.random.split(key)))(ray_keys)
    first, count = 0, views.pixels.shape[0] if active_pixels is None else active_pixels.size
    if batching == "single_image":
        # No ray has this position, so the key is the step's own.
        view = jax.random.randint(jax.random.fold_in(key, 2**32 - 1), (), 0, views.offset.shape[0])
        first, count = views.offset[view], views.size[view].prod()
        if active_pixels is not None:
            first, last = active_pixels.count_below(jnp.stack([first, first + count]))
            count = last - first
    index = jax.vmap(lambda key: jax.random.randint(key, (), first, first + count))(pixel_keys)
    return keys, index if active_pixels is None else active_pixels.ids(index)


def step_key(seed, step):
    """Returns the key of a step; of it come those of its rays, by their positions in the batch."""
    return jax.random.fold_in(jax.random.key(seed), step)


def random_rays(views, count, view_rays, *, pixel_offset=0.5, seed=0):
    """Returns Rays [N] through random pixels of Views, nearly as many of each view; only cameras count.

    Args:
        views: Views.
        count: N.
        view_rays: (views, index, pixels [M, 2]) -> Rays [M].
        pixel_offset: see pixel_grid.
        seed: int.
    """
    rng, parts = np.random.default_rng(seed), []
    ends = np.linspace(0, count, len(views.size) + 1).astype(int)
    for index, (height, width) in enumerate(np.asarray(views.size)):
        each = ends[index + 1] - ends[index]
        pixels = np.stack([rng.integers(width, size=each), rng.integers(height, size=each)], axis=-1)
        parts.append(view_rays(views, index, jnp.asarray(pixels + pixel_offset, jnp.float32)))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
