"""The paper's sampler: a coarse network guides the samples of a fine one (Section 5.2 of arXiv:2003.08934)."""

import dataclasses
import inspect
from collections.abc import Mapping

import jax

from jaxnerf.core.rendering import render_hierarchical, render_rays
from jaxnerf.core.sampling import split_key
from jaxnerf.core.types import Background, without_samples
from jaxnerf.fields.base import Field, field_scene, needs_of_fields
from jaxnerf.fields.mlp import FIELD as MLP
from jaxnerf.models.base import Model, SamplerContext
from jaxnerf.options import Ablation, Options, at_least, between, option
from jaxnerf.registry import Part

_MAX_SAMPLES = 16_384  # per ray
_SAMPLES_PART = Ablation(  # `gauss` takes pairs
    "samples a ray", less=lambda n, *_: n // 4 * 2 if n >= 4 else None, more=lambda n, *_: 2 * n if n else None
)


@dataclasses.dataclass(frozen=True)
class HierarchicalOptions(Options):
    """The options of the sampler "hierarchical"."""

    needs_box = False

    num_coarse: int = option(
        64,
        "samples per ray for the coarse network",
        range=between(1, _MAX_SAMPLES),
        ablations=(
            _SAMPLES_PART,
            Ablation("coarse network", lambda n, options, _: n + options.num_fine if options.num_fine else None),
        ),
    )
    num_fine: int = option(
        128,
        "additional samples per ray for the fine network; 0: no coarse network",
        range=between(0, _MAX_SAMPLES),
        ablations=(_SAMPLES_PART, Ablation("coarse network", without=0)),
    )
    rule: str = option(
        "segments",
        "quadrature: `gauss` takes pairs and has fourth order, `points` is the paper's",
        choices=("segments", "gauss", "points"),
    )
    in_disparity: bool = option(False, "whether coarse samples have equal steps of 1 / t")
    stratified: bool = option(True, "whether training draws its samples at random; images have fixed positions")
    importance_padding: float = option(0.0, "added to the coarse weights before importance sampling", range=at_least(0))
    density_noise: float = option(
        0.0, "standard deviation of the noise on the density in training", unit="1 / world unit", range=at_least(0)
    )

    def check_unused(self, sampler: str) -> None:
        for name, value, other in (("density_noise", self.density_noise, 0.0), ("stratified", self.stratified, True)):
            if value != other:
                raise ValueError(
                    f"{name} is {value}, which the sampler {sampler!r} does not read; set it to {other}, or use the "
                    "sampler 'hierarchical'"
                )


def from_context(context: SamplerContext) -> Model:
    """Makes the model that the options describe; with `num_fine` 0 it has one network, "fine"."""
    names = ("coarse", "fine") if context.options.num_fine else ("fine",)
    fields = {name: context.make_field(name) for name in names}
    return hierarchical_model(
        fields, context.options, background=context.background, sample_multiplier=context.view.sample_multiplier
    )


SAMPLER = Part(from_context, HierarchicalOptions, section="sampling", networks={"coarse": MLP})


def hierarchical_model(
    fields: Mapping[str, Field],
    sampling: HierarchicalOptions,
    *,
    background: Background | None,
    sample_multiplier: float = 1.0,
) -> Model:
    """Makes the paper's model from the fields "coarse" and "fine", or from "fine" alone where num_fine is 0.

    Args:
        fields: Field by name.
        sampling: see also `render_hierarchical`.
        background: see `render_hierarchical`.
        sample_multiplier: samples per ray of images over those of training.

    Raises:
        ValueError: if density_noise is set and a field takes no noise.
    """
    options = {"rule": sampling.rule, "in_disparity": sampling.in_disparity, "background": background}
    for name, field in fields.items():
        parameters = inspect.signature(field.apply).parameters.values()
        takes_noise = any(each.name == "density_noise" or each.kind is each.VAR_KEYWORD for each in parameters)
        if sampling.density_noise and not takes_noise:
            raise ValueError(
                f"sampling.density_noise is {sampling.density_noise}, and the {name} field takes no noise; set it to 0"
            )

    def init(key):
        keys = jax.random.split(key, len(fields))
        return {name: field.init(key) for (name, field), key in zip(fields.items(), keys, strict=True)}

    def render(keys, params, grid, rays, step, multiplier=1.0, median_depth=False):
        del grid, step
        noise = sampling.density_noise if keys is not None else 0.0
        keys, *noise_keys = split_key(keys, 1 + len(fields)) if noise else (keys, *[None] * len(fields))
        scenes = [
            field_scene(field, params, name, **({"key": noise_key, "density_noise": noise} if noise else {}))
            for (name, field), noise_key in zip(fields.items(), noise_keys, strict=True)
        ]
        keys = keys if sampling.stratified else None
        first, more = (
            max(2, 2 * round(number * multiplier / 2)) if multiplier != 1 else number
            for number in (sampling.num_coarse, sampling.num_fine)
        )
        if len(scenes) == 1:
            return {"fine": render_rays(keys, *scenes, rays, num_samples=first, median_depth=median_depth, **options)}
        counts = {"num_coarse": first, "num_fine": more, "importance_padding": sampling.importance_padding}
        renderings = render_hierarchical(keys, *scenes, rays, median_depth=median_depth, **counts, **options)
        return dict(zip(fields, renderings, strict=True))

    def view(params, grid, rays, median_depth=False):
        return without_samples(render(None, params, grid, rays, None, sample_multiplier, median_depth)["fine"])

    def scene(params, grid):
        del grid
        return field_scene(fields["fine"], params)

    return Model(
        init=init,
        render=render,
        view=view,
        scene=scene,
        samples_per_ray=sampling.num_coarse + sampling.num_fine,
        fields=fields,
        image_networks=tuple(fields),
        needs=needs_of_fields(*fields.values()),
    )
