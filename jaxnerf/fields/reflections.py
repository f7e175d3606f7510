"""What a field's colour reads of reflections: the direction reflected about normals that the field predicts.

A highlight is a simple function of the reflected direction, wherever it is on a curved surface, and one that moves
from point to point of the view direction (Ref-NeRF, arXiv:2112.03907). The network of the density has NUM_OUTPUTS
outputs more: the normal, tied to the gradient of the density by the loss `normals`, and the roughness.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.core.reflections import encode_rows
from jaxnerf.core.safe_math import normalize

NUM_OUTPUTS = 4
DEGREES = (1, 2, 4)  # of the harmonics; Ref-NeRF has degree 8, too, which its scenes with mirrors need
_ROUGHNESS_BIAS = -1.0  # as in Ref-NeRF, so that training begins with a roughness of 0.3

HELP = (
    "Whether colour depends on the direction that is reflected about normals, which the network predicts "
    "(arXiv:2112.03907): for shiny surfaces. The loss `normals` trains them."
)


def reflection_features(
    outputs: Float[ArrayLike, "outputs N"], viewdirs: Float[ArrayLike, "*batch #samples 3"], shape: tuple[int, ...]
) -> tuple[Float[Array, "features N"], Float[Array, "*batch samples 3"]]:
    """Computes the inputs of a colour network: encoded reflected directions, and the cosines of view and normal.

    Args:
        outputs: [4, N] of the density network: the normal of any length but 0, and the roughness before its softplus.
        viewdirs: [..., 1 or S, 3] unit length.
        shape: (..., S), of N samples.

    Returns:
        [F, N]; and the normals [..., S, 3] of unit length, 0 where the outputs are.
    """
    normals = normalize(jnp.moveaxis(outputs[:3].reshape(3, *shape), 0, -1))
    roughness = jax.nn.softplus(outputs[3] + _ROUGHNESS_BIAS)
    view = [jnp.broadcast_to(viewdirs[..., axis], shape).reshape(-1) for axis in range(3)]
    normal = [normals[..., axis].reshape(-1) for axis in range(3)]
    cosine = -sum(a * b for a, b in zip(view, normal, strict=True))
    reflected = [a + 2 * cosine * b for a, b in zip(view, normal, strict=True)]
    return jnp.stack([*encode_rows(reflected, roughness, degrees=DEGREES), cosine]), normals
