"""The embedded scene: a still life in closed form, inside the box +-1.2.

A striped pillar, a banded ring, a block of blue glass and a polished ball stand on a checked plinth. A lamp, a
dark core in amber glass, floats above them. Only the ball's colour depends on the direction; in matt_still_life
no colour does, in shiny_still_life those of the pillar, the ring and the lamp's core do, too.

A body is a signed distance d (negative inside), a peak density and a colour. Its density is
peak * sigmoid(-d / width), thin enough for a crisp outline and smooth enough for a quadrature to converge.
All arithmetic is on the components of x, [..., S] each, where no small constant has to be broadcast.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.core.types import check_shapes

_POLISH, _SHEEN = 24, 6  # exponents of highlights: small and wide ones


Positions = Float[ArrayLike, "*batch samples 3"]
Directions = Float[ArrayLike, "*batch #samples 3"]
Output = tuple[Float[Array, "*batch samples"], Float[Array, "*batch samples 3"]]


def still_life(x: Positions, viewdirs: Directions) -> Output:
    """Returns the density and the colour of the still life.

    Args:
        x: [..., S, 3] world units, z up.
        viewdirs: [..., 1 or S, 3] unit length, from the camera into the scene.

    Returns:
        density [..., S] in 1 / world unit, at most 50 in a single body; rgb [..., S, 3] in [0, 1]. In empty
        space the colour is a mean of all bodies', which no ray shows. Gradients are finite everywhere.

    Raises:
        ValueError: on other shapes.
    """
    return _still_life(x, viewdirs, ball=True)


def matt_still_life(x: Positions, viewdirs: Directions) -> Output:
    """Returns the density and the colour of the still life with a matt ball: no colour depends on viewdirs."""
    return _still_life(x, viewdirs)


def shiny_still_life(x: Positions, viewdirs: Directions) -> Output:
    """Returns the density and the colour of the still life with highlights on all round opaque bodies."""
    return _still_life(x, viewdirs, ball=True, others=True)


def opaque_distance(x: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch"]:
    """Returns the signed distance [...] of x [..., 3] from the nearest opaque body, negative inside one.

    It is exact outside the bodies; their density is half its peak where it is 0.
    """
    return _nearest(x, (_plinth, _pillar, _ring, _lamp_core, _ball))


def glass_distance(x: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch"]:
    """Returns the signed distance [...] of x [..., 3] from the nearest transparent body, the brick or the lamp's glass.

    That from the brick is approximate, and 0 where it should be.
    """
    return _nearest(x, (_brick, _lamp_glass))


def _nearest(x, bodies):
    x = jnp.asarray(x)
    place = x[..., 0], x[..., 1], x[..., 2]
    distances = [body(*place, *(None,) * (body in (_pillar, _ring, _lamp_core, _ball)))[0] for body in bodies]
    return jnp.min(jnp.stack(distances), axis=0)


def _still_life(x, viewdirs, *, ball=False, others=False):
    """Returns the density and the colour; ball, others: whether these bodies have highlights."""
    pattern = "... 1 3" if jnp.shape(viewdirs)[-2:-1] == (1,) else "... S 3"
    check_shapes("still_life", x=(x, "... S 3"), viewdirs=(viewdirs, pattern))
    place = x[..., 0], x[..., 1], x[..., 2]
    direction = viewdirs[..., 0], viewdirs[..., 1], viewdirs[..., 2]
    on_others, on_ball = direction if others else None, direction if ball else None
    bodies = (
        _plinth(*place),
        _pillar(*place, on_others),
        _ring(*place, on_others),
        _brick(*place),
        _lamp_core(*place, on_others),
        _lamp_glass(*place),
        _ball(*place, on_ball),
    )
    width = 0.015
    density, total_part, rgb = 0.0, 0.0, (0.0, 0.0, 0.0)
    for distance, peak, colour in bodies:
        own = peak * jax.nn.sigmoid(-distance / width)
        # Far from all bodies the densities are 0 in float32. The tiny part keeps the colour from being 0 / 0,
        # and its square, which the gradient divides by, from being 0.
        part = own + 1e-12
        density, total_part = density + own, total_part + part
        rgb = tuple(total + part * value for total, value in zip(rgb, colour, strict=True))
    # Without the barrier XLA fuses all bodies into the loop that stacks: on a CPU twice as slow.
    rgb = jax.lax.optimization_barrier([total / total_part for total in rgb])
    return density, jnp.stack(rgb, axis=-1)


def _plinth(x, y, z):
    z = z + 0.71
    side, face = _norm(x, y) - 0.98, jnp.abs(z) - 0.10
    checks = _step(_wave(x / 0.68) * _wave(y / 0.68), 0.08)
    on_face = _step(face - side, 0.02)
    top = _mix((0.07, 0.13, 0.30), (0.98, 0.62, 0.18), checks)
    rim = _mix((0.16, 0.10, 0.09), (0.85, 0.16, 0.10), _step(0.035 - jnp.abs(z), 0.008))
    shade = 0.55 + 0.45 * _step(z, 0.03)
    return jnp.maximum(side, face), 50.0, _scale(_mix(rim, top, on_face), shade)


def _pillar(x, y, z, direction):
    x, y, z = x + 0.40, y - 0.46, z + 0.02
    radius = _norm(x, y)
    cap = z - jnp.clip(z, -0.4, 0.64)
    turn = z / 0.60  # one stripe winds round once in 0.6 units
    stripes = _step((x * _wave(turn + 0.25) + y * _wave(turn)) / radius, 0.12)
    colour = _mix((0.02, 0.36, 0.25), (0.95, 0.86, 0.25), stripes)
    return _norm(x, y, cap) - 0.24, 50.0, _shaded(colour, (x, y, cap), direction, _SHEEN)


def _ring(x, y, z, direction):
    x, y, z = x - 0.48, y - 0.36, z + 0.04
    along, across = 0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y  # its axis is horizontal: across
    spoke = _norm(along, z)
    tube = spoke - 0.42
    double = 2 * jnp.square(along / spoke) - 1  # cos 2a, and cos 6a = 4 cos^3 2a - 3 cos 2a: six bands
    bands = _step(4 * double**3 - 3 * double, 0.2)
    colour = _mix((0.32, 0.05, 0.42), (0.25, 0.78, 0.85), bands)
    outward = tube / spoke * along
    normal = 0.8 * outward + 0.6 * across, 0.8 * across - 0.6 * outward, tube / spoke * z
    return _norm(tube, across) - 0.16, 50.0, _shaded(colour, normal, direction, _SHEEN)


def _brick(x, y, z):
    x, y, z = x - 0.42, y + 0.42, z + 0.29
    rounded = jnp.sqrt(jnp.sqrt(x**4 + y**4 + z**4 + 1e-12))  # the norm whose unit ball is a rounded cube
    return rounded - 0.33, 3.5, (0.05, 0.25, 0.80)


def _lamp_core(x, y, z, direction):
    x, y, z = x - 0.22, y + 0.10, z - 0.62
    return _norm(x, y, z) - 0.15, 50.0, _shaded((0.45, 0.02, 0.10), (x, y, z), direction, _SHEEN)


def _lamp_glass(x, y, z):
    x, y, z = x - 0.22, y + 0.10, z - 0.62
    return _norm(x, y, z) - 0.36, 2.5, (0.98, 0.50, 0.05)


def _ball(x, y, z, direction):
    x, y, z = x + 0.38, y + 0.38, z + 0.18
    return _norm(x, y, z) - 0.44, 50.0, _shaded((0.70, 0.05, 0.08), (x, y, z), direction, _POLISH)


def _shaded(colour, normal, direction, exponent):
    """Returns a surface's colour: matt if direction is None, else with the highlight of Blinn and Phong."""
    base = _scale(colour, _lambert(*normal))
    if direction is None:
        return base
    # Brightest where the normal halves the angle between light and camera.
    halfway = tuple(towards - away for towards, away in zip(_light(), direction, strict=True))
    aligned = sum(a * b for a, b in zip(normal, halfway, strict=True)) / (_norm(*normal) * _norm(*halfway))
    highlight = 0.9 * jnp.maximum(aligned, 0.0) ** exponent
    return tuple(value + highlight * (1 - value) for value in base)


def _light():
    return 0.48, -0.36, 0.80


def _lambert(x, y, z):
    """Returns the brightness of a matt surface with its normal along (x, y, z), softened on the dark side."""
    light = _light()
    facing = (x * light[0] + y * light[1] + z * light[2]) / _norm(x, y, z)
    return 0.35 + 0.65 * jnp.square(0.5 + 0.5 * facing)


def _norm(*components):
    # 1e-12 keeps the gradient finite on an axis; 1e-6 units are far below a pixel.
    return jnp.sqrt(sum(jnp.square(component) for component in components) + 1e-12)


def _wave(turns):
    """Returns a sine of turns made of parabolas: the same zeros and peaks, several times faster."""
    part = turns - jnp.round(turns)
    return 8 * part * (1 - 2 * jnp.abs(part))


def _step(value, softness):
    return jax.nn.sigmoid(value / softness)


def _mix(first, second, fraction):
    return tuple(a + (b - a) * fraction for a, b in zip(first, second, strict=True))


def _scale(colour, factor):
    return tuple(value * factor for value in colour)
