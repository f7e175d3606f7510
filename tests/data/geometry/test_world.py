"""Normalised worlds of datasets, and bounds along the cameras' axes."""

import numpy as np
import pytest

import captures
from jaxnerf import Camera
from jaxnerf.data.geometry import bounds, world
from jaxnerf.data.geometry.poses import gaze_center, look_one_way
from jaxnerf.data.readers.base import Capture, Frame


def capture_of(stack, **options):
    """Returns a Capture of a stack of cameras, without image files."""
    frames = []
    for index, pose in enumerate(np.asarray(stack.to_world, np.float64)):
        camera = Camera(
            to_world=pose,
            focal=np.asarray(stack.focal[index], np.float64),
            center=np.asarray(stack.center[index], np.float64),
            height=stack.height,
            width=stack.width,
        )
        frames.append(Frame(f"{index:03d}", None, camera))
    return Capture("test", "here", tuple(frames), **options)


def assert_similar(before, after, back):
    """Checks that `back` is a similarity that maps the poses and points of `after` to those of `before`."""
    scale = np.cbrt(np.linalg.det(back[:3, :3]))
    turn = back[:3, :3] / scale
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    for old, new in zip(world.poses_of(before), world.poses_of(after), strict=True):
        np.testing.assert_allclose(turn @ new[:, :3], old[:, :3], atol=1e-9)
        np.testing.assert_allclose(back[:3, :3] @ new[:, 3] + back[:3, 3], old[:, 3], atol=1e-9)
    if before.points is not None:
        np.testing.assert_allclose(after.points @ back[:3, :3].T + back[:3, 3], before.points, atol=1e-9)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0, 0, -1), (1, -1, 0.2)])
def test_centered_cameras_are_upright_at_distance_one(up):
    stack = captures.orbit(12)
    axis = np.array(up) / np.linalg.norm(up)
    spare = np.cross(axis, [0.3, 0.5, 0.8])
    spare /= np.linalg.norm(spare)
    turn = np.stack([spare, np.cross(axis, spare), axis], axis=-1)  # z goes to up
    poses = turn @ np.asarray(stack.to_world, np.float64) * [1, 1, 1, 3]
    poses[:, :, 3] += [5, 6, 7]
    moved = capture_of(
        Camera(to_world=poses, focal=stack.focal, center=stack.center, height=24, width=32),
        points=np.random.default_rng(0).normal(size=(5, 3)),
    )
    after, back = world.center(moved)
    assert_similar(moved, after, back)
    found = world.poses_of(after)
    np.testing.assert_allclose(gaze_center(found), 0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found[:, :, 3], axis=-1), 1, rtol=1e-4)
    np.testing.assert_allclose(found[:, 2, 0], 0, atol=1e-5)  # all horizons are level
    assert found[:, 2, 1].mean() > 0


def test_an_upright_world_is_not_rotated():
    _, back = world.center(capture_of(captures.orbit(12)))
    assert np.abs(back[:3, :3] / np.cbrt(np.linalg.det(back[:3, :3])) - np.eye(3)).max() < 1e-5
    box = (np.full(3, -2.0), np.full(3, 2.0))
    moved, back = world.center(capture_of(captures.orbit(12), box=box))
    corners = np.array(np.meshgrid(*zip(*box, strict=True))).reshape(3, -1).T
    inside = (corners - back[:3, 3]) @ np.linalg.inv(back[:3, :3]).T
    assert (inside >= moved.box[0] - 1e-9).all() and (inside <= moved.box[1] + 1e-9).all()


def test_recentering_is_a_similarity_and_sets_the_nearest_bound():
    stack = captures.front(9)
    before = capture_of(stack)
    before = before._replace(frames=tuple(f._replace(bounds=(2.0 + i, 20.0)) for i, f in enumerate(before.frames)))
    after, back = world.recenter(before)
    assert_similar(before, after, back)
    assert min(frame.bounds[0] for frame in after.frames) == pytest.approx(1 / 0.75)
    np.testing.assert_allclose(world.poses_of(after)[:, :, 3].mean(0), 0, atol=1e-9)


def test_cameras_look_one_way():
    assert look_one_way(world.poses_of(capture_of(captures.front(9))))
    assert not look_one_way(world.poses_of(capture_of(captures.orbit(9))))


def test_cameras_at_the_point_that_they_look_at_are_an_error():
    stack = captures.orbit(4)
    poses = np.array(stack.to_world)
    poses[:, :, 3] = 0
    with pytest.raises(ValueError, match="all 4 cameras are at the point that they look at"):
        world.center(capture_of(Camera(to_world=poses, focal=stack.focal, center=stack.center, height=9, width=9)))


def test_bounds_enclose_the_points():
    stack = captures.orbit(6)
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    plain = capture_of(stack, points=points)
    frames = tuple(frame._replace(seen=np.arange(500)) for frame in plain.frames)
    for frame in bounds.with_bounds(plain._replace(frames=frames)).frames:
        along = bounds.depths(frame.camera, points)
        near, far = frame.bounds
        assert 0.7 * along.min() < near < np.quantile(along, 0.02) and np.quantile(along, 0.98) < far
        assert far < 1.4 * along.max()
    few = plain._replace(frames=tuple(frame._replace(seen=np.arange(3)) for frame in plain.frames))
    assert bounds.with_bounds(few).frames[0].bounds == bounds.with_bounds(plain).frames[0].bounds


def test_bounds_without_points_begin_at_the_frusta_of_others_and_end_at_the_box():
    box = (np.full(3, -1.5), np.full(3, 1.5))
    for options, farthest in (({}, 40.1), ({"box": box}, 4 + 1.5 * 3**0.5 + 0.1)):
        for frame in bounds.with_bounds(capture_of(captures.orbit(12), **options)).frames:
            near, far = frame.bounds
            assert 0 < near < 3.5 and 5 < far < farthest  # other cameras see the space in front of each


def test_existing_bounds_are_kept():
    plain = capture_of(captures.orbit(4))
    given = plain._replace(frames=tuple(frame._replace(bounds=(1.0, 2.0)) for frame in plain.frames))
    assert bounds.with_bounds(given) is given
