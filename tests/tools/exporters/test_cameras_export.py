"""The export of refined cameras: read again by the readers of the program and by pycolmap."""

import dataclasses
import functools
import os
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import captures
from jaxnerf.core.cameras import project
from jaxnerf.core.pose_estimation import moved
from jaxnerf.data import dataset
from jaxnerf.data.geometry.world import poses_in_file
from jaxnerf.data.readers.base import read_capture
from jaxnerf.evaluation.restore import TrainedRun
from jaxnerf.tools.exporters import cameras as exporter
from jaxnerf.tools.exporters.base import ExportSource
from jaxnerf.tools.exporters.options import CamerasOptions
from jaxnerf.training.config import RunConfig, changed

ZOOM = 1.02


def run_of(experiment):
    return TrainedRun(experiment, None, None, None, "", None, None, None)


def write_dataset(folder, format="colmap", lens="opencv"):
    """Writes images of noise with exact observations of random points; returns the Points of a COLMAP dataset."""
    shots = captures.noise(captures.orbit(9, lens=lens))
    if format == "transforms":
        return captures.write_transforms(folder, shots)
    xyz = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    at, depth = (
        np.stack(part) for part in zip(*(project(shot.camera, np.float32(xyz)) for shot in shots), strict=True)
    )
    size = np.array([shots[0].camera.width, shots[0].camera.height])
    points = captures.Points(xyz, np.zeros((40, 3), np.uint8), ((at > 0) & (at < size)).all(axis=-1), at, depth)
    return captures.write_colmap(folder, shots, points=points)


def make_source(folder, format):
    """Returns an ExportSource of a run whose cameras differ from those of a dataset, its lines, and the names."""
    fields = {"data.dir": str(folder), "data.format": format, "data.world": "around", "data.background": "none"}
    config = changed(RunConfig(), {**fields, "cameras.refine": True})
    views = dataset.load_split(config.data, "train")
    change = jnp.float32([0.01, -0.02, 0.005, 0.003, 0.002, -0.004, np.log(ZOOM)])
    refined = jax.tree.map(np.asarray, jax.vmap(functools.partial(moved, change=change))(views.cameras))
    lines = []
    experiment = SimpleNamespace(config=config, load_split=lambda split, images, given=views: given)
    run = run_of(experiment)
    exporter.check_refined(run)
    views = dataclasses.replace(views, cameras=refined)
    return ExportSource(run, 1, None, views, CamerasOptions(), lines.append), lines


@pytest.mark.parametrize("format, lens", [("colmap", "opencv"), ("transforms", "fisheye"), ("colmap", "pinhole")])
def test_refined_cameras_are_read_again(tmp_path, format, lens):
    data, out = tmp_path / "data", tmp_path / "out"
    write_dataset(data, format, lens)
    source, lines = make_source(data, format)
    out.mkdir()
    exporter.export_cameras(source, out)
    os.symlink(data / "images", out / "images")
    given = {frame.name: frame.camera for frame in read_capture(data, format).frames}
    expected = {name: np.asarray(camera.to_world) for name, camera in given.items()}
    trained = source.views.names
    poses = poses_in_file(source.views.cameras.to_world, source.views.to_file)
    expected |= dict(zip(trained, poses, strict=True))
    assert 0 < len(trained) < len(given) and any("refined cameras" in line for line in lines)
    for read in ("transforms", "colmap"):
        frames = read_capture(out, read).frames
        assert {frame.name for frame in frames} == expected.keys()
        for frame in frames:
            np.testing.assert_allclose(frame.camera.to_world, expected[frame.name], atol=1e-6)
            np.testing.assert_allclose(frame.camera.focal, ZOOM * given[frame.name].focal, rtol=1e-6)
            np.testing.assert_allclose(frame.camera.center, given[frame.name].center, atol=1e-6)
            assert (frame.camera.lens, frame.camera.width) == (lens, 32)
            if lens != "pinhole":
                np.testing.assert_allclose(frame.camera.distortion, given[frame.name].distortion, atol=1e-9)


def test_pycolmap_reads_the_model(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    data = tmp_path / "data"
    write_dataset(data)
    source, lines = make_source(data, "colmap")
    exporter.export_cameras(source, tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    ours = {frame.name: frame for frame in read_capture(_with_images(tmp_path, data), "colmap").frames}
    assert len(model.images) == 9 and len(model.points3D) == len(read_capture(data, "colmap").points)
    for image in model.images.values():
        frame = ours[image.name.removesuffix(".png")]
        matrix = image.cam_from_world().matrix()
        pose = np.asarray(frame.camera.to_world) * [1, -1, -1, 1]
        np.testing.assert_allclose(matrix[:, :3].T, pose[:, :3], atol=1e-6)
        np.testing.assert_allclose(-matrix[:, :3].T @ matrix[:, 3], pose[:, 3], atol=1e-6)
        assert image.num_points3D == len(frame.seen)
    assert any("points fit their observations within" in line for line in lines)


def _with_images(folder, data):
    os.symlink(data / "images", folder / "images")
    return folder


def test_points_are_triangulated_with_the_cameras(tmp_path):
    points = write_dataset(tmp_path)
    capture = read_capture(tmp_path, "colmap")
    cameras = [frame.camera for frame in capture.frames]
    places = exporter._on_plane(capture.frames, cameras)
    found = exporter.triangulated(capture.points + 0.1, capture.frames, cameras, places)
    seen_often = np.asarray(points.seen).sum(axis=0) >= 2
    np.testing.assert_allclose(found[seen_often], capture.points[seen_often], atol=1e-4)


def test_a_run_without_refined_cameras_is_refused():
    run = run_of(SimpleNamespace(config=RunConfig()))
    with pytest.raises(ValueError, match="has not refined its cameras; train with --config.cameras.refine=True"):
        exporter.check_refined(run)
