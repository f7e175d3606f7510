"""The embedded scene: a still life in closed form, inside the box +-1.2.

A striped pillar, a banded ring, a block of blue glass and a polished ball stand on a checked plinth. A lamp, a
dark core in amber glass, floats above them. Only the ball's colour depends on the direction.

A body is a signed distance d (negative inside), a peak density and a colour. Its density is
peak * sigmoid(-d / width), thin enough for a crisp outline and smooth enough for a quadrature to converge.
All arithmetic is on the components of x, [..., S] each, where no small constant has to be broadcast. The bodies take
arrays of JAX or of numpy; those of numpy, in float64, give the same bits on every machine.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.core.types import check_shapes
from jaxnerf.tools.embedded_scene import portable_math

_LIGHT = (0.48, -0.36, 0.80)  # the direction that it comes from
WIDTH = 0.015  # world units, over which a body's density falls at its outline

Positions = Float[ArrayLike, "*batch samples 3"]
Directions = Float[ArrayLike, "*batch #samples 3"]
Output = tuple[Float[Array, "*batch samples"], Float[Array, "*batch samples 3"]]


class Body(NamedTuple):
    """A body of the still life.

    Attributes:
        peak: density inside, 1 / world unit.
        lower, upper: [3] corners of a box that contains it.
        distance: (x, y, z) -> signed distance [...] from its outline, or a lower bound outside.
        colour: (x, y, z, direction) -> three channels [...]; direction is None without highlights.
    """

    peak: float
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    distance: Callable[..., Array]
    color: Callable[..., tuple[Array, Array, Array]]

    def density(self, distance: Float[ArrayLike, "*batch"]) -> Float[Array, "*batch"]:
        """Returns the density at signed distances [...] from the outline."""
        return self.peak * _sigmoid(-distance / WIDTH)


def still_life(x: Positions, viewdirs: Directions) -> Output:
    """Returns the density and the colour of the still life.

    Args:
        x: [..., S, 3] world units, z up.
        viewdirs: [..., 1 or S, 3] unit length, from the camera into the scene.

    Returns:
        density [..., S] in 1 / world unit, at most 50 in a single body; rgb [..., S, 3] in [0, 1]. In empty
        space the colour is a mean of all bodies', which no ray shows. Gradients are finite everywhere.
    """
    pattern = "... 1 3" if jnp.shape(viewdirs)[-2:-1] == (1,) else "... S 3"
    check_shapes("still_life", x=(x, "... S 3"), viewdirs=(viewdirs, pattern))
    x, viewdirs = jnp.asarray(x), jnp.asarray(viewdirs)
    place = x[..., 0], x[..., 1], x[..., 2]
    direction = viewdirs[..., 0], viewdirs[..., 1], viewdirs[..., 2]
    density, total_part, rgb = 0.0, 0.0, (0.0, 0.0, 0.0)
    for body in BODIES:
        density_of_body = body.density(body.distance(*place))
        color = body.color(*place, direction)
        # Far from all bodies the densities are 0 in float32. The tiny part keeps the colour from being 0 / 0,
        # and its square, which the gradient divides by, from being 0.
        part = density_of_body + 1e-12
        density, total_part = density + density_of_body, total_part + part
        rgb = tuple(total + part * value for total, value in zip(rgb, color, strict=True))
    # Without the barrier XLA fuses all bodies into the loop that stacks: on a CPU twice as slow.
    rgb = jax.lax.optimization_barrier([total / total_part for total in rgb])
    return density, jnp.stack(rgb, axis=-1)


def _plinth_place(x, y, z):
    """Returns z from its middle, and the distances from its side and from its faces."""
    z = z + 0.71
    return z, _norm(x, y) - 0.98, abs(z) - 0.10


def _plinth(x, y, z):
    _, side, face = _plinth_place(x, y, z)
    return _namespace(side).maximum(side, face)


def _plinth_color(x, y, z, direction):
    z, side, face = _plinth_place(x, y, z)
    checks = _step(_wave(x / 0.68) * _wave(y / 0.68), 0.08)
    on_face = _step(face - side, 0.02)
    top = _mix((0.07, 0.13, 0.30), (0.98, 0.62, 0.18), checks)
    rim = _mix((0.16, 0.10, 0.09), (0.85, 0.16, 0.10), _step(0.035 - abs(z), 0.008))
    shade = 0.55 + 0.45 * _step(z, 0.03)
    return _scale(_mix(rim, top, on_face), shade)


def _pillar_place(x, y, z):
    """Returns x, y and z from its middle, and z from the nearest point of its axis."""
    x, y, z = x + 0.40, y - 0.46, z + 0.02
    return x, y, z, z - _namespace(z).clip(z, -0.4, 0.64)


def _pillar(x, y, z):
    x, y, _, cap = _pillar_place(x, y, z)
    return _norm(x, y, cap) - 0.24


def _pillar_color(x, y, z, direction):
    x, y, z, cap = _pillar_place(x, y, z)
    turn = z / 0.60  # one stripe winds round once in 0.6 units
    stripes = _step((x * _wave(turn + 0.25) + y * _wave(turn)) / _norm(x, y), 0.12)
    color = _mix((0.02, 0.36, 0.25), (0.95, 0.86, 0.25), stripes)
    return _scale(color, _lambert(x, y, cap))


def _ring_place(x, y, z):
    """Returns positions along the ring's plane, across it and upwards, and the distance from its axis."""
    x, y, z = x - 0.48, y - 0.36, z + 0.04
    along, across = 0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y  # its axis is horizontal: across
    return along, across, z, _norm(along, z)


def _ring(x, y, z):
    _, across, _, spoke = _ring_place(x, y, z)
    return _norm(spoke - 0.42, across) - 0.16


def _ring_color(x, y, z, direction):
    along, across, z, spoke = _ring_place(x, y, z)
    ratio, tube = along / spoke, spoke - 0.42
    double = 2 * ratio * ratio - 1  # cos 2a, and cos 6a = 4 cos^3 2a - 3 cos 2a: six bands
    bands = _step((4 * double * double - 3) * double, 0.2)
    color = _mix((0.32, 0.05, 0.42), (0.25, 0.78, 0.85), bands)
    outward = tube / spoke * along
    normal = 0.8 * outward + 0.6 * across, 0.8 * across - 0.6 * outward, tube / spoke * z
    return _scale(color, _lambert(*normal))


def _brick(x, y, z):
    squares = [value * value for value in (x - 0.42, y + 0.42, z + 0.29)]
    sqrt = _namespace(x).sqrt
    # The norm whose unit ball is a rounded cube.
    return sqrt(sqrt(sum(square * square for square in squares) + 1e-12)) - 0.33


def _lamp_place(x, y, z):
    return x - 0.22, y + 0.10, z - 0.62


def _lamp_core_color(x, y, z, direction):
    return _scale((0.45, 0.02, 0.10), _lambert(*_lamp_place(x, y, z)))


def _ball_place(x, y, z):
    return x + 0.38, y + 0.38, z + 0.18


def _ball_color(x, y, z, direction):
    """Returns the colour with the highlight of Blinn and Phong."""
    normal = _ball_place(x, y, z)
    base = _scale((0.70, 0.05, 0.08), _lambert(*normal))
    if direction is None:
        return base
    # Brightest where the normal halves the angle between light and camera.
    halfway = tuple(towards - away for towards, away in zip(_LIGHT, direction, strict=True))
    aligned = sum(a * b for a, b in zip(normal, halfway, strict=True)) / (_norm(*normal) * _norm(*halfway))
    eighth = _square(_square(_square(_namespace(aligned).maximum(aligned, 0.0))))  # products, whose bits are defined
    highlight = 0.9 * (eighth * _square(eighth))
    return tuple(value + highlight * (1 - value) for value in base)


def _sphere(place, radius):
    """Returns the distance of a body whose middle is where `place` is 0."""
    return lambda x, y, z: _norm(*place(x, y, z)) - radius


def _plain(*color):
    """Returns the colour of a body that has the same one everywhere."""
    return lambda x, y, z, direction: color


def _lambert(x, y, z):
    """Returns the brightness of a matt surface with its normal along (x, y, z), softened on the dark side."""
    facing = (x * _LIGHT[0] + y * _LIGHT[1] + z * _LIGHT[2]) / _norm(x, y, z)
    softened = 0.5 + 0.5 * facing
    return 0.35 + 0.65 * softened * softened


def _norm(*components):
    # 1e-12 keeps the gradient finite on an axis; 1e-6 units are far below a pixel.
    return _namespace(components[0]).sqrt(sum(component * component for component in components) + 1e-12)


def _wave(turns):
    """Returns a sine of turns made of parabolas: the same zeros and peaks, several times faster."""
    part = turns - _namespace(turns).round(turns)
    return 8 * part * (1 - 2 * abs(part))


def _step(value, softness):
    return _sigmoid(value / softness)


def _mix(first, second, fraction):
    return tuple(a + (b - a) * fraction for a, b in zip(first, second, strict=True))


def _scale(color, factor):
    return tuple(value * factor for value in color)


def _namespace(x):
    return np if isinstance(x, np.ndarray) else jnp


def _sigmoid(x):
    return portable_math.sigmoid(x) if isinstance(x, np.ndarray) else jax.nn.sigmoid(x)


def _square(x):
    return x * x


BODIES = (
    Body(50.0, (-0.98, -0.98, -0.81), (0.98, 0.98, -0.61), _plinth, _plinth_color),
    Body(50.0, (-0.64, 0.22, -0.66), (-0.16, 0.70, 0.86), _pillar, _pillar_color),
    Body(50.0, (-0.02, -0.06, -0.62), (0.98, 0.78, 0.54), _ring, _ring_color),
    Body(3.5, (0.09, -0.75, -0.62), (0.75, -0.09, 0.04), _brick, _plain(0.05, 0.25, 0.80)),
    Body(50.0, (0.07, -0.25, 0.47), (0.37, 0.05, 0.77), _sphere(_lamp_place, 0.15), _lamp_core_color),
    Body(2.5, (-0.14, -0.46, 0.26), (0.58, 0.26, 0.98), _sphere(_lamp_place, 0.36), _plain(0.98, 0.50, 0.05)),
    Body(50.0, (-0.82, -0.82, -0.62), (0.06, 0.06, 0.26), _sphere(_ball_place, 0.44), _ball_color),
)
