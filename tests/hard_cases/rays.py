"""The rays of the hard cases of compositing: RAYS, by name, each a dict of float32 arrays.

density [S], rgb [S, 3], t and delta [S], origins, directions, viewdirs and background [3], near, far;
slope [S, 3] and rgb_slope [S, 3, 3], derivatives of density and rgb with respect to the position.
"""

import numpy as np

SIZE = 64
RAYS = {}
MASKED_NAN = []  # names of rays that hold NaN where delta is 0


def ray(name, density, *, t=None, delta=None, near=2.0, far=6.0, length=1.3, size=SIZE, **given):
    """Adds a ray: uneven samples from near to far unless they are given, colours and slopes at random."""
    rng = np.random.default_rng(len(RAYS))
    if t is None:
        widths = rng.uniform(0.3, 1.7, size)
        edges = near + (min(far, 1e7) - near) * np.append(0, np.cumsum(widths) / widths.sum())
        edges = edges.astype(np.float32)
        t = edges[:-1] + 0.5 * (edges[1:] - edges[:-1])
        delta = np.diff(edges) if delta is None else delta
    density = np.broadcast_to(np.asarray(density, np.float64), np.shape(t))
    usual = density[np.isfinite(density) & (density > 0)]
    place = length * np.max(t) or 1.0  # the length of the ray, so that slopes change density and rgb by their own size
    slope = np.clip((np.median(usual) if len(usual) else 1) / place, 1e-30, 1e20)
    unit = rng.normal(size=3)
    unit /= np.linalg.norm(unit)
    fields = {
        "density": density,
        "rgb": rng.uniform(size=(*np.shape(t), 3)),
        "t": t,
        "delta": delta,
        "origins": rng.normal(size=3),
        "directions": unit * length,
        "viewdirs": unit,
        "near": near,
        "far": far,
        "background": np.array([0.9, 0.2, 0.5]),
        "slope": rng.normal(size=(*np.shape(t), 3)) * slope,
        "rgb_slope": rng.normal(size=(*np.shape(t), 3, 3)) / place,
    }
    RAYS[name] = {key: np.asarray(value, np.float32) for key, value in (fields | given).items()}


def spread(optical, *, seed=0, size=SIZE):
    """Returns random densities of that optical depth over a usual ray, 4 long and 1.3 a unit of t."""
    density = np.random.default_rng(seed).exponential(size=size)
    return density * optical / density.mean() / (4 * 1.3)


def holes(values, fill, every=3):
    return np.where(np.arange(len(values)) % every == 1, fill, values)


def widths(size=SIZE):
    """Returns uneven deltas from 2 to 6, of which every third is 0, and the samples in their middles."""
    delta = holes(np.random.default_rng(7).uniform(0.3, 1.7, size), 0.0)
    delta *= 4 / delta.sum()
    return {"t": 2 + np.cumsum(delta) - delta / 2, "delta": delta}


# Nothing, and too much.
ray("zero density", 0.0)
ray("denormal density", 1e-40)
for value in (1e3, 1e10, 1e30, np.inf):
    ray(f"density {value:g}", value)
ray("densities over 60 decades", 10.0 ** np.random.default_rng(1).uniform(-30, 30, SIZE))
ray("an opaque first sample", np.where(np.arange(SIZE) == 0, 1e10, 1.0))
ray("an infinite first sample", np.where(np.arange(SIZE) == 0, np.inf, 1.0))
ray("an infinite wall in fog", np.where(np.arange(SIZE) == 40, np.inf, spread(1.0)))
ray("one sample of matter in empty space", np.where(np.arange(SIZE) == 20, 10.0, 0.0))
ray("density and length overflow in fog", np.where(np.arange(SIZE) == SIZE - 1, 1e30, spread(1.0)),
    delta=np.append(np.full(SIZE - 1, 0.0625), 1e10))  # fmt: skip
ray("every product overflows", 1e38, delta=np.full(SIZE, 1e5))

# Thin and thick fog.
ray("opacity 4e-12", spread(4e-12))
for optical, size in ((1e-4, 1000), (1e-9, 1000), (1e-5, 10000), (1e-7, 10000), (1e-9, 10000)):
    ray(f"{optical:g} an interval, {size} of them", spread(optical * size, size=size), size=size)
for optical in (1e-4, 1e-6, 1e-9):
    ray(f"{optical:g} an interval, 100000 of them", spread(optical * 1e5, size=100000), size=100000)
ray(
    "a wall in 100000 samples",
    np.where(np.arange(100000) == 70000, 1e6, spread(0.5, size=100000)),
    size=100000,
)
for optical in (5.0, 20.0, 40.0):
    ray(f"fog of one colour, depth {optical:g}", spread(optical), rgb=np.tile([0.7, 0.3, 0.1], (SIZE, 1)))

# Intervals without width, and what stands in them.
ray("zero widths", spread(2.0), **widths())
ray("zero widths of infinite density", holes(spread(2.0), np.inf), **widths())
ray("nothing but zero widths, near = far", np.inf, t=np.full(SIZE, 2.0), delta=np.zeros(SIZE), far=2.0)
for name, density in (
    ("fog", spread(2.0)),
    ("walls", np.full(SIZE, np.inf)),
    ("empty space", np.zeros(SIZE)),
):
    ray(f"NaN in zero widths of {name}", density, **widths())
    MASKED_NAN.append(f"NaN in zero widths of {name}")
for name in MASKED_NAN:
    for key in ("density", "rgb", "t", "slope", "rgb_slope"):
        RAYS[name][key][RAYS[name]["delta"] == 0] = np.nan

# Places.
ray("near = 0", spread(2.0), near=0.0)
ray(
    "near = 0, a sample of weight at t = 0",
    spread(2.0),
    t=np.arange(SIZE) / 16,
    delta=np.full(SIZE, 1 / 16),
    near=0.0,
)
ray("near = 0, an empty sample at t = 0", spread(2.0) * (np.arange(SIZE) > 0), t=np.arange(SIZE) / 16,
    delta=np.full(SIZE, 1 / 16), near=0.0)  # fmt: skip
ray(
    "steps of one ulp at t = 1e6",
    1.0,
    t=1e6 + np.arange(SIZE) / 16,
    delta=np.full(SIZE, 1 / 16),
    near=1e6,
    far=1e6 + 4,
)
ray("direction of length 1e-20", spread(2.0) * 1e20, length=1e-20)
ray("direction of length 1e-20, t of 1e8", spread(2.0) * 1e12, near=2e8, far=6e8, length=1e-20,
    t=2e8 + 4e8 * (np.arange(SIZE) + 0.5) / SIZE, delta=np.full(SIZE, 4e8 / SIZE))  # fmt: skip
ray("direction of length 1e20", spread(2.0) / 1e20, length=1e20)
ray("direction 0", spread(2.0), length=0.0)
ray("direction 0, infinite density", np.inf, length=0.0)

# Depth of rays that are not opaque.
for far in (6.0, 1e6, np.inf):
    inside = {"t": 2 + (np.arange(SIZE) + 0.5) / 16, "delta": np.full(SIZE, 1 / 16), "far": far}
    ray(f"empty, far {far:g}", 0.0, **inside)
    ray(f"nearly empty, far {far:g}", spread(1e-9), **inside)
    ray(f"half empty, far {far:g}", spread(0.7), **inside)
    ray(f"a wall, far {far:g}", np.where(np.arange(SIZE) == 30, 1e10, 0.0), **inside)
    ray(f"thick fog, far {far:g}", spread(30.0), **inside)

# The released codes' last delta.
points = 2 + np.arange(SIZE) / 16
closed = {"t": points, "delta": np.append(np.diff(points), 1e10)}
ray("last delta 1e10 in fog", spread(2.0), **closed)
ray("last delta 1e10 in empty space", 0.0, **closed)
ray("last delta 1e10, density 1e-11", np.where(np.arange(SIZE) == SIZE - 1, 1e-11, spread(0.5)), **closed)

# Samples out of order.
shuffled = np.random.default_rng(3).permutation(points)
ray("unsorted t", spread(2.0), t=shuffled, delta=np.append(np.diff(shuffled), 0.1))
ray("unsorted t, last delta 1e10", spread(2.0), t=shuffled, delta=np.append(np.diff(shuffled), 1e10))
repeated = np.repeat(points[::4], 4)
ray("repeated t", spread(2.0), t=repeated, delta=np.append(np.diff(repeated), 0.1))
ray("descending t", spread(2.0), t=points[::-1], delta=np.append(np.diff(points[::-1]), 0.0))
ray("one sample", 1.0, t=np.array([3.0]), delta=np.array([0.5]))
