"""The embedded house: three rooms in a row and a terrace with an open view, in closed form as the room is.

A walk leads from the first room through doors to the terrace, 3 units above streets with other houses, hills and sky.
Cameras look at no common point: what is near some of them is far away from others, or hidden by walls.
"""

import functools
import math

import numpy as np
from jaxtyping import Float

from test_scenes import room
from test_scenes.room import Place

FLOOR = 3.0  # its height above the ground, world units
_HEIGHT, _WALL = 2.8, 0.06  # of a room; half the thickness of a wall
_SUN = (90.0, -140.0, 160.0)
_DOORS = (5.0, 10.0, 15.0)  # x of the walls with doors
_DOOR = (0.2, 1.2, 2.1)  # y from and to, and height
# Places along the path, x and y; the terrace begins at x = 15.
_PATH = (
    *((1.3, -1.9), (1.2, 1.7), (3.0, 2.2), (4.2, 0.7), (5.8, 0.7), (6.3, -1.0), (7.4, -1.9), (8.6, -1.3)),
    *((9.2, 0.7), (10.8, 0.7), (11.4, -1.2), (12.9, -1.9), (13.8, -0.6), (14.2, 0.7), (15.8, 0.7), (16.2, -1.9)),
    *((18.9, -2.2), (19.2, 0.0), (18.8, 2.2), (16.6, 2.2), (15.8, 0.7), (13.9, 0.7), (12.9, 1.9), (11.0, 0.8)),
)
_SMOOTHING = 0.35  # world units along the path

_of = functools.partial
_plain, _mottled, _grain, _checked = room._plain, room._mottled, room._grain, room._checked


def along_path(progress: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 2"]:
    """Returns x and y on the path at fractions of its length."""
    corners = np.asarray(_PATH)
    length = np.append(0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
    shifts = np.linspace(-2, 2, 33) * _SMOOTHING
    at = np.clip(np.asarray(progress)[:, None] * length[-1] + shifts, 0, length[-1])
    weights = np.exp(-((shifts / _SMOOTHING) ** 2))
    return np.stack([np.interp(at, length, axis) @ weights / weights.sum() for axis in corners.T], axis=-1)


def _lamps(x):
    """Returns where light comes from [N, 3]: the lamp of the room, or the sun."""
    inside = (x[:, 0] > 0) & (x[:, 0] < 15) & (np.abs(x[:, 1]) < 3) & (x[:, 2] > FLOOR - 1e-6)
    lamp = np.stack([5 * np.clip(np.floor(x[:, 0] / 5), 0, 2) + 2.5, 0 * x[:, 0], 0 * x[:, 0] + FLOOR + 2.6], axis=-1)
    return np.where((inside & (x[:, 2] < FLOOR + _HEIGHT + 1e-6))[:, None], lamp, _SUN)


@functools.cache
def _bodies():
    return tuple(room._Body(*each) for part in (_walls(), _furniture(), _terrace(), _town()) for each in part)


def _between(lower, upper, material, **options):
    """Returns the box from one corner to the other; heights count from the floor."""
    lower, upper = np.add(lower, (0, 0, FLOOR)), np.add(upper, (0, 0, FLOOR))
    return room._body("box", (lower + upper) / 2, (upper - lower) / 2, material, **options)


def _walls():
    papers = [
        _of(_mottled, (0.74, 0.66, 0.52), (0.52, 0.40, 0.30), 0.16),
        _of(_checked, 0.22),
        _of(_mottled, (0.45, 0.60, 0.62), (0.70, 0.76, 0.70), 0.12),
    ]
    white, wood = (
        _of(_mottled, (0.86, 0.85, 0.82), (0.74, 0.72, 0.68), 0.5),
        _of(_grain, (0.5, 0.34, 0.2), (0.3, 0.2, 0.12), 0.12),
    )
    outer = _of(_mottled, (0.72, 0.55, 0.42), (0.62, 0.44, 0.34), 0.2)
    bodies = [_between((0, -3, -FLOOR), (20, 3, -0.1), outer)]
    floors = [
        wood,
        _of(_mottled, (0.60, 0.24, 0.20), (0.82, 0.70, 0.52), 0.2),
        _of(_checked, 0.3),
        _of(_mottled, (0.70, 0.66, 0.60), (0.50, 0.46, 0.42), 0.15),
    ]
    for index, floor in enumerate(floors):
        bodies.append(_between((5 * index, -3, -0.1), (5 * index + 5, 3, 0), floor))
    for index, paper in enumerate(papers):
        left, right = 5 * index, 5 * index + 5
        bodies.append(_between((left, -3, _HEIGHT), (right, 3, _HEIGHT + 0.1), white))
        bodies.append(_between((left, 3 - 2 * _WALL, 0), (right, 3, _HEIGHT), paper))
        holes = (left + 1.6, left + 3.4) if index else ()  # a window
        spans = [(left, right, 0, _HEIGHT)]
        if holes:
            spans = [
                (left, holes[0], 0, _HEIGHT),
                (holes[1], right, 0, _HEIGHT),
                (*holes, 0, 0.9),
                (*holes, 2.2, _HEIGHT),
            ]
        bodies += [_between((a, -3, low), (b, 2 * _WALL - 3, high), paper) for a, b, low, high in spans]
    bodies.append(_between((0, -3, 0), (2 * _WALL, 3, _HEIGHT), papers[0]))
    for x, paper in zip(_DOORS, (*papers[1:], outer), strict=True):
        lower, upper, height = _DOOR
        for y0, y1, low in ((-3, lower, 0), (upper, 3, 0), (lower, upper, height)):
            bodies.append(_between((x - _WALL, y0, low), (x + _WALL, y1, _HEIGHT), paper))
    return bodies


def _table(x, y, material, half=(0.5, 0.4), height=0.72):
    legs = [(x + sx * (half[0] - 0.05), y + sy * (half[1] - 0.05)) for sx in (-1, 1) for sy in (-1, 1)]
    top = _between((x - half[0], y - half[1], height - 0.04), (x + half[0], y + half[1], height), material)
    return [
        top,
        *(
            room._body("cylinder", (a, b, FLOOR + height / 2), (0.025, 0.025, height / 2 - 0.02), material)
            for a, b in legs
        ),
    ]


def _chair(x, y, yaw, material):
    place = {"around": (x, y, FLOOR), "yaw": yaw}
    legs = [(a, b, 0.22) for a in (-0.18, 0.18) for b in (-0.18, 0.18)]
    return [
        room._body("box", (0, 0, 0.45), (0.21, 0.21, 0.02), material, **place),
        *(room._body("cylinder", leg, (0.02, 0.02, 0.22), material, **place) for leg in legs),
        *(room._body("box", (0.19, b, 0.68), (0.015, 0.02, 0.22), material, **place) for b in (-0.17, 0.0, 0.17)),
        room._body("box", (0.19, 0, 0.92), (0.016, 0.21, 0.04), material, **place),
    ]


def _furniture():
    oak, dark = _of(_grain, (0.62, 0.44, 0.25), (0.45, 0.28, 0.14), 0.06), _of(_plain, (0.18, 0.16, 0.16))
    cloth = _of(_mottled, (0.20, 0.38, 0.42), (0.45, 0.60, 0.58), 0.08)
    canvas = [
        _of(_mottled, a, b, 0.15) for a, b in (((0.9, 0.7, 0.2), (0.2, 0.3, 0.6)), ((0.7, 0.2, 0.2), (0.85, 0.85, 0.7)))
    ]
    leaf = _of(_mottled, (0.16, 0.40, 0.12), (0.42, 0.62, 0.24), 0.08)
    plant = [
        room._body(
            "ball",
            (0.2, 0, 0.06),
            (0.22, 0.07, 0.015),
            leaf,
            pitch=15 * (k % 4) - 40,
            around=(9.3, 2.3, FLOOR + 0.7 + 0.07 * k),
            yaw=50 * k,
        )
        for k in range(8)
    ]
    return [
        *_table(2.8, 0.0, oak, (0.7, 0.5)),
        *_chair(2.8, -1.0, -90, dark),
        room._body("ball", (2.6, 0.1, FLOOR + 0.87), (0.15, 0.15, 0.15), _of(room._marble, 0.05), gloss=0.4),
        room._body("cylinder", (3.1, -0.2, FLOOR + 0.82), (0.08, 0.08, 0.10), room._striped),
        room._body("box", (0.37, 0, FLOOR + 1.05), (0.25, 1.3, 1.05), room._shelf),
        _between((1.6, 2.82, 1.2), (2.8, 2.88, 2.0), canvas[0]),
        _between((5.6, 2.0, 0), (8.0, 2.8, 0.42), cloth),
        _between((5.6, 2.55, 0), (8.0, 2.85, 0.9), cloth),
        _between((6.2, 2.82, 1.3), (7.6, 2.88, 2.1), canvas[1]),
        room._body("cylinder", (9.3, 2.3, FLOOR + 0.35), (0.2, 0.2, 0.35), room._striped),
        *plant,
        *_table(7.6, 0.4, dark, (0.4, 0.3), 0.45),
        room._body(
            "box", (7.6, 0.4, FLOOR + 0.49), (0.17, 0.12, 0.03), _of(room._book, (0.16, 0.30, 0.55), 0.0175), yaw=20
        ),
        _between((10.3, 2.3, 0), (12.3, 2.85, 0.9), _of(_checked, 0.15)),
        _between((10.3, -2.85, 0), (11.0, -2.2, 1.9), oak),
        *_table(12.6, 0.5, oak, (0.4, 0.4)),
        room._body("cylinder", (12.6, 0.5, FLOOR + 0.84), (0.06, 0.06, 0.12), room._striped, gloss=0.3),
        _between((13.4, 2.82, 1.1), (14.4, 2.88, 1.9), canvas[0]),
    ]


def _terrace():
    iron, cane = _of(_plain, (0.12, 0.12, 0.13)), _of(_mottled, (0.80, 0.70, 0.50), (0.60, 0.48, 0.30), 0.05)
    edge = [(x, y) for x in np.arange(15.4, 20, 0.4) for y in (-2.95, 2.95)] + [
        (19.95, y) for y in np.arange(-2.8, 2.9, 0.4)
    ]
    rails = [
        ((15, -2.98, 0.95), (20, -2.92, 1.02)),
        ((15, 2.92, 0.95), (20, 2.98, 1.02)),
        ((19.92, -3, 0.95), (19.98, 3, 1.02)),
    ]
    return [
        *(room._body("cylinder", (x, y, FLOOR + 0.48), (0.02, 0.02, 0.48), iron) for x, y in edge),
        *(_between(lower, upper, iron) for lower, upper in rails),
        *_table(17.6, 0.3, iron, (0.5, 0.5)),
        *_chair(17.6, -0.7, -90, cane),
        *_chair(16.7, 0.5, 170, cane),
        room._body("cylinder", (17.6, 0.3, FLOOR + 0.76), (0.08, 0.08, 0.04), room._striped),
        room._body("cylinder", (19.4, 2.5, FLOOR + 0.25), (0.22, 0.22, 0.25), room._striped),
        room._body(
            "ball",
            (19.4, 2.5, FLOOR + 0.75),
            (0.35, 0.35, 0.4),
            _of(_mottled, (0.16, 0.40, 0.12), (0.5, 0.62, 0.3), 0.07),
        ),
    ]


def _town():
    rng, bodies = np.random.default_rng(7), []
    for _ in range(44):
        angle, distance = rng.uniform(-math.pi, math.pi), rng.uniform(14, 75)
        x, y = 14 + distance * math.cos(angle), distance * math.sin(angle)
        half = rng.uniform(2, 5, 2)
        tall = rng.uniform(0.6, 2.4)
        wall, other = rng.uniform(0.35, 0.85, (2, 3))
        kind = _of(_checked, 0.9) if rng.uniform() < 0.3 else _of(_mottled, tuple(wall), tuple(other), 1.2)
        if -9 < x < 29 and abs(y) < 9:
            continue
        bodies.append(room._body("box", (x, y, tall), (*half, tall), kind, yaw=rng.uniform(0, 90)))
    return bodies


def _ground(x, y, z):
    flat = np.stack([x, y, 0 * z], axis=-1)
    near = _mottled((0.62, 0.54, 0.42), (0.42, 0.40, 0.26), 2.5, flat)[0]
    return room._mix(near, (0.66, 0.60, 0.50), np.clip(np.hypot(x - 14, y) / 120, 0, 1) * 0.7), 0.0


def _horizon(x, y, z):
    """Returns the sky above hills."""
    turn = np.arctan2(y, x - 14)
    ridge = 14 + 6 * np.sin(5 * turn) + 3 * np.sin(13 * turn + 1)
    sky = room._mix((0.86, 0.90, 0.94), (0.50, 0.68, 0.90), np.clip((z - 15) / 60, 0, 1))
    hill = room._mottled((0.52, 0.48, 0.36), (0.40, 0.42, 0.30), 9.0, np.stack([x, y, z], axis=-1))[0]
    return room._mix(sky, hill, room._step(ridge - z, 0.5)), 1.0


def _sky(x, y, z):
    flat = np.stack([x, y, 0 * z], axis=-1)
    return room._mix((0.50, 0.68, 0.90), (0.92, 0.94, 0.96), room._step(room._noise(flat, 60.0) - 0.4, 0.4)), 1.0


_WALLS = {1: _horizon, -1: _horizon, 2: _horizon, -2: _horizon, 3: _ground, -3: _sky}
HOUSE = Place((-130.0, -150.0, 0.0), (160.0, 150.0, 90.0), _bodies, _WALLS, _lamps)
