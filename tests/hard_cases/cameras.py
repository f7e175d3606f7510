"""Hard cases of cameras, jitted: NDC, lengths of vectors, far away cameras and lenses.

Oracles are the closed formulas in float64. Which pixels have a preimage is decided by brute force: from
the centre outwards the exact inverse is followed in small steps, as long as the lens does not fold.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from hard_cases.checks import Case, Check, absolute, count, not_finite, relative
from jaxnerf import Camera, Rays, look_at, ndc_rays, pixel_grid, rays_from_pixels, undistort
from jaxnerf.core.safe_math import norm, normalize

EPS = float(np.finfo(np.float32).eps)
COUNT, FOCAL, HEIGHT, WIDTH = 500, 400.0, 300, 400
LENSES, PIXELS, STEPS = 12, 160, 80


def cases():
    found = [Case("cameras", f"NDC: {name}", functools.partial(_ndc, *rays)) for name, rays in forward().items()]
    found += [
        Case("cameras", f"length {length:g}", functools.partial(_length, length))
        for length in (0.0, 1e-30, 1e-20, 1.0, 1e20, 1e37)
    ]
    found.append(Case("cameras", "components over 60 decades", _mixed))
    found.append(Case("cameras", "a camera 1e6 away", _far_away))
    found += [Case("cameras", f"{LENSES} random {name} lenses", functools.partial(_lenses, name)) for name in LENS]
    found.append(Case("cameras", "lenses that bend nothing", functools.partial(_lenses, "opencv", still=True)))
    return found


def forward():
    """Returns {name: (origins [COUNT, 3], directions [COUNT, 3])} of rays to convert to NDC."""
    rng = np.random.default_rng(0)
    origins, lateral = 0.3 * rng.normal(size=(COUNT, 3)), rng.normal(size=(COUNT, 2))

    def ray(z, place=origins, side=lateral):
        directions = np.concatenate([side, np.broadcast_to(z, (COUNT,))[:, None]], axis=-1)
        return place.astype(np.float32), directions.astype(np.float32)

    def at(z):
        return np.where(np.arange(3) == 2, z, origins)

    found = {"usual rays": ray(-1.0), "long directions": ray(-1e10, side=1e10 * lateral)}
    found |= {f"d_z of {-z:g}": ray(-z) for z in (1e-3, 1e-8, 1e-18)}
    found |= {f"d_z of {z:g}": ray(z) for z in (0.0, 1e-20, 1.0)}
    found |= {f"origins at z = {z:g}": ray(-1.0, at(z)) for z in (-1.0, -1.0000001, -5.0, 0.0, 3.0)}
    found["zero directions"] = ray(0.0, side=0 * lateral)
    found["origins 1e6 away"] = ray(-1.0, origins + [1e6, -1e6, 1e6])
    found["origins 1e6 behind the near plane"] = ray(-1.0, origins - [0, 0, 1e6])
    return found


def exact_ndc(origins, directions):
    """Returns NDC origins and directions (x and y) in float64, and the sum of the terms each is made of."""
    origins, directions = origins.astype(np.float64), directions.astype(np.float64)
    scale = 2 * FOCAL / np.array([WIDTH, HEIGHT])
    side, along = directions[:, :2], directions[:, 2:]
    shift = -(1 + origins[:, 2:]) / along
    place = scale * (origins[:, :2] + shift * side)
    reach = (1 + abs(origins[:, 2:])) / abs(along)
    place_terms = scale * (abs(origins[:, :2]) + reach * abs(side))
    return place, -scale * side / along - place, place_terms, scale * abs(side / along) + place_terms


def _ndc(origins, directions):
    run, slope = _ndc_compiled()
    got = run(origins, directions)
    ahead = directions[:, 2] < 0
    checks = [
        Check("not finite", not_finite(*jax.tree.leaves(got)), 0, "finite"),
        Check("near other than 0", count(got.near), 0),
        Check("far of rays that go ahead and back", absolute(got.far, ahead), 0),
        Check("gradient not finite", not_finite(*slope(origins, directions)), 0, "finite"),
        Check(
            "box: z of origins and directions",
            count((got.origins[:, 2] != -1) | (got.directions[:, 2] != 2)),
            0,
        ),
    ]
    if ahead.any():
        place, turn, place_terms, turn_terms = exact_ndc(origins[ahead], directions[ahead])
        place_error = abs(got.origins[ahead, :2] - place) / place_terms
        turn_error = abs(got.directions[ahead, :2] - turn) / turn_terms
        checks += [
            Check("origins, of their terms", float(place_error.max()), 8 * EPS),
            Check("directions, of their terms", float(turn_error.max()), 8 * EPS),
        ]
    return checks


def _length(length):
    vectors = np.random.default_rng(0).normal(size=(COUNT, 3))
    vectors *= length / np.linalg.norm(vectors, axis=-1, keepdims=True)
    vectors[:3] = length * np.eye(3)
    return _normalized(vectors.astype(np.float32))


def _mixed():
    vectors = 10.0 ** np.random.default_rng(1).uniform(-30, 30, (COUNT, 3))
    return _normalized(np.float32(vectors * np.array([1, -1, 1])))


def _normalized(vectors):
    lengths, units, slopes = _norm_compiled()(vectors)
    wide = vectors.astype(np.longdouble)
    want = np.sqrt((wide**2).sum(axis=-1))
    exact_units = wide / np.where(want > 0, want, 1)[:, None]
    return [
        Check("length", relative(lengths, want), 1e-6),
        Check("unit vectors", absolute(units, exact_units), 1e-6),
        Check("not finite", not_finite(lengths, units), 0, "finite"),
        Check("gradient not finite", not_finite(*slopes), 0, "finite"),
        Check("gradient of the length", absolute(slopes[0], exact_units), 1e-6, "gradient"),
    ]


def _far_away():
    eye = np.array([1e6, -1e6, 1e6], np.float32)
    pose = np.asarray(look_at(eye, eye + np.array([-300, 200, -100], np.float32), np.array([0.0, 0.0, 1.0])))
    pixels = np.asarray(pixel_grid(HEIGHT, WIDTH)).reshape(-1, 2)[:: HEIGHT * WIDTH // COUNT]
    run = jax.jit(lambda pose: rays_from_pixels(_camera(to_world=pose), pixels, near=2.0, far=6.0))
    rays = jax.tree.map(np.asarray, run(pose))
    x, y = ((pixels.astype(np.float64) - [WIDTH / 2, HEIGHT / 2]) / FOCAL).T
    local = np.stack([x, -y, -np.ones_like(x)], axis=-1)
    want = local @ pose[:, :3].T.astype(np.float64)
    units = want / np.linalg.norm(want, axis=-1, keepdims=True)
    square = pose[:, :3].T.astype(np.float64) @ pose[:, :3]
    return [
        Check("origins", absolute(rays.origins, np.broadcast_to(eye, rays.origins.shape)), 0),
        Check("directions", absolute(rays.directions, want), 8 * EPS),
        Check("viewdirs", absolute(rays.viewdirs, units), 1e-6),
        Check("look_at: a rotation", absolute(square, np.eye(3)), 1e-6),
    ]


def brown(k, points):
    """The "opencv" lens on points [..., 2]; k broadcasts, its coefficients first."""
    k1, k2, p1, p2, k3 = k
    x, y = points[..., 0], points[..., 1]
    square = x * x + y * y
    radial = 1 + k1 * square + k2 * square**2 + k3 * square**3
    bent_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    return np.stack([bent_x, y * radial + 2 * p2 * x * y + p1 * (square + 2 * y * y)], axis=-1)


def equidistant(k, angles):
    """The "fisheye" lens on vectors [..., 2] whose length is the angle from the axis."""
    square = (angles**2).sum(axis=-1)
    return angles * (1 + sum(c * square ** (i + 1) for i, c in enumerate(k)))[..., None]


def follow(lens, k, targets):
    """Returns the exact inverse in float64 [..., 2], and how far towards each target it exists, up to 1.

    STEPS steps outwards from the centre, each by Newton's method from the last. The lens folds where its
    Jacobian's determinant reaches 0 or Newton no longer arrives; beyond that there is no preimage.
    """
    point, reached = np.zeros_like(targets), np.zeros(targets.shape[:-1])
    alive = np.ones(targets.shape[:-1], bool)
    with np.errstate(all="ignore"):
        for step in range(1, STEPS + 1):
            trial = point
            for _ in range(6):
                jacobian = _jacobian(lens, k, trial)
                off = np.linalg.solve(jacobian, (lens(k, trial) - targets * step / STEPS)[..., None])
                trial = trial - np.where(alive[..., None], off[..., 0], 0)
            miss = abs(lens(k, trial) - targets * step / STEPS).max(axis=-1)
            jump = np.linalg.norm(trial - point, axis=-1)
            alive &= (miss < 1e-12) & (np.linalg.det(_jacobian(lens, k, trial)) > 0) & (jump < 0.5)
            point, reached = np.where(alive[..., None], trial, point), np.where(alive, step / STEPS, reached)
    return point, reached


LENS = {
    # name: the lens, how many coefficients it has in the camera, their size, and how far out pixels lie
    "opencv": (brown, [0.4, 0.15, 0.01, 0.01, 0.05], 1.5),
    "fisheye": (equidistant, [0.15, 0.05, 0.02, 0.005], 2.2),
}


def _lenses(name, still=False):
    lens, sizes, reach = LENS[name]
    rng = np.random.default_rng(2)
    k = rng.uniform(-1, 1, (LENSES, len(sizes))) * np.array(sizes) * (0 if still else 1)
    pixels = rng.uniform(-reach, reach, (LENSES, PIXELS, 2)) * FOCAL + np.array([WIDTH / 2, HEIGHT / 2])
    pixels[:, 0] = WIDTH / 2, HEIGHT / 2  # the centre, which is its own image
    k, pixels = k.astype(np.float32), pixels.astype(np.float32)
    points, converged = _undistort(name)(k, pixels)
    targets = (pixels.astype(np.float64) - [WIDTH / 2, HEIGHT / 2]) / FOCAL
    wide = [c[:, None] for c in k.astype(np.float64).T]
    inverse, reached = follow(lens, wide, targets * 1.01)
    before, sooner = follow(lens, wide, targets * 0.99)
    exists, lacks = (
        reached == 1,
        sooner < 1,
    )  # also a little nearer and further: float32 need not decide an edge
    if name == "fisheye":
        # The plane at distance 1 is seen up to a right angle.
        angle = np.linalg.norm(inverse, axis=-1)
        exists, lacks = exists & (angle < 1.55), lacks | (np.linalg.norm(before, axis=-1) > np.pi / 2)
    back = points.astype(np.float64)
    if name == "fisheye":
        radius = np.linalg.norm(back, axis=-1, keepdims=True)
        back = back * np.where(radius > 0, np.arctan(radius) / np.where(radius > 0, radius, 1), 1)
    residual = np.linalg.norm(lens(wide, back) - targets, axis=-1)
    return [
        Check("residual where converged", float(residual[converged].max()), 1e-6),
        Check("pixels without a preimage that are not flagged", count(converged & lacks), 0),
        Check("pixels with a preimage that are flagged", count(~converged & exists), 0),
        Check("flagged points other than 0", count(points[~converged]), 0),
        Check("not finite", not_finite(points), 0, "finite"),
        Check(
            "pixels of which none has, or lacks, a preimage",
            float(not (still or lacks.any()) + (not exists.any())),
            0,
        ),
    ]


def _jacobian(lens, k, points):
    step = 1e-6
    columns = [(lens(k, points + d) - lens(k, points - d)) / (2 * step) for d in step * np.eye(2)]
    return np.stack(columns, axis=-1)


def _camera(**given):
    pose = np.concatenate([np.eye(3), np.zeros((3, 1))], axis=1).astype(np.float32)
    center, focal = jnp.array([WIDTH / 2, HEIGHT / 2]), jnp.full(2, FOCAL)
    return Camera(**({"to_world": pose, "focal": focal, "center": center, "height": HEIGHT, "width": WIDTH} | given))


@functools.cache
def _undistort(name):
    def one(k, pixels):
        return undistort(_camera(distortion=k, lens=name), pixels)

    run = jax.jit(jax.vmap(one))
    return lambda *given: jax.tree.map(np.asarray, run(*given))


@functools.cache
def _ndc_compiled():
    def rays(origins, directions):
        ends = jnp.ones(origins.shape[:-1])
        return Rays(origins=origins, directions=directions, viewdirs=directions, near=ends, far=ends)

    def total(origins, directions):
        ndc = ndc_rays(rays(origins, directions), _camera())
        return ndc.origins.sum() + ndc.directions.sum()

    run = jax.jit(lambda *given: ndc_rays(rays(*given), _camera()))
    slope = jax.jit(jax.grad(total, argnums=(0, 1)))
    return (
        lambda *given: jax.tree.map(np.asarray, run(*given)),
        lambda *given: jax.tree.map(np.asarray, slope(*given)),
    )


@functools.cache
def _norm_compiled():
    def both(vectors):
        slopes = [jax.grad(lambda v, f=f: f(v).sum())(vectors) for f in (norm, lambda v: normalize(v)[..., 0])]
        return norm(vectors), normalize(vectors), slopes

    run = jax.jit(both)
    return lambda vectors: jax.tree.map(np.asarray, run(vectors))
