"""An example of a sampler with an occupancy grid: it takes equal steps, and evaluates those in occupied cells.

Train with it by

    jaxnerf-train --plugins=cell_sampler --config=embedded_small --config.field=hash_grid --config.sampler=cells \
        --workdir=runs/cells

where cell_sampler.py is in the current folder or on PYTHONPATH. It declares what the rest of the run asks a sampler:
that it skips empty cells, how many rays a step takes, and, by `Options.needs_box`, that the scene has a box.
"""

import dataclasses
import math

import jax

import jaxnerf
from jaxnerf.core.occupancy.grid import mask_scene
from jaxnerf.core.occupancy.importance import importance_samples
from jaxnerf.core.occupancy.packed import render_placed
from jaxnerf.core.occupancy.ray_marching import march_rays, num_steps
from jaxnerf.extend import (
    Model,
    Options,
    at_least,
    field_scene,
    infer,
    make_grid_schedule,
    needs_of_fields,
    option,
)


@dataclasses.dataclass(frozen=True)
class CellOptions(Options):
    """The options of the sampler: the config's section `cells`."""

    skips_empty_cells = True

    resolution: int = option("auto", "cells along the longest side of the scene's box", range=at_least(1), auto=True)
    samples_per_ray: int = option(16, "size of the sample buffer, divided by the number of rays", range=at_least(1))

    def resolve(self, facts, device):
        """Infers the cells from what the images resolve."""
        cells = min(facts.detail, 64)
        return infer(self, resolution=(cells, f"cells         {cells} along the longest side"))

    def rays_per_step(self, cpu_rays, device, *, large_field):
        """Returns half of the usual rays, as each has more samples."""
        return cpu_rays // 2, "half of train.cpu_batch_size"


def make_cell_model(context):
    """Makes the Model from a SamplerContext, which knows the scene's box."""
    field, options = context.make_field("fine"), context.options
    longest = max(high - low for low, high in zip(*context.box, strict=True))
    schedule = make_grid_schedule(
        *context.box,
        resolution=options.resolution,
        step_size=longest / (2 * options.resolution),
        field=field,
        threshold=0.01,
        update_every=16,
        contracted=context.contracted,
        min_views=int(context.contracted),
    )
    steps = {"step_size": schedule.step_size, "cell": schedule.cell}

    def scene(params, grid):
        return mask_scene(field_scene(field, params), grid)

    def render(keys, params, grid, rays, step):
        """Renders a training batch, with as many samples as the buffer holds."""
        candidates = march_rays(None, grid, jax.lax.stop_gradient(rays), **steps)
        buffer = math.ceil(options.samples_per_ray * rays.near.size)
        placed, _ = importance_samples(keys, grid, rays, candidates, max_samples=buffer, uniform_fraction=1.0)
        size = {"longest": num_steps(grid, **steps), "fixed_order": context.fixed_order}
        return {"fine": render_placed(scene(params, grid), rays, placed, background=context.background, **size)}

    def view(params, grid, rays, median_depth=False):
        """Renders images; with the median depth, from which exports are made."""
        samples = march_rays(None, grid, rays, **steps)
        limits = {"max_samples": context.view.max_samples, "early_stop_eps": context.view.early_stop_eps}
        look = {"background": context.background, "median_depth": median_depth}
        return jaxnerf.render_packed(field_scene(field, params), grid, rays, samples, **limits, **look)

    return Model(
        init=lambda key: {"fine": field.init(key)},
        render=render,
        view=view,
        scene=scene,
        samples_per_ray=options.samples_per_ray,
        fields={"fine": field},
        grid_schedule=schedule,
        needs=needs_of_fields(field),
    )


jaxnerf.register_sampler("cells", make_cell_model, options=CellOptions)
