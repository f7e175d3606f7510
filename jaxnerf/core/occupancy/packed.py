"""The renderer that asks only where there is something: the samples of many rays, packed into one pool."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnerf.core import rendering, volume_rendering
from jaxnerf.core.occupancy import bitmask, early_termination
from jaxnerf.core.occupancy.grid import is_occupied
from jaxnerf.core.types import PackedSamples, Rendering, check_shapes

_HARDLY = 1e-3  # of the light


def render_packed(scene, grid, rays, samples, *, max_samples, early_stop_eps=0.0, background=None):
    """Returns what render_samples does, asking the scene only where the grid is occupied.

    The samples of all rays that count are packed into a pool of fixed size, and composited there (Eq. 3,
    with the skipping and the early stop of arXiv:2201.05989).

    Args:
        scene: see render_samples; it is asked for [1, K, 3] positions with as many directions, or, with a
            early_stop_eps, for a few in a row of many rays.
        grid: Grid, outside whose box there is nothing. None where the samples are masked already.
        rays: Rays [...].
        samples: Samples [..., S]; rules "segments" and "points".
        capacity: K >= 1, the size of the pool.
        early_stop_eps: 0 asks all samples at once; those that do not fit are left out and counted. Greater than 0,
            as many as fit are asked again and again, the next ones of rays that still let more than this
            through: none is left out. What is behind a stopped ray is taken to look like what it has met:
            where colours are in [0, 1] the colour is within early_stop_eps of the whole one, and so is the opacity,
            which is 1. That is for rendering: it has no reverse mode.
        background: see render_samples.

    Returns:
        Rendering [...] without weights; dropped [...] says how many samples of a ray did not fit.

    Raises:
        ValueError: as render_samples; on rule "gauss"; if capacity < 1.
    """
    shape = rays.near.shape
    rays, samples = _checked("render_packed", rays, samples, max_samples)
    words = _words(grid, rays, samples)
    if early_stop_eps > 0:
        options = {"max_samples": max_samples, "early_stop_eps": early_stop_eps}
        sums = early_termination.march_until_terminated("render_packed", scene, rays, samples, words, **options)
        num_dropped, packed = jnp.zeros_like(rays.near, jnp.int32), None
    else:
        queue, slot = _queue(words), jnp.arange(max_samples)
        sums, packed = _ask(scene, rays, samples, _fill(queue, slot, slot < queue.ends[-1]))
        num_dropped = queue.count - jnp.clip(max_samples - _first(queue), 0, queue.count)
    flat = _rendering(sums, num_dropped, rays.far, shape, background)
    return dataclasses.replace(flat, samples=packed)


def visible_samples(scene, grid, rays, samples, *, error, max_samples, background=None):
    """Returns which samples a ray needs: without all of the others its colour differs by at most an error.

    From back to front, each sample is left out unless what that adds to the error made behind it, by Eq. 3,
    is too much. White fog before a white background is not needed, nor is the inside of a wall.

    Args:
        scene, rays, samples, background: see render_packed.
        grid: Grid, where the scene is asked.
        error: in each of the three channels, which are taken to be in [0, 1].
        capacity: samples asked at once; all of them are asked, in as many rounds as that takes.

    Returns:
        [..., S] bool; False where the scene is not asked. A ray that lets less than a thousandth pass keeps
        what stops it, whatever the colours: opacity and depth would show it. A NaN is needed, and shows.

    Raises:
        ValueError: as render_packed.
    """
    name, shape = "needed_samples", samples.t.shape
    rays, samples = _checked(name, rays, samples, max_samples)
    queue = _queue(_words(grid, rays, samples))

    def ask_round(index, answers):
        slot = index * max_samples + jnp.arange(max_samples)
        pool = _fill(queue, slot, slot < queue.ends[-1])
        _, density, rgb = _answers(name, scene, rays, samples, pool)
        place = jnp.where(pool.used, pool.ray * shape[-1] + pool.source, answers.shape[0])
        return answers.at[place].set(jnp.concatenate([density[:, None], rgb], axis=-1), mode="drop")

    rounds = -(-queue.ends[-1] // max_samples)
    answers = jax.lax.fori_loop(0, rounds, ask_round, jnp.zeros((samples.t.size, 4)))
    density, *rgb = jnp.moveaxis(answers.reshape(*samples.t.shape, 4), -1, 0)
    length = rendering.segment_lengths(jnp.maximum(samples.delta, 0), rays.directions)
    depth = jnp.where(density == 0, 0, density * length)
    before = jnp.exp(-volume_rendering.exclusive_sum(depth))
    passing = jnp.exp(-depth)

    def leave_out(state, sample):
        # [B, 3]: the colour behind the sample, and by how much it is off already; [B]: what an opaque ray
        # would let through of light from behind it.
        behind, wrong, bared = state
        before, passing, rgb = sample
        through = passing[:, None]
        change = wrong + (1 - through) * (rgb - behind)
        needed = ~(before * jnp.maximum(jnp.abs(change).max(axis=-1), bared) <= error)
        wrong = jnp.where(needed[:, None], through * wrong, change)
        bared = jnp.where(needed, passing * bared, bared)
        return ((1 - through) * rgb + through * behind, wrong, bared), needed

    behind = jnp.zeros(3) if background is None else jnp.asarray(background)
    behind = jnp.broadcast_to(behind, (*rays.near.shape, 3))
    opaque = before[:, -1:] * passing[:, -1:] < _HARDLY
    start = (behind, jnp.zeros_like(behind), opaque[:, 0].astype(behind.dtype))
    nearest_first = (before.T, passing.T, jnp.stack(rgb, axis=-1).swapaxes(0, 1))
    return jax.lax.scan(leave_out, start, nearest_first, reverse=True)[1].T.reshape(shape)


class _Queue(NamedTuple):
    """The samples that count, ray after ray: a bit each, W words of 32 a ray."""

    words: jax.Array  # [B W] uint32, the samples' flags, the nearest lowest
    ends: jax.Array  # [B W] int32, how many count up to the end of each word
    count: jax.Array  # [B] int32, how many of each ray count


class _Pool(NamedTuple):
    """What is asked at once."""

    source: jax.Array  # [K] int32, places among the samples of the ray
    ray: jax.Array  # [K] int32, ascending
    used: jax.Array  # [K] bool, False for the room that is left


def _checked(function, rays, samples, max_samples):
    """Returns Rays [B] and Samples [B, S] of any leading axes; ValueError on what cannot be packed."""
    if samples.rule == "gauss":
        raise ValueError(f"{function}: rule 'gauss' asks in pairs, which a cell's border may part; use 'segments'")
    check_shapes(function, near=(rays.near, "..."), t=(samples.t, "... S"), delta=(samples.delta, "... S"))
    if max_samples < 1:
        raise ValueError(f"{function}: max_samples is {max_samples}, wanted at least 1")
    leading = rays.near.ndim
    return jax.tree.map(lambda x: jnp.asarray(x).reshape(-1, *x.shape[leading:]), (rays, samples))


def _words(grid, rays, samples):
    """Returns [B, W], which samples count."""
    kept = ~(samples.delta <= 0)
    return bitmask.pack(kept if grid is None else kept & is_occupied(grid, rays, samples.t))


def _queue(words):
    sizes = bitmask.count(words)
    return _Queue(words.reshape(-1), jnp.cumsum(sizes.reshape(-1)), sizes.sum(-1))


def _first(queue):
    """Returns [B], where each ray's samples begin in the queue."""
    return jnp.cumsum(queue.count) - queue.count


def _fill(queue, place, used):
    """Returns the Pool of the samples at places [K] in the queue, each the next after the one before."""
    # How many words have ended up to a place: counted from place to place, rather than searched for each.
    ended = jnp.zeros_like(place).at[jnp.maximum(queue.ends - place[0], 0)].add(1, mode="drop")
    word = jnp.minimum(jnp.cumsum(ended), queue.words.size - 1)
    flags = queue.words[word]
    before = queue.ends[word] - bitmask.count(flags)
    width = queue.words.size // queue.count.size
    return _Pool(word % width * 32 + bitmask.nth(flags, place - before), word // width, used)


def _answers(function, scene, rays, samples, pool):
    """Returns what a scene says at a pool's samples, 0 in the room left: t [K], density [K], rgb [K, 3]."""
    t = jnp.where(pool.used, samples.t[pool.ray, pool.source], 0)
    one = jax.tree.map(lambda leaf: leaf[pool.ray][None], rays)  # Rays [1, K], one a sample
    x = one.origins + t[None, :, None] * one.directions
    density, rgb = scene(x, one.viewdirs)
    rendering.check_scene_output(function, density, rgb, x)
    return t, jnp.where(pool.used, density[0], 0), jnp.where(pool.used[:, None], rgb[0], 0)


def _ask(scene, rays, samples, pool):
    """Evaluates the scene at a pool's samples and composites them: Sums [B], PackedSamples [K]."""
    t, density, rgb = _answers("render_packed", scene, rays, samples, pool)
    delta = jnp.where(pool.used, samples.delta[pool.ray, pool.source], 0)
    length = rendering.segment_lengths(delta[:, None], rays.directions[pool.ray])[:, 0]
    starts = pool.ray != jnp.roll(pool.ray, 1).at[0].set(-1)
    weights, optical_depth = volume_rendering.packed_weights(density, length, starts, longest=samples.t.shape[-1])
    colours = [rgb[:, axis] * weights for axis in range(3)]
    parts = [optical_depth, *colours, weights * t, volume_rendering.divide_or_zero(weights, t)]
    sums = jax.ops.segment_sum(jnp.stack(parts, axis=-1), pool.ray, rays.near.size, indices_are_sorted=True)
    packed = PackedSamples(weights=weights, t=t, delta=delta, ray_index=pool.ray, used=pool.used)
    return early_termination.Sums(
        passing=jnp.exp(-sums[:, 0]),
        opacity=-jnp.expm1(-sums[:, 0]),
        rgb=sums[:, 1:4],
        depth=sums[:, 4],
        disparity=sums[:, 5],
    ), packed


def _rendering(sums, num_dropped, far, shape, background):
    rgb = sums.rgb
    if background is not None:
        behind = jnp.broadcast_to(jnp.asarray(background, rgb.dtype), (*shape, 3)).reshape(-1, 3)
        rgb = rgb + sums.passing[:, None] * behind
    flat = Rendering(
        rgb=rgb,
        opacity=sums.opacity,
        depth=sums.depth + volume_rendering.multiply_or_zero(sums.passing, far),
        disparity=sums.disparity,
        weights=None,
        num_dropped=num_dropped,
    )
    return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), flat)
