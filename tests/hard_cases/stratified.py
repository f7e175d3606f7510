"""Hard cases of stratified sampling: by uniform_edges and samples_from_edges, jitted, against float64."""

import functools

import jax
import numpy as np

from hard_cases.checks import Case, Check, absolute, count, not_finite
from jaxnerf import samples_from_edges, uniform_edges

RAYS, SEGMENTS = 4000, 64
RANGES = {  # name: near, far, whether in disparity
    "usual": (2.0, 6.0, False),
    "near = 0": (0.0, 6.0, False),
    "near = far": (2.0, 2.0, False),
    "near = far = 0": (0.0, 0.0, False),
    "near = far, in disparity": (2.0, 2.0, True),
    "far = 1e6": (2.0, 1e6, False),
    "far = 1e30": (0.1, 1e30, False),
    "a few ulps at 1e6": (1e6, 1e6 + 2, False),
    "fewer ulps than segments": (1e6, 1e6 + 1, False),
    "negative near": (-3.0, 5.0, False),
    "in disparity": (0.1, 3.3, True),
    "far = 1e6, in disparity": (0.1, 1e6, True),
    "far = inf, in disparity": (0.5, np.inf, True),
    "near = 1e-30, in disparity": (1e-30, 6.0, True),
}


def cases(edges=uniform_edges, samples=samples_from_edges):
    """Returns the cases, of functions with the arguments of uniform_edges and samples_from_edges."""
    found = [
        Case("stratified", name, functools.partial(_range, edges, samples, *given)) for name, given in RANGES.items()
    ]
    found.append(Case("stratified", "near <= 0 in disparity is an error", functools.partial(_wrong, edges)))
    found.append(Case("stratified", "draws are uniform in their bin", functools.partial(_even, edges, samples)))
    return found


def exact_edges(near, far, in_disparity):
    s = np.arange(SEGMENTS + 1) / SEGMENTS
    near, far = np.float64(np.float32(near)), np.float64(np.float32(far))
    with np.errstate(divide="ignore"):
        return 1 / ((1 - s) / near + s / far) if in_disparity else near + (far - near) * s


def _range(edges, samples, near, far, in_disparity):
    run, slope = _compiled(edges, samples, in_disparity)
    near, far = np.full(RAYS, near, np.float32), np.full(RAYS, far, np.float32)
    got, drawn, middle = run(jax.random.key(0), near, far)
    want = exact_edges(near[0], far[0], in_disparity)
    lower, upper = got[:, :-1], got[:, 1:]
    # Each edge is rounded, and so are the terms that it is the sum of.
    scale = np.maximum(np.abs(want), 0 if in_disparity else abs(float(near[0])))
    finite = np.isfinite(want)
    miss = np.abs(got[0, finite] - want[finite]) / np.where(scale[finite] > 0, scale[finite], 1)
    checks = [
        Check("first edge is near", absolute(got[:, 0], near), 0),
        Check("last edge is far", absolute(got[:, -1], far), 0),
        Check("edges out of order", count(~(upper >= lower)), 0),
        Check("edges, relative", float(miss.max()), 1e-6),
    ]
    for name, (t, delta) in (("draws", drawn), ("midpoints", middle)):
        # In [edge, next edge); a bin without a float inside holds its lower edge.
        outside = ~((t >= lower) & ((t < upper) | ((name == "midpoints") & (t <= upper)) | (lower == upper)))
        checks += [
            Check(f"{name} outside their bin", count(outside), 0),
            Check(f"{name} out of order", count(~(np.diff(t) >= 0)), 0),
            Check(f"{name}: t not finite", not_finite(t), 0, "finite"),
            Check(f"{name}: delta below 0 or NaN", count(~(delta >= 0)), 0),
        ]
    if np.isfinite(far[0]):
        slopes = slope(near[0], far[0])
        checks.append(Check("gradient by near and far not finite", not_finite(*slopes), 0, "finite"))
        if not in_disparity:
            s = np.arange(SEGMENTS + 1) / SEGMENTS
            found = max(absolute(slopes[0], 1 - s), absolute(slopes[1], s))
            if (far[0] - near[0]) / SEGMENTS > 8 * np.spacing(far[0]):  # else neighbours share a float
                checks.append(Check("gradient by near and far", found, 1e-6, "gradient"))
    return checks


def _wrong(edges):
    """1 / t has no equal steps from t <= 0: known values raise an error that says so."""
    silent = []
    for near in (0.0, -1.0, np.nan):
        try:
            edges(np.full(3, near, np.float32), np.full(3, 6, np.float32), num_segments=4, in_disparity=True)
            silent.append(near)
        except ValueError as error:
            if "near" not in str(error):
                silent.append(near)
    return [Check("values of near <= 0 without an error that names it", float(len(silent)), 0)]


def _even(edges, samples):
    run, _ = _compiled(edges, samples, False)
    got, (t, _), _ = run(jax.random.key(1), np.full(RAYS, 2, np.float32), np.full(RAYS, 6, np.float32))
    fraction = (t.astype(np.float64) - got[:, :-1]) / np.diff(got.astype(np.float64))
    counts = np.histogram(fraction, bins=20, range=(0, 1))[0]
    expected = fraction.size / 20
    square = float(((counts - expected) ** 2 / expected).sum())
    return [Check("chi-square of 20 parts of the bins", square, 50.8, "chance")]  # leaves 1e-4 out


@functools.cache
def _compiled(edges, samples, in_disparity):
    options = {"num_segments": SEGMENTS, "in_disparity": in_disparity}

    def both(key, near, far):
        cut = edges(near, far, **options)
        drawn, middle = samples(key, cut), samples(None, cut)
        return cut, (drawn.t, drawn.delta), (middle.t, middle.delta)

    run, slope = jax.jit(both), jax.jit(jax.jacrev(lambda *ends: edges(*ends, **options), argnums=(0, 1)))
    return (
        lambda *given: jax.tree.map(np.asarray, run(*given)),
        lambda *given: jax.tree.map(np.asarray, slope(*given)),
    )
