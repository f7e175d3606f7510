"""The volume renderer, for any scene: a function (x, viewdirs) -> (density, rgb)."""

import functools
import math
from collections.abc import Callable, Iterable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Num

from jaxnerf.core import sampling, volume_rendering
from jaxnerf.core.safe_math import norm
from jaxnerf.core.scene import evaluate_scene, inputs_of
from jaxnerf.core.types import Background, Keys, Rays, Rendering, Samples, SceneFn, check_shapes, without_samples


def points_on_rays(rays: Rays, t: Num[ArrayLike, "*batch samples"]) -> Float[Array, "*batch samples 3"]:
    """Computes the points x(t) = o + t d on rays [...] for t [..., S], in world units; ValueError on other shapes."""
    check_shapes("points_on_rays", origins=(rays.origins, "... 3"), t=(t, "... S"))
    return rays.origins[..., None, :] + t[..., None] * rays.directions[..., None, :]


def render_samples(
    scene: SceneFn,
    rays: Rays,
    samples: Samples,
    *,
    background: Background | None = None,
    median_depth: bool = False,
) -> Rendering:
    """Renders rays through a scene that is evaluated at the given samples (Eq. 3).

    Args:
        scene: (x [..., S, 3], viewdirs [..., 1, 3]) -> (density [..., S], rgb [..., S, 3]). The directions broadcast to
            the samples. In place of three colours it may return any number of channels, such as features. What else it
            needs, it asks for by keyword-only parameters: radius, length, time or image_index, see core.scene.NEEDS.
        rays: Rays [...].
        samples: Samples [..., S]. Where delta is 0, the scene is evaluated at the near end of the ray, and
            the result, even NaN, affects neither value nor gradient.
        background: the colour behind the scene, [3] or [..., 3], with as many channels as the scene; None for black.
        median_depth: whether the Rendering has a median depth; see volume_rendering.median_depth.

    Returns:
        Rendering [...]. An empty ray has the background's colour, depth far and disparity 0.

    Raises:
        ValueError: if an argument or the scene's result has another shape, or the rays lack what the scene asks for.
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
    kept = ~(samples.delta <= 0)  # NaN is kept, so that it is visible
    t = jnp.where(kept, samples.t, jnp.broadcast_to(jnp.asarray(rays.near)[..., None], samples.t.shape))
    x = points_on_rays(rays, t)
    x = jnp.where(kept[..., None], x, jax.lax.stop_gradient(x))  # a NaN gradient must not reach the rays
    inputs = sample_inputs("render_samples", scene, rays, t, samples.delta)
    per_sample = {name: value for name, value in inputs.items() if value.shape == kept.shape}
    inputs |= {name: jnp.where(kept, value, jax.lax.stop_gradient(value)) for name, value in per_sample.items()}
    density, rgb = evaluate_scene("render_samples", scene, x, rays.viewdirs[..., None, :], inputs)
    density = jnp.where(kept, density, 0)
    channels = range(rgb.shape[-1])
    rgb = jnp.stack([jnp.where(kept, rgb[..., i], 0) for i in channels], axis=-1)  # one by one, as in composite
    length = segment_lengths(samples.delta, rays)
    dtype = jnp.result_type(length.dtype, density.dtype, rgb.dtype)
    density, rgb = (
        density.astype(dtype),
        rgb.astype(dtype),
    )  # before the sums: in bfloat16 each would round its gradient
    weights = volume_rendering.weights_from_density(density, length, rule=samples.rule)
    transmittance = volume_rendering.transmittance(density, length)
    median = None
    if median_depth:
        options = {"far": rays.far, "rule": samples.rule}
        median = volume_rendering.median_depth(density, length, t, jnp.where(kept, samples.delta, 0), **options)
    return Rendering(
        rgb=volume_rendering.composite(weights, rgb, background=background, transmittance=transmittance),
        opacity=volume_rendering.opacity(density, length),
        depth=volume_rendering.expected_depth(weights, t, transmittance, far=rays.far),
        disparity=volume_rendering.expected_disparity(weights, t),
        weights=weights,
        num_dropped=jnp.zeros(t.shape[:-1], jnp.int32),
        samples=Samples(t=t, delta=jnp.where(kept, samples.delta, 0), rule=samples.rule),
        median_depth=median,
    )


def render_rays(
    key: Keys | None,
    scene: SceneFn,
    rays: Rays,
    *,
    num_samples: int,
    rule: str = "segments",
    in_disparity: bool = False,
    background: Background | None = None,
    render: Callable[..., Rendering] = render_samples,
    median_depth: bool = False,
) -> Rendering:
    """Renders rays with evenly spaced samples between near and far.

    Args:
        key: None for fixed samples; one key, or one key per ray [...], for stratified samples (Eq. 2).
        scene: see render_samples.
        rays: Rays [...].
        num_samples: S, samples per ray; even for "gauss".
        rule: "segments"; "gauss", of fourth order, see samples_from_edges; or "points" for the quadrature of the
            released codes.
        in_disparity: whether the samples are evenly spaced in 1 / t (requires near > 0).
        background: see render_samples.
        render: render_samples, or a function with the same arguments and result.
        median_depth: see render_samples.

    Returns:
        Rendering [...].

    Raises:
        ValueError: on an unknown rule or an odd number for "gauss", and as uniform_edges and render_samples.
    """
    samples, _ = _evenly_spaced(key, rays, "num_samples", num_samples, rule, in_disparity)
    extras = {"median_depth": True} if median_depth else {}
    return render(scene, rays, samples, background=background, **extras)


def render_hierarchical(
    key: Keys | None,
    coarse: SceneFn,
    fine: SceneFn,
    rays: Rays,
    *,
    num_coarse: int,
    num_fine: int,
    rule: str = "segments",
    in_disparity: bool = False,
    importance_padding: float = 0.0,
    background: Background | None = None,
    median_depth: bool = False,
) -> tuple[Rendering, Rendering]:
    """Renders a coarse scene, and a fine scene at samples where the coarse one has weight (Section 5.2).

    Args:
        key: None for fixed samples, one key, or one key per ray [...].
        coarse: scene, see render_samples.
        fine: scene; it may be the same.
        rays: Rays [...].
        num_coarse: samples of the coarse scene.
        num_fine: importance points. The fine scene is evaluated at num_coarse + num_fine samples.
        rule: "segments": the points split the coarse segments, with one sample per piece. "gauss":
            half as many points split them, with two samples per piece; both numbers must be even.
            "points": the paper's sorted union of both sets of points, with a last delta of 1e10.
        in_disparity: whether the coarse samples are evenly spaced in 1 / t.
        importance_padding: padding of importance_points; the released codes use 1e-5.
        background: see render_samples.
        median_depth: whether the fine Rendering has a median depth.

    Returns:
        (Rendering, Rendering): coarse and fine. No gradient flows from the fine one to the coarse scene.
    """
    coarse_key, point_key, fine_key = sampling.split_key(key, 3)
    samples, edges = _evenly_spaced(coarse_key, rays, "num_coarse", num_coarse, rule, in_disparity)
    first = render_samples(coarse, rays, samples, background=background)
    if rule == "points":
        # The released codes draw between the midpoints of the coarse points, from the inner weights.
        edges, inner = sampling.midpoints(samples.t), first.weights[..., 1:-1]
        points = sampling.importance_points(point_key, edges, inner, num_points=num_fine, padding=importance_padding)
        samples = sampling.samples_from_points(sampling.merge_edges(samples.t, points))
    else:
        num_points = _num_segments("num_fine", num_fine, rule)
        count = edges.shape[-1] - 1
        weights = first.weights.reshape(*edges.shape[:-1], count, num_coarse // count).sum(axis=-1)
        points = sampling.importance_points(
            point_key, edges, weights, num_points=num_points, padding=importance_padding
        )
        samples = sampling.samples_from_edges(fine_key, sampling.merge_edges(edges, points), rule=rule)
    return first, render_samples(fine, rays, samples, background=background, median_depth=median_depth)


def render_image(
    render: Callable[[Rays], Rendering], rays: Rays, *, chunk: int, map: Callable[..., Iterable] = map
) -> Rendering:
    """Renders a whole image in chunks of equal size, so that `render` is compiled once.

    Args:
        render: Rays [chunk] -> Rendering [chunk], jitted. Pass the parameters as arguments and bind
            them with functools.partial, so that new parameters need no compilation.
        rays: Rays [H, W], or any other leading axes.
        chunk: rays per call. The last chunk is padded with copies of the last ray.
        map: (function, chunks) -> results in order, as `map` or `ThreadPoolExecutor.map`: on a CPU with several cores
            chunks that several threads start are rendered at once.

    Returns:
        Rendering [H, W] without weights and samples.

    Raises:
        ValueError: if chunk < 1 or there are no rays.
    """
    shape, count = rays.near.shape, rays.near.size
    if chunk < 1 or count < 1:
        raise ValueError(f"render_image: chunk is {chunk} and there are {count} rays, expected at least 1 of each")

    def render_from(start):
        part = render(_take_chunk(rays, start, chunk=chunk))
        if not isinstance(part, Rendering):
            raise ValueError(f"render_image: render returned {type(part).__name__}, expected a Rendering of its rays")
        return without_samples(part)

    return _join_chunks(list(map(render_from, range(0, count, chunk))), shape=shape)


# Both are jitted: run op by op, they would take longer than rendering a small image.
@functools.partial(jax.jit, static_argnames="chunk")
def _take_chunk(rays, start, *, chunk):
    """Returns Rays [chunk]: rays [...] from start on, padded with copies of the last."""
    axes, index = rays.near.ndim, jnp.minimum(start + jnp.arange(chunk), rays.near.size - 1)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[axes:])[index], rays)


@functools.partial(jax.jit, static_argnames="shape")
def _join_chunks(parts, *, shape):
    """Joins Renderings [chunk] to one of this shape and removes the padding of the last."""
    count = math.prod(shape)
    whole = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:count], *parts)
    return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), whole)


def sample_inputs(
    function: str,
    scene: SceneFn,
    rays: Rays,
    t: Num[ArrayLike, "*batch samples"],
    delta: Num[ArrayLike, "*batch samples"],
) -> dict[str, Num[Array, "..."]]:
    """Computes what a scene asks for at samples of rays, the keyword arguments of its evaluation there.

    Args:
        function: name of the calling function, for messages.
        scene: see render_samples.
        rays: Rays [...].
        t: [..., S] in t.
        delta: [..., S] length in t; a negative one counts as 0.

    Returns:
        By name of core.scene.NEEDS: radius and length [..., S], time and image_index [..., 1]. Empty for a scene that
        asks for nothing.

    Raises:
        ValueError: if the rays lack what it asks for, or have it in another shape than near.
    """

    def of_rays(name):
        value = getattr(rays, name)
        if value is None:
            return None

        def compute():
            check_shapes(function, near=(rays.near, "..."), **{name: (value, "...")})
            return jnp.asarray(value)[..., None]

        return compute

    at_one = of_rays("radius")
    return inputs_of(
        function,
        scene,
        radius=at_one and (lambda: at_one() * t),
        length=lambda: segment_lengths(jnp.maximum(delta, 0), rays),
        time=of_rays("time"),
        image_index=of_rays("image_index"),
    )


def segment_lengths(delta: Num[ArrayLike, "*batch samples"], rays: Rays) -> Float[Array, "*batch samples"]:
    """Converts delta from t to world units, delta * |d|; an infinite delta gets no derivative, as 0 * inf is NaN.

    Where the origin is NaN the length is NaN, too, so that the ray is visible whatever a scene returns for NaN.
    """
    return lengths_at_speeds(delta, *(of_ray[..., None] for of_ray in speeds(rays)))


def speeds(rays: Rays) -> tuple[Float[Array, "*batch"], Bool[Array, "*batch"]]:
    """Returns the world units per t of rays [...], and whether their origins are NaN, for lengths_at_speeds."""
    return norm(rays.directions), jnp.isnan(rays.origins).any(axis=-1)


def lengths_at_speeds(
    delta: Num[ArrayLike, "*batch"], speed: Num[ArrayLike, "*#batch"], unknown: Bool[ArrayLike, "*#batch"]
) -> Float[Array, "*batch"]:
    """Returns segment_lengths [...] of samples, given what `speeds` returns for the ray of each."""
    infinite = jnp.isinf(delta)
    length = jnp.where(infinite & (speed > 0), jnp.inf, jnp.where(infinite, 0, delta) * speed)
    return jnp.where(unknown & (delta > 0), jnp.nan, length)


def _evenly_spaced(key, rays, name, num_samples, rule, in_disparity):
    """Returns evenly spaced samples, and the edges of their segments; of the rule "points" the points."""
    options = {"in_disparity": in_disparity}
    if rule == "points":
        points = sampling.stratified_points(key, rays.near, rays.far, num_points=num_samples, **options)
        return sampling.samples_from_points(points), points
    number = _num_segments(name, num_samples, rule)
    edges = sampling.uniform_edges(rays.near, rays.far, num_segments=number, **options)
    return sampling.samples_from_edges(key, edges, rule=rule), edges


def _num_segments(name, num_samples, rule):
    """Returns the number of segments for a number of samples."""
    if num_samples < 1:
        raise ValueError(f"{name} is {num_samples}, expected at least 1")
    if rule not in ("segments", "gauss"):
        raise ValueError(f"rule is {rule!r}, expected 'segments', 'gauss' or 'points'")
    if rule == "gauss" and num_samples % 2:
        raise ValueError(f"{name} is {num_samples}, expected an even number for rule 'gauss', which places pairs")
    return num_samples // 2 if rule == "gauss" else num_samples
