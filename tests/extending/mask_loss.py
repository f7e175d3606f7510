"""An example of losses: one that compares opacity with alpha, and a regularizer of the parameters.

Train with --plugins=mask_loss --config.losses.mask=0.1, or give them weights in a config file:

    config.losses.mask = 0.1
    config.losses.weight_decay = ((0, 1e-4), (1000, 0.0))  # linear between steps 0 and 1000

Neither needs a change of the training step. A loss whose weight is the number 0 adds no operation to it.
"""

import jax
import jax.numpy as jnp

import jaxnerf


def mask_loss(outputs, batch):
    """Computes the squared difference between each ray's opacity and its pixel's alpha [B].

    Args:
        outputs: the step's Renderings [B], with weights and samples; the one that images show is the last, and
            outputs["name"] is that of any network.
        batch: Batch [B]. `alpha` is None unless `needs` names it below.
    """
    return (outputs[-1].opacity - batch.alpha) ** 2


def weight_decay(params):
    """Computes the sum of squares of all parameters: a scalar."""
    return sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(params))


jaxnerf.register_loss("mask", mask_loss, needs=("alpha",), help="squared difference of opacity and alpha")
jaxnerf.register_loss("weight_decay", weight_decay, on="params", help="sum of squares of all parameters")
