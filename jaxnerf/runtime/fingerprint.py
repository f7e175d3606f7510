"""Fingerprints of text, arrays and files: equal content has an equal fingerprint, on any machine."""

import hashlib
import os
from typing import Any

import jax
import numpy as np

from jaxnerf.runtime.atomic_files import open_regular


def fingerprint(*values: Any, sample: int | None = None) -> str:
    """Returns 16 hexadecimal digits of SHA-256 over text, bytes and trees of arrays.

    Boundaries, types and shapes count: ("ab", "c") differs from ("a", "bc"). Of a pytree only the leaves
    count; None and static fields do not.

    Args:
        *values: str, bytes, arrays, numbers, or pytrees of them.
        sample: only about this many evenly spaced rows of an array count, for arrays that lie on a disk;
            None: all.
    """
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(values):
        if isinstance(leaf, str | bytes):
            kind, content = type(leaf).__name__, leaf.encode() if isinstance(leaf, str) else leaf
            digest.update(f"{kind}{len(content)}:".encode())
        else:
            rows = leaf if sample is None or np.ndim(leaf) == 0 else leaf[:: max(len(leaf) // sample, 1)]
            rows = np.asarray(rows)
            digest.update(f"{rows.dtype.name}{np.shape(leaf)}:".encode())
            content = np.ascontiguousarray(rows).reshape(-1).view(np.uint8)  # also for types that hashlib does not know
        digest.update(content)
    return digest.hexdigest()[:16]


def file_sha256(path: str | os.PathLike) -> str:
    """Returns the SHA-256 of a file's content, as sha256sum prints it."""
    with open_regular(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
