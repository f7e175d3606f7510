"""Image files as arrays: decoding, shrinking by whole factors, straight alpha. numpy on the host.

With straight alpha the colour of a partly covered pixel is that of full coverage. Premultiplied colour is
multiplied by alpha, which is what averages and composites correctly. Files and Views hold straight alpha; sums
are taken of premultiplied colour.
"""

import contextlib
import os
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt, UInt16
from PIL import Image, UnidentifiedImageError

from jaxnerf.runtime.atomic_files import open_regular

# What Pillow decodes by itself. Left to choose by a file's content, it would start Ghostscript for an EPS.
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
MASK_PREFIX = "dynamic_mask_"  # of instant-ngp's masks beside images: pixels where they are not black are ignored
_GREY_MODES = ("I;16", "I;16B", "I;16L", "I", "F")  # Pillow's, of more than 8 bits
_ROUNDING = 1e-4  # by which floats may leave [0, 1]
_DARK = 16  # up to this brightest value, a mask of 8 bits with several levels holds class numbers or noise
_ORIENTATION = 0x0112  # the EXIF tag
_WRITE_MASK = "write 0 where pixels are ignored and 255 elsewhere"
# Tags of a TIFF.
_BITS, _PHOTOMETRIC, _PLANAR, _SAMPLE_FORMAT = 258, 262, 284, 339
_UPRIGHT = {  # value of the tag -> function that makes the image upright
    2: np.fliplr,
    3: lambda pixels: np.rot90(pixels, 2),
    4: np.flipud,
    5: lambda pixels: np.swapaxes(pixels, 0, 1),
    6: lambda pixels: np.rot90(pixels, -1),
    7: lambda pixels: np.rot90(np.swapaxes(pixels, 0, 1), 2),
    8: np.rot90,
}


class _WrongRangeError(ValueError):
    """An image's numbers are no colours, or a mask's numbers are none of a mask."""

    def __init__(self, found: str, remedy: str = "convert it to 8 or 16 bits"):
        super().__init__(f"{found}; {remedy}")


def is_hidden(name: str) -> bool:
    """Returns whether a file is no image by its name: a mask of instant-ngp, or hidden as the ._ files of macOS."""
    return name.startswith((".", MASK_PREFIX))


def read_image(
    path: str | os.PathLike, *, camera_size: tuple | None = None, follow_exif: bool = True
) -> UInt[np.ndarray, "H W C"]:
    """Reads the pixels of an image file, upright, with the file's precision.

    Args:
        path: of one of the FORMATS: 8 bits, 16 bits in a PNG or grey, or in a grey TIFF floats in [0, 1] or whole
            numbers of 32 bits up to 65535. Of several pages the first is read.
        camera_size: (height, width) that the camera's intrinsics refer to, or a multiple of the image's size.
            EXIF orientation is followed if only the upright image fits it: programs that compute poses ignore it, so
            where both fit, as at half a turn, the poses are those of the pixels as they are stored.
        follow_exif: whether EXIF orientation is followed at all.

    Returns:
        [H, W, 3] opaque or [H, W, 4] with straight alpha, uint8 or uint16. Grey becomes three equal channels;
        a palette and a transparent colour key are resolved.

    Raises:
        ValueError: if the file is missing, truncated or not an image, or if its numbers have another range.
    """
    pixels, value = _open(path, lambda image: (_decode(path, image), _orientation(image)))
    return _upright(pixels, value, camera_size) if follow_exif else pixels


def read_stored(path: str | os.PathLike) -> Shaped[np.ndarray, "H W *C"]:
    """Reads an image file's numbers as they are stored, also those of a float32 TIFF.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is truncated or not an image.
    """
    return _use(path, np.asarray)


@contextlib.contextmanager
def open_image(path: str | os.PathLike) -> Iterator[Image.Image]:
    """Opens an image file of one of the FORMATS with Pillow; raises what Pillow and `open_regular` raise."""
    with open_regular(path, "rb") as file, Image.open(file, formats=FORMATS) as image:
        yield image


def image_form(
    path: str | os.PathLike, *, camera_size: tuple | None = None, follow_exif: bool = True
) -> tuple[tuple[int, int, int], np.dtype]:
    """Returns the shape (H, W, C) and the dtype of the result of `read_image`, from the file's first bytes."""
    (width, height), channels, dtype, value = _open(
        path, lambda image: (image.size, *_depth(image), _orientation(image))
    )
    if follow_exif and value >= 5 and _is_rotated((height, width), value, camera_size):
        height, width = width, height
    return (height, width, channels), dtype


def _upright(pixels, value, camera_size):
    """Returns an image [H, W, ...] turned by its EXIF orientation, where that is followed."""
    if not _is_rotated(pixels.shape[:2], value, camera_size):
        return pixels
    return np.ascontiguousarray(_UPRIGHT[value](pixels))


def _is_rotated(size, value, camera_size):
    """Returns whether the EXIF orientation of an image [H, W] is followed."""
    if value not in _UPRIGHT or camera_size is None:
        return value in _UPRIGHT
    return value >= 5 and fits(size[::-1], camera_size) and not fits(size, camera_size)


def fits(found: tuple, declared: tuple) -> bool:
    """Returns whether (height, width) is the declared one, or smaller than all of it by a whole factor."""
    times = max(round(declared[0] / found[0]), 1)
    return all(abs(full / times - have) < 1 for full, have in zip(declared, found, strict=True))


def read_mask(path: str | os.PathLike, *, camera_size: tuple | None = None) -> Bool[np.ndarray, "H W"]:
    """Reads an image as a mask: True where a pixel is brighter than half of the brightest one. See `read_image`.

    The values may be 0 and 1, 0 and 255 or any others, also floats, and palettes of any colours; a black image
    excludes all. Transparent pixels are dark; where all pixels have one colour, alpha alone is the mask.

    Raises:
        ValueError: as read_image, on negative values and NaN, and on several levels that are all dark, such as the
            numbers of classes.
    """
    values, value = _open(path, lambda image: (_brightness(path, image), _orientation(image)))
    return _upright(values > values.max(initial=0) / 2, value, camera_size)


def image_size(
    path: str | os.PathLike, *, follow_exif: bool = True, center: Float[np.ndarray, "2"] | None = None
) -> tuple[int, int]:
    """Returns the (width, height) in px of an image file from its first bytes; see `read_image`.

    With a principal point it is the size upright only if that point fits it better than the size as stored.
    """
    size, value = _open(path, lambda image: (image.size, _orientation(image)))
    if not follow_exif or value < 5:
        return size
    if center is None:
        return size[::-1]
    return min(size, size[::-1], key=lambda each: np.abs(center - np.array(each) / 2).sum())


def read_ignored(path: str | os.PathLike, *, camera_size: tuple | None = None) -> Bool[np.ndarray, "H W"]:
    """Reads an image whose pixels other than black are ignored, whatever their alpha, as a mask like `read_mask`'s."""
    ignored, value = _open(path, lambda image: (_decode(path, image)[..., :3].any(axis=-1), _orientation(image)))
    return _upright(~ignored, value, camera_size)


def has_alpha(path: str | os.PathLike) -> bool:
    """Returns whether `read_image` returns four channels for an image file."""
    return _open(path, lambda image: image.has_transparency_data)


def _open(path, use):
    try:
        return _use(path, use)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file, expected an image; copy it or correct the name") from None


def _use(path, use):
    try:
        with open_image(path) as image:
            return use(image)
    except FileNotFoundError:
        raise
    except _WrongRangeError as error:
        raise ValueError(f"{path}: {error}") from None
    except Exception as error:  # Pillow's decoders raise almost any exception on a damaged file
        unknown = isinstance(error, UnidentifiedImageError)
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        remedy = "expected a complete image file; copy or render it again"
        if unknown:
            reason, remedy = (
                f"it is no {'/'.join(FORMATS)}, or of a kind that Pillow does not read",
                ("expected an image of 8 or 16 bits; copy it again, or convert it to PNG"),
            )
        raise ValueError(f"{path}: unreadable ({reason}), {remedy}") from error


def _orientation(image):
    # For a PNG without metadata before the pixels Pillow decodes them all, in case that some follow.
    known = image.format != "PNG" or image.fp is None or "exif" in image.info or _has_exif(image.fp)
    turn = (image.getexif() if known else Image.Image.getexif(image)).get(_ORIENTATION, 1)
    return turn if turn in _UPRIGHT else 1


def _has_exif(file):
    """Returns whether a PNG file has a chunk of EXIF data anywhere; leaves the file where it was."""
    start, found = file.tell(), b""
    file.seek(8)
    while len(head := file.read(8)) == 8 and found != b"eXIf":
        found = head[4:]
        file.seek(int.from_bytes(head[:4], "big") + 4, os.SEEK_CUR)
    file.seek(start)
    return found == b"eXIf"


def _raw(image):
    return image.tile[0][3] if image.format == "PNG" and image.tile else None


def _depth(image):
    """Returns the number of channels and the dtype of _decode's result."""
    deep = _raw(image) in ("RGB;16B", "RGBA;16B") or image.mode in _GREY_MODES
    return (4 if image.has_transparency_data else 3), np.dtype(np.uint16 if deep else np.uint8)


def _decode(path, image):
    _check_numbers(image)
    raw = _raw(image)
    if raw in ("RGB;16B", "RGBA;16B"):
        # Pillow keeps only the first byte of each 16 bit value. With the opposite byte order it keeps the second,
        # so two passes give all sixteen bits.
        high, low = np.asarray(image), _second_bytes(path, raw)
        return _with_color_key(image, high.astype(np.uint16) * 256 + low)
    if image.mode in _GREY_MODES:
        values = _sixteen_bits(np.asarray(image), image.format)
        values = 65535 - values if _tag(image, _PHOTOMETRIC) == 0 else values
        return np.repeat(_with_color_key(image, values[..., None]), (3, 1)[: 1 + image.has_transparency_data], axis=-1)
    mode = "RGBA" if image.has_transparency_data else "RGB"
    return np.asarray(image if image.mode == mode else image.convert(mode))


def _tag(image, number, default=None):
    return image.tag_v2.get(number, default) if image.format == "TIFF" else default


def _check_numbers(image):
    """Raises a _WrongRangeError where Pillow returns other colours than those of a TIFF."""
    bits = max(np.atleast_1d(_tag(image, _BITS, 1)))
    if bits > 8 and _tag(image, _PLANAR) == 2:
        raise _WrongRangeError(f"its channels of {bits} bits are stored one after the other, expected them interleaved")
    if bits < 32 and 2 in np.atleast_1d(_tag(image, _SAMPLE_FORMAT, 1)):
        raise _WrongRangeError(f"its values are signed numbers of {bits} bits, expected unsigned ones")


def _with_color_key(image, pixels):
    """Returns pixels [H, W, C] of 16 bits, with alpha if a PNG states a transparent colour."""
    key = image.info.get("transparency")
    if key is None:
        return pixels
    opaque = (pixels != np.reshape(key, -1)).any(axis=-1, keepdims=True)
    return np.concatenate([pixels, np.where(opaque, np.uint16(65535), np.uint16(0))], axis=-1)


def _brightness(path, image):
    """Returns the brightness [H, W] of a mask's pixels, in any unit."""
    if image.mode in _GREY_MODES and not image.has_transparency_data:
        values = np.asarray(image)
        if not values.min(initial=0) >= 0:
            low, high = values.min(), values.max()
            raise _WrongRangeError(f"its values are from {low:g} to {high:g}, expected a mask's", _WRITE_MASK)
        return values.max(initial=0) - values if _tag(image, _PHOTOMETRIC) == 0 else values
    pixels = _decode(path, image)
    values, alpha = pixels[..., :3].max(axis=-1), pixels[..., 3:]
    levels = np.unique(values)
    if len(levels) == 1 and alpha.size and alpha.min() < alpha.max():
        return alpha[..., 0]
    if values.dtype == np.uint8 and len(levels) > 2 and levels[-1] <= _DARK:
        some = ", ".join(map(str, levels[:4]))
        raise _WrongRangeError(f"it holds the values {some} ..., expected those of a mask", _WRITE_MASK)
    return values.astype(np.float32) * alpha[..., 0] if alpha.size else values


def _sixteen_bits(values, format):
    """Returns floats in [0, 1] or whole numbers up to 65535 as uint16; ValueError on any other range."""
    low, high = values.min(initial=0), values.max(initial=0)
    if values.dtype.kind == "f":
        if not (low >= -_ROUNDING and high <= 1 + _ROUNDING):  # not NaN either
            raise _WrongRangeError(f"its values are from {low:g} to {high:g}, expected floats from 0 to 1")
        values = np.rint(65535 * np.clip(values, 0, 1))
    elif format == "TIFF" and values.itemsize == 4 and 0 < high <= 255:
        raise _WrongRangeError(f"its values are from {low} to {high} in 32 bits, expected a range up to 65535")
    elif not 0 <= low <= high <= 65535:
        raise _WrongRangeError(f"its values are from {low} to {high}, expected whole numbers from 0 to 65535")
    return values.astype(np.uint16)


def _second_bytes(path, raw):
    with open_image(path) as image:
        image.tile = [(*image.tile[0][:3], raw.replace("16B", "16L"))]
        return np.asarray(image)


def average_tiles(
    pixels: UInt[np.ndarray, "H W C"], factor: int, *, background: tuple | None = None
) -> UInt16[np.ndarray, "h w C"]:
    """Shrinks an image by area: each new pixel is the mean of factor x factor old ones.

    The mean is taken of premultiplied colour, summed in integers and therefore without rounding. The invisible
    colour of transparent pixels does not bleed into the edge of an object.

    Args:
        pixels: [H, W, 3] or [H, W, 4] with straight alpha, uint8 or uint16.
        factor: a divisor of H and W.
        background: see `to_straight`; it has no effect without alpha.

    Returns:
        [H / factor, W / factor, 3 or 4] with straight alpha, rounded to nearest.
    """
    channels = pixels.shape[-1]
    # Contiguous channels, one after the other, are much faster than interleaved ones.
    planes = np.ascontiguousarray(np.moveaxis(pixels, -1, 0))
    largest = np.iinfo(pixels.dtype).max
    if channels == 3:
        mean = np.stack([_sum_tiles(plane, factor) for plane in planes], axis=-1) / (largest * factor**2)
        return np.rint(mean * 65535).astype(np.uint16)
    alpha = planes[3].astype(np.uint16 if pixels.dtype == np.uint8 else np.uint32)  # holds largest^2
    color = np.stack([_sum_tiles(plane * alpha, factor) for plane in planes[:3]], axis=-1)
    cover = _sum_tiles(alpha, factor) / (largest * factor**2)
    return to_straight(color / (float(largest) ** 2 * factor**2), cover, background=background)


def _sum_tiles(plane, factor):
    """Returns the sum [H / factor, W / factor] uint64 of each block of a channel [H, W]."""
    height, width = plane.shape
    rows = plane.reshape(height // factor, factor, width)
    total = rows[:, 0].astype(np.uint64 if plane.dtype == np.uint32 else np.uint32)
    for index in range(1, factor):
        total += rows[:, index]
    return total.reshape(height // factor, width // factor, factor).sum(axis=2, dtype=np.uint64)


def to_straight(
    premultiplied: Float[np.ndarray, "*pixels 3"],
    alpha: Float[np.ndarray, "*pixels"],
    *,
    background: tuple | None = None,
) -> UInt16[np.ndarray, "*pixels 4"]:
    """Converts premultiplied colour and alpha to 16 bit straight RGBA.

    Compositing the result adds two rounding errors, that of alpha and that of the colour. The colour is rounded
    last and, if the background is known, compensates the error of alpha, which halves the total error.

    Args:
        premultiplied: colour times alpha, in [0, alpha].
        alpha: in [0, 1].
        background: 3 values in [0, 1]; compositing over this colour is correct to 0.5 / 65535 = 7.7e-6. None:
            compositing over any colour is correct to twice that.

    Returns:
        Straight RGBA. Colour is 0 where alpha rounds to 0.
    """
    alpha = np.asarray(alpha, np.float64)
    rounded = np.rint(np.clip(alpha, 0, 1) * 65535) / 65535
    behind = 0.0 if background is None else np.asarray(background, np.float64) * (rounded - alpha)[..., None]
    covered = rounded[..., None]
    color = (premultiplied + behind) / np.where(covered > 0, covered, 1.0)
    color = np.where(covered > 0, np.clip(color, 0, 1), 0.0)
    return np.rint(np.concatenate([color, covered], axis=-1) * 65535).astype(np.uint16)
