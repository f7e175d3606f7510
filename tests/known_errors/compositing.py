"""Rows of volume rendering, renderers and the occupancy grid; exact values by the paper's equations, term by term."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxnerf
from jaxnerf import Rays, Samples
from known_errors.rows import Input, Row, ascending
from known_errors.sampling import _exact_gauss, _exact_inverse, _exact_samples

SIZE = 8
DENSITY, LENGTH = Input((SIZE,), "log0", 1e-9, 1e9), Input((SIZE,), "log0", 1e-6, 1e3)
WEIGHTS, T = Input((SIZE,), "log0", 1e-9, 1), Input((SIZE,), "log", 1e-3, 1e4)
COLORS, COLOR = Input((SIZE, 3), "uniform", 0, 1), Input((3,), "uniform", 0, 1)
FAR = Input((), "log", 1e-3, 1e6)
RAY = {
    "origins": Input((3,), "signed0", 1e-2, 1),
    "directions": Input((3,), "signed", 1e-2, 1),
    "sigma": Input((), "log0", 1e-6, 1e6),
    "place": Input((3,), "signed0", 1e-2, 1),
}


def rows() -> list[Row]:
    """Returns the rows."""
    matter = {"density": DENSITY, "length": LENGTH}
    sort, thin = {"prepare": lambda given: given | {"t": ascending(given["t"])}}, {"scale": _of_transmittance}
    return [
        Row("weights_from_density", "", matter, jaxnerf.weights_from_density, _exact_weights, **thin),
        Row("weights_from_density", "gauss", matter, _gauss_weights, _exact_gauss_weights, jumps=True, **thin),
        Row("transmittance", "", matter, jaxnerf.transmittance, lambda **given: _weights(**given)[1]),
        Row(
            "composite",
            "",
            {"weights": WEIGHTS, "values": COLORS, "background": COLOR, "behind": Input((), "uniform", 0, 1)},
            lambda behind, **given: jaxnerf.composite(**given, transmittance=behind),
            lambda weights, values, background, behind: weights @ values + behind * background,
        ),
        Row(
            "expected_depth",
            "",
            {"weights": WEIGHTS, "t": T, "transmittance": Input((), "log0", 1e-9, 1), "far": FAR},
            jaxnerf.expected_depth,
            lambda weights, t, transmittance, far: weights @ t + transmittance * far,
        ),
        Row(
            "expected_disparity",
            "",
            {"weights": WEIGHTS, "t": T},
            jaxnerf.expected_disparity,
            lambda weights, t: (weights / t).sum(),
        ),
        Row(
            "median_depth",
            "",
            matter | {"t": T, "delta": LENGTH, "far": FAR},
            jaxnerf.median_depth,
            _median,
            **sort,
            jumps=True,
            moves=_rounded_sum,
        ),
        *_renderers(),
        *_grids(),
    ]


def _weights(density, length):
    """Eq. 3, and the transmittance of the whole ray."""
    depth = _depth(density, length)
    before = jnp.concatenate([jnp.zeros_like(depth[:1]), jnp.cumsum(depth)])
    return jnp.exp(-before[:-1]) * _absorbed(depth), jnp.exp(-before[-1])


@jax.custom_jvp
def _absorbed(depth):
    """1 - exp(-x), with the derivative exp(-x): that of expm1 is 1 - (1 - exp(-x))."""
    return -jnp.expm1(-depth)


@_absorbed.defjvp
def _absorbed_jvp(primals, tangents):
    return _absorbed(primals[0]), jnp.exp(-primals[0]) * tangents[0]


def _rounded_sum(given):
    """An optical depth moves by half an ulp of their sum."""
    total = (given["density"] * given["length"]).sum(axis=-1, keepdims=True)
    return {"density": total / np.where(given["length"] > 0, given["length"], np.inf)}


def _of_transmittance(given, slopes):
    """What gradients would be if only one sample were seen: the transmittance before it, times the largest slope.

    They are differences of such numbers, which cancel where samples are thin.
    """
    density, length = given["density"], given["length"]
    depth = np.minimum(density * length, 1e4)
    light = np.exp(depth - np.cumsum(depth, axis=-1)) * np.abs(slopes).max(axis=-1, keepdims=True)
    return {"density": light * length, "length": light * density}


def _of_colors(given, slopes):
    """As _of_transmittance; the slope of a sample is that of its colour, opacity, depth and disparity."""
    t, far = given["t"], given["far"][:, None]
    sizes = np.stack([np.maximum(far, t).max(axis=-1), 1 / t.min(axis=-1)], axis=-1)
    most = (np.abs(slopes) * np.concatenate([np.ones_like(slopes[:, :4]), sizes], axis=-1)).sum(axis=-1)
    speed = _norm(given["directions"])
    found = _of_transmittance({"density": given["density"], "length": given["delta"] * speed}, most[:, None])
    by_speed = (found["length"] * given["delta"]).sum(axis=-1, keepdims=True)
    return {"density": found["density"], "delta": found["length"] * speed, "directions": by_speed}


def _norm(directions):
    return np.linalg.norm(directions, axis=-1, keepdims=True)


def _depth(density, length):
    """The optical depth; beyond 1e4 nothing is transmitted in any float type. Length 0 removes a sample."""
    depth = jnp.where(length > 0, density, 0) * jnp.where(density > 0, length, 0)
    plain = jnp.where(length > 0, density * length, 0)
    return jnp.where(depth > 1e4, 1e4, plain)


def _exact_weights(density, length):
    return _weights(density, length)[0]


def _gauss_weights(density, length):
    return jaxnerf.weights_from_density(density, length, rule="gauss")


def _exact_gauss_weights(density, length):
    """The sum of each pair stays, and the ratio of the first to the second grows by exp((1/sqrt(3) - 1/2) tau)."""
    weights, depth = _weights(density, length)[0], _depth(density, length)
    first, second = weights[::2], weights[1::2]
    both = depth[::2] + depth[1::2]
    growth = jnp.expm1((1 / jnp.sqrt(3.0) - 0.5) * jnp.minimum(both, 4))
    absorbed = _absorbed(jnp.where(both > 0, both, 1))
    # Of what lies before the pair, first = T a, so that T is not needed: growth a / absorbed is a fraction.
    moved = jnp.where(both > 0, growth * _absorbed(depth[::2]) / absorbed, 0)
    moved = moved / (1 + moved) * second
    return jnp.stack([first + moved, second - moved], axis=-1).reshape(-1)


def _median(density, length, t, delta, far):
    depth = _depth(density, length)
    found, done = far, jnp.zeros((), bool)
    before = jnp.zeros_like(far)
    for i in range(SIZE):
        here = (before + depth[i] >= jnp.log(2.0)) & (depth[i] > 0)
        fraction = (jnp.log(2.0) - before) / jnp.where(depth[i] > 0, depth[i], 1)
        place = t[i] + (jnp.clip(fraction, 0, 1) - 0.5) * delta[i]
        found, done = jnp.where(here & ~done, place, found), done | here
        before = before + depth[i]
    return jnp.minimum(found, far)


# Renderers: of arrays, and of a scene that is a polynomial, so that its own rounding is small.


def _renderers():
    given = {
        "density": DENSITY,
        "rgb": COLORS,
        "t": T,
        "delta": LENGTH,
        "origins": RAY["origins"],
        "directions": RAY["directions"],
        "background": COLOR,
        "far": FAR,
    }
    options = {"prepare": lambda given: given | {"t": ascending(given["t"])}, "scale": _of_colors}
    plain = {"bfloat16": False}
    march = RAY | {"near": Input((), "log", 1e-2, 1), "thickness": Input((), "log", 1, 10)}
    normal = {"sigma": RAY["sigma"], "place": RAY["place"], "x": Input((2, 3), "signed0", 1e-2, 1)}
    return [
        Row("render_samples", "", given, _render_samples, _exact_render_samples, **options),
        Row("render_packed", "", given, _render_packed, _exact_render_samples, **options),
        Row("render_rays", "", march, _render_rays, _exact_render_rays, **plain),
        Row("render_rays", "gauss", march, functools.partial(_render_rays, rule="gauss"), _exact_render_gauss, **plain),
        Row("render_image", "", march, _render_image, _exact_render_rays, **plain),
        Row("render_hierarchical", "", march, _render_hierarchical, _exact_hierarchical, gradient=False, **plain),
        Row("density_normals", "", normal, _normals, _exact_normals, whole=True, constant=("sigma",), **plain),
        Row(
            "density_normals",
            "with a spacing",
            normal | {"spacing": Input((), "log", 0.1, 1)},
            _normals,
            _exact_normals,
            whole=True,
            constant=("sigma", "spacing"),
            **plain,
        ),
        Row("mask_scene", "", normal, _masked, _exact_masked, **plain),
    ]


def _rays(origins, directions, near, far):
    views = directions / jnp.linalg.norm(directions)
    return Rays(origins=origins, directions=directions, viewdirs=views, near=near, far=far)


def _outputs(seen):
    return seen.rgb, seen.opacity, seen.depth, seen.disparity


def _render_samples(density, rgb, t, delta, origins, directions, background, far):
    rays, samples = _rays(origins, directions, jnp.zeros_like(far), far), Samples(t=t, delta=delta)
    scene = lambda x, viewdirs: (density, rgb)  # noqa: E731
    return _outputs(jaxnerf.render_samples(scene, rays, samples, background=background))


def _render_packed(density, rgb, t, delta, origins, directions, background, far):
    rays, samples = _rays(origins, directions, jnp.zeros_like(far), far), Samples(t=t, delta=delta)
    rays, samples = jax.tree.map(lambda leaf: leaf[None], (rays, samples))

    def scene(x, viewdirs):
        kept = jnp.cumsum(delta > 0) - 1  # packed without those of length 0
        order = jnp.zeros(SIZE, int).at[jnp.where(delta > 0, kept, SIZE)].set(jnp.arange(SIZE), mode="drop")
        return density[order][None], rgb[order][None]

    seen = jaxnerf.render_packed(scene, None, rays, samples, max_samples=SIZE, background=background)
    return jax.tree.map(lambda leaf: leaf[0], _outputs(seen))


def _exact_render_samples(density, rgb, t, delta, origins, directions, background, far):
    del origins
    weights, behind = _weights(density, delta * jnp.sqrt((directions**2).sum()))
    weights = jnp.where(delta > 0, weights, 0)
    color = weights @ jnp.where(delta[:, None] > 0, rgb, 0) + behind * background
    # 1 - exp(-x) of the sum, as 1 - behind would cancel even in float64.
    opacity = _absorbed(_depth(density, delta * jnp.sqrt((directions**2).sum())).sum())
    return color, opacity, weights @ t + behind * far, (weights / t).sum()


def _medium(sigma, place):
    """Density sigma |x - place|^2, colours x^2 / (1 + x^2)."""

    def scene(x, viewdirs):
        return sigma * ((x - place) ** 2).sum(axis=-1), x**2 / (1 + x**2)

    return scene


def _render_rays(origins, directions, sigma, place, near, thickness, rule="segments"):
    rays = _rays(origins, directions, near, near + thickness)
    return _outputs(jaxnerf.render_rays(None, _medium(sigma, place), rays, num_samples=SIZE, rule=rule))


def _render_image(origins, directions, sigma, place, near, thickness):
    rays = jax.tree.map(lambda leaf: leaf[None, None], _rays(origins, directions, near, near + thickness))
    render = functools.partial(jaxnerf.render_rays, None, _medium(sigma, place), num_samples=SIZE)
    return jax.tree.map(lambda leaf: leaf[0, 0], _outputs(jaxnerf.render_image(render, rays, chunk=2)))


def _render_hierarchical(origins, directions, sigma, place, near, thickness):
    rays, scene = _rays(origins, directions, near, near + thickness), _medium(sigma, place)
    seen = jaxnerf.render_hierarchical(None, scene, scene, rays, num_coarse=6, num_fine=4)
    return [_outputs(each) for each in seen]


def _exact_at(t, delta, weigh, origins, directions, sigma, place, near, thickness):
    density, rgb = _medium(sigma, place)(origins + t[:, None] * directions, None)
    length = delta * jnp.sqrt((directions**2).sum())
    weights, behind = weigh(density, length), _weights(density, length)[1]
    opacity = _absorbed(_depth(density, length).sum())
    return weights @ rgb, opacity, weights @ t + behind * (near + thickness), (weights / t).sum(), weights


def _edges(near, thickness, count):
    return near + thickness * jnp.arange(count + 1) / count


def _exact_render_rays(**given):
    t, delta = _exact_samples(_edges(given["near"], given["thickness"], SIZE))
    return _exact_at(t, delta, lambda *matter: _weights(*matter)[0], **given)[:4]


def _exact_render_gauss(**given):
    t, delta = _exact_gauss(_edges(given["near"], given["thickness"], SIZE // 2))
    return _exact_at(t, delta, _exact_gauss_weights, **given)[:4]


def _exact_hierarchical(**given):
    edges, weigh = _edges(given["near"], given["thickness"], 6), lambda *matter: _weights(*matter)[0]
    *coarse, weights = _exact_at(*_exact_samples(edges), weigh, **given)
    points = _exact_inverse(edges, weights, (jnp.arange(4) + 0.5) / 4)
    fine = _exact_at(*_exact_samples(jnp.sort(jnp.append(edges, points))), weigh, **given)
    return coarse, fine[:4]


def _normals(sigma, place, x, spacing=None):
    return jaxnerf.density_normals(_medium(sigma, place), x, jnp.ones((1, 3)) / jnp.sqrt(3.0), spacing=spacing)


def _exact_normals(sigma, place, x, spacing=None):
    gradient = sigma * (x - place)
    if spacing is not None:
        corners = jnp.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / jnp.sqrt(3.0)
        density = [_medium(sigma, place)(x + spacing * corner, None)[0] for corner in corners]
        levels = [jnp.log1p(1000 * each * spacing) for each in density]
        gradient = sum(each[:, None] * corner for each, corner in zip(levels, corners, strict=True))
    size = jnp.sqrt((gradient**2).sum(axis=-1, keepdims=True))
    # Where the levels at the corners are nearly equal, rounding decides.
    least = 0 if spacing is None else 0.01 * jnp.stack(levels).max(axis=0)[:, None]
    return -gradient / jnp.where(size > least, size, jnp.nan)


# The grid, with a scene of one density.


def _grids():
    update = {
        "found": Input((), "log", 1e-2, 1e2),
        "maximum": Input((), "log0", 1e-3, 1e3),
        "mean": Input((), "log0", 1e-2, 1e2),
        "spacing": Input((), "log", 1e-3, 1),
    }
    # Optical depths per spacing: thinner cells are emptied.
    thick = {"prepare": lambda given: given | {name: given[name] / given["spacing"] for name in ("found", "mean")}}
    box = {"low": Input((3,), "signed0", 1e-3, 1e3), "side": Input((), "log", 1e-3, 1e3)}
    return [
        Row("create_grid", "", box | {"density": Input((), "log", 1e-3, 1e3)}, _create, _exact_create),
        Row("update_grid", "", update, _update, _exact_update, gradient=False, **thick),
        Row(
            "grid_from_scene", "", {"found": Input((), "log", 2e-2, 30)}, _from_scene, _exact_from_scene, gradient=False
        ),
    ]


def _cells(low, upper, density):
    return jaxnerf.create_grid(low, upper, jnp.ones((2, 2, 2), bool), initial_density=density)


def _create(low, side, density):
    grid = _cells(low, low + side, density)
    return grid.lower, grid.upper, grid.density_max


def _exact_create(low, side, density):
    return low, low + side, jnp.full((2, 2, 2), density)


def _constant(found):
    return lambda x, viewdirs: (jnp.broadcast_to(found, x.shape[:-1]), jnp.zeros_like(x))


def _update(found, maximum, mean, spacing):
    grid = _cells(jnp.zeros(3), jnp.ones(3), maximum)
    grid = dataclasses.replace(grid, density_mean=jnp.full((2, 2, 2), mean))
    options = {"threshold": 0.0, "spacing": spacing, "decay": 0.5, "smoothing": 0.25}
    after = jaxnerf.update_grid(jax.random.key(0), grid, _constant(found), jnp.arange(8), **options)
    return after.density_max, after.density_mean


def _exact_update(found, maximum, mean, spacing):
    largest = jnp.maximum(0.5 * maximum, found)
    thin = 0.75 * jnp.expm1(-spacing * mean) + 0.25 * jnp.expm1(-spacing * found)
    thick = 0.75 * jnp.exp(-spacing * mean) + 0.25 * jnp.exp(-spacing * found)
    log = jnp.where(thick > 0.5, jnp.log1p(thin), jnp.log(jnp.maximum(thick, 1e-30)))
    uniform = -log / spacing
    whole = functools.partial(jnp.broadcast_to, shape=(2, 2, 2))
    return whole(largest), whole(jnp.where(largest > 0, uniform, -1))


def _from_scene(found):
    low, high = jnp.zeros(3), jnp.ones(3)
    grid = jaxnerf.grid_from_scene(jax.random.key(0), _constant(found), low, high, (2, 2, 2), threshold=1e-2)
    return grid.density_max, grid.density_mean


def _exact_from_scene(found):
    whole = jnp.broadcast_to(found, (2, 2, 2))
    return whole, jnp.where(whole > 1e-2, whole, -1)


def _masked(sigma, place, x):
    grid = _cells(-4 * jnp.ones(3), 4 * jnp.ones(3), 1.0)
    return jaxnerf.mask_scene(_medium(sigma, place), grid)(x, jnp.ones((1, 3)) / jnp.sqrt(3.0))


def _exact_masked(sigma, place, x):
    return _medium(sigma, place)(x, None)
