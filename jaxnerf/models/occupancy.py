"""The occupancy sampler: one field, evaluated only in the occupied cells of a grid (after arXiv:2201.05989)."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxnerf.core.loops import is_cpu
from jaxnerf.core.occupancy.from_scene import crop_grid, num_visibility_rays, visible_grid
from jaxnerf.core.occupancy.grid import OccupancyGrid, mask_scene
from jaxnerf.core.occupancy.importance import importance_samples
from jaxnerf.core.occupancy.packed import render_packed, render_placed
from jaxnerf.core.occupancy.ray_culling import rays_may_hit, render_background
from jaxnerf.core.occupancy.ray_marching import march_rays, num_steps
from jaxnerf.core.occupancy.sample_runs import WIDTH, march_near_matter
from jaxnerf.core.types import Background, Rays, Rendering, SceneFn
from jaxnerf.fields.base import Field, field_scene, needs_of_fields
from jaxnerf.models.base import Model, SamplerContext, ViewOptions
from jaxnerf.models.grid_schedule import GridSchedule, make_grid_schedule
from jaxnerf.options import (
    FRACTION,
    POSITIVE,
    Ablation,
    Box,
    Changes,
    Device,
    Facts,
    Options,
    at_least,
    between,
    double,
    infer,
    is_auto,
    option,
)
from jaxnerf.registry import Part

_SMALLEST_EPS = 1e-30  # replaces an early_stop_eps of 0: below this transmittance no light is left
_DETAIL = (32, 256)  # fewest and most of the smallest details along the longest side that a grid follows
_MAX_STEPS = 144  # along the longest side: finer images need finer features rather than finer steps
# But a step is at most as long as a cell, since training skips cells in which no step has its middle. With more than
# _MAX_RESOLUTION cells it is a little shorter, which gains 0.1 dB at 400 px.
_FINE_STEPS_PER_CELL = 1.125
_MAX_RESOLUTION = 128  # cells: updating more of them costs more than the samples that they save
_FINE_RESOLUTION = 256  # where alpha empties most of them; a cell then holds two of the smallest details
# Fraction of all steps along rays that the buffer of those near matter holds; lego at 400 px needs most of it.
_MAX_NEAR_MATTER = 0.25
_MAX_OPEN_RESOLUTION = 96  # where nothing empties cells before training, so that all of them are updated
_MAX_STEPS_PER_SIDE = 2**16  # of any step size, through the box
_ACCELERATOR_SAMPLES = 2**18  # of a step, which keep an accelerator busy; as in arXiv:2201.05989
_POOL = between(0.01, 100_000)


@dataclasses.dataclass(frozen=True)
class OccupancyOptions(Options):
    """The options of the sampler "occupancy"."""

    skips_empty_cells = True

    step_size: float = option(
        "auto",
        "distance of samples",
        unit="world units",
        range=POSITIVE,
        auto=True,
        ablations=(Ablation("samples a ray", less=double, more=lambda step, *_: step / 2),),
    )
    resolution: int = option("auto", "cells along the longest side", range=at_least(1), auto=True)
    threshold: float = option(0.01, "opacity over one step below which a cell is empty", range=at_least(0))
    update_every: int = option(64, "training steps between updates of the grid", range=at_least(1))
    pool_samples_per_ray: float = option(
        10.0,
        "size of the sample buffer in training, divided by the number of rays. auto: on a CPU "
        "`cpu_pool_samples_per_ray`; on an accelerator, which a larger buffer keeps busy, up to twice as much",
        range=_POOL,
        auto=True,
    )
    cpu_pool_samples_per_ray: float = option(10.0, "see `pool_samples_per_ray`", range=_POOL, changes=Changes.NOTHING)
    uniform_fraction: float = option(
        0.4,
        "If the samples of all rays do not fit into the buffer, the rays with most samples get fewer: this fraction "
        "of them evenly, the others where the grid expects the rays to end.",
        range=FRACTION,
    )
    max_optical_depth: float = option(
        6.0, "training skips samples behind it, as estimated by the grid; 0: off", range=at_least(0)
    )
    occlusion_start_step: int = option(400, "training step from which `max_optical_depth` applies", range=at_least(0))
    min_views: int = option(
        "auto", "training views that must see a cell; other cells are empty; 0: no limit", range=at_least(0), auto=True
    )

    def resolve(self, facts: Facts, device: Device) -> tuple["OccupancyOptions", list[str]]:
        """Infers cells and step from the scene's box and what images show, the buffer from the device."""
        samples = self._samples_per_ray
        if not device.is_cpu:
            samples = float(min(max(_ACCELERATOR_SAMPLES / facts.batch_size, samples), 2 * samples))
        options, lines = infer(
            self,
            min_views=(int(facts.fills_space), "valid cells   those that a training view sees" * facts.fills_space),
            resolution=_resolution(facts),
            pool_samples_per_ray=(samples, f"batch         at most {samples:g} samples per ray on average"),
        )
        options, more = infer(options, step_size=_step_size(facts, options.resolution))
        return options, lines + more

    def check(self, box: Box | None = None) -> None:
        if box is None or is_auto(self.step_size):
            return
        longest = max(_sides(box))
        if longest > _MAX_STEPS_PER_SIDE * self.step_size:
            raise ValueError(
                f"step_size is {self.step_size}, expected at least {longest / _MAX_STEPS_PER_SIDE:.3g}: the "
                f"longest side of the box, {longest:.3g}, in at most {_MAX_STEPS_PER_SIDE:,} steps; correct it"
            )

    def bytes_needed(self, box: Box | None) -> dict[str, float]:
        """Returns those of the grid."""
        sides = [1.0, 1.0, 1.0] if box is None else _sides(box)
        if is_auto(self.resolution) or min(sides) <= 0:
            return {}
        return {"resolution": 10 * self.resolution**3 * math.prod(sides) / max(sides) ** 3}

    def rays_per_step(self, cpu_rays: int, device: Device, *, large_field: bool) -> tuple[int, str]:
        """Returns as many rays as fill the buffer of an accelerator; on a CPU more where the field is large."""
        if not device.is_cpu:
            rays = 2 ** max(math.floor(math.log2(_ACCELERATOR_SAMPLES / self._samples_per_ray)), 0)
            return rays, "they keep this device busy"
        if large_field:
            return 2 * cpu_rays, "twice train.cpu_batch_size, as the hash grid's table is large"
        return cpu_rays, "train.cpu_batch_size"

    def rays_per_chunk(self, device: Device) -> int:
        """Returns as many rays as fill the buffer, and not much more than a small image needs."""
        return 2**13 if device.is_cpu else 2**16

    @property
    def _samples_per_ray(self):
        pool = self.pool_samples_per_ray
        return self.cpu_pool_samples_per_ray if is_auto(pool) else pool


def _sides(box):
    return [high - low for low, high in zip(*box, strict=True)]


def _resolution(facts):
    """Returns cells along the longest side, and the line that reports them."""
    is_open = not (facts.has_alpha or facts.contracted or facts.ndc)
    cells = min(min(max(facts.detail, _DETAIL[0]), _DETAIL[1]), _MAX_OPEN_RESOLUTION if is_open else _MAX_RESOLUTION)
    if facts.has_fine_cells:
        cells = min(facts.detail // 2, _FINE_RESOLUTION)
    return cells, f"grid          {cells} cells along the longest side"


def _step_size(facts, resolution):
    """Returns the step for so many cells, and the line that reports it."""
    per_cell = _FINE_STEPS_PER_CELL if resolution > _MAX_RESOLUTION else 1
    finest = min(max(facts.detail, _DETAIL[0]), _DETAIL[1])
    step = facts.longest / max(min(finest, _MAX_STEPS), per_cell * resolution)
    return step, f"step size     {step:.4g}; a pixel covers {facts.footprint:.4g} world units"


def from_context(context: SamplerContext) -> Model:
    """Makes the model that the options describe."""
    field = context.make_field("fine")
    schedule = schedule_of(context.options, context.box, field, contracted=context.contracted)
    given = {"background": context.background, "fixed_order": context.fixed_order}
    return occupancy_model(field, schedule, context.options, context.view, **given)


SAMPLER = Part(from_context, OccupancyOptions, section="occupancy")


def schedule_of(options: OccupancyOptions, box: Box | None, field: Field | None, *, contracted: bool) -> GridSchedule:
    """Makes the GridSchedule that resolved options describe.

    Args:
        options: resolved.
        box: of the scene; a ValueError is raised without one.
        field: that updates the grid; None: there are no updates.
        contracted: whether the box holds all of space.
    """
    if box is None:
        raise ValueError("scene.lower or scene.upper is 'auto'; resolve the config against a dataset, or set both")
    return make_grid_schedule(
        *box,
        resolution=options.resolution,
        step_size=options.step_size,
        field=field,
        threshold=options.threshold,
        update_every=options.update_every,
        contracted=contracted,
        min_views=options.min_views,
    )


def occupancy_model(
    field: Field,
    schedule: GridSchedule,
    options: OccupancyOptions,
    view: ViewOptions,
    *,
    background: Background | None,
    fixed_order: bool = False,
) -> Model:
    """Makes the model of one field that is evaluated only in the occupied cells of its grid.

    Args:
        field: any Field.
        schedule: of the occupancy grid.
        options: of training. If the samples of all rays do not fit into its buffer, the rays with most samples get
            fewer, see `importance_samples`.
        view: of images.
        background: see `render_samples`.
        fixed_order: see `render_placed`.
    """

    def scene(params):
        return field_scene(field, params)

    def render(keys, params, grid, rays, step):
        buffer = math.ceil(options.pool_samples_per_ray * rays.near.size)
        fixed = jax.lax.stop_gradient(rays)  # where samples are has no gradient with respect to refined cameras
        limit = jnp.inf
        if options.max_optical_depth:
            limit = jnp.where(step < options.occlusion_start_step, jnp.inf, options.max_optical_depth)
        steps = {"step_size": schedule.step_size, "cell": schedule.cell}
        place = functools.partial(
            importance_samples,
            keys,
            grid,
            fixed,
            max_samples=buffer,
            uniform_fraction=options.uniform_fraction,
            max_optical_depth=limit,
        )

        def anywhere():
            return place(march_rays(None, grid, fixed, **steps))

        longest = num_steps(grid, **steps)
        # An accelerator marches along all rays at once, and of coarser cells too many are occupied.
        if is_cpu() and max(grid.valid.shape) > _MAX_RESOLUTION and not grid.contracted and rays.near.size:
            max_runs = math.ceil(_MAX_NEAR_MATTER * longest / WIDTH * rays.near.size)
            runs, complete = march_near_matter(grid, fixed, max_runs=max_runs, **steps)
            samples, occluded = jax.lax.cond(complete, lambda: place(runs), anywhere)
        else:
            samples, occluded = anywhere()
        rendering = render_placed(scene(params), rays, samples, longest=longest, fixed_order=fixed_order)
        return {"fine": _over_background(rendering, occluded, background)}

    return Model(
        init=lambda key: {"fine": field.init(key)},
        render=render,
        view=_view(scene, schedule, view, background),
        scene=lambda params, grid: mask_scene(scene(params), grid),
        samples_per_ray=options.pool_samples_per_ray,
        fields={"fine": field},
        grid_schedule=schedule,
        cull=_cull(schedule, background),
        needs=needs_of_fields(field),
    )


def bake_occupancy(
    model: Model,
    schedule: GridSchedule,
    visibility_rays: Callable[[int], Rays],
    view: ViewOptions,
    *,
    crop: bool = True,
    background: Background | None,
) -> tuple[Model, Callable[[Any], OccupancyGrid]]:
    """Converts a model trained without a grid into one that renders images with a grid of its visible density.

    Args:
        model: Model without a grid.
        schedule: GridSchedule of the box that images show.
        visibility_rays: count -> Rays [count] of the training views.
        crop: whether the grid is cropped to its occupied cells. Images then take less time, but grids of other
            parameters have other shapes, for which the renderer is compiled again.
        view: of images.
        background: see `render_samples`.

    Returns:
        Model, which evaluates only occupied cells; and the function params -> its grid, see `visible_grid`.
    """

    def scene(params):
        return model.scene(params, None)

    @jax.jit
    def find(params, rays):
        options = {"max_samples": view.max_samples, "background": background}
        return visible_grid(scene(params), rays, **schedule.box(), **options)

    rays = visibility_rays(num_visibility_rays(schedule.shape))
    model = model._replace(view=_view(scene, schedule, view, background), cull=_cull(schedule, background))
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


def _view(scene, schedule, options, background):
    def view(params, grid, rays, median_depth=False):
        return render_with_grid(
            scene(params),
            grid,
            rays,
            step_size=schedule.step_size / options.sample_multiplier,
            cell=schedule.cell,
            early_stop_eps=options.early_stop_eps,
            max_samples=options.max_samples,
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
