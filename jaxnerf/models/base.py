"""The interface of models: a sampler places samples along rays and renders a run's fields there."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax

from jaxnerf.core.types import Background, Rendering, SceneFn
from jaxnerf.fields.base import Field
from jaxnerf.models.grid_schedule import GridSchedule
from jaxnerf.options import BELOW_ONE, Box, Changes, Device, Facts, Options, Range, between, infer, option

FINAL_NETWORK = "fine"  # the network of the final rendering, whose field the config names
_SAMPLE_MULTIPLIER = 1.5  # samples of images over those of training: no jitter averages over a step in rendering


@dataclasses.dataclass(frozen=True)
class ViewOptions(Options):
    """The options of images: how a trained model renders them."""

    chunk: int = option("auto", "rays per rendered chunk", range=between(1, 2**24), auto=True, changes=Changes.SPEED)
    sample_multiplier: float = option(
        1.0,
        "samples per ray of images, divided by those of training; auto: 1.5",
        range=Range("more than 0 and at most 64", lambda value: 0 < value <= 64),
        auto=True,
        changes=Changes.IMAGES,
    )
    bake_occupancy: bool = option(
        False,
        "whether a model that was trained without an occupancy grid renders with one, of its visible density",
        changes=Changes.IMAGES,
    )
    early_stop_eps: float = option(
        1e-3, "with a grid: the transmittance below which a ray is terminated", range=BELOW_ONE, changes=Changes.IMAGES
    )
    max_samples: int = option(
        "auto", "with a grid: size of the sample buffer", range=between(1, 2**28), auto=True, changes=Changes.SPEED
    )

    def resolve(self, facts: Facts, device: Device) -> tuple["ViewOptions", list[str]]:
        """Infers the number of samples."""
        line = f"images        {_SAMPLE_MULTIPLIER:g} times the samples of training"
        return infer(self, sample_multiplier=(_SAMPLE_MULTIPLIER, line))

    def resolve_for_device(self, device: Device) -> tuple["ViewOptions", list[str]]:
        """Infers sizes that keep the device busy, and activations in the cache of a CPU."""
        samples = 2**10 if device.is_cpu else 2**17
        return infer(
            self,
            max_samples=(samples, f"images        {samples} samples per batch, for this device"),
            chunk=(device.chunk, f"images        {device.chunk} rays per chunk, for this device"),
        )


class Model(NamedTuple):
    """Pure functions of parameters, an occupancy grid (None if the model has none) and rays.

    Attributes:
        init: key -> params, a dict with an entry for each network. All other functions find the progress of training
            in an entry "progress", too, where `needs` names it.
        render: (keys [B], params, grid, Rays [B], step) -> for training, a dict with the Rendering [B] of each
            network. They carry weights and samples, for losses.
        view: (params, grid, Rays [...]) -> Rendering [...] without weights and samples, for images. With
            median_depth=True it has a median depth; a sampler whose images need none may lack that argument.
        scene: (params, grid) -> the scene of the final rendering.
        samples_per_ray: approximate number of evaluations of the largest network per ray in training.
        fields: by network, the Field that has its parameters.
        image_networks: the networks whose renderings are compared with the colours of the batch, that of the final
            rendering last. Others, which may only propose samples, need a loss of their own.
        grid_schedule: how the occupancy grid is created and updated; None without one.
        cull: (grid, Rays [...], median_depth=False) -> bool [...], which rays may hit an occupied cell, and the
            Rendering [...] of those that cannot; None where all may.
        needs: what the fields ask for, see `core.scene.NEEDS`: the optional fields of Rays that are filled.
    """

    init: Callable[[jax.Array], Any]
    render: Callable[..., dict[str, Rendering]]
    view: Callable[..., Rendering]
    scene: Callable[..., SceneFn]
    samples_per_ray: float
    fields: Mapping[str, Field] = {}
    image_networks: tuple[str, ...] = (FINAL_NETWORK,)
    grid_schedule: GridSchedule | None = None
    cull: Callable[..., tuple] | None = None
    needs: tuple[str, ...] = ()


class SamplerContext(NamedTuple):
    """What a sampler makes a model from.

    Attributes:
        options: of the sampler: an instance of its registered class, or the section of its name as a dict.
        make_field: name of a network -> its Field, as the config describes it: "fine" is that of the final rendering,
            "coarse" an MLP with the options of the section `coarse`.
        view: the options of images.
        background: [3] colour behind the scene; None: black.
        box: lower and upper corner of the scene, world units; None where the config has none yet.
        contracted: whether the box holds all of space.
        fixed_order: whether the sums of training must have a fixed order on an accelerator, see `render_placed`; those
            of the fields then have it.
    """

    options: Any
    make_field: Callable[[str], Field]
    view: ViewOptions
    background: Background | None
    box: Box | None
    contracted: bool = False
    fixed_order: bool = False
