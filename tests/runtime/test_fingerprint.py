"""Fingerprints are equal for equal content, and differ where anything differs."""

import hashlib

import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest

from jaxnerf.runtime.fingerprint import file_sha256, fingerprint

ARRAY = np.arange(12, dtype=np.float32).reshape(3, 4)
OTHERS = {
    "value": ARRAY + 1,
    "shape": ARRAY.reshape(4, 3),
    "type": ARRAY.astype(np.int32),
    "order": ARRAY.T.copy(),
    "count": (ARRAY, ARRAY),
    "text": "text",
    "bfloat16": ARRAY.astype(ml_dtypes.bfloat16),
}


def test_equal_content_has_an_equal_fingerprint():
    assert fingerprint(ARRAY) == fingerprint(jnp.asarray(ARRAY)) == fingerprint(np.asfortranarray(ARRAY))
    assert fingerprint({"a": ARRAY, "b": None}) == fingerprint(ARRAY)
    assert len(fingerprint()) == 16 and fingerprint(1.5, "text") == fingerprint(1.5, "text")


@pytest.mark.parametrize("name", OTHERS)
def test_different_content_has_another_fingerprint(name):
    assert fingerprint(OTHERS[name]) != fingerprint(ARRAY)


def test_boundaries_count():
    assert fingerprint("ab", "c") != fingerprint("a", "bc")
    assert fingerprint(b"ab") != fingerprint("ab")


def test_sample_reads_some_rows_and_the_shape():
    rows = np.zeros((1000, 3))
    rows[1] = 1  # not in the sample
    assert fingerprint(rows, sample=10) == fingerprint(np.zeros((1000, 3)), sample=10)
    assert fingerprint(rows, sample=10) != fingerprint(np.zeros((1001, 3)), sample=10)
    assert fingerprint(rows, sample=1000) != fingerprint(np.zeros((1000, 3)), sample=1000)
    assert fingerprint(np.float32(3), sample=10) == fingerprint(np.float32(3))


def test_file_sha256(tmp_path):
    (tmp_path / "file").write_bytes(b"content")
    assert file_sha256(tmp_path / "file") == hashlib.sha256(b"content").hexdigest()
