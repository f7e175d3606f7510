"""Pixels that are mapped from a file are those in memory, and a file that is of no use is made again."""

import functools
import os

import numpy as np
import pytest
from PIL import Image
from test_load_images import a_capture, pixels

import runs  # noqa: F401  (experiments can be imported)
from experiments import large_scene
from jaxnerf.data.images import image_files, load_images, pixel_cache
from jaxnerf.data.readers import blender

SHAPE = (12, 4)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """Returns the folder of the cache, for a limit that all pixels exceed."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(pixel_cache, "_LARGE", 1)
    return tmp_path / "cache" / "jaxnerf"


@pytest.fixture
def photo(tmp_path):
    file = tmp_path / "photo.png"
    file.write_bytes(b"123")
    return file


def fill(photo, asked, value=7, **options):
    """Returns pixels of two images; what is read is noted in asked."""

    def read(index):
        asked.append(index)
        return np.full((2, 3, 4), value + index, np.uint8)

    tasks = [functools.partial(read, index) for index in range(2)]
    return pixel_cache.fill_pixels([photo], tasks, shape=SHAPE, dtype=np.uint8, place=[0, 6], **options)


@pytest.mark.parametrize("many", [True, False])
def test_a_second_call_reads_nothing_until_a_file_changes(photo, cache, monkeypatch, many):
    monkeypatch.setattr(pixel_cache, "_LARGE", 1 if many else 2**28)
    monkeypatch.setattr(pixel_cache, "_SLOW", 0.0)
    asked = []
    first, second = fill(photo, asked), fill(photo, asked, value=9)
    assert isinstance(first, np.memmap) == isinstance(second, np.memmap) == many
    assert sorted(asked) == [0, 1] and first[:, 0].tolist() == second[:, 0].tolist() == [7] * 6 + [8] * 6
    assert [file.suffix for file in cache.iterdir()] == [".npy"]
    os.utime(photo, ns=(1, 1))
    assert fill(photo, asked, value=9)[0, 0] == 9
    assert fill(photo, asked, value=5, depends=("factor", 2))[0, 0] == 5


@pytest.mark.parametrize("content", [b"", b"nothing", "cut", "other"])
def test_a_broken_file_is_made_again(photo, cache, content):
    fill(photo, [])
    (file,) = cache.iterdir()
    if content == "other":
        np.save(file, np.zeros((3, 4), np.uint8))
    else:
        file.write_bytes(file.read_bytes()[:-5] if content == "cut" else content)
    asked = []
    assert fill(photo, asked)[:, 0].tolist() == [7] * 6 + [8] * 6 and len(asked) == 2


def test_what_fails_leaves_no_file(photo, cache):
    def bad():
        raise ValueError("photo.png: unreadable")

    with pytest.raises(ValueError, match="unreadable"):
        pixel_cache.fill_pixels([photo], [bad], shape=SHAPE, dtype=np.uint8, place=[0])
    assert not list(cache.iterdir())


def test_few_pixels_that_are_soon_decoded_are_not_kept(photo, cache, monkeypatch):
    monkeypatch.setattr(pixel_cache, "_LARGE", 2**28)
    assert fill(photo, [])[0, 0] == 7 and not list(cache.iterdir())


@pytest.mark.parametrize("many", [True, False])
def test_without_room_on_the_disk_pixels_are_in_memory(photo, cache, monkeypatch, caplog, many):
    monkeypatch.setattr(pixel_cache, "_LARGE", 1 if many else 2**28)
    monkeypatch.setattr(pixel_cache, "_SLOW", 0.0)
    monkeypatch.setattr(pixel_cache, "_SPARE", 2**60)
    found = fill(photo, [])
    assert not isinstance(found, np.memmap) and found[:, 0].tolist() == [7] * 6 + [8] * 6
    assert "cannot be kept" in caplog.text and not list(cache.iterdir())


def test_what_was_used_longest_ago_goes_first(photo, cache, monkeypatch):
    for age in (1, 2, 3):
        fill(photo, [], depends=(age,))
        newest = max(cache.iterdir(), key=lambda file: file.stat().st_mtime)
        os.utime(newest, (10**9 - age,) * 2)
    (cache / "pixels_x.1.tmp").write_bytes(b"left by a kill")
    os.utime(cache / "pixels_x.1.tmp", (1, 1))
    monkeypatch.setattr(pixel_cache, "_KEPT", 48 + 2 * (128 + 48))
    asked = []
    fill(photo, asked, depends=(4,))
    assert len(list(cache.iterdir())) == 3
    fill(photo, asked, depends=(1,))
    assert len(asked) == 2, "the one used last is still there"


def test_readers_give_the_same_pixels_mapped(tmp_path, monkeypatch):
    """Of a scene of experiments/large_scene.py, and of photographs that are not alike."""
    monkeypatch.setattr(large_scene, "render_views", random_views)
    large_scene.write_split(tmp_path / "scene", "train", large_scene.poses(3, 0), 16, 8)
    kinds = [pixels(0), pixels(1, channels=4), pixels(2, dtype=np.uint16)[..., 0]]
    splits = {"train": (0, 1, 2)}
    capture = a_capture(tmp_path / "own", kinds, splits=splits)

    def read():
        views = [
            blender.load_views(tmp_path / "scene"),
            blender.load_views(tmp_path / "scene", only=lambda count: [count - 1]),
            load_images.load_views(capture, background=(1, 1, 1)),
            load_images.load_views(capture, factor=2, only=lambda count: range(1, count)),
        ]
        return [each.pixels for each in views]

    found = read() + read()
    assert all(isinstance(each, np.memmap) for each in found)
    monkeypatch.setattr(pixel_cache, "_LARGE", 2**28)
    for each, wanted in zip(found, 2 * read(), strict=True):
        assert not isinstance(wanted, np.memmap) and wanted.dtype == each.dtype
        np.testing.assert_array_equal(each, wanted)
    assert found[0].shape == (3 * 16 * 16, 4) and found[1].shape == (16 * 16, 4) and found[0].any()


def random_views(stack):
    """Stands in for the embedded scene, which takes long to compile."""
    shape = len(stack.to_world) * stack.height * stack.width, 4
    return np.random.default_rng(0).integers(0, 65536, shape, np.uint16)


@pytest.mark.parametrize("mode", ["L", "LA", "P", "PA", "RGB", "RGBA", "1", "I;16", "CMYK"])
@pytest.mark.parametrize("turned", [1, 6])
def test_what_an_image_becomes_is_known_from_its_first_bytes(tmp_path, mode, turned):
    file = tmp_path / ("a.jpg" if mode == "CMYK" else "a.png")
    image = Image.new("LA" if mode == "PA" else mode, (6, 4))
    exif = Image.Exif()
    exif[0x0112] = turned
    (image.convert("P") if mode == "PA" else image).save(file, exif=exif)
    for options in ({}, {"turn": False}, {"stored": (4, 6)}, {"stored": (6, 4)}, {"stored": (9, 9)}):
        got = image_files.read_image(file, **options)
        assert image_files.image_form(file, **options) == (got.shape, got.dtype)
