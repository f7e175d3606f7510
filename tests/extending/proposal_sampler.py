"""An example of a sampler with two networks and a loss of its own: a proposal network says where to evaluate the field.

The proposal network has a density and no colour. The samples of the run's field are drawn where it has weight, and it
is trained to bound the field's weights from above (arXiv:2111.12077, Section 3). Train with it by

    jaxnerf-train --plugins=proposal_sampler --config=embedded_small --config.sampler=proposal \
        --config.losses.proposal=1 --workdir=runs/proposal

where proposal_sampler.py is in the current folder or on PYTHONPATH.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp

import jaxnerf
from jaxnerf.extend import (
    Model,
    Options,
    at_least,
    between,
    field_scene,
    needs_of_fields,
    option,
    split_key,
    without_samples,
)

_EPS = 1e-7  # added to weights in a denominator, as in the paper's code


@dataclasses.dataclass(frozen=True)
class ProposalOptions(Options):
    """The options of the sampler: the config's section `proposal`."""

    num_proposals: int = option(32, "samples per ray of the proposal network", range=at_least(2))
    num_samples: int = option(24, "samples per ray of the field", range=at_least(2))
    width: int = option(32, "outputs of a layer of the proposal network", range=at_least(1))
    num_freqs: int = option(5, "octaves of its encoding", range=between(0, 16))


def make_proposal_model(context):
    """Makes the Model of the networks "proposal" and "fine"."""
    options, fine = context.options, context.make_field("fine")
    sizes = {"depth": 2, "skip_layer": 1, "use_viewdirs": False, "density_activation": "softplus"}
    proposal = jaxnerf.mlp_field(width=options.width, num_freqs=options.num_freqs, **sizes)
    fields = {"proposal": proposal, "fine": fine}

    def init(key):
        return {name: field.init(jax.random.fold_in(key, index)) for index, (name, field) in enumerate(fields.items())}

    def scene(params, grid):
        return field_scene(fine, params)

    def render(keys, params, grid, rays, step):
        """Renders both networks; segments have their samples in the middle, so that the loss finds their ends."""
        keys, _ = split_key(keys, 2)
        edges = jaxnerf.uniform_edges(rays.near, rays.far, num_segments=options.num_proposals)
        proposed = functools.partial(proposal.apply, params["proposal"])
        first = jaxnerf.render_samples(proposed, rays, jaxnerf.samples_from_edges(None, edges))
        weights = jax.lax.stop_gradient(first.weights)
        edges = jaxnerf.importance_points(keys, edges, weights, num_points=options.num_samples + 1, padding=0.01)
        samples = jaxnerf.samples_from_edges(None, edges)
        final = jaxnerf.render_samples(scene(params, grid), rays, samples, background=context.background)
        return {"proposal": first, "fine": final}

    return Model(
        init=init,
        render=render,
        view=lambda params, grid, rays: without_samples(render(None, params, grid, rays, None)["fine"]),
        scene=scene,
        samples_per_ray=options.num_samples,
        fields=fields,
        needs=needs_of_fields(fine),
        image_networks=("fine",),  # the proposal network has no colour that could be compared with images
    )


def proposal_loss(outputs, batch):
    """Computes how far the field's weights exceed the bound that the proposal network gives [B] (Eq. 13).

    The bound of a segment is the sum of the weights of all segments of the proposal network that overlap it. The field
    gets no gradient: the proposal network follows it.
    """
    proposal, final = outputs["proposal"], outputs["fine"]
    lower, upper = ends(final.samples)
    start, end = ends(proposal.samples)
    before = jnp.cumsum(proposal.weights, axis=-1) - proposal.weights
    totals = jnp.concatenate([before, before[..., -1:] + proposal.weights[..., -1:]], axis=-1)
    first = (end[:, None] <= lower[..., None]).sum(axis=-1)  # segments that end before
    last = (start[:, None] < upper[..., None]).sum(axis=-1)  # segments that start before the end
    bound = jnp.take_along_axis(totals, last, axis=-1) - jnp.take_along_axis(totals, first, axis=-1)
    weights = jax.lax.stop_gradient(final.weights)
    return (jnp.maximum(weights - bound, 0) ** 2 / (weights + _EPS)).sum(axis=-1)


def ends(samples):
    """Returns where the segments of samples in their middles begin and end, in t."""
    t, delta = jax.lax.stop_gradient((samples.t, samples.delta))
    return t - delta / 2, t + delta / 2


jaxnerf.register_sampler("proposal", make_proposal_model, options=ProposalOptions)
jaxnerf.register_loss("proposal", proposal_loss, help="excess of the field's weights over the proposal network's bound")
