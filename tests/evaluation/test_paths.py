"""Camera paths: every pose is rigid and where its closed form says; path files, right and wrong."""

import dataclasses
import json
import math

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import compiled
from jaxnerf import Camera, Views, pixel_grid
from jaxnerf.core import poses as poses_module
from jaxnerf.data.geometry import path_poses
from jaxnerf.data.geometry.poses import up_of
from jaxnerf.data.ray_batches import view_rays
from jaxnerf.evaluation.paths import camera_path as camera_paths
from jaxnerf.evaluation.paths.camera_path import read_path_file

UP = np.float32([0, 0, 1])
look_at = compiled(poses_module.look_at)
interpolate = compiled(poses_module.interpolate, "num_frames", "closed")
turntable = compiled(poses_module.turntable, "num_frames", "elevation")


def turn(axis, degrees):
    """Returns the rotation about an axis (Rodrigues)."""
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    angle = math.radians(degrees)
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def pose(rotation, eye):
    return np.concatenate([rotation, np.reshape(eye, (3, 1))], axis=1)


def ring(count, half_axes=(4.0, 4.0), height=1.0, tilt=None):
    """Returns poses [count, 3, 4] around the provenance that look at it; the world is turned by tilt."""
    angle = 2 * np.pi * np.arange(count) / count
    eyes = np.stack([half_axes[0] * np.cos(angle), half_axes[1] * np.sin(angle), 0 * angle + height], axis=-1)
    flat = [look_at(np.float32(eye), np.zeros(3, np.float32), UP) for eye in eyes]
    return np.stack([each if tilt is None else tilt @ each for each in flat])


def views_of(poses, focal=100.0, names=None, to_file=None, near=2.0, far=6.0, size=(48, 64)):
    count = len(poses)
    return Views(
        pixels=np.zeros((0, 3), np.uint8),
        offset=np.zeros(count, np.int32),
        size=np.tile(np.int32([size]), (count, 1)),
        cameras=Camera(
            to_world=np.float32(poses),
            focal=np.broadcast_to(np.float32(focal), (2, count)).T.copy(),
            center=np.tile(np.float32([[31, 25]]), (count, 1)),
            height=size[0],
            width=size[1],
        ),
        near=np.full(count, near, np.float32),
        far=np.full(count, far, np.float32),
        names=names or tuple(f"v_{index}" for index in range(count)),
        to_file=to_file,
    )


def assert_rigid(poses):
    rotation = np.asarray(poses, np.float64)[:, :, :3]
    assert np.isfinite(poses).all()
    product = np.swapaxes(rotation, 1, 2) @ rotation
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=2e-6)
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=2e-6)


def assert_looks_at(poses, target):
    towards = np.asarray(target) - poses[:, :, 3]
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    np.testing.assert_allclose(-poses[:, :, 2], towards, atol=2e-6)


def test_a_turntable_is_a_circle_at_its_elevation():
    center = np.array([1.0, -2.0, 0.5])
    poses = turntable(16, center=center, radius=3.0, elevation=0.4)
    assert_rigid(poses)
    assert_looks_at(poses, center)
    np.testing.assert_allclose(np.linalg.norm(poses[:, :, 3] - center, axis=-1), 3, rtol=1e-6)
    np.testing.assert_allclose(poses[:, 2, 3] - 0.5, 3 * math.sin(0.4), rtol=1e-5)
    steps = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=-1)
    np.testing.assert_allclose(steps, 2 * 3 * math.cos(0.4) * math.sin(math.pi / 16), rtol=1e-5)
    assert (poses[:, 2, 1] > 0).all(), "up is up"


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (1.0, 0.1, 0.0), (-1.0, 2.0, 0.5)])
def test_a_turntable_needs_only_the_direction_of_up(up):
    poses, longer = (turntable(8, center=UP, radius=3.0, elevation=0.4, up=scale * np.array(up)) for scale in (1, 20))
    assert_rigid(poses)
    np.testing.assert_allclose(poses, longer, atol=2e-6)
    above = (poses[:, :, 3] - UP) @ np.array(up) / np.linalg.norm(up)
    np.testing.assert_allclose(above, 3 * math.sin(0.4), rtol=1e-5)


def test_a_spiral_is_the_llff_codes():
    """Against render_path_spiral, written out again, from a pose that is no identity."""
    middle, radii = pose(turn([1, 2, 3], 40), [1.0, 2.0, 3.0]), np.array([0.5, 0.3, 0.1])
    poses = compiled(poses_module.spiral, "num_frames")(120, pose=middle, radii=radii, focus=4.0)
    assert_rigid(poses)
    assert_looks_at(poses, middle @ [0, 0, -4, 1])
    angle = np.linspace(0, 4 * np.pi, 121)[:-1]
    local = np.stack([np.cos(angle), -np.sin(angle), -np.sin(0.5 * angle), 1 + 0 * angle]) * [
        *radii[:, None],
        [1],
    ]
    np.testing.assert_allclose(poses[:, :, 3], (middle @ local).T, atol=2e-6)
    assert ((poses[:, :, 1] @ middle[:, 1]) > 0.9).all()


def test_interpolation_passes_through_every_pose():
    knots = np.stack([pose(turn([1, k, 2], 50 * k), [k * k, -k, k % 2]) for k in range(5)])
    for closed, count in ((False, 4 * 6 + 1), (True, 5 * 6)):
        path = interpolate(count, poses=np.float32(knots), closed=closed)
        assert_rigid(path)
        np.testing.assert_allclose(path[::6], knots, atol=2e-5)
        assert np.linalg.norm(np.diff(path[:, :, 3], axis=0), axis=-1).max() < 20 / 6 * 1.5, "no leap"
    np.testing.assert_allclose(poses_module.path_times(25, 5)[::6], range(5), atol=1e-6)


def test_interpolation_is_even_between_two_poses_and_on_a_line():
    start, end = pose(np.eye(3), [0, 0, 0]), pose(turn([1, 1, 0], 80), [4, 0, 8])
    path = interpolate(5, poses=np.float32([start, end]))
    for part, found in zip(np.linspace(0, 1, 5), path, strict=True):
        expected = pose(turn([1, 1, 0], 80 * part), [4 * part, 0, 8 * part])
        np.testing.assert_allclose(found, expected, atol=2e-6)
    line = np.stack([pose(np.eye(3), [k, 2 * k, 0]) for k in range(4)])
    path = interpolate(13, poses=np.float32(line))
    np.testing.assert_allclose(path[:, :, 3], np.linspace(0, 3, 13)[:, None] * [1, 2, 0], atol=1e-5)


@pytest.mark.parametrize("closed", [False, True])
def test_interpolation_halfway_is_that_of_catmull_and_rom(closed):
    """Between b and c: (9 (b + c) - a - d) / 16, with the neighbours a and d; past an end they are on a line."""
    eyes = np.random.default_rng(0).normal(size=(5, 3))
    knots = np.stack([pose(np.eye(3), eye) for eye in eyes])
    around = np.roll(eyes, 1, axis=0), eyes, np.roll(eyes, -1, axis=0), np.roll(eyes, -2, axis=0)
    if not closed:
        padded = np.concatenate([[2 * eyes[0] - eyes[1]], eyes, [2 * eyes[-1] - eyes[-2]]])
        around = tuple(padded[k : k + 4] for k in range(4))
    a, b, c, d = around
    path = interpolate(10 if closed else 9, poses=np.float32(knots), closed=closed)
    np.testing.assert_allclose(path[1::2, :, 3], (9 * (b + c) - a - d) / 16, atol=1e-5)


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 179.99, 180.0, 270.0])
def test_interpolation_turns_the_shorter_way(degrees):
    knots = np.float32([pose(np.eye(3), [0, 0, 0]), pose(turn([2, -1, 0.5], degrees), [0, 0, 0])])
    path = interpolate(3, poses=knots)
    assert_rigid(path)
    shorter = min(degrees, 360 - degrees)
    cosine = (np.trace(path[1, :, :3]) - 1) / 2
    assert math.degrees(math.acos(min(cosine, 1))) == pytest.approx(shorter / 2, abs=0.05)


def test_a_single_pose_and_a_single_frame():
    knots = np.float32([pose(turn([1, 0, 0], 30), [1, 2, 3])])
    for closed in (False, True):
        np.testing.assert_allclose(interpolate(1, poses=knots, closed=closed), knots, atol=1e-6)
    np.testing.assert_allclose(interpolate(1, poses=np.float32(ring(4))), ring(4)[:1], atol=1e-6)


def test_the_mean_of_a_pose_and_its_mirror_image_lies_between():
    left, right = (pose(turn([0, 1, 0], angle), [angle, 0, 5]) for angle in (-20, 20))
    mean = compiled(poses_module.mean_pose)(np.stack([left, right]))
    np.testing.assert_allclose(mean, pose(np.eye(3), [0, 0, 5]), atol=1e-6)


def test_an_ellipse_passes_through_cameras_on_one():
    for tilt in (np.eye(3), turn([1, 0, 0], 70)):  # z is up; y is, nearly
        cameras = ring(16, (5.0, 3.0), 2.0, tilt)
        path = camera_paths.make_path("ellipse", views_of(cameras), num_frames=16)
        np.testing.assert_allclose(up_of(cameras), tilt @ UP, atol=1e-6)
        assert_rigid(path.poses)
        eyes = path.poses[:, :, 3] @ tilt
        np.testing.assert_allclose((eyes[:, 0] / 5) ** 2 + (eyes[:, 1] / 3) ** 2, 1, atol=1e-4)
        np.testing.assert_allclose(eyes[:, 2], 2, atol=1e-4)
        center = camera_paths.make_path("turntable", views_of(cameras), num_frames=16).poses
        assert_rigid(center)
        np.testing.assert_allclose(center[:, :, 3] @ tilt @ UP, 2, atol=0.05)


def test_a_turntable_frames_the_scene_as_the_cameras_nearby_do():
    """Cameras on one side look at a point above the others', as at the top of an object that is not level."""
    poses = np.array(ring(12))
    for index in np.flatnonzero(poses[:, 0, 3] > 0):
        poses[index] = look_at(np.float32(poses[index, :, 3]), np.float32([0, 0, 0.8]), UP)
    found = np.asarray(path_poses.make_poses("turntable", poses, 24), np.float64)
    axes, eyes = found[:, :, 2], found[:, :, 3]
    aims = eyes - (eyes * axes).sum(axis=1, keepdims=True) * axes
    assert aims[eyes[:, 0] > 1.5, 2].min() > aims[eyes[:, 0] < -1.5, 2].max() + 0.3


def test_up_is_across_the_horizons_of_an_arc_and_the_mean_of_views_that_look_one_way():
    tilt = turn([1, 0, 0], 70)
    np.testing.assert_allclose(up_of(ring(16, height=4.0, tilt=tilt)[:6]), tilt @ UP, atol=1e-5)
    forward = np.stack([pose(tilt @ turn([0, 1, 0], angle), [0, 0, 0]) for angle in (-5, 5)])
    np.testing.assert_allclose(up_of(forward), tilt[:, 1], atol=1e-6)


def test_a_spiral_has_the_amplitudes_of_the_cameras():
    offsets = np.stack(np.meshgrid(*[np.linspace(-side, side, 5) for side in (1.0, 0.5, 0.1)]), axis=-1).reshape(-1, 3)
    cameras = np.stack([pose(np.eye(3), offset) for offset in offsets])
    path = camera_paths.make_path("spiral", views_of(cameras))
    assert path.poses.shape == (120, 3, 4)
    assert_rigid(path.poses)
    np.testing.assert_allclose(np.abs(path.poses[:, :, 3]).max(0), [1, 0.5, 0.1], rtol=1e-2)


def test_interpolation_visits_views_in_the_order_of_their_names_with_their_focal_lengths():
    cameras = ring(3)
    views = views_of(cameras, focal=[100.0, 200.0, 300.0], names=("a_10", "a_2", "b_1"))
    path = camera_paths.make_path("interpolate", views)
    np.testing.assert_allclose(path.poses[::6], cameras[[1, 0, 2]], atol=1e-5)
    np.testing.assert_allclose(path.focal[[0, 3, 6, 9, 12], 0], [200, 150, 100, 200, 300], rtol=1e-5)
    closed = camera_paths.make_path("interpolate", views, closed=True)
    assert len(closed.poses) == 18
    np.testing.assert_allclose(closed.focal[[0, 6, 12, 15], 1], [200, 100, 300, 250], rtol=1e-5)


def test_another_size_keeps_the_field_of_view():
    path = camera_paths.make_path("turntable", views_of(ring(4)), num_frames=16)

    def corners(path):
        sides = np.array([[0, 0], [path.width, path.height]])
        return (sides - path.center[0]) / path.focal[0]

    for size in ((128, None), (None, 96), (128, 96)):
        twice = camera_paths.resize(path, *size)
        assert (twice.width, twice.height) == (128, 96)
        np.testing.assert_allclose(corners(twice), corners(path), rtol=1e-12)
    wide = camera_paths.resize(path, 640, 48)
    np.testing.assert_allclose(corners(wide)[:, 1], corners(path)[:, 1])
    assert wide.focal[0, 0] == wide.focal[0, 1], "square pixels"


@pytest.mark.parametrize("ndc", [False, True])
def test_rays_of_a_frame_are_those_of_its_own_camera(ndc):
    """In NDC they lie in the space of the first view's lens, as in training, whatever their own lens is."""
    views = views_of([pose(np.eye(3), [0, 0, 0])] * 2)
    path = camera_paths.CameraPath(
        "p",
        "p",
        np.stack([pose(turn([0, 1, 0], 5), [0.1, 0, 0])] * 2),
        np.array([[50.0, 60.0], [70.0, 70.0]]),
        np.array([[10.0, 9.0], [8.0, 8.0]]),
        20,
        16,
    )
    posed = camera_paths.posed_views(views, path)
    rays = view_rays(posed, 1, camera_paths.path_pixels(posed, path, 1), ndc=ndc)
    own = Camera(to_world=np.float32(path.poses), focal=np.float32(path.focal), center=np.float32(path.center))
    plain = view_rays(dataclasses.replace(posed, cameras=own), 1, pixel_grid(16, 20))
    np.testing.assert_allclose(rays.viewdirs, plain.viewdirs, atol=1e-6)
    if not ndc:
        np.testing.assert_allclose(rays.directions, plain.directions, atol=1e-6)
        assert (np.asarray(rays.near) == 2).all() and (np.asarray(rays.far) == 6).all()
        return
    # Eq. 25 at the near plane: x' = -(f / (W / 2)) x / z with the first view's f and W.
    direction, provenance = np.asarray(plain.directions), np.asarray(plain.origins)
    point = provenance + (-1 - provenance[..., 2:]) / direction[..., 2:] * direction
    np.testing.assert_allclose(rays.origins[..., 0], 100 / 32 * point[..., 0], atol=1e-5)


def test_a_frame_at_the_pose_of_a_view_has_the_rays_of_evaluation(tmp_path):
    cameras = ring(7)
    near, far = np.float32([0.35, 0.5, 0.82, 0.4, 0.7, 0.36, 0.6]), np.float32([6, 5, 4, 7, 6, 5, 8])
    views = dataclasses.replace(views_of(cameras), near=near, far=far)
    frames = [{"transform_matrix": matrix(each)} for each in cameras]
    path = camera_paths.make_path(written(tmp_path, {"frames": frames}), views)
    posed = camera_paths.posed_views(views, path)
    np.testing.assert_array_equal(posed.near, near)
    np.testing.assert_array_equal(posed.far, far)
    for index in (0, 2):
        found = view_rays(posed, index, camera_paths.path_pixels(posed, path, index))
        jax.tree.map(np.testing.assert_array_equal, found, view_rays(views, index, pixel_grid(48, 64)))


def test_near_and_far_of_a_frame_are_those_of_the_views_nearby_and_move_with_it():
    views = dataclasses.replace(
        views_of(ring(8)), near=np.float32([1, 2, 2, 2, 2, 2, 2, 2]), far=np.float32([6, 7, 7, 7, 7, 7, 7, 9])
    )

    def bounds(pose):
        near, far = camera_paths.frame_bounds(pose[None], views)
        return float(near[0]), float(far[0])

    first, fourth = ring(8)[0], ring(8)[4]
    between = interpolate(3, poses=ring(8)[:2])[1]
    assert 1.3 < bounds(between)[0] < 1.9 and 6.2 < bounds(between)[1] < 7
    forward = fourth.copy()
    forward[:, 3] -= 0.5 * forward[:, 2]
    assert bounds(forward) == pytest.approx((1.5, 6.5), abs=0.05)
    forward[:, 3] -= 2 * forward[:, 2]
    assert bounds(forward)[0] == 1, "no less than any view's"
    backward = fourth.copy()
    backward[:, 3] += 50 * backward[:, 2]
    near, far = bounds(backward)
    distance = np.linalg.norm(fourth[:, 3])
    assert 40 < near < 50 + distance < far <= 50.01 + 9, "what the views look at is between them"
    shared = views_of(ring(8), near=0.05, far=7.0)
    for pose in (first, between, forward):
        near, far = camera_paths.frame_bounds(pose[None], shared)
        assert near[0] == np.float32(0.05) and far[0] == np.float32(7.0)


def written(tmp_path, content, name="my path.json"):
    (tmp_path / name).write_text(json.dumps(content))
    return tmp_path / name


def matrix(each):
    return [*np.asarray(each, float).tolist(), [0, 0, 0, 1]]


SIMILARITY = np.block([[0.02 * turn([3, 1, 2], 100), np.array([[5.0], [-7.0], [9.0]])], [np.eye(4)[3:]]])


@pytest.mark.parametrize("to_file", [None, SIMILARITY])
def test_the_poses_of_a_file_are_in_the_datasets_world(tmp_path, to_file):
    expected = ring(3)
    in_file = expected
    if to_file is not None:
        eyes = expected[:, :, 3] @ to_file[:3, :3].T + to_file[:3, 3]
        in_file = np.concatenate([to_file[:3, :3] / 0.02 @ expected[:, :, :3], eyes[:, :, None]], axis=-1)
    frames = [{"transform_matrix": matrix(each)} for each in in_file]
    views = views_of(ring(5), to_file=to_file)
    path = camera_paths.make_path(str(written(tmp_path, {"frames": frames})), views)
    np.testing.assert_allclose(path.poses, expected, atol=1e-6)
    assert_rigid(path.poses)
    assert (path.name, path.width, path.height, path.fps) == ("my path", 64, 48, None)
    assert (path.focal == 100).all() and (path.center == [31, 25]).all(), "the first view's lens"


def test_a_file_may_state_its_own_intrinsics(tmp_path):
    bare = {"transform_matrix": matrix(ring(1)[0])}
    frames = [bare, {**bare, "fl_x": 70, "cx": 3}, {**bare, "fl_x": 80, "fl_y": 90}]
    content = {"frames": frames, "w": 200, "h": 100, "camera_angle_x": math.pi / 2, "fps": 12, "cy": 40}
    path = camera_paths.make_path(written(tmp_path, content), views_of(ring(5)))
    np.testing.assert_allclose(path.focal, [[100, 100], [70, 70], [80, 90]])
    np.testing.assert_allclose(path.center, [[100, 40], [3, 40], [100, 40]])
    assert (path.width, path.height, path.fps) == (200, 100, 12)
    path = camera_paths.make_path(written(tmp_path, {"frames": [bare], "h": 96}), views_of(ring(5)))
    assert (path.width, path.height) == (128, 96) and (path.focal == 200).all()


def test_a_path_of_nerfstudios_viewer(tmp_path):
    poses = ring(2)
    flat = np.reshape(matrix(poses[0]), -1).tolist()
    content = {
        "camera_type": "perspective",
        "render_height": 100,
        "render_width": 150,
        "seconds": 0.5,
        "camera_path": [
            {"camera_to_world": flat, "fov": 90, "aspect": 1.5},
            {"camera_to_world": matrix(poses[1]), "fov": 60, "aspect": 1.5},
        ],
    }
    path = camera_paths.make_path(written(tmp_path, content), views_of(ring(5)))
    np.testing.assert_allclose(path.poses, poses, atol=1e-6)
    np.testing.assert_allclose(path.focal[:, 0], [50, 50 * math.sqrt(3)])
    assert (path.width, path.height, path.fps) == (150, 100, 4) and (path.center == [75, 50]).all()
    del content["render_width"]
    assert camera_paths.make_path(written(tmp_path, content), views_of(ring(5))).width == 150


GOOD = matrix(ring(1)[0])
WRONG = {
    "has w, expected frames or camera_path": {"w": 3},
    "frames is not a list": {"frames": {}},
    "frames is not a list of 1": {"frames": []},
    r"frames\[1\]: is 3, expected an object": {"frames": [{"transform_matrix": GOOD}, 3]},
    r"frames\[0\]: has fl_x, expected transform_matrix": {"frames": [{"fl_x": 3}]},
    r"frames\[0\]: the camera-to-world matrix has shape \(2,\)": {"frames": [{"transform_matrix": [1, 2]}]},
    r"frames\[0\]: .* determinant -1": {"frames": [{"transform_matrix": np.diag([-1.0, 1, 1, 1]).tolist()}]},
    r"frames\[0\]: fl_x is -1, expected a number above 0": {"frames": [{"transform_matrix": GOOD, "fl_x": -1}]},
    r"frames\[0\]: has fl_y but no fl_x": {"frames": [{"transform_matrix": GOOD, "fl_y": 1}]},
    "w is 0.5, expected 1 to 16384": {"frames": [{"transform_matrix": GOOD}], "w": 0.5},
    "camera_angle_x but no w": {"frames": [{"transform_matrix": GOOD}], "camera_angle_x": 1},
    "fps is 'fast', expected a number": {"frames": [{"transform_matrix": GOOD}], "fps": "fast"},
    "expected render_height, too": {"camera_path": [{"camera_to_world": GOOD, "fov": 50}]},
    r"camera_path\[0\]: fov is 180": {
        "render_height": 9,
        "camera_path": [{"camera_to_world": GOOD, "fov": 180}],
    },
    r"camera_path\[0\]: has fov, expected camera_to_world": {"render_height": 9, "camera_path": [{"fov": 50}]},
    "camera_type is 'fisheye'": {
        "render_height": 9,
        "camera_type": "fisheye",
        "camera_path": [{"camera_to_world": GOOD, "fov": 50}],
    },
}


@pytest.mark.parametrize("message", WRONG)
def test_a_wrong_file_is_an_error_that_names_file_and_entry(tmp_path, message):
    with pytest.raises(ValueError, match=message) as error:
        read_path_file(written(tmp_path, WRONG[message]))
    assert str(tmp_path / "my path.json") in str(error.value) and "\n" not in str(error.value)


def test_a_wrong_kind_is_an_error(tmp_path):
    views = views_of(ring(3))
    with pytest.raises(ValueError, match="path is 'circle', expected one of turntable, arc, spiral, ellipse, inter"):
        camera_paths.make_path("circle", views)
    with pytest.raises(ValueError, match="No such file"):
        camera_paths.make_path(tmp_path / "none.json", views)
    with pytest.raises(ValueError, match="expected no --frames"):
        camera_paths.make_path(written(tmp_path, {"frames": [{"transform_matrix": GOOD}]}), views, num_frames=3)


NUMBERS = st.one_of(st.integers(), st.floats(), st.sampled_from([0, 1, 1e-300, 1e300, 10**400]))
VALUES = st.recursive(st.one_of(st.none(), st.booleans(), NUMBERS, st.text(max_size=3)), st.lists, max_leaves=5)
KEYS = ["frames", "w", "h", "fl_x", "fl_y", "cx", "camera_angle_x", "fps", "camera_path", "render_height"]
KEYS += ["render_width", "seconds", "camera_type", "transform_matrix", "camera_to_world", "fov", "aspect"]
FUZZED_WITH = views_of(ring(2))


@settings(max_examples=150, deadline=None)
@given(st.booleans(), st.sampled_from(KEYS), VALUES)
def test_any_value_of_a_field_is_read_or_a_clear_error(tmp_path_factory, own, key, value):
    frame = {"transform_matrix": GOOD, "camera_to_world": GOOD, "fov": 50, "fl_x": 30}
    content = {"w": 30, "h": 20, "render_height": 9}
    content["frames" if own else "camera_path"] = [{**frame, key: value}, frame]
    file = tmp_path_factory.getbasetemp() / "fuzzed.json"
    file.write_text(json.dumps({**content, key: value}))
    try:
        path = camera_paths.make_path(file, FUZZED_WITH)
    except ValueError as error:
        assert str(file) in str(error)
    else:
        assert np.isfinite(path.poses).all() and np.isfinite(path.focal).all() and (path.focal > 0).all()
        assert 1 <= path.width <= 16384 and 1 <= path.height <= 16384
