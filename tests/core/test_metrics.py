import dm_pix
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skimage.metrics

import captures
import oracle
from helpers import all_finite, assert_batch_is_vmap_is_jit, compiled
from jaxnerf import mse, psnr, round_to_8_bits, ssim
from jaxnerf.core.metrics import align_colors


def pair(seed, noise, shape=(17, 20, 3)):
    """Returns an image of smooth colours and a noisy copy."""
    rng = np.random.default_rng(seed)
    ramp = np.add.outer(np.sin(np.arange(shape[0]) / 4), np.cos(np.arange(shape[1]) / 3))[..., None]
    image = np.clip(0.5 + 0.2 * ramp * rng.uniform(size=shape[-1]) + 0.02 * rng.normal(size=shape), 0, 1)
    other = np.clip(image + noise * rng.normal(size=shape), 0, 1)
    return image.astype(np.float32), other.astype(np.float32)


fast_ssim = compiled(ssim)


def test_psnr_by_hand():
    zero = jnp.zeros((4, 5, 3))
    np.testing.assert_allclose(psnr(zero, zero + 0.1), 20, rtol=1e-6)
    np.testing.assert_allclose(mse(zero, zero + 0.1), 0.01, rtol=1e-6)


@pytest.mark.parametrize("noise", [1e-4, 0.01, 0.3])
def test_psnr_is_the_oracle(noise):
    a, b = pair(0, noise)
    np.testing.assert_allclose(psnr(a, b), oracle.psnr(a.astype(np.float64), b.astype(np.float64)), rtol=1e-5)


def test_psnr_of_identical_images_is_infinite_with_gradient_zero():
    a, _ = pair(1, 0)
    value, slope = jax.value_and_grad(psnr)(a, a)
    assert value == jnp.inf
    np.testing.assert_array_equal(slope, 0)


def test_gradient_of_psnr():
    a, b = pair(1, 0.1)
    difference = a.astype(np.float64) - b
    want = -20 / np.log(10) * difference / (difference**2).sum()
    np.testing.assert_allclose(jax.grad(psnr)(a, b), want, rtol=1e-4, atol=1e-7)


def test_psnr_keeps_nan():
    a, b = pair(2, 0.1)
    assert jnp.isnan(psnr(jnp.asarray(a).at[0, 0, 0].set(jnp.nan), b))


def test_psnr_counts_the_pixels_in_the_mask_only():
    a, b = pair(3, 0.1)
    mask = np.zeros(a.shape[:2], bool)
    mask[3:9, 2:15] = True
    cut = psnr(a[3:9, 2:15], b[3:9, 2:15])
    spoiled = np.where(mask[..., None], b, np.nan)
    np.testing.assert_allclose(psnr(a, spoiled, mask=mask), cut, rtol=1e-6)
    assert jnp.isnan(psnr(a, b, mask=np.zeros_like(mask)))


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.05, 0.5])
def test_ssim_is_that_of_the_oracle_scikit_image_and_dm_pix(noise):
    a, b = pair(4, noise)
    assert_ssim_is_theirs(a, b)
    np.testing.assert_allclose(fast_ssim(a, b), oracle.ssim(a.astype(np.float64), b.astype(np.float64)), atol=1e-5)


def test_random_images_have_the_scores_of_scikit_image_and_dm_pix():
    a, b = np.random.default_rng(7).uniform(size=(2, 17, 20, 3)).astype(np.float32)
    assert_ssim_is_theirs(a, b)
    assert_psnr_is_theirs(a, b)
    assert_psnr_is_theirs(*pair(8, 0.003))


@pytest.mark.slow
@pytest.mark.scenes("lego")
def test_images_of_scenes_have_the_scores_of_scikit_image_and_dm_pix(scenes_dir):
    """200 x 200 px, mostly white; a pair, and one beside itself with noise of 40 dB in 8 bits."""
    views = captures.load_blender(scenes_dir / "lego", split="test", factor=4)
    a, b = (np.asarray(views.image(index)) for index in (0, 1))
    noise = np.random.default_rng(9).normal(scale=0.01, size=a.shape).astype(np.float32)
    for other in (b, np.asarray(round_to_8_bits(a + noise))):
        assert_ssim_is_theirs(a, other)
        assert_psnr_is_theirs(a, other)


def assert_ssim_is_theirs(a, b):
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    options |= {"data_range": 1.0, "channel_axis": -1, "full": True}
    a64, b64 = a.astype(np.float64), b.astype(np.float64)
    valid_map = skimage.metrics.structural_similarity(a64, b64, **options)[1][5:-5, 5:-5]
    np.testing.assert_allclose(fast_ssim(a, b), valid_map.mean(), atol=1e-5)
    with jax.enable_x64(True):  # in float32 its differences of squares are 3e-5 off on a white image
        pix = float(jax.jit(dm_pix.ssim)(a64, b64))
    np.testing.assert_allclose(fast_ssim(a, b), pix, atol=1e-5)


def assert_psnr_is_theirs(a, b):
    theirs = skimage.metrics.peak_signal_noise_ratio(a.astype(np.float64), b.astype(np.float64), data_range=1)
    np.testing.assert_allclose(psnr(a, b), theirs, rtol=0, atol=1e-5)
    np.testing.assert_allclose(psnr(a, b), dm_pix.psnr(a, b), rtol=0, atol=1e-5)


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_ssim_in_flat_bright_and_dark_regions(level):
    """Where the variance is small compared with the mean, E[x^2] - E[x]^2 cancels."""
    rng = np.random.default_rng(5)
    a, b = (np.clip(level + 0.002 * rng.normal(size=(2, 14, 14, 3)), 0, 1)).astype(np.float32)
    expected = oracle.ssim(a.astype(np.float64), b.astype(np.float64))
    np.testing.assert_allclose(fast_ssim(a, b), expected, atol=1e-5)


def test_ssim_is_symmetric_at_most_one_and_one_for_itself():
    a, b = pair(6, 0.1)
    np.testing.assert_allclose(fast_ssim(a, b), fast_ssim(b, a), atol=1e-6)
    assert -1 <= fast_ssim(a, b) < 1
    np.testing.assert_allclose(fast_ssim(a, a), 1, atol=1e-6)


@pytest.mark.slow
def test_gradients_are_finite():
    black = jnp.zeros((11, 12, 3))
    slopes = jax.jit(jax.grad(lambda a, b: ssim(a, b) + psnr(a, b)))
    assert all_finite(slopes(black, black))
    assert all_finite(slopes(black, black + 0.1))


def test_batch_is_vmap_is_jit():
    images = [pair(seed, 0.1, (11, 12, 3)) for seed in range(3)]
    a, b = (np.stack([image[i] for image in images]) for i in range(2))
    assert_batch_is_vmap_is_jit(psnr, a, b, rtol=1e-5)
    assert_batch_is_vmap_is_jit(lambda a, b, m: psnr(a, b, mask=m), a, b, a[..., 0] > 0.5, rtol=1e-5)
    assert_batch_is_vmap_is_jit(ssim, a, b, rtol=1e-5)


def test_rounding_is_to_the_nearest_level():
    levels = jnp.arange(256) / 255
    np.testing.assert_allclose(round_to_8_bits(levels + 0.0019), levels, atol=1e-7)
    np.testing.assert_allclose(round_to_8_bits(levels - 0.0019), levels, atol=1e-7)
    np.testing.assert_array_equal(round_to_8_bits(jnp.array([-3.0, 7.0])), [0, 1])


def test_wrong_shapes():
    image = jnp.ones((12, 12, 3))
    with pytest.raises(ValueError, match="b has shape"):
        psnr(image, jnp.ones((12, 11, 3)))
    with pytest.raises(ValueError, match="mask has shape"):
        psnr(image, image, mask=jnp.ones((12, 11), bool))
    with pytest.raises(ValueError, match="b has shape"):
        ssim(image, jnp.ones((12, 12, 1)))
    with pytest.raises(ValueError, match="11 x 11"):
        jax.eval_shape(ssim, jnp.ones((10, 12, 3)), jnp.ones((10, 12, 3)))


def test_alignment_finds_the_gains_and_nothing_else():
    image = 0.6 * pair(4, 0)[0]
    gains = np.float32([0.8, 1.1, 1.2])
    np.testing.assert_allclose(align_colors(gains * image, image), image, atol=1e-6)
    assert psnr(align_colors(image, gains * image), gains * image) > 100
    # Fog lowers the contrast. That is no difference in exposure, so little of it is removed.
    foggy = 0.5 * image + 0.25
    assert psnr(align_colors(foggy, image), image) < psnr(foggy, image) + 6


def test_alignment_counts_the_pixels_in_the_mask_only():
    image, target = pair(5, 0.05)
    mask = np.zeros(image.shape[:2], bool)
    mask[3:9, 2:15] = True
    expected = align_colors(image[3:9, 2:15], target[3:9, 2:15])
    spoiled = np.where(mask[..., None], image, np.nan)
    np.testing.assert_allclose(align_colors(spoiled, target, mask=mask)[3:9, 2:15], expected, atol=1e-6)


def test_alignment_keeps_a_black_channel_and_nan():
    image, target = pair(6, 0.05)
    image[..., 1] = 0
    aligned = align_colors(image, target)
    assert all_finite(aligned) and not aligned[..., 1].any()
    image[0, 0, 0] = np.nan
    assert np.isnan(align_colors(image, target)[..., 0]).all()
