"""Renders only the samples in occupied cells: packed into one buffer, or with early termination.

Occupied samples are those of positive length in an occupied cell. Training packs them into one buffer of fixed
size and composites them there. Images march each ray only until it is opaque.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, UInt32

from jaxnerf.core import rendering, volume_rendering
from jaxnerf.core.fixed_order import segment_sums
from jaxnerf.core.loops import vary_like
from jaxnerf.core.occupancy.grid import OccupancyGrid, is_occupied
from jaxnerf.core.scene import evaluate_scene, needs_of
from jaxnerf.core.types import Background, PackedSamples, PlacedSamples, Rays, Rendering, Samples, SceneFn, check_shapes

_HIGH_EPS = 0.01  # an early_stop_eps above which rays end so soon that long runs waste samples


def render_packed(
    scene: SceneFn,
    grid: OccupancyGrid | None,
    rays: Rays,
    samples: Samples,
    *,
    max_samples: int,
    early_stop_eps: float = 0.0,
    background: Background | None = None,
    median_depth: bool = False,
) -> Rendering:
    """Renders samples as render_samples does, but evaluates the scene only in the grid's occupied cells.

    The occupied samples of all rays are packed into a buffer of fixed size and composited there (Eq. 3 of
    arXiv:2003.08934, with the skipping and the early termination of arXiv:2201.05989).

    Args:
        scene: see render_samples. It is evaluated at [1, K, 3] positions with as many directions, or, with an
            early_stop_eps, at a few consecutive samples of many rays.
        grid: OccupancyGrid, outside whose box space is empty. None where the samples are masked already.
        rays: Rays [...].
        samples: Samples [..., S]; rules "segments" and "points".
        max_samples: K >= 1, the size of the buffer.
        early_stop_eps: 0 evaluates all samples at once; those that do not fit are dropped and counted. Above 0, none
            is dropped: each of several rounds evaluates as many samples as fit, the next ones of the rays whose
            transmittance is still above early_stop_eps. The remaining light of a terminated ray is assumed to
            look like the rest of the ray. If colours are in [0, 1], the colour is then within early_stop_eps of
            the exact one, and so is the opacity, which is 1. This mode is for rendering; it has no reverse mode.
        background: see render_samples.
        median_depth: see render_samples; an early_stop_eps must then be at most 0.5.

    Returns:
        Rendering [...] without weights; num_dropped [...] is the number of a ray's samples that did not fit.
        Without early termination `samples` is PackedSamples [K]; K is 0 if there are no rays.

    Raises:
        ValueError: as render_samples; on rule "gauss"; if max_samples < 1; if rays end before their median depth.
    """
    if median_depth and early_stop_eps > 0.5:
        raise ValueError(
            f"render_packed: early_stop_eps is {early_stop_eps} and median_depth is True, expected at most 0.5: rays "
            "would end before their median depth"
        )
    shape, scene = rays.near.shape, _without_gradient_if_empty(scene, rays)
    rays, samples = flattened("render_packed", rays, samples, max_samples)
    words = occupied_words(grid, rays, samples)
    if early_stop_eps > 0:
        options = {"max_samples": max_samples, "early_stop_eps": early_stop_eps, "median_depth": median_depth}
        sums = _march_until_terminated("render_packed", scene, rays, samples, words, **options)
        num_dropped, packed = jnp.zeros_like(rays.near, jnp.int32), None
    else:
        occupied, slot = count_occupied(words), jnp.arange(max_samples, dtype=jnp.int32)
        buffer = fill_buffer(occupied, slot, slot < occupied.ends[-1])
        t, delta = (jnp.where(buffer.used, leaf[buffer.ray, buffer.source], 0) for leaf in (samples.t, samples.delta))
        first = jnp.cumsum(occupied.count, dtype=jnp.int32) - occupied.count  # of each ray among all occupied samples
        num_dropped = occupied.count - jnp.clip(max_samples - first, 0, occupied.count)
        placed = PlacedSamples(t, delta, buffer.ray, buffer.used, num_dropped)
        options = {"rule": samples.rule, "longest": samples.t.shape[-1], "median_depth": median_depth}
        sums, packed = _composite("render_packed", scene, rays, placed, **options)
    return _rendering(sums, num_dropped, rays.far, shape, background, packed)


def render_placed(
    scene: SceneFn,
    rays: Rays,
    placed: PlacedSamples,
    *,
    longest: int,
    background: Background | None = None,
    fixed_order: bool = False,
) -> Rendering:
    """Renders samples that are in a buffer already, such as those of `importance_samples`.

    Args:
        scene: see render_samples. It is evaluated at [1, K, 3] positions with as many directions.
        rays: Rays [B].
        placed: PlacedSamples [K] of these rays, of the rule "segments".
        longest: upper bound of the number of samples of a ray.
        background: see render_samples.
        fixed_order: whether the samples of a ray are summed in a fixed order, for accelerators, whose own sums over
            rays have none.

    Returns:
        Rendering [B] without weights; `samples` is PackedSamples [K], K being 0 if there are no rays.
    """
    check_shapes("render_placed", near=(rays.near, "B"), t=(placed.t, "K"), delta=(placed.delta, "K"))
    shape, scene = rays.near.shape, _without_gradient_if_empty(scene, rays)
    rays = _at_least_one(jax.tree.map(jnp.asarray, rays))
    options = {"rule": "segments", "longest": longest, "fixed_order": fixed_order}
    sums, packed = _composite("render_placed", scene, rays, placed, **options)
    num_dropped = _at_least_one(placed.num_dropped)
    return _rendering(sums, num_dropped, rays.far, shape, background, packed)


class _Sums(NamedTuple):
    """The sums over the samples of each ray.

    Attributes:
        transmittance: [B].
        opacity: [B] 1 - transmittance, without cancellation.
        rgb: [B, C] on black.
        depth: [B] sum of w t.
        disparity: [B] sum of w / t.
        median_depth: [B] in t, inf where the transmittance stays above one half; None unless it is wanted.
    """

    transmittance: Array
    opacity: Array
    rgb: Array
    depth: Array
    disparity: Array
    median_depth: Array | None = None


def _without_gradient_if_empty(scene, rays):
    """Returns the scene; without rays no position is safe to evaluate, so that its gradient may be NaN."""
    if math.prod(rays.near.shape):
        return scene

    @functools.wraps(scene)
    def constant(x, viewdirs, **inputs):
        return jax.lax.stop_gradient(scene(x, viewdirs, **inputs))

    return constant


def flattened(function: str, rays: Rays, samples: Samples, max_samples: int) -> tuple[Rays, Samples]:
    """Returns Rays [B] and Samples [B, S] of any leading axes; ValueError on what cannot be packed.

    If there are no rays, B is 1: a ray of length 0, which `_rendering` removes. If there are no samples, S is 1, too.
    """
    if samples.rule == "gauss":
        raise ValueError(
            f"{function}: rule is 'gauss', whose pairs of samples a cell's border may part; expected 'segments' or "
            "'points'"
        )
    check_shapes(function, near=(rays.near, "..."), t=(samples.t, "... S"), delta=(samples.delta, "... S"))
    if max_samples < 1:
        raise ValueError(f"{function}: max_samples is {max_samples}, expected at least 1")
    if not samples.t.shape[-1]:
        samples = jax.tree.map(lambda x: jnp.zeros((*x.shape[:-1], 1), x.dtype), samples)
    leading = rays.near.ndim
    flat = jax.tree.map(lambda x: jnp.asarray(x).reshape(rays.near.size, *x.shape[leading:]), (rays, samples))
    return _at_least_one(flat)


def _at_least_one(flat):
    """Returns a tree of arrays [B, ...]; if B is 0, with one row of zeros, so that indices have something to read."""
    return jax.tree.map(lambda x: x if len(x) else jnp.zeros((1, *x.shape[1:]), x.dtype), flat)


def _rendering(sums, num_dropped, far, shape, background, samples):
    """Returns the Rendering [*shape], with PackedSamples or None."""
    rgb = sums.rgb
    if background is not None:
        color = rgb[: math.prod(shape)].reshape(*shape, -1) if math.prod(shape) else jnp.zeros((*shape, rgb.shape[-1]))
        behind = volume_rendering.broadcast_background("render_packed", background, color).reshape(-1, rgb.shape[-1])
        rgb = rgb + sums.transmittance[:, None] * _at_least_one(behind)
    flat = Rendering(
        rgb=rgb,
        opacity=sums.opacity,
        depth=sums.depth + volume_rendering.multiply_or_zero(sums.transmittance, far),
        disparity=sums.disparity,
        weights=None,
        num_dropped=num_dropped,
        median_depth=None if sums.median_depth is None else jnp.minimum(sums.median_depth, far),
    )
    count = math.prod(shape)
    rendering = jax.tree.map(lambda leaf: leaf[:count].reshape(*shape, *leaf.shape[1:]), flat)
    # Without rays there is nothing that ray_index could refer to.
    return dataclasses.replace(rendering, samples=samples if count else jax.tree.map(lambda leaf: leaf[:0], samples))


# Which samples are occupied: one bit per sample, W words of 32 bits per ray. Packing is cheap because it searches
# words rather than samples.


class Occupied(NamedTuple):
    """The occupied samples of all rays, ray after ray.

    Attributes:
        words: [B W] uint32, a bit for each sample, the nearest lowest.
        ends: [B W] int32, the number of occupied samples up to the end of each word.
        count: [B] int32, the number of occupied samples of each ray.
    """

    words: Array
    ends: Array
    count: Array


def occupied_words(grid: OccupancyGrid | None, rays: Rays, samples: Samples) -> UInt32[Array, "B W"]:
    """Returns [B, W] uint32, a bit for each sample: whether it is occupied."""
    kept = ~(samples.delta <= 0)
    return _pack_bits(kept if grid is None else kept & is_occupied(grid, rays, samples.t))


def _pack_bits(flags):
    """Returns flags [B, S] as words [B, W] uint32, the first flag lowest."""
    flags = jnp.pad(flags, ((0, 0), (0, -flags.shape[-1] % 32))).reshape(flags.shape[0], -1, 32)
    return (flags * (jnp.uint32(1) << jnp.arange(32, dtype=jnp.uint32))[None, None]).sum(-1, dtype=jnp.uint32)


def _count_bits(words):
    """Returns the number of set bits of each word, int32."""
    return jax.lax.population_count(words).astype(jnp.int32)


def _nth_bit(words, n):
    """Returns the place in each word of its n-th set bit, the lowest being n = 0."""
    place = jnp.zeros_like(n)
    for half in (16, 8, 4, 2, 1):
        low = _count_bits((words >> place.astype(jnp.uint32)) & jnp.uint32(2**half - 1))
        above = n >= low
        n, place = n - jnp.where(above, low, 0), place + jnp.where(above, half, 0)
    return place


def count_occupied(words: UInt32[Array, "B W"]) -> Occupied:
    """Counts the occupied samples of words, see occupied_words."""
    sizes = _count_bits(words)
    ends = jnp.cumsum(sizes.reshape(-1), dtype=jnp.int32)
    return Occupied(words.reshape(-1), ends, sizes.sum(-1, dtype=jnp.int32))


class Buffer(NamedTuple):
    """Which sample each slot of the buffer holds.

    Attributes:
        source: [K] int32, index among the samples of the ray.
        ray: [K] int32, ascending.
        used: [K] bool, False for unused slots, which come last.
    """

    source: Array
    ray: Array
    used: Array


def fill_buffer(occupied: Occupied, place: Int[Array, " K"], used: Bool[Array, " K"]) -> Buffer:
    """Returns the Buffer of the occupied samples with the indices place [K], which are consecutive."""
    # The number of words that end before each index, by a cumulative sum instead of a search for each index.
    ended = jnp.zeros_like(place).at[jnp.maximum(occupied.ends - place[0], 0)].add(1, mode="drop")
    word = jnp.minimum(jnp.cumsum(ended, dtype=jnp.int32), occupied.words.size - 1)
    flags = occupied.words[word]
    before = occupied.ends[word] - _count_bits(flags)
    width = occupied.words.size // occupied.count.size
    return Buffer(word % width * 32 + _nth_bit(flags, place - before), word // width, used)


def evaluate_samples(
    function: str,
    scene: SceneFn,
    rays: Rays,
    t: Float[ArrayLike, " K"],
    ray_index: Int[ArrayLike, " K"],
    used: Bool[ArrayLike, " K"],
    delta: Callable[[], Array],
) -> tuple[Float[Array, " K"], Float[Array, "K C"]]:
    """Evaluates the scene at samples t [K] of rays; delta: a function that returns their lengths [K] in t.

    Unused slots evaluate the scene where the first slot does, so that they add no place at which it may be undefined,
    with a gradient that is NaN. If no slot is used, that place is the near end of a ray, as in render_samples.

    Returns:
        density [K] and rgb [K, C], both 0 in unused slots.
    """
    first = ray_index[0]
    t = jnp.where(used, t, jnp.where(used[0], t[0], rays.near[first]))
    index = jnp.where(used, ray_index, first)
    sample_rays = jax.tree.map(lambda leaf: leaf[index], rays)
    x = sample_rays.origins + t[:, None] * sample_rays.directions
    x = jnp.where(used[:, None], x, jax.lax.stop_gradient(x))[None]
    inputs = _packed_inputs(function, scene, sample_rays, t, used, delta) if needs_of(scene) else {}
    density, rgb = evaluate_scene(function, scene, x, sample_rays.viewdirs[None], inputs)
    return jnp.where(used, density[0], 0), jnp.where(used[:, None], rgb[0], 0)


def _packed_inputs(function, scene, sample_rays, t, used, delta: Callable[[], Array]):
    """Returns what the scene asks for at samples [K] of Rays [K], each value [1, K]; see evaluate_samples."""
    lengths = delta()
    lengths = jnp.where(used, lengths, jnp.where(used[0], lengths[0], 0))
    inputs = rendering.sample_inputs(function, scene, sample_rays, t[:, None], lengths[:, None])
    values = {name: value.reshape(1, -1) for name, value in inputs.items()}
    return {name: jnp.where(used[None], value, jax.lax.stop_gradient(value)) for name, value in values.items()}


def _composite(function, scene, rays, placed, *, rule, longest, median_depth=False, fixed_order=False):
    """Evaluates the scene at PlacedSamples and composites them: _Sums [B], PackedSamples [K]."""
    t, ray = placed.t, placed.ray_index
    density, rgb = evaluate_samples(function, scene, rays, t, ray, placed.used, lambda: placed.delta)
    speed, unknown = (of_ray[ray] for of_ray in rendering.speeds(rays))
    length = jnp.where(placed.used, rendering.lengths_at_speeds(placed.delta, speed, unknown), 0)
    starts = ray != jnp.roll(ray, 1).at[0].set(-1)
    weights, optical_depth = volume_rendering.packed_weights(density, length, starts, longest=longest)
    colors = [rgb[:, channel] * weights for channel in range(rgb.shape[1])]
    moments = volume_rendering.multiply_or_zero(weights, t), volume_rendering.divide_or_zero(weights, t)
    parts = [optical_depth, *colors, *moments]
    if fixed_order:
        sums = segment_sums(jnp.stack(parts, axis=-1), ray, starts, placed.used, rays.near.size, longest)
    else:
        sums = jax.ops.segment_sum(jnp.stack(parts, axis=-1), ray, rays.near.size, indices_are_sorted=True)
    packed = PackedSamples(weights=weights, t=t, delta=placed.delta, ray_index=ray, used=placed.used, rule=rule)
    median = None
    if median_depth:
        behind = volume_rendering.running_sum_since(starts, optical_depth, longest)
        places = volume_rendering.half_depths(optical_depth, behind, t, placed.delta, rule=rule)
        slot = jnp.where(jnp.isinf(places), places.size, jnp.arange(places.size))
        first = jax.ops.segment_min(slot, ray, rays.near.size, indices_are_sorted=True)
        median = places.at[first].get(mode="fill", fill_value=jnp.inf)
    return _Sums(
        transmittance=jnp.exp(-sums[:, 0]),
        opacity=volume_rendering.absorbed(sums[:, 0]),
        rgb=sums[:, 1:-2],
        depth=sums[:, -2],
        disparity=sums[:, -1],
        median_depth=median,
    ), packed


# Early termination: each slot marches one ray, and takes the next ray as soon as that one terminates.


class _Slots(NamedTuple):
    """The state of L slots.

    Attributes:
        ray: [L] int32; B: none.
        num_done: [L] int32, the number of the ray's samples that were evaluated.
        sums: [C + 4, L], the columns of _Sums; [C + 5, L] with the median depth, which is not a sum.
    """

    ray: Array
    num_done: Array
    sums: Array


def _march_until_terminated(function, scene, rays, samples, words, *, max_samples, early_stop_eps, median_depth=False):
    """Marches each ray until its transmittance is at most early_stop_eps, or to its end.

    The remaining light of a terminated ray is assumed to look like the rest of the ray, so such a ray is opaque. The
    scene is evaluated at [L, N, 3] positions with [L, 1, 3] directions, L N being at most max_samples.

    Returns:
        _Sums [B] of Rays [B] and Samples [B, S], whose `occupied_words` are [B, W].
    """
    ray_count = rays.near.size
    samples_per_slot = (
        2 if early_stop_eps >= _HIGH_EPS else 4
    )  # more would waste evaluations, fewer would need more rounds
    slot_count = max(min(max_samples // samples_per_slot, ray_count), 1)
    row = jnp.arange(max_samples // slot_count)[None]
    up_to = jnp.cumsum(_count_bits(words), axis=-1)
    count = up_to[:, -1]
    order = _longest_first(count, samples.t.shape[-1])
    waiting = (count > 0).sum()

    def evaluate(ray, num_done, transmittance):
        n = num_done[:, None] + row
        used = n < count.at[ray, None].get(mode="fill", fill_value=0)
        ray = jnp.minimum(ray, ray_count - 1)
        slot_rays, some = _nth_samples(rays, samples, words, up_to, ray, n, used)
        return _sum_run(function, scene, slot_rays, some, used, samples.rule, transmittance if median_depth else None)

    no_ray = jnp.full(slot_count, ray_count)
    none_done = jnp.zeros_like(no_ray)
    run = jax.eval_shape(evaluate, no_ray, none_done, jnp.ones(slot_count))
    rows = run.shape[0] - median_depth
    start = jnp.zeros((run.shape[0], 1), run.dtype).at[0].set(1).at[rows:].set(jnp.inf)

    def refill(slots, num_taken):
        """Gives the next rays to the slots without one; returns the _Slots and how many rays were taken."""
        free = slots.ray == ray_count
        place = num_taken + jnp.cumsum(free) - free
        following = jnp.where(place < waiting, order.at[place].get(mode="clip"), ray_count)
        ray, num_done = jnp.where(free, following, slots.ray), jnp.where(free, 0, slots.num_done)
        return _Slots(ray, num_done, jnp.where(free[None], start, slots.sums)), num_taken + free.sum()

    def step(state):
        slots, num_taken, finished = state
        slots, num_taken = refill(slots, num_taken)
        transmittance = slots.sums[:1]
        run = evaluate(slots.ray, slots.num_done, transmittance[0])
        sums = [transmittance * run[:1], slots.sums[1:rows] + transmittance * run[1:rows]]
        if median_depth:
            sums.append(jnp.where(jnp.isinf(slots.sums[rows:]), run[rows:], slots.sums[rows:]))
        sums = jnp.concatenate(sums)
        num_done = slots.num_done + row.size
        terminates = ~(sums[0] > early_stop_eps)  # NaN terminates, so that it is visible
        ends = terminates | (num_done >= count.at[slots.ray].get(mode="clip"))
        sums = jnp.where(terminates & (sums[1] > 0), _made_opaque(sums, rows), sums)
        finished = finished.at[:, jnp.where(ends, slots.ray, ray_count)].set(sums, mode="drop")
        return _Slots(jnp.where(ends, ray_count, slots.ray), num_done, sums), num_taken, finished

    def continues(state):
        slots, num_taken, _ = state
        return (num_taken < waiting) | (slots.ray < ray_count).any()

    slots = _Slots(no_ray, none_done, jnp.broadcast_to(start, (start.shape[0], slot_count)))
    finished = jnp.broadcast_to(start, (start.shape[0], ray_count))
    state = vary_like((slots, jnp.zeros_like(waiting), finished), run)
    finished = jax.lax.while_loop(continues, step, state)[2]
    transmittance, opacity, *rgb, depth, disparity = finished[:rows]
    median = finished[rows] if median_depth else None
    return _Sums(transmittance, opacity, jnp.stack(rgb, axis=-1), depth, disparity, median)


def _longest_first(count, most):
    """Returns the order [B] of rays by count [B], at most `most`, so that all slots finish at about the same time.

    The sorted numbers combine the count with the ray's index, as argsort takes several times as long on a CPU.
    """
    rays = count.size
    if rays * (most + 1) > 2**32:  # too large for such numbers
        return jnp.argsort(-count)
    numbers = jnp.uint32(rays) * (most - count).astype(jnp.uint32) + jnp.arange(rays, dtype=jnp.uint32)
    return (jnp.sort(numbers) % rays).astype(jnp.int32)


def _made_opaque(sums, rows):
    """Returns the sums [C + 4 or 5, L] of terminated rays, whose remaining light looks like the rest of the ray."""
    opacity = jnp.where(sums[1:2] > 0, sums[1:2], 1)
    return jnp.concatenate([jnp.zeros_like(sums[:1]), sums[1:rows] / opacity, sums[rows:]])


def _nth_samples(rays, samples, words, up_to, ray, n, used):
    """Returns the Rays [L] of the slots, and t and delta [L, N] of each one's n-th occupied samples.

    Unused samples are at the near end of the ray, as in render_samples.
    """
    word = jnp.minimum((up_to[ray, None] <= n[..., None]).sum(axis=-1), words.shape[-1] - 1)
    slot_rays = jax.tree.map(lambda leaf: leaf[ray], rays)
    ray = ray[:, None]
    flags, end = words[ray, word], up_to[ray, word]
    source = 32 * word + _nth_bit(flags, n - end + _count_bits(flags))
    t = jnp.where(used, samples.t[ray, source], slot_rays.near[:, None])
    return slot_rays, (t, jnp.where(used, samples.delta[ray, source], 0))


def _sum_run(function, scene, rays, samples, used, rule, transmittance):
    """Returns [C + 4, L], the columns of _Sums of consecutive samples, as if nothing lay in front of them.

    If the transmittance [L] in front of them is given, the result is [C + 5, L], with the median depth.
    """
    t, delta = samples
    x = rendering.points_on_rays(rays, t)
    inputs = rendering.sample_inputs(function, scene, rays, t, delta)
    density, rgb = evaluate_scene(function, scene, x, rays.viewdirs[:, None], inputs)
    density, rgb = jnp.where(used, density, 0), jnp.where(used[..., None], rgb, 0)
    length = rendering.segment_lengths(delta, rays)
    weights = volume_rendering.weights_from_density(density, length)
    sums = [
        volume_rendering.transmittance(density, length),
        volume_rendering.opacity(density, length),
        *volume_rendering.composite(weights, rgb).T,
        volume_rendering.multiply_or_zero(weights, t).sum(axis=-1),
        volume_rendering.expected_disparity(weights, t),
    ]
    if transmittance is not None:
        depth = volume_rendering.optical_depth(function, density, length)
        before = -jnp.log(transmittance)[:, None]
        behind = volume_rendering.running_sum(depth)
        places = volume_rendering.half_depths(depth, behind, t, delta, rule=rule, before=before)
        sums.append(volume_rendering.first_finite(places))
    return jnp.stack(sums)
