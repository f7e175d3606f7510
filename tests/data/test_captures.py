"""The datasets that tests/captures.py writes are correct independently of the readers."""

import numpy as np
import pytest

import captures


@pytest.fixture(scope="session")
def shots():
    return captures.shoot(captures.front(6))


def test_a_sky_is_only_behind_the_scene(shots):
    skies = captures.shoot(captures.front(6), sky=True)
    for shot, sky in zip(shots, skies, strict=True):
        alpha = shot.pixels[..., 3]
        assert (sky.pixels[..., 3] == 65535).all() and (alpha == 0).any() and (alpha == 65535).any()
        solid = alpha == 65535
        assert np.abs(sky.pixels[solid, :3].astype(int) - shot.pixels[solid, :3]).max() <= 1
        assert sky.pixels[alpha == 0, :3].std() > 5000  # textured


def test_points_project_to_their_observations(tmp_path, shots):
    """Observations are checked in COLMAP's convention: y down, z forward, world to camera."""
    points = captures.write_colmap(tmp_path, shots)
    assert len(points.xyz) > 40 and points.seen.sum(axis=1).min() > 10
    assert (np.abs(points.xyz) < 1.3).all()
    _, _, width, height, fx, fy, cx, cy = _rows(tmp_path, "cameras")[0]
    assert (width, height) == ("32", "24")
    images = _rows(tmp_path, "images")
    assert len(images) == 12 and images[0][-1] == "000.png"
    for pose, marks in zip(images[::2], images[1::2], strict=True):
        (w, x, y, z), shift = np.float64(pose[1:5]), np.float64(pose[5:8])
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        marks = np.float64(marks).reshape(-1, 3)
        local = points.xyz[marks[:, 2].astype(int) - 1] @ turn.T + shift
        assert (local[:, 2] > 0).all()
        found = local[:, :2] / local[:, 2:] * np.float64([fx, fy]) + np.float64([cx, cy])
        np.testing.assert_allclose(found, marks[:, :2], atol=1e-4)


def test_llff_rows_hold_bounds_around_the_scene(tmp_path, shots):
    captures.write_llff(tmp_path, shots)
    rows = np.load(tmp_path / "poses_bounds.npy")
    assert rows.shape == (6, 17) and (2.5 < rows[:, 15]).all() and (rows[:, 16] < 5.5).all()
    assert (rows[:, 16] - rows[:, 15] > 0.5).all()
    with pytest.raises(ValueError, match="one pinhole camera"):
        captures.write_llff(tmp_path, captures.noise(captures.orbit(1, lens="opencv")))


def _rows(folder, name):
    lines = (folder / "sparse" / "0" / f"{name}.txt").read_text().splitlines()
    return [line.split() for line in lines if not line.startswith("#")]
