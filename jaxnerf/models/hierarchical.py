"""The paper's sampler: a coarse network guides the samples of a fine one (Section 5.2 of arXiv:2003.08934)."""

import inspect
from collections.abc import Mapping

import jax

from jaxnerf.core.rendering import render_hierarchical, render_rays
from jaxnerf.core.sampling import split_key
from jaxnerf.core.types import Background, without_samples
from jaxnerf.fields.base import Field, field_scene, needs_of_fields
from jaxnerf.models.base import Model, SamplerContext


def from_context(context: SamplerContext) -> Model:
    """Makes the model that the section `sampling` describes; with `num_fine` 0 it has one network, "fine"."""
    sampling = dict(context.sections["sampling"])
    if sampling["rule"] not in ("segments", "gauss", "points"):
        raise ValueError(f"sampling.rule is {sampling['rule']!r}, expected 'segments', 'gauss' or 'points'")
    names = ("coarse", "fine") if sampling["num_fine"] else ("fine",)
    return hierarchical_model(
        {name: context.make_field(name) for name in names},
        background=context.background,
        sample_multiplier=context.sections["eval"]["sample_multiplier"],
        **sampling,
    )


def hierarchical_model(
    fields: Mapping[str, Field],
    *,
    num_coarse: int,
    num_fine: int,
    rule: str,
    in_disparity: bool,
    importance_padding: float,
    density_noise: float,
    background: Background | None,
    stratified: bool = True,
    sample_multiplier: float = 1.0,
) -> Model:
    """Makes the paper's model from the fields "coarse" and "fine", or from "fine" alone where num_fine is 0.

    Args:
        fields: Field by name.
        density_noise: 1 / world unit, standard deviation of the noise on the density in training.
        stratified: whether training draws its samples at random; otherwise they have fixed positions, as in
            images.
        sample_multiplier: samples per ray of images over those of training.
        num_coarse, num_fine, rule, in_disparity, importance_padding, background: see `render_hierarchical`.

    Raises:
        ValueError: if density_noise is set and a field takes no noise.
    """
    options = {"rule": rule, "in_disparity": in_disparity, "background": background}
    for name, field in fields.items():
        parameters = inspect.signature(field.apply).parameters
        takes_noise = "density_noise" in parameters or any(
            parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()
        )
        if density_noise and not takes_noise:
            raise ValueError(
                f"sampling.density_noise is {density_noise}, and the {name} field takes no noise; set it to 0"
            )

    def init(key):
        keys = jax.random.split(key, len(fields))
        return {name: field.init(key) for (name, field), key in zip(fields.items(), keys, strict=True)}

    def render(keys, params, grid, rays, step, multiplier=1.0, median_depth=False):
        del grid, step
        noise = density_noise if keys is not None else 0.0
        keys, *noise_keys = split_key(keys, 1 + len(fields)) if noise else (keys, *[None] * len(fields))
        scenes = [
            field_scene(field, params, name, **({"key": noise_key, "density_noise": noise} if noise else {}))
            for (name, field), noise_key in zip(fields.items(), noise_keys, strict=True)
        ]
        keys = keys if stratified else None
        first, more = (
            max(2, 2 * round(number * multiplier / 2)) if multiplier != 1 else number
            for number in (num_coarse, num_fine)
        )
        if len(scenes) == 1:
            return (render_rays(keys, *scenes, rays, num_samples=first, median_depth=median_depth, **options),)
        counts = {"num_coarse": first, "num_fine": more, "importance_padding": importance_padding}
        return render_hierarchical(keys, *scenes, rays, median_depth=median_depth, **counts, **options)

    def view(params, grid, rays, median_depth=False):
        return without_samples(render(None, params, grid, rays, None, sample_multiplier, median_depth)[-1])

    def scene(params, grid):
        del grid
        return field_scene(fields["fine"], params)

    return Model(
        init=init,
        render=render,
        view=view,
        scene=scene,
        samples_per_ray=num_coarse + num_fine,
        input_layers={name: field.input_layers for name, field in fields.items()},
        color_layers={name: field.color_layers for name, field in fields.items()},
        needs=needs_of_fields(*fields.values()),
    )
