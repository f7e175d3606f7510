"""Training steps and pictures in parts that there is room for in memory."""

import dataclasses
import functools

import jax
import numpy as np

from jaxnerf.core.occupancy.ray_culling import render_selected
from jaxnerf.core.rendering import render_image
from jaxnerf.runtime import devices, memory

_CPU_CHUNK = 2**12  # rays that are rendered at once where there is room for them
_LARGEST_CHUNK = 2**16  # of an accelerator


def fit_step(compile_step, state, data, block):
    """Returns run, state, data of compile_step(state, data, block), with less where block has no room.

    Room is looked for when the step is compiled, and where that was wrong by the first step, which is then
    taken once more. Later steps need no more than the first. The batch stays what it was, and but for
    rounding what a step does.
    """
    options = {"cause": "train batch", "unit": "rays at once (--batch)", "whole": True}
    if jax.process_count() > 1:
        options["least"] = block  # all processes run one program: none can take less by itself
    (run, state, data), block = memory.back_off(lambda size: compile_step(state, data, size), block, **options)
    tried = False

    def patient(state, data):
        nonlocal run, block, tried
        if tried:
            return run(state, data)
        kept = jax.device_get(state)  # a step takes its state's memory, also one that fails

        def attempt(size):
            nonlocal run
            given = state, data
            if size != block:
                run, *given = compile_step(kept, data, size)
            return jax.block_until_ready(run(*given))

        result, block = memory.back_off(attempt, block, **options)
        tried = True
        return result

    return patient, state, data


def has_no_room(pixels):
    """Returns whether pixels better stay on the host, as they would fill over half of a device's memory."""
    room = None if jax.local_devices()[0].platform == "cpu" else memory.left()  # which maps them, too
    return room is not None and pixels.nbytes > room / 2


def gather_ahead(run, ids, pixels):
    """Returns run for data whose views' pixels are Gathered: each step gets those that it draws.

    Args:
        run: (state, data) -> (state, metrics), the step.
        ids: (step, data) -> [batch] int32, the pixels that a step draws; jitted.
        pixels: [P, C] of all views, on the host.
    """
    step, asked = None, None

    def gathered(state, data):
        nonlocal step, asked
        if step is None:
            step = int(state.step)
            asked = ids(step, data)
        drawn = data.views.pixels
        rows = devices.place(pixels[np.asarray(asked)], drawn.rows.sharding)
        step += 1
        asked = ids(step, data)  # now: once the step is under way, it would have to wait for that
        views = dataclasses.replace(data.views, pixels=dataclasses.replace(drawn, rows=rows))
        return run(state, data._replace(views=views))

    return gathered


def image_renderer(render, default, unseen=None):
    """Returns image(weights, rays [...], chunk=None) -> Rendering [...], in chunks that there is room for.

    Args:
        render: (weights, Rays [N]) -> Rendering [N], jitted.
        default: the chunk where none is given. 0, here and there: as large as suits the device, which for a
            CPU is the default.
        unseen: (weights, Rays [...]) -> which of them to render, and what the others are; None: render all.
    """
    fitting = {}  # by what was asked for: what there was room for

    def image(weights, rays, chunk=None):
        asked = default if chunk is None else chunk
        if not asked:
            asked = min(_auto_chunk(default), 1 << (rays.near.size - 1).bit_length())
        key = asked, _shapes(weights)

        def attempt(size):
            if fitting.get(key) != size:
                part = jax.tree.map(lambda leaf: _first(leaf, rays.near.ndim, size), rays)
                memory.check(render.lower(weights, part).compile())  # the calls below find it compiled
            part = functools.partial(render, weights)
            if unseen is None:
                return jax.block_until_ready(render_image(part, rays, chunk=size))
            return jax.block_until_ready(render_selected(part, rays, *unseen(weights, rays), chunk=size))

        result, fitting[key] = memory.back_off(
            attempt, fitting.get(key, asked), cause="render chunk", unit="rays at once (--chunk)"
        )
        return result

    return image


def _auto_chunk(default):
    """Returns how many rays to render at once where there is the room; configurations suit CPUs."""
    return default or _CPU_CHUNK if jax.local_devices()[0].platform == "cpu" else _LARGEST_CHUNK


def _first(leaf, axes, size):
    return jax.ShapeDtypeStruct((size, *leaf.shape[axes:]), leaf.dtype)


def _shapes(tree):
    return tuple((leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(tree))
