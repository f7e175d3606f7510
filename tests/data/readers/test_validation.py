"""Arrays of .npy files of unknown origin, and the detection of formats."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnerf.data.readers.base import detect_formats
from jaxnerf.data.readers.validation import read_npy


def test_read_npy_reads_what_numpy_writes(tmp_path):
    path = tmp_path / "a.npy"
    for array in (
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.float32(3),
    ):
        np.save(path, array)
        np.testing.assert_array_equal(read_npy(path, "numbers"), array)


def test_read_npy_unpickles_nothing(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="a.npy: unreadable .*Python objects"):
        read_npy(path, "numbers")
    with pytest.raises(ValueError, match="b.npy: no such file, expected numbers"):
        read_npy(tmp_path / "b.npy", "numbers")


@settings(deadline=None, max_examples=150)
@given(data=st.data())
def test_a_damaged_npy_file_is_read_or_a_one_line_error(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("npy") / "a.npy"
    np.save(path, np.arange(17.0 * 3).reshape(3, 17))
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        for _ in range(data.draw(st.integers(1, 4))):
            content[data.draw(st.integers(0, 200))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    try:
        assert read_npy(path, "floats").nbytes <= len(content)
    except ValueError as error:
        assert "a.npy: unreadable" in str(error) and "\n" not in str(error)


def test_detected_formats_and_their_order(tmp_path):
    with pytest.raises(ValueError, match="holds no dataset"):
        detect_formats(tmp_path)
    for name, found in (
        ("poses_bounds.npy", ["llff"]),
        ("sparse/0/cameras.bin", ["llff"]),
        ("transforms.json", ["transforms", "llff"]),
        ("transforms_train.json", ["blender", "transforms", "llff"]),
    ):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")
        assert detect_formats(tmp_path) == found
    for name in ("images.bin", "points3D.bin"):
        (tmp_path / "sparse/0" / name).write_text("")
    assert detect_formats(tmp_path) == ["blender", "transforms", "colmap", "llff"]
