"""The scores of a run on the embedded room, on renderings that are known."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnerf.core.types import Rays, Rendering
from jaxnerf.data import ray_batches
from jaxnerf.data.dataset import load_dataset
from studies import study
from test_scenes import room, synthetic_capture

pytestmark = pytest.mark.slow
score_room = study("room/score_room")
SCHEDULE = SimpleNamespace(lower=(-2.0,) * 3, upper=(2.0,) * 3, cell=(0.1, 0.1, 0.1), contracted=True)


def known_run(folder, *, fog=0.0, too_deep=0.0):
    """Returns a run that renders the room exactly, but for fog in front of it and a depth that is too large."""
    views = load_dataset(folder, split="val")
    turn, shift = views.to_file[:3, :3], views.to_file[:3, 3]

    def render_image(variables, rays):
        rgb, t = room.render(np.asarray(rays.origins) @ turn.T + shift, np.asarray(rays.directions) @ turn.T)
        one = np.ones(t.shape)
        return Rendering(
            rgb=np.float32(rgb), opacity=one, depth=t + too_deep, disparity=1 / t, weights=None, num_dropped=0
        )

    def scene(x, viewdirs):
        return jnp.full(x.shape[:-1], fog), x

    model = SimpleNamespace(grid_schedule=SCHEDULE, scene=lambda *variables: scene)
    experiment = SimpleNamespace(
        model=model,
        load_split=lambda split, **options: load_dataset(folder, split=split),
        view_rays=ray_batches.view_rays,
    )
    return SimpleNamespace(experiment=experiment, variables=lambda step: (None, None), render_image=render_image)


@pytest.fixture(autouse=True)
def quick_metrics(monkeypatch):
    """Replaces the metrics of images, which have their own tests and take seconds to compile."""

    def metrics(image, truth, mask=None):
        squares = (np.asarray(image) - np.asarray(truth)) ** 2
        error = squares.mean() if mask is None else squares[mask].mean()
        return {"psnr": float(-10 * np.log10(error)), "ssim": 1.0}

    monkeypatch.setattr(score_room, "image_metrics", metrics)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room") / "capture"
    sizes = {
        "num_views": 24,
        "num_held_out": 2,
        "num_far": 2,
        "width": 32,
        "height": 24,
        "num_points": 0,
        "distortion": None,
    }
    return folder, synthetic_capture.write_capture(folder, **sizes)


def test_an_exact_run_has_no_error(written):
    folder, truth = written
    found = score_room.score(known_run(folder), 0, truth, num_rays=64)
    assert list(found) == ["val", "test"]
    for split in found.values():
        assert split["psnr"] > 30 and split["psnr_aligned"] > 30 and split["views"] == 2  # but for edges
        assert split["depth_error"] < 1e-4 and split["free_weight"] == split["free_weight_4_cells"] == 0
    lines = score_room.table(found)
    assert len(lines) == 4 and lines[2].startswith("| near the path (2) |") and "0.0 %" in lines[3]


def test_fog_and_wrong_depths_are_measured(written):
    folder, truth = written
    views = load_dataset(folder, split="val")
    unit = score_room.unit_of(views)
    found = score_room.score(known_run(folder, fog=0.1, too_deep=0.05), 0, truth, num_rays=768)["val"]
    speed = np.linalg.norm(ray_batches.view_rays(views, 0, np.full((1, 2), 16.0)).directions)
    assert found["depth_error"] == pytest.approx(0.05 * unit * speed, rel=0.2)
    assert found["depth_error_cells"] < 0.05 * speed * 1.4 / 0.1
    expected = (1 - np.exp(-0.1 * truth.depth[truth.split == "val"] / unit)).mean()
    assert 0.6 * expected < found["free_weight"] < 1.2 * expected  # rays are slanted, and a cell shorter
    assert 0 < found["free_weight_4_cells"] < 0.9 * found["free_weight"]


def test_the_optical_depth_of_a_slope_is_its_integral():
    rays = Rays(
        origins=jnp.zeros((2, 3)),
        directions=jnp.array([[2.0, 0, 0], [0, 1.0, 0]]),
        viewdirs=jnp.array([[1.0, 0, 0], [0, 1.0, 0]]),
        near=jnp.zeros(2),
        far=jnp.ones(2),
    )

    def slope(x, viewdirs):
        return jnp.abs(x).max(axis=-1), x

    found = score_room.optical_depth(slope, rays, jnp.array([0.5, 2.0]), jnp.array([1.5, 1.0]))
    np.testing.assert_allclose(found, [(9 - 1) / 2, 0], rtol=1e-5)


def test_cells_are_longer_where_space_is_contracted():
    x = np.array([[0.2, 0.1, 0.0], [0.2, 0.1, 0.0], [4.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    viewdirs = np.array([[1.0, 0, 0], [0.6, 0.8, 0], [1.0, 0, 0], [0, 1.0, 0]])
    # At m = 4 the contraction's slope is 1 / m^2 along x and (2 - 1 / m) / m across it.
    np.testing.assert_allclose(score_room.cell_lengths(SCHEDULE, x, viewdirs), [0.1, 0.1, 1.6, 0.1 * 16 / 7], rtol=1e-5)
    plain = SimpleNamespace(**{**vars(SCHEDULE), "contracted": False})
    np.testing.assert_allclose(score_room.cell_lengths(plain, x, viewdirs), 0.1, rtol=1e-5)


def test_an_affine_map_of_colors_is_undone():
    target = np.random.default_rng(0).uniform(0.1, 0.9, (6, 5, 3))
    mix = np.eye(3) * [0.8, 1.1, 0.9] + 0.02
    np.testing.assert_allclose(score_room.align_colors(target @ mix + 0.01, target), target, atol=1e-5)


def test_a_run_without_a_grid_is_refused(written):
    run = known_run(written[0])
    run.experiment.model.grid_schedule = None
    with pytest.raises(ValueError, match="has no occupancy grid"):
        score_room.score(run, 0, written[1])
