"""The embedded dataset: views of `fields.still_life`, rendered on first use, so that nothing is downloaded."""

import inspect
import math
import os
import sys

import jax
import numpy as np
from jaxtyping import UInt16

from jaxnerf.core import cameras
from jaxnerf.core.types import Camera, Rays, Views
from jaxnerf.data import exact_rendering
from jaxnerf.data.images import image_files
from jaxnerf.fields import portable_math, still_life
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.runtime.user_cache import load_or_make

_COUNT = {"train": 60, "val": 8, "test": 8}
_DISTANCE = 4.0  # of every camera from the origin, world units
_DEPTH = 1.4  # of the scene in front of and behind the origin, along any axis: the plinth's edge is at 1.27
_CYLINDER = {"radius": 1.14, "ends": (-0.97, 1.1)}  # around the z axis; contains all density; world units
_WHITE = (1.0, 1.0, 1.0)
# SHA-256 of two test views of 24 px in each finish, in the order usual, matt, shiny.
CHECKSUM = "5a3d1cf5978d6ef65d76665f47b7bbb7179ec1ff20037f2519f67f347a3e4266"


def load_synthetic(
    *, split: str = "train", size: int = 100, finish: str = "usual", cache: str | os.PathLike | None = None
) -> Views:
    """Returns views of the embedded still life, with alpha and a white background.

    They are computed from a closed-form field, with the same bits on every machine. Each pixel is a single ray through
    its center, as the pixels of a trained model are, so a model's error contains no difference between filters.

    Args:
        split: "train" (60 views), "val" (8) or "test" (8). All 76 poses are different.
        size: height and width in px, at least 1. All 60 views of size 100 take about ten seconds, once.
        finish: "usual": a highlight on the ball; "matt": none, so that colour does not depend on the view
            direction; "shiny": highlights on half of the objects.
        cache: folder for the rendered pixels; None: jaxnerf in $XDG_CACHE_HOME or ~/.cache. If it cannot be
            used, a warning is logged and the views are rendered again.

    Returns:
        Views: pixels [V * size * size, 4] uint16, rays with t in [2.6, 5.4].

    Raises:
        ValueError: on another split, size or finish.
    """
    if split not in _COUNT:
        raise ValueError(f"split is {split!r}, expected one of {', '.join(_COUNT)}; choose one of these")
    if isinstance(size, bool) or not isinstance(size, int | np.integer) or not 1 <= size <= 4096:
        raise ValueError(f"size is {size!r}, expected a whole number of pixels from 1 to 4096; 100 is the default")
    if finish not in still_life.FINISHES:
        raise ValueError(f"finish is {finish!r}, expected one of {sorted(still_life.FINISHES)}; correct data.finish")
    count, size = _COUNT[split], int(size)
    stack = _cameras(split, size)
    form = (count * size * size, 4), np.uint16
    kept = load_or_make(
        cache,
        f"still_life_{finish}_{split}_{size}_{_fingerprint()}",
        lambda: {"pixels": render_views(stack, finish)},
        is_valid=lambda arrays: [(each.shape, each.dtype) for each in arrays.values()] == [form],
    )
    return Views(
        pixels=kept["pixels"],
        offset=np.arange(count, dtype=np.int32) * np.int32(size * size),
        size=np.full((count, 2), size, np.int32),
        cameras=stack,
        near=np.full(count, _DISTANCE - _DEPTH, np.float32),
        far=np.full(count, _DISTANCE + _DEPTH, np.float32),
        names=tuple(f"{split}_{index:03d}" for index in range(count)),
        background=_WHITE,
    )


def render_views(
    stack: Camera, finish: str = "usual", *, num_segments: int = 384, chunk: int = 4096
) -> UInt16[np.ndarray, "P 4"]:
    """Renders the pixels of a stack of V cameras: P = V * H * W, with straight alpha.

    Args:
        stack: [V], with one height and width.
        finish: see `load_synthetic`.
        num_segments: even, of the midpoint rule on the longest ray segment inside the scene's cylinder. Rays
            with at most half that length have half as many, which saves a quarter of the work.
        chunk: number of rays at once; it has no effect on the pixels.
    """
    rays = scene_rays(stack)
    length = rays.far - rays.near  # negative: the ray misses the cylinder
    rgba = np.zeros((length.size, 4))
    longest = max(length.max(), 0.0)
    for divisor, chosen in ((2, (length > 0) & (length <= longest / 2)), (1, length > longest / 2)):
        part = jax.tree.map(lambda leaf, chosen=chosen: leaf[chosen], rays)
        rgba[chosen, :3], rgba[chosen, 3] = exact_rendering.render_rays(
            part, finish, num_segments=num_segments // divisor, chunk=chunk
        )
    return image_files.to_straight(rgba[:, :3], rgba[:, 3], background=_WHITE)


def scene_rays(stack: Camera) -> Rays:
    """Returns the rays through all pixels of a stack of cameras, clipped to a cylinder around the scene.

    Args:
        stack: [V], with one height and width.

    Returns:
        Rays [V * H * W] of numpy arrays, float64. near >= far if a ray misses the cylinder, or if the lens has no ray
        for the pixel. The bits of a pinhole's rays are the same on every machine.
    """
    origins, directions, exists = _pinhole_rays(stack) if stack.distortion is None else _lens_rays(stack)
    # The intersections with the lateral surface are the roots of a quadratic in t.
    (x, y, z), (a, b, c) = origins.T, directions.T
    square = np.maximum(a * a + b * b, 1e-12)  # a ray parallel to the axis has none
    middle = -(x * a + y * b) / square
    aside, beside = x + middle * a, y + middle * b
    half = np.sqrt(np.maximum(_CYLINDER["radius"] ** 2 - (aside * aside + beside * beside), 0) / square)
    with np.errstate(divide="ignore", invalid="ignore"):  # a horizontal ray meets the ends at infinity
        ends = np.sort([(end - z) / c for end in _CYLINDER["ends"]], axis=0)
    near = np.maximum(middle - half, ends[0])
    return Rays(
        origins=origins,
        directions=directions,
        viewdirs=directions / np.sqrt(a * a + b * b + c * c)[:, None],
        near=near,
        far=np.where(exists, np.minimum(middle + half, ends[1]), near),
    )


def _pinhole_rays(stack):
    """Returns origins and directions [P, 3] through all pixels, and whether such a ray exists [P]."""
    count = stack.height * stack.width
    row, column = np.divmod(np.arange(count), stack.width)
    to_world, focal, center = (np.asarray(leaf, np.float64) for leaf in (stack.to_world, stack.focal, stack.center))
    right = (column + 0.5 - center[:, :1]) / focal[:, :1]
    up = -(row + 0.5 - center[:, 1:]) / focal[:, 1:]
    axes = to_world[:, None, :, :]
    directions = right[..., None] * axes[..., 0] + up[..., None] * axes[..., 1] - axes[..., 2]
    origins = np.broadcast_to(to_world[:, None, :, 3], directions.shape)
    return origins.reshape(-1, 3), directions.reshape(-1, 3), np.ones(len(to_world) * count, bool)


def _lens_rays(stack):
    """As _pinhole_rays, in float32: only JAX inverts a lens."""
    rays = jax.tree.map(np.asarray, _undistorted_rays(stack))
    origins, directions = (leaf.reshape(-1, 3).astype(np.float64) for leaf in (rays.origins, rays.directions))
    return origins, directions, rays.far.reshape(-1) > 0


@jax.jit  # otherwise each operation of a lens is compiled separately
def _undistorted_rays(stack):
    grid = cameras.pixel_grid(stack.height, stack.width).reshape(-1, 2)
    return jax.vmap(lambda camera: cameras.rays_from_pixels(camera, grid, near=0.0, far=1.0))(stack)


def _cameras(split, size):
    """Returns V cameras on a golden spiral that look at the origin, most of them from above."""
    count = _COUNT[split]
    steps = np.arange(count)
    height = -0.25 + 1.2 * (steps + 0.5) / count  # sine of the elevation; below 1, where up is undefined
    golden = math.pi * (3 - math.sqrt(5))
    azimuth = golden * steps + list(_COUNT).index(split)  # one radian between splits, so that all poses differ
    around = np.sqrt(1 - height**2)
    # In numpy, whose bits no flag of XLA changes.
    back = np.stack([around * np.cos(azimuth), around * np.sin(azimuth), height], axis=-1)
    right = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(count)], axis=-1)
    to_world = np.stack([right, np.cross(back, right), back, _DISTANCE * back], axis=-1)
    return Camera(
        to_world=to_world.astype(np.float32),
        focal=np.full((count, 2), 1.36 * size, np.float32),  # the whole plinth is visible
        center=np.full((count, 2), size / 2, np.float32),
        height=size,
        width=size,
    )


def _fingerprint():
    """Returns a hash of the source code that the pixels depend on."""
    own = sys.modules[__name__]
    modules = (still_life, portable_math, exact_rendering, image_files, own)
    return fingerprint(*(inspect.getsource(module) for module in modules))
