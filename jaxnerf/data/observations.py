"""The observations of sparse points that supervise depth, and how far each can be trusted."""

import dataclasses

import jax
import numpy as np

from jaxnerf.core.cameras import project
from jaxnerf.core.types import SparsePoints
from jaxnerf.core.views import Views

_ACCURATE = 0.5  # px, standard deviation of an observation below which points do not differ in confidence
_LEAST = 0.05  # confidence below which an observation is dropped


def num_shared(views: Views) -> int:
    """Returns the number of observations of points that at least two of the views show; 0 without points."""
    if views.sparse is None or not len(views.sparse.point):
        return 0
    count = np.bincount(views.sparse.point)
    return int(count[count >= 2].sum())


def confident_observations(views: Views) -> SparsePoints:
    """Returns the views' SparsePoints with the confidence of each observation, without those that are unreliable.

    The n observations of a point determine its 3 coordinates, so its mean squared reprojection error per degree of
    freedom is s^2 = sum_i |e_i|^2 / (2 n - 3) px^2. The confidence is exp(-s^2 / m), where m is the median of s^2 over
    all observations, at least 0.25 px^2. It follows DS-NeRF (arXiv:2107.02791), which takes exp(-(e / mean e)^2) and
    ignores n: a wrong match of two views shows in one of their four equations only.

    Args:
        views: with `sparse`.

    Returns:
        SparsePoints. Observations are dropped whose confidence is below 0.05, as that of points that one view alone
        shows, or that lie behind one of their cameras; and those in masked pixels.

    Raises:
        ValueError: if there is no observation, or none is left.
    """
    if views.sparse is None or not len(views.sparse.view):
        raise ValueError(
            "losses.depth is set, and the dataset has no observations of sparse points, expected those of a COLMAP "
            "model with points3D; set losses.depth to 0, or add the model"
        )
    sparse = views.sparse
    positions, point = np.asarray(sparse.positions), np.asarray(sparse.point)
    cameras = jax.tree.map(lambda leaf: np.asarray(leaf)[sparse.view], views.cameras)
    projected = np.asarray(_project(cameras, positions[point]))
    errors = ((projected - sparse.pixel) ** 2).sum(axis=-1)  # inf behind the camera
    count = np.bincount(point, minlength=len(positions))
    variance = np.bincount(point, errors, minlength=len(positions)) / np.maximum(2 * count - 3, 1)
    variance = np.where(count >= 2, variance, np.inf)[point]
    finite = variance[np.isfinite(variance)]
    usual = max(np.median(finite), _ACCURATE**2) if finite.size else 1.0
    confidence = np.exp(-variance / usual)
    kept = confidence >= _LEAST
    if views.mask is not None:
        column, row = np.floor(sparse.pixel).astype(int).T
        kept &= np.asarray(views.mask)[
            np.asarray(views.offset)[sparse.view] + row * views.size[sparse.view, 1] + column
        ]
    if not kept.any():
        raise ValueError(
            f"losses.depth is set, and none of {len(kept)} observations of sparse points fits the cameras and masks, "
            "expected most to; set losses.depth to 0, or copy cameras, images and points of one model"
        )
    view, point, pixel = (np.asarray(values)[kept] for values in (sparse.view, sparse.point, sparse.pixel))
    confidence = np.float32(confidence[kept])
    return dataclasses.replace(sparse, view=view, point=point, pixel=pixel, confidence=confidence)


_project = jax.jit(jax.vmap(lambda camera, x: project(camera, x)[0]))
