"""Tests of the images that structure from motion is given: their order, their copies and their pairs."""

import itertools
import os

import numpy as np
import pytest
from PIL import Image

from jaxnerf.data.images.image_files import read_image
from jaxnerf.tools.structure_from_motion.images import (
    copy_images,
    copy_name,
    find_images,
    group_by_size,
    image_pairs,
    resolve_matching,
)


def write_images(folder, *names, size=(12, 8), **options):
    """Writes images of smooth random colour; returns their paths."""
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(0)
    for name in names:
        coarse = Image.fromarray(rng.integers(0, 256, (2, 3, 3), np.uint8))
        coarse.resize(size, Image.Resampling.BILINEAR).save(folder / name, **options)
    return [folder / name for name in names]


def test_images_are_found_in_natural_order_and_other_files_are_counted(tmp_path):
    write_images(tmp_path, "a10.png", "a2.PNG", "b1.jpg", ".hidden.png")
    for name in ("x.HEIC", "y.heic", "notes"):
        (tmp_path / name).write_bytes(b"")
    paths, others = find_images(tmp_path)
    assert [path.name for path in paths] == ["a2.PNG", "a10.png", "b1.jpg"]
    assert others == "2 .heic, 1 no suffix"


@pytest.mark.parametrize("count", [0, 2])
def test_too_few_images_are_reported(tmp_path, count):
    write_images(tmp_path, *(f"{index}.png" for index in range(count)))
    (tmp_path / "x.heic").write_bytes(b"")
    with pytest.raises(ValueError, match=rf"holds {count or 'no'} images and other files \(1 .heic\), expected at l"):
        find_images(tmp_path)


def test_copies_are_exact_named_without_white_space_and_made_once(tmp_path):
    paths, out = write_images(tmp_path / "in", "a b.png", "c.jpg"), tmp_path / "out"
    out.mkdir()
    done = []
    assert copy_images(paths, out, overwrite=False, progress=done.append) == 0
    assert done == [1, 2]
    assert {path.name: path.read_bytes() for path in out.iterdir()} == {
        "a_b.png": paths[0].read_bytes(),
        "c.jpg": paths[1].read_bytes(),
    }
    before = (out / "c.jpg").stat()
    copy_images(paths, out, overwrite=True, progress=done.append)
    assert (out / "c.jpg").stat().st_ino == before.st_ino


@pytest.mark.parametrize(
    "name, copied",
    [
        ("#1.png", "_1.png"),
        ("# 1#.png", "__1#.png"),
        ("a\nb\t\u3000.png", "a_b__.png"),
        ("\x1b\u202e\udcff.png", "___.png"),
        ("é'\"\\,;$().png", "é'\"\\,;$().png"),
    ],
)
def test_a_copy_has_a_name_that_a_list_of_pairs_can_hold(tmp_path, name, copied):
    """COLMAP takes lines that begin with # as comments, and white space separates two names."""
    assert copy_name(tmp_path / name) == copied


def test_rotated_jpegs_are_copied_upright(tmp_path):
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "maker"
    paths, out = write_images(tmp_path / "in", "a.jpg", "b.jpg", size=(32, 16), quality=95, exif=exif), tmp_path / "o"
    write_images(tmp_path / "in", "b.jpg", size=(32, 16))
    out.mkdir()
    assert copy_images(paths, out, overwrite=False, progress=lambda count: None) == 1
    upright = read_image(paths[0])
    assert upright.shape == (32, 16, 3)
    copied = read_image(out / "a.jpg", follow_exif=False)
    assert copied.shape == upright.shape
    assert np.abs(copied.astype(int) - upright).mean() < 2
    kept = Image.open(out / "a.jpg").getexif()
    assert kept[0x010F] == "maker" and 0x0112 not in kept
    assert group_by_size([out / "a.jpg", out / "b.jpg"]) == [["a.jpg"], ["b.jpg"]]


def test_other_files_are_replaced_only_on_request(tmp_path):
    paths, out = write_images(tmp_path / "in", "a.png"), tmp_path / "out"
    write_images(out, "a.png", size=(4, 4))
    time = paths[0].stat().st_mtime_ns
    os.utime(out / "a.png", ns=(time, time))
    with pytest.raises(ValueError, match="a.png: exists and is no copy of .*; add --overwrite"):
        copy_images(paths, out, overwrite=False, progress=lambda count: None)
    copy_images(paths, out, overwrite=True, progress=lambda count: None)
    assert (out / "a.png").read_bytes() == paths[0].read_bytes()


def test_copies_with_one_name_are_reported(tmp_path):
    paths = write_images(tmp_path, "a b.png", "a_b.png")
    with pytest.raises(ValueError, match="2 images would be copied to 'a_b.png'; rename them"):
        copy_images(paths, tmp_path, overwrite=True, progress=lambda count: None)


def test_exhaustive_pairs_are_all():
    assert image_pairs("abcd", "exhaustive") == list(itertools.combinations("abcd", 2))


def test_sequential_pairs_hold_neighbours_and_close_loops():
    names = [f"{index:03d}" for index in range(300)]
    pairs = image_pairs(names, "sequential")
    assert len(set(pairs)) == len(pairs) < 0.2 * 300 * 299 / 2
    assert all(first < second for first, second in pairs)
    assert {(names[0], names[offset]) for offset in (*range(1, 11), 16, 32, 64, 128, 256)} < set(pairs)
    assert (names[7], names[18]) not in pairs
    assert (names[0], names[295]) in pairs


def test_neighbours_are_at_most_10_places_apart():
    pairs = image_pairs([str(index) for index in range(40)], "neighbours")
    assert {int(second) - int(first) for first, second in pairs} == set(range(1, 11))
    assert len(pairs) == sum(40 - offset for offset in range(1, 11))


def test_the_matching_follows_the_number_of_images():
    assert [resolve_matching("auto", count) for count in (3, 200, 201)] == ["exhaustive"] * 2 + ["sequential"]
    assert resolve_matching("exhaustive", 1000) == "exhaustive"
