"""Photographs as arrays: reading a file, shrinking by whole factors, straight alpha.

Straight alpha keeps the colour of a half covered pixel as if it were fully covered; premultiplied colour
is already scaled by its alpha, which is what averages and composites correctly. Files and Views are
straight, arithmetic is premultiplied. Everything here is numpy on the host.
"""

import numpy as np
from PIL import Image

_ORIENTATION = 0x0112  # the EXIF tag
_UPRIGHT = {  # its values, and what undoes each
    2: np.fliplr,
    3: lambda pixels: np.rot90(pixels, 2),
    4: np.flipud,
    5: lambda pixels: np.swapaxes(pixels, 0, 1),
    6: lambda pixels: np.rot90(pixels, -1),
    7: lambda pixels: np.rot90(np.swapaxes(pixels, 0, 1), 2),
    8: np.rot90,
}


def read_image(path, *, stored=None, turn=True):
    """Returns the pixels of an image file, upright, at the precision that the file has.

    Args:
        path: an 8 or 16 bit PNG, or an 8 bit file of another kind that Pillow reads.
        stored: (height, width) of the pixels as the cameras count them, or a multiple. Where they are stored
            like that, an EXIF orientation that would turn them is not followed.
        turn: whether EXIF orientation is followed at all.

    Returns:
        [H, W, 3] opaque or [H, W, 4] with straight alpha, uint8 or uint16. Grey becomes three equal
        channels, a palette or a transparent colour key is resolved.

    Raises:
        ValueError: if the file is missing, no image, or cut short.
    """
    pixels, value = _open(path, lambda image: (_decode(path, image), _orientation(image)))
    if not (turn and _turns(pixels.shape[:2], value, stored)):
        return pixels
    return np.ascontiguousarray(_UPRIGHT[value](pixels))


def image_form(path, *, stored=None, turn=True):
    """Returns the shape (H, W, C) and the dtype of what read_image gives, from the file's first bytes."""
    (width, height), channels, dtype, value = _open(
        path, lambda image: (image.size, *_depth(image), _orientation(image))
    )
    if turn and value >= 5 and _turns((height, width), value, stored):
        height, width = width, height
    return (height, width, channels), dtype


def _turns(size, value, stored):
    """Returns whether an EXIF orientation of an image [H, W] is followed."""
    upright = size[::-1] if value >= 5 else size
    return value in _UPRIGHT and not (stored and fits(size, stored) and not fits(upright, stored))


def fits(found, declared):
    """Returns whether (height, width) is what is declared, or all of that a whole number of times smaller."""
    times = max(round(declared[0] / found[0]), 1)
    return all(abs(want / times - have) < 1 for want, have in zip(declared, found, strict=True))


def read_mask(path, *, stored=None):
    """Returns [H, W] bool of a grey image file: whether a pixel is at least half bright; see read_image."""
    pixels = read_image(path, stored=stored)
    return pixels[..., 0] > np.iinfo(pixels.dtype).max // 2


def image_size(path, *, turn=True):
    """Returns the (width, height) in px of an image file from its first bytes; see read_image."""
    size, value = _open(path, lambda image: (image.size, _orientation(image)))
    return size[::-1] if turn and value >= 5 else size


def has_alpha(path):
    """Returns whether read_image gives an image file four channels."""
    return _open(path, lambda image: image.has_transparency_data)


def _open(path, use):
    try:
        with Image.open(path) as image:
            return use(image)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file, wanted an image; copy it or correct the name") from None
    except Exception as error:  # a damaged file makes Pillow's decoders raise almost anything
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(
            f"{path}: unreadable ({reason}), wanted a whole image file; copy or render it again"
        ) from error


def _orientation(image):
    turn = image.getexif().get(_ORIENTATION, 1)
    return turn if turn in _UPRIGHT else 1


def _raw(image):
    return image.tile[0][3] if image.format == "PNG" and image.tile else None


def _depth(image):
    """Returns the channels and the dtype of what _decode gives."""
    raw = _raw(image)
    if raw in ("RGB;16B", "RGBA;16B"):
        return (4 if raw.startswith("RGBA") else 3), np.dtype(np.uint16)
    if image.mode == "I;16":
        return 3, np.dtype(np.uint16)
    return (4 if image.has_transparency_data else 3), np.dtype(np.uint8)


def _decode(path, image):
    raw = _raw(image)
    if raw in ("RGB;16B", "RGBA;16B"):
        # Pillow keeps only the first byte of each 16 bit value. Naming the byte order the other way
        # round makes it keep the second, so two passes give all sixteen bits.
        high, low = np.asarray(image), _second_bytes(path, raw)
        return high.astype(np.uint16) * 256 + low
    if image.mode == "I;16":
        return np.repeat(np.asarray(image)[..., None], 3, axis=-1)
    mode = "RGBA" if image.has_transparency_data else "RGB"
    return np.asarray(image if image.mode == mode else image.convert(mode))


def _second_bytes(path, raw):
    with Image.open(path) as image:
        image.tile = [(*image.tile[0][:3], raw.replace("16B", "16L"))]
        return np.asarray(image)


def average_blocks(pixels, factor, *, background=None):
    """Returns the image shrunk by area: each new pixel is the mean of factor x factor old ones.

    The mean is taken of premultiplied colour, summed in whole numbers and so without rounding; a transparent
    pixel's colour, which nobody sees, does not bleed into the edge of an object.

    Args:
        pixels: [H, W, 3] or [H, W, 4] with straight alpha, uint8 or uint16.
        factor: whole number >= 1 that divides H and W.
        background: see `to_straight`; without alpha it plays no part.

    Returns:
        [H / factor, W / factor, 3 or 4] uint16, straight again, rounded to nearest.

    Raises:
        ValueError: if factor does not divide the size; the message lists those that do.
    """
    height, width, channels = pixels.shape
    if height % factor or width % factor:
        common = np.gcd(height, width)
        works = ", ".join(str(k) for k in range(1, common + 1) if common % k == 0)
        raise ValueError(
            f"factor {factor} does not divide {width} x {height}, wanted one that does; take one of {works}"
        )
    # One channel after the other, each side by side in memory: much faster than all at once.
    planes = np.ascontiguousarray(np.moveaxis(pixels, -1, 0))
    largest = np.iinfo(pixels.dtype).max
    if channels == 3:
        mean = np.stack([_sum_blocks(plane, factor) for plane in planes], axis=-1) / (largest * factor**2)
        return np.rint(mean * 65535).astype(np.uint16)
    alpha = planes[3].astype(np.uint16 if pixels.dtype == np.uint8 else np.uint32)  # holds largest^2
    colour = np.stack([_sum_blocks(plane * alpha, factor) for plane in planes[:3]], axis=-1)
    cover = _sum_blocks(alpha, factor) / (largest * factor**2)
    return to_straight(colour / (float(largest) ** 2 * factor**2), cover, background=background)


def _sum_blocks(plane, factor):
    """Returns the sums [H / factor, W / factor] uint64 of an image's [H, W] blocks."""
    height, width = plane.shape
    rows = plane.reshape(height // factor, factor, width)
    total = rows[:, 0].astype(np.uint64 if plane.dtype == np.uint32 else np.uint32)
    for index in range(1, factor):
        total += rows[:, index]
    return total.reshape(height // factor, width // factor, factor).sum(axis=2, dtype=np.uint64)


def to_straight(premultiplied, alpha, *, background=None):
    """Returns premultiplied colour and alpha as 16 bit straight RGBA.

    Two roundings meet when the result is composited: alpha's and the colour's. Colour is rounded last and,
    where the background is known, makes up for what rounding alpha changed, which halves the error.

    Args:
        premultiplied: [..., 3] colour times alpha, in [0, alpha].
        alpha: [...] in [0, 1].
        background: 3 values in [0, 1] over which compositing is to be right to 0.5 / 65535 = 7.7e-6, or None
            for right to twice that over any colour.

    Returns:
        [..., 4] uint16. Colour is 0 where alpha rounds to 0.
    """
    alpha = np.asarray(alpha, np.float64)
    rounded = np.rint(np.clip(alpha, 0, 1) * 65535) / 65535
    behind = 0.0 if background is None else np.asarray(background, np.float64) * (rounded - alpha)[..., None]
    covered = rounded[..., None]
    colour = (premultiplied + behind) / np.where(covered > 0, covered, 1.0)
    colour = np.where(covered > 0, np.clip(colour, 0, 1), 0.0)
    return np.rint(np.concatenate([colour, covered], axis=-1) * 65535).astype(np.uint16)
