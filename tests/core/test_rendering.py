import dataclasses
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import all_finite, assert_same, compiled, random_rays
from jaxnerf import Samples, points_on_rays, render_hierarchical, render_image, render_rays, render_samples
from jaxnerf.core.types import without_samples

SHAPE = (4, 3)


def fog(sigma=0.3, color=(0.2, 0.5, 0.9)):
    def scene(x, viewdirs):
        return jnp.full(x.shape[:-1], sigma), jnp.broadcast_to(jnp.array(color), x.shape)

    return scene


def ball(x, viewdirs):
    """A soft ball of radius 2 around the origin, whose colour depends on position and direction."""
    density = 5 * jax.nn.sigmoid(4 * (2 - jnp.sqrt((x**2).sum(axis=-1) + 1e-6)))
    return density, 0.5 + 0.2 * jnp.sin(x) + 0.3 * viewdirs


@pytest.fixture(scope="module")
def rays():
    return random_rays(0, SHAPE)


@pytest.fixture(scope="module")
def keys():
    return jax.random.split(jax.random.key(1), SHAPE)


def through_ball(key, rays):
    return render_rays(key, ball, rays, num_samples=16)


def twice_through_ball(key, rays):
    return render_hierarchical(key, ball, ball, rays, num_coarse=8, num_fine=8)


draw = {"rays": compiled(through_ball), "hierarchical": compiled(twice_through_ball)}


def through_fog(key, rays, sigma, num_samples, background=None, in_disparity=False):
    options = {"num_samples": num_samples, "background": background, "in_disparity": in_disparity}
    return render_rays(key, fog(sigma), rays, **options)


through_fog = compiled(through_fog, "num_samples", "in_disparity")


def test_points_on_rays(rays):
    t = np.broadcast_to(np.float32([0.0, 2.5]), (*SHAPE, 2))
    got = compiled(points_on_rays)(rays, t)
    np.testing.assert_array_equal(got[..., 0, :], rays.origins)
    np.testing.assert_allclose(got[..., 1, :], rays.origins + 2.5 * rays.directions, atol=1e-6)


@pytest.mark.parametrize("key", [None, jax.random.key(0)], ids=["fixed", "random"])
@pytest.mark.parametrize("sigma", [1e-12, 0.3, 50.0])
def test_fog_of_constant_density(rays, sigma, key):
    """Exact whatever the samples: opacity 1 - exp(-sigma L), L in world units, to relative accuracy."""
    got = through_fog(key, rays, sigma, 5, np.ones(3))
    length = 4 * np.linalg.norm(np.asarray(rays.directions, np.float64), axis=-1)
    expected = -np.expm1(-sigma * length)
    np.testing.assert_allclose(got.opacity, expected, rtol=2e-6)
    color = np.array([0.2, 0.5, 0.9]) * expected[..., None] + 1 - expected[..., None]
    np.testing.assert_allclose(got.rgb, color, atol=2e-6)
    np.testing.assert_allclose(got.weights.sum(axis=-1), got.opacity, rtol=1e-5)
    assert (got.depth >= 2).all() and (got.depth <= 6).all()
    np.testing.assert_array_equal(got.num_dropped, np.zeros(SHAPE, np.int32))


def test_depth_of_fog_is_second_order(rays):
    """Expected depth of constant density: near + (1 - exp(-s L)) / s, in t; 256 midpoints."""
    got = through_fog(None, rays, 0.3, 256)
    rate = 0.3 * np.linalg.norm(np.asarray(rays.directions, np.float64), axis=-1)  # per t
    np.testing.assert_allclose(got.depth, 2 - np.expm1(-4 * rate) / rate, rtol=1e-4)


def test_the_length_of_directions_scales_t(rays):
    longer = dataclasses.replace(rays, directions=2 * rays.directions, near=rays.near / 2, far=rays.far / 2)
    got, expected = draw["rays"](None, longer), draw["rays"](None, rays)
    scaled = dataclasses.replace(
        expected,
        depth=expected.depth / 2,
        disparity=expected.disparity * 2,
        samples=dataclasses.replace(expected.samples, t=expected.samples.t / 2, delta=expected.samples.delta / 2),
    )
    assert_same(got, scaled, atol=1e-5)


@pytest.mark.parametrize("far", [2.0, 6.0, jnp.inf])
def test_an_empty_ray_shows_the_background_at_far(rays, far):
    """The ray has length 0 at far = near = 2, and density 0 otherwise."""
    rays = dataclasses.replace(rays, far=np.full(SHAPE, far, np.float32))
    sigma, background = np.nan if far == 2 else 0.0, np.array([0.1, 0.2, 0.3])
    got = through_fog(None, rays, sigma, 4, background, in_disparity=True)
    np.testing.assert_allclose(got.rgb, np.broadcast_to([0.1, 0.2, 0.3], (*SHAPE, 3)), rtol=1e-6)
    np.testing.assert_array_equal(got.depth, rays.far)
    np.testing.assert_array_equal(got.disparity, 0)
    np.testing.assert_array_equal(got.opacity, 0)


@pytest.mark.parametrize("key", [None, jax.random.key(0)], ids=["fixed", "random"])
def test_a_ray_of_infinite_length_that_meets_matter(rays, key):
    endless = dataclasses.replace(rays, far=np.full(SHAPE, np.inf, np.float32))
    got = through_fog(key, endless, 50.0, 5, in_disparity=True)
    np.testing.assert_array_equal(np.isinf(got.samples.delta), np.arange(5) == np.full((*SHAPE, 1), 4))
    assert all_finite(dataclasses.replace(got, samples=None))
    np.testing.assert_allclose(got.opacity, 1, rtol=1e-6)


def test_a_masked_sample_changes_nothing(rays):
    """The scene returns NaN at its position, and so does the derivative."""
    t = np.broadcast_to(np.float32([2.5, 3.0, 4.0, 1e9]), (*SHAPE, 4))
    delta = np.broadcast_to(np.float32([0.5, 0.5, 1.0, 0.0]), (*SHAPE, 4))

    def loss(scale, kept):
        def scene(x, viewdirs):
            density, rgb = ball(x * scale, viewdirs)
            hole = (jnp.abs(x) > 1e6).any(axis=-1)
            return jnp.where(hole, jnp.nan, density), jnp.where(hole[..., None], jnp.nan, rgb)

        samples = Samples(t=t[..., :kept], delta=delta[..., :kept])
        got = render_samples(scene, rays, samples, background=jnp.ones(3))
        return got.rgb.sum() + got.depth.sum() + got.disparity.sum(), without_samples(got)

    run = jax.jit(jax.value_and_grad(loss, has_aux=True), static_argnums=1)
    assert_same(run(1.0, 4), run(1.0, 3))


@pytest.mark.slow
@pytest.mark.parametrize("name", draw)
def test_a_ray_with_its_own_key_does_not_depend_on_its_batch(rays, keys, name):
    whole = draw[name](keys, rays)
    turned = draw[name](keys[::-1], jax.tree.map(lambda leaf: leaf[::-1], rays))
    assert_same(turned, jax.tree.map(lambda leaf: leaf[::-1], whole))
    one_ray = {"rays": through_ball, "hierarchical": twice_through_ball}[name]
    assert_same(jax.jit(jax.vmap(jax.vmap(one_ray)))(keys, rays), whole)


@pytest.mark.parametrize("name", draw)
def test_samples_are_random_only_with_a_key(rays, name):
    fixed, one = draw[name](None, rays), draw[name](jax.random.key(0), rays)
    assert_same(one, draw[name](jax.random.key(0), rays), rtol=0, atol=0)
    assert (jax.tree.leaves(one)[0] != jax.tree.leaves(fixed)[0]).any()


def test_fine_samples_lie_where_the_coarse_weights_are(rays):
    first, second = draw["hierarchical"](None, rays)
    assert first.weights.shape == (*SHAPE, 8) and second.weights.shape == (*SHAPE, 16)
    exact = compiled(lambda: render_rays(None, ball, rays, num_samples=1024))()
    errors = [abs(got.opacity - exact.opacity).mean() for got in (first, second, draw["rays"](None, rays))]
    assert errors[1] < errors[2] < errors[0]


def test_no_gradient_flows_from_the_fine_rendering_to_the_coarse_scene(rays):
    def fine_color(scale):
        def coarse(x, viewdirs):
            return ball(scale * x, viewdirs)

        return render_hierarchical(None, coarse, ball, rays, num_coarse=8, num_fine=8)[1].rgb.sum()

    assert jax.jit(jax.grad(fine_color))(1.1) == 0


def test_gradients_are_finite_for_every_density(rays):
    def loss(sigma, rule):
        options = {"num_coarse": 4, "num_fine": 4, "rule": rule, "background": jnp.ones(3)}
        renderings = render_hierarchical(None, fog(sigma), fog(sigma), rays, **options)
        return sum(leaf.sum() for r in renderings for leaf in (r.rgb, r.opacity, r.depth, r.disparity))

    for rule in ("segments", "points"):
        sigmas = jnp.array([0.0, 1e-38, 1e-20, 1e-6, 1.0, 1e3, 1e10, 1e30])
        run = jax.jit(jax.vmap(jax.value_and_grad(lambda sigma, rule=rule: loss(sigma, rule))))
        assert all_finite(run(sigmas))


@pytest.mark.parametrize("chunk", [1, 5, 12, 100])
def test_an_image_does_not_depend_on_its_chunks(rays, chunk):
    compiled = []

    @jax.jit
    def render(rays):
        compiled.append(rays.near.shape)
        return through_ball(None, rays)

    got = render_image(render, rays, chunk=chunk)
    assert compiled == [(chunk,)] and got.weights is None and got.samples is None
    assert_same(got, without_samples(draw["rays"](None, rays)))
    with ThreadPoolExecutor(2) as pool:
        assert_same(render_image(render, rays, chunk=chunk, map=pool.map), got, rtol=0, atol=0)


def test_wrong_arguments(rays):
    t = np.ones((*SHAPE, 2), np.float32)
    both = Samples(t=t, delta=t)
    for message, call in {
        "render_samples: delta": lambda: render_samples(ball, rays, Samples(t=t, delta=t[..., :1])),
        "render_samples: t": lambda: render_samples(ball, rays, Samples(t=t[0], delta=t[0])),
        "scene returned density": lambda: render_samples(lambda x, v: (x, x), rays, both),
        r"scene returned \(4, 3, 2, 4\) in place of a pair": lambda: render_samples(
            lambda x, v: jnp.concatenate([x, x[..., :1]], axis=-1), rays, both
        ),
        "render returned tuple, expected a Rendering": lambda: render_image(lambda rays: (rays,), rays, chunk=4),
        "num_samples is 0": lambda: render_rays(None, ball, rays, num_samples=0),
        "background": lambda: render_samples(ball, rays, both, background=np.ones(4)),
        "points_on_rays: t": lambda: points_on_rays(rays, t[0]),
        "rule is 'other'": lambda: render_rays(None, ball, rays, num_samples=4, rule="other"),
        "rule is 'none'": lambda: render_hierarchical(None, ball, ball, rays, num_coarse=4, num_fine=4, rule="none"),
        "chunk": lambda: render_image(lambda rays: through_ball(None, rays), rays, chunk=0),
    }.items():
        with pytest.raises(ValueError, match=message):
            jax.eval_shape(call)
