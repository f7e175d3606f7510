"""Images of every kind that Pillow reads are the same image as in 8 bits, or are refused with what was found."""

import struct
import zlib

import imageio.v3 as iio
import numpy as np
import pytest
import tifffile
from PIL import Image

from jaxnerf.data.images.image_files import image_form, read_image, read_mask

GREY = np.random.default_rng(0).integers(0, 256, (6, 8)).astype(np.uint8)
BIG_ENDIAN = (GREY.astype(">u2") * 257).astype(">u2").tobytes()
KINDS = {
    "8 bits.png": lambda: Image.fromarray(GREY),
    "16 bits.png": lambda: Image.fromarray(GREY.astype(np.uint16) * 257),
    "16 bits.tif": lambda: Image.fromarray(GREY.astype(np.uint16) * 257),
    "16 bits, big endian.tif": lambda: Image.frombytes("I;16B", (8, 6), BIG_ENDIAN),
    "32 bits.tif": lambda: Image.fromarray(GREY.astype(np.int32) * 257),
    "floats.tif": lambda: Image.fromarray(GREY.astype(np.float32) / 255),
    "rounded floats.tif": lambda: Image.fromarray(GREY.astype(np.float32) * (1.00001 / 255) - 1e-6),
    "palette.png": lambda: Image.fromarray(GREY).convert("P"),
    "grey with alpha.png": lambda: Image.fromarray(GREY).convert("LA"),
    "colour.tif": lambda: Image.fromarray(GREY).convert("RGB"),
    "print colours.tif": lambda: Image.fromarray(GREY).convert("RGB").convert("CMYK"),
}


COLORS = np.stack([GREY, 255 - GREY, GREY // 2], axis=-1)
DEEP = COLORS.astype(np.uint16) * 257
OPAQUE = np.full((6, 8, 1), 65535, np.uint16)
TIFFS = {
    "16 bits": (COLORS, DEEP, {"photometric": "rgb"}),
    "16 bits, big endian": (COLORS, DEEP, {"photometric": "rgb", "byteorder": ">"}),
    "with alpha": (COLORS, np.concatenate([DEEP, OPAQUE], axis=-1), {"photometric": "rgb", "extrasamples": [2]}),
    "planes": (COLORS, np.moveaxis(COLORS, -1, 0), {"photometric": "rgb", "planarconfig": "separate"}),
    "0 is white": (255 - GREY, GREY, {"photometric": "miniswhite"}),
    "0 is white, 16 bits": (255 - GREY, DEEP[..., 0], {"photometric": "miniswhite"}),
    "unsigned 32 bits": (GREY, DEEP[..., 0].astype(np.uint32), {}),
    "big endian floats": (GREY, GREY.astype(np.float32) / 255, {"byteorder": ">"}),
    "compressed": (GREY, DEEP[..., 0], {"compression": "zlib"}),
    "two pages": (GREY, np.stack([DEEP[..., 0], DEEP[..., 1]]), {"photometric": "minisblack"}),
}


@pytest.mark.parametrize("name", TIFFS)
def test_tiffs_of_other_programs(name, tmp_path):
    image, numbers, options = TIFFS[name]
    tifffile.imwrite(tmp_path / "a.tif", numbers, **options)
    pixels = read_image(tmp_path / "a.tif")
    assert image_form(tmp_path / "a.tif") == (pixels.shape, pixels.dtype)
    colors = pixels[..., :3] / np.iinfo(pixels.dtype).max
    np.testing.assert_allclose(colors, np.broadcast_to(image.reshape(6, 8, -1), (6, 8, 3)) / 255, atol=1.5 / 255)


@pytest.mark.parametrize(
    "numbers, words, options",
    [
        (np.moveaxis(DEEP, -1, 0), "channels of 16 bits are stored one after", {"planarconfig": "separate"}),
        (GREY.astype(np.int16) * 128, "its values are signed numbers of 16 bits, expected unsigned ones", {}),
        ((GREY // 2).astype(np.int8), "its values are signed numbers of 8 bits", {}),
        (GREY.astype(np.int32), "its values are from 0 to 2.. in 32 bits, expected a range up to 65535", {}),
        (GREY.astype(np.uint32) * 16843009, "expected whole numbers from 0 to 65535", {}),
        (GREY / 255, "of a kind that Pillow does not read", {}),
    ],
)
def test_tiffs_that_are_refused(numbers, words, options, tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", numbers, photometric="rgb" if options else "minisblack", **options)
    with pytest.raises(ValueError, match=f"a.tif: .*{words}.*convert it"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize("numbers, key", [(DEEP, (514, 65535 - 514, 257)), (DEEP[..., :1], (514,))])
def test_a_transparent_colour_of_16_bits_is_resolved(numbers, key, tmp_path):
    numbers = numbers.copy()
    numbers[2, 3] = key

    def chunk(kind, content):
        whole = kind + content
        return struct.pack(">I", len(content)) + whole + struct.pack(">I", zlib.crc32(whole))

    header = struct.pack(">IIBBBBB", 8, 6, 16, 2 if numbers.shape[-1] == 3 else 0, 0, 0, 0)
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in numbers)
    chunks = [(b"IHDR", header), (b"tRNS", np.asarray(key, ">u2").tobytes()), (b"IDAT", zlib.compress(rows))]
    (tmp_path / "a.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*each) for each in (*chunks, (b"IEND", b"")))
    )
    pixels = read_image(tmp_path / "a.png")
    assert image_form(tmp_path / "a.png") == ((6, 8, 4), np.uint16) == (pixels.shape, pixels.dtype)
    np.testing.assert_array_equal(pixels[..., :3], np.broadcast_to(numbers, (6, 8, 3)))
    np.testing.assert_array_equal(pixels[..., 3] == 0, (numbers == key).all(axis=-1))


@pytest.mark.parametrize("name", KINDS)
def test_the_image_is_that_of_8_bits(name, tmp_path):
    KINDS[name]().save(tmp_path / name)
    pixels = read_image(tmp_path / name)
    assert image_form(tmp_path / name) == (pixels.shape, pixels.dtype)
    largest = np.iinfo(pixels.dtype).max
    for channel in range(3):
        np.testing.assert_allclose(pixels[..., channel] / largest, GREY / 255, atol=1 / 255)


def test_black_and_white(tmp_path):
    Image.fromarray(GREY > 128).save(tmp_path / "bits.png")
    assert (read_image(tmp_path / "bits.png")[..., 0] == 255 * (GREY > 128)).all()


@pytest.mark.parametrize(
    "values, words",
    [
        (
            GREY.astype(np.float32),
            "its values are from 0 to 2.., expected floats from 0 to 1; convert it to 8 or 16 bits",
        ),
        (GREY / np.float32(255) - 0.5, "its values are from -0.5 to 0.4.*, expected floats from 0 to 1"),
        (np.where(GREY > 9, GREY / np.float32(255), np.nan).astype(np.float32), "from nan to nan, expected floats"),
        (GREY.astype(np.int32) * 1000, "expected whole numbers from 0 to 65535"),
        (GREY.astype(np.int32) - 10, "its values are from -10 to "),
    ],
)
def test_other_ranges_are_refused(values, words, tmp_path):
    Image.fromarray(values).save(tmp_path / "a.tif")
    with pytest.raises(ValueError, match=f"a.tif: .*{words}"):
        read_image(tmp_path / "a.tif")


def test_kinds_that_pillow_does_not_read_are_refused(tmp_path):
    """A TIFF of floats in three channels, such as renderers write: Pillow knows no such mode."""
    floats = np.repeat(GREY.astype(np.float32)[..., None] / 255, 3, axis=-1)
    iio.imwrite(tmp_path / "a.tif", floats)
    with pytest.raises(ValueError, match="a.tif: unreadable .* of a kind that Pillow does not read.*convert it to PNG"):
        read_image(tmp_path / "a.tif")


KEPT = GREY > 100
MASKS = {
    "0 and 255.png": lambda: Image.fromarray(255 * KEPT.astype(np.uint8)),
    "0 and 1.png": lambda: Image.fromarray(KEPT.astype(np.uint8)),
    "bits.png": lambda: Image.fromarray(KEPT),
    "0 and 1000.png": lambda: Image.fromarray(1000 * KEPT.astype(np.uint16)),
    "0 and 65535.tif": lambda: Image.fromarray(65535 * KEPT.astype(np.uint16)),
    "floats.tif": lambda: Image.fromarray(KEPT.astype(np.float32)),
    "colours.png": lambda: Image.fromarray(KEPT[..., None] * np.uint8([0, 128, 0])),
    "floats of 0 and 255.tif": lambda: Image.fromarray(255 * KEPT.astype(np.float32)),
    "0 and 100000.tif": lambda: Image.fromarray(100000 * KEPT.astype(np.int32)),
    "black with alpha.png": lambda: Image.fromarray(KEPT[..., None] * np.uint8([0, 0, 0, 255])),
    "white with alpha.png": lambda: Image.fromarray(
        np.uint8([255, 255, 255, 0]) + KEPT[..., None] * np.uint8([0, 0, 0, 255])
    ),
    "grey and opaque.png": lambda: Image.fromarray(255 * KEPT.astype(np.uint8)).convert("LA"),
    "soft.png": lambda: Image.fromarray(np.where(KEPT, 200, 40).astype(np.uint8)),
}


@pytest.mark.parametrize("name", MASKS)
def test_a_mask_is_true_where_it_is_bright(name, tmp_path):
    MASKS[name]().save(tmp_path / name)
    assert (read_mask(tmp_path / name) == KEPT).all()


@pytest.mark.parametrize(
    "values, words",
    [
        (GREY % 4, "it holds the values 0, 1, 2, 3 ..., expected those of a mask; write 0 where pixels are ignored"),
        (np.where(KEPT, 1, np.nan).astype(np.float32), "from nan to nan, expected a mask's"),
        (KEPT.astype(np.float32) - 1, "from -1 to 0, expected a mask's"),
    ],
)
def test_what_is_no_mask_is_refused(values, words, tmp_path):
    Image.fromarray(values).save(tmp_path / "mask.tif")
    with pytest.raises(ValueError, match=f"mask.tif: .*{words}"):
        read_mask(tmp_path / "mask.tif")


@pytest.mark.parametrize("value, kept", [(0, False), (1, True), (255, True)])
def test_a_mask_of_one_value_keeps_all_unless_it_is_black(value, kept, tmp_path):
    Image.fromarray(np.full((6, 8), value, np.uint8)).save(tmp_path / "mask.png")
    assert (read_mask(tmp_path / "mask.png") == kept).all()


def test_a_mask_with_a_palette_is_read_by_its_colours(tmp_path):
    image = Image.fromarray(KEPT.astype(np.uint8)).convert("P")
    image.putdata([int(value) for value in KEPT.reshape(-1)])
    image.putpalette([0, 0, 0, 0, 0, 128])
    image.save(tmp_path / "mask.png")
    assert (read_mask(tmp_path / "mask.png") == KEPT).all()
