"""The colours of points that some views see and others do not, in closed form."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from export_sources import CENTER, RADIUS, SIZE, TO_FILE, ball, source_of
from jaxnerf import ndc_rays, points_on_rays, rays_from_pixels
from jaxnerf.tools.exporters.surface_colors import field_position, surface_colors
from jaxnerf.tools.exporters.surfaces import render_depth_images
from jaxnerf.training.config import changed

REACH, SHADES = 0.1, 0.05


def painted(x, viewdirs):
    """The ball, whose colour is the direction to the camera."""
    density, rgb = ball(x, viewdirs)
    return density, jnp.broadcast_to(0.5 - SHADES * viewdirs, rgb.shape)


@pytest.fixture(scope="module")
def images():
    return render_depth_images(source_of(painted), SIZE, colors=False)


def on_ball(directions):
    directions = np.float64(directions) / np.linalg.norm(directions, axis=-1, keepdims=True)
    return CENTER + 2 * RADIUS * directions, directions


def test_colors_are_those_of_the_views_that_see_a_point(images):
    """The eight that see it at the steepest angles, weighted by the cosine; fewer see this ball."""
    eyes = np.stack([image.camera.to_world[:, 3] for image in images]) - CENTER
    points, normals = on_ball(eyes[:5])
    towards = eyes + CENTER - points[:, None]
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    cosine = (towards * normals[:, None]).sum(axis=-1)
    cosine = np.where(cosine > 0.15, cosine, 0)
    best = np.argsort(-cosine, axis=1)[:, :8]
    weights, towards = (np.take_along_axis(each, best[..., None], axis=1) for each in (cosine[..., None], towards))
    expected = (weights * towards).sum(axis=1) / weights.sum(axis=1) @ (TO_FILE[:3, :3] / 2)  # in the axes of the run
    found = surface_colors(source_of(painted), images, points, normals, REACH)
    np.testing.assert_allclose(found / 255, 0.5 + SHADES * expected, atol=0.003)


def test_views_that_show_another_color_than_most_do_not_count(images):
    """A matte that cuts the object in some images makes the field show the background from there."""
    eyes = np.stack([image.camera.to_world[:, 3] for image in images]) - CENTER
    towards = eyes / np.linalg.norm(eyes, axis=1, keepdims=True)
    points, normals = on_ball(eyes[[5]])
    wrong = np.argsort(-(towards @ normals[0]))[1:3]
    away = -towards[wrong] @ (TO_FILE[:3, :3] / 2)  # in the axes of the run

    def cut(x, viewdirs):
        density, rgb = painted(x, viewdirs)
        is_wrong = (viewdirs @ jnp.float32(away).T).max(axis=-1, keepdims=True) > 0.95
        return density, jnp.where(is_wrong, 0.9, rgb)

    found, right = (surface_colors(source_of(each), images, points, normals, REACH) for each in (cut, painted))
    assert np.abs(found.astype(int) - right).max() <= 10  # of 255


def test_a_point_that_no_view_sees_has_the_color_of_the_nearest(images):
    eye = images[0].camera.to_world[:, 3] - CENTER
    points, normals = on_ball([eye, -eye])
    rgb = surface_colors(source_of(painted), images[:1], points, normals, REACH)
    assert (rgb[0] == rgb[1]).all() and rgb[0].max() > 0
    hidden = surface_colors(source_of(painted), images[:1], points - 3 * REACH * normals, normals, REACH)
    assert not hidden.any()  # the ball is in front of both


def test_poses_that_are_not_of_training_views_count_only_alone(images):
    eye = images[0].camera.to_world[:, 3] - CENTER
    order = np.argsort([-(image.camera.to_world[:, 3] - CENTER) @ eye for image in images])
    first, second = (images[index] for index in order[:2])
    points, normals = on_ball([eye])
    rgb = [
        surface_colors(source_of(painted), some, points, normals, REACH)[0].astype(int)
        for some in ([second], [first._replace(name=None), second], [first._replace(name=None)])
    ]
    assert np.abs(rgb[0] - rgb[1]).max() <= 1 and np.abs(rgb[1] - rgb[2]).max() > 2


def test_positions_are_those_at_which_rays_evaluate_the_field():
    source, pixels = source_of(), jnp.array([[3.5, 4.5], [20.0, 30.0]])
    t = jnp.float32([[2.0], [3.0]])  # of rays in the run's world
    lens = source.views.camera(0)
    for pose, ndc in ((lens.to_world, False), (np.eye(3, 4, dtype=np.float32), True)):
        source.run.experiment.config = changed(source.run.experiment.config, {"data.ndc": ndc})
        camera = dataclasses.replace(lens, to_world=pose)
        rays = rays_from_pixels(camera, pixels, near=1.5, far=4.5)
        x = points_on_rays(rays, t)
        files = np.asarray(x) @ TO_FILE[:3, :3].T + TO_FILE[:3, 3]
        if ndc:  # t of the near plane is 1
            x = points_on_rays(ndc_rays(rays, camera), 1 - 1 / t)
        np.testing.assert_allclose(field_position(source)(jnp.float32(files)), x, atol=1e-5)
