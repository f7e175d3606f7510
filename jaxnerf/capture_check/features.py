"""Places that can be found again in another photograph: corners, what surrounds them, and pairs of these.

A small relative of SIFT (Lowe 2004) without its turn and its scales: photographs of one capture that are
taken from nearby places are turned and scaled alike. numpy on the host, and the same on every run.
"""

from typing import NamedTuple

import numpy as np

_LONGEST = 512  # px of the shrunk image: corners are found to a fraction of one of these
_CELL = 12  # px, one corner at most in such a square, so that they spread
_MOST = 700  # corners of one image
_TURNS = 8  # directions of brightness that are told apart
_GRID = 4  # a corner's surroundings are 4 x 4 places
_SPACING = 5.0  # px between them
_CLIP = 0.2  # no direction counts for more: one strong edge is not to decide
_RATIO = 0.85  # of the distances to the nearest and to the second: above, it could be either


class Features(NamedTuple):
    """The corners of one photograph."""

    pixels: np.ndarray  # [N, 2] px of the photograph as it is on disk
    descriptors: np.ndarray  # [N, 128] float32 of length 1


def shrink(pixels):
    """Returns (grey [h, w] float32 in [0, 1], factor) of a photograph, averaged down by a whole factor.

    Args:
        pixels: [H, W, 3 or 4] uint8 or uint16; alpha is composited over white.
    """
    height, width = pixels.shape[:2]
    factor = max(1, -(-max(height, width) // _LONGEST))
    height, width = max(height // factor, 1), max(width // factor, 1)
    blocks = pixels[: height * factor, : width * factor]
    weights = np.float32([0.299, 0.587, 0.114]) / np.iinfo(pixels.dtype).max
    grey = sum(blocks[..., k] * weights[k] for k in range(3))
    if pixels.shape[-1] == 4:
        grey = 1 + blocks[..., 3] * np.float32(1 / np.iinfo(pixels.dtype).max) * (grey - 1)
    rows = np.add.reduceat(grey, np.arange(0, len(grey), factor), axis=0) / factor
    return rows.reshape(height, width, factor).mean(axis=2), factor


def find(grey, factor):
    """Returns the Features of a grey image [h, w] that was shrunk by a factor."""
    if min(grey.shape) < 4 * _CELL:
        return Features(np.zeros((0, 2)), np.zeros((0, _TURNS * _GRID**2), np.float32))
    along_y, along_x = np.gradient(blur(grey, 1.0))
    places = _corners(along_x, along_y)
    return Features((places + 0.5) * factor, _describe(along_x, along_y, places))


def match(first, second):
    """Returns [M, 2] indices of corners of two Features that are each other's nearest, and clearly so."""
    if min(len(first.pixels), len(second.pixels)) < 2:
        return np.zeros((0, 2), int)
    alike = first.descriptors @ second.descriptors.T
    forth, back = alike.argmax(axis=1), alike.argmax(axis=0)
    chosen = np.arange(len(alike))
    best = alike[chosen, forth]
    alike[chosen, forth] = -1
    next_best = alike.max(axis=1)
    good = (back[forth] == chosen) & (1 - best < _RATIO**2 * (1 - next_best))  # 2 - 2 a b is |a - b|^2
    return np.column_stack([chosen[good], forth[good]])


def blur(image, sigma):
    """Returns an image [..., h, w] smoothed with a Gaussian of sigma px; beyond its rim it is continued."""
    reach = int(np.ceil(2.5 * sigma))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    weights = (weights / weights.sum()).astype(np.float32)
    for axis in (-2, -1):
        size, padding = image.shape[axis], [(0, 0)] * image.ndim
        padding[axis] = (reach, reach)
        padded = np.pad(image, padding, mode="edge")
        shifted = [
            padded[(..., slice(k, k + size)) if axis == -1 else (..., slice(k, k + size), slice(None))]
            for k in range(2 * reach + 1)
        ]
        image = weights[reach] * shifted[reach]
        for k in range(reach):
            image += weights[k] * (shifted[k] + shifted[-1 - k])
    return image


def _corners(along_x, along_y):
    """Returns [N, 2] (x, y) px of shrunk pixels' centres where brightness changes both ways."""
    xx, yy, xy = blur(np.stack([along_x**2, along_y**2, along_x * along_y]), 1.5)
    response = 0.5 * (xx + yy - np.sqrt((xx - yy) ** 2 + 4 * xy**2))  # the smaller eigenvalue (Shi, Tomasi)
    rim = int(_SPACING * _GRID / 2)
    inside = np.zeros_like(response)
    inside[rim:-rim, rim:-rim] = response[rim:-rim, rim:-rim]
    height, width = (size // _CELL * _CELL for size in inside.shape)
    cells = inside[:height, :width].reshape(height // _CELL, _CELL, width // _CELL, _CELL).swapaxes(1, 2)
    cells = cells.reshape(height // _CELL, width // _CELL, -1)
    row, column = np.divmod(cells.argmax(axis=-1), _CELL)
    y = (row + _CELL * np.arange(height // _CELL)[:, None]).reshape(-1)
    x = (column + _CELL * np.arange(width // _CELL)).reshape(-1)
    around = np.stack([[inside[y + j - 1, x + i - 1] for i in range(3)] for j in range(3)])
    peak = (around[1, 1] >= around.max(axis=(0, 1))) & (around[1, 1] > 1e-6)
    order = np.flatnonzero(peak)
    order = order[np.argsort(-around[1, 1, order], kind="stable")[:_MOST]]
    fraction = [_peak(*around[1, :, order].T), _peak(*around[:, 1, order])]
    return np.stack([x[order], y[order]], axis=-1) + np.stack(fraction, axis=-1)


def _peak(before, here, after):
    """Returns where between -0.5 and 0.5 a parabola through three values has its top."""
    bend = np.maximum(2 * here - before - after, 1e-12)
    return np.clip(0.5 * (after - before) / bend, -0.5, 0.5)


def _describe(along_x, along_y, places):
    """Returns [N, 128]: how much brightness changes in each direction, at 4 x 4 places around each corner."""
    height, width = (size // 2 for size in along_x.shape)
    angles = np.float32(2 * np.pi / _TURNS * np.arange(_TURNS))
    maps = np.empty((_TURNS, height, width), np.float32)
    least = 1 / np.sqrt(np.maximum(along_x**2 + along_y**2, 1e-12))
    for index, angle in enumerate(angles):
        slope = np.maximum(np.cos(angle) * along_x + np.sin(angle) * along_y, 0)  # as DAISY (Tola 2010),
        narrow = np.square(slope * least)
        slope *= np.square(narrow)  # but narrower: times a power of the cosine between the two
        slope = slope[: 2 * height, : 2 * width].reshape(height, 2, width, 2)
        maps[index] = slope[:, 0, :, 0] + slope[:, 0, :, 1] + slope[:, 1, :, 0] + slope[:, 1, :, 1]
    maps = blur(maps, _SPACING / 4)  # of half as many px
    offsets = _SPACING * (np.arange(_GRID) - (_GRID - 1) / 2)
    grid = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    x, y = np.rint((places[:, None] + grid) / 2 - 0.25).astype(int).transpose(2, 0, 1)
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    values = maps[:, y, x].transpose(1, 2, 0).reshape(len(places), _TURNS * _GRID**2)
    values = np.minimum(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9), _CLIP)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9)
