"""Camera poses: one that looks at a point, and paths of many.

Camera axes are x right, y up, looking along -z. A path is poses [N, 3, 4], camera to world, in float32.
"""

import math

import jax
import jax.numpy as jnp

from jaxnerf.core.safe_math import norm, normalize
from jaxnerf.core.types import check_shapes


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
    flat = radius * math.cos(elevation)
    axes = jnp.stack([flat * first, flat * jnp.cross(up, first)])
    middle = center + radius * math.sin(elevation) * up
    return ellipse(num_frames, middle=middle, axes=axes, target=center, up=up)


def ellipse(num_frames, *, middle, axes, target, up):
    """Returns poses [N, 3, 4] on an ellipse, all looking at one point.

    Args:
        num_frames: N, one turn, which begins at middle + axes[0] and goes on towards middle + axes[1].
        middle: [3] of the ellipse, world.
        axes: [2, 3] half axes, world units.
        target: [3] what is looked at, world.
        up: [3] upwards in the images.
    """
    middle, axes, target, up = (jnp.asarray(value, jnp.float32) for value in (middle, axes, target, up))
    check_shapes("ellipse", middle=(middle, "3"), axes=(axes, "2 3"), target=(target, "3"), up=(up, "3"))
    angle = 2 * math.pi * jnp.arange(num_frames)[:, None] / num_frames
    eyes = middle[None] + jnp.cos(angle) * axes[:1] + jnp.sin(angle) * axes[1:]
    return jax.vmap(lambda eye: look_at(eye, target, up))(eyes)


def spiral(num_frames, *, pose, radii, focus, rotations=2, zrate=0.5):
    """Returns poses [N, 3, 4] that wind around one pose and look at a point before it.

    The path of the LLFF code (Mildenhall et al. 2019): while the eye circles across the line of sight it
    goes to and fro along it. It is closed where rotations * zrate is a whole number.

    Args:
        num_frames: N.
        pose: [3, 4] in the middle of the path.
        radii: [3] how far the eye goes along the pose's x, y and z, world units.
        focus: how far before the pose the point lies, world units.
        rotations: circles in all.
        zrate: goings to and fro in a circle.
    """
    pose, radii = jnp.asarray(pose, jnp.float32), jnp.asarray(radii, jnp.float32)
    check_shapes("spiral", pose=(pose, "3 4"), radii=(radii, "3"))
    target = pose[:, 3] - focus * pose[:, 2]

    def pose_at(angle):
        around = jnp.stack([jnp.cos(angle), -jnp.sin(angle), -jnp.sin(zrate * angle)]) * radii
        return look_at(pose[:, 3] + (pose[:, :3] * around[None]).sum(axis=-1), target, pose[:, 1])

    return jax.vmap(pose_at)(2 * math.pi * rotations * jnp.arange(num_frames) / num_frames)


def interpolate(num_frames, *, poses, closed=False):
    """Returns poses [N, 3, 4] that pass through others in their order, each step taking as many frames.

    Positions follow a Catmull-Rom spline (1974), which is straight where the poses stand in a line at even
    distances; each rotation turns about one axis to the next (Shoemake 1985), the shorter way.

    Args:
        num_frames: N. A pose is met exactly where path_times has a whole number.
        poses: [K, 3, 4], K >= 1.
        closed: whether the path goes on from the last pose to the first, where it ends one frame short.
    """
    poses = jnp.asarray(poses, jnp.float32)
    check_shapes("interpolate", poses=(poses, "K 3 4"))
    before, here, after, beyond, part = _neighbours(num_frames, poses, closed)
    a, b, c, d = (pose[:, :, 3] for pose in (before, here, after, beyond))
    cubic = -a + 3 * b - 3 * c + d
    eyes = b + 0.5 * part * (c - a + part * (2 * a - 5 * b + 4 * c - d + part * cubic))
    rotations = _slerp(here[:, :, :3], after[:, :, :3], part[:, 0])
    return jnp.concatenate([rotations, eyes[:, :, None]], axis=-1)


def path_times(num_frames, num_knots, *, closed=False):
    """Returns [N] float32, when interpolate has each frame: k at the pose k, k + 0.5 halfway to the next."""
    length = num_knots if closed else num_knots - 1
    return jnp.arange(num_frames) * (length / max(num_frames if closed else num_frames - 1, 1))


def mean_pose(poses):
    """Returns the pose [3, 4] in the mean of poses [N, 3, 4]: position, line of sight and up averaged."""
    poses = jnp.asarray(poses, jnp.float32)
    check_shapes("mean_pose", poses=(poses, "N 3 4"))
    eye = poses[:, :, 3].mean(axis=0)
    return look_at(eye, eye - poses[:, :, 2].mean(axis=0), poses[:, :, 1].mean(axis=0))


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


def _neighbours(num_frames, poses, closed):
    """Returns poses [N, 3, 4] before, at, after and beyond each frame, and the part [N, 1] of its step."""
    count = len(poses)
    times = path_times(num_frames, count, closed=closed)
    index = jnp.clip(jnp.floor(times).astype(int), 0, count - 1 if closed else max(count - 2, 0))
    part = times - index

    def at(step):
        return poses[(index + step) % count if closed else jnp.clip(index + step, 0, count - 1)]

    before, beyond = at(-1), at(2)
    if not closed:  # past the ends the path goes on as it was: its first and last piece bend only inwards
        before = jnp.where((index == 0)[:, None, None], 2 * at(0) - at(1), before)
        beyond = jnp.where((index >= count - 2)[:, None, None], 2 * at(1) - at(0), beyond)
    return before, at(0), at(1), beyond, part[:, None]


def _slerp(start, end, part):
    """Returns the rotations [N, 3, 3] a part [N] of the way from one to another."""
    first, second = _quaternion(start), _quaternion(end)
    cosine = (first * second).sum(axis=-1)
    second = jnp.where((cosine < 0)[:, None], -second, second)  # both mean the same rotation
    angle = 2 * jnp.arctan2(norm(second - first), norm(second + first))  # arccos of nearly 1 would be coarse
    # sin(p x) / sin(x), as a quotient of sincs: p where x is 0. The angle is at most a quarter turn.
    whole = jnp.sinc(angle / math.pi)

    def share(p):
        return (p * jnp.sinc(p * angle / math.pi) / whole)[:, None]

    return _rotation(normalize(share(1 - part) * first + share(part) * second))


def _quaternion(rotation):
    """Returns [N, 4] (w, x, y, z) of rotations [N, 3, 3]."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = jnp.moveaxis(rotation, 0, -1)
    products = jnp.array(  # 4 q q^T: every row is q at another length
        [
            [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
        ]
    )
    longest = jnp.argmax(jnp.diagonal(products), axis=-1)
    return normalize(jnp.moveaxis(products, -1, 0)[jnp.arange(len(rotation)), longest])


def _rotation(quaternion):
    """Returns the rotations [N, 3, 3] of unit quaternions [N, 4]."""
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.moveaxis(jnp.array(rows), -1, 0)
