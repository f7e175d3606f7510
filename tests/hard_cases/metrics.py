"""Hard cases of PSNR and SSIM, jitted, against float64; oracle.ssim takes two passes over each window."""

import functools
import warnings

import jax
import numpy as np

import oracle
from hard_cases.checks import Case, Check, absolute, count, not_finite, of_largest, relative
from jaxnerf import psnr, ssim

SHAPE = (13, 14, 3)


def cases(psnr=psnr, ssim=ssim):
    """Returns the cases, of functions with the arguments of psnr and ssim."""
    found = [Case("metrics", name, functools.partial(_pair, psnr, ssim, a, b)) for name, (a, b) in pairs().items()]
    found += [
        Case("metrics", f"NaN in {where}", functools.partial(_nan, psnr, ssim, where))
        for where in ("the first pixel", "the last pixel", "every pixel")
    ]
    found += [
        Case("metrics", f"an image of {h} x {w} px", functools.partial(_tiny, psnr, ssim, (h, w, 3)))
        for h, w in ((1, 1), (10, 40), (11, 11))
    ]
    found.append(Case("metrics", "a mask hides NaN, an empty one shows", functools.partial(_masked, psnr)))
    return found


def pairs():
    """Returns {name: (a, b)}."""
    rng = np.random.default_rng(0)
    noise, flat = rng.normal(size=SHAPE), np.ones(SHAPE)
    smooth = 0.5 + 0.3 * np.sin(np.add.outer(np.arange(13) / 3, np.arange(14) / 5))[..., None] * np.ones(3)
    found = {
        "identical noise": (0.5 + 0.1 * noise,) * 2,
        "identical black": (0 * flat,) * 2,
        "identical white": (flat,) * 2,
        "black beside white": (0 * flat, flat),
        "two greys": (0.5 * flat, 0.6 * flat),
        "white and nearly white": (flat, flat - 1e-3 * abs(noise)),
        "noise of 1e-3 on white": (flat - 1e-3 * abs(noise), flat - 1e-3 * abs(noise[::-1])),
        "noise of 1e-3 on grey": (0.5 + 1e-3 * noise, 0.5 + 1e-3 * noise[::-1]),
        "one level of 8 bits apart": (smooth, smooth + 1 / 255),
        "1e-4 apart": (smooth, smooth + 1e-4 * noise),
        "a negative copy": (smooth, 1 - smooth),
        "one pixel apart": (smooth, smooth + (np.arange(smooth.size) == 40).reshape(SHAPE)),
    }
    return {name: tuple(image.astype(np.float32) for image in pair) for name, pair in found.items()}


def _pair(psnr, ssim, a, b):
    values, slopes = _compiled(psnr, ssim)(a, b)
    wide = a.astype(np.float64), b.astype(np.float64)
    error = wide[0] - wide[1]
    square = np.mean(error**2)
    want = -10 * np.log10(square) if square else np.inf
    slope = -20 / np.log(10) * error / error.size / square if square else 0 * error
    return [
        Check("PSNR", relative(values[0], want), 1e-5),
        Check("SSIM", absolute(values[1], oracle.ssim(*wide)), 1e-5),
        Check("gradient not finite", not_finite(*slopes), 0, "finite"),
        Check("gradient of PSNR", of_largest(slopes[0], slope), 1e-5, "gradient"),
    ]


def _nan(psnr, ssim, where):
    a, b = (image.copy() for image in pairs()["1e-4 apart"])
    a.reshape(-1)[{"the first pixel": 0, "the last pixel": -1, "every pixel": slice(None)}[where]] = np.nan
    values, _ = _compiled(psnr, ssim)(a, b)
    return [
        Check(f"{name} hides NaN", count(~np.isnan(value)), 0)
        for name, value in zip(("PSNR", "SSIM"), values, strict=True)
    ]


def _tiny(psnr, ssim, shape):
    a, b = np.full(shape, 0.5, np.float32), np.full(shape, 0.25, np.float32)
    found = [Check("PSNR", absolute(jax.jit(psnr)(a, b), -10 * np.log10(0.0625)), 1e-5)]
    if min(shape[:2]) >= 11:
        expected = oracle.ssim(a.astype(np.float64), b.astype(np.float64))
        return [*found, Check("SSIM", absolute(jax.jit(ssim)(a, b), expected), 1e-5)]
    try:
        jax.eval_shape(ssim, a, b)
        said = ""
    except ValueError as error:
        said = str(error)
    return [*found, Check("no error that names 11 pixels", float("11" not in said), 0)]


def _masked(psnr):
    a, b = (image.copy() for image in pairs()["1e-4 apart"])
    mask = np.zeros(SHAPE[:2], bool)
    mask[2:9, 3:7] = True
    b[~mask] = np.nan
    run = jax.jit(jax.value_and_grad(lambda a, b, mask: psnr(a, b, mask=mask)))
    value, slope = run(a, b, mask)
    cut = [image[2:9, 3:7].astype(np.float64) for image in (a, b)]
    with warnings.catch_warnings(action="ignore"):
        none = run(a, b, np.zeros_like(mask))[0]
    return [
        Check("PSNR under a mask", relative(value, oracle.psnr(*cut)), 1e-5),
        Check("gradient not finite", not_finite(slope), 0, "finite"),
        Check("gradient where the mask is False", count(np.asarray(slope)[~mask]), 0, "gradient"),
        Check("PSNR of nothing is a number", count(~np.isnan(none)), 0),
    ]


@functools.cache
def _compiled(psnr, ssim):
    def both(a, b):
        value, slope = zip(*(jax.value_and_grad(metric)(a, b) for metric in (psnr, ssim)), strict=True)
        return value, slope

    run = jax.jit(both)
    return lambda *images: jax.tree.map(np.asarray, run(*images))
