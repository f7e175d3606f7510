"""Evaluates scenes, and finds what they ask for beyond positions and directions by keyword-only parameters."""

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any

from jaxtyping import Array, ArrayLike, Float, Num

from jaxnerf.core.types import SceneFn

# Each is given per sample; [..., 1] stands for one value per ray.
#   radius        [..., S]       of the cone around the ray, at the sample, world units (arXiv:2103.13415)
#   length        [..., S]       of the ray's interval that the sample stands for, world units
#   time          [..., 1 or S]  of the image, as the dataset states it, in [0, 1]
#   image_index   [..., 1 or S]  int32, of the training image
#   progress      []             fraction of training that is done, in [0, 1]
NEEDS = ("radius", "length", "time", "image_index", "progress")

_REMEDIES = {
    "radius": "set Rays.radius, see cameras.pixel_radius (rays in NDC have none, as cones are no cones there)",
    "length": "samples have it",
    "time": "set Rays.time; a dataset states it in each frame",
    "image_index": "set Rays.image_index",
    "progress": "a trained run has it in its parameters",
}
_EXAMPLES = {"radius": "0.01", "length": "0.01", "time": "0.0", "image_index": "0", "progress": "1.0"}


def evaluate_scene(
    function: str,
    scene: SceneFn,
    x: Float[ArrayLike, "*batch samples 3"],
    viewdirs: Float[ArrayLike, "*#batch #samples 3"],
    inputs: Mapping[str, Num[ArrayLike, "..."]],
) -> tuple[Num[Array, "*batch samples"], Num[Array, "*batch samples channels"]]:
    """Evaluates a scene, and checks what it returns.

    Args:
        function: name of the calling function, for messages.
        scene: see render_samples.
        x: [..., S, 3] world units.
        viewdirs: [..., 1 or S, 3].
        inputs: what the scene asks for, see `sample_inputs`.

    Returns:
        density [..., S] and rgb [..., S, C].

    Raises:
        ValueError: if they have other shapes. An error of the scene itself gets a note with the shapes it was given.
    """
    try:
        found = scene(x, viewdirs, **inputs)
    except Exception as error:
        error.add_note(f"{function} called the scene with x {x.shape} and viewdirs {viewdirs.shape}, which broadcast")
        raise
    pair = isinstance(found, tuple | list) and len(found) == 2
    density, rgb = (getattr(each, "shape", type(each).__name__) for each in (found if pair else (found, found)))
    if not (pair and density == x.shape[:-1] == rgb[:-1] and rgb[-1:] > (0,)):
        returned = f"density {density} and rgb {rgb}" if pair else f"{density} in place of a pair"
        raise ValueError(
            f"{function}: the scene returned {returned} for positions {x.shape}, expected density {x.shape[:-1]} and "
            f"rgb {x.shape}, or another number of channels than 3"
        )
    return found


def needs_of(scene: Callable[..., Any]) -> tuple[str, ...]:
    """Returns the names, of NEEDS, that a scene or the `apply` of a field takes as keyword-only parameters.

    functools.partial, functools.wraps and JAX's transformations are followed. What functools.partial has bound by
    name is no longer asked for. A function without a signature asks for nothing. ValueError on another such parameter
    that has no default.
    """
    return tuple(_parameters(scene))


def inputs_of(function: str, scene: Callable[..., Any], **known: Callable[[], Array] | None) -> dict[str, Array]:
    """Computes the keyword arguments of a scene; what it does not ask for is not computed.

    Args:
        function: name of the calling function, for the message.
        scene: any.
        **known: by name of NEEDS, a function that computes the value; None, or absent, where there is none.

    Returns:
        The values by name. A parameter that has a default and no value is absent, so that it keeps its default.

    Raises:
        ValueError: if a parameter without a default has no value.
    """
    inputs = {}
    for name, has_default in _parameters(scene).items():
        compute = known.get(name)
        if compute is not None:
            inputs[name] = compute()
        elif not has_default:
            raise ValueError(
                f"{function}: the scene asks for {name}, and the rays have none; {_REMEDIES[name]}, or bind it with "
                f"functools.partial(scene, {name}={_EXAMPLES[name]})"
            )
    return inputs


def _parameters(scene):
    """Returns whether each name that a scene asks for has a default, in the order of NEEDS."""
    bound = set()
    while isinstance(scene, functools.partial) or _is_wrapper(scene):
        if isinstance(scene, functools.partial):
            bound |= scene.keywords.keys()
            scene = scene.func
        else:
            scene = scene.__wrapped__
    try:
        parameters = inspect.signature(scene).parameters
    except (TypeError, ValueError):  # of some builtins
        return {}
    free = {name: each for name, each in parameters.items() if each.kind is each.KEYWORD_ONLY and name not in bound}
    unknown = [name for name, each in free.items() if name not in NEEDS and each.default is each.empty]
    if unknown:
        raise ValueError(
            f"the scene asks for {unknown[0]} by a keyword-only parameter, expected one of {', '.join(NEEDS)}; bind it "
            f"with functools.partial(scene, {unknown[0]}=...), or give it a default"
        )
    return {name: free[name].default is not inspect.Parameter.empty for name in NEEDS if name in free}


def _is_wrapper(scene):
    """Returns whether the signature of a function is that of the one it wraps, unless it states its own."""
    return hasattr(scene, "__wrapped__") and "__signature__" not in getattr(scene, "__dict__", {})
