"""A restored run: the functions that read and render its checkpoints."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from jaxnerf.core.types import Rays, Rendering
from jaxnerf.models.base import Model
from jaxnerf.training import build


class TrainedRun(NamedTuple):
    """A run's experiment and the functions that read and render its checkpoints.

    Attributes:
        experiment: what its config describes for rendering, see `build.RenderParts`.
        steps: () -> the steps of the finished checkpoints, ascending.
        variables: step -> (params, grid) of that checkpoint; the grid is None where the model has none.
        render: (variables, Rays [...]) -> Rendering [...] without weights, jitted.
        identity: text that is equal for configs that render alike, see `config.identity`.
        render_image: (variables, Rays [...], chunk=None, median_depth=False) -> Rendering [...] as `render`, in
            chunks that fit into memory.
        variables_of: (`image_params`, grid) of a state of training -> (params, grid) as `variables` returns them.
        model_with: (settings of the section `eval`, by name; wrap=None) -> the Model that renders with these in place
            of the run's own, and whose field is wrapped as `build_model` does. It takes the same variables.
        settings: what the images of the same variables depend on: the options of the section `eval` that change them,
            by name, and what a tool has changed about the run.
    """

    experiment: build.RenderParts
    steps: Callable[[], list[int]]
    variables: Callable[[int], tuple]
    render: Callable[[tuple, Rays], Rendering]
    identity: str
    render_image: Callable[..., Rendering]
    variables_of: Callable[[Any, Any], tuple]
    model_with: Callable[..., Model]
    settings: Mapping[str, Any] = {}
