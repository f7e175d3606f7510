"""The confidence of observations of sparse points, and which of them are dropped."""

import dataclasses

import jax
import numpy as np
import pytest

from captures import black_views, orbit
from jaxnerf import SparsePoints
from jaxnerf.core.cameras import project
from jaxnerf.data.observations import confident_observations

VIEWS, POINTS = 5, 40


@pytest.fixture(scope="module")
def views():
    """Returns views of random points that all show with errors of 0.2 px; the first point shows in view 0 only."""
    cameras = orbit(VIEWS, lens="opencv")
    rng = np.random.default_rng(0)
    positions = np.float32(rng.uniform(-0.4, 0.4, (POINTS, 3)))
    pixels = jax.jit(jax.vmap(lambda camera: project(camera, positions)[0]))(cameras)
    view, point = (np.int32(index.ravel()) for index in np.indices((VIEWS, POINTS)))
    kept = (point > 0) | (view == 0)
    pixel = np.float32(np.asarray(pixels).reshape(-1, 2) + rng.normal(scale=0.2, size=(view.size, 2)))
    sparse = SparsePoints(positions=positions, view=view[kept], point=point[kept], pixel=pixel[kept])
    return black_views(cameras, sparse=sparse)


def changed(views, **fields):
    return dataclasses.replace(views, sparse=dataclasses.replace(views.sparse, **fields))


def test_points_with_larger_errors_have_less_confidence(views):
    """Those with errors well below half a pixel do not differ much; that of a wrong match is dropped."""
    pixel = views.sparse.pixel.copy()
    pixel[(views.sparse.point == 1) & (views.sparse.view == 2)] += [0.0, 1.5]
    pixel[(views.sparse.point == 2) & (views.sparse.view == 2)] += [20.0, 0.0]
    found = confident_observations(changed(views, pixel=pixel))
    kept = set(found.point.tolist())
    assert kept == set(range(POINTS)) - {0, 2}  # a single view proves nothing
    usual = np.median(found.confidence)
    assert 0.7 < usual < 1 and 0.05 < found.confidence[found.point == 1].max() < 0.7 * usual
    assert (np.diff(found.view) >= 0).all() and found.confidence.dtype == np.float32
    for point in (1, 5):  # all observations of a point have the confidence of its mean error
        assert len(set(found.confidence[found.point == point].tolist())) == 1


def test_a_track_of_two_views_needs_smaller_errors(views):
    pixel = views.sparse.pixel + np.float32([0.6, 0.0])
    short = ~np.isin(views.sparse.point, (3, 4)) | (views.sparse.view < 2)
    fields = {name: getattr(views.sparse, name)[short] for name in ("view", "point")}
    found = confident_observations(changed(views, pixel=pixel[short], **fields))
    confidence = np.bincount(found.point, found.confidence, POINTS) / np.maximum(np.bincount(found.point), 1)
    assert confidence[[3, 4]].max() < 0.8 * np.median(confidence)


def test_points_behind_a_camera_and_masked_pixels_are_dropped(views):
    positions = views.sparse.positions.copy()
    positions[3] = 1.5 * views.cameras.to_world[1, :, 3]
    column = np.arange(len(views.pixels)) % views.size[0, 1]
    masked = dataclasses.replace(changed(views, positions=positions), mask=column < 16)
    found = confident_observations(masked)
    assert 3 not in found.point and 0 < len(found.view) < len(views.sparse.view)
    assert (found.pixel[:, 0] < 16).all()


def test_no_usable_observation_is_an_error(views):
    for sparse in (None, jax.tree.map(lambda leaf: leaf[:0], views.sparse)):
        with pytest.raises(ValueError, match="losses.depth is set, and the dataset has no observations"):
            confident_observations(dataclasses.replace(views, sparse=sparse))
    with pytest.raises(ValueError, match="none of .* observations of sparse points fits the cameras and masks"):
        confident_observations(dataclasses.replace(views, mask=np.zeros(len(views.pixels), bool)))
