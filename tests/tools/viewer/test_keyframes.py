"""Camera paths of keyframes, and the files that jaxnerf-render reads."""

import dataclasses
import os

import numpy as np
import pytest

import captures
from helpers import compiled
from jaxnerf import turntable
from jaxnerf.data import dataset
from jaxnerf.data.dataset import DataOptions
from jaxnerf.data.synthetic import load_synthetic
from jaxnerf.evaluation.paths.camera_path import make_path, read_path_file
from jaxnerf.tools.viewer.frame_renderer import FrameCamera
from jaxnerf.tools.viewer.keyframes import cameras_through, load_keyframes, save_path

POSES = compiled(turntable, "num_frames", "elevation")(4, center=np.zeros(3), radius=3.0, elevation=0.3)
VIEWS = load_synthetic(size=8)
KEYFRAMES = [FrameCamera(pose, fov, 64, 48) for pose, fov in zip(POSES, (0.5, 0.7, 0.9, 0.7), strict=True)]


@pytest.mark.slow
def test_the_path_goes_through_the_keyframes():
    frames = cameras_through(KEYFRAMES, seconds=1.9, fps=10)
    assert len(frames) == 19
    for index in range(4):
        np.testing.assert_allclose(frames[6 * index].to_world, POSES[index], atol=1e-5)
        assert frames[6 * index].fov == pytest.approx(KEYFRAMES[index].fov)
    assert frames[3].fov == pytest.approx(0.6)


def test_render_reads_the_saved_path_in_the_world_of_the_run(tmp_path):
    to_file = np.diag([2.0, 2.0, 2.0, 1.0])
    to_file[:3, 3] = 1, 2, 3
    captures.write_transforms(tmp_path / "data", captures.noise(captures.orbit(3)))
    data = DataOptions(dir=str(tmp_path / "data"), format="transforms", world="file")
    views = dataclasses.replace(dataset.load_split(data, "train"), to_file=to_file)
    frames = KEYFRAMES
    file = save_path(tmp_path, "my.path-1", frames, fps=10, views=views)
    assert file == tmp_path / "camera_paths" / "my.path-1.json"
    path = make_path(str(file), views)
    np.testing.assert_allclose(path.poses, [frame.to_world for frame in frames], atol=1e-5)
    assert (path.width, path.height, path.fps) == (64, 48, 10)
    np.testing.assert_allclose(path.focal[:, 1], [frame.focal for frame in frames])
    assert read_path_file(file).poses.shape == (4, 3, 4)
    again = load_keyframes(tmp_path, "my.path-1", views)
    np.testing.assert_allclose([frame.to_world for frame in again], path.poses)
    np.testing.assert_allclose([frame.fov for frame in again], [frame.fov for frame in frames])
    assert [(frame.width, frame.height) for frame in again] == [(64, 48)] * 4
    with pytest.raises(ValueError, match="no such path, expected one of: my.path-1"):
        load_keyframes(tmp_path, "other", views)


@pytest.mark.parametrize("name", ["../up", "/etc/passwd", "", ".hidden", "a/b", "a b", "x" * 65, "a\0b", 5, None])
def test_a_name_that_is_a_path_is_refused(tmp_path, name):
    with pytest.raises(ValueError, match="expected up to 64 letters"):
        save_path(tmp_path, name, KEYFRAMES, fps=24, views=VIEWS)
    assert not list(tmp_path.iterdir())


def test_a_link_out_of_the_workdir_is_refused(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "elsewhere").mkdir()
    os.symlink(tmp_path / "elsewhere", tmp_path / "run" / "camera_paths")
    with pytest.raises(ValueError, match="camera_paths: is a symbolic link"):
        save_path(tmp_path / "run", "mine", KEYFRAMES, fps=24, views=VIEWS)
    assert not list((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize(
    ("count", "seconds", "fps", "message"),
    [
        (1, 2, 24, "the path has 1 keyframes, expected 2 to 500"),
        (501, 2, 24, "the path has 501 keyframes"),
        (2, 1e9, 24, "expected 2 to 10000 frames"),
        (2, -1, 24, "expected 2 to 10000 frames"),
        (2, float("nan"), 24, "expected 2 to 10000 frames"),
        (2, 2, float("inf"), "expected 2 to 10000 frames"),
    ],
)
def test_paths_beyond_the_limits_are_refused(count, seconds, fps, message):
    with pytest.raises(ValueError, match=message):
        cameras_through((KEYFRAMES * 126)[:count], seconds=seconds, fps=fps)


def test_a_size_beyond_the_limit_is_refused(tmp_path):
    with pytest.raises(ValueError, match="5000 x 48 px, expected sides of 1 to 4096"):
        save_path(tmp_path, "mine", [KEYFRAMES[0]._replace(width=5000)], fps=24, views=VIEWS)
