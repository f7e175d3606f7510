"""What a run learns and how it is rendered; here the paper's way, two networks along whole rays."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from jaxnerf.core.rendering import render_hierarchical, render_rays
from jaxnerf.core.sampling import split_key
from jaxnerf.core.structs import without_weights


class Model(NamedTuple):
    """Pure functions; a grid is None where a model has none."""

    init: Callable[[jax.Array], Any]  # key -> params
    render: Callable[..., tuple]  # (keys [B], params, grid, Rays [B], step) -> Renderings, for training
    view: Callable[..., Any]  # (params, grid, Rays [...]) -> Rendering [...] without weights, for pictures
    scene: Callable[..., Callable]  # (params, grid) -> the scene that counts
    space: Any = None  # Space; None where all of it is asked
    entrances: dict[str, tuple[str, ...]] = {}  # of the networks, see Field
    # (grid, Rays [...]) -> bool [...], which may see something, and the Rendering [...] of those that do not;
    # None: all may
    unseen: Callable[..., tuple] | None = None


def hierarchical_model(
    fields,
    *,
    num_coarse,
    num_fine,
    rule,
    in_disparity,
    importance_floor,
    density_noise,
    background,
    stratified=True,
    view_samples=1.0,
):
    """Returns the paper's Model: fields "coarse" and "fine", or "fine" alone for num_fine 0.

    Args:
        fields: name -> Field.
        density_noise: 1 / world unit, its deviation while there are keys.
        stratified: whether samples are drawn while there are keys; else they stay where they are without.
        view_samples: of pictures, times those of training.
        num_coarse, num_fine, rule, in_disparity, importance_floor, background: see render_hierarchical.
    """
    options = {"rule": rule, "in_disparity": in_disparity, "background": background}

    def init(key):
        keys = jax.random.split(key, len(fields))
        return {name: field.init(key) for (name, field), key in zip(fields.items(), keys, strict=True)}

    def render(keys, params, grid, rays, step, share=1.0):
        del grid, step
        noise = density_noise if keys is not None else 0.0
        keys, *noise_keys = split_key(keys, 1 + len(fields)) if noise else (keys, *[None] * len(fields))
        scenes = [
            functools.partial(field.apply, params[name], key=noise_key, density_noise=noise)
            for (name, field), noise_key in zip(fields.items(), noise_keys, strict=True)
        ]
        keys = keys if stratified else None
        first, more = (
            max(2, 2 * round(number * share / 2)) if share != 1 else number
            for number in (num_coarse, num_fine)
        )
        if len(scenes) == 1:
            return (render_rays(keys, *scenes, rays, num_samples=first, **options),)
        counts = {"num_coarse": first, "num_fine": more, "importance_floor": importance_floor}
        return render_hierarchical(keys, *scenes, rays, **counts, **options)

    def view(params, grid, rays):
        return without_weights(render(None, params, grid, rays, None, view_samples)[-1])

    def scene(params, grid):
        del grid
        return functools.partial(fields["fine"].apply, params["fine"])

    return Model(init, render, view, scene, None, {name: field.entrances for name, field in fields.items()})
