"""The cache of arrays: whose folders are used, and which files are believed."""

import os
import time

import numpy as np
import pytest

from jaxnerf.runtime import user_cache

ARRAYS = {"numbers": np.arange(50.0), "more": np.ones((2, 3), np.uint8)}


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The folder of the cache, which does not exist yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "jaxnerf"


def load(name="name", arrays=ARRAYS):
    """Returns the arrays, and whether they were computed."""
    made = []
    found = user_cache.load_or_make(
        None, name, lambda: made.append(1) or arrays, is_valid=lambda found: found.keys() == arrays.keys()
    )
    assert found.keys() == arrays.keys()
    return found, bool(made)


def test_only_the_user_can_read_the_cache(cache):
    assert load()[1] and not load()[1]
    assert [path.stat().st_mode & 0o777 for path in (cache, *cache.iterdir())] == [0o700, 0o600]
    cache.chmod(0o755)  # as earlier versions made it
    assert not load()[1] and cache.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o702])
def test_a_folder_that_others_can_write_is_not_used(cache, caplog, mode):
    load()
    cache.chmod(mode)
    (file,) = cache.iterdir()
    file.unlink()
    assert load()[1] and load()[1] and not list(cache.iterdir())
    assert f"jaxnerf can be written by other users (mode {mode:o}); remove it" in caplog.text


def test_a_folder_of_another_user_is_not_used(cache, caplog, monkeypatch):
    load()
    user = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: user + 1)
    assert load()[1] and "jaxnerf belongs to another user; set XDG_CACHE_HOME" in caplog.text


def test_no_flipped_bit_is_believed(cache):
    load()
    (file,) = cache.iterdir()
    content = file.read_bytes()
    for position in range(0, len(content), 7):
        changed = bytearray(content)
        changed[position] ^= 1 << position % 8
        file.write_bytes(changed)
        for name, array in load()[0].items():
            np.testing.assert_array_equal(array, ARRAYS[name])


def test_the_file_of_another_name_is_not_believed(cache):
    load("one")
    load("other", {name: array + 1 for name, array in ARRAYS.items()})
    os.replace(cache / "one.npz", cache / "other.npz")
    assert load("other")[1]


def test_least_recently_used_are_removed_first(tmp_path):
    for age in range(6):
        path = tmp_path / f"{age}-cache"
        path.write_bytes(bytes(1000))
        os.utime(path, (time.time() - 100 * age,) * 2)
    size = path.stat().st_size
    (tmp_path / "partial.tmp").write_bytes(b"of a killed process")
    os.utime(tmp_path / "partial.tmp", (time.time() - 7200,) * 2)
    user_cache.prune(tmp_path.iterdir(), 100 * size)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{age}-cache" for age in range(6)]
    user_cache.prune(tmp_path.iterdir(), 3.5 * size)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0-cache", "1-cache", "2-cache"]
