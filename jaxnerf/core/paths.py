"""Camera poses: one that looks at a point, and paths of many.

Camera axes are x right, y up, looking along -z. A path is poses [N, 3, 4], camera to world, in float32.
"""

import math

import jax
import jax.numpy as jnp

from jaxnerf.core.numerics import norm, normalize
from jaxnerf.core.structs import check_shapes


def look_at(eye, target, up):
    """Returns the pose [3, 4] of a camera at eye [3] that looks to target [3].

    up [3] points upwards in the image. Where up is along the line of sight another axis takes its place.
    """
    eye, target, up = (jnp.asarray(value, jnp.float32) for value in (eye, target, up))
    check_shapes("look_at", eye=(eye, "3"), target=(target, "3"), up=(up, "3"))
    back = normalize(eye - target)
    right = jnp.cross(normalize(up), back)
    spare = jnp.cross(jnp.roll(back, 1), back)
    right = normalize(jnp.where(norm(right) > 1e-6, right, spare))  # shorter, it would be rounding alone
    return jnp.stack([right, jnp.cross(back, right), back, eye], axis=-1)


def turntable(num_frames, *, center, radius, elevation, up=(0.0, 0.0, 1.0)):
    """Returns poses [N, 3, 4] on a circle around center [3], looking at it.

    Args:
        num_frames: N, one turn.
        center: [3] world.
        radius: distance to the center, world units.
        elevation: radians above the plane across up.
        up: [3] the axis of the turn; unit length, not along x + 0.1 y.
    """
    center, up = jnp.asarray(center, jnp.float32), jnp.asarray(up, jnp.float32)
    first = normalize(jnp.cross(up, jnp.array([1.0, 0.1, 0.0])))
    second = jnp.cross(up, first)

    def pose(angle):
        around = jnp.cos(angle) * first + jnp.sin(angle) * second
        eye = center + radius * (math.cos(elevation) * around + math.sin(elevation) * up)
        return look_at(eye, center, up)

    return jax.vmap(pose)(2 * math.pi * jnp.arange(num_frames) / num_frames)
