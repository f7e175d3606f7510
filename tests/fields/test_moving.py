"""The field that moves: at rest at first, a hash grid at displaced positions, and a hash grid where nothing moves."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnerf.core.scene import needs_of
from jaxnerf.fields import hash_grid
from jaxnerf.fields.base import at_time
from jaxnerf.fields.moving import MovingOptions, from_options
from jaxnerf.options import Device, Facts

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")

BOX = (-1.0, -1.5, 0.0), (1.0, 1.5, 4.0)
GRID = {"resolutions": (4, 8), "prefilter": False, "compute_dtype": "float32", "table_size": 64}


@pytest.fixture(scope="module")
def points():
    x = np.random.default_rng(0).uniform(*BOX, (3, 5, 3)).astype(np.float32)
    return x, np.float32(np.broadcast_to([0, 0, 1.0], (3, 1, 3))), np.float32([[0.0], [0.3], [1.0]])


@pytest.fixture(scope="module")
def parts(unoptimized):
    """Returns the field, parameters whose density does not read the code, and the hash grid with these parameters."""
    options = MovingOptions(**GRID, motion_depth=1, motion_width=8, motion_freqs=0, time_freqs=0)
    field = from_options(options, BOX)
    assert needs_of(field.apply) == ("time",) and field.network is None
    params = jax.jit(field.init)(jax.random.key(0))
    kernel = np.concatenate([np.eye(64, dtype=np.float32), np.zeros((8, 64), np.float32)])
    params["code"] = {"kernel": kernel, "bias": np.zeros(64, np.float32)}
    others = {name: value for name, value in params.items() if name not in ("motion", "code")}
    names = [each.name for each in dataclasses.fields(hash_grid.HashGridOptions)]
    still = hash_grid.HashGridOptions(**{name: getattr(options, name) for name in names})
    at_rest = jax.jit(hash_grid.from_options(still, BOX).apply)
    return field, jax.jit(field.apply), params, functools.partial(at_rest, others)


def test_it_is_at_rest_at_first_and_displacements_have_a_gradient(points, parts):
    x, viewdirs, time = points
    field, apply, params, still = parts
    for got, expected in zip(apply(params, x, viewdirs, time=time), still(x, viewdirs), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-5)
    gradient = jax.jit(jax.grad(lambda params: field.apply(params, x, viewdirs, time=time)[1].sum()))(params)
    assert (jnp.abs(gradient["motion"]["kernel"]).max(axis=0) > 0).all()
    read = params | {"code": params["code"] | {"kernel": np.ones((72, 64), np.float32)}}
    density = apply(read, x, viewdirs, time=np.float32([[0], [1], [1]]))[0]
    again = apply(read, x, viewdirs, time=np.zeros((3, 1), np.float32))[0]
    assert np.allclose(density[0], again[0], rtol=1e-5) and not np.isclose(density[1:], again[1:], rtol=1e-5).any()


def test_positions_are_displaced_by_fractions_of_the_box_that_depend_on_time(points, parts):
    """The only output that is not 0 is that of a unit that reads the time alone, so that all points move alike."""
    x, viewdirs, time = points
    field, apply, params, still = parts
    first = np.zeros((4, 8), np.float32)
    first[3, 0] = 1.0  # the time from -1 to 1
    kernel = np.zeros((8, 3), np.float32)
    kernel[0] = [1.0, 0, -2.0]
    params = params | {"motion": {"layer_0": {"kernel": first, "bias": np.zeros(8, np.float32)}, "kernel": kernel}}
    moved = x + 0.01 * np.maximum(2 * time - 1, 0)[..., None] * np.float32([1, 0, -2]) * np.float32([2, 3, 4])
    at_rest = still(moved, viewdirs)
    for got, expected in zip(apply(params, x, viewdirs, time=time), at_rest, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-4)
    last = at_time(field, 1.0)
    assert needs_of(last.apply) == ()
    for got, expected in zip(jax.jit(last.apply)(params, x, viewdirs), at_rest, strict=True):
        np.testing.assert_allclose(got[2], expected[2], rtol=1e-4)
        assert not np.allclose(got[0], expected[0], rtol=1e-4)


def test_cones_have_a_radius_and_scenes_without_times_no_motion(points):
    x, viewdirs, time = points
    field = from_options(MovingOptions(**{**GRID, "prefilter": True}, motion_depth=1), BOX)
    assert needs_of(field.apply) == ("radius", "time")

    @jax.jit
    def densities(radii):
        params = field.init(jax.random.key(0))
        return jax.lax.map(lambda radius: field.apply(params, x, viewdirs, time=time, radius=radius)[0], radii)

    wide, narrow = densities(np.float32([1.0, 1e-4]).reshape(2, 1, 1) * np.ones((3, 1), np.float32))
    assert not np.allclose(wide, narrow, rtol=1e-3)
    device = Device("cpu", 1)
    for has_times, depth in ((True, 2), (False, 0)):
        facts = Facts(num_views=2, side=100.0, footprint=0.1, has_times=has_times)
        options, lines = MovingOptions().resolve(facts, device)
        assert options.motion_depth == depth and any(line.startswith("motion ") for line in lines)
    field = from_options(MovingOptions(**GRID, motion_depth=0), BOX)
    assert needs_of(field.apply) == () and isinstance(field.network, hash_grid.HashGrid)
