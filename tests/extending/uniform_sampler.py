"""An example of a sampler: one network, evaluated at evenly spread samples between near and far.

Train with it by

    jaxnerf-train --plugins=uniform_sampler --config=embedded_small --config.sampler=uniform --workdir=runs/uniform

where uniform_sampler.py is in the current folder or on PYTHONPATH. `--config.uniform.num_samples=256` sets the number
of samples.
"""

import dataclasses
import functools

import jaxnerf
from jaxnerf.extend import Model, Options, at_least, field_scene, needs_of_fields, option, without_samples


@dataclasses.dataclass(frozen=True)
class UniformOptions(Options):
    """The options of the sampler: the config's section `uniform`."""

    num_samples: int = option(128, "samples per ray", range=at_least(1))


def make_uniform_model(context):
    """Makes the Model from a SamplerContext, which makes fields and holds the sampler's options."""
    field = context.make_field("fine")  # the field that the config names
    num_samples = context.options.num_samples
    render_rays = functools.partial(jaxnerf.render_rays, num_samples=num_samples, background=context.background)

    def init(key):
        return {"fine": field.init(key)}

    def scene(params, grid):
        return field_scene(field, params)

    def render(keys, params, grid, rays, step):
        """Renders a training batch: a dict with the Rendering of each network."""
        return {"fine": render_rays(keys, scene(params, grid), rays)}

    def view(params, grid, rays):
        """Renders images: without a key the samples are at fixed places."""
        return without_samples(render_rays(None, scene(params, grid), rays))

    return Model(
        init=init,
        render=render,
        view=view,
        scene=scene,
        samples_per_ray=num_samples,
        fields={"fine": field},
        needs=needs_of_fields(field),  # rays then have what the field asks for, such as the time
    )


jaxnerf.register_sampler("uniform", make_uniform_model, options=UniformOptions)
