"""Patches of rays from poses between those of the training cameras, for losses that need no image."""

import dataclasses
from collections.abc import Iterable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int, Integer, Key

from jaxnerf.core.types import Rays
from jaxnerf.core.views import Views
from jaxnerf.data.ray_batches import step_key, view_rays

PATCH_SIDE = 4  # px
_PATCHES = 2**32 - 3  # no ray has this position in a batch, so the key is unused otherwise
_MIN_COSINE = 0.5  # between the axes of cameras that a pose lies between


def draw_patches(
    seed: Integer[ArrayLike, ""],
    step: Int[ArrayLike, ""],
    views: Views,
    *,
    count: int,
    pixel_offset: float = 0.5,
    ndc: bool = False,
    needs: Iterable[str] = (),
) -> tuple[Key[Array, " B"], Rays]:
    """Draws square patches of neighbouring pixels of cameras that no image has, see `pose_between`.

    Lens, size, near, far and time are those of a random training view. All depends on the seed and the step alone.

    Args:
        seed, step: as of `draw_batch`.
        views: on the device.
        count: P patches.
        pixel_offset, ndc, needs: as of `draw_batch`.

    Returns:
        Keys [B] and Rays [B] of B = P PATCH_SIDE^2 rays, patch by patch and row by row.
    """
    poses = jnp.asarray(views.cameras.to_world)
    rows, columns = jnp.divmod(jnp.arange(PATCH_SIDE**2), PATCH_SIDE)

    def patch(key):
        view_key, pose_key, place_key, ray_key = jax.random.split(key, 4)
        view = jax.random.randint(view_key, (), 0, views.near.shape[0])
        pose = pose_between(pose_key, view, poses)
        moved = poses.at[view].set(pose)
        free = jnp.maximum(jnp.asarray(views.size)[view] - PATCH_SIDE + 1, 1)
        row, column = jnp.floor(jax.random.uniform(place_key, (2,)) * free)
        pixels = jnp.stack([column + columns, row + rows], axis=-1) + pixel_offset
        posed = dataclasses.replace(views, cameras=dataclasses.replace(views.cameras, to_world=moved))
        return jax.random.split(ray_key, PATCH_SIDE**2), view_rays(posed, view, pixels, ndc=ndc, needs=needs)

    keys = jax.random.split(jax.random.fold_in(step_key(seed, step), _PATCHES), count)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), jax.vmap(patch)(keys))


def in_patches(values: Array) -> Array:
    """Returns values [P PATCH_SIDE^2, ...] of the rays of patches as [P, PATCH_SIDE, PATCH_SIDE, ...]."""
    return values.reshape(-1, PATCH_SIDE, PATCH_SIDE, *values.shape[1:])


def pose_between(
    key: Key[Array, ""], view: Int[ArrayLike, ""], poses: Float[Array, "views 3 4"]
) -> Float[Array, "3 4"]:
    """Draws a pose between that of a view and those of two random others that look the same way within 60 degrees.

    Position and axes are their mean with random weights, uniform over the triangle; the axes are made orthonormal,
    the viewing direction first. Where no other camera looks that way, it is the view's own pose.

    Args:
        key: one.
        view: index of the view.
        poses: [V, 3, 4] camera to world.
    """
    view = jnp.asarray(view)
    choice_key, weight_key = jax.random.split(key)
    axes = poses[:, :, 2]
    fits = (axes @ axes[view] > _MIN_COSINE) & (jnp.arange(len(poses)) != view)
    fits = jnp.where(fits.any(), fits, jnp.arange(len(poses)) == view)
    others = jax.random.categorical(choice_key, jnp.where(fits, 0.0, -jnp.inf), shape=(2,))
    weights = jax.random.dirichlet(weight_key, jnp.ones(3))
    mean = jnp.einsum("k,kij->ij", weights, poses[jnp.concatenate([view[None], others])])
    back = mean[:, 2] / jnp.linalg.norm(mean[:, 2])
    right = jnp.cross(mean[:, 1], back)
    right = right / jnp.linalg.norm(right)
    return jnp.stack([right, jnp.cross(back, right), back, mean[:, 3]], axis=-1)
