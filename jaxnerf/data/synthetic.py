"""The default scene: views of fields.showcase, rendered here on first use, so that nothing is downloaded."""

import functools
import hashlib
import inspect
import math
import sys

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf.core import cameras, poses, rendering, sampling, types, volume_rendering
from jaxnerf.core.poses import look_at
from jaxnerf.core.types import Camera, Rays, Views
from jaxnerf.data.images import image_files
from jaxnerf.fields import still_life
from jaxnerf.runtime.user_cache import load_or_make

_COUNT = {"train": 60, "val": 8, "test": 8}
_DISTANCE = 4.0  # of every camera from the origin, world units
_DEPTH = 1.4  # of the scene before and behind the origin along any axis: the plinth's edge is 1.27 from it
_CYLINDER = {"radius": 1.14, "ends": (-0.97, 1.1)}  # around the z axis, holds all density; world units
_WHITE = (1.0, 1.0, 1.0)
FINISHES = {"usual": still_life.still_life, "matt": still_life.matt_scene, "shiny": still_life.shiny_scene}


def load_views(*, split="train", size=100, finish="usual", cache=None):
    """Returns views of the built-in still life, with alpha, to be composited over white.

    This package's renderer makes them from a field in closed form. Each pixel is one ray through its centre:
    as a model's pixels are, so what separates the two is the model's error and no filter's.

    Args:
        split: "train" (60 views), "val" (8) or "test" (8). No two of the 76 have the same pose.
        size: H = W in px, >= 1. All 60 views take about ten seconds at 100, once.
        finish: "usual", with a highlight on the ball; "matt", without, so that no view direction matters;
            "shiny", with highlights on half of what is there.
        cache: folder for the rendered pixels; None for jaxnerf in $XDG_CACHE_HOME or ~/.cache. Where it
            cannot be used they are rendered again, with a warning in the log.

    Returns:
        Views: pixels [V * size * size, 4] uint16, rays through t in [2.6, 5.4].

    Raises:
        ValueError: on another split, size or finish.
    """
    if split not in _COUNT:
        raise ValueError(f"split is {split!r}, the built-in scene has {', '.join(_COUNT)}; take one of these")
    if isinstance(size, bool) or not isinstance(size, int | np.integer) or not 1 <= size <= 4096:
        raise ValueError(f"size is {size!r}, wanted a whole number of pixels from 1 to 4096; 100 is usual")
    if finish not in FINISHES:
        raise ValueError(f"finish is {finish!r}, wanted one of {sorted(FINISHES)}; correct data.finish")
    count, size = _COUNT[split], int(size)
    stack = _cameras(split, size)
    form = (count * size * size, 4), np.uint16
    kept = load_or_make(
        cache,
        f"showcase_{finish}_{split}_{size}_{_fingerprint()}",
        lambda: {"pixels": render_views(stack, FINISHES[finish])},
        fits=lambda arrays: [(each.shape, each.dtype) for each in arrays.values()] == [form],
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


def render_views(stack, scene=still_life.still_life, *, num_segments=384, chunk=1024):
    """Returns the pixels of a stack of V cameras, [V * H * W, 4] uint16 with straight alpha.

    Args:
        stack: Camera [V], of one height and width.
        scene: what they see, a SceneFn.
        num_segments: of the midpoint rule on the longest way through the scene, even. Ways of up to half
            that length take half as many, which saves a quarter of the work and keeps the segments short.
        chunk: rays at once. No pixel depends on it.
    """
    rays = scene_rays(stack)
    way = rays.far - rays.near  # negative: the ray misses
    seen = np.zeros((way.size, 4))
    longest = max(way.max(), 0.0)
    for share, chosen in ((2, (way > 0) & (way <= longest / 2)), (1, way > longest / 2)):
        indices, parts = np.flatnonzero(chosen), []
        for start in range(0, indices.size, chunk):
            index = indices[np.minimum(np.arange(start, start + chunk), indices.size - 1)]  # one shape
            part = jax.tree.map(lambda leaf, index=index: leaf[index], rays)
            parts.append(_render(part, scene, num_segments // share))  # returns at once: the device stays busy
        if parts:
            seen[indices] = np.concatenate(parts)[: indices.size]
    return image_files.to_straight(seen[:, :3], seen[:, 3], background=_WHITE)


def scene_rays(stack):
    """Returns the rays through all pixels of a stack of cameras, cut to the part that can hold matter.

    Args:
        stack: Camera [V], of one height and width.

    Returns:
        Rays [V * H * W], arrays of numpy, from entering to leaving a cylinder around the scene; near >= far
        where they miss it, and where a lens has no ray for the pixel.
    """
    rays = _all_rays(stack)
    origins, directions, viewdirs = (
        np.asarray(leaf).reshape(-1, 3) for leaf in (rays.origins, rays.directions, rays.viewdirs)
    )
    # The round side is a quadratic in t.
    start, slope = origins[:, :2], directions[:, :2]
    square = np.maximum((slope**2).sum(axis=-1), 1e-12)  # a ray along the axis never meets the side
    middle = -(start * slope).sum(axis=-1) / square
    closest = ((start + middle[:, None] * slope) ** 2).sum(axis=-1)
    half = np.sqrt(np.maximum(_CYLINDER["radius"] ** 2 - closest, 0) / square)
    with np.errstate(divide="ignore"):  # a level ray meets the ends at infinity
        ends = np.sort((np.float32([_CYLINDER["ends"]]) - origins[:, 2:]) / directions[:, 2:], axis=-1)
    near = np.maximum(middle - half, ends[:, 0])
    through = np.asarray(rays.far).reshape(-1) > 0
    return Rays(
        origins=origins,
        directions=directions,
        viewdirs=viewdirs,
        near=near,
        far=np.where(through, np.minimum(middle + half, ends[:, 1]), near),
    )


@jax.jit  # step by step, each of a lens's operations would be compiled by itself
def _all_rays(stack):
    grid = cameras.pixel_grid(stack.height, stack.width).reshape(-1, 2)
    return jax.vmap(lambda camera: cameras.rays_from_pixels(camera, grid, near=0.0, far=1.0))(stack)


@functools.partial(jax.jit, static_argnums=(1, 2))
def _render(rays, scene, num_segments):
    result = rendering.render_rays(None, scene, rays, num_samples=num_segments)
    return jnp.concatenate([result.rgb, result.opacity[:, None]], axis=-1)


def _cameras(split, size):
    """Returns V cameras on a golden spiral, looking at the origin from above and from a little below."""
    count = _COUNT[split]
    steps = np.arange(count)
    height = -0.25 + 1.2 * (steps + 0.5) / count  # sine of the elevation; short of 1, where up means nothing
    golden = math.pi * (3 - math.sqrt(5))
    azimuth = golden * steps + list(_COUNT).index(split)  # a radian between splits: no pose comes twice
    around = np.sqrt(1 - height**2)
    eyes = _DISTANCE * np.stack([around * np.cos(azimuth), around * np.sin(azimuth), height], axis=-1)
    to_world = jax.vmap(lambda eye: look_at(eye, jnp.zeros(3), jnp.array([0.0, 0.0, 1.0])))(eyes)
    return Camera(
        to_world=np.asarray(to_world),
        focal=np.full((count, 2), 1.36 * size, np.float32),  # the whole plinth fits
        center=np.full((count, 2), size / 2, np.float32),
        height=size,
        width=size,
    )


def _fingerprint():
    """Returns a hash of the source code that the pixels depend on: a changed scene is rendered anew."""
    own = sys.modules[__name__]
    modules = (still_life, cameras, volume_rendering, poses, rendering, sampling, types, image_files, own)
    source = "".join(inspect.getsource(module) for module in modules)
    return hashlib.sha256(source.encode()).hexdigest()[:16]
