"""What a model is: how a run's fields are sampled along rays and rendered."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax

from jaxnerf.fields.base import Field
from jaxnerf.registry import SAMPLERS


class Model(NamedTuple):
    """Pure functions of parameters, an occupancy grid and rays; the grid is None where a model has none.

    Attributes:
        init: key -> params, a dict with an entry for each network. The one that counts is "fine".
        render: (keys [B], params, grid, Rays [B], step) -> Renderings [B] for training, the one that counts
            last. They carry weights and samples, for losses.
        view: (params, grid, Rays [...]) -> Rendering [...] without weights and samples, for images.
        scene: (params, grid) -> the scene that counts.
        samples_per_ray: evaluations of the largest network for a ray in training, about.
        grid_schedule: how the occupancy grid is made and updated; None without one.
        input_layers: network name -> see `Field`.
        cull: (grid, Rays [...]) -> bool [...], which rays may hit an occupied cell, and the Rendering [...]
            of those that cannot; None where all may.
    """

    init: Callable[[jax.Array], Any]
    render: Callable[..., tuple]
    view: Callable[..., Any]
    scene: Callable[..., Callable]
    samples_per_ray: float
    grid_schedule: Any = None
    input_layers: Mapping[str, tuple[str, ...]] = {}
    cull: Callable[..., tuple] | None = None


class SamplerContext(NamedTuple):
    """What a sampler makes a model from.

    Attributes:
        make_field: name of a network ("fine", "coarse") -> its Field.
        sections: the resolved config's sections as plain dicts, by name.
        background: [3] behind the scene, or None for black.
    """

    make_field: Callable[[str], Field]
    sections: Mapping[str, Mapping[str, Any]]
    background: tuple[float, float, float] | None


def make_model(sampler: str, context: SamplerContext) -> Model:
    """Makes a model by the registered name of its sampler.

    Raises:
        ValueError: if there is no sampler of that name, or a section holds what it cannot do.
    """
    return SAMPLERS.get(sampler)(context)
