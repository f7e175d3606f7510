"""The interface of models: a sampler places samples along rays and renders a run's fields there."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax

from jaxnerf.core.types import Rendering, SceneFn
from jaxnerf.fields.base import Field
from jaxnerf.models.grid_schedule import GridSchedule
from jaxnerf.registry import SAMPLERS


class Model(NamedTuple):
    """Pure functions of parameters, an occupancy grid (None if the model has none) and rays.

    Attributes:
        init: key -> params, a dict with an entry for each network. "fine" is the network of the final rendering.
            All other functions find the progress of training in an entry "progress" as well, where `needs` names it.
        render: (keys [B], params, grid, Rays [B], step) -> Renderings [B] for training, that of "fine" last.
            They carry weights and samples, for losses.
        view: (params, grid, Rays [...]) -> Rendering [...] without weights and samples, for images. With
            median_depth=True it has a median depth; a sampler whose images need none may lack that argument.
        scene: (params, grid) -> the scene of the final rendering.
        samples_per_ray: approximate number of evaluations of the largest network per ray in training.
        grid_schedule: how the occupancy grid is created and updated; None without one.
        input_layers, color_layers: by network, see `Field`.
        cull: (grid, Rays [...], median_depth=False) -> bool [...], which rays may hit an occupied cell, and the
            Rendering [...] of those that cannot; None where all may.
        needs: what the fields ask for, see `core.scene.NEEDS`: the optional fields of Rays that are filled.
    """

    init: Callable[[jax.Array], Any]
    render: Callable[..., tuple[Rendering, ...]]
    view: Callable[..., Rendering]
    scene: Callable[..., SceneFn]
    samples_per_ray: float
    grid_schedule: GridSchedule | None = None
    input_layers: Mapping[str, tuple[str, ...]] = {}
    cull: Callable[..., tuple] | None = None
    color_layers: Mapping[str, tuple[str, ...]] = {}
    needs: tuple[str, ...] = ()


class SamplerContext(NamedTuple):
    """The parts of a resolved config from which a sampler makes a model.

    Attributes:
        make_field: name of a network ("fine" or "coarse") -> its Field.
        sections: the config's sections as plain dicts, by name.
        background: [3] colour behind the scene; None: black.
    """

    make_field: Callable[[str], Field]
    sections: Mapping[str, Mapping[str, Any]]
    background: tuple[float, float, float] | None


def make_model(sampler: str, context: SamplerContext) -> Model:
    """Makes a model by the registered name of its sampler.

    Raises:
        ValueError: if there is no sampler of that name, or it cannot do what a section asks for.
    """
    return SAMPLERS.get(sampler)(context)
