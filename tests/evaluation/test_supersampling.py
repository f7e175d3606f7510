"""Several rays a pixel: how many, and that each pixel is their mean."""

import dataclasses
import json
import shutil

import imageio.v3 as iio
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.types import Rays
from jaxnerf.evaluation.evaluate import score_run, summary
from jaxnerf.evaluation.metrics import image_metrics
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.evaluation.supersampling import Footprint, render_pixels, trained_footprint
from jaxnerf.training.config import changed
from jaxnerf.training.workdir import load_config
from runs import render_path

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")
FOOTPRINT = Footprint(focal=100.0, center=np.float64([0, 0, 1]), distance=2.0, covered=1.0)


def pose(distance):
    return np.array([[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1 + distance]]])


@pytest.mark.parametrize(
    ("distance", "focal", "expected"),
    [
        (2, 100, 1),
        (2, 200, 1),
        (2, 50, 2),
        (2, 25, 4),
        (2, 12.5, 4),
        (4, 100, 2),
        (4, 50, 4),
        (0.1, 50, 2),
    ],
)
def test_rays_are_as_dense_as_in_training(distance, focal, expected):
    focal = np.array([[focal, focal]])
    assert FOOTPRINT.rays_per_side(pose(distance), focal) == [expected]
    assert FOOTPRINT.rays_per_side(pose(distance), focal, max_rays=3) == [1]
    wide = FOOTPRINT._replace(covered=4.0)  # the field is trained for pixels of four times the side
    assert wide.rays_per_side(pose(distance), focal, max_rays=10**6) <= [2]
    flat = FOOTPRINT._replace(distance=np.inf)  # in normalised device coordinates
    assert flat.rays_per_side(pose(distance), focal) == FOOTPRINT.rays_per_side(pose(1), focal)


def test_a_small_frame_is_the_mean_of_a_large_one(trained, tmp_path, capsys):
    """At a quarter of the size, the frame is that of full size shrunk by area; with one ray it is not."""
    workdir = shutil.copytree(trained, tmp_path / "run")
    run = restore_run(workdir)
    views = run.experiment.load_split("train")
    (height, width), matrix = views.size[0], np.eye(4)
    matrix[:3] = views.cameras.to_world[0]
    file = tmp_path / "one.json"
    file.write_text(json.dumps({"frames": [{"transform_matrix": matrix.tolist()}]}))
    images = {}
    for name, scale, most in (("whole", 1, 16), ("small", 4, 16), ("point", 4, 1)):
        options = {"width": int(width) // scale, "height": int(height) // scale, "max_rays_per_pixel": most}
        folder, *_ = render_path(workdir, path=str(file), name=name, video="none", overwrite=True, **options)
        images[name] = iio.imread(folder / "color" / "0000.png") / 255
        text = capsys.readouterr().err
        assert ("rays: 16 per pixel, as dense as those of training" in text) == (name == "small")
    expected = images["whole"].reshape(height // 4, 4, width // 4, 4, 3).mean((1, 3))
    np.testing.assert_allclose(images["small"], expected, atol=1.1 / 255)
    assert np.abs(images["point"] - expected).max() > 5 / 255


def test_cones_of_parts_of_a_pixel_are_narrower(trained):
    run, seen = restore_run(trained), []
    views = run.experiment.load_split("train")

    def view_rays(views, index, pixels):
        rays = run.experiment.view_rays(views, index, pixels)
        return dataclasses.replace(rays, radius=jnp.full(rays.near.shape, 0.6))

    def render_image(variables, rays):
        seen.append(rays)
        return run.render_image(variables, dataclasses.replace(rays, radius=None))

    fake = run._replace(experiment=dataclasses.replace(run.experiment, view_rays=view_rays), render_image=render_image)
    pixels = np.float32([[[3.0, 4.0], [5.0, 4.0]]])
    render_pixels(fake, run.variables(run.steps()[-1]), views, 0, pixels, side=3, size=2.0)
    (rays,) = seen
    np.testing.assert_allclose(rays.radius, 0.4)  # a third of a pixel whose side is two of the view's
    middle = run.experiment.view_rays(views, 0, pixels)
    np.testing.assert_allclose(rays.directions.mean(axis=0), middle.directions, atol=1e-6)
    assert isinstance(rays, Rays) and trained_footprint(run, views).covered == 1


def test_images_smaller_than_those_of_training_are_scored_as_they_are_shown(trained, tmp_path):
    """The figures of one ray stand beside them; those of images of the size of training are as they were."""
    workdir = shutil.copytree(trained, tmp_path / "run")
    config, results = load_config(workdir), {}
    for scale in (1, 2):
        run = restore_run(workdir, changed(config, {"data.size": config.data.size // scale}))
        results[scale] = score_run(run, workdir, overwrite=True)
    assert "psnr_one_ray" not in results[1] and "one ray" not in summary(results[1])
    found, variables, views = results[2], run.variables(run.steps()[-1]), run.experiment.load_split("test")
    assert "with one ray a pixel" in summary(found)
    assert {row["rays_per_pixel"] for row in found["images"]} == {4}
    for side, names in ((1, ("psnr_one_ray", "ssim_one_ray")), (2, ("psnr", "ssim"))):
        pixels = pixel_grid(*(int(value) for value in views.size[0]), offset=config.data.pixel_offset)
        image, _ = render_pixels(run, variables, views, 0, pixels, side=side)
        metrics = image_metrics(image.rgb, views.image(0))
        for name, metric in zip(names, ("psnr", "ssim"), strict=True):
            assert found["images"][0][name] == pytest.approx(metrics[metric], rel=1e-5)
    assert abs(found["psnr"] - found["psnr_one_ray"]) > 1e-3
