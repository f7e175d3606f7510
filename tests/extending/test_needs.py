"""The examples of fields that ask for more: they train, and what they ask for improves their images."""

import dataclasses
import functools

import cone_field
import moving_bodies
import numpy as np
import pytest

import jaxnerf
from jaxnerf.data.synthetic import load_synthetic
from runs import smoke_config

NETWORK = {"depth": 4, "width": 64}


def config_of(field, steps, **fields):
    """Returns a config with one network of 4 layers of 64 features."""
    config = smoke_config(max_steps=steps, lr_steps=steps, save_every=steps, log_every=100)
    config.update_from_flattened_dict({"field": field, "sampling.num_fine": 0, "train.batch_size": 256, **fields})
    options = {"skip_layer": 2, "num_freqs": 8, "num_view_freqs": 2}
    config.cone, config.timed_mlp = NETWORK | options, dict(NETWORK)
    activation = {"view_width": 32, "density_activation": "softplus", "density_bias": -1.0}
    config.fine.update(NETWORK | options | activation)
    return config


def score(run, views):
    """Returns the mean PSNR of the last checkpoint over views."""
    variables, values = run.variables(run.steps()[-1]), []
    for index, (height, width) in enumerate(views.size):
        rays = run.experiment.view_rays(views, index, jaxnerf.pixel_grid(int(height), int(width)))
        values.append(float(jaxnerf.psnr(run.render_image(variables, rays).rgb, views.image(index))))
    return np.mean(values)


def train_at_scales(field, workdir, *, steps, size, num_samples, factors, trained=(1, 2, 4)):
    """Trains on the embedded scene at some fractions of a resolution; returns the run's PSNR at others."""
    config = config_of(field, steps, **{"data.size": size, "sampling.num_coarse": num_samples, "train.lr_init": 5e-3})
    views = cone_field.multi_scale(load_synthetic(size=size), trained)
    assert jaxnerf.train_and_evaluate(config, workdir, views=views)
    run, test = jaxnerf.restore_run(workdir), load_synthetic(split="test", size=size)
    return [score(run, cone_field.shrunk(test, factor)) for factor in factors]


@pytest.mark.extra
def test_a_cone_field_learns(tmp_path):
    (quarter,) = train_at_scales("cone", tmp_path / "run", steps=200, size=32, num_samples=24, factors=(4,))
    assert quarter > 20.5


@pytest.mark.extra
def test_a_cone_field_is_better_at_lower_resolution_than_the_papers_network(tmp_path):
    """If both see three resolutions; prints the table of docs/extending/cone_field.md."""
    scores, options = {}, {"steps": 1200, "size": 64, "num_samples": 48, "factors": (1, 2, 4)}
    for trained in ((1, 2, 4), (1,)):
        for field in ("cone", "mlp"):
            scores[field, trained] = train_at_scales(field, tmp_path / f"{field}{trained}", trained=trained, **options)
            print(field, trained, *(f"{value:.2f}" for value in scores[field, trained]))
    test = cone_field.shrunk(load_synthetic(split="test", size=64), 4)
    images = [render_exactly(test.rays(index)) for index in range(len(test.size))]
    print(f"exact {np.mean([jaxnerf.psnr(image, test.image(index)) for index, image in enumerate(images)]):.2f}")
    cone, mlp = scores["cone", (1, 2, 4)], scores["mlp", (1, 2, 4)]
    assert cone[2] > 25 and cone[2] > mlp[2] + 0.2


def render_exactly(rays):
    """Renders the embedded scene itself, with one ray through each pixel."""
    white = np.ones(3, np.float32)
    return jaxnerf.render_rays(None, jaxnerf.still_life, rays, num_samples=384, background=white).rgb


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("moving")
    moving_bodies.write_dataset(folder)
    return folder


@pytest.mark.extra
def test_a_moving_scene_is_learned_from_images_with_times(dataset, tmp_path):
    """Unseen views at unseen times; with the time frozen the same network shows the bodies at the wrong places."""
    fields = {"data.format": "blender", "data.dir": str(dataset), "data.near": 2.8, "data.far": 5.2}
    fields |= {"sampling.num_coarse": 32, "train.lr_init": 8e-3}
    assert jaxnerf.train_and_evaluate(config_of("timed_mlp", 400, **fields), tmp_path / "run")
    run = jaxnerf.restore_run(tmp_path / "run")
    test = run.experiment.load_split("test")
    assert len(np.unique(test.time)) == len(test.size) == 6
    value = score(run, test)
    frozen = score(run, dataclasses.replace(test, time=np.zeros(6, np.float32)))
    print(f"moving {value:.2f}, frozen {frozen:.2f}")
    assert value > 21.5 and value > frozen + 4


@pytest.mark.extra
def test_the_dataset_shows_the_bodies_where_they_are(dataset):
    """A frame equals the closed form at its camera and its time."""
    views = jaxnerf.load_dataset(dataset, split="test", near=2.0, far=6.0)
    scene = functools.partial(moving_bodies.bodies, time=np.full((1, 1, 1), views.time[3]))
    image = jaxnerf.render_rays(None, scene, views.rays(3), num_samples=128, background=(1.0, 1.0, 1.0))
    assert jaxnerf.psnr(image.rgb, views.image(3)) > 45
