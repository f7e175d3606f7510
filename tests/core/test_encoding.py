import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import assert_batch_is_vmap_is_jit, compiled
from jaxnerf import positional_encoding

encode = compiled(positional_encoding, "num_freqs", "include_input")


def test_order_is_x_then_sine_and_cosine_of_each_octave():
    x, y = 0.3, -1.1
    got = encode(jnp.array([x, y]), num_freqs=2)
    s, c = np.sin, np.cos
    expected = [x, y, s(x), s(y), c(x), c(y), s(2 * x), s(2 * y), c(2 * x), c(2 * y)]
    np.testing.assert_allclose(got, expected, atol=1e-6)
    bare = encode(jnp.array([x, y]), num_freqs=2, include_input=False)
    np.testing.assert_array_equal(bare, got[2:])


@pytest.mark.parametrize("shape", [(3,), (5, 3), (2, 4, 2)])
def test_shape(shape):
    got = jax.eval_shape(lambda x: positional_encoding(x, num_freqs=10), jnp.ones(shape))
    assert got.shape == (*shape[:-1], 21 * shape[-1]) and got.dtype == jnp.float32


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
    np.testing.assert_allclose(curve(jnp.float32(0.8)), -np.sin(0.8), atol=1e-6)


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
