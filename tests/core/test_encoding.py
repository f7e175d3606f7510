import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import assert_batch_is_vmap_is_jit, compiled
from jaxnerf import frustum_variance, integrated_encoding, positional_encoding

encode = compiled(positional_encoding, "num_freqs", "include_input")
integrate = compiled(integrated_encoding, "num_freqs", "include_input")
variances = compiled(frustum_variance)


def test_order_is_x_then_sine_and_cosine_of_each_octave():
    x, y = 0.3, -1.1
    got = encode(jnp.array([x, y]), num_freqs=2)
    s, c = np.sin, np.cos
    expected = [x, y, s(x), s(y), c(x), c(y), s(2 * x), s(2 * y), c(2 * x), c(2 * y)]
    np.testing.assert_allclose(got, expected, atol=1e-6)
    bare = encode(jnp.array([x, y]), num_freqs=2, include_input=False)
    np.testing.assert_array_equal(bare, got[2:])


@pytest.mark.parametrize("shape", [(3,), (5, 3), (2, 4, 2), (0, 3), (4, 0, 3), (0,)])
def test_shape(shape):
    for encoding in (positional_encoding, lambda x, num_freqs: integrated_encoding(x, x, num_freqs=num_freqs)):
        got = jax.eval_shape(lambda x, encoding=encoding: encoding(x, num_freqs=10), jnp.ones(shape))
        assert got.shape == (*shape[:-1], 21 * shape[-1]) and got.dtype == jnp.float32


def test_octaves_are_nan_where_the_first_of_their_group_overflows():
    for x, num_nan in ((1e31, 0), (3e38, 32), (np.inf, 64)):
        waves = np.asarray(encode(jnp.float32([x]), num_freqs=32, include_input=False))
        assert np.isnan(waves).sum() == num_nan and (np.abs(waves[~np.isnan(waves)]) <= 1).all()


def test_no_octaves_leave_x():
    np.testing.assert_array_equal(encode(jnp.array([1.5]), num_freqs=0), [1.5])


@pytest.mark.parametrize("scale", [1e-6, 1.0, 10.0, 1e3, 1e6])
def test_every_octave_keeps_its_digits(scale):
    """The shortcuts, sin(x + pi/2) and double angles, lose all digits at the upper end of this range."""
    x = np.random.default_rng(0).uniform(-scale, scale, 1000).astype(np.float32)
    x[:2] = np.pi, -scale
    got = encode(x[:, None], num_freqs=40, include_input=False).reshape(-1, 40, 2)
    angles = 2.0 ** np.arange(40) * x[:, None].astype(np.float64)
    expected = np.stack([np.sin(angles), np.cos(angles)], axis=-1)
    np.testing.assert_allclose(got, expected, atol=3e-7)


def test_sine_keeps_its_relative_digits_near_zero():
    x = jnp.array([[1e-30], [1e-10], [-1e-5]])
    got = encode(x, num_freqs=1, include_input=False)[:, 0]
    np.testing.assert_allclose(got, np.asarray(x)[:, 0], rtol=1e-6)


def test_sine_and_cosine_lie_on_the_circle():
    x = np.random.default_rng(0).uniform(-50, 50, (200, 3)).astype(np.float32)
    waves = encode(x, num_freqs=6, include_input=False).reshape(200, 6, 2, 3)
    np.testing.assert_allclose((waves**2).sum(axis=2), 1, atol=1e-6)


def test_an_octave_is_the_first_of_twice_the_position():
    x = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    second = encode(x, num_freqs=2, include_input=False)[:, 6:]
    np.testing.assert_allclose(encode(2 * x, num_freqs=1, include_input=False), second, atol=3e-7)


def test_batch_is_vmap_is_jit():
    x = np.random.default_rng(2).normal(size=(4, 5, 3)).astype(np.float32)
    assert_batch_is_vmap_is_jit(lambda x: positional_encoding(x, num_freqs=4), x)


def test_gradient_is_that_of_the_waves():
    x = jnp.array([0.0, 1e-30, 0.7, -0.4, 1e3, 1e6])

    def waves(x):
        return positional_encoding(x[None], num_freqs=8, include_input=False)

    got = jax.jit(jax.vmap(jax.jacfwd(waves)))(x)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.jacrev(waves)))(x), got, rtol=1e-6)
    frequency = 2.0 ** np.arange(8)
    angles = frequency * np.asarray(x, np.float64)[:, None]
    slopes = np.stack([np.cos(angles), -np.sin(angles)], axis=-1) * frequency[:, None]
    np.testing.assert_allclose(got.reshape(6, 8, 2), slopes, atol=3e-7 * 2**8)


def test_second_derivative_is_minus_the_wave():
    curve = jax.grad(jax.grad(lambda x: positional_encoding(x[None], num_freqs=1)[1]))
    np.testing.assert_allclose(jax.jit(curve)(jnp.float32(0.8)), -np.sin(0.8), atol=1e-6)


def test_wrong_arguments():
    with pytest.raises(ValueError, match="x is .*int32"):
        positional_encoding(jnp.array([1, 2]), num_freqs=2)
    with pytest.raises(ValueError, match="x is"):
        positional_encoding(jnp.float32(1.0), num_freqs=2)
    with pytest.raises(ValueError, match="num_freqs"):
        positional_encoding(jnp.ones(3), num_freqs=-1)
    with pytest.raises(ValueError, match="num_freqs is 65, expected at most 64"):
        positional_encoding(jnp.ones(3), num_freqs=65)
    with pytest.raises(ValueError, match="num_freqs"):
        positional_encoding(jnp.ones(3), num_freqs=0, include_input=False)


def test_half_precision_is_raised_first():
    x = jnp.array([[3.7, 900.0]], jnp.float16)
    got = encode(x, num_freqs=16)
    assert got.dtype == np.float32
    np.testing.assert_array_equal(got, encode(x.astype(jnp.float32), num_freqs=16))


# The mean over a cone.

EXTENTS = [0.0, 1e-30, 1e-12, 1e-3, 0.02, 0.5, 3.0, 1e6, 1e17, 1e25, np.inf]  # of a frustum
AWAY = np.array([2.0, -1.0, 2.0]) / 3


def exact_waves(x, radius, length, num_freqs):
    """Returns the waves [2 num_freqs, 3] and their derivatives with respect to radius and length, in float64."""
    octaves = 2.0 ** np.arange(num_freqs)[:, None, None]
    along, across = AWAY**2 / 12, (1 - AWAY**2) / 4
    # Where a wave is averaged away, its derivative is 0, too: the product would be that of infinity and 0.
    radius, length = min(radius, 1e18), min(length, 1e18)
    decay = np.exp(-(octaves**2) / 2 * (length**2 * along + radius**2 * across))
    waves = decay * np.stack([np.sin(octaves[:, 0] * x), np.cos(octaves[:, 0] * x)], axis=1)
    slopes = [-(octaves**2) * waves * extent * of for extent, of in ((radius, across), (length, along))]
    return [each.reshape(-1, 3) for each in (waves, *slopes)]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("is_radius", [True, False])
def test_waves_over_a_frustum_and_their_derivatives_are_those_of_float64(is_radius, dtype):
    x, extents = np.array([0.3, -0.2, 1.5]), np.array(EXTENTS, dtype)

    def waves(extent):
        radius, length = (extent, jnp.zeros_like(extent)) if is_radius else (jnp.zeros_like(extent), extent)
        variance = frustum_variance(AWAY.astype(dtype)[None], radius[None], length[None])[0]
        return integrated_encoding(x.astype(dtype), variance, num_freqs=12, include_input=False)

    with jax.enable_x64(dtype == np.float64):
        got, slopes = jax.jit(lambda at: (jax.vmap(waves)(at), jax.vmap(jax.jacrev(waves))(at)))(jnp.asarray(extents))
        assert got.dtype == slopes.dtype == dtype
    x = x.astype(dtype).astype(np.float64)
    for value, slope, extent in zip(got, slopes, extents.astype(np.float64), strict=True):
        want, *derivatives = exact_waves(x, *((extent, 0.0) if is_radius else (0.0, extent)), 12)
        np.testing.assert_allclose(value.reshape(-1, 3), want, atol=1e-6)
        np.testing.assert_allclose(slope.reshape(-1, 3), derivatives[not is_radius], rtol=1e-4, atol=1e-3)
    assert not got[-3:].any() and not slopes[-3:].any() and not slopes[0].any()


def test_a_frustum_that_is_a_point_has_the_plain_encoding_and_its_gradient():
    x = np.random.default_rng(3).uniform(-1e3, 1e3, (50, 3)).astype(np.float32)
    nothing = np.zeros(50, np.float32)
    variance = frustum_variance(np.tile(np.float32(AWAY), (50, 1)), nothing, nothing)
    np.testing.assert_array_equal(integrate(x, variance, num_freqs=16), encode(x, num_freqs=16))
    np.testing.assert_array_equal(integrate(x, variance, num_freqs=0), x)
    pull = np.random.default_rng(4).normal(size=(50, 99)).astype(np.float32)
    plain, mean = (
        jax.jit(jax.grad(lambda x, function=function: (pull * function(x)).sum()))(x)
        for function in (
            lambda x: positional_encoding(x, num_freqs=16),
            lambda x: integrated_encoding(x, variance, num_freqs=16),
        )
    )
    np.testing.assert_allclose(mean, plain, rtol=1e-6, atol=0.1)  # of 2^15


def test_the_integrated_encoding_is_the_mean_over_random_points_of_a_cylinder():
    rng = np.random.default_rng(0)
    x, radius, length, count = np.float32([0.3, -0.2, 0.5]), 0.2, 0.5, 400_000
    side = np.cross(AWAY, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    turn, out = rng.uniform(0, 2 * np.pi, count), radius * np.sqrt(rng.uniform(0, 1, count))
    across = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(AWAY, side)
    points = x + rng.uniform(-0.5, 0.5, (count, 1)) * length * AWAY + out[:, None] * across
    angles = 2.0 ** np.arange(3)[:, None] * points[:, None]
    want = np.concatenate([np.sin(angles), np.cos(angles)], axis=-1).mean(axis=0).reshape(-1)
    variance = frustum_variance(np.float32(AWAY)[None], np.float32([radius]), np.float32([length]))[0]
    np.testing.assert_allclose(variance, points.var(axis=0), rtol=0.01)
    np.testing.assert_allclose(integrate(x, variance, num_freqs=3, include_input=False), want, atol=0.01)


@pytest.mark.parametrize("half", [0.001, 0.01, 0.1])
def test_a_frustum_near_its_apex_differs_by_the_square_of_its_relative_length(half):
    """Eq. 7 of arXiv:2103.13415, for a sample at a distance of 1 and the stated orders."""
    square, radius, length = half**2, 0.05, 2 * half
    mean = 1 + 2 * square / (3 + square)
    along = square / 3 - 4 / 15 * square**2 * (12 - square) / (3 + square) ** 2
    across = radius**2 * (1 / 4 + 5 / 12 * square - 4 / 15 * square**2 / (3 + square))
    with jax.enable_x64(True):
        found = variances(np.array([[0.0, 0.0, 1.0]]), np.array([radius]), np.array([length]))[0]
    order = 2 * square**2
    assert mean - 1 == pytest.approx(2 / 3 * square, abs=order)
    assert along / float(found[2]) == pytest.approx(1 - 16 / 15 * square, abs=order)
    assert across / float(found[0]) == pytest.approx(1 + 5 / 3 * square, abs=order)


def test_a_variance_is_never_negative():
    """Directions of rays are unit vectors but for rounding."""
    rng = np.random.default_rng(5)
    viewdirs = rng.normal(size=(1000, 1, 3)) * 10.0 ** rng.uniform(-8, 0, (1000, 1, 3))
    viewdirs = np.float32(viewdirs / np.linalg.norm(viewdirs, axis=-1, keepdims=True)) * np.float32(1 + 1e-6)
    variance = frustum_variance(viewdirs, np.full((1000, 2), 1e18, np.float32), np.zeros((1000, 2), np.float32))
    assert variance.shape == (1000, 2, 3) and (variance >= 0).all()


def test_wrong_arguments_of_the_mean():
    with pytest.raises(ValueError, match="integrated_encoding: num_freqs=0"):
        integrated_encoding(jnp.ones(3), jnp.ones(3), num_freqs=0, include_input=False)
    with pytest.raises(ValueError, match=r"integrated_encoding: variance has shape \(2,\)"):
        integrated_encoding(jnp.ones(3), jnp.ones(2), num_freqs=2)
    with pytest.raises(ValueError, match=r"frustum_variance: length has shape \(4,\)"):
        frustum_variance(jnp.ones((3, 3)), jnp.ones(3), jnp.ones(4))
