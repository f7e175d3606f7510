"""Renders images of the embedded scene in numpy: those that do not ship with the package.

The bits are the same on every machine, whatever XLA's flags are.
"""

import inspect
import logging
import sys
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from jaxtyping import Float, Int, UInt16

from jaxnerf.core import cameras
from jaxnerf.core.types import Camera, Rays
from jaxnerf.data.images import image_files
from jaxnerf.data.images.pixel_cache import num_workers
from jaxnerf.runtime import stages
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.tools.embedded_scene import portable_math, still_life
from jaxnerf.tools.embedded_scene.portable_math import exp
from jaxnerf.tools.embedded_scene.still_life import BODIES, WIDTH

_logger = logging.getLogger(__name__)
_MANY_SECONDS, _RAYS_PER_SECOND = 5, 100_000  # from which on people wait; on a core of two AMD EPYC
_WHITE = (1.0, 1.0, 1.0)
_CYLINDER = {"radius": 1.14, "ends": (-0.97, 1.1)}  # around the z axis; contains all density; world units
_INTERVAL = 8  # samples that are skipped together
# From the outline, in world units. What is neglected beyond has a density of at most 50 exp(-16), which changes a pixel
# by a tenth of a 16 bit level at most.
_MARGIN = 16 * WIDTH
_DARK = 16.0  # optical depth behind which nothing is visible
_FAINT = 1e-9  # weight below which a sample's colour is not evaluated


def fingerprint_of_code() -> str:
    """Returns a hash of the source code that the pixels depend on."""
    modules = (still_life, portable_math, image_files, sys.modules[__name__])
    return fingerprint(*(inspect.getsource(module) for module in modules))


def render_views(
    stack: Camera, finish: str = "usual", *, num_segments: int = 256, chunk: int = 4096
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
    if (seconds := len(rays.near) / _RAYS_PER_SECOND) > _MANY_SECONDS:
        _logger.warning("images of the embedded scene are rendered, which takes about %.0f s on a core", seconds)
    length = rays.far - rays.near  # negative: the ray misses the cylinder
    rgba = np.zeros((length.size, 4))
    longest = max(length.max(), 0.0)
    for divisor, chosen in ((2, (length > 0) & (length <= longest / 2)), (1, length > longest / 2)):
        part = jax.tree.map(lambda leaf, chosen=chosen: leaf[chosen], rays)
        rgba[chosen, :3], rgba[chosen, 3] = render_rays(part, finish, num_segments=num_segments // divisor, chunk=chunk)
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


def render_rays(
    rays: Rays, finish: str, *, num_segments: int, chunk: int = 4096
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
    """Renders rays through the still life by the midpoint rule of `render_samples`, in numpy.

    The bits are the same on every machine, whatever XLA's flags are. It is fast because most samples are skipped: they
    are divided into intervals, and the distance at the middle of an interval bounds the distance at all of its samples.
    Bodies are evaluated only in the intervals near them that the ray reaches before it is opaque, and colours only
    where a sample has a weight.

    Args:
        rays: Rays [N] of numpy arrays; they hit nothing where near >= far.
        finish: see `load_synthetic`.
        num_segments: of each ray, a multiple of 8.
        chunk: number of rays that a thread renders at once, which has no effect on the result.

    Returns:
        The colour [N, 3] on black, and the opacity [N].

    Raises:
        ValueError: if num_segments is no multiple of 8.
    """
    if num_segments < 1 or num_segments % _INTERVAL:
        raise ValueError(f"render_rays: num_segments is {num_segments}, expected a multiple of {_INTERVAL}")
    rgb, opacity = np.zeros((rays.near.size, 3)), np.zeros(rays.near.size)
    hits = np.flatnonzero(rays.far > rays.near)

    def render(start):
        chosen = hits[start : start + chunk]
        part = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32)[chosen], rays)
        rgb[chosen], opacity[chosen] = _render(part, finish, num_segments // _INTERVAL)

    starts = range(0, hits.size, chunk)
    with ThreadPoolExecutor(num_workers()) as pool, stages.stage("rendering the embedded scene") as stage:
        for done, _ in enumerate(pool.map(render, starts), 1):
            stage.update(done, len(starts))
    return rgb, opacity


def _render(rays, finish, count):
    """Returns the colour [R, 3] and the opacity [R] of Rays [R], with `count` intervals each."""
    near, size = rays.near, rays.near.size
    width = (rays.far - near) / count  # of an interval, in t
    x, y, z = rays.directions.T
    half = width / 2 * np.sqrt(x * x + y * y + z * z)
    middle, inner = np.float32([0.5]), (np.arange(_INTERVAL, dtype=np.float32) + 0.5) / _INTERVAL

    def points(interval, fractions):
        """Returns the ray of intervals with these flat indices in [R, count], and positions at fractions of each."""
        ray = interval // count
        t = near[ray, None] + ((interval - ray * count).astype(np.float32)[:, None] + fractions) * width[ray, None]
        return ray, [rays.origins[ray, axis, None] + t * rays.directions[ray, axis, None] for axis in range(3)]

    # All samples of an interval are within half its length of its middle.
    least, near_intervals = np.zeros(size * count, np.float32), []
    for body in BODIES:
        interval = _inside_box(body, rays, width, count)
        ray, place = points(interval, middle)
        distance, reach = body.distance(*place)[:, 0], half[ray]
        least[interval] += body.density(distance + reach) * (2 * reach)  # each interval is there once
        near_intervals.append(interval[distance < _MARGIN + reach])
    least = least.reshape(size, count)
    hidden = (np.add.accumulate(least, axis=1) - least > _DARK).reshape(-1)

    total, parts = np.zeros((size * count, _INTERVAL), np.float32), []
    for body, interval in zip(BODIES, near_intervals, strict=True):
        interval = interval[~hidden[interval]]
        ray, place = points(interval, inner)
        density = body.density(body.distance(*place))
        total[interval] += density
        parts.append((body, interval, ray, place, density))
    depth = total.reshape(size, -1) * (half[:, None] * (2 / _INTERVAL))
    behind = np.add.accumulate(depth, axis=1, dtype=np.float64)  # one after the other, unlike a sum
    lit = np.flatnonzero((depth > 0) & (behind - depth < _DARK))
    after = behind.reshape(-1)[lit]
    before = (after - depth.reshape(-1)[lit]).astype(np.float32)
    weight = np.zeros((size * count, _INTERVAL), np.float32)
    weight.reshape(-1)[lit] = exp(-before) - exp(-after.astype(np.float32))

    rgb = np.zeros((size, 3))
    for body, interval, ray, place, density in parts:
        fraction = weight[interval]
        seen = np.nonzero(fraction > _FAINT)
        fraction = fraction[seen] * density[seen] / total[interval[seen[0]], seen[1]]
        ray, place = ray[seen[0]], [value[seen] for value in place]
        direction = None if finish == "matt" else [rays.viewdirs[ray, axis] for axis in range(3)]
        for channel, value in enumerate(body.color(*place, direction)):
            rgb[:, channel] += np.bincount(ray, fraction * value, size)  # adds one after the other
    return rgb, 1 - exp(-behind[:, -1].astype(np.float32)).astype(np.float64)


def _inside_box(body, rays, width, count) -> Int[np.ndarray, " P"]:
    """Returns the flat indices of the intervals [R, count] that touch a body's box and the margin around it."""
    size = width.size
    enter, leave = np.full(size, -np.inf, np.float32), np.full(size, np.inf, np.float32)
    for axis, (lower, upper) in enumerate(zip(body.lower, body.upper, strict=True)):
        origin, direction = rays.origins[:, axis], rays.directions[:, axis]
        level = direction == 0
        ends = [(bound - origin) / np.where(level, 1, direction) for bound in (lower - _MARGIN, upper + _MARGIN)]
        beside = np.where((ends[0] > 0) | (ends[1] < 0), np.inf, -np.inf)
        enter = np.maximum(enter, np.where(level, beside, np.minimum(*ends)))
        leave = np.minimum(leave, np.where(level, np.inf, np.maximum(*ends)))
    with np.errstate(divide="ignore"):  # rays that miss the scene have intervals of width 0, all at infinity
        first = np.clip(np.floor((enter - rays.near) / width), 0, count).astype(np.int64)
        end = np.clip(np.ceil((leave - rays.near) / width), 0, count).astype(np.int64)
    number = np.maximum(end - first, 0)
    offset = np.arange(size) * count + first - (np.cumsum(number) - number)
    return np.arange(number.sum()) + np.repeat(offset, number)
