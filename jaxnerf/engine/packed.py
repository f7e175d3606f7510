"""The model that is asked only where there is something: one field, and the grid that says where."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp

from jaxnerf.core import occupancy
from jaxnerf.core.packing import render_packed
from jaxnerf.engine.extraction import crop_grid, rays_to_look, visible_grid
from jaxnerf.engine.marching import samples_in_box
from jaxnerf.engine.models import Model
from jaxnerf.engine.unseen import may_meet, render_nothing

_STEP_IN_FOG = 3.0  # times the step


def packed_model(
    field,
    space,
    *,
    samples_per_ray,
    fog_until,
    hide_beyond,
    hide_from,
    stop,
    view_samples,
    samples_at_once,
    background,
):
    """Returns the Model of one field that is asked only where its grid is occupied.

    Args:
        field: Field.
        space: Space.
        samples_per_ray: the room in training's pool; rays that find none are left out and counted.
        fog_until: the step before which samples are longer, as fog looks the same and more rays find room.
        hide_beyond: optical depth by the grid's guess behind which training asks no more; 0: none.
        hide_from: the step from which on the guess counts.
        stop: of pictures: a ray ends where no more than this passes.
        view_samples: of pictures, times those of training.
        samples_at_once: of pictures.
        background: see render_samples.
    """

    def scene(params):
        return functools.partial(field.apply, params["fine"])

    def render(keys, params, grid, rays, step):
        capacity = math.ceil(samples_per_ray * rays.near.size)
        stretch = jnp.where(step < fog_until, _STEP_IN_FOG, 1.0) if fog_until else 1.0
        samples = samples_in_box(keys, grid, rays, step=space.step, cell=space.cell, stretch=stretch)
        beyond = jnp.where(step < hide_from, jnp.inf, hide_beyond) if hide_beyond else jnp.inf
        samples, hidden = occupancy.mask_samples(grid, rays, samples, beyond=beyond)
        seen = render_packed(scene(params), None, rays, samples, capacity=capacity)
        return (_over_background(seen, hidden, background),)

    view = _view_of(scene, space, view_samples, stop, samples_at_once, background)

    def restricted(params, grid):
        return occupancy.restrict_scene(scene(params), grid)

    return Model(
        init=lambda key: {"fine": field.init(key)},
        render=render,
        view=view,
        scene=restricted,
        space=space,
        entrances={"fine": field.entrances},
        unseen=_unseen_of(space, background),
    )


def skip_empty_afterwards(model, space, look, *, stop, view_samples, samples_at_once, background):
    """Returns the Model, for pictures only, of one trained along whole rays, with a grid of what can be seen.

    Args:
        model: Model without a space.
        space: Space around what is to be seen.
        look: count -> Rays [count] of what the training views see.
        stop, view_samples, samples_at_once, background: see packed_model.

    Returns:
        Model, outside whose grid nothing is asked; and params -> that grid, see extraction.visible_grid.
    """

    def scene(params):
        return model.scene(params, None)

    @jax.jit
    def find(params, rays):
        options = {"samples_at_once": samples_at_once, "background": background}
        return visible_grid(scene(params), space, rays, **options)

    rays = look(rays_to_look(space))
    view = _view_of(scene, space, view_samples, stop, samples_at_once, background)
    model = model._replace(view=view, unseen=_unseen_of(space, background))
    return model, lambda params: crop_grid(find(params, rays))


def _unseen_of(space, background):
    def unseen(grid, rays):
        return may_meet(grid, rays, cell=space.cell), render_nothing(rays, background=background)

    return unseen


def _view_of(scene, space, view_samples, stop, samples_at_once, background):
    def view(params, grid, rays):
        return view_packed(
            scene(params),
            grid,
            rays,
            step=space.step / view_samples,
            cell=space.cell,
            stop=stop,
            capacity=samples_at_once,
            background=background,
        )

    return view


def view_packed(scene, grid, rays, *, step, cell, stop, capacity, background=None):
    """Returns what rays [...] see of a scene where its grid is occupied: Rendering [...] without weights.

    Args:
        scene, grid, rays, background: see render_packed.
        step, cell: see samples_in_box.
        stop: a ray ends where no more than this passes; 0: where nothing does.
        capacity: samples asked at once; what does not fit is asked in a further round.
    """
    samples = samples_in_box(None, grid, rays, step=step, cell=cell)
    return render_packed(
        scene, grid, rays, samples, capacity=capacity, stop=stop or 1e-30, background=background
    )


def _over_background(seen, cut, background):
    """Returns the Rendering of black, over a background.

    Where hidden samples were left out, what passes is taken to look like what does not: were the background
    seen there, the field would grow opaque before its time, the guess with it, and both run away.
    """
    passing = (1 - seen.opacity)[..., None]
    behind = jnp.zeros(3) if background is None else jnp.asarray(background)
    behind = jnp.broadcast_to(behind, seen.rgb.shape)
    alike = seen.rgb / jnp.maximum(seen.opacity, 0.1)[..., None]
    return dataclasses.replace(seen, rgb=seen.rgb + passing * jnp.where(cut[..., None], alike, behind))
