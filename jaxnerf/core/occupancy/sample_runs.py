"""Ray marching near matter: runs of steps that may cross occupied cells, in one buffer for all rays.

A CPU takes as long for a sample in an empty cell as for one in an occupied cell. With fine cells most are empty, so it
is faster to find out first which parts of a ray may cross occupied ones.
"""

import math
from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxnerf.core.occupancy.grid import OccupancyGrid, clip_rays_to_box, near_occupied
from jaxnerf.core.occupancy.ray_marching import num_steps, steps_in_t
from jaxnerf.core.sampling import edges_after_steps, samples_from_edges
from jaxnerf.core.types import Rays, Samples, check_shapes, has_nan, pytree
from jaxnerf.core.volume_rendering import running_sum

WIDTH = 8  # steps of a run; march_rays has a multiple of 32 of them
_PART = 64  # runs that are counted by one matrix product


@pytree(static=("max_count",))
class SampleRuns:
    """Samples along B rays in U runs of W that follow each other, ray after ray.

    Attributes:
        samples: Samples [U, W].
        ray_index: [U] int32, the ray of each run, ascending. Runs that no ray has are empty and come last.
        first: [B] int32, the first run of each ray.
        count: [B] int32, its runs; may be 0.
        max_count: an upper bound of `count`.
    """

    samples: Samples
    ray_index: Int[Array, " U"]
    first: Int[Array, " B"]
    count: Int[Array, " B"]
    max_count: int


def march_near_matter(
    grid: OccupancyGrid, rays: Rays, *, step_size: float, cell: Sequence[float], max_runs: int
) -> tuple[SampleRuns, Bool[Array, ""]]:
    """Returns the samples of `march_rays` in those runs of steps that may cross occupied cells.

    A run is looked up once, by its middle, see `near_occupied`.

    Args:
        grid: OccupancyGrid, not contracted.
        rays: Rays [B], B >= 1. One that is NaN has all runs.
        step_size, cell: see `march_rays`.
        max_runs: U, the size of the buffer.

    Returns:
        SampleRuns, and whether the buffer holds all. If not, the last ones are missing.

    Raises:
        ValueError: on other shapes, or a contracted grid.
    """
    check_shapes("march_near_matter", near=(rays.near, "B"))
    if grid.contracted:
        raise ValueError("march_near_matter: the grid is contracted, expected one that is not; use march_rays")
    steps, t_step, inside = num_steps(grid, step_size, cell), steps_in_t(rays, step_size), clip_rays_to_box(grid, rays)
    near, far, t_run = (leaf[:, None] for leaf in (inside.near, inside.far, WIDTH * t_step))
    runs = jnp.arange(steps // WIDTH, dtype=jnp.float32)[None]
    # Half a run is at most so many cells long; the margin is for rounding.
    radius = math.ceil(1.001 * WIDTH * step_size / (2 * min(cell)))
    may_cross = (near + runs * t_run < far) & near_occupied(grid, rays, near + (runs + 0.5) * t_run, radius)
    may_cross |= has_nan(rays)[:, None]
    rank = running_sum(may_cross.astype(jnp.float32), part_size=_PART).astype(jnp.int32)
    count = rank[:, -1]
    first = jnp.cumsum(count, dtype=jnp.int32) - count

    # The runs of all rays, in order; the index max_runs is outside the buffer, so that all others are dropped.
    place = jnp.where(may_cross, first[:, None] + rank - 1, max_runs).reshape(-1)
    every = jnp.arange(place.size, dtype=jnp.int32)
    chosen = jnp.full(max_runs, place.size, jnp.int32).at[place].set(every, mode="drop")
    ray, run = jnp.divmod(chosen, runs.size)
    ray = jnp.minimum(ray, rays.near.size - 1)
    after = run[:, None] * WIDTH + jnp.arange(WIDTH + 1)[None]
    ends = (leaf[ray][:, None] for leaf in (inside.near, inside.far, t_step))
    edges = edges_after_steps(after.astype(jnp.float32), *ends, steps)
    edges = jnp.where((chosen < place.size)[:, None], edges, 0)
    samples = samples_from_edges(None, edges)
    found = SampleRuns(samples=samples, ray_index=ray, first=first, count=count, max_count=runs.size)
    return found, count.sum() <= max_runs
