"""Curricula of a field: detail from coarse to fine, and view dependence late, as functions of the training's progress.

With few views a field can explain each image by details of its own. Without fine detail, and without colours that
depend on the direction, it has to find a shape that all images share first.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.options import BELOW_ONE, Options, between, option

_RAMP = 0.1  # of training, in which view dependence is switched on; at once, the loss would jump


@dataclasses.dataclass(frozen=True)
class CurriculumOptions(Options):
    """The options of the curricula, which a field's own options inherit."""

    coarse_to_fine: float = option(
        0.0,
        "fraction of training after which all levels of a hash grid, or octaves of a positional encoding, are on; "
        "until then they are switched on one after the other, coarse ones first (arXiv:2303.07418); 0: all always are",
        range=between(0, 1),
    )
    viewdirs_from: float = option(
        0.0,
        f"fraction of training from which, over {_RAMP:g} of it, colour begins to depend on the direction; 0: it does "
        "from the start",
        range=BELOW_ONE,
    )


def band_weights(progress: Float[ArrayLike, ""], count: int, until: float) -> Float[Array, " count"]:
    """Computes the weights of the levels or octaves of an encoding (after arXiv:2303.07418, Eq. 5).

        w_k = clip(1 + (count - 1) progress / until - k, 0, 1)

    Args:
        progress: fraction of training that is done.
        count: of the levels or octaves, coarse ones first.
        until: progress from which all weights are 1; more than 0.

    Returns:
        [count] in [0, 1], not increasing. The first is always 1.
    """
    return jnp.clip(1 + (count - 1) * progress / until - jnp.arange(count), 0, 1)


def view_weight(progress: Float[ArrayLike, ""], start: float) -> Float[Array, ""]:
    """Computes the weight in [0, 1] of the encoded direction: 0 until `start`, and 1 a tenth of training later.

    The weight is 1 at the end of training, whatever the start.
    """
    return jnp.clip((progress - start) / min(_RAMP, 1 - start), 0, 1)
