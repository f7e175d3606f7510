"""The directions from which cameras have seen each cell of an occupancy grid, and how familiar a new view is.

Directions are rounded to 64 fixed ones, so that a cell needs 64 bits however many cameras see it. The nearest fixed
direction is 10 degrees away in the mean, and at most 20.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int, UInt32

from jaxnerf.core.occupancy.grid import OccupancyGrid, cells_around
from jaxnerf.core.poses import spread_directions
from jaxnerf.core.types import SceneFn, check_shapes

NUM_DIRECTIONS = 64
_BITS = 32  # of a word


def nearest_direction(viewdirs: Float[ArrayLike, "*batch 3"]) -> Int[Array, "*batch"]:
    """Returns which of the 64 directions is nearest to each viewing direction [..., 3], unit length; int32."""
    return _cosines(viewdirs).argmax(axis=-1).astype(jnp.int32)


def familiarity(seen: UInt32[ArrayLike, "*batch 2"], viewdirs: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch"]:
    """Computes how well cameras have seen a place from near a direction: (1 + cos a) / 2.

    a is the angle to the nearest direction in which a camera has looked at it. This is the score of a sample in
    CONVERGE (CVPR 2026), with that direction rounded.

    Args:
        seen: [..., 2] bit k % 32 of word k // 32 is set if a camera has seen the place in about the k-th direction.
        viewdirs: [..., 3] unit length, from the camera to the place.

    Returns:
        [...] in [0, 1]: 1 straight ahead, 1/2 at right angles, and 0 where no camera has seen the place. It has no
        gradient with respect to the place.

    Raises:
        ValueError: on other shapes.
    """
    check_shapes("familiarity", seen=(seen, "... 2"), viewdirs=(viewdirs, "... 3"))
    shifts = jnp.arange(_BITS, dtype=jnp.uint32).reshape((1,) * jnp.ndim(seen) + (_BITS,))
    bits = (jnp.asarray(seen)[..., None] >> shifts) & 1
    is_seen = bits.reshape(*bits.shape[:-2], NUM_DIRECTIONS) > 0
    return (1 + jnp.where(is_seen, _cosines(viewdirs), -1).max(axis=-1)) / 2


def familiarity_scene(scene: SceneFn, grid: OccupancyGrid, seen: UInt32[ArrayLike, "X Y Z 2"]) -> SceneFn:
    """Makes a scene of one channel, which renders how well cameras have seen what a view shows.

    The channel of a sample is the familiarity of its cell. A renderer composites it as colour, so that a ray has the
    sum of w_i (1 + cos a_i) / 2 over its samples (CONVERGE, CVPR 2026). The background must have one channel, too:
    [1.0] where it is known that light which passes the scene comes from nothing, so that empty views count as seen.

    Args:
        scene: see render_samples; it keeps its density, and what it asks for.
        grid: OccupancyGrid.
        seen: [X, Y, Z, 2] of its cells, see `familiarity`. Outside of its box nothing is seen.

    Returns:
        The scene (x [..., S, 3], viewdirs [..., 1 or S, 3]) -> (density [..., S], familiarity [..., S, 1]).

    Raises:
        ValueError: if `seen` does not have the grid's cells.
    """
    if jnp.shape(seen) != (*grid.occupied.shape, 2):
        raise ValueError(
            f"familiarity_scene: seen has shape {jnp.shape(seen)}, expected {(*grid.occupied.shape, 2)}, two words for "
            "each cell of the grid"
        )
    words = jnp.asarray(seen).reshape(-1, 2)

    @functools.wraps(scene)
    def familiar(x, viewdirs, **inputs):
        density, _ = scene(x, viewdirs, **inputs)
        index, inside = cells_around(grid, jax.lax.stop_gradient(x))
        found = jnp.where(inside[..., None], words[index], jnp.uint32(0))
        return density, familiarity(found, jnp.broadcast_to(viewdirs, x.shape))[..., None]

    return familiar


def _cosines(viewdirs):
    """Returns the cosines [..., 64] of the angles between viewing directions and the fixed ones."""
    return jnp.dot(jnp.asarray(viewdirs), jnp.array(spread_directions(NUM_DIRECTIONS)).T, precision="highest")
