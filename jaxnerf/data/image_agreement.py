"""How well images fit their cameras, and how far their exposures differ, from corners that three images show.

Corners are those of Shi and Tomasi (1994), described by histograms of gradients (Lowe 2004) of one size and one
orientation, as neighbouring images show a scene upright and at a similar scale. They are matched whatever the cameras
are. A match counts if a third image confirms it, which it does of hardly any wrong one.
"""

import functools
import itertools
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxnerf.core.cameras import rays_from_pixels
from jaxnerf.core.views import Views
from jaxnerf.data.geometry.poses import neighbours

_VIEWS, _NEAR = 12, 4  # views that are compared with their neighbours, and how many of these
_SIDE, _CORNERS, _EDGE = 400, 300, 10  # px of the longest side, at most; of one image; px from its edges
_RATIO = 0.8  # of the distances to the nearest and second nearest descriptor (Lowe 2004, section 7.1)
_CELLS = np.stack(np.meshgrid(*[[-8, -3, 2, 7]] * 2, indexing="ij"), axis=-1).reshape(-1, 2)  # px, of 5 x 5 px
_BINS = np.arange(8, dtype=np.float32)  # of directions
_DARKEST, _BRIGHTEST, _LEAST = 0.03, 0.97, 10  # colours that tell a ratio, and how many of two images


class Agreement(NamedTuple):
    """What `agreement` finds: medians, 0 without any.

    Attributes:
        count: confirmed matches of two images.
        off: px, of images of at most 400, by which a corner is beside the epipolar line of its match.
        brightness: the absolute logarithm of the ratio of two images' brightness.
        tint: the same of the channel that differs most from the mean of the channels.
    """

    count: int
    off: float
    brightness: float
    tint: float


def agreement(views: Views) -> Agreement:
    """Matches some images with their neighbours and compares the matches with the cameras, and their colours."""
    poses, focal = np.asarray(views.cameras.to_world, np.float64), np.mean(views.cameras.focal) / _step(views)
    chosen = np.unique(np.linspace(0, len(poses) - 1, _VIEWS).round().astype(int))
    corners = functools.cache(functools.partial(_corners, views))
    matched = functools.cache(lambda one, other: match(corners(one)[1], corners(other)[1], _RATIO))
    off, ratios = [np.zeros(0)], [np.zeros((0, 3))]
    for view, others in zip(chosen, neighbours(poses, count=_NEAR, of=chosen), strict=True):
        for second, third in itertools.combinations(others, 2):
            there, beyond = matched(view, second), matched(view, third)
            rows = np.flatnonzero((there >= 0) & (beyond >= 0))
            rows = rows[matched(second, third)[there[rows]] == beyond[rows]]
            shown = (view, rows), (second, there[rows]), (third, beyond[rows])
            for (one, first), (other, last) in itertools.combinations(shown, 2):
                rays, colors = ((corners(one)[k][first], corners(other)[k][last]) for k in (0, 2))
                off.append(focal * _beside(poses[other, :, 3] - poses[one, :, 3], *rays))
                usable = ((np.minimum(*colors) > _DARKEST) & (np.maximum(*colors) < _BRIGHTEST)).all(axis=1)
                if usable.sum() >= _LEAST:
                    ratios.append(np.median(np.log(colors[0][usable] / colors[1][usable]), axis=0, keepdims=True))
    ratio = np.concatenate(ratios)
    level = ratio.mean(axis=1, keepdims=True)
    found = np.concatenate(off), np.abs(level), np.abs(ratio - level).max(axis=1, initial=0)
    return Agreement(len(found[0]), *(float(np.median(each)) if each.size else 0.0 for each in found))


def match(first: Float[np.ndarray, "N D"], second: Float[np.ndarray, "M D"], ratio: float) -> Int[np.ndarray, " N"]:
    """Returns for each descriptor of unit length the index of its match, or -1.

    Matches are mutual nearest neighbours that pass Lowe's test of the `ratio` of two distances.
    """
    if min(len(first), len(second)) < 2:
        return np.full(len(first), -1)
    similarity = first @ second.T
    forward, backward = similarity.argmax(axis=1), similarity.argmax(axis=0)
    rows = np.arange(len(similarity))
    best = similarity[rows, forward]
    similarity[rows, forward] = -1
    unambiguous = 1 - best < ratio**2 * (1 - similarity.max(axis=1))  # |a - b|^2 = 2 - 2 a b
    return np.where(unambiguous & (backward[forward] == rows), forward, -1)


def _beside(shift, *rays):
    """Returns the angles [N] of rays [N, 3] from the planes of their matches' rays and the shift between both eyes."""
    normals = [np.cross(shift, each) for each in rays]
    sizes = np.minimum(*(np.linalg.norm(each, axis=1) for each in normals))
    return np.abs((normals[0] * rays[1]).sum(axis=1)) / np.maximum(sizes, 1e-12)


def _step(views):
    """Returns how many pixels of a row become one, the same number for all images, as descriptors have one size."""
    return -(-int(np.max(views.size)) // _SIDE)


@jax.jit
def _rays(camera, pixels):
    return rays_from_pixels(camera, pixels, near=0.0, far=1.0).viewdirs


def _corners(views, view):
    """Returns the corners of a view: unit vectors along their rays [N, 3], descriptors [N, D] and colours [N, 3]."""
    from scipy import ndimage  # where it is used: it takes 50 MB

    (height, width), first = views.size[view], views.offset[view]
    pixels = np.float32(views.pixels[first : first + height * width]) / np.iinfo(views.pixels.dtype).max
    step = _step(views)
    rows, columns = height // step, width // step
    if min(rows, columns) <= 2 * _EDGE:
        return np.zeros((0, 3)), np.zeros((0, len(_CELLS) * len(_BINS))), np.zeros((0, 3))
    image = (1 + pixels[:, 3:].prod(axis=1, keepdims=True) * (pixels[:, :3] - 1)).reshape(height, width, 3)
    image = image[: rows * step, : columns * step].reshape(rows, step, columns, step, 3).mean(axis=(1, 3))
    down, right = np.gradient(image.mean(axis=-1))
    around = functools.partial(ndimage.uniform_filter, size=5, axes=(0, 1))
    xx, yy, xy = around(right * right), around(down * down), around(right * down)
    least = (xx + yy) / 2 - np.sqrt((xx - yy) ** 2 / 4 + xy**2)
    peaks = (least == ndimage.maximum_filter(least, 7)) & (least > 1e-4 * least.max())
    at = np.argwhere(peaks[_EDGE:-_EDGE, _EDGE:-_EDGE]) + _EDGE
    at = at[np.argsort(-least[tuple(at.T)], kind="stable")]
    if views.mask is not None:
        at = at[views.mask[first + step * (at[:, 0] * width + at[:, 1])]]
    at = at[:_CORNERS]
    place = np.zeros((_CORNERS, 2), np.float32)  # one shape to compile
    for axis in (0, 1):  # the vertex of a parabola
        before, here, after = (least[tuple((at + k * np.eye(2, dtype=int)[axis]).T)] for k in (-1, 0, 1))
        shift = (after - before) / np.maximum(2 * here - before - after, 1e-12) / 2
        place[: len(at), 1 - axis] = step * (at[:, axis] + 0.5 + np.clip(shift, -0.5, 0.5))
    turns = np.arctan2(down, right)[..., None] * np.float32(len(_BINS) / (2 * np.pi)) - _BINS
    near = np.maximum(1 - np.abs((turns + len(_BINS) / 2) % len(_BINS) - len(_BINS) / 2), 0)
    energy = around(np.hypot(down, right)[..., None] * near)
    found = energy[tuple((at[:, None] + _CELLS).transpose(2, 0, 1))].reshape(len(at), len(_CELLS) * len(_BINS))
    for most in (0.2, 1.0):  # of one entry, so that strong edges do not decide
        found = np.minimum(found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12), most)
    rays = _rays(jax.tree.map(lambda leaf: np.asarray(leaf)[view], views.cameras), place)
    return np.float64(rays)[: len(at)], found, around(image)[tuple(at.T)]
