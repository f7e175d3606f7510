"""Rows of samples along rays; exact values by the formulas of their documentation, one number after another."""

import functools

import jax.numpy as jnp
import numpy as np

import jaxnerf
from jaxnerf import Rays
from known_errors.rows import Input, Row, ascending

SIZE, POINTS = 6, 4
ENDS = {"near": Input((), "log0", 1e-6, 1e6), "far": Input((), "log", 1e-6, 1e6)}
EDGES = Input((SIZE + 1,), "log0", 1e-6, 1e6)


def rows() -> list[Row]:
    """Returns the rows."""
    inside = {"edges": EDGES}
    sort = {"prepare": lambda given: given | {"edges": ascending(given["edges"])}}
    mass = {"weights": Input((SIZE,), "log0", 1e-6, 1)}
    positive = {"near": Input((), "log", 1e-6, 1e6), "far": ENDS["far"]}
    return [
        Row("uniform_edges", "", ENDS, _uniform, _exact_uniform, prepare=_order),
        Row("uniform_edges", "in disparity", positive, _disparity, _exact_disparity, prepare=_order),
        Row(
            "stepped_edges",
            "",
            ENDS | {"step_size": Input((), "log", 1e-6, 1e6)},
            _stepped,
            _exact_stepped,
            prepare=_order,
            jumps=True,
        ),
        Row("samples_from_edges", "", inside, _samples, _exact_samples, **sort),
        Row("samples_from_edges", "gauss", inside, _gauss, _exact_gauss, **sort),
        Row(
            "samples_from_points",
            "",
            {"t": EDGES},
            lambda t: _fields(jaxnerf.samples_from_points(t)),
            lambda t: (t, jnp.append(jnp.diff(t), 1e10)),
            prepare=lambda given: {"t": ascending(given["t"])},
        ),
        Row(
            "inverse_cdf",
            "",
            inside | mass | {"u": Input((POINTS,), "uniform", 0, 1)},
            jaxnerf.inverse_cdf,
            _exact_inverse,
            **sort,
            constant=("weights",),
            moves=lambda given: {"weights": given["weights"].sum(axis=-1, keepdims=True)},
            jumps=True,
        ),
        Row(
            "importance_points",
            "",
            inside | mass,
            lambda **given: jaxnerf.importance_points(None, **given, num_points=POINTS),
            lambda **given: _exact_inverse(u=(jnp.arange(POINTS) + 0.5) / POINTS, **given),
            **sort,
            gradient=False,
            jumps=True,
        ),
        Row(
            "merge_edges",
            "",
            inside | {"points": Input((POINTS,), "log0", 1e-6, 1e6)},
            jaxnerf.merge_edges,
            lambda edges, points: jnp.sort(jnp.append(edges, points)),
            **sort,
            jumps=True,
        ),
        Row(
            "points_on_rays",
            "",
            {
                "origins": Input((3,), "signed0", 1e-6, 1e6),
                "directions": Input((3,), "signed0", 1e-6, 1e6),
                "t": Input((POINTS,), "log0", 1e-6, 1e6),
            },
            _along,
            lambda origins, directions, t: origins[None] + t[:, None] * directions[None],
        ),
    ]


def _order(given):
    """Returns the inputs with near and far in order."""
    near, far = given["near"], given["far"]
    return given | {"near": np.minimum(near, far), "far": np.maximum(near, far)}


def _uniform(near, far):
    return jaxnerf.uniform_edges(near, far, num_segments=SIZE)


def _disparity(near, far):
    return jaxnerf.uniform_edges(near, far, num_segments=SIZE, in_disparity=True)


def _exact_uniform(near, far):
    return jnp.stack([((SIZE - i) * near + i * far) / SIZE for i in range(SIZE + 1)])


def _exact_disparity(near, far):
    return jnp.stack([SIZE / ((SIZE - i) / near + i / far) for i in range(SIZE + 1)])


def _stepped(near, far, step_size):
    return jaxnerf.stepped_edges(None, near, far, step_size=step_size, num_segments=SIZE)


def _exact_stepped(near, far, step_size):
    inner = [jnp.where(near + i * step_size < far, near + i * step_size, far) for i in range(1, SIZE)]
    return jnp.stack([near, *inner, far])


def _fields(samples):
    return samples.t, samples.delta


def _samples(edges):
    return _fields(jaxnerf.samples_from_edges(None, edges))


def _gauss(edges):
    return _fields(jaxnerf.samples_from_edges(None, edges, rule="gauss"))


def _exact_samples(edges):
    return (edges[1:] + edges[:-1]) / 2, edges[1:] - edges[:-1]


def _exact_gauss(edges):
    middle, half = (edges[1:] + edges[:-1]) / 2, (edges[1:] - edges[:-1]) / 2
    t = jnp.stack([middle - half / jnp.sqrt(3.0), middle + half / jnp.sqrt(3.0)], axis=-1)
    return t.reshape(-1), jnp.repeat(half, 2)


def _exact_inverse(edges, weights, u):
    """Where the running sum of the weights reaches u of their total; in the last segment with weight there."""
    weights = jnp.where((weights == 0).all(), 1.0, weights)
    sums = jnp.concatenate([jnp.zeros_like(weights[:1]), jnp.cumsum(weights)])
    target = u * sums[-1]
    found = edges[0] + 0 * target
    for i in range(SIZE):
        here = (target >= sums[i]) & (weights[i] > 0)
        fraction = (target - sums[i]) / jnp.where(weights[i] > 0, weights[i], 1)
        found = jnp.where(here, edges[i] + fraction * (edges[i + 1] - edges[i]), found)
    return jnp.where(found > edges[-1], edges[-1], found)


def _along(origins, directions, t):
    ends = jnp.ones((), t.dtype)
    rays = functools.partial(Rays, viewdirs=directions, near=ends, far=ends)
    return jaxnerf.points_on_rays(rays(origins=origins, directions=directions), t)
