"""Alignment of scored views: a closed-form scene seen from poses that are a little wrong, in another exposure."""

import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import captures
from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.metrics import psnr
from jaxnerf.core.pose_estimation import moved
from jaxnerf.core.rendering import render_rays
from jaxnerf.data import ray_batches
from jaxnerf.evaluation.restore import TrainedRun
from jaxnerf.evaluation.supersampling import render_pixels
from jaxnerf.tools.alignment import align_views
from jaxnerf.tools.alignment.align_views import Aligner
from jaxnerf.training.config import RunConfig, changed

SIZE = 24
GAINS = np.float32([0.7, 0.9, 1.1])
CHANGE = np.float32([0.02, -0.01, 0.015, 0.03, 0.05, -0.04])


def blobs(x, viewdirs):
    """A smooth ball with colours that vary in all directions."""
    return 8 * jnp.exp(-2 * (x**2).sum(axis=-1)), 0.5 + 0.4 * jnp.sin(3 * x + x[..., ::-1])


@pytest.fixture(scope="module")
def run():
    """What an aligner uses of a TrainedRun."""
    render = jax.jit(lambda variables, rays: render_rays(None, blobs, rays, num_samples=32))
    experiment = SimpleNamespace(
        view_rays=jax.jit(ray_batches.view_rays),
        world_depth=lambda views, index, pixels, depth: depth,
        config=changed(RunConfig(), {"eval.chunk": 2**13}),
    )
    return TrainedRun(experiment, None, None, render, "", render, None, None)


@pytest.fixture(scope="module")
def views(run):
    """Views with poses that are wrong by CHANGE, of images from the true ones, times GAINS."""
    true = captures.black_views(captures.orbit(2, height=SIZE, width=SIZE), to_file=np.diag(np.float32([2, 2, 2, 1])))
    images = [GAINS * np.asarray(rendered(run, true, index)) for index in range(2)]
    pixels = np.rint(255 * np.clip(images, 0, 1)).astype(np.uint8).reshape(-1, 3)
    cameras = jax.vmap(functools.partial(moved, change=jnp.asarray(CHANGE)))(true.cameras)
    names = ("first", "second")
    return dataclasses.replace(true, pixels=pixels, cameras=jax.tree.map(np.asarray, cameras), names=names)


def rendered(run, views, index):
    return render_pixels(run, None, views, index, pixel_grid(SIZE, SIZE), side=1)[0].rgb


def test_pose_and_exposure_are_aligned(run, views):
    before = rendered(run, views, 1)
    row = Aligner(("pose", "exposure")).scored(run, None, views, 1, before, side=1)
    assert psnr(before, views.image(1)) < 25 and row["psnr_pose_exposure_aligned"] > 45
    assert row["psnr_pose_exposure_half"] > 40 and row["ssim_pose_exposure_aligned"] > 0.99
    np.testing.assert_allclose(row["gains"], GAINS, rtol=0.01)
    assert row["rotation_degrees"] == pytest.approx(np.degrees(np.linalg.norm(CHANGE[:3])), rel=0.1)
    assert row["translation"] == pytest.approx(2 * np.linalg.norm(CHANGE[3:]), rel=0.1)  # in the files' units
    assert not row["pose_kept"]
    summary = Aligner(("pose", "exposure")).summary([row, row])
    assert summary["aligned"] == "pose_exposure" and "gains" not in summary
    assert summary["psnr_pose_exposure_aligned"] == row["psnr_pose_exposure_aligned"]
    line = align_views.line(summary)
    assert line.startswith("pose and exposure aligned: PSNR ") and "right halves" in line and "degrees" in line


def test_exposure_alone_leaves_the_pose(run, views):
    before = rendered(run, views, 0)
    row = Aligner(("exposure",)).scored(run, None, views, 0, before, side=1)
    assert row.keys() >= {"psnr_exposure_aligned", "ssim_exposure_aligned", "psnr_exposure_half", "gains"}
    assert psnr(before, views.image(0)) < row["psnr_exposure_aligned"] < 40 and "rotation_degrees" not in row


def test_gains_leave_the_background_as_it_is(run, views):
    alpha = np.zeros((2 * SIZE**2, 1), np.uint8)
    clear = dataclasses.replace(views, pixels=np.concatenate([views.pixels, alpha], axis=1), background=(1.0, 1.0, 1.0))
    row = Aligner(("exposure",)).scored(run, None, clear, 0, jnp.ones((SIZE, SIZE, 3)), side=1)
    np.testing.assert_array_equal(row["gains"], 1)
    assert row["psnr_exposure_aligned"] == np.inf


@pytest.mark.parametrize(
    "text, refine, exposure, parts",
    [
        (None, True, False, ("pose",)),
        (None, True, True, ("pose", "exposure")),
        ("exposure,pose", False, False, ("pose", "exposure")),
        ("none", True, True, None),
        (None, False, False, None),
    ],
)
def test_what_is_aligned(text, refine, exposure, parts):
    cameras = SimpleNamespace(refine=refine, exposure=exposure)
    aligner = align_views.requested(text)(SimpleNamespace(experiment=SimpleNamespace(cameras=cameras)))
    assert (aligner and aligner.parts) == parts


def test_a_wrong_flag_is_named():
    with pytest.raises(ValueError, match="--align is 'poses', expected pose, exposure, pose,exposure or none"):
        align_views.requested("poses")
