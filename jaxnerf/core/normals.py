"""Normals of a scene's surfaces: the direction in which its density falls fastest."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from jaxnerf.core.rendering import points_on_rays, sample_inputs, segment_lengths
from jaxnerf.core.safe_math import normalize
from jaxnerf.core.types import PackedSamples, Rays, Rendering, SceneFn, check_shapes

# The corners of a tetrahedron at distance 1: four evaluations, where differences along the axes take six.
_CORNERS = tuple(tuple(sign / 3**0.5 for sign in signs) for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)))
_LARGEST_DEPTH = 1e30  # optical depth; more than that, infinity too, counts as this
_LEAST_DEPTH = 1e-3  # optical depth that counts as empty: the logarithm of less would be about noise


def density_normals(
    scene: SceneFn,
    x: Float[ArrayLike, "*batch samples 3"],
    viewdirs: Float[ArrayLike, "*batch #samples 3"],
    *,
    spacing: Float[ArrayLike, "..."] | None = None,
    **inputs: Num[ArrayLike, "..."],
) -> Float[Array, "*batch samples 3"]:
    """Computes the outward normals of a scene, n = -grad density / |grad density| (arXiv:2112.03907, Eq. 3).

    With a spacing the gradient is that of log(1 + 1000 density * spacing), which has the same direction and changes
    evenly where a density rises by orders of magnitude, by differences between the corners of a tetrahedron around x.
    They average over what is smaller than the spacing, such as the linear pieces between the vertices of a hash grid
    (arXiv:2306.03092), at the cost of four evaluations.

    Args:
        scene: see render_samples. Its colours are not computed where the call is jitted.
        x: [..., S, 3] world units.
        viewdirs: [..., 1 or S, 3], which density should not depend on.
        spacing: [...] or [..., S] world units, > 0: the distance of the corners from x. None: by automatic
            differentiation.
        **inputs: what else the scene asks for, by name, each [..., 1 or S], or a number.

    Returns:
        [..., S, 3] unit length, at least float32; 0, with gradient 0, where the density does not change. With a
        spacing, a density of far less than 0.001 / spacing counts as empty space, and an infinite one is finite.

    Raises:
        ValueError: on other shapes.
    """
    x = jnp.asarray(x)
    pattern = "... 1 3" if jnp.shape(viewdirs)[-2:-1] == (1,) else "... S 3"
    check_shapes("density_normals", x=(x, "... S 3"), viewdirs=(viewdirs, pattern))
    if spacing is None:
        return -normalize(jax.grad(lambda x: scene(x, viewdirs, **inputs)[0].sum())(x))
    length = jnp.broadcast_to(jnp.asarray(spacing, x.dtype), x.shape[:-1])
    around = jnp.stack([x + jnp.stack([length * each for each in corner], axis=-1) for corner in _CORNERS])

    def repeated(value):
        return value if jnp.ndim(value) == 0 else jnp.broadcast_to(value, (len(_CORNERS), *jnp.shape(value)))

    density = scene(around, repeated(viewdirs), **{name: repeated(value) for name, value in inputs.items()})[0]
    levels = jnp.log1p(jnp.minimum(density * repeated(length) / _LEAST_DEPTH, _LARGEST_DEPTH))
    change = levels - levels[:1]  # exactly 0 where all are equal
    return -normalize(jnp.einsum("c...,ca->...a", change, jnp.asarray(_CORNERS, change.dtype)))


class SurfaceSamples(NamedTuple):
    """One sample of each of N rays: that which contributes most to its colour, so that it is at a surface.

    Attributes:
        x: [N, 1, 3] world units.
        viewdirs: [N, 1, 3] unit length.
        weights: [N] compositing weight, 0 for a ray without samples.
        length: [N] world units, of the interval that the sample stands for.
        inputs: what the scene asks for there, each [N, 1], or a number.
    """

    x: Float[Array, "N 1 3"]
    viewdirs: Float[Array, "N 1 3"]
    weights: Float[Array, " N"]
    length: Float[Array, " N"]
    inputs: dict[str, Num[Array, "..."]]


def surface_samples(scene: SceneFn, rays: Rays, rendering: Rendering, *, every: int = 1) -> SurfaceSamples:
    """Finds the heaviest sample of rays, from a rendering of them that carries its samples.

    Args:
        scene: that the samples are for.
        rays: Rays [B].
        rendering: Rendering [B] with samples.
        every: only each ray of this number, the first one included.

    Returns:
        SurfaceSamples of N = ceil(B / every) rays, without gradient. A ray without samples has its near end.

    Raises:
        ValueError: if the rendering carries no samples.
    """
    if rendering.samples is None:
        raise ValueError("surface_samples: the rendering has no samples, expected those of a training step")
    rays, rendering = jax.lax.stop_gradient((rays, rendering))
    find = _heaviest_of_packed if isinstance(rendering.samples, PackedSamples) else _heaviest
    t, delta, weights = (each[::every] for each in find(rendering, rays))
    rays = jax.tree.map(lambda leaf: leaf[::every], rays)
    t = jnp.where(weights > 0, t, rays.near)[:, None]
    delta = delta[:, None]
    inputs = sample_inputs("surface_samples", scene, rays, t, delta)
    length = segment_lengths(delta, rays)[:, 0]
    return SurfaceSamples(points_on_rays(rays, t), rays.viewdirs[:, None], weights, length, inputs)


def _heaviest(rendering, rays):
    """Returns t, delta and the weight [B] of the heaviest of the samples [B, S]."""
    samples, weights = rendering.samples, rendering.weights
    at = weights.argmax(axis=-1, keepdims=True)
    return [jnp.take_along_axis(each, at, axis=-1)[..., 0] for each in (samples.t, samples.delta, weights)]


def _heaviest_of_packed(rendering, rays):
    """As _heaviest, of PackedSamples."""
    samples, (count,) = rendering.samples, rays.near.shape
    options = {"num_segments": count, "indices_are_sorted": True}
    weights = jnp.where(samples.used, samples.weights, 0)
    largest = jax.ops.segment_max(weights, samples.ray_index, **options)
    slots = jnp.where(weights == largest[samples.ray_index], jnp.arange(weights.size), weights.size)
    first = jax.ops.segment_min(slots, samples.ray_index, **options)
    chosen = (jnp.asarray(each) for each in (samples.t, samples.delta, weights))
    return [each.at[first].get(mode="fill", fill_value=0) for each in chosen]


def normal_loss(scene: SceneFn, normals: Callable[..., Array] | None, samples: SurfaceSamples) -> Float[Array, " N"]:
    """Computes how far predicted normals are from those of the density (after arXiv:2112.03907, Eq. 10).

        w |n - n'|^2

    n is that of `density_normals`, with the length of the sample's interval as spacing, n' the predicted one and w the
    weight of the heaviest sample of a ray, where Ref-NeRF sums over all samples. No gradient flows into the density:
    it would make the surfaces follow normals that are still wrong.

    Args:
        scene: of the network that predicts the normals.
        normals: (x, viewdirs, **inputs) -> [..., S, 3] unit length, see `Field.normals`.
        samples: SurfaceSamples of N rays.

    Returns:
        [N] in [0, 4].

    Raises:
        ValueError: if normals is None.
    """
    if normals is None:
        raise ValueError(
            "normal_loss: normals is None, expected those that the field predicts; turn on its option reflections, or "
            "set losses.normals to 0"
        )
    x, viewdirs, weights, length, inputs = samples
    truth = density_normals(scene, x, viewdirs, spacing=jnp.maximum(length, 1e-6)[:, None], **inputs)
    error = normals(x, viewdirs, **inputs) - jax.lax.stop_gradient(truth)
    return weights * (error**2).sum(axis=-1)[:, 0]
