"""The occupancy sampler: one field, evaluated only in the occupied cells of a grid (after arXiv:2201.05989)."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxnerf.core.occupancy.from_scene import crop_grid, num_visibility_rays, visible_grid
from jaxnerf.core.occupancy.grid import OccupancyGrid, mask_scene
from jaxnerf.core.occupancy.importance import importance_samples
from jaxnerf.core.occupancy.packed import render_packed, render_placed
from jaxnerf.core.occupancy.ray_culling import rays_may_hit, render_background
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.core.types import Background, Rays, Rendering, SceneFn
from jaxnerf.fields.base import Field, field_scene, needs_of_fields
from jaxnerf.models.base import Model, SamplerContext
from jaxnerf.models.grid_schedule import GridSchedule, make_grid_schedule

_SMALLEST_EPS = 1e-30  # replaces an early_stop_eps of 0: below this transmittance no light is left


def from_context(context: SamplerContext) -> Model:
    """Makes the model that the section `occupancy` describes."""
    section, sampling = context.sections["occupancy"], context.sections["sampling"]
    if sampling["density_noise"]:
        raise ValueError(
            f"sampling.density_noise is {sampling['density_noise']} and the sampler 'occupancy', which adds no "
            "noise; set it to 0, or use the sampler 'hierarchical'"
        )
    if not sampling["stratified"]:
        raise ValueError(
            "sampling.stratified is False and the sampler 'occupancy', which draws its samples; set it to True, "
            "or use the sampler 'hierarchical'"
        )
    field = context.make_field("fine")
    return occupancy_model(
        field,
        schedule_from_section(section, field),
        pool_samples_per_ray=section["pool_samples_per_ray"],
        uniform_fraction=section.get("uniform_fraction", 1.0),
        max_optical_depth=section["max_optical_depth"],
        occlusion_start_step=section["occlusion_start_step"],
        **view_options(context),
    )


def schedule_from_section(section: Mapping[str, Any], field: Field | None) -> GridSchedule:
    """Makes the GridSchedule that a resolved section `occupancy` describes; field: None without updates."""
    names = ("resolution", "step_size", "threshold", "update_every", "cells_per_update", "contracted", "update_chunk")
    options = {name: section[name] for name in names if name in section}  # configs of older versions lack some
    return make_grid_schedule(section["lower"], section["upper"], field=field, **options)


def view_options(context: SamplerContext) -> dict[str, Any]:
    """Returns the options of occupancy_model that concern images."""
    names = ("early_stop_eps", "sample_multiplier", "max_samples")
    section = context.sections["eval"]
    return {name: section[name] for name in names} | {"background": context.background}


def occupancy_model(
    field: Field,
    schedule: GridSchedule,
    *,
    pool_samples_per_ray: float,
    uniform_fraction: float,
    max_optical_depth: float,
    occlusion_start_step: int,
    early_stop_eps: float,
    sample_multiplier: float,
    max_samples: int,
    background: Background | None,
) -> Model:
    """Makes the model of one field that is evaluated only in the occupied cells of its grid.

    Args:
        field: any Field.
        schedule: of the occupancy grid.
        pool_samples_per_ray: size of training's sample buffer over the number of rays. If the samples of all rays do
            not fit, the rays with most samples get fewer, see `importance_samples`.
        uniform_fraction: of training, see `importance_samples`.
        max_optical_depth: training skips samples behind this optical depth, as estimated by the grid;
            0: no limit.
        occlusion_start_step: the training step from which max_optical_depth applies.
        early_stop_eps: of images: transmittance below which a ray ends.
        sample_multiplier: samples of images over those of training.
        max_samples: of images: samples evaluated at once.
        background: see `render_samples`.
    """

    def scene(params):
        return field_scene(field, params)

    def render(keys, params, grid, rays, step):
        buffer = math.ceil(pool_samples_per_ray * rays.near.size)
        fixed = jax.lax.stop_gradient(rays)  # where samples are has no gradient with respect to refined cameras
        limit = jnp.inf
        if max_optical_depth:
            limit = jnp.where(step < occlusion_start_step, jnp.inf, max_optical_depth)
        candidates = march_rays(None, grid, fixed, step_size=schedule.step_size, cell=schedule.cell)
        options = {"max_samples": buffer, "uniform_fraction": uniform_fraction, "max_optical_depth": limit}
        samples, occluded = importance_samples(keys, grid, fixed, candidates, **options)
        rendering = render_placed(scene(params), rays, samples, longest=candidates.t.shape[-1])
        return (_over_background(rendering, occluded, background),)

    return Model(
        init=lambda key: {"fine": field.init(key)},
        render=render,
        view=_view(scene, schedule, sample_multiplier, early_stop_eps, max_samples, background),
        scene=lambda params, grid: mask_scene(scene(params), grid),
        samples_per_ray=pool_samples_per_ray,
        grid_schedule=schedule,
        input_layers={"fine": field.input_layers},
        color_layers={"fine": field.color_layers},
        cull=_cull(schedule, background),
        needs=needs_of_fields(field),
    )


def bake_occupancy(
    model: Model,
    schedule: GridSchedule,
    visibility_rays: Callable[[int], Rays],
    *,
    crop: bool = True,
    early_stop_eps: float,
    sample_multiplier: float,
    max_samples: int,
    background: Background | None,
) -> tuple[Model, Callable[[Any], OccupancyGrid]]:
    """Converts a model trained without a grid into one that renders images with a grid of its visible density.

    Args:
        model: Model without a grid.
        schedule: GridSchedule of the box that images show.
        visibility_rays: count -> Rays [count] of the training views.
        crop: whether the grid is cropped to its occupied cells. Images then take less time, but grids of other
            parameters have other shapes, for which the renderer is compiled again.
        early_stop_eps, sample_multiplier, max_samples, background: see `occupancy_model`.

    Returns:
        Model, which evaluates only occupied cells; and the function params -> its grid, see `visible_grid`.
    """

    def scene(params):
        return model.scene(params, None)

    @jax.jit
    def find(params, rays):
        options = {"max_samples": max_samples, "background": background}
        return visible_grid(scene(params), rays, **schedule.box(), **options)

    rays = visibility_rays(num_visibility_rays(schedule.shape))
    view = _view(scene, schedule, sample_multiplier, early_stop_eps, max_samples, background)
    model = model._replace(view=view, cull=_cull(schedule, background))
    return model, lambda params: crop_grid(find(params, rays)) if crop else find(params, rays)


def render_with_grid(
    scene: SceneFn,
    grid: OccupancyGrid,
    rays: Rays,
    *,
    step_size: float,
    cell: Sequence[float],
    early_stop_eps: float,
    max_samples: int,
    background: Background | None = None,
    median_depth: bool = False,
) -> Rendering:
    """Renders rays [...] through the occupied cells of a grid: Rendering [...] without weights.

    Args:
        scene, grid, rays, background, median_depth: see `render_packed`.
        step_size, cell: see `march_rays`.
        early_stop_eps: transmittance below which a ray ends; 0: it ends when no light is left.
        max_samples: samples evaluated at once; the rest follow in further rounds.
    """
    samples = march_rays(None, grid, rays, step_size=step_size, cell=cell)
    return render_packed(
        scene,
        grid,
        rays,
        samples,
        max_samples=max_samples,
        early_stop_eps=early_stop_eps or _SMALLEST_EPS,
        background=background,
        median_depth=median_depth,
    )


def _cull(schedule, background):
    def cull(grid, rays, median_depth=False):
        empty = render_background(rays, background=background, median_depth=median_depth)
        return rays_may_hit(grid, rays, cell=schedule.cell), empty

    return cull


def _view(scene, schedule, sample_multiplier, early_stop_eps, max_samples, background):
    def view(params, grid, rays, median_depth=False):
        return render_with_grid(
            scene(params),
            grid,
            rays,
            step_size=schedule.step_size / sample_multiplier,
            cell=schedule.cell,
            early_stop_eps=early_stop_eps,
            max_samples=max_samples,
            background=background,
            median_depth=median_depth,
        )

    return view


def _over_background(rendering, occluded, background):
    """Composites a Rendering on black over a background.

    Where occluded samples were skipped, the remaining light is assumed to look like the rest of the ray. If it
    had the background's colour, the field would become opaque too early. The grid's estimate would follow and
    skip more samples: a feedback loop.
    """
    transmittance = (1 - rendering.opacity)[..., None]
    behind = jnp.zeros(3) if background is None else jnp.asarray(background)
    behind = jnp.broadcast_to(behind, rendering.rgb.shape)
    alike = rendering.rgb / jnp.maximum(rendering.opacity, 0.1)[..., None]
    rgb = rendering.rgb + transmittance * jnp.where(occluded[..., None], alike, behind)
    return dataclasses.replace(rendering, rgb=rgb)
