"""The volume renderer, for any scene that is a function (x, viewdirs) -> (density, rgb)."""

import functools
import math

import jax
import jax.numpy as jnp

from jaxnerf.core import sampling, volume_rendering
from jaxnerf.core.safe_math import norm
from jaxnerf.core.types import Rendering, Samples, check_shapes, without_samples


def points_on_rays(rays, t):
    """Returns the points x(t) = o + t d on rays [...], for t [..., S]: [..., S, 3] in world units."""
    check_shapes("points_on_rays", origins=(rays.origins, "... 3"), t=(t, "... S"))
    return rays.origins[..., None, :] + t[..., None] * rays.directions[..., None, :]


def render_samples(scene, rays, samples, *, background=None):
    """Returns what rays see of a scene that is asked at the given samples (Eq. 3).

    Args:
        scene: (x [..., S, 3], viewdirs [..., 1, 3]) -> (density [..., S], rgb [..., S, 3]).
        rays: Rays [...].
        samples: Samples [..., S]. Where delta is 0 the scene is asked at the ray's near end, and
            whatever it answers, NaN too, reaches neither value nor gradient.
        background: None (black), [3], or [..., 3]: the colour of what passes through.

    Returns:
        Rendering [...]. An empty ray has the background's colour, depth far and disparity 0.

    Raises:
        ValueError: if the scene's answer, or an argument, has another shape.
    """
    check_shapes(
        "render_samples",
        origins=(rays.origins, "... 3"),
        directions=(rays.directions, "... 3"),
        near=(rays.near, "..."),
        far=(rays.far, "..."),
        t=(samples.t, "... S"),
        delta=(samples.delta, "... S"),
    )
    kept = ~(samples.delta <= 0)  # NaN is kept, and shows
    t = jnp.where(kept, samples.t, jnp.broadcast_to(rays.near[..., None], samples.t.shape))
    x = points_on_rays(rays, t)
    x = jnp.where(kept[..., None], x, jax.lax.stop_gradient(x))  # nor may a slope of NaN come back
    density, rgb = scene(x, rays.viewdirs[..., None, :])
    check_scene_output("render_samples", density, rgb, x)
    density = jnp.where(kept, density, 0)
    rgb = jnp.stack([jnp.where(kept, rgb[..., i], 0) for i in range(3)], axis=-1)  # as composite sums them
    length = segment_lengths(samples.delta, rays.directions)
    dtype = jnp.result_type(length.dtype, density.dtype, rgb.dtype)
    density, rgb = density.astype(dtype), rgb.astype(dtype)  # once, or each sum rounds its slopes to bfloat16
    weights = volume_rendering.weights_from_density(density, length, rule=samples.rule)
    passing = volume_rendering.transmittance(density, length)
    return Rendering(
        rgb=volume_rendering.composite(weights, rgb, background=background, transmittance=passing),
        opacity=volume_rendering.opacity(density, length),
        depth=volume_rendering.expected_depth(weights, t, passing, far=rays.far),
        disparity=volume_rendering.expected_disparity(weights, t),
        weights=weights,
        num_dropped=jnp.zeros(t.shape[:-1], jnp.int32),
        samples=Samples(t=t, delta=jnp.where(kept, samples.delta, 0), rule=samples.rule),
    )


def render_rays(
    key,
    scene,
    rays,
    *,
    num_samples,
    rule="segments",
    in_disparity=False,
    background=None,
    render=render_samples,
):
    """Returns what rays see of a scene asked at evenly spread samples between near and far.

    Args:
        key: None for fixed samples, one key, or one key a ray [...], for stratified ones (Eq. 2).
        scene: see render_samples.
        rays: Rays [...].
        num_samples: S, how often the scene is asked; even for "gauss".
        rule: "segments"; "gauss", of fourth order, see samples_from_edges; or "points" for the released
            codes' quadrature.
        in_disparity: equal steps in 1 / t (wants near > 0).
        background: see render_samples.
        render: render_samples, or a function of the same meaning.

    Returns:
        Rendering [...].

    Raises:
        ValueError: on an unknown rule or an odd number for "gauss", and as uniform_edges and render_samples.
    """
    if rule == "points":
        samples = _even_points(key, rays, num_samples, in_disparity)
    else:
        edges = _even_edges("num_samples", rays, num_samples, rule, in_disparity)
        samples = sampling.samples_from_edges(key, edges, rule=rule)
    return render(scene, rays, samples, background=background)


def render_hierarchical(
    key,
    coarse,
    fine,
    rays,
    *,
    num_coarse,
    num_fine,
    rule="segments",
    in_disparity=False,
    importance_padding=0.0,
    background=None,
):
    """Returns what rays see of two scenes, the second asked where the first has weight (Section 5.2).

    Args:
        key: None for fixed samples, one key, or one key a ray [...].
        coarse, fine: scenes, see render_samples. They may be the same.
        rays: Rays [...].
        num_coarse: samples of the coarse scene.
        num_fine: importance points. The fine scene is asked at num_coarse + num_fine samples.
        rule: "segments": the points cut the coarse segments, and each piece is asked once. "gauss":
            half as many points do, and each piece is asked twice; both numbers must be even.
            "points": the paper's sorted union of both sets of points, with a last delta of 1e10.
        in_disparity: equal coarse steps in 1 / t.
        importance_floor: see importance_points; the released codes have 1e-5.
        background: see render_samples.

    Returns:
        (Rendering, Rendering): coarse and fine. No gradient flows from the fine one to the coarse scene.

    Raises:
        ValueError: as render_rays.
    """
    coarse_key, point_key, fine_key = sampling.split_key(key, 3)
    if rule == "points":
        samples = _even_points(coarse_key, rays, num_coarse, in_disparity)
    else:
        edges = _even_edges("num_coarse", rays, num_coarse, rule, in_disparity)
        samples = sampling.samples_from_edges(coarse_key, edges, rule=rule)
    first = render_samples(coarse, rays, samples, background=background)
    if rule == "points":
        # The released codes draw between the middles of the coarse points, from the inner weights.
        middles, inner = sampling.midpoints(samples.t), first.weights[..., 1:-1]
        points = sampling.importance_points(point_key, middles, inner, num_points=num_fine, padding=importance_padding)
        samples = sampling.samples_from_points(sampling.merge_edges(samples.t, points))
    else:
        cells = _cells("num_fine", num_fine, rule)
        weights = first.weights.reshape(*edges.shape[:-1], edges.shape[-1] - 1, -1).sum(axis=-1)
        points = sampling.importance_points(point_key, edges, weights, num_points=cells, padding=importance_padding)
        samples = sampling.samples_from_edges(fine_key, sampling.merge_edges(edges, points), rule=rule)
    return first, render_samples(fine, rays, samples, background=background)


def render_image(render, rays, *, chunk):
    """Returns a whole image, rendered in chunks of one compiled shape.

    Args:
        render: Rays [chunk] -> Rendering [chunk], jitted. Parameters are best its arguments, bound
            with functools.partial: a new checkpoint then compiles nothing.
        rays: Rays [H, W], or any other leading axes.
        chunk: rays at once. The last chunk is filled up with copies of the last ray.

    Returns:
        Rendering [H, W] without weights.

    Raises:
        ValueError: if chunk < 1 or there are no rays.
    """
    shape, count = rays.near.shape, rays.near.size
    if chunk < 1 or count < 1:
        raise ValueError(f"render_image: chunk {chunk} and {count} rays, wanted at least 1 of each")
    parts = []
    for start in range(0, count, chunk):
        part = render(_chunk_of(rays, start, chunk=chunk))
        parts.append(without_samples(part))
    return _joined(parts, shape=shape)


# Both jitted: op by op they would take longer than a small picture's rays.
@functools.partial(jax.jit, static_argnames="chunk")
def _chunk_of(rays, start, *, chunk):
    """Returns Rays [chunk], those of rays [...] from start on, or copies of the last."""
    axes, index = rays.near.ndim, jnp.minimum(start + jnp.arange(chunk), rays.near.size - 1)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[axes:])[index], rays)


@functools.partial(jax.jit, static_argnames="shape")
def _joined(parts, *, shape):
    """Returns the Rendering [...] of this shape from Renderings [chunk], of whose last some are too many."""
    count = math.prod(shape)
    whole = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:count], *parts)
    return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), whole)


def check_scene_output(function, density, rgb, x):
    """Raises a ValueError unless a scene's answer has the shapes that positions x [..., 3] want."""
    if density.shape != x.shape[:-1] or rgb.shape != x.shape:
        raise ValueError(
            f"{function}: the scene returned density {density.shape} and rgb {rgb.shape} for positions "
            f"{x.shape}, wanted {x.shape[:-1]} and {x.shape}"
        )


def segment_lengths(delta, directions):
    """Returns delta in world units; kept apart from an endless one, whose derivative would be 0 times inf."""
    size = norm(directions)[..., None]
    endless = jnp.isinf(delta)
    return jnp.where(endless & (size > 0), jnp.inf, jnp.where(endless, 0, delta) * size)


def _even_points(key, rays, num_samples, in_disparity):
    t = sampling.stratified_points(key, rays.near, rays.far, num_points=num_samples, in_disparity=in_disparity)
    return sampling.samples_from_points(t)


def _even_edges(name, rays, num_samples, rule, in_disparity):
    cells = _cells(name, num_samples, rule)
    return sampling.uniform_edges(rays.near, rays.far, num_segments=cells, in_disparity=in_disparity)


def _cells(name, num_samples, rule):
    """Returns how many segments a rule divides so many samples between."""
    if rule not in ("segments", "gauss"):
        raise ValueError(f"rule is {rule!r}, wanted 'segments', 'gauss' or 'points'")
    if rule == "gauss" and num_samples % 2:
        raise ValueError(f"{name} is {num_samples}, wanted an even number for rule 'gauss', which asks in pairs")
    return num_samples // 2 if rule == "gauss" else num_samples
