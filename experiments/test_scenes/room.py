"""The embedded room: opaque surfaces in closed form, whose first hit along any ray is exact. float64 on the host.

A furnished room of 11 x 10.5 x 3.6 units: a table with objects in the middle, a chair and a plant that a camera
walking around the table passes closely, and furniture and textured walls several units away. A lamp below the ceiling
casts shadows. Some objects are glossy, so that their colour depends on the direction.

Every body is an affine image of the cube, the ball or the cylinder with |coordinates| <= 1. These are convex, so the
first hit is the largest entry into a slab or quadric. Between the walls, whatever is in no body is free space.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

LOWER, UPPER = (-6.0, -5.0, 0.0), (5.0, 5.5, 3.6)  # inner corners of the walls, world units, z up
TABLE_TOP = 0.75  # its height; the table's centre is above the origin
_LAMP = (0.7, -1.0, 3.3)
_AMBIENT = 0.5  # brightness in the shadow

_Values = Float[np.ndarray | Array, "*batch 3"]
_Material = Callable[[np.ndarray], tuple[tuple, float]]  # x [N, 3] in the body's axes -> channels of [N], emission


class Hits(NamedTuple):
    """The first surface along rays.

    Attributes:
        t: [...] in t of the rays, > 0.
        body: [...] index of the body, -1 for the walls, floor and ceiling.
        normal: [..., 3] unit length, into free space.
    """

    t: Float[np.ndarray, "*batch"]
    body: Int[np.ndarray, "*batch"]
    normal: Float[np.ndarray, "*batch 3"]


class Place(NamedTuple):
    """A box of walls with bodies in it.

    Attributes:
        lower, upper: [3] world units, the inner corners of the walls.
        bodies: function of no arguments that returns all bodies.
        walls: {sign of the inward normal * (axis + 1): function (x, y, z) -> (channels, emission)}.
        lamps: x [N, 3] -> [N, 3] or [3], where the light comes from at each place.
    """

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    bodies: Callable[[], tuple]
    walls: dict[int, Callable]
    lamps: Callable[[np.ndarray], np.ndarray]


def render(
    origins: _Values, directions: _Values, place: Place | None = None
) -> tuple[Float[np.ndarray, "*batch 3"], Float[np.ndarray, "*batch"]]:
    """Computes the colour and the depth of the first surface along rays that begin in free space.

    Args:
        origins: [..., 3] world units.
        directions: [..., 3] world units per t, of any length > 0.
        place: None: the room.

    Returns:
        rgb [..., 3] in [0, 1]; and depth [...] in t.
    """
    hits = trace(origins, directions, place)
    directions = np.asarray(directions, np.float64)
    x = np.asarray(origins, np.float64) + hits.t[..., None] * directions
    return surface_colors(x, _unit(directions), hits, place), hits.t


def trace(origins: _Values, directions: _Values, place: Place | None = None) -> Hits:
    """Computes the first surface along rays; origins must be in free space, see `is_matter`."""
    place = place or _ROOM
    shape = np.shape(origins)
    o, d = (np.asarray(values, np.float64).reshape(-1, 3) for values in (origins, directions))
    with np.errstate(divide="ignore", invalid="ignore"):
        exits = np.where(d == 0, np.inf, (np.where(d > 0, place.upper, place.lower) - o) / d)
    axis, rows = exits.argmin(axis=-1), np.arange(len(o))
    t, body, normal = exits[rows, axis], np.full(len(o), -1), np.zeros_like(o)
    normal[rows, axis] = -np.sign(d[rows, axis])
    square = (d * d).sum(axis=-1)
    for index, each in enumerate(place.bodies()):
        offset = each.center - o
        along = (offset * d).sum(axis=-1)
        # Only rays that come near the body's centre can hit it.
        distance = (offset * offset).sum(axis=-1) - np.maximum(along, 0) ** 2 / square
        near = np.flatnonzero(distance <= (each.half**2).sum())
        if not len(near):
            continue
        start, slope = (-offset[near] @ each.rotation) / each.half, (d[near] @ each.rotation) / each.half
        enter, leave, local = _SHAPES[each.shape](start, slope)
        hit = (enter < leave) & (enter > 0) & (enter < t[near])
        chosen = near[hit]
        t[chosen], body[chosen] = enter[hit], index
        normal[chosen] = _unit((local[hit] / each.half) @ each.rotation.T)
    return Hits(t.reshape(shape[:-1]), body.reshape(shape[:-1]), normal.reshape(shape))


def surface_colors(
    x: _Values, viewdirs: _Values, hits: Hits, place: Place | None = None
) -> Float[np.ndarray, "*batch 3"]:
    """Computes the colours of surfaces.

    Args:
        x: [..., 3] world units, on the surfaces of `hits`.
        viewdirs: [..., 3] unit length, from the camera to x.
        hits: Hits [...], of which t is not used.
        place: None: the room.

    Returns:
        [..., 3] in [0, 1].
    """
    place = place or _ROOM
    shape = np.shape(x)
    x, viewdirs, normal = (np.asarray(v, np.float64).reshape(-1, 3) for v in (x, viewdirs, hits.normal))
    albedo, emission, gloss = np.zeros_like(x), np.zeros(len(x)), np.zeros(len(x))
    for index in np.unique(hits.body):
        chosen = np.flatnonzero(hits.body.reshape(-1) == index)
        if index < 0:
            channels, emission[chosen] = _wall_material(place.walls, x[chosen], normal[chosen])
        else:
            each = place.bodies()[index]
            channels, emission[chosen] = each.material((x[chosen] - each.center) @ each.rotation)
            gloss[chosen] = each.gloss
        for axis, channel in enumerate(channels):
            albedo[chosen, axis] = channel
    to_lamp = place.lamps(x) - x
    towards = _unit(to_lamp)
    facing = (normal * towards).sum(axis=-1)
    lit = facing > 0
    # A hit is exact to about 1e-15, so an offset of 1e-9 prevents that a surface shadows itself.
    lit[lit] = trace(x[lit] + 1e-9 * normal[lit], to_lamp[lit], place).t >= 1
    diffuse = np.where(lit, facing, 0.25 * facing * (facing < 0))  # a hint of the shape on the dark side
    light = np.clip(_AMBIENT + (1 - _AMBIENT) * diffuse, 0, 1)
    mirrored = viewdirs - 2 * (viewdirs * normal).sum(axis=-1, keepdims=True) * normal
    highlight = gloss * lit * np.maximum((mirrored * towards).sum(axis=-1), 0) ** 20
    rgb = albedo * (light + emission * (1 - light))[:, None]
    return np.clip(rgb + highlight[:, None] * (1 - rgb), 0, 1).reshape(shape)


def is_matter(x: _Values, place: Place | None = None) -> Bool[np.ndarray, "*batch"]:
    """Returns whether positions [..., 3] are inside a body, or beyond the walls."""
    place = place or _ROOM
    x = np.asarray(x, np.float64)
    inside = ((x < place.lower) | (x > place.upper)).any(axis=-1)
    for each in place.bodies():
        local = np.abs((x - each.center) @ each.rotation) / each.half
        inside |= _size(each.shape, local) < 1
    return np.asarray(inside)


class _Body(NamedTuple):
    """An affine image of a convex shape.

    Attributes:
        shape: of _SHAPES.
        center: [3] world units.
        rotation: [3, 3], from the body's axes to the world's.
        half: [3] world units, half the extent along the body's axes.
        material: see _Material.
        gloss: the strength of the highlight in [0, 1].
    """

    shape: str
    center: np.ndarray
    rotation: np.ndarray
    half: np.ndarray
    material: _Material
    gloss: float = 0.0


def _size(shape, local):
    """Returns the gauge of a shape at |local| [..., 3], 1 on its surface."""
    if shape == "box":
        return local.max(axis=-1)
    if shape == "ball":
        return np.linalg.norm(local, axis=-1)
    return np.maximum(np.hypot(local[..., 0], local[..., 1]), local[..., 2])


def _slabs(o, d):
    """Returns entry and exit [N, K] of the slabs |x_k| <= 1, and the sign of the direction along each axis."""
    sign = np.where(d < 0, -1.0, 1.0)
    safe = np.where(np.abs(d) < 1e-300, 1e-300 * sign, d)  # a parallel ray enters at -inf or at inf
    with np.errstate(over="ignore"):
        return (-sign - o) / safe, (sign - o) / safe, sign


def _quadric(o, d):
    """Returns entry and exit [N] of the set |x| <= 1; both NaN where the ray misses it, which compares as False."""
    a, b, c = (d * d).sum(axis=-1), (o * d).sum(axis=-1), (o * o).sum(axis=-1) - 1
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(b * b - a * c)
        return (-b - root) / a, (-b + root) / a


def _box(o, d):
    enter, leave, sign = _slabs(o, d)
    axis = enter.argmax(axis=-1)
    normal = np.where(np.arange(3) == axis[:, None], -sign, 0)
    return enter.max(axis=-1), leave.min(axis=-1), normal


def _ball(o, d):
    enter, leave = _quadric(o, d)
    return enter, leave, o + np.nan_to_num(enter)[:, None] * d


def _cylinder(o, d):
    enter, leave, sign = _slabs(o[:, 2:], d[:, 2:])
    around, out = _quadric(o[:, :2], d[:, :2])
    on_end = enter[:, 0] > around
    normal = o + np.nan_to_num(around)[:, None] * d
    normal = np.where(on_end[:, None], np.stack([0 * sign, 0 * sign, -sign], -1)[:, 0], normal * [1, 1, 0])
    return np.maximum(enter[:, 0], around), np.minimum(leave[:, 0], out), normal


_SHAPES = {"box": _box, "ball": _ball, "cylinder": _cylinder}


def _body(shape, center, half, material, *, yaw=0.0, pitch=0.0, around=None, gloss=0.0):
    """Makes a body turned by pitch about y, then by yaw about z; around: a centre about which yaw moves it, too.

    Args:
        shape: of _SHAPES.
        center, half: [3] world units; with `around`, center is relative to that point before the turn.
        material: see _Material.
        yaw, pitch: degrees.
        around: [3] world units, or None.
        gloss: see _Body.
    """
    a, b = math.radians(yaw), math.radians(pitch)
    about_z = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    about_y = np.array([[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]])
    center = np.float64(center) if around is None else np.float64(around) + about_z @ np.float64(center)
    return _Body(shape, center, about_z @ about_y, np.float64(half), material, gloss)


@functools.cache
def _bodies():
    """Returns all bodies."""
    return tuple(_Body(*each) for part in (_table(), _near_path(), _at_walls()) for each in part)


_of = functools.partial  # a material of its parameters


def _table():
    wood = _of(_grain, (0.52, 0.33, 0.18), (0.36, 0.20, 0.10), 0.06)
    z, dark = TABLE_TOP, _of(_plain, (0.22, 0.15, 0.11))
    clay = _of(_mottled, (0.75, 0.40, 0.25), (0.55, 0.25, 0.15), 0.05)
    blossom = _of(_mottled, (0.9, 0.7, 0.2), (0.8, 0.3, 0.2), 0.03)
    tin = _of(_mottled, (0.3, 0.5, 0.35), (0.85, 0.82, 0.6), 0.04)
    blue, red = _of(_book, (0.16, 0.30, 0.55), 0.0175), _of(_book, (0.70, 0.22, 0.16), 0.014)
    pencil = _of(_plain, (0.85, 0.65, 0.1))
    return [
        _body("box", (0, 0, z - 0.025), (0.75, 0.55, 0.025), wood, gloss=0.15),
        *(_body("cylinder", (x, y, 0.35), (0.03, 0.03, 0.35), dark) for x in (-0.66, 0.66) for y in (-0.46, 0.46)),
        _body("ball", (0.10, -0.16, z + 0.15), (0.15, 0.15, 0.15), _of(_marble, 0.05), gloss=0.5),
        _body("box", (-0.28, 0.10, z + 0.12), (0.11, 0.11, 0.12), _of(_checked, 0.075), yaw=28),
        _body("box", (0.30, 0.24, z + 0.025), (0.17, 0.12, 0.025), blue, yaw=-20),
        _body("box", (0.31, 0.24, z + 0.07), (0.14, 0.10, 0.02), red, yaw=8),
        _body("cylinder", (0.31, 0.24, z + 0.14), (0.045, 0.045, 0.05), _striped, gloss=0.3),
        _body("cylinder", (-0.02, 0.26, z + 0.09), (0.06, 0.06, 0.09), clay, gloss=0.2),
        _body("ball", (-0.02, 0.26, z + 0.22), (0.09, 0.09, 0.07), clay, gloss=0.2),
        _body("cylinder", (0.01, 0.26, z + 0.38), (0.005, 0.005, 0.14), dark, pitch=12),
        _body("cylinder", (-0.04, 0.25, z + 0.36), (0.005, 0.005, 0.12), dark, pitch=-18, yaw=40),
        _body("ball", (0.05, 0.26, z + 0.54), (0.05, 0.05, 0.025), blossom),
        _body("box", (0.52, -0.14, z + 0.004), (0.13, 0.09, 0.004), _page, yaw=15),
        _body("cylinder", (0.50, -0.14, z + 0.016), (0.006, 0.006, 0.09), pencil, yaw=60, pitch=90),
        _body("box", (-0.55, -0.25, z + 0.05), (0.08, 0.05, 0.05), tin, yaw=-35),
    ]


def _near_path():
    """Returns a chair with a back of thin slats, and a plant on a stand, both between table and cameras."""
    wood = _of(_grain, (0.62, 0.44, 0.25), (0.45, 0.28, 0.14), 0.04)
    cloth = _of(_mottled, (0.20, 0.38, 0.42), (0.45, 0.60, 0.58), 0.05)
    chair = {"around": (1.05 * math.cos(0.42), 1.05 * math.sin(0.42), 0.0), "yaw": math.degrees(0.42)}
    legs = [(x, y, 0.21) for x in (-0.17, 0.17) for y in (-0.17, 0.17)]
    bodies = [
        _body("box", (0, 0, 0.45), (0.20, 0.20, 0.03), cloth, **chair),
        *(_body("cylinder", leg, (0.02, 0.02, 0.21), wood, **chair) for leg in legs),
        *(_body("box", (0.19, y, 0.74), (0.018, 0.018, 0.29), wood, **chair) for y in (-0.18, 0.18)),
        *(_body("box", (0.19, y, 0.72), (0.008, 0.015, 0.24), wood, **chair) for y in (-0.09, 0.0, 0.09)),
        _body("box", (0.19, 0, 0.99), (0.016, 0.20, 0.04), wood, **chair),
    ]
    x, y = 1.32 * math.cos(-1.1), 1.32 * math.sin(-1.1)
    leaf = _of(_mottled, (0.16, 0.40, 0.12), (0.42, 0.62, 0.24), 0.05)
    stand, stem = _of(_grain, (0.7, 0.6, 0.5), (0.5, 0.4, 0.35), 0.05), _of(_plain, (0.25, 0.33, 0.12))
    bodies += [
        _body("cylinder", (x, y, 0.33), (0.13, 0.13, 0.33), stand),
        _body("cylinder", (x, y, 0.76), (0.11, 0.11, 0.10), _striped),
        _body("cylinder", (x, y, 1.00), (0.010, 0.010, 0.16), stem),
    ]
    for index in range(9):
        place = {"around": (x, y, 1.0 + 0.035 * index), "yaw": 40 * index + 25 * (index % 2)}
        bodies.append(_body("ball", (0.12, 0, 0.05), (0.12, 0.045, 0.008), leaf, pitch=12 * (index % 4) - 35, **place))
    return bodies


def _at_walls():
    sofa = _of(_mottled, (0.50, 0.22, 0.24), (0.66, 0.36, 0.34), 0.10)
    oak = _of(_grain, (0.50, 0.36, 0.22), (0.36, 0.24, 0.14), 0.09)
    globe = _of(_mottled, (0.2, 0.3, 0.6), (0.8, 0.8, 0.7), 0.12)
    return [
        _body("box", (-5.75, 0.9, 1.05), (0.25, 1.3, 1.05), _shelf),
        _body("box", (-5.2, -2.9, 0.25), (0.5, 1.1, 0.25), sofa),
        _body("box", (-5.75, -2.9, 0.55), (0.25, 1.1, 0.45), sofa),
        *(_body("box", (-5.35, y, 0.35), (0.55, 0.12, 0.35), sofa) for y in (-4.0, -1.8)),
        _body("cylinder", (-4.6, 3.9, 0.85), (0.03, 0.03, 0.85), _of(_plain, (0.12, 0.12, 0.13))),
        _body("ball", (-4.6, 3.9, 1.85), (0.32, 0.32, 0.25), _shade),
        _body("cylinder", (-2.6, -4.1, 1.8), (0.22, 0.22, 1.8), _tiles),
        _body("box", (1.2, 5.2, 0.45), (1.1, 0.3, 0.45), oak),
        _body("cylinder", (0.7, 5.2, 1.1), (0.14, 0.14, 0.2), _striped),
        _body("ball", (1.7, 5.2, 1.12), (0.22, 0.22, 0.22), _of(_marble, 0.1), gloss=0.4),
        _body("box", (1.5, -4.7, 0.4), (0.7, 0.3, 0.4), _of(_checked, 0.25)),
        _body("box", (3.9, 2.8, 0.5), (0.4, 0.4, 0.5), oak, yaw=30),
        _body("ball", (3.9, 2.8, 1.25), (0.25, 0.25, 0.25), globe),
    ]


# Materials. Their finest detail is a few pixels wide in an image 200 px wide, as each pixel is a single ray.


def _plain(color, p):
    del p
    return color, 0.0


def _mottled(color, other, period, p):
    return _mix(color, other, _step(_noise(p, period), 0.6)), 0.0


def _grain(color, other, period, p):
    """Returns wood: stripes along x that a coarse noise bends."""
    bent = (p[:, 1] + 0.6 * p[:, 2]) / period + 0.8 * _noise(p * [0.4, 1, 1], 4 * period)
    return _mix(color, other, 0.5 + 0.5 * np.sin(2 * np.pi * bent)), 0.0


def _checked(size, p):
    turns = p / size / 2 + 0.25
    signs = np.prod(np.sin(2 * np.pi * turns), axis=-1)
    return _mix((0.90, 0.82, 0.62), (0.15, 0.28, 0.50), _step(signs, 0.2)), 0.0


def _striped(p):
    turns = np.arctan2(p[:, 1], p[:, 0]) / (2 * np.pi) * 8 + p[:, 2] / 0.08
    return _mix((0.86, 0.84, 0.80), (0.10, 0.42, 0.45), _step(np.sin(2 * np.pi * turns), 0.5)), 0.0


def _marble(scale, p):
    veins = np.abs(np.sin(2 * np.pi * p[:, 0] / (4 * scale) + 1.6 * _noise(p, 1.5 * scale)))
    return _mix((0.12, 0.16, 0.30), (0.82, 0.72, 0.58), np.sqrt(veins)), 0.0


def _book(color, pages, p):
    """Returns a book: a cover with a title, and pages of that half height."""
    x, y, z = p.T
    title = _rectangle(x, y, (0.0, 0.02), (0.07, 0.02)) + _rectangle(x, y, (0.0, -0.04), (0.04, 0.008))
    return _mix(_mix(color, (0.92, 0.86, 0.55), title), (0.85, 0.80, 0.68), np.abs(z) < pages), 0.0


def _page(p):
    x, y, _ = p.T
    lines = _step(np.sin(2 * np.pi * y / 0.03), 0.4) * _step(0.10 - np.abs(x + 0.01 * np.sin(90 * y)), 0.01)
    return _mix((0.90, 0.90, 0.86), (0.35, 0.35, 0.40), 0.7 * lines), 0.0


def _tiles(p):
    turn = np.arctan2(p[:, 1], p[:, 0]) / (2 * np.pi)
    row = np.floor(p[:, 2] / 0.3)
    joint = _joint(turn * 6 + 0.5 * (row % 2), 0.06) * _joint(p[:, 2] / 0.3, 0.08)
    return _mix((0.80, 0.76, 0.70), _palette(np.floor(turn * 6 + 0.5 * (row % 2)) + 7 * row, 0.15), joint), 0.0


def _shelf(p):
    """Returns the front of a shelf with five boards of books; p[:, 0] points into the free space."""
    board, column = np.floor(p[:, 2] / 0.42), np.floor(p[:, 1] / 0.11)
    top = 0.30 + 0.08 * np.sin(12.9 * column + 7.3 * board)  # height of a book
    above = p[:, 2] - 0.42 * board
    book = _joint(p[:, 1] / 0.11, 0.10) * _step(top - above, 0.02) * _step(above - 0.05, 0.01)
    band = _step(0.02 - np.abs(above - 0.6 * top), 0.008)
    color = _mix(_palette(column + 17 * board, 0.3), (0.90, 0.82, 0.55), 0.8 * band)
    wood = _grain((0.34, 0.24, 0.16), (0.26, 0.17, 0.10), 0.2, p)[0]
    return _mix(_mix((0.10, 0.08, 0.07), wood, _step(0.05 - above, 0.01)), color, book), 0.0


def _shade(p):
    ribs = 0.5 + 0.5 * np.sin(12 * np.arctan2(p[:, 1], p[:, 0]))
    return _mix((0.95, 0.80, 0.50), (0.85, 0.62, 0.34), ribs), 0.8


def _wall_material(walls, x, normal):
    channels, emission = np.zeros((3, len(x))), np.zeros(len(x))
    for axis in range(3):
        for sign in (-1, 1):
            chosen = np.flatnonzero(sign * normal[:, axis] > 0.5)  # normals point inwards
            if len(chosen):
                color, emission[chosen] = walls[sign * (axis + 1)](*x[chosen].T)
                for channel, value in zip(channels, color, strict=True):
                    channel[chosen] = value
    return channels, emission


def _floor(x, y, z):
    board = np.floor(y / 0.22)
    flat = np.stack([x, y, 0 * z], axis=-1)
    seam = _joint(y / 0.22, 0.08) * _joint(x / 1.7 + 0.37 * board, 0.012)
    shade = 0.5 + 0.3 * np.sin(9.1 * board) + 0.25 * _noise(flat * [0.3, 1, 1], 0.1)
    wood = _mix((0.25, 0.17, 0.11), _mix((0.58, 0.42, 0.28), (0.44, 0.29, 0.18), shade), seam)
    rings = _step(np.sin(2 * np.pi * np.maximum(np.abs(x) / 1.7, np.abs(y) / 1.3) * 7), 0.4)
    rug = _mix((0.58, 0.20, 0.16), (0.82, 0.74, 0.56), rings * (0.75 + 0.25 * _noise(flat, 0.12)))
    return _mix(wood, rug, _rectangle(x, y, (0, 0), (1.7, 1.3))), 0.0


def _ceiling(x, y, z):
    flat = np.stack([x, y, 0 * z], axis=-1)
    beams = _step(0.09 - np.abs((x + 0.5) % 2.0 - 1.0), 0.02)
    white = _mix((0.84, 0.83, 0.80), (0.78, 0.77, 0.74), 0.5 + 0.3 * _noise(flat, 0.9))
    return _mix(white, (0.38, 0.27, 0.18), beams), 0.0


def _wallpaper(x, y, z):
    """Returns the wall at the lowest x: fine flowers between stripes, and two paintings."""
    stripes = _step(np.sin(2 * np.pi * y / 0.5), 0.3)
    dots = _step(np.sin(2 * np.pi * y / 0.25) * np.sin(2 * np.pi * z / 0.25) - 0.5, 0.15)
    color = _mix(_mix((0.62, 0.66, 0.58), (0.72, 0.74, 0.64), stripes), (0.50, 0.36, 0.34), dots)
    color = _painting(color, y, z, (3.6, 2.2), (0.75, 0.55), 5)
    return _painting(color, y, z, (-2.9, 2.2), (0.9, 0.6), 9), 0.0


def _plaster(x, y, z):
    """Returns the wall at the highest x: nearly plain, with a painting and a door."""
    flat = np.stack([0 * x, y, z], axis=-1)
    color = _mix((0.80, 0.76, 0.68), (0.72, 0.68, 0.60), 0.5 + 0.4 * _noise(flat, 1.2))
    color = _painting(color, y, z, (-1.2, 1.9), (0.8, 0.55), 3)
    panels = _joint((y - 1.0) / 0.55, 0.12) * _joint(z / 0.7, 0.10)
    door = _mix((0.24, 0.15, 0.10), (0.46, 0.30, 0.20), panels)
    return _mix(color, door, _rectangle(y, z, (1.55, 1.05), (0.55, 1.05))), 0.0


def _bricks(x, y, z):
    """Returns the wall at the lowest y, of bricks, and a clock."""
    row = np.floor(z / 0.18)
    across = x / 0.5 + 0.5 * (row % 2)
    joint = _joint(z / 0.18, 0.12) * _joint(across, 0.05)
    index = np.floor(across) + 31 * row
    red = _mix((0.62, 0.30, 0.22), (0.48, 0.22, 0.18), 0.5 + 0.5 * np.sin(12.9898 * index))
    color = _mix((0.75, 0.71, 0.66), red, joint)
    radius, turn = np.hypot(x - 0.4, z - 2.3), np.arctan2(z - 2.3, x - 0.4)
    marks = _step(np.cos(12 * turn) - 0.6, 0.1) * _step(0.06 - np.abs(radius - 0.36), 0.02)
    face = _mix((0.93, 0.92, 0.88), (0.1, 0.1, 0.12), np.maximum(marks, _step(radius - 0.45, 0.02)))
    return _mix(color, face, _step(0.5 - radius, 0.02)), 0.0


def _window(x, y, z):
    """Returns the wall at the highest y, with a bright window: sky, hills and a cross, between curtains."""
    flat = np.stack([x, 0 * y, z], axis=-1)
    color = _mix((0.66, 0.60, 0.68), (0.58, 0.53, 0.62), 0.5 + 0.4 * _noise(flat, 0.3))
    glass = _rectangle(x, z, (-1.6, 1.95), (1.2, 0.85))
    hills = _step(1.6 + 0.15 * np.sin(2.1 * x) + 0.08 * np.sin(5.3 * x + 1) - z, 0.03)
    sky = _mix((0.86, 0.92, 0.98), (0.60, 0.78, 0.96), np.clip((z - 1.4) / 1.4, 0, 1))
    view = _mix(sky, (0.36, 0.50, 0.30), hills)
    cross = np.maximum(_step(0.05 - np.abs(x + 1.6), 0.01), _step(0.05 - np.abs(z - 1.95), 0.01))
    color = _mix(color, (0.92, 0.91, 0.88), _rectangle(x, z, (-1.6, 1.95), (1.32, 0.97)))
    color = _mix(color, view, glass * (1 - cross))
    folds = 0.5 + 0.5 * np.sin(2 * np.pi * x / 0.2)
    curtains = np.maximum(*(_rectangle(x, z, (middle, 1.6), (0.35, 1.5)) for middle in (-3.1, -0.1)))
    color = _mix(color, _mix((0.75, 0.55, 0.25), (0.60, 0.40, 0.18), folds), curtains)
    return color, 0.9 * glass * (1 - cross) * (1 - curtains)


# {sign of the inward normal * (axis + 1): material}
_WALLS = {1: _wallpaper, -1: _plaster, 2: _bricks, -2: _window, 3: _floor, -3: _ceiling}
_ROOM = Place(LOWER, UPPER, _bodies, _WALLS, lambda x: np.asarray(_LAMP))


def _painting(color, u, v, middle, half, seed):
    """Returns a wall's colour with a framed painting on it."""
    p = np.stack([u, v, 0 * u + seed], axis=-1)
    canvas = tuple(0.5 + 0.28 * _noise(p, 0.22, seed + channel) for channel in range(3))
    color = _mix(color, (0.20, 0.13, 0.08), _rectangle(u, v, middle, [side + 0.07 for side in half]))
    return _mix(color, tuple(np.clip(channel, 0.05, 0.9) for channel in canvas), _rectangle(u, v, middle, half))


def _rectangle(u, v, middle, half):
    """Returns 1 inside a rectangle and 0 outside, with soft edges."""
    margin = np.minimum(half[0] - np.abs(u - middle[0]), half[1] - np.abs(v - middle[1]))
    return _step(margin, 0.1 * min(half))


def _joint(turns, width):
    """Returns 0 around whole numbers, within `width` turns, and 1 elsewhere."""
    return _step(np.abs(turns - np.round(turns)) - width, 0.4 * width)


def _palette(index, softness):
    """Returns a different colour for each index."""
    return tuple(0.5 + softness * np.sin(factor * index + 0.7) for factor in (12.9898, 78.233, 37.719))


def _noise(p, period, seed=0):
    """Returns smooth noise of mean 0 and standard deviation 0.5 with periods from `period` to twice that."""
    directions, phases = _waves(seed)
    return np.sin((p / period) @ directions.T + phases).sum(axis=-1) / math.sqrt(2 * len(phases))


@functools.cache
def _waves(seed, count=6):
    rng = np.random.default_rng(seed)
    directions = _unit(rng.normal(size=(count, 3))) * 2 * np.pi / rng.uniform(1, 2, (count, 1))
    return directions, rng.uniform(0, 2 * np.pi, count)


def _step(value, softness):
    """Returns 0 below -softness and 1 above it, smooth between."""
    s = np.clip(0.5 + 0.5 * value / softness, 0, 1)
    return s * s * (3 - 2 * s)


def _mix(first, second, fraction):
    return tuple(a + (b - a) * fraction for a, b in zip(first, second, strict=True))


def _unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
