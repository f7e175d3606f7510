"""The pixel cache: mapped and decoded pixels are equal, and unusable files are replaced."""

import functools
import os

import numpy as np
import pytest
from PIL import Image
from test_load_images import a_capture, pixels

import captures
from jaxnerf.data.images import image_files, load_images, pixel_cache

SHAPE = (12, 4)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """Sets a cache folder and a limit from which all pixels are mapped; returns the folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(pixel_cache, "_LARGE", 1)
    return tmp_path / "cache" / "jaxnerf"


@pytest.fixture
def image_file(tmp_path):
    file = tmp_path / "image.png"
    file.write_bytes(b"123")
    return file


def fill(image_file, decoded, value=7, **options):
    """Returns the pixels of two images; appends the index of each decoded image to `decoded`."""

    def read(index):
        decoded.append(index)
        return np.full((2, 3, 4), value + index, np.uint8)

    tasks = [functools.partial(read, index) for index in range(2)]
    return pixel_cache.fill_pixels([image_file], tasks, shape=SHAPE, dtype=np.uint8, offsets=[0, 6], **options)


@pytest.mark.parametrize("many", [True, False])
def test_pixels_are_decoded_again_only_if_a_file_changes(image_file, cache, monkeypatch, many):
    monkeypatch.setattr(pixel_cache, "_LARGE", 1 if many else 2**28)
    monkeypatch.setattr(pixel_cache, "_SLOW", 0.0)
    decoded = []
    first, second = fill(image_file, decoded), fill(image_file, decoded, value=9)
    assert isinstance(first, np.memmap) == isinstance(second, np.memmap) == many
    assert sorted(decoded) == [0, 1] and first[:, 0].tolist() == second[:, 0].tolist() == [7] * 6 + [8] * 6
    assert [file.suffix for file in cache.iterdir()] == [".npy"]
    assert [path.stat().st_mode & 0o777 for path in (cache, *cache.iterdir())] == [0o700, 0o600]
    times = image_file.stat()
    image_file.write_bytes(b"124")  # of the same size
    os.utime(image_file, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert fill(image_file, decoded, value=9)[0, 0] == 9
    assert fill(image_file, decoded, value=5, depends=("factor", 2))[0, 0] == 5


@pytest.mark.parametrize("many", [True, False])
@pytest.mark.parametrize("content", [b"", b"nothing", "cut", "other", "a flipped bit", "of other pixels"])
def test_a_damaged_cache_file_is_replaced(image_file, cache, monkeypatch, content, many):
    monkeypatch.setattr(pixel_cache, "_LARGE", 1 if many else 2**28)
    monkeypatch.setattr(pixel_cache, "_SLOW", 0.0)
    fill(image_file, [])
    (file,) = cache.iterdir()
    kept = bytearray(file.read_bytes())
    if content == "other":
        np.save(file, np.zeros((3, 4), np.uint8))
    elif content == "a flipped bit":
        kept[140] ^= 1
        file.write_bytes(kept)
    elif content == "of other pixels":
        fill(image_file, [], value=5, depends=("factor", 2))
        (other,) = set(cache.iterdir()) - {file}
        os.replace(other, file)
    else:
        file.write_bytes(kept[:-5] if content == "cut" else content)
    decoded = []
    assert fill(image_file, decoded)[:, 0].tolist() == [7] * 6 + [8] * 6 and len(decoded) == 2


@pytest.mark.parametrize("many", [True, False])
def test_no_flipped_bit_of_a_file_is_believed(image_file, cache, monkeypatch, many):
    """Also in the header, which numpy parses as Python."""
    monkeypatch.setattr(pixel_cache, "_LARGE", 1 if many else 2**28)
    monkeypatch.setattr(pixel_cache, "_SLOW", 0.0)
    right = np.array(fill(image_file, []))
    (file,) = cache.iterdir()
    kept = file.read_bytes()
    for position in range(len(kept)):
        changed = bytearray(kept)
        changed[position] ^= 1 << position % 8
        file.write_bytes(changed)
        np.testing.assert_array_equal(fill(image_file, []), right)


def test_a_pipe_in_the_cache_is_not_waited_for(image_file, cache, caplog):
    right = np.array(fill(image_file, []))
    (file,) = cache.iterdir()
    file.unlink()
    os.mkfifo(file)
    np.testing.assert_array_equal(fill(image_file, []), right)
    assert "Not a regular file" in caplog.text


def test_failed_decoding_leaves_no_cache_file(image_file, cache):
    def bad():
        raise ValueError("image.png: unreadable")

    with pytest.raises(ValueError, match="unreadable"):
        pixel_cache.fill_pixels([image_file], [bad], shape=SHAPE, dtype=np.uint8, offsets=[0])
    assert not list(cache.iterdir())


def test_small_and_quickly_decoded_pixels_are_not_cached(image_file, cache, monkeypatch):
    monkeypatch.setattr(pixel_cache, "_LARGE", 2**28)
    assert fill(image_file, [])[0, 0] == 7 and not list(cache.iterdir())


@pytest.mark.parametrize("many", [True, False])
def test_pixels_are_in_memory_if_the_disk_is_full(image_file, cache, monkeypatch, caplog, many):
    monkeypatch.setattr(pixel_cache, "_LARGE", 1 if many else 2**28)
    monkeypatch.setattr(pixel_cache, "_SLOW", 0.0)
    monkeypatch.setattr(pixel_cache, "_SPARE", 2**60)
    found = fill(image_file, [])
    assert not isinstance(found, np.memmap) and found[:, 0].tolist() == [7] * 6 + [8] * 6
    assert "cannot be cached" in caplog.text and not list(cache.iterdir())


def test_the_least_recently_used_files_are_deleted_first(image_file, cache, monkeypatch):
    for age in (1, 2, 3):
        fill(image_file, [], depends=(age,))
        newest = max(cache.iterdir(), key=lambda file: file.stat().st_mtime)
        os.utime(newest, (10**9 - age,) * 2)
    (cache / "pixels_x.1.tmp").write_bytes(b"of a killed process")
    os.utime(cache / "pixels_x.1.tmp", (1, 1))
    monkeypatch.setattr(pixel_cache, "_MAX_SIZE", 48 + 2 * (128 + 48 + 8))
    decoded = []
    fill(image_file, decoded, depends=(4,))
    assert len(list(cache.iterdir())) == 3
    fill(image_file, decoded, depends=(1,))
    assert len(decoded) == 2, "the file used last still exists"


def test_readers_return_the_same_pixels_mapped_and_in_memory(tmp_path, monkeypatch):
    captures.write_blender(tmp_path / "blender", captures.noise(captures.orbit(3)))
    kinds = [pixels(0), pixels(1, channels=4), pixels(2, dtype=np.uint16)[..., 0]]
    splits = {"train": (0, 1, 2)}
    capture = a_capture(tmp_path / "mixed", kinds, splits=splits)

    def read():
        views = [
            captures.load_blender(tmp_path / "blender"),
            captures.load_blender(tmp_path / "blender", select=lambda count: [count - 1]),
            load_images.load_capture(capture, background=(1, 1, 1)),
            load_images.load_capture(capture, factor=2, select=lambda count: range(1, count)),
        ]
        return [each.pixels for each in views]

    found = read() + read()
    assert all(isinstance(each, np.memmap) for each in found)
    monkeypatch.setattr(pixel_cache, "_LARGE", 2**28)
    for each, expected in zip(found, 2 * read(), strict=True):
        assert not isinstance(expected, np.memmap) and expected.dtype == each.dtype
        np.testing.assert_array_equal(each, expected)
    assert found[0].shape == (3 * 24 * 32, 4) and found[1].shape == (24 * 32, 4) and found[0].any()


@pytest.mark.parametrize("mode", ["L", "LA", "P", "PA", "RGB", "RGBA", "1", "I;16", "CMYK"])
@pytest.mark.parametrize("orientation", [1, 6])
def test_the_form_of_an_image_is_known_from_its_first_bytes(tmp_path, mode, orientation):
    file = tmp_path / ("a.jpg" if mode == "CMYK" else "a.png")
    image = Image.new("LA" if mode == "PA" else mode, (6, 4))
    exif = Image.Exif()
    exif[0x0112] = orientation
    (image.convert("P") if mode == "PA" else image).save(file, exif=exif)
    for options in ({}, {"follow_exif": False}, *({"camera_size": size} for size in ((4, 6), (6, 4), (9, 9)))):
        got = image_files.read_image(file, **options)
        assert image_files.image_form(file, **options) == (got.shape, got.dtype)
