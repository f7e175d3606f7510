"""Rays that are asked until they early_stop_eps, in lanes: where a ray has ended, its lane takes the next one."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnerf.core import rendering, volume_rendering
from jaxnerf.core.occupancy import bitmask

_SOON = 0.01  # a early_stop_eps from which on rays end so soon that samples in a row are often asked in vain


class Sums(NamedTuple):
    """What the samples of rays add up to."""

    passing: jax.Array  # [B] what no sample stops
    opacity: jax.Array  # [B] 1 - passing, with all its digits
    rgb: jax.Array  # [B, 3]
    depth: jax.Array  # [B] sum of w t
    disparity: jax.Array  # [B] sum of w / t


class _Lanes(NamedTuple):
    """What L lanes are at."""

    ray: jax.Array  # [L] int32; B: none
    done: jax.Array  # [L] int32, samples of it that were asked
    sums: jax.Array  # [7, L], the columns of Sums


def march_until_terminated(function, scene, rays, samples, words, *, max_samples, early_stop_eps):
    """Returns the Sums of rays, each asked from near to far until no more than early_stop_eps passes, or to its end.

    What would pass a ray that is stopped is taken to look like all that it has met: such a ray is opaque.

    Args:
        function: whose errors these are.
        scene: see render_samples; it is asked for [L, N, 3] positions with [L, 1, 3] directions.
        rays: Rays [B].
        samples: Samples [B, S].
        words: [B, W] uint32, which samples count, see bits.pack.
        capacity: samples asked at once, L N at most.
        early_stop_eps: > 0.
    """
    ray_count = rays.near.size
    in_a_row = 2 if early_stop_eps >= _SOON else 4  # more are asked in vain, fewer make more rounds
    lane_count = max(min(max_samples // in_a_row, ray_count), 1)
    row = jnp.arange(max_samples // lane_count)[None]
    up_to = jnp.cumsum(bitmask.count(words), axis=-1)
    count = up_to[:, -1]
    order = _longest_first(count, samples.t.shape[-1])
    waiting = (count > 0).sum()

    def ask(ray, done):
        n = done[:, None] + row
        used = n < count.at[ray, None].get(mode="fill", fill_value=0)
        ray = jnp.minimum(ray, ray_count - 1)
        own, some = _nth_samples(rays, samples, words, up_to, ray, n, used)
        return _sum_part(function, scene, own, some, used)

    nobody = jnp.full(lane_count, ray_count)
    none_done = jnp.zeros_like(nobody)
    start = jnp.zeros((7, 1), jax.eval_shape(ask, nobody, none_done).dtype).at[0].set(1)

    def take(lanes, taken):
        """Returns the Lanes, of which those without a ray take the next, and how many are taken then."""
        free = lanes.ray == ray_count
        place = taken + jnp.cumsum(free) - free
        following = jnp.where(place < waiting, order.at[place].get(mode="clip"), ray_count)
        ray, done = jnp.where(free, following, lanes.ray), jnp.where(free, 0, lanes.done)
        return _Lanes(ray, done, jnp.where(free[None], start, lanes.sums)), taken + free.sum()

    def step(state):
        lanes, taken, ended = state
        lanes, taken = take(lanes, taken)
        more, light = ask(lanes.ray, lanes.done), lanes.sums[:1]
        sums = jnp.concatenate([light * more[:1], lanes.sums[1:] + light * more[1:]])
        done = lanes.done + row.size
        stops = ~(sums[0] > early_stop_eps)  # NaN stops, and shows
        ends = stops | (done >= count.at[lanes.ray].get(mode="clip"))
        sums = jnp.where(stops & (sums[1] > 0), _made_whole(sums), sums)
        ended = ended.at[:, jnp.where(ends, lanes.ray, ray_count)].set(sums, mode="drop")
        return _Lanes(jnp.where(ends, ray_count, lanes.ray), done, sums), taken, ended

    def goes_on(state):
        lanes, taken, _ = state
        return (taken < waiting) | (lanes.ray < ray_count).any()

    lanes = _Lanes(nobody, none_done, jnp.broadcast_to(start, (7, lane_count)))
    ended = jnp.broadcast_to(start, (7, ray_count))
    ended = jax.lax.while_loop(goes_on, step, (lanes, jnp.zeros_like(waiting), ended))[2]
    passing, opacity, *rgb, depth, disparity = ended
    return Sums(passing, opacity, jnp.stack(rgb, axis=-1), depth, disparity)


def _longest_first(count, most):
    """Returns the order [B] of rays by count [B], or a few lanes would go on where all others have ended.

    A sort of numbers that hold the ray's own too: argsort takes several times as long on a CPU.
    """
    rays = count.size
    if rays * (most + 1) > 2**32:  # which they are too many for
        return jnp.argsort(-count)
    numbers = jnp.uint32(rays) * (most - count).astype(jnp.uint32) + jnp.arange(rays, dtype=jnp.uint32)
    return (jnp.sort(numbers) % rays).astype(jnp.int32)


def _made_whole(sums):
    """Returns sums [7, L] of stopped rays: what still passes is taken to look like the rest."""
    return jnp.concatenate([jnp.zeros_like(sums[:1]), sums[1:] / sums[1:2]])


def _nth_samples(rays, samples, words, up_to, ray, n, used):
    """Returns Rays [L], those of lanes, and t and delta [L, N] of each one's n-th samples that count."""
    word = jnp.minimum((up_to[ray, None] <= n[..., None]).sum(axis=-1), words.shape[-1] - 1)
    ray = ray[:, None]
    flags, end = words[ray, word], up_to[ray, word]
    source = 32 * word + bitmask.nth(flags, n - end + bitmask.count(flags))
    t, delta = (jnp.where(used, leaf[ray, source], 0) for leaf in (samples.t, samples.delta))
    return jax.tree.map(lambda leaf: leaf[ray[:, 0]], rays), (t, delta)


def _sum_part(function, scene, rays, samples, used):
    """Returns [7, L], the columns of Sums of a few samples in a row, as if nothing lay before them."""
    t, delta = samples
    x = rendering.points_on_rays(rays, t)
    density, rgb = scene(x, rays.viewdirs[:, None])
    rendering.check_scene_output(function, density, rgb, x)
    density, rgb = jnp.where(used, density, 0), jnp.where(used[..., None], rgb, 0)
    length = rendering.segment_lengths(delta, rays.directions)
    weights = volume_rendering.weights_from_density(density, length)
    return jnp.stack(
        [
            volume_rendering.transmittance(density, length),
            volume_rendering.opacity(density, length),
            *volume_rendering.composite(weights, rgb).T,
            volume_rendering.multiply_or_zero(weights, t).sum(axis=-1),
            volume_rendering.expected_disparity(weights, t),
        ]
    )
