"""Hard cases of importance sampling: by inverse_cdf and importance_points, jitted.

A point p is right where F(p - one ulp) - 1e-6 <= u <= F(p + one ulp) + 1e-6, F being the float64 running
sum of the float32 weights over its last entry, linear between the edges. Weights below the smallest normal
float count as 0, and if all do, F is that of equal weights.
"""

import functools

import jax
import numpy as np

from hard_cases.checks import Case, Check, count, not_finite
from jaxnerf import importance_points, inverse_cdf

SEGMENTS, DRAWS, OPACITY = 64, 100000, 1e-3
LARGEST = np.float32(1 - 2.0**-24)  # the largest u that a draw may give
PADDING = 1e-5  # the released codes' padding


def cases(invert=inverse_cdf):
    """Returns the cases; invert has the arguments of inverse_cdf."""
    rows = weight_rows()
    found = [
        Case("importance", name, functools.partial(_quantiles, invert, weights, edges))
        for name, (weights, edges) in rows.items()
    ]
    found.append(Case("importance", "scaled by 1e-20 to 1e20", functools.partial(_scaled, invert)))
    if invert is inverse_cdf:
        found += [
            Case("importance", "statistics at opacity 1e-3", _statistics),
            Case("importance", "one point is the median", _median),
            Case("importance", f"bias of a padding of {PADDING:g}", _bias),
        ]
    return found


def weight_rows():
    """Returns {name: (weights [S], edges [S + 1])}."""
    rng = np.random.default_rng(0)
    edges = _edges(SEGMENTS)
    place = np.arange(SEGMENTS)
    usual = rng.exponential(size=SEGMENTS)
    tied = np.sort(np.append(np.repeat(edges[::2], 2), edges[-2:]))[: SEGMENTS + 1]
    rows = {
        "all zero": 0 * usual,
        "denormal weights": np.full(SEGMENTS, 1e-40),
        "denormal beside zero": np.where(place == 9, 1e-41, 0),
        "one-hot, first": place == 0,
        "one-hot, inside": place == 40,
        "one-hot, last": place == SEGMENTS - 1,
        "one-hot of 1e-30": 1e-30 * (place == 40),
        "weights over 30 decades": 10.0 ** rng.uniform(-30, 0, SEGMENTS),
        "weights over 30 decades, ascending": 10.0 ** np.linspace(-30, 0, SEGMENTS),
        "weights over 60 decades": 10.0 ** rng.uniform(-37, 30, SEGMENTS),
        "ties: equal weights": np.full(SEGMENTS, 0.3),
        "ties: zeros between": np.where(place % 4 == 0, usual, 0),
        "a sum that misses 1": np.full(SEGMENTS, 1 / SEGMENTS) * (1 + 2.0**-23 * (place % 3)),
        "a sum over 1": np.full(SEGMENTS, 0.1),
        "opacity 1e-3": usual / usual.sum() * OPACITY,
        "opacity 4e-12": usual / usual.sum() * 4e-12,
    }
    found = {name: (np.asarray(weights, np.float32), edges) for name, weights in rows.items()}
    found["ties: repeated edges"] = np.float32(usual), tied
    found["no width at all"] = np.float32(usual), np.full(SEGMENTS + 1, 2.0, np.float32)
    found["near 1e6"] = np.float32(usual), np.float32(1e6 + np.arange(SEGMENTS + 1) / 16)
    found["one segment"] = np.ones(1, np.float32), np.array([2.0, 6.0], np.float32)
    found["one segment of weight 0"] = np.zeros(1, np.float32), np.array([2.0, 6.0], np.float32)
    found["4096 segments"] = np.float32(rng.exponential(size=4096)), _edges(4096)
    return found


def exact_cdf(weights, edges, points):
    """Returns F(point - ulp) from the left and F(point + ulp) from the right, in float64."""
    weights = np.where(weights < np.finfo(np.float32).tiny, 0, np.asarray(weights, np.float64))
    if not weights.any():
        weights = np.ones_like(weights)
    sums = np.append(0, np.cumsum(weights)) / weights.sum()
    edges = np.asarray(edges, np.float64)
    bounds = []
    for side, where in (("left", -np.inf), ("right", np.inf)):
        near = np.nextafter(points, np.float32(where)).astype(np.float64)
        index = np.clip(np.searchsorted(edges, near, side=side) - 1, 0, len(weights) - 1)
        width = edges[index + 1] - edges[index]
        fraction = np.where(width > 0, (near - edges[index]) / np.where(width > 0, width, 1), side == "right")
        bounds.append(sums[index] + np.clip(fraction, 0, 1) * (sums[index + 1] - sums[index]))
    return bounds


def padding_bias(padding):
    """Returns the fraction of draws outside the one segment of weight, and what weight and padding predict."""
    weights = np.where(np.arange(SEGMENTS) == 40, OPACITY, 0).astype(np.float32)
    edges = _edges(SEGMENTS)
    points = _draw(weights, edges, 1, padding)
    outside = np.mean((points < edges[40]) | (points > edges[41]))
    return outside, (SEGMENTS - 1) * padding / (OPACITY + SEGMENTS * padding)


def _quantiles(invert, weights, edges):
    u = _u()
    points = _invert(invert)(edges[None], weights[None], u[None])[0]
    slopes = _slopes(invert)(edges[None], weights[None], u[None])
    return [
        Check("|F(point) - u| beyond one ulp", _miss(weights, edges, points, u), 1e-6),
        *_in_order(points, edges),
        Check("gradient by edges and u not finite", not_finite(*slopes), 0, "finite"),
    ]


def _scaled(invert):
    weights, edges = weight_rows()["opacity 1e-3"][0] * 1e3, _edges(SEGMENTS)
    u, run = _u(), _invert(invert)
    usual = run(edges[None], weights[None], u[None])[0]
    found = []
    for scale in (1e-20, 1e20):
        power = np.float32(2.0 ** np.round(np.log2(scale)))  # changes no digit of a weight
        points = run(edges[None], (weights * power)[None], u[None])[0]
        found.append(Check(f"points changed by a power of two near {scale:g}", count(points != usual), 0))
        moved = weights * np.float32(scale)
        points = run(edges[None], moved[None], u[None])[0]
        found.append(Check(f"|F(point) - u| scaled by {scale:g}", _miss(weights, edges, points, u), 1e-6))
    return found


def _statistics():
    """Chi-square of draws at opacity 1e-3: one per ray must match independent draws, 64 may fit better."""
    weights, edges = weight_rows()["opacity 1e-3"]
    found = []
    for points_per_ray in (1, 50):
        points = _draw(weights, edges, points_per_ray, 0.0)
        counts = np.histogram(points, bins=edges.astype(np.float64))[0]
        expected = DRAWS * weights.astype(np.float64) / weights.sum(dtype=np.float64)
        found.append(Check("draws outside the edges", float(DRAWS - counts.sum()), 0))
        square = float(((counts - expected) ** 2 / expected).sum())
        found.append(Check(f"chi-square, {points_per_ray} per ray", square, _chi_square(SEGMENTS - 1, 3.72), "chance"))
        if points_per_ray == 1:
            found.append(Check("chi-square too small for chance", _chi_square(SEGMENTS - 1, -3.72), square, "chance"))
    return found


def _median():
    weights, edges = weight_rows()["weights over 30 decades"]
    run = jax.jit(lambda edges, weights: importance_points(None, edges, weights, num_points=1))
    found = []
    for name, row in (("usual", weights), ("empty", 0 * weights)):
        point = np.asarray(run(edges, row))
        found.append(Check(f"|F(point) - 1/2|, {name}", _miss(row, edges, point, np.full(1, 0.5)), 1e-6))
    return found


def _bias():
    found = []
    for padding in (0.0, PADDING):
        measured, predicted = padding_bias(padding)
        deviation = 5 * np.sqrt(predicted * (1 - predicted) / DRAWS)  # of the draws
        what = f"fraction of samples outside the weight, {100 * measured:.1f} %, beside that of the padding"
        found.append(Check(what, float(abs(measured - predicted)), deviation, "chance"))
    return found


def _draw(weights, edges, points_per_ray, padding):
    run = jax.jit(
        functools.partial(importance_points, num_points=points_per_ray, padding=padding),
    )
    rays = DRAWS // points_per_ray
    tiled = [np.broadcast_to(x, (rays, len(x))) for x in (edges, weights)]
    return np.asarray(run(jax.random.key(points_per_ray), *tiled))


def _miss(weights, edges, points, u):
    low, high = exact_cdf(weights, edges, points)
    return float(np.max(np.maximum(np.maximum(low - u, u - high), 0)))


def _in_order(points, edges):
    return [
        Check("points out of order", count(~(np.diff(points) >= 0)), 0),
        Check("points outside the edges", count(~((points >= edges[0]) & (points <= edges[-1]))), 0),
    ]


def _u():
    inner = np.random.default_rng(5).uniform(size=61)
    return np.sort(np.append(inner, [0, 0.5, LARGEST, 1])).astype(np.float32)


def _edges(size):
    widths = np.random.default_rng(size).uniform(0.2, 1.8, size)
    return (2 + 4 * np.append(0, np.cumsum(widths)) / widths.sum()).astype(np.float32)


def _chi_square(freedom, deviations):
    """Returns a quantile of chi-square by Wilson and Hilferty; 3.72 deviations leave 1e-4 out."""
    part = 2 / (9 * freedom)
    return freedom * (1 - part + deviations * np.sqrt(part)) ** 3


@functools.cache
def _invert(invert):
    run = jax.jit(invert)
    return lambda *arrays: np.asarray(run(*arrays))


@functools.cache
def _slopes(invert):
    run = jax.jit(jax.grad(lambda *arrays: invert(*arrays).sum(), argnums=(0, 2)))
    return lambda *arrays: jax.tree.map(np.asarray, run(*arrays))
