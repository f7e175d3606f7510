"""Images at several sizes: means of premultiplied colour, cameras of the same cones, and losses that weigh as sides."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf
from helpers import random_rays
from jaxnerf import Camera, Views
from jaxnerf.core.cameras import pixel_radius
from jaxnerf.core.types import Batch
from jaxnerf.data import ray_batches
from jaxnerf.data.scales import shrink_views, with_scales
from jaxnerf.data.view_selection import select_views
from jaxnerf.training import build
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step
from runs import PACKED, smoke_config
from toys import LOSSES, OPTIMIZER, toy_model

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")
WHITE = (1.0, 1.0, 1.0)


def views(dtype=np.uint16, channels=4, sizes=((8, 12), (9, 5)), **fields):
    """Returns views of noise; the second has 9 x 5 px."""
    rng, sizes = np.random.default_rng(0), np.int32(sizes)
    counts = sizes.prod(axis=1)
    to_world = np.stack([np.eye(3, 4, dtype=np.float32)] * len(sizes))
    focal, center = np.float32([[20, 22]] * len(sizes)), np.float32(sizes[:, ::-1]) / 2
    return Views(
        pixels=rng.integers(0, np.iinfo(dtype).max + 1, (counts.sum(), channels), dtype=dtype),
        offset=np.append(0, np.cumsum(counts)[:-1]).astype(np.int32),
        size=sizes,
        cameras=Camera(to_world=to_world, focal=focal, center=center),
        near=np.ones(len(sizes), np.float32),
        far=np.full(len(sizes), 5, np.float32),
        names=tuple("ab"[: len(sizes)]),
        background=WHITE if channels == 4 else None,
        **fields,
    )


@pytest.mark.parametrize(("dtype", "error"), [(np.uint8, 1 / 255), (np.uint16, 2e-5)])
@pytest.mark.parametrize("channels", [3, 4])
def test_each_pixel_is_the_mean_of_its_parts(dtype, error, channels):
    whole = views(dtype, channels)
    small = shrink_views(whole, 4)
    assert small.pixels.dtype == dtype
    np.testing.assert_array_equal(small.size, [[2, 3], [2, 1]])
    for index, (height, width) in enumerate(small.size):
        image = np.asarray(whole.image(index))[: 4 * height, : 4 * width]
        expected = image.reshape(height, 4, width, 4, 3).mean((1, 3))
        np.testing.assert_allclose(small.image(index), expected, atol=error)


def test_cones_of_a_small_image_are_those_of_its_pixels_in_the_large_one():
    whole = views(sizes=[(8, 8)])
    whole = dataclasses.replace(whole, cameras=dataclasses.replace(whole.cameras, height=8, width=8))
    small = shrink_views(whole, 2)
    assert (small.cameras.height, small.cameras.width) == (4, 4)
    at = np.float32([2.5, 1.5])
    large, wide = (each.camera(0) for each in (whole, small))
    rays, parts = (jaxnerf.rays_from_pixels(*each, near=1.0, far=2.0) for each in ((wide, at), (large, 2 * at)))
    np.testing.assert_allclose(rays.directions, parts.directions, rtol=1e-6)
    np.testing.assert_allclose(pixel_radius(wide, at), 2 * pixel_radius(large, 2 * at), rtol=1e-5)


def test_a_pixel_is_masked_if_a_part_of_it_is():
    mask = np.ones(8 * 12 + 9 * 5, bool)
    mask[[1 * 12 + 3, 8 * 12 + 4]] = False  # in the second column of the first view; cropped from the second
    small = shrink_views(views(mask=mask), 2)
    np.testing.assert_array_equal(np.flatnonzero(~small.mask), [1])


def test_all_sizes_are_views_of_the_same_images():
    whole = views(time=np.float32([0.2, 0.7]))
    found = with_scales(whole, 3)
    np.testing.assert_array_equal(found.pixels[: len(whole.pixels)], whole.pixels)
    np.testing.assert_array_equal(found.size, [[8, 12], [9, 5], [4, 6], [4, 2], [2, 3], [2, 1]])
    np.testing.assert_array_equal(found.image_index, [0, 1] * 3)
    np.testing.assert_array_equal(found.time, np.float32([0.2, 0.7] * 3))
    assert found.offset.dtype == found.size.dtype == found.image_index.dtype == np.int32
    for scale in range(3):
        part = shrink_views(whole, 2**scale)
        np.testing.assert_array_equal(select_views(found, [2 * scale + 1]).pixels, select_views(part, [1]).pixels)
    np.testing.assert_allclose(found.loss_weight / found.loss_weight[0], [1, 1, 2, 2, 4, 4], rtol=1e-6)
    assert found.loss_weight @ found.size.prod(axis=1) == pytest.approx(len(found.pixels), rel=1e-6)
    np.testing.assert_array_equal(select_views(found, [0, 5]).loss_weight, found.loss_weight[[0, 5]])


def test_too_many_sizes_are_refused():
    with pytest.raises(ValueError, match="view b: is 5 x 9 px, too small to be shrunk by 8; lower data.num_scales"):
        with_scales(views(), 2**30)


def test_rays_have_the_weight_of_their_view():
    whole = jax.tree.map(jnp.asarray, with_scales(views(), 2))
    draw = jax.jit(functools.partial(ray_batches.draw_batch, 0, 0, needs=("radius",)))
    _, batch = draw(jnp.arange(64), whole)
    weights = np.asarray(whole.loss_weight)
    large = np.asarray(batch.rays.radius) > 1.5 * np.asarray(batch.rays.radius).min()
    assert 0 < large.sum() < 64
    np.testing.assert_allclose(batch.loss_weight, np.where(large, weights[-1], weights[0]), rtol=1e-6)
    assert draw(jnp.arange(64), views())[1].loss_weight is None


def test_a_loss_weight_of_two_is_a_ray_drawn_twice():
    rays, rgb = random_rays(0, (4,)), np.random.default_rng(1).uniform(size=(4, 3)).astype(np.float32)

    def gradient_step(index, weight):
        def draw(step, positions, data):
            drawn = jax.tree.map(lambda leaf: jnp.asarray(leaf)[positions], Batch(rays=rays, rgb=rgb))
            return None, dataclasses.replace(drawn, loss_weight=weight)

        model = toy_model()
        step = make_train_step(model, OPTIMIZER, draw, LOSSES)
        return jax.jit(step)(create_state(model, OPTIMIZER, 0), None, jnp.asarray([index]))

    (_, twice), (_, heavy) = gradient_step([0, 1, 1], None), gradient_step([0, 1], np.float32([2, 4]) / 3)
    for name in ("loss", "grad_norm", "mse_fine"):
        np.testing.assert_allclose(heavy[name], twice[name], rtol=1e-5)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"data.ndc": True, "data.world": "forward"}, "data.ndc is True"),
        ({"train.batching": "single_image"}, "train.batching is 'single_image'"),
        ({"cameras.exposure": True, "cameras.num_images": 4}, "the section cameras has parameters"),
    ],
)
def test_what_several_sizes_do_not_fit_is_refused(settings, reason):
    config = smoke_config()
    config.update_from_flattened_dict({"data.num_scales": 2, **settings})
    with pytest.raises(ValueError, match=f"data.num_scales is 2, expected 1, as {reason}"):
        build.build(config)


MLP = {"field": "mlp", "fine.prefilter": "auto"}


@pytest.mark.extra
@pytest.mark.parametrize(
    "settings",
    [
        {**PACKED, "hash_grid.prefilter": "auto"},
        {**PACKED, **MLP},
        {**MLP, "coarse.prefilter": "auto"},
    ],
    ids=["hash_grid", "mlp", "hierarchical"],
)
def test_a_run_of_several_sizes_is_trained_and_rendered(tmp_path, settings):
    """Pixels of all sizes are drawn, and what an image shows depends on the size of its pixels."""
    config = smoke_config(max_steps=8, lr_steps=8)
    config.update_from_flattened_dict({**settings, "data.num_scales": 3})
    assert jaxnerf.train_and_evaluate(config, tmp_path / "run")
    run = jaxnerf.restore_run(tmp_path / "run")
    assert run.experiment.model.needs == (("length", "radius") if MLP.items() <= settings.items() else ("radius",))
    variables = run.variables(8)
    rays = run.experiment.view_rays(run.experiment.load_split("test"), 0, jaxnerf.pixel_grid(8, 8))
    small, large = (dataclasses.replace(rays, radius=scale * rays.radius) for scale in (1, 4))
    small, large = (np.asarray(run.render_image(variables, each).rgb) for each in (small, large))
    assert np.isfinite(small).all() and np.abs(small - large).max() > 1e-4
