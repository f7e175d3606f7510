"""Worlds far from the origin, or in other units, give what the same cameras near the origin in usual units give."""

import dataclasses
import json
import pathlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import captures
import jaxnerf
from jaxnerf.core.cameras import project
from jaxnerf.data import dataset
from jaxnerf.data.geometry.bounds import unsuited_to_ndc
from jaxnerf.data.readers.base import Capture, Frame, origin_near, read_capture
from jaxnerf.evaluation.paths.camera_path import make_path
from jaxnerf.tools.capture_check import report
from jaxnerf.tools.exporters.options import ExportOptions
from jaxnerf.tools.viewer.frame_renderer import FrameCamera
from jaxnerf.tools.viewer.keyframes import save_path

SHIFTS = {
    "UTM": (500_000.0, 5_000_000.0, 120.0),
    "one axis": (0.0, 3e6, 0.0),
    "earth-centred": (4.2e6, 1.7e5, 4.78e6),
    "very far": (1e7, -2e7, 3.0),
}


def moved(shots, shift, scale=1.0):
    """Returns the shots with positions, in float64, times a scale and moved."""
    found = []
    for shot in shots:
        pose = np.array(shot.camera.to_world, np.float64)
        left, _, right = np.linalg.svd(pose[:, :3])
        pose[:, :3] = left @ right  # a rotation in float64, as COLMAP's positions are turned by it
        pose[:, 3] = scale * pose[:, 3] + shift
        found.append(shot._replace(camera=dataclasses.replace(shot.camera, to_world=pose)))
    return found


WRITERS = {
    "transforms": captures.write_transforms,
    "colmap": captures.write_colmap,
    "llff": captures.write_llff,
    "blender": captures.write_blender,
}


@pytest.fixture(scope="module")
def images():
    return captures.shoot(captures.orbit(6))


@pytest.fixture(scope="module")
def points(images):
    return captures.surface_points(images)


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("name", SHIFTS)
def test_views_are_those_near_the_origin(images, points, tmp_path, writer, name):
    for folder, shift in (("near", (0, 0, 0)), ("far", SHIFTS[name])):
        given = {"points": points._replace(xyz=points.xyz + shift)} if writer in ("colmap", "llff") else {}
        WRITERS[writer](tmp_path / folder, moved(images, shift), **given)
    near, far = (jaxnerf.load_dataset(tmp_path / folder, split="train") for folder in ("near", "far"))
    assert near.file_origin == (0, 0, 0)
    np.testing.assert_allclose(far.file_origin, SHIFTS[name], atol=5)
    np.testing.assert_allclose(far.near, near.near, rtol=1e-4)
    np.testing.assert_allclose(far.far, near.far, rtol=1e-4)
    poses = [np.asarray(views.cameras.to_world, np.float64) for views in (near, far)]
    rotations = [each[:, :, :3] for each in poses]
    np.testing.assert_allclose(rotations[1], rotations[0], atol=1e-5)
    apart = [each[:, :, 3] - each[0, :, 3] for each in poses]
    np.testing.assert_allclose(apart[1], apart[0], atol=1e-5)


def test_an_ordinary_world_stays_as_it_is():
    rng = np.random.default_rng(0)
    for distance in (0, 1, 20, 80):
        assert origin_near(rng.uniform(-1, 1, (20, 3)) + [distance, 0, 0]) is None
    assert origin_near(np.full((5, 3), 1e6)) is None  # one position: nothing says what is far
    positions = rng.uniform(-30, 30, (20, 3)) + [512_345.6, 0, 0]
    found = origin_near(positions)
    assert found[0] % 10 == 0 and abs(found[0] - 512_345.6) < 30 and (found[1:] % 10 == 0).all()


def test_single_cameras_without_a_position_do_not_keep_a_far_origin():
    positions = np.random.default_rng(0).uniform(-30, 30, (20, 3)) + SHIFTS["UTM"]
    positions[[3, 7]] = 0
    np.testing.assert_allclose(origin_near(positions), SHIFTS["UTM"], atol=30)


def test_the_box_of_an_export_is_in_the_files_own_coordinates():
    given = ExportOptions(box=(499_999.0, 4_999_998.0, 117.0, 500_001.0, 5_000_002.0, 123.0))
    assert given.relative_to(SHIFTS["UTM"]).box == (-1, -2, -3, 1, 2, 3)
    assert ExportOptions().relative_to(SHIFTS["UTM"]).corners is None


def test_the_check_finds_the_same(images, tmp_path):
    for folder, shift in (("near", (0, 0, 0)), ("far", SHIFTS["UTM"])):
        captures.write_transforms(tmp_path / folder, moved(images, shift))
    near, far = (report.inspect(tmp_path / folder) for folder in ("near", "far"))
    assert [finding.kind for finding in far.findings] == [finding.kind for finding in near.findings]
    assert read_capture(tmp_path / "far").choices[-1].startswith("positions are relative to (5000")


def test_camera_paths_are_in_the_files_own_coordinates(images, tmp_path):
    """A path that the viewer saves has the positions of the files in float64, and is read again without loss."""
    captures.write_transforms(tmp_path / "far", moved(images, SHIFTS["UTM"]))
    views = jaxnerf.load_dataset(tmp_path / "far", split="train")
    cameras = [FrameCamera(np.asarray(pose), 0.7, 32, 24) for pose in views.cameras.to_world[:2]]
    file = save_path(tmp_path, "mine", cameras, fps=10, views=views)
    stated = [frame["transform_matrix"] for frame in json.loads(file.read_text())["frames"]]
    whole = json.loads((tmp_path / "far" / "transforms.json").read_text())["frames"]
    by_name = {frame["file_path"].rsplit("/")[-1].split(".")[0]: frame["transform_matrix"] for frame in whole}
    np.testing.assert_allclose(stated, [by_name[name] for name in views.names[:2]], atol=1e-5)
    path = make_path(str(file), views)
    np.testing.assert_allclose(path.poses, np.asarray(views.cameras.to_world[:2]), atol=1e-6)


@pytest.mark.parametrize("scale", [1000.0, 0.05, 0.3])
def test_blender_scenes_in_other_units_have_another_near_and_far(images, tmp_path, scale):
    for split in ("train", "test"):
        captures.write_blender(tmp_path, moved(images, (0, 0, 0), scale), split=split)
    views = jaxnerf.load_dataset(tmp_path, split="test")
    np.testing.assert_allclose([views.near[0], views.far[0]], scale * np.array([2, 6]), rtol=0.02)
    stated = jaxnerf.load_dataset(tmp_path, split="test", near=1.0, far=9.0)
    assert (stated.near[0], stated.far[0]) == (1, 9)


def test_blender_scenes_of_the_paper_keep_2_and_6(images, tmp_path):
    for index, scale in enumerate((1.0, 0.6, 1.4)):
        captures.write_blender(tmp_path / str(index), moved(images, (0, 0, 0), scale))
        views = jaxnerf.load_dataset(tmp_path / str(index), split="train")
        assert (views.near[0], views.far[0]) == (2, 6)


def test_cameras_that_look_outwards_keep_2_and_6(tmp_path):
    turned = []
    for shot in captures.shoot(captures.orbit(6, distance=0.5)):
        pose = np.array(shot.camera.to_world, np.float64)
        pose[:, [0, 2]] *= -1  # half a turn
        turned.append(shot._replace(camera=dataclasses.replace(shot.camera, to_world=pose)))
    captures.write_blender(tmp_path, turned)
    views = jaxnerf.load_dataset(tmp_path, split="train")
    assert (views.near[0], views.far[0]) == (2, 6)


@pytest.mark.parametrize(
    "apart, near, far, survey",
    [
        (30.0, 20.0, 24.0, True),  # a flight over ground, 7 x 7 images
        (30.0, 12.0, 28.0, True),  # the same over hills, with the margins of bounds from points
        (30.0, 20.0, 90.0, False),  # deep
        (10.0, 20.0, 70.0, False),  # deep beside how far the cameras are apart
        (4.0, 20.0, 24.0, False),  # from nearly one place, as in LLFF's scenes
    ],
)
def test_cameras_far_apart_over_a_thin_layer_are_a_survey(apart, near, far, survey):
    frames = []
    for x, y in np.stack(np.meshgrid(*2 * [np.linspace(-0.5, 0.5, 7)]), axis=-1).reshape(-1, 2) * apart:
        pose = np.column_stack([np.eye(3), [x, y, 0.0]])
        camera = jaxnerf.Camera(to_world=pose, focal=np.full(2, 20.0), center=np.full(2, 10.0), height=20, width=20)
        frames.append(Frame(f"{len(frames)}", pathlib.Path("a.png"), camera, bounds=(near, far)))
    assert bool(unsuited_to_ndc(Capture("colmap", pathlib.Path("a"), tuple(frames)))) == survey


def flight(relief, *, apart=30.0, height=20.0, size=24):
    """Returns the Shots of 7 x 7 cameras that look down on hills, tilted by about a degree, and points of these."""
    rng = np.random.default_rng(0)
    places = np.stack(np.meshgrid(*2 * [np.linspace(-0.5, 0.5, 7)]), axis=-1).reshape(-1, 2) * apart
    turns = Rotation.from_euler("xyz", rng.normal(0, 0.02, (len(places), 3))).as_matrix()
    poses = np.concatenate([turns, np.column_stack([places, np.full(len(places), height)])[:, :, None]], axis=-1)
    stack = jaxnerf.Camera(
        to_world=np.float32(poses),
        focal=np.full((len(places), 2), 1.2 * size, np.float32),
        center=np.full((len(places), 2), size / 2, np.float32),
        height=size,
        width=size,
    )
    shots = captures.noise(stack)
    ground = rng.uniform(-0.8 * apart, 0.8 * apart, (3000, 2))
    xyz = np.column_stack([ground, relief / 2 * np.sin(ground / 4).sum(axis=1) / 2])
    at, depth = map(np.float64, zip(*(project(shot.camera, np.float32(xyz)) for shot in shots), strict=True))
    seen = (depth > 0) & (at > 0).all(axis=-1) & (at < size).all(axis=-1)
    return shots, captures.Points(xyz, np.full(xyz.shape, 128, np.uint8), seen, at, depth)


@pytest.mark.parametrize("writer", ["colmap", "llff"])
@pytest.mark.parametrize("relief, shift", [(0.5, (0, 0, 0)), (8.0, (0, 0, 0)), (8.0, SHIFTS["UTM"])])
def test_a_flight_over_hills_is_trained_around(tmp_path, writer, relief, shift):
    shots, points = flight(relief)
    WRITERS[writer](tmp_path, moved(shots, shift), points=points._replace(xyz=points.xyz + shift))
    data, lines, _ = dataset.resolve(dataset.DataOptions(format="auto", dir=str(tmp_path), world="auto", ndc="auto"))
    assert (data.world, data.ndc) == ("around", False)
    assert any("a layer that is thin" in line for line in lines)
    forward, *_ = dataset.resolve(dataset.replaced(data, world="auto", ndc=True))
    assert forward.world == "forward"  # what is asked for stays


@pytest.mark.scenes
def test_fern_is_no_survey(scenes_dir):
    assert not unsuited_to_ndc(read_capture(scenes_dir / "fern"))
