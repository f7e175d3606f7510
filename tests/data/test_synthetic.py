"""The embedded dataset: its difficulty, its splits and its cache."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxnerf.core import cameras, rendering
from jaxnerf.data import synthetic
from jaxnerf.tools.embedded_scene import render, still_life


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="session")
def test_images(cache):
    """[8, 100, 100, 3] float64, over white."""
    return _over_white(synthetic.load_synthetic(split="test", cache=cache).pixels).reshape(8, 100, 100, 3)


def _over_white(pixels):
    values = pixels / 65535
    return values[..., :3] * values[..., 3:] + 1 - values[..., 3:]


def _mean_psnr(images, others):
    return np.mean(-10 * np.log10(((images - others) ** 2).mean(axis=(1, 2, 3))))


def test_white_images_score_at_most_12_db(test_images):
    assert _mean_psnr(test_images, 1.0) <= 12


@pytest.mark.parametrize("method", ["NEAREST", "BILINEAR", "BICUBIC"])
def test_images_upscaled_from_a_quarter_score_at_most_26_db(test_images, method):
    small = test_images.reshape(8, 25, 4, 25, 4, 3).mean((2, 4)).astype(np.float32)

    def enlarge(channel):
        return np.asarray(Image.fromarray(channel).resize((100, 100), Image.Resampling[method]))

    large = np.stack([np.stack([enlarge(view[..., k]) for k in range(3)], -1) for view in small])
    assert _mean_psnr(test_images, np.clip(large, 0, 1)) <= 26


def test_all_matter_is_in_the_cylinder_and_between_near_and_far(cache):
    """A rendering from near to far, as a model's, agrees with the stored pixels."""
    views = synthetic.load_synthetic(split="test", size=20, cache=cache)
    camera = jax.tree.map(lambda leaf: leaf[3], views.cameras)
    rays = cameras.rays_from_pixels(
        camera, cameras.pixel_grid(20, 20), near=views.near[3].item(), far=views.far[3].item()
    )
    render = jax.jit(lambda rays: rendering.render_rays(None, still_life.still_life, rays, num_samples=1024))
    result = render(rays)
    stored = views.pixels.reshape(8, 20, 20, 4)[3] / 65535
    np.testing.assert_allclose(result.opacity, stored[..., 3], atol=1e-3)
    np.testing.assert_allclose(result.rgb, stored[..., :3] * stored[..., 3:], atol=1e-3)


def test_splits_are_complete_and_all_poses_differ(cache):
    backs = []
    for split, count in (("train", 60), ("val", 8), ("test", 8)):
        views = synthetic.load_synthetic(split=split, size=2, cache=cache)
        assert views.pixels.shape == (count * 4, 4) and views.pixels.dtype == np.uint16
        np.testing.assert_array_equal(views.offset, 4 * np.arange(count))
        assert len(views.names) == count and views.background == (1.0, 1.0, 1.0)
        np.testing.assert_allclose(views.cameras.to_world[:, :, 3], 4 * views.cameras.to_world[:, :, 2], atol=1e-5)
        backs.append(views.cameras.to_world[:, :, 2])
    backs = np.concatenate(backs)
    assert len(np.unique(views.names)) == 8
    angles = np.degrees(np.arccos(np.clip(backs @ backs.T, -1, 1))) + 180 * np.eye(76)
    assert angles.min() > 2


def test_images_show_the_whole_scene(test_images):
    border = np.concatenate([test_images[:, [0, -1]], test_images[:, :, [0, -1]].swapaxes(1, 2)])
    assert np.abs(1 - border).max() < 0.02


def test_the_cache_returns_the_same_bits_without_rendering(tmp_path, monkeypatch):
    first = synthetic.load_synthetic(split="val", size=8, cache=tmp_path).pixels
    (path,) = tmp_path.iterdir()
    monkeypatch.setattr(render, "render_views", lambda *_: pytest.fail("rendered again"))
    np.testing.assert_array_equal(synthetic.load_synthetic(split="val", size=8, cache=tmp_path).pixels, first)
    # Source code, size, split and finish are part of the file's name.
    monkeypatch.setattr(render, "render_views", lambda stack, finish: np.zeros((8 * stack.height**2, 4), np.uint16))
    for change in ({"size": 9}, {"split": "test"}, {"finish": "matt"}):
        synthetic.load_synthetic(**{"split": "val", "size": 8, **change}, cache=tmp_path)
    monkeypatch.setattr(render, "fingerprint_of_code", lambda: "changed")
    assert not synthetic.load_synthetic(split="val", size=8, cache=tmp_path).pixels.any()
    assert len(list(tmp_path.iterdir())) == 5 and path.exists()


def test_a_damaged_cache_file_is_replaced(tmp_path, caplog):
    first = synthetic.load_synthetic(split="val", size=8, cache=tmp_path).pixels
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 255
    for body in (b"", b"garbage", whole[: len(whole) // 2], bytes(flipped)):
        path.write_bytes(body)
        again = synthetic.load_synthetic(split="val", size=8, cache=tmp_path).pixels
        np.testing.assert_array_equal(again, first)
        np.testing.assert_array_equal(np.load(path)["pixels"], first)
    np.savez(path, pixels=first[:5])
    np.testing.assert_array_equal(synthetic.load_synthetic(split="val", size=8, cache=tmp_path).pixels, first)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    assert len(caplog.records) >= 5


def test_an_unwritable_cache_folder_only_warns(tmp_path, caplog, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    views = synthetic.load_synthetic(split="val", size=4, cache=tmp_path / "file")
    assert views.pixels.shape == (128, 4) and "cannot be written" in caplog.text
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    synthetic.load_synthetic(split="val", size=4)
    assert len(list((tmp_path / "home" / "jaxnerf").iterdir())) == 1


def test_only_the_balls_color_depends_on_the_direction():
    centers = {"ball": (-0.38, -0.38, -0.18), "pillar": (-0.40, 0.46, 0.3), "glass": (0.42, -0.42, -0.29)}
    offset = 0.43 * jnp.array([0.48, -0.36, 0.80])  # towards the light, just inside the ball
    x = jnp.array([centers["ball"], centers["pillar"], centers["glass"]]) + offset[None, :] * jnp.eye(3)[:, :1]
    x = x[:, None, :]
    down = jnp.tile(-offset[None, None, :] / 0.43, (3, 1, 1))
    scene = jax.jit(still_life.still_life)
    (density, bright), (same, dark) = scene(x, down), scene(x, -down)
    np.testing.assert_array_equal(density, same)
    changed = np.abs(bright - dark).max(axis=(1, 2))
    assert changed[0] > 0.3 and (changed[1:] < 1e-6).all() and (density > 1).all()


@pytest.mark.slow
def test_field_is_bounded_with_finite_gradients():
    x = jax.random.uniform(jax.random.key(0), (500, 4, 3), minval=-2.0, maxval=2.0)
    special = jnp.array([0.0, -0.38, -0.71, 0.22, 1e3, -0.40, 0.46, 0.42])  # centres of objects, and far away
    axes = jnp.broadcast_to(special[:, None, None], (8, 4, 3))
    x = jnp.concatenate([x, axes])
    viewdirs = jnp.zeros((508, 1, 3)).at[..., 2].set(-1.0)
    density, rgb = jax.jit(still_life.still_life)(x, viewdirs)
    assert density.shape == (508, 4) and rgb.shape == (508, 4, 3)
    assert (density >= 0).all() and (rgb >= 0).all() and (rgb <= 1).all()
    gradient = jax.jit(
        jax.grad(lambda *place: sum(part.sum() for part in still_life.still_life(*place)), argnums=(0, 1))
    )
    assert all(jnp.isfinite(part).all() for part in gradient(x, viewdirs))
    each = jax.jit(jax.vmap(still_life.still_life))(x, viewdirs)
    np.testing.assert_allclose(each[1], rgb, atol=1e-5)


def test_invalid_arguments_are_errors():
    with pytest.raises(ValueError, match="split is 'all', .*train, val, test"):
        synthetic.load_synthetic(split="all")
    with pytest.raises(ValueError, match="viewdirs"):
        still_life.still_life(jnp.zeros((2, 4, 3)), jnp.zeros((2, 3, 3)))
