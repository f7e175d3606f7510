"""Normals of a scene's surfaces: the direction in which its density falls fastest."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from jaxnerf.core.safe_math import normalize
from jaxnerf.core.scene import evaluate_scene
from jaxnerf.core.types import SceneFn, check_shapes

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
    """
    x = jnp.asarray(x)
    pattern = "... 1 3" if jnp.shape(viewdirs)[-2:-1] == (1,) else "... S 3"
    check_shapes("density_normals", x=(x, "... S 3"), viewdirs=(viewdirs, pattern))

    def density_at(x, viewdirs, inputs):
        return evaluate_scene("density_normals", scene, x, viewdirs, inputs)[0]

    if spacing is None:
        return -normalize(jax.grad(lambda x: density_at(x, viewdirs, inputs).sum())(x))
    length = jnp.broadcast_to(jnp.asarray(spacing, x.dtype), x.shape[:-1])
    around = jnp.stack([x + jnp.stack([length * each for each in corner], axis=-1) for corner in _CORNERS])

    def repeated(value):
        return value if jnp.ndim(value) == 0 else jnp.broadcast_to(value, (len(_CORNERS), *jnp.shape(value)))

    density = density_at(around, repeated(viewdirs), {name: repeated(value) for name, value in inputs.items()})
    levels = jnp.log1p(jnp.minimum(density * repeated(length) / _LEAST_DEPTH, _LARGEST_DEPTH))
    change = levels - levels[:1]  # exactly 0 where all are equal
    return -normalize(jnp.einsum("c...,ca->...a", change, jnp.asarray(_CORNERS, change.dtype)))
