"""Every stage of jaxnerf against the slow float64 oracle, from the same float32 numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf
import oracle
from helpers import compiled, random_rays

SEEDS = [0, 1, 2]
RAYS = 5

positional_encoding = compiled(jaxnerf.positional_encoding, "num_freqs")
rays_from_pixels, ndc_rays = compiled(jaxnerf.rays_from_pixels), compiled(jaxnerf.ndc_rays)
look_at, merge_edges = compiled(jaxnerf.look_at), compiled(jaxnerf.merge_edges)
uniform_edges = compiled(jaxnerf.uniform_edges, "num_segments", "in_disparity")
inverse_cdf = compiled(jaxnerf.inverse_cdf)
importance_points = compiled(jaxnerf.importance_points, "num_points")
samples_from_points = compiled(jaxnerf.samples_from_points)
weights_from_density, transmittance = map(compiled, (jaxnerf.weights_from_density, jaxnerf.transmittance))


@compiled
def render_cells(rays, edges, background=None):
    samples = jaxnerf.samples_from_edges(None, edges)
    return jaxnerf.render_samples(scene(jnp, 1.0), rays, samples, background=background)


def render_twice(rays, rule):
    scenes, options = (scene(jnp, 0.7), scene(jnp, 1.1)), {"num_coarse": 16, "num_fine": 24, "rule": rule}
    return jaxnerf.render_hierarchical(None, *scenes, rays, background=jnp.ones(3), **options)


render_twice = compiled(render_twice, "rule")


def exact(array):
    return np.asarray(array, np.float64)


def rows(function, *arrays):
    """Returns the result of the oracle for every row."""
    return np.stack([function(*row) for row in zip(*map(exact, arrays), strict=True)])


def scene(xp, frequency):
    """Returns a scene of waves, in jax or in numpy: density and colour everywhere, different at every position."""

    def scene(x, viewdirs):
        phase = frequency * (x[..., 0] + 0.5 * x[..., 1] - 0.3 * x[..., 2])
        return 0.35 + 0.25 * xp.sin(phase), 0.5 + 0.3 * xp.cos(frequency * x) + 0.2 * viewdirs

    return scene


def assert_parity(got, expected):
    """Compares a batch of renderings with a list of the oracle's."""
    for name in ("rgb", "opacity", "weights"):
        np.testing.assert_allclose(getattr(got, name), [w[name] for w in expected], atol=1e-5, err_msg=name)
    for name in ("depth", "disparity"):
        np.testing.assert_allclose(getattr(got, name), [w[name] for w in expected], rtol=1e-5, err_msg=name)


def each_ray(rays):
    return zip(*(exact(leaf) for leaf in (rays.origins, rays.directions, rays.near, rays.far)), strict=True)


def sorted_uniform(seed, shape, low=0.0, high=1.0):
    draws = np.random.default_rng(seed).uniform(low, high, shape)
    return np.sort(draws, axis=-1).astype(np.float32)


@pytest.mark.parametrize("seed", SEEDS)
def test_positional_encoding(seed):
    x = np.random.default_rng(seed).normal(size=(RAYS, 3)).astype(np.float32)
    got = positional_encoding(x, num_freqs=10)
    np.testing.assert_allclose(got, rows(lambda x: oracle.positional_encoding(x, 10), x), atol=1e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_rays_and_ndc(seed):
    rng = np.random.default_rng(seed)
    eye = rng.normal(size=3) * 0.2
    pose = look_at(eye, eye + [0.1, -0.1, -1.0], jnp.array([0.0, 1.0, 0.1]))
    focal, center = np.array([45.0, 50.0], np.float32), np.array([16.0, 12.0], np.float32)
    camera = jaxnerf.Camera(to_world=pose, focal=focal, center=center, height=24, width=32)
    pixels = rng.uniform(0, 24, (RAYS, 2)).astype(np.float32)
    rays = rays_from_pixels(camera, pixels, near=0.0, far=1.0)
    ndc = ndc_rays(rays, camera, near_plane=1.0)
    for i in range(RAYS):
        o, d = oracle.pinhole_ray(exact(pose), exact(focal), exact(center), exact(pixels[i]))
        np.testing.assert_allclose(rays.origins[i], o, atol=1e-5)
        np.testing.assert_allclose(rays.directions[i], d, atol=1e-5)
        np.testing.assert_allclose(rays.viewdirs[i], d / np.linalg.norm(d), atol=1e-5)
        o, d = oracle.ndc_ray(o, d, exact(focal), 24, 32, 1.0)
        np.testing.assert_allclose(ndc.origins[i], o, atol=1e-5)
        np.testing.assert_allclose(ndc.directions[i], d, atol=1e-5)


@pytest.mark.parametrize("in_disparity", [False, True])
@pytest.mark.parametrize("seed", SEEDS)
def test_edges_and_their_union(seed, in_disparity):
    near, far = sorted_uniform(seed, (RAYS, 2), 0.5, 6.0).T
    got = uniform_edges(near, far, num_segments=9, in_disparity=in_disparity)
    expected = rows(lambda n, f: oracle.uniform_edges(n, f, 9, in_disparity), near, far)
    np.testing.assert_allclose(got, expected, rtol=1e-5)
    points = sorted_uniform(seed + 9, (RAYS, 4), 0.0, 7.0)
    union = rows(lambda e, p: np.array(sorted([*e, *p])), got, points)
    np.testing.assert_allclose(merge_edges(got, points), union, rtol=1e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_inverse_cdf(seed):
    edges, u = sorted_uniform(seed, (RAYS, 9), 2.0, 6.0), sorted_uniform(seed + 9, (RAYS, 12))
    weights = np.random.default_rng(seed).exponential(size=(RAYS, 8)).astype(np.float32)
    weights[0], weights[1, :4], weights[2, 4:] = 0, 0, 0
    expected = rows(oracle.inverse_cdf, edges, weights, u)
    np.testing.assert_allclose(inverse_cdf(edges, weights, u), expected, rtol=1e-5)
    middle = np.broadcast_to(oracle.middle_u(7), (RAYS, 7))
    expected = rows(oracle.inverse_cdf, edges, weights, middle)
    got = importance_points(None, edges, weights, num_points=7)
    np.testing.assert_allclose(got, expected, rtol=1e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_compositing(seed):
    rng = np.random.default_rng(seed)
    t = sorted_uniform(seed, (RAYS, 8), 2.0, 6.0)
    density = rng.exponential(size=t.shape).astype(np.float32) * (rng.uniform(size=t.shape) < 0.7)
    delta = samples_from_points(t).delta
    np.testing.assert_allclose(delta, rows(oracle.deltas, t), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(
        weights_from_density(density, delta),
        rows(lambda *a: oracle.weights(*a)[0], density, delta),
        atol=1e-5,
    )
    transmitted = transmittance(density, delta)
    np.testing.assert_allclose(transmitted, rows(lambda *a: oracle.weights(*a)[1], density, delta), atol=1e-5)


@pytest.mark.parametrize("background", [None, np.array([0.2, 0.9, 0.5], np.float32)], ids=["black", "grey"])
@pytest.mark.parametrize("seed", SEEDS)
def test_render_samples(seed, background):
    rays = random_rays(seed, (RAYS,))
    edges = sorted_uniform(seed, (RAYS, 12), 2.0, 6.0)
    got = render_cells(rays, edges, background)
    expected = [
        oracle.evaluate(scene(np, 1.0), o, d, oracle.middles(e), np.diff(e), far, background)
        for (o, d, _, far), e in zip(each_ray(rays), exact(edges), strict=True)
    ]
    assert_parity(got, expected)


@pytest.mark.parametrize("rule", ["points", "segments"])
@pytest.mark.parametrize("seed", SEEDS)
def test_render_hierarchical(seed, rule):
    rays, white = random_rays(seed, (RAYS,)), np.ones(3)
    got = render_twice(rays, rule)
    scenes = scene(np, 0.7), scene(np, 1.1)
    expected = [oracle.hierarchy(*scenes, *ray, 16, 24, rule, white) for ray in each_ray(rays)]
    for pass_ in (0, 1):
        assert_parity(got[pass_], [w[pass_] for w in expected])


@pytest.mark.parametrize("rule", ["points", "segments"])
def test_random_samples_lie_where_the_paper_draws_them(rule):
    """The scene records its positions: exactly one in each bin of Eq. 2."""
    rays, positions = random_rays(3, (200,)), []

    def note(x, viewdirs):
        positions.append(x)
        return jnp.ones(x.shape[:-1]), jnp.ones(x.shape)

    @compiled
    def places(rays):
        jaxnerf.render_rays(jax.random.key(0), note, rays, num_samples=8, rule=rule)
        return positions[-1]

    x = exact(places(rays))
    o, d = exact(rays.origins)[:, None], exact(rays.directions)[:, None]
    t = ((x - o) * d).sum(axis=-1) / (d**2).sum(axis=-1)
    edges = oracle.uniform_edges(2, 6, 8)
    lower, upper = oracle.stratified_bins(2, 6, 8) if rule == "points" else (edges[:-1], edges[1:])
    fraction = (t - lower) / (upper - lower)
    assert fraction.min() > -1e-5 and fraction.max() < 1 + 1e-5
    assert (fraction.min(axis=0) < 0.1).all() and (fraction.max(axis=0) > 0.9).all()
