"""Camera poses: one that looks at a point, and paths of many; directions spread over the sphere.

Camera axes are x right, y up, looking along -z. A path is poses [N, 3, 4], camera to world, in float32.
"""

import math

import jax
import jax.numpy as jnp
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Array, ArrayLike, Float, Num

from jaxnerf.core.safe_math import norm, normalize
from jaxnerf.core.types import Vector, check_shapes, is_known


def turntable(
    num_frames: int,
    *,
    center: Vector,
    radius: Num[ArrayLike, ""],
    elevation: float,
    up: Vector = (0.0, 0.0, 1.0),
) -> Float[Array, "N 3 4"]:
    """Places cameras on a circle around a point, looking at it.

    Args:
        num_frames: N, one turn.
        center: [3] world.
        radius: distance to the center, world units.
        elevation: radians above the plane through the center that is perpendicular to up.
        up: [3] axis of the circle, any length > 0.

    Returns:
        Poses [N, 3, 4].
    """
    center, radius, up = (jnp.asarray(value, jnp.float32) for value in (center, radius, up))
    check_shapes("turntable", center=(center, "3"), up=(up, "3"), radius=(radius, ""))
    if is_known(radius <= 0):
        raise ValueError(f"turntable: radius is {radius}, expected more than 0")
    up = normalize(up)
    across = jnp.cross(up, jnp.array([1.0, 0.1, 0.0]))
    first = normalize(jnp.where(norm(across) > 1e-3, across, jnp.cross(up, jnp.array([0.0, 1.0, 0.0]))))
    flat = radius * math.cos(elevation)
    middle = center + radius * math.sin(elevation) * up
    angle = 2 * math.pi * jnp.arange(num_frames)[:, None] / num_frames
    eyes = middle[None] + jnp.cos(angle) * (flat * first)[None] + jnp.sin(angle) * (flat * jnp.cross(up, first))[None]
    return jax.vmap(lambda eye: look_at(eye, center, up))(eyes)


def spiral(
    num_frames: int,
    *,
    pose: Num[ArrayLike, "3 4"],
    radii: Vector,
    focus: Num[ArrayLike, ""],
) -> Float[Array, "N 3 4"]:
    """Places cameras on a spiral around one pose, looking at a point in front of it.

    This is the path of the LLFF code (Mildenhall et al. 2019): the camera circles twice in the plane perpendicular to
    the viewing direction and oscillates once along that direction.

    Args:
        num_frames: N.
        pose: [3, 4] the pose in the middle of the path.
        radii: [3] amplitudes along the pose's x, y and z, world units.
        focus: distance from the pose to the point that all cameras look at, world units.

    Returns:
        Poses [N, 3, 4].
    """
    pose, radii = jnp.asarray(pose, jnp.float32), jnp.asarray(radii, jnp.float32)
    check_shapes("spiral", pose=(pose, "3 4"), radii=(radii, "3"))
    target = pose[:, 3] - focus * pose[:, 2]

    def pose_at(angle):
        around = jnp.stack([jnp.cos(angle), -jnp.sin(angle), -jnp.sin(angle / 2)]) * radii
        return look_at(pose[:, 3] + (pose[:, :3] * around[None]).sum(axis=-1), target, pose[:, 1])

    return jax.vmap(pose_at)(4 * math.pi * jnp.arange(num_frames) / num_frames)


def interpolate(num_frames: int, *, poses: Num[ArrayLike, "K 3 4"], closed: bool = False) -> Float[Array, "N 3 4"]:
    """Interpolates between poses in their order, with equally many frames between each two.

    Positions follow a Catmull-Rom spline (1974), which is straight where the poses are collinear and equally
    spaced. Rotations follow the shorter great arc between neighbours (Shoemake 1985).

    Args:
        num_frames: N. The path passes through a pose where `path_times` is an integer.
        poses: [K, 3, 4], K >= 1.
        closed: whether the path returns from the last pose to the first. It then ends one frame before the first pose.

    Returns:
        Poses [N, 3, 4].
    """
    poses = jnp.asarray(poses, jnp.float32)
    check_shapes("interpolate", poses=(poses, "K 3 4"))
    before, here, after, beyond, fraction = _neighbours(num_frames, poses, closed)
    a, b, c, d = (pose[:, :, 3] for pose in (before, here, after, beyond))
    cubic = -a + 3 * b - 3 * c + d
    eyes = b + 0.5 * fraction * (c - a + fraction * (2 * a - 5 * b + 4 * c - d + fraction * cubic))
    start, end = (Rotation.from_matrix(pose[:, :, :3]) for pose in (here, after))
    turn = Rotation.from_rotvec(fraction * (start.inv() * end).as_rotvec())
    return jnp.concatenate([(start * turn).as_matrix(), eyes[:, :, None]], axis=-1)


def path_times(num_frames: int, num_knots: int, *, closed: bool = False) -> Float[Array, " N"]:
    """Computes the times of the frames of `interpolate`: k at pose k, k + 0.5 halfway to the next."""
    length = num_knots if closed else num_knots - 1
    return jnp.arange(num_frames) * (length / max(num_frames if closed else num_frames - 1, 1))


def mean_pose(poses: Num[ArrayLike, "N 3 4"]) -> Float[Array, "3 4"]:
    """Averages poses: the mean position, looking along the mean direction, with the mean up vector."""
    poses = jnp.asarray(poses, jnp.float32)
    check_shapes("mean_pose", poses=(poses, "N 3 4"))
    eye = poses[:, :, 3].mean(axis=0)
    return look_at(eye, eye - poses[:, :, 2].mean(axis=0), poses[:, :, 1].mean(axis=0))


def look_at(eye: Vector, target: Vector, up: Vector) -> Float[Array, "3 4"]:
    """Computes the pose of a camera that looks at a point.

    Args:
        eye: [3] position of the camera, world.
        target: [3] the point in the center of the image, world.
        up: [3] upwards in the image, any length > 0. If it is parallel to the viewing direction, within 1e-6
            radians, the coordinate axis after that of the direction's largest component replaces it: y after x, z
            after y, x after z. A traced target at the eye, to which no direction leads, makes the rotation 0.

    Returns:
        Pose [3, 4], camera to world, orthonormal also where up is nearly parallel to the viewing direction. The
        gradient is finite; it grows as the inverse of the angle between them, to 1e6, and is 0 with respect to an up
        that is replaced.
    """
    eye, target, up = (jnp.asarray(value, jnp.float32) for value in (eye, target, up))
    check_shapes("look_at", eye=(eye, "3"), target=(target, "3"), up=(up, "3"))
    if is_known((eye == target).all()):
        raise ValueError(f"look_at: eye and target are both {eye}, expected two points; move one of them")
    back = normalize(eye - target)
    right, largest = jnp.cross(normalize(up), back), jnp.arange(3) == jnp.abs(back).argmax()
    sine = norm(right)
    substitute = jnp.cross(jnp.roll(jnp.where(largest, back, 0), 1), back)
    right = normalize(jnp.where(sine > 1e-6, right, substitute))  # a shorter one is rounding error
    # Of a short one, rounding has changed the direction.
    right = jnp.where(sine > 1e-2, right, normalize(right - (right * back).sum() * back))
    return jnp.stack([right, jnp.cross(back, right), back, eye], axis=-1)


def spread_directions(count: int) -> list[tuple[float, float, float]]:
    """Returns unit vectors that are spread evenly over the sphere, on a golden spiral, from the top to the bottom."""
    golden = math.pi * (3 - math.sqrt(5))
    heights = [1 - (2 * step + 1) / count for step in range(count)]
    around = [math.sqrt(1 - height**2) for height in heights]
    return [
        (radius * math.cos(golden * step), radius * math.sin(golden * step), height)
        for step, (radius, height) in enumerate(zip(around, heights, strict=True))
    ]


def se3_exponential(twists: Float[ArrayLike, "*batch 6"]) -> Float[Array, "*batch 3 4"]:
    """Computes the rigid motions exp(twist) of SE(3) (Murray, Li and Sastry 1994, Eq. 2.36).

        R = 1 + a W + b W^2,  position = (1 + b W + c W^2) v,  W v = w x v,
        a = sin(s) / s,  b = (1 - cos(s)) / s^2,  c = (s - sin(s)) / s^3,  s = |w|

    Args:
        twists: [..., 6], the rotation w in radians along its axis, and the velocity v in world units.

    Returns:
        [..., 3, 4] rotation and translation; the identity for a twist of 0. Values and all derivatives are exact
        there, as a, b and c are power series in s^2 below s = 1.
    """
    twists = jnp.asarray(twists)
    check_shapes("se3_exponential", twists=(twists, "... 6"))
    turn, velocity = twists[..., :3], twists[..., 3:]
    square = (turn**2).sum(axis=-1)[..., None]
    is_small = square < 1
    small, large = jnp.where(is_small, square, 0), jnp.where(is_small, 1, square)
    angle = jnp.sqrt(large)
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    a = jnp.where(is_small, _alternating(small, 1), sine / angle)
    b = jnp.where(is_small, _alternating(small, 2), (1 - cosine) / large)
    c = jnp.where(is_small, _alternating(small, 3), (angle - sine) / (angle * large))

    def apply(first, second, vector):
        once = jnp.cross(turn, vector)
        return vector + first * once + second * jnp.cross(turn, once)

    columns = [apply(a, b, jnp.broadcast_to(axis, turn.shape)) for axis in jnp.eye(3, dtype=turn.dtype)]
    return jnp.stack([*columns, apply(b, c, velocity)], axis=-1)


def _alternating(square, first):
    """Computes the series 1 / n! - x / (n + 2)! + x^2 / (n + 4)! - ..., n = first, of x in [0, 1] in float32."""
    total = jnp.zeros_like(square)
    for power in reversed(range(5)):
        total = 1 / math.factorial(first + 2 * power) - square * total
    return total


def _neighbours(num_frames, poses, closed):
    """Returns the four poses [N, 3, 4] around each frame, and its position [N, 1] between the middle two."""
    count = len(poses)
    times = path_times(num_frames, count, closed=closed)
    index = jnp.clip(jnp.floor(times).astype(int), 0, count - 1 if closed else max(count - 2, 0))
    fraction = times - index

    def at(step):
        return poses[(index + step) % count if closed else jnp.clip(index + step, 0, count - 1)]

    before, beyond = at(-1), at(2)
    if not closed:  # linear extrapolation past both ends
        before = jnp.where((index == 0)[:, None, None], 2 * at(0) - at(1), before)
        beyond = jnp.where((index >= count - 2)[:, None, None], 2 * at(1) - at(0), beyond)
    return before, at(0), at(1), beyond, fraction[:, None]
