"""Random training rays, drawn on the device from the pixels of all views."""

import dataclasses
from collections.abc import Callable, Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, Integer, Key, Num, UInt

from jaxnerf.core.cameras import ndc_rays, ndc_to_t, pixel_radius, rays_from_pixels
from jaxnerf.core.loops import search_sorted
from jaxnerf.core.safe_math import norm
from jaxnerf.core.types import Batch, Camera, Rays, pytree
from jaxnerf.core.views import Views, pixel_colors

BATCHINGS = ("all_images", "single_image")
DEPTH_STRIDE = 4  # px between the places of `SparsePoints.interpolated`
DEPTH_FIELDS = ("depth", "depth_weight")  # of Batch; for these, some rays go through observations of sparse points
_OBSERVED_EVERY = 16  # one ray in this many: most pixels show no sparse point


@pytree(static=("shape",))
class BatchPixels:
    """The pixels of one step's batch, in place of the pixels of Views that do not fit into the device's memory.

    Attributes:
        rows: [B, C], in the order of the batch.
        shape: (P, C) of all pixels.
    """

    rows: UInt[Array, "B C"]
    shape: tuple[int, int]


@pytree()
class PixelRuns:
    """Pixel ids in ascending order, stored as runs of consecutive ids: single ids take as much memory as pixels.

    Attributes:
        first: [R] int32, the first id of each run.
        before: [R] int32, the number of ids in all previous runs.
        size: int32, the number of all ids.
    """

    first: Int[Array, " R"]
    before: Int[Array, " R"]
    size: Int[Array, ""]

    def ids(self, positions: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
        """Returns the ids at positions in [0, size)."""
        run = search_sorted(self.before, positions, side="right") - 1
        return jnp.asarray(self.first)[run] + positions - jnp.asarray(self.before)[run]

    def count_below(self, bounds: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
        """Returns the number of ids below each bound."""
        run = jnp.maximum(search_sorted(self.first, bounds, side="left") - 1, 0)
        ends = jnp.append(self.before[1:], self.size)
        within = bounds - jnp.asarray(self.first)[run]
        return jnp.clip(jnp.asarray(self.before)[run] + within, 0, ends[run])


def view_rays(
    views: Views,
    index: Int[ArrayLike, ""],
    pixels: Num[ArrayLike, "*batch 2"],
    *,
    ndc: bool = False,
    needs: Iterable[str] = (),
) -> Rays:
    """Returns the Rays [*batch] of one view through pixel positions (x, y).

    Args:
        views: with their cameras on the device or the host.
        index: of the view.
        pixels: px.
        ndc: whether the rays are in normalised device coordinates.
        needs: what a scene asks for, see `with_needs`. Rays have a time only if the views do.
    """
    camera = views.camera(index)
    near, far = jnp.asarray(views.near)[index], jnp.asarray(views.far)[index]
    rays = rays_from_pixels(camera, pixels, near=near, far=far)
    if needs:
        time = None if views.time is None else jnp.asarray(views.time)[index]
        image_index = index if views.image_index is None else jnp.asarray(views.image_index)[index]
        rays = with_needs(rays, camera, pixels, needs, time=time, image_index=image_index)
    return ndc_rays(rays, camera) if ndc else rays


def with_needs(
    rays: Rays,
    camera: Camera,
    pixels: Num[ArrayLike, "*batch 2"],
    needs: Iterable[str],
    *,
    time: Float[ArrayLike, ""] | None = 0.0,
    image_index: Int[ArrayLike, ""] = 0,
) -> Rays:
    """Fills those optional fields of rays that a scene asks for.

    Args:
        rays: Rays [...] of rays_from_pixels.
        camera, pixels: from which they were made.
        needs: names of `core.scene.NEEDS`, those of fields of Rays count.
        time: of all rays; None: unknown, and not filled.
        image_index: of all rays.
    """
    shape, known = rays.near.shape, {}
    if "radius" in needs:
        known["radius"] = pixel_radius(camera, pixels)
    if "time" in needs and time is not None:
        known["time"] = jnp.broadcast_to(jnp.asarray(time, jnp.float32), shape)
    if "image_index" in needs:
        known["image_index"] = jnp.broadcast_to(jnp.asarray(image_index, jnp.int32), shape)
    return dataclasses.replace(rays, **known)


def world_depth(
    views: Views,
    index: Int[ArrayLike, ""],
    pixels: Num[ArrayLike, "*batch 2"],
    depth: Float[ArrayLike, "*batch"],
    *,
    ndc: bool = False,
) -> Float[Array, "*batch"]:
    """Converts depths in t of the rays of `view_rays` to distances along them.

    Distances are in the world units of the dataset's files, see `Views.to_file`.
    """
    rays = view_rays(views, index, pixels)
    t = depth
    if ndc:  # NDC hold nothing of rays that point backwards
        t = jnp.where(rays.directions[..., 2] < 0, ndc_to_t(depth, rays), jnp.inf)
    distance = t * norm(rays.directions)
    if views.to_file is None:
        return distance
    return distance * norm(jnp.asarray(views.to_file)[:3, 0])  # all axes of a similarity have one scale


def draw_batch(
    seed: Integer[ArrayLike, ""],
    step: Int[ArrayLike, ""],
    positions: Int[ArrayLike, " B"],
    views: Views,
    active_pixels: PixelRuns | None = None,
    *,
    batching: str = "all_images",
    pixel_offset: float = 0.5,
    ndc: bool = False,
    extras: Iterable[str] = (),
    needs: Iterable[str] = (),
    rays_per_side: Int[ArrayLike, ""] = 1,
) -> tuple[Key[Array, " B"], Batch]:
    """Draws random rays with their colours: a part of one step's batch.

    Each ray depends only on the seed, the step and its position in the whole batch, and therefore not on how the
    batch is split over devices.

    Args:
        seed: of the run.
        step: training step.
        positions: of the rays in the step's whole batch.
        views: on the device; their pixels may be BatchPixels.
        active_pixels: the pixels to draw from; None: all.
        batching: "all_images": each ray from any pixel of any view; "single_image": all rays of a step from one
            view, as in the paper's synthetic runs.
        pixel_offset: px, position of a ray in its pixel, see `pixel_grid`.
        ndc: whether the rays are in normalised device coordinates.
        extras: the optional fields of Batch to fill. For "depth" and "depth_weight", one ray in 16 goes through a
            random observation of `views.sparse` instead, and has the colour of the pixel around it. The depth of the
            others is interpolated, if `views.sparse.interpolated` is known.
        needs: the optional fields of Rays to fill, see `view_rays`.
        rays_per_side: n; each n^2 positions, from a multiple of n^2 on, are rays of one pixel on a regular grid, and
            their cones are as wide as its cells.

    Returns:
        One key per ray, for sampling along the rays; and the Batch [B].

    Raises:
        ValueError: on an unknown batching, or if a depth is wanted and the views have no observations.
    """
    observed = not set(DEPTH_FIELDS).isdisjoint(extras)
    options = {"batching": batching, "extras": extras, "rays_per_side": rays_per_side}
    keys, index, chosen = draw_pixels(seed, step, positions, views, active_pixels, **options)
    view = jnp.searchsorted(views.offset, index, side="right", method="compare_all") - 1
    place = index - views.offset[view]
    width = views.size[view, 1]
    pixels = jnp.stack([place % width, place // width], axis=-1) + pixel_offset
    if observed:  # an observation is measured as the pixels are where their rays go through their centres
        at = jnp.asarray(views.sparse.pixel)[chosen] + (pixel_offset - 0.5)
        pixels = jnp.where((chosen >= 0)[:, None], at, pixels)
    several = not _is_one(rays_per_side)
    if several:
        place_in_pixel = jnp.stack([positions % rays_per_side, positions // rays_per_side % rays_per_side], axis=-1)
        pixels += (place_in_pixel + 0.5) / rays_per_side - 0.5
    rays = jax.vmap(lambda view, pixel: view_rays(views, view, pixel, ndc=ndc, needs=needs))(view, pixels)
    if several and rays.radius is not None:
        rays = dataclasses.replace(rays, radius=rays.radius / rays_per_side)
    stored = views.pixels
    colors = stored.rows[positions] if isinstance(stored, BatchPixels) else stored[index]
    batch = Batch(rays=rays, rgb=pixel_colors(colors, views.background))
    if not extras:
        return keys, batch
    known = {"image_index": view.astype(jnp.int32), "pixel": pixels, "alpha": _alpha(colors)}
    if observed:
        known |= _known_depth(views, view, chosen, place, rays, ndc)
    return keys, dataclasses.replace(batch, **{name: known[name] for name in extras})


def _known_depth(views, view, chosen, place, rays, ndc):
    """Returns the fields "depth" and "depth_weight" [B], of the chosen observation or else interpolated between them.

    Both are 0 where nothing is known.
    """
    sparse = views.sparse
    position, pose = (
        jnp.asarray(values)[index]
        for values, index in ((sparse.positions, jnp.asarray(sparse.point)[chosen]), (views.cameras.to_world, view))
    )
    depth = ((pose[:, :, 3] - position) * pose[:, :, 2]).sum(axis=-1)  # along the axis, as t of the rays
    if views.cameras.lens == "fisheye":  # whose rays may run sideways
        depth = ((position - pose[:, :, 3]) * rays.directions).sum(axis=-1) / (rays.directions**2).sum(axis=-1)
    if ndc:
        depth = 1 + 1 / position[:, 2]  # t of `ndc_rays`: 0 at z = -1, 1 at infinity
    weight = 1.0 if sparse.confidence is None else jnp.asarray(sparse.confidence)[chosen]
    if sparse.interpolated is not None:
        width = views.size[view, 1]
        at = view, place // width // DEPTH_STRIDE, place % width // DEPTH_STRIDE
        inverse, confidence = jnp.moveaxis(jnp.asarray(sparse.interpolated)[at], -1, 0)
        observed, sure = chosen >= 0, confidence > 0
        depth = jnp.where(observed, depth, jnp.where(sure, 1 / jnp.where(sure, inverse, 1), 0))
        weight = jnp.where(observed, weight, confidence)
        chosen = jnp.where(sure, 0, chosen)
    known = (chosen >= 0) & (depth > rays.near) & (depth < rays.far)
    return {"depth": jnp.where(known, depth, 0), "depth_weight": jnp.where(known, weight, 0.0)}


def _alpha(pixels):
    """Returns the alpha [...] of pixels [..., C]; 1 if C = 3."""
    if pixels.shape[-1] == 3:
        return jnp.ones(pixels.shape[:-1], jnp.float32)
    return pixels[..., 3].astype(jnp.float32) / jnp.iinfo(pixels.dtype).max


def draw_pixels(
    seed: Integer[ArrayLike, ""],
    step: Int[ArrayLike, ""],
    positions: Int[ArrayLike, " B"],
    views: Views,
    active_pixels: PixelRuns | None = None,
    *,
    batching: str = "all_images",
    extras: Iterable[str] = (),
    rays_per_side: Int[ArrayLike, ""] = 1,
) -> tuple[Key[Array, " B"], Int[Array, " B"], Int[Array, " B"] | None]:
    """Returns the keys of `draw_batch`, the ids of the pixels that its rays pass through, and their observations.

    The observations are indices [B], -1 for rays that go through none; None unless the extras need them.
    """
    if batching not in BATCHINGS:
        raise ValueError(f"draw_batch: batching is {batching!r}, expected one of {BATCHINGS}")
    key = step_key(seed, step)
    ray_keys = jax.vmap(lambda position: jax.random.fold_in(key, position))(positions)
    pixel_keys, keys = jax.vmap(lambda key: tuple(jax.random.split(key)))(ray_keys)
    if not _is_one(rays_per_side):  # the pixel of the first of its rays
        first_rays = positions - positions % rays_per_side**2
        pixel_keys = jax.vmap(lambda position: jax.random.split(jax.random.fold_in(key, position))[0])(first_rays)
    first, count = 0, views.pixels.shape[0] if active_pixels is None else active_pixels.size
    if batching == "single_image":
        # No ray has this position, so no ray has this key.
        view = jax.random.randint(jax.random.fold_in(key, 2**32 - 1), (), 0, views.offset.shape[0])
        first, count = views.offset[view], views.size[view].prod()
        if active_pixels is not None:
            first, last = active_pixels.count_below(jnp.stack([first, first + count]))
            count = last - first
    index = jax.vmap(lambda key: jax.random.randint(key, (), first, first + count))(pixel_keys)
    index = index if active_pixels is None else active_pixels.ids(index)
    if set(DEPTH_FIELDS).isdisjoint(extras):
        return keys, index, None
    if views.sparse is None or not views.sparse.view.shape[0]:
        raise ValueError(
            "draw_batch: the views have no observations of sparse points, expected those of a COLMAP model, for example"
        )
    sparse = jax.tree.map(jnp.asarray, views.sparse)
    first, last = 0, sparse.view.size
    if batching == "single_image":
        first, last = search_sorted(sparse.view, jnp.stack([view, view + 1]), side="left")
    chosen = jax.vmap(lambda key: jax.random.randint(key, (), first, jnp.maximum(last, first + 1)))(pixel_keys)
    chosen = jnp.where((positions % _OBSERVED_EVERY == 0) & (last > first), chosen, -1)
    view, (column, row) = sparse.view[chosen], jnp.floor(sparse.pixel[chosen]).astype(jnp.int32).T
    there = jnp.asarray(views.offset)[view] + row * jnp.asarray(views.size)[view, 1] + column
    return keys, jnp.where(chosen >= 0, there, index), chosen


def _is_one(rays_per_side):
    return isinstance(rays_per_side, int) and rays_per_side == 1


def step_key(seed: Integer[ArrayLike, ""], step: Int[ArrayLike, ""]) -> Key[Array, ""]:
    """Returns the key of a step. The keys of its rays are folded from it with their positions in the batch."""
    return jax.random.fold_in(jax.random.key(seed), step)


def random_rays(views: Views, count: int, view_rays: Callable[..., Rays], *, pixel_offset: float = 0.5) -> Rays:
    """Returns Rays [count] through random pixels, almost equally many of each view. Colours are not read.

    Args:
        views: any.
        count: number of rays.
        view_rays: (views, index, pixels [M, 2]) -> Rays [M].
        pixel_offset: see `pixel_grid`.
    """
    rng, parts = np.random.default_rng(0), []
    ends = np.linspace(0, count, len(views.size) + 1).astype(int)
    for index, (height, width) in enumerate(np.asarray(views.size)):
        each = ends[index + 1] - ends[index]
        pixels = np.stack([rng.integers(width, size=each), rng.integers(height, size=each)], axis=-1)
        parts.append(view_rays(views, index, jnp.asarray(pixels + pixel_offset, jnp.float32)))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
