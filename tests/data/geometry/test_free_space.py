"""Depths between the sparse points of a view, and their cache."""

import builtins
import dataclasses
import os

import jax
import numpy as np
import pytest

from captures import black_views, orbit
from helpers import compiled
from jaxnerf import SparsePoints
from jaxnerf.core.cameras import project, rays_from_pixels
from jaxnerf.data.geometry import free_space
from jaxnerf.data.ray_batches import DEPTH_STRIDE

NORMAL, HEIGHT = np.array([0.2, -0.3, 0.9]), 0.1  # of a plane through all points
RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def views():
    """Returns two views of points on a plane; the second one has observed nothing."""
    cameras = orbit(2, height=90, width=120)
    positions = RNG.uniform(-0.8, 0.8, (60, 3))
    positions += np.outer((HEIGHT - positions @ NORMAL) / (NORMAL @ NORMAL), NORMAL)
    camera = jax.tree.map(lambda leaf: leaf[0], cameras)
    pixel = compiled(project)(camera, np.float32(positions))[0]
    index = np.arange(len(positions), dtype=np.int32)
    sparse = SparsePoints(positions=np.float32(positions), view=0 * index, point=index, pixel=pixel)
    return black_views(cameras, sparse=sparse)


def test_depths_are_exact_on_a_plane(views):
    depths = free_space.interpolated_depths(views)
    assert depths.shape == (2, *-(-views.size[0] // DEPTH_STRIDE), 2) and not depths[1].any()
    inverse, confidence = depths[0, ..., 0], depths[0, ..., 1]
    rows, columns = np.nonzero(confidence)
    assert len(rows) > 20 and (confidence <= 1).all() and not inverse[confidence == 0].any()
    pixels = np.float32(np.stack([columns, rows], axis=-1) + 0.5) * DEPTH_STRIDE
    rays = compiled(rays_from_pixels)(views.camera(0), pixels, near=1.0, far=9.0)
    places = rays.origins + rays.directions / inverse[rows, columns, None]
    np.testing.assert_allclose(places @ NORMAL, HEIGHT, atol=2e-3)


def test_depths_are_read_from_the_cache(views, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(free_space, "_SLOW", 0.0)
    made = free_space.interpolated_depths(views)
    monkeypatch.setattr(free_space, "_interpolated", lambda views: pytest.fail("computed again"))
    np.testing.assert_array_equal(free_space.interpolated_depths(views), made)
    smaller = dataclasses.replace(views, size=views.size - 8)
    with pytest.raises(pytest.fail.Exception):
        free_space.interpolated_depths(smaller)


def test_scipy_is_imported_with_a_single_thread_of_its_blas(monkeypatch):
    """Each of thousands of small matrices would otherwise wait for all threads."""
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    during, imported = [], builtins.__import__

    def spy(name, *rest, **options):
        during.append((name, os.environ.get("OPENBLAS_NUM_THREADS")))
        return imported(name, *rest, **options)

    monkeypatch.setattr(builtins, "__import__", spy)
    free_space.scipy_spatial.__wrapped__()
    assert ("scipy", "1") in during and "OPENBLAS_NUM_THREADS" not in os.environ
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    free_space.scipy_spatial.__wrapped__()
    assert ("scipy", "3") in during and os.environ["OPENBLAS_NUM_THREADS"] == "3"
