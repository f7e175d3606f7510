"""Short loops: the same values whether they are compiled as loops or unrolled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from jaxnerf.core.loops import search_sorted, short_loop


@pytest.fixture(params=["cpu", "default"])
def branch(request, monkeypatch):
    """Compiles for a CPU what is meant for a CPU, or for other devices."""
    monkeypatch.setattr(
        jax.lax, "platform_dependent", lambda *arguments, **branches: branches[request.param](*arguments)
    )


@pytest.mark.usefixtures("branch")
@pytest.mark.parametrize("count", [0, 1, 5])
def test_a_short_loop_applies_its_body_in_order(count):
    def body(index, value):
        return 3 * value + index

    expected = 2
    for index in range(count):
        expected = body(index, expected)
    assert jax.jit(lambda start: short_loop(count, body, start))(jnp.int32(2)) == expected


@pytest.mark.usefixtures("branch")
def test_a_short_loop_has_a_gradient():
    gradient = jax.grad(lambda x: short_loop(3, lambda _, value: value * value, x))(jnp.float32(1.5))
    np.testing.assert_allclose(gradient, 8 * 1.5**7, rtol=1e-6)


@pytest.mark.usefixtures("branch")
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_search_finds_the_places_that_numpy_finds(side):
    ascending = np.sort(np.random.default_rng(0).integers(0, 50, 100)).astype(np.int32)
    values = np.arange(-2, 55, dtype=np.int32).reshape(3, -1)
    found = jax.jit(lambda values: search_sorted(ascending, values, side=side))(values)
    np.testing.assert_array_equal(found, np.searchsorted(ascending, values, side=side))


@pytest.mark.parametrize(("platform", "loops"), [("cpu", True), ("cuda", False)])
def test_only_a_cpu_gets_a_loop(platform, loops):
    function = jax.jit(lambda x: short_loop(4, lambda index, value: value * x + index, x))
    exported = export.export(function, platforms=[platform])(jnp.ones(3))
    assert ("stablehlo.while" in exported.mlir_module()) is loops
