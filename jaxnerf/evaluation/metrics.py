"""The metrics of a picture against its photograph, in strips where the whole has no room in memory."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf.core.metrics import decibels, mse, psnr, round_to_8_bits, ssim
from jaxnerf.runtime import memory

_RIM = 10  # rows that a window of SSIM has below its first


def scores(image, truth, mask=None):
    """Returns the metrics of an image [H, W, 3] against its photograph, of the pixels in mask [H, W]."""
    image, truth = jnp.asarray(image), jnp.asarray(truth)
    height, width = image.shape[:2]

    def attempt(rows):
        if rows == height:
            _check_once(height, width, mask is None)
            return _pair_scores(image, truth, mask)
        return _in_strips(image, truth, mask, rows)

    unit = f"rows of an image of {width} x {height} at once"
    found, _ = memory.back_off(attempt, height, cause="metrics", unit=unit)
    return {key: float(value) for key, value in found.items()}


@functools.cache
def _check_once(height, width, unmasked):
    pixels = jax.ShapeDtypeStruct((height, width, 3), jnp.float32)
    mask = None if unmasked else jax.ShapeDtypeStruct((height, width), bool)
    memory.check(_pair_scores.lower(pixels, pixels, mask).compile())


@jax.jit
def _pair_scores(image, truth, mask):
    rounded, target, image, truncated = _roundings(image, truth, mask)
    return {
        "psnr": psnr(rounded, target, mask=mask),
        "ssim": ssim(rounded, target),
        "psnr_float": psnr(image, truth, mask=mask),
        "psnr_truncated": psnr(truncated, target, mask=mask),
    }


def _roundings(image, truth, mask):
    if mask is not None:  # SSIM has windows, so it sees the photograph where nothing counts
        image = jnp.where(mask[..., None], image, truth)
    truncated = jnp.floor(jnp.clip(image, 0, 1) * 255) / 255  # colours of 8 bits stay as they are
    return round_to_8_bits(image), round_to_8_bits(truth), image, truncated


def _in_strips(image, truth, mask, rows):
    """Returns what _pair_scores does, from strips of so many rows."""
    errors, likeness = [], []
    for start in range(0, image.shape[0], rows):
        own, wide = (
            [None if values is None else values[start:end] for values in (image, truth, mask)]
            for end in (start + rows, start + rows + _RIM)
        )
        count = own[0].size if mask is None else int(own[2].sum())
        if count:
            errors.append((count, _errors(*own)))
        if len(wide[0]) > _RIM:
            likeness.append((len(wide[0]) - _RIM, _likeness(*wide)))
    means = {
        name: np.average([float(part[name]) for _, part in errors], weights=[count for count, _ in errors])
        for name in errors[0][1]
    }
    windows, values = zip(*likeness, strict=True)
    return {
        **{name: decibels(jnp.float32(value)) for name, value in means.items()},
        "ssim": np.average([float(value) for value in values], weights=windows),
    }


@jax.jit
def _errors(image, truth, mask):
    rounded, target, image, truncated = _roundings(image, truth, mask)
    return {
        "psnr": mse(rounded, target, mask=mask),
        "psnr_float": mse(image, truth, mask=mask),
        "psnr_truncated": mse(truncated, target, mask=mask),
    }


@jax.jit
def _likeness(image, truth, mask):
    rounded, target, _, _ = _roundings(image, truth, mask)
    return ssim(rounded, target)
