"""Image metrics: MSE, PSNR, SSIM, and the rounding to 8 bits that makes scores comparable."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Num

from jaxnerf.core.safe_math import at_least_float32
from jaxnerf.core.types import check_shapes


def mse(
    a: Num[ArrayLike, "*batch H W C"] | Num[ArrayLike, "B C"],
    b: Num[ArrayLike, "*batch H W C"] | Num[ArrayLike, "B C"],
    *,
    mask: Bool[ArrayLike, "*batch H W"] | Bool[ArrayLike, " B"] | None = None,
) -> Float[Array, "*batch"]:
    """Computes the mean squared error of images over pixels and channels, or of the colours of a batch of rays.

    Args:
        a: [..., H, W, C], or [B, C].
        b: as a.
        mask: [..., H, W] or [B] bool, the pixels that count; all when None.

    Returns:
        [...], or [] for rays; NaN where the mask is empty.

    Raises:
        ValueError: if the shapes differ, or on integers, such as the bytes of an image.
    """
    return _mean_squared_error("mse", a, b, mask)


def _mean_squared_error(function, a, b, mask):
    a, b = _colors(function, a=a, b=b)
    pixels = "B" if a.ndim == 2 else "... H W"
    check_shapes(function, a=(a, f"{pixels} C"), b=(b, f"{pixels} C"))
    axes = tuple(range(-min(a.ndim, 3), 0))
    if mask is None:
        return ((a - b) ** 2).mean(axis=axes)
    check_shapes(function, a=(a, f"{pixels} C"), mask=(mask, pixels))
    mask = jnp.asarray(mask)
    if mask.dtype != bool:
        raise ValueError(
            f"{function}: mask has type {mask.dtype}, expected bool; compare it with a threshold: mask > 0"
        )
    kept = jnp.where(mask[..., None], a - b, 0)  # before the square, so that excluded pixels get gradient 0
    return (kept**2).sum(axis=axes) / (mask.sum(axis=axes[1:]) * a.shape[-1])


def _colors(function, **arrays):
    """Returns arrays of colours, at least float32; ValueError on integers, which are no colours in [0, 1]."""
    for name, array in arrays.items():
        kind = jnp.asarray(array).dtype
        if not jnp.issubdtype(kind, jnp.floating):
            raise ValueError(
                f"{function}: {name} has type {kind}, expected floats in [0, 1]; divide 8 bit images by 255 "
                "and 16 bit images by 65535"
            )
    return at_least_float32(*arrays.values())


@jax.custom_jvp
def decibels(error: Float[ArrayLike, "*batch"]) -> Float[Array, "*batch"]:
    """Computes -10 log10(error) of mean squared errors of colours in [0, 1].

    An error of 0 gives inf, with gradient 0. NaN stays NaN.
    """
    return -10 / math.log(10) * jnp.log(error)


@decibels.defjvp
def _decibels_jvp(primals, tangents):
    (error,), (tangent,) = primals, tangents
    slope = jnp.where(error == 0, 0, -10 / math.log(10) / jnp.where(error == 0, 1, error))
    return decibels(error), slope * tangent


def psnr(
    a: Num[ArrayLike, "*batch H W C"] | Num[ArrayLike, "B C"],
    b: Num[ArrayLike, "*batch H W C"] | Num[ArrayLike, "B C"],
    *,
    mask: Bool[ArrayLike, "*batch H W"] | Bool[ArrayLike, " B"] | None = None,
) -> Float[Array, "*batch"]:
    """Computes the peak signal-to-noise ratio in dB of images, or of a batch of rays, with colours in [0, 1].

    Args:
        a: [..., H, W, C], or [B, C].
        b: as a.
        mask: see mse.

    Returns:
        [...] dB: inf for identical images, with gradient 0; NaN if a colour that counts is NaN.
    """
    return decibels(_mean_squared_error("psnr", a, b, mask))


def ssim(a: Num[ArrayLike, "*batch H W C"], b: Num[ArrayLike, "*batch H W C"]) -> Float[Array, "*batch"]:
    """Computes the structural similarity of images with colours in [0, 1] (Wang et al. 2004).

    Uses a Gaussian window of 11 pixels with standard deviation 1.5 at every position where it fits, k1 = 0.01,
    k2 = 0.03, population variances, and the mean over windows and channels, as the paper's tables and dm_pix do.

    Args:
        a: [..., H, W, C].
        b: [..., H, W, C].

    Returns:
        [...] in [-1, 1], 1 for identical images.

    Raises:
        ValueError: if the shapes differ, a side is shorter than 11 pixels, or on integers.
    """
    a, b = _colors("ssim", a=a, b=b)
    check_shapes("ssim", a=(a, "... H W C"), b=(b, "... H W C"))
    size, deviation = 11, 1.5
    if min(a.shape[-3:-1]) < size:
        raise ValueError(f"ssim: images are {a.shape[-3]} x {a.shape[-2]} px, expected at least {size} x {size}")
    gaussian = [math.exp(-(((i - size // 2) / deviation) ** 2) / 2) for i in range(size)]
    window = [value / sum(gaussian) for value in gaussian]

    # Vertical, then horizontal: the variance of a window is the mean of its lines' variances plus the variance
    # of their means. E[x^2] - E[x]^2 would cancel in a white image.
    mean_a, mean_b = a, b
    variance_a, variance_b, covariance = (jnp.zeros_like(a) for _ in range(3))
    for axis in (a.ndim - 3, a.ndim - 2):
        lines = _windows((mean_a, mean_b, variance_a, variance_b, covariance), size, axis)
        mean_a = sum(w * line[0] for w, line in zip(window, lines, strict=True))
        mean_b = sum(w * line[1] for w, line in zip(window, lines, strict=True))
        off = [(line[0] - mean_a, line[1] - mean_b) for line in lines]
        terms = list(zip(window, lines, off, strict=True))
        variance_a = sum(w * (line[2] + da * da) for w, line, (da, _) in terms)
        variance_b = sum(w * (line[3] + db * db) for w, line, (_, db) in terms)
        covariance = sum(w * (line[4] + da * db) for w, line, (da, db) in terms)
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structure = (2 * covariance + c2) / (variance_a + variance_b + c2)
    return (luminance * structure).mean(axis=(-3, -2, -1))


def align_colors(
    image: Num[ArrayLike, "H W C"], target: Num[ArrayLike, "H W C"], *, mask: Bool[ArrayLike, "H W"] | None = None
) -> Float[Array, "H W C"]:
    """Multiplies each channel of an image by the gain that brings it closest to another image, by least squares.

        gain = sum(image * target) / sum(image^2)

    This removes a difference in exposure and white balance. It adds no contrast, as a matrix and an offset would do:
    these also hide fog and blur.

    Args:
        image: [H, W, C] in [0, 1].
        target: [H, W, C] in [0, 1].
        mask: [H, W] bool, the pixels that determine the gains; all when None.

    Returns:
        [H, W, C], clipped to [0, 1]. A channel that is 0 in all these pixels keeps its colours. NaN stays NaN.
    """
    image, target = at_least_float32(image, target)
    check_shapes("align_colors", image=(image, "H W C"), target=(target, "H W C"))
    if mask is None:
        kept = image
    else:
        check_shapes("align_colors", image=(image, "H W C"), mask=(mask, "H W"))
        kept = jnp.where(jnp.asarray(mask)[..., None], image, 0)
    squares, products = (values.sum(axis=(0, 1), keepdims=True) for values in (kept**2, kept * target))
    gains = jnp.where(squares == 0, 1, products / jnp.where(squares == 0, 1, squares))
    return jnp.clip(image * gains, 0, 1)


def _windows(arrays, size, axis):
    """Returns the arrays shifted to each offset within a window, along an axis."""
    valid = arrays[0].shape[axis] - size + 1
    return [[jax.lax.slice_in_dim(x, i, i + valid, axis=axis) for x in arrays] for i in range(size)]


def round_to_8_bits(image: Num[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
    """Clips colours to [0, 1] and rounds them to the nearest of the 256 levels of a PNG.

    Args:
        image: [...] colours.

    Returns:
        [...], at least float32.

    Raises:
        ValueError: on integers, such as the bytes of an image.
    """
    (image,) = _colors("round_to_8_bits", image=image)
    return jnp.round(jnp.clip(image, 0, 1) * 255) / 255
