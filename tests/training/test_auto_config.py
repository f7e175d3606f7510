"""What a configuration leaves open is filled from cameras, masks and images, once."""

import copy
import dataclasses
import json

import jax
import numpy as np
import pytest
from ml_collections import ConfigDict

from configs import default, lego_fast, lego_mlp_fast
from helpers import compiled
from jaxnerf import Camera, Views
from jaxnerf.data import synthetic
from jaxnerf.data.ray_batches import view_rays
from jaxnerf.data.readers import blender
from jaxnerf.fields import still_life
from jaxnerf.training import workdir
from jaxnerf.training.auto_config import fill_from, is_open, resolve_sizes
from jaxnerf.training.build import build
from test_configs import fields

PIXEL = 4 / (1.36 * 24)  # what a pixel of the embedded scene covers at its middle


def an_open(field="grid", **occupancy):
    """Returns the default configuration with one field and a occupancy, their sizes open."""
    config = default.get_config()
    config.data.size, config.field = 24, field
    config.sampler = "occupancy"
    config.occupancy.update(occupancy)
    if field == "mlp":
        config.fine.num_freqs = 0
    return config


@pytest.fixture(scope="module")
def views():
    return synthetic.load_views(size=24)


@pytest.fixture(scope="module")
def fitted(views):
    return resolve_sizes(an_open(), views)


@pytest.mark.parametrize("missing", [False, True])
def test_a_configuration_without_a_space_is_left_alone(missing):
    config = default.get_config()
    if missing:  # of a run from before there were any
        config = ConfigDict({key: value for key, value in config.items() if key not in ("space", "features")})
    before = config.to_json_best_effort()
    got, lines = resolve_sizes(config, None)
    assert got.to_json_best_effort() == before and not lines
    assert got is not config and not is_open(config)


def test_all_that_is_open_is_filled_and_said(fitted, views):
    config, lines = fitted
    occupancy = config.occupancy
    longest = max(np.subtract(occupancy.upper, occupancy.lower))
    assert len(occupancy.lower) == len(occupancy.upper) == 3 and 2.3 < longest < 3.5
    assert 0.3 * PIXEL < occupancy.step_size < PIXEL
    assert 0.3 * PIXEL < longest / occupancy.resolution < PIXEL
    sizes = config.hash_grid.resolutions
    assert list(sizes) == sorted(set(sizes)) and 0.3 * PIXEL < longest / sizes[-1] < PIXEL
    assert not is_open(config)
    build(config)
    for word in ("box", "step", "cells", "features"):
        assert any(line.startswith(word) for line in lines), word
    assert f"a pixel covers {PIXEL:.4g}" in "".join(lines)


@pytest.mark.parametrize("field", ["grid", "mlp"])
@pytest.mark.parametrize("seen", [True, False])
def test_whether_colour_depends_on_the_direction_is_said(views, field, seen):
    config = an_open(field)
    (config.fine if field == "mlp" else config.hash_grid).use_viewdirs = seen
    said = [line for line in resolve_sizes(config, views)[1] if "colour by direction" in line]
    assert len(said) == 1 and said[0].startswith("kept" if seen else "left out")


def test_what_is_given_stays_as_it_was(views):
    given = an_open()
    before = given.to_json_best_effort()
    config, _ = resolve_sizes(given, views)
    assert given.to_json_best_effort() == before and is_open(given)
    changed = {name for name, value in fields(config).items() if value != fields(given)[name]}
    assert changed == {f"occupancy.{name}" for name in ("lower", "upper", "step", "resolution")} | {
        "hash_grid.resolutions"
    }
    kinds = {name: type(value) for name, value in fields(config).items()}
    assert kinds == {name: type(value) for name, value in fields(given).items()}


SET = [
    {"lower": (-1.0, -1.1, -1.2), "upper": (1.3, 1.4, 1.5)},
    {"step": 0.123},
    {"resolution": 7},
    {"lower": (-2.0,) * 3, "upper": (2.0,) * 3, "step": 0.2, "resolution": 9},
]


@pytest.mark.parametrize("given", SET, ids=lambda given: " ".join(given))
def test_what_is_set_is_kept(views, given):
    config = an_open(**given)
    config.hash_grid.resolutions = (5, 6)
    got, lines = resolve_sizes(config, views)
    assert {name: got.space[name] for name in given} == given
    assert got.features.resolutions == (5, 6)
    assert not is_open(got) and not any(line.startswith("features") for line in lines)


def test_half_a_box_is_not_replaced(views):
    """Either it is kept or it is named; it must not be overwritten without a word."""
    try:
        config, _ = resolve_sizes(an_open(lower=(-1.0, -1.1, -1.2)), views)
    except ValueError as error:
        assert "occupancy." in str(error)
    else:
        assert config.occupancy.lower == (-1.0, -1.1, -1.2)


def test_a_fitted_configuration_is_fitted_and_stays_so(fitted, views):
    config, _ = fitted
    again, _ = resolve_sizes(an_open(), views)
    assert again.to_json_best_effort() == config.to_json_best_effort()
    twice, _ = resolve_sizes(config, views)
    assert twice.to_json_best_effort() == config.to_json_best_effort()
    filled = fill_from(an_open(), config)
    assert filled.to_json_best_effort() == config.to_json_best_effort()


def test_a_network_of_octaves_is_fitted_too(views):
    config, _ = resolve_sizes(an_open("mlp"), views)
    wave = 2 * np.pi / 2 ** (config.fine.num_freqs - 1)
    assert 2 * PIXEL < wave < 8 * PIXEL
    assert not config.hash_grid.resolutions and not is_open(config)
    build(config)


def test_finer_images_are_trained_on_longer(views):
    """Sixteen times the pixels a side: four times the steps. What is set is kept, and lr_steps follows it."""
    config = an_open(lower=(-1.0,) * 3, upper=(1.0,) * 3)
    config.train.max_steps = config.train.lr_steps = 0
    assert is_open(config)
    got, lines = resolve_sizes(config, views)
    sharp, _ = resolve_sizes(config, dataclasses.replace(views, size=16 * views.size))
    assert sharp.train.max_steps == pytest.approx(4 * got.train.max_steps, abs=4)
    assert got.train.max_steps == got.train.lr_steps == round(1000 * 24**0.5) and not is_open(got)
    assert any(line.startswith("training") and "4,899" in line for line in lines)
    filled = fill_from(config, got)
    assert filled.to_json_best_effort() == got.to_json_best_effort()
    config.train.max_steps = 7
    got, lines = resolve_sizes(config, views)
    assert (got.train.max_steps, got.train.lr_steps) == (7, 7)
    assert not any(line.startswith("training") for line in lines)


def test_the_box_holds_all_matter_of_the_embedded_scene(fitted):
    lower, upper = (np.float32(bound) for bound in (fitted[0].occupancy.lower, fitted[0].occupancy.upper))
    x = np.random.default_rng(0).uniform(-2, 2, (1, 300_000, 3)).astype(np.float32)
    density, _ = compiled(still_life.still_life)(x, x)
    outside = ((x < lower) | (x > upper)).any(-1)
    assert (density > 0.1).mean() > 0.01 and not density[outside].max() > 0.1


def test_without_masks_the_box_is_what_all_cameras_see(fitted, views):
    config, lines = resolve_sizes(an_open(masks=False), views)
    opaque = dataclasses.replace(views, pixels=views.pixels[:, :3])
    assert resolve_sizes(an_open(), opaque)[0].occupancy.lower == config.occupancy.lower
    assert "nothing is known to be empty" in lines[0]
    # Cameras 4 away from the origin, which look at it with a focal length of 1.36 images.
    np.testing.assert_allclose(config.occupancy.upper, 3 * [4 / 1.36 / 2], atol=1e-3)
    np.testing.assert_allclose(config.occupancy.lower, 3 * [-4 / 1.36 / 2], atol=1e-3)
    assert (np.float64(fitted[0].occupancy.lower) >= np.float64(config.occupancy.lower) - 1e-4).all()


def test_a_scene_in_other_units_has_its_box_in_them(fitted, views):
    """A scene of a thousandth of the size has a thousandth of the box, to the same digits."""
    poses = views.cameras.to_world.copy()
    poses[:, :, 3] *= 1e-3
    small = dataclasses.replace(views, cameras=dataclasses.replace(views.cameras, to_world=poses))
    got, _ = resolve_sizes(an_open(), small)
    for name in ("lower", "upper", "step"):
        np.testing.assert_allclose(1e3 * np.float64(got.space[name]), fitted[0].space[name], rtol=2e-3)
    assert got.occupancy.resolution == fitted[0].occupancy.resolution


def test_in_normalised_coordinates_the_box_holds_all_rays():
    shift = np.zeros((2, 3, 4), np.float32) + np.eye(3, 4, dtype=np.float32)
    shift[:, :2, 3] = [[0.3, -0.1], [-0.2, 0.2]]
    size = np.int32([[20, 30]] * 2)
    views = Views(
        pixels=np.zeros((1200, 3), np.uint8),
        offset=np.int32([0, 600]),
        size=size,
        cameras=Camera(
            to_world=shift,
            focal=np.full((2, 2), 25, np.float32),
            center=np.float32([[15, 10]] * 2),
            height=20,
            width=30,
        ),
        near=np.zeros(2, np.float32),
        far=np.ones(2, np.float32),
    )
    config = an_open()
    config.data.ndc = True
    got, _ = resolve_sizes(config, views)
    pixels = np.random.default_rng(1).uniform(0, 1, (200, 2)).astype(np.float32) * [30, 20]
    for index in range(2):
        rays = compiled(view_rays, "ndc")(views, index, np.float32(pixels), ndc=True)
        for t in (rays.near, rays.far):
            x = rays.origins + t[:, None] * rays.directions
            assert (x >= np.float64(got.occupancy.lower) - 2e-4).all()
            assert (x <= np.float64(got.occupancy.upper) + 2e-4).all()


def test_the_record_of_a_run_builds_the_same_model(fitted, views, tmp_path):
    config, _ = fitted
    workdir.claim(tmp_path, config)
    workdir.claim(tmp_path, resolve_sizes(an_open(), views)[0])  # the same command goes on
    read = workdir.read_config(tmp_path)
    assert json.loads(read.to_json_best_effort()) == json.loads(config.to_json_best_effort())
    refitted, _ = resolve_sizes(read, views)
    assert json.loads(refitted.to_json_best_effort()) == json.loads(config.to_json_best_effort())
    mine, theirs = build(config).model, build(read).model
    for part in ("lower", "upper", "shape", "step"):
        assert tuple(np.ravel(getattr(mine.occupancy, part))) == tuple(np.ravel(getattr(theirs.occupancy, part)))
    shapes = [jax.eval_shape(model.init, jax.random.key(0)) for model in (mine, theirs)]
    assert jax.tree.structure(shapes[0]) == jax.tree.structure(shapes[1])
    assert jax.tree.leaves(shapes[0]) == jax.tree.leaves(shapes[1])
    other = copy.deepcopy(config)
    other.occupancy.step_size *= 2
    with pytest.raises(ValueError, match="belongs to a run with another configuration .occupancy.step_size"):
        workdir.claim(tmp_path, other)


@pytest.mark.scenes("lego")
def test_sizes_of_lego(scenes_dir):
    lego = blender.load_views(scenes_dir / "lego", split="train", factor=8)  # fewer views leave a larger box
    config, _ = resolve_sizes(lego_fast.get_config(), lego)
    occupancy = config.occupancy
    assert (np.abs([occupancy.lower, occupancy.upper]) < 1.3).all()
    assert 0.015 < occupancy.step_size < 0.025
    assert 64 <= occupancy.resolution <= 128 and 64 <= config.hash_grid.resolutions[-1] <= 256
    build(config)
    slow, _ = resolve_sizes(lego_mlp_fast.get_config(), lego)
    assert slow.occupancy.lower == occupancy.lower and slow.occupancy.step_size == occupancy.step_size
    assert config.train.max_steps == config.train.lr_steps == 10000
    build(slow)
