"""The embedded dataset: views of `fields.still_life`, so that nothing is downloaded. Those of the demo ship with the
package, rendered by experiments/embedded/write_images.py; others are rendered on first use.
"""

import inspect
import logging
import math
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float, Int, UInt16

from jaxnerf.core import cameras
from jaxnerf.core.types import Camera, Rays
from jaxnerf.core.views import Views
from jaxnerf.data.images import image_files
from jaxnerf.data.images.pixel_cache import num_workers
from jaxnerf.fields import portable_math, still_life
from jaxnerf.fields.portable_math import exp
from jaxnerf.fields.still_life import BODIES, FINISHES, WIDTH
from jaxnerf.registry import Reader
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.runtime.user_cache import load_or_make

_logger = logging.getLogger(__name__)
_MANY_SECONDS, _RAYS_PER_SECOND = 5, 100_000  # from which on people wait; on a core of two AMD EPYC
_COUNT = {"train": 60, "val": 8, "test": 8}
SHIPPED = Path(__file__).with_name("still_life.npz")  # the splits train and test of this size and finish
SHIPPED_SIZE, SHIPPED_FINISH = 200, "usual"
_DISTANCE = 4.0  # of every camera from the origin, world units
_DEPTH = 1.4  # of the scene in front of and behind the origin, along any axis: the plinth's edge is at 1.27
_CYLINDER = {"radius": 1.14, "ends": (-0.97, 1.1)}  # around the z axis; contains all density; world units
_WHITE = (1.0, 1.0, 1.0)
# SHA-256 of two test views of 24 px in each finish, in the order usual, matt, shiny.
CHECKSUM = "443353a4de8ea173b87fd430eea98a896b2a70cb78c22364fa0292f087530482"
_INTERVAL = 8  # samples that are skipped together
# From the outline, in world units. What is neglected beyond has a density of at most 50 exp(-16), which changes a pixel
# by a tenth of a 16 bit level at most.
_MARGIN = 16 * WIDTH
_DARK = 16.0  # optical depth behind which nothing is visible
_FAINT = 1e-9  # weight below which a sample's colour is not evaluated


def load_synthetic(
    *, split: str = "train", size: int = 100, finish: str = "usual", cache: str | os.PathLike | None = None
) -> Views:
    """Returns views of the embedded still life, with alpha and a white background.

    They are computed from a closed-form field, with the same bits on every machine. Each pixel is a single ray through
    its center, as the pixels of a trained model are, so a model's error contains no difference between filters.

    Args:
        split: "train" (60 views), "val" (8) or "test" (8). All 76 poses are different.
        size: height and width in px, at least 1. All 60 views of size 100 take about six seconds, once.
        finish: "usual": a highlight on the ball; "matt": none, so that colour does not depend on the view
            direction; "shiny": highlights on half of the objects.
        cache: folder for pixels that are rendered; None: jaxnerf in $XDG_CACHE_HOME or ~/.cache. If it cannot be
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
    if finish not in FINISHES:
        raise ValueError(f"finish is {finish!r}, expected one of {sorted(FINISHES)}; correct data.finish")
    count, size = _COUNT[split], int(size)
    stack = _cameras(split, size)
    if (size, finish) == (SHIPPED_SIZE, SHIPPED_FINISH) and split != "val":
        pixels = _shipped(split)
    else:
        pixels = load_or_make(
            cache,
            f"still_life_{finish}_{split}_{size}_{_fingerprint()}",
            lambda: {"pixels": render_views(stack, finish)},
            is_valid=lambda found: [(a.shape, a.dtype) for a in found.values()] == [((count * size**2, 4), np.uint16)],
        )["pixels"]
    return Views(
        pixels=pixels,
        offset=np.arange(count, dtype=np.int32) * np.int32(size * size),
        size=np.full((count, 2), size, np.int32),
        cameras=stack,
        near=np.full(count, _DISTANCE - _DEPTH, np.float32),
        far=np.full(count, _DISTANCE + _DEPTH, np.float32),
        names=tuple(f"{split}_{index:03d}" for index in range(count)),
        background=_WHITE,
    )


def _shipped(split):
    """Returns the pixels of a split in SHIPPED: bytes [2, V, 4, H, W], high and low, of differences of neighbours."""
    with np.load(SHIPPED) as file:
        high, low = file[split].astype(np.uint16)
    values = ((high << 8 | low) - np.uint16(128)).cumsum(2, np.uint16).cumsum(3, np.uint16)  # modulo 65536
    return np.moveaxis(values, 1, -1).reshape(-1, 4)


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
    modules = (still_life, portable_math, image_files, sys.modules[__name__])
    return fingerprint(*(inspect.getsource(module) for module in modules))


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
        finish: see `FINISHES`.
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

    with ThreadPoolExecutor(num_workers()) as pool:
        list(pool.map(render, range(0, hits.size, chunk)))
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
        direction = None
        if body.name in FINISHES[finish]:
            direction = [rays.viewdirs[ray, axis] for axis in range(3)]
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


def _no_folder(folder):
    raise ValueError(f"{folder}: the embedded scene is in no folder; give another format than 'synthetic'")


READER = Reader(
    _no_folder,
    detect=lambda folder: False,
    views=lambda data, split: load_synthetic(split=split, size=data.size, finish=data.finish),
)
