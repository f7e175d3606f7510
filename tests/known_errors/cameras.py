"""Rows of cameras and poses; exact values by Newton's method from the known preimage, and the closed formulas."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxnerf
from jaxnerf import Camera, Rays
from known_errors.rows import Input, Row, rotations

SIZES = {"opencv": (0.1, 0.05, 0.01, 0.01, 0.02), "fisheye": (0.05, 0.02, 0.01, 0.002)}
HEIGHT, WIDTH = 300, 400
UP = Input((3,), "signed0", 0.1, 10)


def rows() -> list[Row]:
    """Returns the rows."""
    found = [
        Row("pixel_grid", "", {"unused": Input((), "uniform", 0, 1)}, _grid, _exact_grid, gradient=False),
        *(row for lens in ("pinhole", "opencv", "fisheye") for row in _of_lens(lens)),
        *_projective(),
        Row(
            "look_at",
            "",
            {name: Input((3,), "signed0", 1e-3, 1e3) for name in ("eye", "target")} | {"up": UP},
            lambda **given: _parts(jaxnerf.look_at(**given)),
            lambda **given: _parts(_look_at(**given)),
            whole=True,
            noise=1e-12,
        ),
        Row(
            "turntable",
            "",
            {
                "center": Input((3,), "signed0", 1e-3, 1e3),
                "radius": Input((), "log", 1e-3, 1e3),
                "up": UP,
            },
            lambda **given: _parts(jaxnerf.turntable(3, elevation=0.5, **given)),
            lambda **given: _parts(_turntable(**given)),
            prepare=_outside,
            whole=True,
            noise=1e-12,
        ),
        Row(
            "se3_exponential",
            "",
            {"turn": Input((3,), "signed0", 1e-12, 2.0), "velocity": Input((3,), "signed0", 1e-6, 1e3)},
            lambda turn, velocity: _parts(jaxnerf.se3_exponential(jnp.concatenate([turn, velocity]))),
            lambda turn, velocity: _parts(_exponential(turn, velocity)),
            whole=True,
        ),
    ]
    return found


def _parts(poses):
    """Returns rotations and positions."""
    return poses[..., :3], poses[..., 3]


def _outside(given):
    """Returns the inputs with a radius of at least the center's distance, whose rounding would turn the cameras."""
    return given | {"radius": given["radius"] + np.abs(given["center"]).max(axis=-1)}


def _grid(unused):
    return jaxnerf.pixel_grid(3, 5) + 0 * unused


def _exact_grid(unused):
    return jnp.array([[[j + 0.5, i + 0.5] for j in range(5)] for i in range(3)]) + 0 * unused


def _of_lens(lens):
    inputs = {
        "start": Input((2,), "signed0", 1e-4, 0.7),  # the preimage
        "focal": Input((2,), "log", 300, 3000),
        "center": Input((2,), "uniform", 0, 1000),
    }
    if lens != "pinhole":
        inputs["distortion"] = Input((len(SIZES[lens]),), "signed0", 1e-3, 1)
    pose = inputs | {"to_world": Input((3, 4), "signed", 1e-2, 1e2)}
    shared = {"prepare": functools.partial(_pixels, lens), "fixed": ("start",), "whole": True}
    place = {"prepare": functools.partial(_points, lens), "fixed": ("start",), "whole": True, "bfloat16": False}
    bend = functools.partial(functools.partial, lens=lens)
    found = [
        Row("undistort", lens, inputs, bend(_undistort), bend(_exact_undistort), **shared),
        Row("rays_from_pixels", lens, pose, bend(_rays), bend(_exact_rays), **shared),
        Row(
            "pixel_radius",
            lens,
            inputs,
            bend(_radius),
            bend(_exact_radius),
            gradient=lens == "pinhole",  # undistort has no second derivative
            **shared,
        ),
        Row(
            "project",
            lens,
            pose | {"depth": Input((), "log", 1e-3, 1e3)},
            bend(_project),
            bend(_exact_project),
            **place,
        ),
    ]
    # What the lenses add to a ray and to a pixel's area is what they add to undistort.
    skipped = {"pinhole": ("undistort",), "opencv": ("rays_from_pixels", "pixel_radius"), "fisheye": ()}
    return [row for row in found if row.name not in skipped[lens]]


def _bend(lens, k, point):
    """The lenses' models, in numpy or jax; point is a pair of arrays, k has the coefficients first."""
    x, y = point
    square = x * x + y * y
    if lens == "pinhole":
        return x, y
    if lens == "fisheye":
        stretch = 1 + k[0] * square + k[1] * square**2 + k[2] * square**3 + k[3] * square**4
        return x * stretch, y * stretch
    radial = 1 + k[0] * square + k[1] * square**2 + k[4] * square**3
    return (
        x * radial + 2 * k[2] * x * y + k[3] * (square + 2 * x * x),
        y * radial + 2 * k[3] * x * y + k[2] * (square + 2 * y * y),
    )


def _prepare(lens, given):
    """Returns the inputs with rotations, and their coefficients, which are first."""
    given = dict(given)
    if lens != "pinhole":
        given["distortion"] = given["distortion"] * np.array(SIZES[lens])
    if "to_world" in given:
        given["to_world"] = np.concatenate([rotations(given["to_world"][..., :3]), given["to_world"][..., 3:]], -1)
    given = {name: value.astype(np.float32).astype(np.float64) for name, value in given.items()}
    return given, np.moveaxis(given["distortion"], -1, 0) if lens != "pinhole" else ()


def _pixels(lens, given):
    given, k = _prepare(lens, given)
    image = np.stack(_bend(lens, k, tuple(given["start"].T)), axis=-1)
    return given | {"pixels": image * given["focal"] + given["center"]}


def _points(lens, given):
    given, _ = _prepare(lens, given)
    start, depth = given["start"], given.pop("depth")[:, None]
    if lens == "fisheye":
        angle = np.linalg.norm(start, axis=-1, keepdims=True) + 1e-30
        start = start * np.tan(angle) / angle
    local = np.concatenate([start[:, :1], -start[:, 1:], -np.ones_like(depth)], axis=-1) * depth
    return given | {"x": np.einsum("nij,nj->ni", given["to_world"][..., :3], local) + given["to_world"][..., 3]}


def _camera(lens, given):
    pose = jnp.concatenate([jnp.eye(3), jnp.zeros((3, 1))], axis=1)
    rest = {"focal": given["focal"], "center": given["center"], "distortion": given.get("distortion")}
    return Camera(to_world=given.get("to_world", pose), lens=lens, height=HEIGHT, width=WIDTH, **rest)


def _undistort(lens, **given):
    return jaxnerf.undistort(_camera(lens, given), given["pixels"])[0]


def _rays(lens, **given):
    rays = jaxnerf.rays_from_pixels(_camera(lens, given), given["pixels"], near=1.0, far=2.0)
    return rays.directions, rays.viewdirs, rays.far


def _radius(lens, **given):
    return jaxnerf.pixel_radius(_camera(lens, given), given["pixels"])


def _project(lens, **given):
    return jaxnerf.project(_camera(lens, given), given["x"])


def _exact_undistort(lens, pixels, focal, center, distortion=None, start=None):
    target = (pixels - center) / focal
    if lens == "pinhole":
        return target
    forward = lambda point: jnp.stack(_bend(lens, distortion, (point[0], point[1])))  # noqa: E731
    point = start
    for _ in range(3):  # of second order, from 1e-2 away where inputs are bfloat16
        point = jax.lax.stop_gradient(point)  # at the solution the derivative of the last step is that of all
        (a, b), (c, d) = jax.jacfwd(forward)(point)
        x, y = forward(point) - target
        point = point - jnp.stack([d * x - b * y, a * y - c * x]) / (a * d - b * c)
    return point if lens == "opencv" else point * _tangent((point**2).sum())


def _tangent(square):
    """tan(s) / s of s^2, by its series below 0.01."""
    angle = jnp.sqrt(jnp.where(square > 1e-4, square, 1))
    series = 1 + square / 3 + 2 * square**2 / 15 + 17 * square**3 / 315 + 62 * square**4 / 2835
    return jnp.where(square > 1e-4, jnp.tan(angle) / angle, series)


def _exact_rays(lens, to_world, **given):
    x, y = _exact_undistort(lens, **given)
    directions = to_world[:, :3] @ jnp.stack([x, -y, -jnp.ones_like(x)])
    return directions, directions / jnp.sqrt((directions**2).sum()), jnp.full((), 2.0)


def _exact_radius(lens, **given):
    def direction(pixels):
        x, y = _exact_undistort(lens, **given | {"pixels": pixels})
        return jnp.stack([x, -y, -jnp.ones_like(x)])

    right, down = jax.jacfwd(direction)(given["pixels"]).T
    return 2 / jnp.sqrt(12.0) * jnp.sqrt(jnp.abs(right[0] * down[1] - right[1] * down[0]))


def _exact_project(lens, x, to_world, focal, center, distortion=None, start=None):
    local = to_world[:, :3].T @ (x - to_world[:, 3])
    point = jnp.stack([local[0], -local[1]]) / -local[2]
    if lens == "fisheye":
        square = (point**2).sum()
        radius = jnp.sqrt(jnp.where(square > 1e-4, square, 1))
        series = 1 - square / 3 + square**2 / 5 - square**3 / 7 + square**4 / 9
        point = point * jnp.where(square > 1e-4, jnp.arctan(radius) / radius, series)
    return jnp.stack(_bend(lens, distortion, (point[0], point[1]))) * focal + center, -local[2]


def _projective():
    ray = {
        "origins": Input((3,), "signed0", 1e-3, 1e3),
        "directions": Input((3,), "signed", 1e-3, 1e3),
    }
    turned = {"prepare": lambda given: given | {"directions": given["directions"] * _forward(given["directions"])}}
    return [
        Row("ndc_rays", "", ray | {"focal": Input((2,), "log", 1e2, 1e4)}, _ndc, _exact_ndc, whole=True, **turned),
        Row("ndc_to_t", "", ray | {"t": Input((), "uniform", 0, 0.9999)}, _to_t, _exact_to_t, **turned),
    ]


def _forward(directions):
    """Factors that turn rays [N, 3] towards -z."""
    sign = np.where(directions[:, 2:] > 0, -1, 1)
    return np.concatenate([np.ones_like(directions[:, :2]), sign], axis=-1)


def _make(origins, directions):
    return Rays(origins=origins, directions=directions, viewdirs=directions, near=jnp.ones(()), far=jnp.ones(()))


def _ndc(origins, directions, focal):
    camera = Camera(to_world=jnp.eye(4)[:3], focal=focal, center=focal, height=HEIGHT, width=WIDTH)
    found = jaxnerf.ndc_rays(_make(origins, directions), camera)
    return found.origins, found.directions


def _exact_ndc(origins, directions, focal):
    """Eqs. 25 and 26 at the origin moved to the near plane."""
    along = jnp.where(directions[2] < 0, directions[2], jnp.nan)
    shift = -(1 + origins[2]) / along
    ox, oy = origins[0] + shift * directions[0], origins[1] + shift * directions[1]
    ax, ay = 2 * focal[0] / WIDTH, 2 * focal[1] / HEIGHT
    origin = jnp.stack([ax * ox, ay * oy, -jnp.ones_like(ox)])
    turn = jnp.stack([-ax * (directions[0] / along + ox), -ay * (directions[1] / along + oy), 2 * jnp.ones_like(ox)])
    return origin, turn


def _to_t(origins, directions, t):
    return jaxnerf.ndc_to_t(t, _make(origins, directions))


def _exact_to_t(origins, directions, t):
    along = jnp.where(directions[2] < 0, directions[2], jnp.nan)
    return (1 / (1 - t) + origins[2]) / -along


def _unit(vector):
    return vector / jnp.sqrt((vector**2).sum())


def _look_at(eye, target, up):
    back = _unit(eye - target)
    right = jnp.cross(_unit(up), back)
    sine = jnp.sqrt((right**2).sum())
    right = right / jnp.where(sine > 1e-2, sine, jnp.nan)  # below, all depends on the last digits
    return jnp.stack([right, jnp.cross(back, right), back, eye], axis=-1)


def _turntable(center, radius, up):
    up = _unit(up)
    across = jnp.cross(up, jnp.array([1.0, 0.1, 0.0]))
    # Of a shorter one, rounding may decide that it is replaced.
    first = _unit(jnp.where((across**2).sum() > 1e-3, across, jnp.nan))
    second = jnp.cross(up, first)
    angle = 2 * jnp.pi * jnp.arange(3)[:, None] / 3
    around = jnp.cos(angle) * first + jnp.sin(angle) * second
    eyes = center + radius * (jnp.sin(0.5) * up + jnp.cos(0.5) * around)
    return jax.vmap(lambda eye: _look_at(eye, center, up))(eyes)


def _exponential(turn, velocity):
    """The power series of the matrix over 16, squared four times."""
    x, y, z = turn
    zero = jnp.zeros_like(x)
    top = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    matrix = jnp.concatenate([jnp.concatenate([top, velocity[:, None]], axis=1), jnp.zeros((1, 4))]) / 16
    total = term = jnp.eye(4)
    for power in range(1, 16):
        term = term @ matrix / power
        total = total + term
    for _ in range(4):
        total = total @ total
    return total[:3]
