import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf
from helpers import all_finite, assert_batch_is_vmap_is_jit, compiled

composite, transmittance = compiled(jaxnerf.composite), compiled(jaxnerf.transmittance)
weights_from_density = compiled(jaxnerf.weights_from_density)
median_depth = compiled(jaxnerf.median_depth, "rule")
expected_depth, expected_disparity = compiled(jaxnerf.expected_depth), compiled(jaxnerf.expected_disparity)
slopes_of_weights = compiled(jax.jacrev(jaxnerf.weights_from_density))

SWEEP = [0.0, 1e-38, 1e-30, 1e-12, 1e-3, 1.0, 20.0, 100.0, 1e5, 1e12, 1e30]


def random_segments(seed, shape=(6, 9)):
    rng = np.random.default_rng(seed)
    return rng.exponential(size=shape).astype(np.float32), rng.uniform(size=shape).astype(np.float32)


@pytest.mark.parametrize("sigma", [4e-12, 1e-6, 0.3, 5.0, 40.0])
def test_fog_of_constant_density(sigma):
    """Beer and Lambert, to relative accuracy: 1 - exp(-4e-12) itself is 0 in float32."""
    length = jnp.array([0.1, 0.3, 0.2, 0.4])
    weights = weights_from_density(np.full(4, sigma), length)
    np.testing.assert_allclose(weights.sum(), -np.expm1(-sigma), rtol=1e-6)
    np.testing.assert_allclose(transmittance(np.full(4, sigma), length), np.exp(-sigma), rtol=1e-5)


def test_splitting_every_segment_changes_nothing():
    density, length = random_segments(0)
    halves = np.repeat(length / 2, 2, axis=-1)
    split = weights_from_density(np.repeat(density, 2, axis=-1), halves)
    whole = weights_from_density(density, length)
    np.testing.assert_allclose(split.reshape(6, 9, 2).sum(axis=-1), whole, atol=1e-6)


def test_weights_and_transmittance_sum_to_one():
    density, length = random_segments(1)
    total = weights_from_density(density, length).sum(axis=-1) + transmittance(density, length)
    np.testing.assert_allclose(total, 1, atol=1e-6)


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf, 1e30])
def test_a_segment_of_length_zero_is_ignored(bad):
    length = jnp.array([0.5, 0.0, 0.25])

    dirty, clean = jnp.array([1.0, bad, 2.0]), jnp.array([1.0, 0.0, 2.0])
    np.testing.assert_array_equal(weights_from_density(dirty, length), weights_from_density(clean, length))
    slopes = slopes_of_weights(dirty, length)
    np.testing.assert_array_equal(slopes, slopes_of_weights(clean, length))
    np.testing.assert_array_equal(slopes[:, 1], 0)
    np.testing.assert_array_equal(transmittance(dirty, length), transmittance(clean, length))


def test_nan_in_a_segment_with_length_is_shown():
    assert jnp.isnan(weights_from_density(jnp.array([jnp.nan]), np.ones(1))).all()


def test_infinite_density_is_a_wall():
    density = jnp.array([0.0, jnp.inf, 3.0, jnp.inf])
    np.testing.assert_array_equal(weights_from_density(density, np.ones(4)), [0, 1, 0, 0])
    assert transmittance(density, np.ones(4)) == 0
    assert all_finite(slopes_of_weights(density, np.ones(4)))


@pytest.mark.parametrize("last", [1.0, 1e10])
def test_gradients_are_finite_for_every_density(last):
    t, far = jnp.array([1.0, 2.0, 3.0]), jnp.float32(4.0)
    densities = jnp.array([[a, b, c] for a in SWEEP for b in SWEEP for c in SWEEP], jnp.float32)

    def everything(density, length, values):
        weights, transmitted = (
            jaxnerf.weights_from_density(density, length),
            jaxnerf.transmittance(density, length),
        )
        color = jaxnerf.composite(weights, values, background=jnp.ones(3), transmittance=transmitted)
        depth = jaxnerf.expected_depth(weights, t, transmitted, far=far)
        return jnp.append(color, jnp.stack([weights.sum(), depth, jaxnerf.expected_disparity(weights, t), transmitted]))

    def value_and_slopes(density):
        arguments = density, jnp.array([0.5, 1e-3, last]), jnp.eye(3)
        return everything(*arguments), jax.jacrev(everything, argnums=(0, 2))(*arguments)

    assert all_finite(jax.jit(jax.vmap(value_and_slopes))(densities))


@pytest.mark.parametrize("depth", [1e-12, 1e-3, 1.0, 20.0, 60.0])
def test_gradient_of_a_weight_keeps_its_digits(depth):
    slope = jax.grad(lambda x: jaxnerf.weights_from_density(x[None], np.ones(1))[0])(jnp.float32(depth))
    np.testing.assert_allclose(slope, np.exp(-depth), rtol=1e-5)


def test_derivative_of_the_weights_of_a_ray_with_thousands_of_samples():
    """In double precision: dw_i = T_i exp(-tau_i) dtau_i - w_i sum of dtau_k in front of i."""
    rng, size = np.random.default_rng(2), 5000
    depth, tangent = np.float32(rng.exponential(2 / size, size)), np.float32(rng.normal(size=size))
    weights_of = lambda depth: jaxnerf.weights_from_density(depth, jnp.ones(size))  # noqa: E731
    _, change = jax.jit(lambda *of: jax.jvp(weights_of, *of))((depth,), (tangent,))
    exact, moved = depth.astype(np.float64), tangent.astype(np.float64)
    in_front = np.cumsum(exact) - exact
    weights = np.exp(-in_front) * -np.expm1(-exact)
    want = np.exp(-in_front - exact) * moved - weights * (np.cumsum(moved) - moved)
    np.testing.assert_allclose(change, want, atol=2e-4)


def test_composite_adds_the_background_behind():
    weights, values = jnp.array([0.25, 0.5]), jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(composite(weights, values), [0.25, 0.5, 0.0])
    white = np.ones(3)
    np.testing.assert_allclose(composite(weights, values, background=white), [0.5, 0.75, 0.25])
    given = composite(weights, values, background=white, transmittance=jnp.float32(0.0))
    np.testing.assert_allclose(given, [0.25, 0.5, 0.0])
    each = composite(np.zeros((2, 4)), np.zeros((2, 4, 3)), background=np.eye(3)[:2])
    np.testing.assert_array_equal(each, np.eye(3)[:2])


@pytest.mark.parametrize("far", [6.0, jnp.inf])
def test_an_empty_ray_ends_at_far(far):
    none, t = np.zeros(3), jnp.array([0.0, 1.0, 2.0])
    assert expected_depth(none, t, jnp.float32(1.0), far=jnp.float32(far)) == far
    assert expected_disparity(none, t) == 0
    assert all_finite(jax.grad(jaxnerf.expected_disparity, argnums=(0, 1))(none, t))


def test_the_depth_of_a_wall_does_not_depend_on_far():
    weights, t = jnp.array([0.0, 1.0, 0.0]), jnp.array([1.0, 2.0, 4.0])
    assert expected_depth(weights, t, jnp.float32(0.0), far=jnp.float32(jnp.inf)) == 2
    assert expected_disparity(weights, t) == 0.5
    beyond = jnp.array([1.0, 2.0, jnp.inf])  # the last segment of a ray of infinite length
    assert expected_depth(weights, beyond, jnp.float32(0.0), far=jnp.float32(jnp.inf)) == 2
    assert expected_disparity(weights, beyond) == 0.5


def test_the_median_depth_halves_the_transmittance():
    """In segments of constant density it is where the piecewise linear optical depth is log 2."""
    density, length = random_segments(3)
    edges = 1 + np.concatenate([np.zeros_like(length[:, :1]), np.cumsum(length, axis=-1)], axis=-1)
    delta, far = np.diff(edges), np.float32(edges[:, -1])
    got = median_depth(density, length, edges[:, :-1] + delta / 2, delta, far=far)
    behind = np.cumsum(density * length, axis=-1)
    for ray, half in enumerate(got):
        depth = np.interp(half, edges[ray], np.append(0, behind[ray]))
        assert half == far[ray] if behind[ray, -1] < np.log(2) else depth == pytest.approx(np.log(2), rel=1e-3)
    assert (got < far).any()


def test_the_median_depth_of_limits():
    t, ones, far = np.float32([1, 2, 3]), np.ones(3, np.float32), np.float32(3.5)
    assert median_depth(0 * ones, ones, t, ones, far=far) == far
    assert median_depth(np.float32([0.1, jnp.inf, 1]), ones, t, ones, far=far) == pytest.approx(1.5, abs=1e-4)
    assert np.isnan(median_depth(np.float32([0.1, jnp.nan, 1]), ones, t, ones, far=far))
    last = np.float32([1, 1, jnp.inf])
    assert median_depth(np.float32([0.1, 0, 2]), last, t, last, far=far, rule="points") == 3
    assert median_depth(np.float32([0.1, 2, 0]), ones, t, ones, far=far, rule="points") == pytest.approx(
        2 + (np.log(2) - 0.1) / 2
    )
    with pytest.raises(ValueError, match="median_depth: far"):
        jaxnerf.median_depth(np.ones((2, 3)), np.ones((2, 3)), np.ones((2, 3)), np.ones((2, 3)), far=np.ones(3))


def test_batch_is_vmap_is_jit():
    density, length = random_segments(2)
    assert_batch_is_vmap_is_jit(jaxnerf.weights_from_density, density, length)
    assert_batch_is_vmap_is_jit(jaxnerf.transmittance, density, length)
    weights, t, values = weights_from_density(density, length), 1 + length, np.ones((6, 9, 3))
    transmitted, far = transmittance(density, length), np.full(6, 3.0, np.float32)
    assert_batch_is_vmap_is_jit(lambda w, v: jaxnerf.composite(w, v, background=np.ones(3)), weights, values)
    assert_batch_is_vmap_is_jit(lambda w, t, p, f: jaxnerf.expected_depth(w, t, p, far=f), weights, t, transmitted, far)
    assert_batch_is_vmap_is_jit(jaxnerf.expected_disparity, weights, t)


def test_wrong_shapes():
    with pytest.raises(ValueError, match=r"weights_from_density: length .*\(4,\)"):
        jax.eval_shape(jaxnerf.weights_from_density, np.ones(3), np.ones(4))
    with pytest.raises(ValueError, match="transmittance: length"):
        jaxnerf.transmittance(np.ones((2, 3)), np.ones(3))
    with pytest.raises(ValueError, match="composite: values"):
        jaxnerf.composite(np.ones((2, 3)), np.ones((2, 4, 3)))
    with pytest.raises(ValueError, match="background"):
        jaxnerf.composite(np.ones((2, 4)), np.ones((2, 4, 3)), background=np.ones(4))
    with pytest.raises(ValueError, match="transmittance"):
        jaxnerf.composite(np.ones((2, 4)), np.ones((2, 4, 3)), background=np.ones(3), transmittance=np.ones(3))
    with pytest.raises(ValueError, match="expected_depth: t"):
        jaxnerf.expected_depth(np.ones(3), np.ones(4), np.ones(()), far=np.ones(()))
    with pytest.raises(ValueError, match="expected_depth: far"):
        jaxnerf.expected_depth(np.ones((2, 3)), np.ones((2, 3)), np.ones(2), far=np.ones(3))
    with pytest.raises(ValueError, match="expected_disparity: t"):
        jaxnerf.expected_disparity(np.ones((2, 3)), np.ones((2, 4)))


def test_gradients_of_disparity_near_the_camera():
    """1 / t^2 overflows long before w / t^2 does, which is 0 for an empty sample."""
    slope = compiled(jax.grad(jaxnerf.expected_disparity, argnums=1))
    np.testing.assert_allclose(slope(jnp.array([0.0, 0.1]), jnp.array([1e-20, 1.0])), [0, -0.1], rtol=1e-6)
