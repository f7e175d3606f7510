"""Renders images in chunks that fit into memory."""

from collections.abc import Callable
from typing import Any

import jax

from jaxnerf.core.occupancy.ray_culling import render_selected
from jaxnerf.core.rendering import render_image
from jaxnerf.core.types import Rays, Rendering
from jaxnerf.runtime import memory, stages
from jaxnerf.runtime.cores import map_on_cores, num_at_once


def image_renderer(
    render: Callable[[Any, Rays], Rendering], default: int, cull: Callable[..., tuple] | None = None
) -> Callable[..., Rendering]:
    """Makes the function (variables, rays [...], chunk=None) -> Rendering [...], in chunks that fit into memory.

    Args:
        render: (variables, Rays [N]) -> Rendering [N], jitted.
        default: rays per chunk where none are given. An image with fewer rays has one chunk of about its size.
        cull: (variables, Rays [...]) -> bool [...], which rays to render, and the Rendering of the others;
            None: all are rendered.
    """
    fitting = {}  # requested chunk -> the one that fits
    checked = set()

    def image(variables, rays, chunk=None):
        requested = min(default if chunk is None else chunk, 1 << (rays.near.size - 1).bit_length())
        key = requested, tuple((leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(variables))

        def attempt(size):
            def part(rays):
                if (size, key) not in checked:
                    # For the arrays themselves, not only their shapes: the call would compile again for arrays that are
                    # bound to a device.
                    memory.check(render.lower(variables, rays).compile(), num_at_once())
                    memory.release()
                    checked.add((size, key))
                return render(variables, rays)

            # The first image, which compiles, has one thread.
            options = {"chunk": size, "map": map_on_cores if (size, key) in checked else map}
            if cull is None:
                return jax.block_until_ready(render_image(part, rays, **options))
            return jax.block_until_ready(render_selected(part, rays, *cull(variables, rays), **options))

        with stages.stage("rendering an image"):
            result, fitting[key] = memory.back_off(
                attempt, fitting.get(key, requested), cause="image", unit="rays per chunk (--chunk)"
            )
        return result

    return image
