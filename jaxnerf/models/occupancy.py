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
    Changes,
    Device,
    Facts,
    Options,
    at_least,
    between,
    infer,
    is_auto,
    numbers,
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
    """The options of the sampler "occupancy"; the box also bounds the hash grid."""

    use_alpha: bool = option(
        True, "whether cells outside the visual hull of the alpha channels are empty from the start"
    )
    contracted: bool = option(
        "auto", "whether the box holds all of space; positions outside its inner half are then contracted", auto=True
    )
    lower: tuple[float, ...] = option("auto", "a corner of the box", unit="world units", auto=True, check=numbers(3))
    upper: tuple[float, ...] = option(
        "auto", "the opposite corner of the box", unit="world units", auto=True, check=numbers(3)
    )
    step_size: float = option("auto", "distance of samples", unit="world units", range=POSITIVE, auto=True)
    resolution: int = option("auto", "cells along the longest side", range=at_least(1), auto=True)
    threshold: float = option(0.01, "opacity over one step below which a cell is empty", range=at_least(0))
    update_every: int = option(64, "training steps between updates of the grid", range=at_least(1))
    cells_per_update: int = option(2**18, "cells whose density an update evaluates", range=at_least(1))
    update_chunk: int = option(
        "auto", "cells of these evaluated at once", range=at_least(1), auto=True, changes=Changes.SPEED
    )
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
        """Infers the box, its cells and the step from what cameras and images show, the buffer from the device."""
        contraction = f"contraction   {'on' if facts.contracted else 'off'}: {facts.contraction_reason}"
        box = f"box           {_point(facts.lower)} to {_point(facts.upper)}, {facts.box_reason}"
        options, lines = infer(
            self,
            contracted=(facts.contracted, contraction),
            lower=(facts.lower, box),
            upper=(facts.upper, "" if is_auto(self.lower) else box),
            min_views=(int(facts.fills_space), "valid cells   those that a training view sees" * facts.fills_space),
            resolution=_resolution(facts),
        )
        options, more = infer(options, step_size=_step_size(facts, options.resolution))
        lines += more
        if facts.batch_size:
            samples = options._samples_per_ray
            if not device.is_cpu:
                samples = float(min(max(_ACCELERATOR_SAMPLES / facts.batch_size, samples), 2 * samples))
            used = facts.sampler == "occupancy"
            line = f"batch         at most {samples:g} samples per ray on average" * used
            options, more = infer(options, pool_samples_per_ray=(samples, line))
            lines += more
        return options, lines

    def resolve_for_device(self, device: Device) -> tuple["OccupancyOptions", list[str]]:
        """Infers how many cells an update evaluates at once."""
        # On a CPU a little under a power of two, so that activations do not collide in the cache.
        cells = 8160 if device.is_cpu else 2**18
        line = f"grid          {cells} cells evaluated at once in an update, for this device"
        return infer(self, update_chunk=(cells, line))

    def check(self) -> None:
        if is_auto(self.lower) or is_auto(self.upper) or is_auto(self.step_size):
            return
        longest = max(self._sides)
        if longest > _MAX_STEPS_PER_SIDE * self.step_size:
            raise ValueError(
                f"step_size is {self.step_size}, expected at least {longest / _MAX_STEPS_PER_SIDE:.3g}: the "
                f"longest side of the box, {longest:.3g}, in at most {_MAX_STEPS_PER_SIDE:,} steps; correct it"
            )

    def bytes_needed(self) -> dict[str, float]:
        """Returns those of the grid."""
        sides = (1.0, 1.0, 1.0) if is_auto(self.lower) or is_auto(self.upper) else self._sides
        if is_auto(self.resolution) or min(sides) <= 0:
            return {}
        return {"resolution": 10 * self.resolution**3 * math.prod(sides) / max(sides) ** 3}

    def busy_rays(self, device: Device) -> int | None:
        """Returns as many rays as fill the buffer of an accelerator."""
        if device.is_cpu:
            return None
        return 2 ** max(math.floor(math.log2(_ACCELERATOR_SAMPLES / self._samples_per_ray)), 0)

    def rays_per_chunk(self, device: Device) -> int:
        """Returns as many rays as fill the buffer, and not much more than a small image needs."""
        return 2**13 if device.is_cpu else 2**16

    @property
    def _samples_per_ray(self):
        pool = self.pool_samples_per_ray
        return self.cpu_pool_samples_per_ray if is_auto(pool) else pool

    @property
    def _sides(self):
        return [high - low for low, high in zip(self.lower, self.upper, strict=True)]


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


def _point(point):
    return "(" + ", ".join(f"{value:.2f}" for value in point) + ")"


def from_context(context: SamplerContext) -> Model:
    """Makes the model that the options describe."""
    field = context.make_field("fine")
    schedule = schedule_of(context.options, field)
    given = {"background": context.background, "fixed_order": context.fixed_order}
    return occupancy_model(field, schedule, context.options, context.view, **given)


SAMPLER = Part(from_context, OccupancyOptions, section="occupancy")


def schedule_of(options: OccupancyOptions, field: Field | None) -> GridSchedule:
    """Makes the GridSchedule that resolved options describe; field: None without updates."""
    return make_grid_schedule(
        options.lower,
        options.upper,
        resolution=options.resolution,
        step_size=options.step_size,
        field=field,
        threshold=options.threshold,
        update_every=options.update_every,
        cells_per_update=options.cells_per_update,
        contracted=options.contracted,
        update_chunk=options.update_chunk,
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
