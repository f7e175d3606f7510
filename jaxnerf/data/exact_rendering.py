"""Renders the still life in numpy: the same bits on every machine, whatever XLA's flags are.

The quadrature is that of `rendering.render_samples`, with fixed samples. It is fast because most samples are skipped.
They are divided into intervals, and the distance at the middle of an interval bounds the distance at all of its
samples. Bodies are evaluated only in the intervals near them that the ray reaches before it is opaque, and colours only
where the ray still has light.
"""

from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxnerf.core.types import Rays
from jaxnerf.data.images.pixel_cache import num_workers
from jaxnerf.fields.portable_math import exp
from jaxnerf.fields.still_life import BODIES, FINISHES, WIDTH

INTERVAL = 8  # samples
# From the outline, in world units. What is neglected beyond has a density of at most 50 exp(-16), which changes a pixel
# by a tenth of a 16 bit level at most.
_MARGIN = 16 * WIDTH
_DARK = 16.0  # optical depth behind which nothing is visible
_FAINT = 1e-9  # weight below which a sample's colour is not evaluated


def render_rays(
    rays: Rays, finish: str, *, num_segments: int, chunk: int = 4096
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
    """Renders rays through the still life by the midpoint rule.

    Args:
        rays: Rays [N] of numpy arrays; they hit nothing where near >= far.
        finish: see `still_life.FINISHES`.
        num_segments: of each ray, a multiple of 8.
        chunk: number of rays that a thread renders at once, which has no effect on the result.

    Returns:
        The colour [N, 3] on black, and the opacity [N].

    Raises:
        ValueError: if num_segments is no multiple of 8.
    """
    if num_segments < 1 or num_segments % INTERVAL:
        raise ValueError(f"render_rays: num_segments is {num_segments}, expected a multiple of {INTERVAL}")
    rgb, opacity = np.zeros((rays.near.size, 3)), np.zeros(rays.near.size)
    hits = np.flatnonzero(rays.far > rays.near)

    def render(start):
        chosen = hits[start : start + chunk]
        part = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32)[chosen], rays)
        rgb[chosen], opacity[chosen] = _render(part, finish, num_segments // INTERVAL)

    with ThreadPoolExecutor(num_workers()) as pool:
        list(pool.map(render, range(0, hits.size, chunk)))
    return rgb, opacity


def _render(rays, finish, count):
    """Returns the colour [R, 3] and the opacity [R] of Rays [R], with `count` intervals each."""
    near, size = rays.near, rays.near.size
    width = (rays.far - near) / count  # of an interval, in t
    x, y, z = rays.directions.T
    half = width / 2 * np.sqrt(x * x + y * y + z * z)
    middle, inner = np.float32([0.5]), (np.arange(INTERVAL, dtype=np.float32) + 0.5) / INTERVAL

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

    total, parts = np.zeros((size * count, INTERVAL), np.float32), []
    for body, interval in zip(BODIES, near_intervals, strict=True):
        interval = interval[~hidden[interval]]
        ray, place = points(interval, inner)
        density = body.density(body.distance(*place))
        total[interval] += density
        parts.append((body, interval, ray, place, density))
    depth = total.reshape(size, -1) * (half[:, None] * (2 / INTERVAL))
    behind = np.add.accumulate(depth, axis=1, dtype=np.float64)  # one after the other, unlike a sum
    lit = np.flatnonzero((depth > 0) & (behind - depth < _DARK))
    after = behind.reshape(-1)[lit]
    before = (after - depth.reshape(-1)[lit]).astype(np.float32)
    weight = np.zeros((size * count, INTERVAL), np.float32)
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
        for channel, value in enumerate(body.colour(*place, direction)):
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
    first = np.clip(np.floor((enter - rays.near) / width), 0, count).astype(np.int64)
    end = np.clip(np.ceil((leave - rays.near) / width), 0, count).astype(np.int64)
    number = np.maximum(end - first, 0)
    offset = np.arange(size) * count + first - (np.cumsum(number) - number)
    return np.arange(number.sum()) + np.repeat(offset, number)
