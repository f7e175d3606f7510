"""Cameras: pixels, lenses, rays and their projective (NDC) form.

Camera axes are x right, y up, looking along -z. Image axes are x right, y down. An unknown lens is a ValueError.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Num

from jaxnerf.core.safe_math import at_least_float32, divide, norm, normalize
from jaxnerf.core.types import Camera, Rays, broadcast, check_order, check_shapes

# Degrees from the axis of a fisheye up to which directions reach the plane at distance 1. Those beyond, also backwards,
# end on the sphere through that plane's circle at this angle.
_SIDEWAYS = math.radians(80)


def pixel_grid(height: int, width: int, *, offset: float = 0.5) -> Float[Array, "H W 2"]:
    """Computes the (x, y) of every pixel, in px from the top left corner of the image.

    Args:
        height: px.
        width: px.
        offset: the point in the pixel's square that its ray passes through. 0.5 is the centre; the 2020 code
            uses 0.

    Returns:
        [H, W, 2].
    """
    x, y = jnp.meshgrid(jnp.arange(width) + offset, jnp.arange(height) + offset, indexing="xy")
    return jnp.stack([x, y], axis=-1).astype(jnp.float32)


def undistort(
    camera: Camera, pixels: Num[ArrayLike, "*batch 2"]
) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
    """Computes where the rays through distorted pixels cross the plane at distance 1.

    Inverts the lens model (Brown 1966; Kannala and Brandt 2006) by Newton's method. The gradient with respect
    to pixels, focal, center and distortion is that of the exact inverse: one differentiable Newton
    step from the solution. It has no second derivative.

    Args:
        camera: one Camera. Its lens is "pinhole"; "opencv" with distortion (k1, k2, p1, p2) or
            (k1, k2, p1, p2, k3); or "fisheye" with the equidistant model's (k1, k2, k3, k4).
        pixels: [..., 2] px.

    Returns:
        points [..., 2], x right and y down, focal length 1; and converged [...]. A pixel outside
        the image of the lens, or that only points beyond a fold of the lens are seen in, has no preimage: its point
        is 0 and converged is False. A lens folds where its image, on the way from the axis to the point, stops
        growing, along the ray or across it: where the Jacobian's determinant is no longer positive. A fisheye's
        pixel at 90 degrees from the axis or beyond is flagged, too: its ray, see `rays_from_pixels`, does not cross
        that plane.
    """
    points, converged = _before_lens("undistort", camera, pixels)
    if _is_fisheye(camera):
        return _on_plane(points, converged & (norm(points) < 0.5 * math.pi))
    return points, converged


def _is_fisheye(camera):
    return camera.lens == "fisheye" and camera.distortion is not None


def _before_lens(function, camera, pixels):
    """Returns the points [..., 2] that the lens distorts, of a fisheye as long as their angle, and which exist."""
    pixels, focal, center = at_least_float32(pixels, camera.focal, camera.center)
    check_shapes(function, pixels=(pixels, "... 2"))
    _check_one(function, camera, "focal", "center")
    lead = (1,) * (pixels.ndim - 1)
    target = (pixels - center.reshape(*lead, 2)) / focal.reshape(*lead, 2)
    if camera.distortion is None or camera.lens == "pinhole":
        return target, jnp.ones(target.shape[:-1], bool)
    distort, distortion = _lens(function, camera)
    points, converged = jax.vmap(lambda goal: _invert(distort, distortion, goal))(target.reshape(-1, 2))
    return points.reshape(target.shape), converged.reshape(target.shape[:-1])


def _on_plane(points, inside):
    """Returns points as long as an angle from the axis as points at its tangent, 0 unless inside; and inside."""
    angle = jnp.where(inside, norm(points), 0)
    wide = angle > 1e-4  # below, the series is exact, and its derivative has no 0 / 0
    stretch = jnp.where(wide, jnp.tan(angle) / jnp.where(wide, angle, 1), 1 + angle**2 / 3)
    return jnp.where(inside[..., None], points * stretch[..., None], 0), inside


def _directions(function, camera, pixels):
    """Returns directions [..., 3] in the camera's axes through pixels [..., 2], along -z without one; which exist."""
    points, converged = _before_lens(function, camera, pixels)
    plane, ahead = points, converged
    if _is_fisheye(camera):
        angle = norm(points)
        converged &= angle < math.pi  # all around, a lens shows the point behind it
        plane, ahead = _on_plane(points, converged & (angle <= _SIDEWAYS))
    local = jnp.stack([plane[..., 0], -plane[..., 1], -jnp.ones_like(plane[..., 0])], axis=-1)
    if not _is_fisheye(camera):
        return local, converged
    beside = converged & ~ahead
    angle = jnp.where(beside, angle, _SIDEWAYS)
    across = points * (jnp.sin(angle) / angle)[..., None]
    around = jnp.stack([across[..., 0], -across[..., 1], -jnp.cos(angle)], axis=-1) / math.cos(_SIDEWAYS)
    return jnp.where(beside[..., None], around, local), converged


def rays_from_pixels(
    camera: Camera,
    pixels: Num[ArrayLike, "*batch 2"],
    *,
    near: Num[ArrayLike, "*#batch"] | Num[ArrayLike, "*views"],
    far: Num[ArrayLike, "*#batch"] | Num[ArrayLike, "*views"],
) -> Rays:
    """Computes the rays from a camera through pixels.

    Args:
        camera: one Camera, or several, whose poses are [V, 3, 4], or have more leading axes, and whose other arrays
            may be common to all.
        pixels: [..., 2] px, as from pixel_grid.
        near: scalar or [...] in t, which here is the distance along the camera's axis; or [V], one for each camera.
        far: as near.

    Returns:
        Rays [...], or [V, ...] of several cameras; directions reach the plane at distance 1 (not unit length), as in
        the released codes. Those of a fisheye that are more than 80 degrees from the axis, up to 180, have the length
        1 / cos 80 degrees, at which they are continuous. The ray of a pixel without a preimage has near = far and
        runs along the axis.

    Raises:
        ValueError: on other shapes, an unknown lens, or near > far where known at trace time.
    """
    pixels = jnp.asarray(pixels)
    check_shapes("rays_from_pixels", pixels=(pixels, "... 2"))
    if jnp.ndim(camera.to_world) > 2:
        return _rays_of_cameras(camera, pixels, near, far)
    _check_one("rays_from_pixels", camera, "to_world", "focal", "center")
    local, converged = _directions("rays_from_pixels", camera, pixels)
    to_world = jnp.asarray(camera.to_world)
    lead = (1,) * (pixels.ndim - 1)
    # Sums of products instead of a matmul, which may round the camera to ten bits.
    directions = (to_world[:, :3].reshape(*lead, 3, 3) * local[..., None, :]).sum(axis=-1)
    shape = pixels.shape[:-1]
    near, far = _bounds(directions.dtype, shape, near, far)
    return Rays(
        origins=jnp.broadcast_to(to_world[:, 3], directions.shape).astype(directions.dtype),
        directions=directions,
        viewdirs=normalize(directions),
        near=near,
        far=jnp.where(converged, far, near),
    )


def _rays_of_cameras(cameras, pixels, near, far):
    """Computes the Rays [V, ...] of cameras whose poses are [V, 3, 4], where V may be several axes."""
    count = jnp.shape(cameras.to_world)[:-2]
    flat = {}
    for name in ("to_world", "focal", "center", "distortion"):
        value = getattr(cameras, name)
        if value is not None:
            one = jnp.shape(value)[-2 if name == "to_world" else -1 :]
            flat[name] = broadcast("rays_from_pixels", (*count, *one), **{name: value})[0].reshape(-1, *one)
    rays = jax.vmap(lambda camera: rays_from_pixels(camera, pixels, near=0.0, far=1.0))(
        dataclasses.replace(cameras, **flat)
    )
    rays = jax.tree.map(lambda leaf: leaf.reshape(*count, *leaf.shape[1:]), rays)
    has_preimage, shape = rays.far > rays.near, rays.near.shape

    def of_rays(bound):
        bound = jnp.asarray(bound)
        return bound.reshape(*count, *(1,) * (pixels.ndim - 1)) if bound.shape == count else bound

    near, far = _bounds(rays.near.dtype, shape, of_rays(near), of_rays(far))
    return dataclasses.replace(rays, near=near, far=jnp.where(has_preimage, far, near))


def _bounds(dtype, shape, near, far):
    """Returns near and far of rays [*shape]; ValueError on other shapes, or where near is known to be beyond far."""
    near, far = (each.astype(dtype) for each in broadcast("rays_from_pixels", shape, near=near, far=far))
    check_order("rays_from_pixels", near=near, far=far)
    return near, far


def _check_one(function, camera, *names, call="lambda camera: {}(camera, ...)", arguments="cameras"):
    """Raises a ValueError, which says how several cameras are computed, unless a Camera's arrays are those of one."""
    for name in names:
        found, expected = jnp.shape(getattr(camera, name)), (3, 4) if name == "to_world" else (2,)
        if found != expected:
            several = f"for several, each array of which has a leading axis, call jax.vmap({call.format(function)})"
            advice = "drop the last row: to_world[:3]" if found == (4, 4) else f"{several}({arguments})"
            raise ValueError(
                f"{function}: the camera's {name} has shape {found}, expected {expected}, of one camera; {advice}"
            )


def pixel_radius(camera: Camera, pixels: Num[ArrayLike, "*batch 2"]) -> Float[Array, "*batch"]:
    """Computes the radius of the cone of each pixel's ray at t = 1 (arXiv:2103.13415, Section 3.1).

    It is 2 / sqrt(12) times the side of a square with the area of the pixel on the plane at distance 1: the disk then
    has the variance of the pixel. Multiplied by t it is the radius at x(t) of the rays of `rays_from_pixels`.

    Args:
        camera: one Camera (use jax.vmap for a stack).
        pixels: [..., 2] px, as from pixel_grid.

    Returns:
        [...] world units per t. For a lens it is that of the pixel's area on that plane, or on the sphere where a
        fisheye's directions end, see `rays_from_pixels`; 0 without a preimage.
    """
    (pixels,) = at_least_float32(pixels)
    check_shapes("pixel_radius", pixels=(pixels, "... 2"))
    _check_one("pixel_radius", camera, "focal", "center")
    steps = [jnp.broadcast_to(jnp.eye(2, dtype=pixels.dtype)[axis], pixels.shape) for axis in range(2)]
    directions = functools.partial(_directions, "pixel_radius", camera)
    right, down = (jax.jvp(lambda at: directions(at)[0], (pixels,), (step,))[1] for step in steps)
    area = jnp.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
    if _is_fisheye(camera):
        area = norm(jnp.cross(right, down))
    return jnp.where(area > 0, 2 / math.sqrt(12) * jnp.sqrt(jnp.where(area > 0, area, 1)), 0)


def project(camera: Camera, x: Num[ArrayLike, "*batch 3"]) -> tuple[Float[Array, "*batch 2"], Float[Array, "*batch"]]:
    """Projects points of the world into the image, the inverse of `rays_from_pixels` (Hartley and Zisserman 2004, 6.1).

    Args:
        camera: one Camera (use jax.vmap for a stack).
        x: [..., 3] world units.

    Returns:
        pixels [..., 2] px, (x, y); and depth [...] in world units along the camera's axis, > 0 in front,
        the t of rays_from_pixels, also where this is not along the axis, beside a fisheye. A point that the camera
        does not see, behind it or beyond a fold of the lens, see `undistort`, or so near the camera that the gradient
        of its pixel overflows, has pixels inf, with gradient 0.
    """
    x, to_world, focal, center = at_least_float32(x, camera.to_world, camera.focal, camera.center)
    check_shapes("project", x=(x, "... 3"))
    _check_one("project", camera, "to_world", "focal", "center")
    lead = (1,) * (x.ndim - 1)
    focal, center = (value.reshape(*lead, 2) for value in (focal, center))
    offset = x - to_world[:, 3].reshape(*lead, 3)
    # Sums of products instead of a matmul, which may round the camera to ten bits.
    local = (to_world[:, :3].reshape(*lead, 3, 3) * offset[..., None]).sum(axis=-2)
    depth = -local[..., 2]
    across = jnp.stack([local[..., 0], -local[..., 1]], axis=-1)
    ahead = jax.lax.stop_gradient(jnp.where(depth > 0, depth, 1))[..., None]
    steepest = focal * (1 + jnp.abs(jax.lax.stop_gradient(across) / ahead)) / ahead
    seen = (depth > 0) & jnp.isfinite(jax.lax.stop_gradient(steepest)).all(axis=-1)
    points = divide(across, jnp.broadcast_to(jnp.where(seen, depth, 1)[..., None], across.shape))
    if camera.distortion is not None and camera.lens != "pinhole":
        distort, distortion = _lens("project", camera)
        if camera.lens == "fisheye":
            radius = norm(points)
            wide = radius > 1e-4  # below, the series is exact, and its derivative has no 0 / 0
            angle = jnp.where(wide, jnp.arctan(radius) / jnp.where(wide, radius, 1), 1 - radius**2 / 3)
            points, depth, beside = _beside(across, depth, points * angle[..., None])
            seen |= beside
        flat = points.reshape(-1, 2)

        def has_image(point):
            return _growing(distort, distortion, point) & jnp.isfinite(distort(distortion, point)).all()

        seen &= jax.vmap(has_image)(jax.lax.stop_gradient(flat)).reshape(seen.shape)
        flat = jnp.where(seen.reshape(-1, 1), flat, 0)
        points = jax.vmap(lambda point: distort(distortion, point))(flat).reshape(points.shape)
    return jnp.where(seen[..., None], points * focal + center, jnp.inf), depth


def _beside(across, depth, points):
    """Returns points as long as the angle from the axis and t, also where a fisheye sees beside itself; and where."""
    radius = norm(across)
    near = radius < 1e-18  # of the type's smallest root: the gradient overflows there
    angle = jnp.arctan2(radius, jnp.where(near, 1, depth))
    beside = (angle > _SIDEWAYS) & ~near
    scale = jnp.where(beside, angle, 0) / jnp.where(beside, radius, 1)
    t = norm(jnp.stack([radius, depth], axis=-1)) * math.cos(_SIDEWAYS)
    return jnp.where(beside[..., None], across * scale[..., None], points), jnp.where(beside, t, depth), beside


def ndc_rays(rays: Rays, camera: Camera, *, near_plane: Num[ArrayLike, ""] = 1.0) -> Rays:
    """Transforms forward-facing rays to normalised device coordinates (Appendix C, Eqs. 25 and 26).

    The half space beyond the near plane z = -near_plane becomes a box, and t in [0, 1] runs
    from that plane to infinity, linear in disparity.

    Args:
        rays: Rays [...] in a world in which the cameras look roughly along -z.
        camera: the Camera, for its focal length and size.
        near_plane: distance in world units.

    Returns:
        Rays [...] with near 0 and far 1, the same viewdirs, time and image_index, and no radius, as the image of a
        cone is no cone. A ray that does not run towards -z, or is so
        nearly perpendicular to it that its position or gradient overflows, misses the box: near = far = 0.

    Raises:
        ValueError: if the camera's size is unknown, or on several cameras.
    """
    if camera.height is None or camera.width is None:
        raise ValueError("ndc_rays: the camera has no height and width, expected both in px; NDC depends on them")
    _check_one("ndc_rays", camera, "focal", call="{}", arguments="rays, cameras")
    focal = jnp.asarray(camera.focal)
    scale = 2 * focal / jnp.array([camera.width, camera.height], focal.dtype) / near_plane
    scale = scale.reshape(*(1,) * rays.near.ndim, 2)
    height = rays.origins[..., 2:]

    def lateral_and_slope(depth):
        # Computed from the given origin: moving it to the near plane first would subtract large terms.
        slant = divide(rays.directions[..., :2], jnp.broadcast_to(depth[..., None], (*depth.shape, 2)))
        lateral = scale * (rays.origins[..., :2] - (near_plane + height) * slant)
        return jnp.concatenate([lateral, scale * (height * slant - rays.origins[..., :2])], axis=-1)

    forward = rays.directions[..., 2] < 0
    depth = jnp.where(forward, rays.directions[..., 2], -1)
    slope = jax.lax.stop_gradient(lateral_and_slope(depth) / depth[..., None])  # with respect to depth, the steepest
    forward &= jnp.isfinite(slope).all(axis=-1)
    projected = lateral_and_slope(jnp.where(forward, rays.directions[..., 2], -1))
    plane = jnp.ones_like(projected[..., :1])
    return Rays(
        origins=jnp.concatenate([projected[..., :2], -plane], axis=-1),
        directions=jnp.concatenate([projected[..., 2:], 2 * plane], axis=-1),
        viewdirs=rays.viewdirs,
        near=jnp.zeros_like(plane[..., 0]),
        far=jnp.where(forward, plane[..., 0], 0),
        time=rays.time,
        image_index=rays.image_index,
    )


def ndc_to_t(
    t: Num[ArrayLike, "*batch"], rays: Rays, camera: Camera | None = None, *, near_plane: Num[ArrayLike, ""] = 1.0
) -> Float[Array, "*batch"]:
    """Converts t of NDC rays, such as a depth, to t of the world rays at the same points.

    Args:
        t: [...] in [0, 1], t of ndc_rays(rays, camera).
        rays: the world Rays [...] that went into ndc_rays.
        camera: unused, as the result does not depend on it; accepted for symmetry with ndc_rays.
        near_plane: as in ndc_rays.

    Returns:
        [...] in t of the world rays: at the near plane for 0, inf for 1, with gradient 0.
    """
    check_shapes("ndc_to_t", t=(t, "..."), near=(rays.near, "..."))
    depth = rays.directions[..., 2]
    shift = -(near_plane + rays.origins[..., 2]) / depth
    infinite = (t == 1) & (jnp.abs(depth) > 0)
    finite = shift - near_plane * t / (jnp.where(infinite, 1, 1 - t) * depth)
    return jnp.where(infinite, jnp.where(depth < 0, jnp.inf, -jnp.inf), finite)


def _lens(function, camera):
    """Returns the forward model distort(distortion, point) of a camera's lens, and its distortion."""
    distortion = jnp.asarray(camera.distortion)
    if (camera.lens, distortion.size) not in (("opencv", 4), ("opencv", 5), ("fisheye", 4)):
        raise ValueError(
            f"{function}: lens {camera.lens!r} with {distortion.size} coefficients, expected 'opencv' with 4 "
            "or 5 (k1, k2, p1, p2[, k3]) or 'fisheye' with 4 (k1, k2, k3, k4); pad with zeros"
        )
    return _brown if camera.lens == "opencv" else _equidistant, distortion


def _brown(distortion, point):
    """Applies the "opencv" lens: radial and tangential terms on the plane at distance 1 (Brown 1966)."""
    k1, k2, p1, p2 = distortion[:4]
    k3 = distortion[4] if distortion.size == 5 else 0.0
    x, y = point
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    return jnp.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + 2 * p2 * x * y + p1 * (square + 2 * y * y),
        ]
    )


def _equidistant(distortion, point):
    """Applies the "fisheye" lens to points whose length is the angle from the axis (Kannala and Brandt 2006)."""
    square = (point**2).sum()
    k1, k2, k3, k4 = distortion
    return point * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))


def _growing(distort, distortion, point):
    """Returns whether the image grows monotonically from the axis to a point [2]; a lens folds where it does not."""
    way = jnp.linspace(0, 1, 32, dtype=point.dtype)[:, None] * point[None]
    (a, b), (c, d) = jnp.moveaxis(jax.vmap(lambda at: jax.jacfwd(distort, argnums=1)(distortion, at))(way), 0, -1)
    # Not sums along an axis of length 2: XLA calls a library for that on a CPU, which is slow for so short an axis.
    x, y = normalize(point)
    along = x * (a * x + b * y) + y * (c * x + d * y)
    return ((along > 0) & (a * d - b * c > 0)).all() | (norm(point) == 0)


def _invert(distort, distortion, goal):
    """Returns the point [2] with distort(point) = goal [2], and whether it was found before a fold of the lens."""

    def newton(point, coefficients, goal):
        jacobian = jax.lax.stop_gradient(jax.jacfwd(distort, argnums=1)(distortion, point))
        (a, b), (c, d) = jacobian
        determinant = a * d - b * c
        x, y = distort(coefficients, point) - goal
        return point - jnp.stack([d * x - b * y, a * y - c * x]) / determinant, determinant

    fixed = jax.lax.stop_gradient(goal)
    start = jax.lax.stop_gradient(distortion)

    def follow(i, point):
        # The goal moves outwards from the axis: a start at the goal itself may lie beyond a fold of the lens.
        return newton(point, start, fixed * jnp.minimum((i + 1) / 24, 1))[0]

    point = jax.lax.fori_loop(0, 32, follow, jnp.zeros_like(fixed))
    residual = norm(distort(start, point) - fixed)
    tolerance = 8 * jnp.finfo(goal.dtype).eps * (1 + norm(fixed))
    converged = (residual <= tolerance) & _growing(distort, start, point)
    point = jax.lax.stop_gradient(jnp.where(converged, point, 0))
    refined, _ = newton(point, distortion, goal)
    return jnp.where(converged, refined, 0), converged
