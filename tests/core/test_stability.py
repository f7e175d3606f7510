"""The hard cases, each within its bound; and known-bad variants, which must fail."""

import collections
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hard_cases import ALL, compositing, exact, importance, naive
from hard_cases.rays import RAYS
from jaxnerf import Rays, Samples, render_samples

# How bfloat16 is rounded does not depend on the number of samples, which these cases are about.
LONG = {str(case) for case in compositing.cases(outputs="bfloat16", sizes=(10000, 100000))}


@pytest.mark.parametrize(
    "case",
    [pytest.param(c, id=str(c), marks=pytest.mark.extra if str(c) in LONG else pytest.mark.slow) for c in ALL],
)
def test_a_hard_case_is_within_its_bars(case):
    failed = [str(check) for check in case.run() if not check.passed]
    assert not failed, "\n".join([str(case), *failed])


def test_every_family_has_six_cases_of_its_own_or_more():
    families = collections.Counter(case.family for case in ALL)
    assert min(families.values()) >= 6
    assert len(families) == 7 and len({str(case) for case in ALL}) == len(ALL)


def test_the_cumulative_product_fails_the_table():
    failed = collections.Counter()
    for case in compositing.cases(render=naive.render_samples, sizes=(64,)):
        failed.update({check.kind for check in case.run() if not check.passed})
    assert min(failed[kind] for kind in ("value", "gradient", "finite")) >= 10


def test_padded_weights_fail_the_table():
    cases = importance.cases(invert=naive.inverse_cdf)
    failed = [case for case in cases if not all(check.passed for check in case.run())]
    assert len(failed) >= 6


@pytest.mark.parametrize("name", ["half empty, far 6", "near = 0", "zero widths"])
def test_the_closed_formulas_are_the_finite_differences_of_the_exact_values(name):
    """In extended precision, a few entries each; without the scene's slopes, which only multiply them."""
    ray = {key: value.astype(np.longdouble) for key, value in RAYS[name].items()}
    ray |= {"slope": 0 * ray["slope"], "rgb_slope": 0 * ray["rgb_slope"]}
    formulas = exact.gradients(ray)
    for argument in compositing.ARGUMENTS:
        size = ray[argument].size
        for entry in range(0, size, max(1, size // 5)):
            step = 1e-6 * max(abs(ray[argument].flat[entry]), np.longdouble(1e-3))
            if argument in ("delta", "t") and not ray["delta"][entry] > 0:
                continue  # absent by convention, whatever the limit
            sides = []
            for sign in (1, -1):
                moved = ray | {argument: ray[argument].copy()}
                moved[argument].flat[entry] += sign * step
                sides.append(exact.render(moved))
            for output in compositing.OUTPUTS:
                slope = (sides[0][output] - sides[1][output]) / (2 * step)
                expected = formulas[output][argument][0].flat[entry]
                np.testing.assert_allclose(np.float64(expected), np.float64(slope), rtol=1e-7, atol=1e-10)


def test_nan_and_infinity_fail_a_check():
    check = functools.partial(compositing.Check, "anything", bar=1.0)
    assert not check(error=np.nan).passed and not check(error=np.inf).passed
    assert check(error=1.0).passed and not check(error=1.1).passed


@pytest.mark.parametrize("name", ["half empty, far 6", "opacity 4e-12", "fog of one colour, depth 20"])
def test_float64_stays_float64(name):
    """With float64 rays and scene outputs, results have float64 accuracy."""
    given = {key: value.astype(np.float64) for key, value in RAYS[name].items()}
    with jax.enable_x64(True):
        ray = Rays(
            **{key: jnp.asarray(given[key])[None] for key in ("origins", "directions", "viewdirs", "near", "far")}
        )
        samples = Samples(t=jnp.asarray(given["t"])[None], delta=jnp.asarray(given["delta"])[None])

        def color(density, rgb):
            seen = render_samples(
                lambda x, viewdirs: (density, rgb),
                ray,
                samples,
                background=jnp.asarray(given["background"])[None],
            )
            return seen.rgb[0].sum(), seen

        arrays = jnp.asarray(given["density"])[None], jnp.asarray(given["rgb"])[None]
        slope, seen = jax.jit(jax.grad(color, has_aux=True))(*arrays)
        got = jax.tree.map(np.asarray, seen)
    want, slopes = exact.render(given), exact.gradients(given)
    for field in ("rgb", "opacity", "depth", "disparity", "weights"):
        assert getattr(got, field).dtype == np.float64
    np.testing.assert_allclose(got.rgb[0], [want[c] for c in compositing.COLOURS], rtol=1e-13)
    np.testing.assert_allclose(got.weights[0], np.float64(want["weights"]), rtol=1e-13)
    for field in ("opacity", "depth", "disparity"):
        np.testing.assert_allclose(getattr(got, field)[0], np.float64(want[field]), rtol=1e-13)
    expected = np.float64(sum(slopes[c]["density"][0] for c in compositing.COLOURS))
    assert np.abs(np.asarray(slope)[0] - expected).max() <= 1e-12 * np.abs(expected).max()


def test_bfloat16_outputs_render_as_their_float32_values():
    """Only the field loses accuracy in bfloat16: its outputs are composited in float32."""
    for name in ("half empty, far 6", "1e-09 an interval, 1000 of them", "density 1000"):
        ray = {key: value[None] for key, value in RAYS[name].items()}
        density, rgb = (jnp.asarray(ray[key], jnp.bfloat16) for key in ("density", "rgb"))
        rays = Rays(**{key: ray[key] for key in ("origins", "directions", "viewdirs", "near", "far")})
        samples = Samples(t=ray["t"], delta=ray["delta"])
        low, full = (
            jax.jit(lambda density, rgb: render_samples(lambda x, v: (density, rgb), rays, samples))(*outputs)  # noqa: B023
            for outputs in ((density, rgb), (density.astype(jnp.float32), rgb.astype(jnp.float32)))
        )
        for got, want in zip(jax.tree.leaves(low), jax.tree.leaves(full), strict=True):
            assert got.dtype == want.dtype
            np.testing.assert_allclose(got, want, rtol=1e-6, atol=0)
