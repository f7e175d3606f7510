"""The embedded dataset: views of `jaxnerf.still_life`, so that nothing is downloaded. Those of the demo ship with the
package, rendered by experiments/embedded/write_images.py; others are rendered on first use, by a tool.
"""

import math
import os
from pathlib import Path

import numpy as np

from jaxnerf.core.types import Camera
from jaxnerf.core.views import Views
from jaxnerf.registry import Reader
from jaxnerf.runtime.user_cache import load_or_make

_COUNT = {"train": 60, "val": 8, "test": 8}
_WHITE = (1.0, 1.0, 1.0)
FINISHES = ("usual", "matt")
SHIPPED = Path(__file__).with_name("still_life.npz")  # the splits train and test of this size, with the usual finish
SHIPPED_SIZE = 200
_DISTANCE = 4.0  # of every camera from the origin, world units
_DEPTH = 1.4  # of the scene in front of and behind the origin, along any axis: the plinth's edge is at 1.27


def load_synthetic(
    *, split: str = "train", size: int = 100, finish: str = "usual", cache: str | os.PathLike | None = None
) -> Views:
    """Returns views of the embedded still life, with alpha and a white background.

    They are computed from a closed-form field, with the same bits on every machine. Each pixel is a single ray through
    its center, as the pixels of a trained model are, so a model's error contains no difference between filters.

    Args:
        split: "train" (60 views), "val" (8) or "test" (8). All 76 poses are different.
        size: height and width in px, at least 1. All 60 views of size 100 take about six seconds, once.
        finish: "usual": a highlight on the ball; "matt": none, so that colour does not depend on the view direction.
        cache: folder for pixels that are rendered; None: jaxnerf in $XDG_CACHE_HOME or ~/.cache. If it cannot be
            used, a warning is logged and the views are rendered again.

    Returns:
        Views: pixels [V * size * size, 4] uint16, rays with t in [2.6, 5.4].

    Raises:
        ValueError: on another split.
    """
    if split not in _COUNT:
        raise ValueError(f"split is {split!r}, expected one of {', '.join(_COUNT)}; choose one of these")
    count = _COUNT[split]
    stack = _cameras(split, size)
    if (size, finish) == (SHIPPED_SIZE, "usual") and split != "val":
        pixels = _shipped(split)
    else:
        from jaxnerf.tools.embedded_scene import render

        pixels = load_or_make(
            cache,
            f"still_life_{finish}_{split}_{size}_{render.fingerprint_of_code()}",
            lambda: {"pixels": render.render_views(stack, finish)},
            is_valid=lambda found: [(a.shape, a.dtype) for a in found.values()] == [((count * size**2, 4), np.uint16)],
        )["pixels"]
    return Views(
        pixels=pixels,
        offset=np.arange(count, dtype=np.int32) * np.int32(size * size),
        size=np.full((count, 2), size, np.int32),
        cameras=stack,
        near=np.full(count, _DISTANCE - _DEPTH, np.float32),
        far=np.full(count, _DISTANCE + _DEPTH, np.float32),
        names=tuple(f"{split}_{index:03d}" for index in range(count)),
        background=_WHITE,
    )


def _shipped(split):
    """Returns the pixels of a split in SHIPPED: bytes [2, V, 4, H, W], high and low, of differences of neighbours."""
    with np.load(SHIPPED) as file:
        high, low = file[split].astype(np.uint16)
    values = ((high << 8 | low) - np.uint16(128)).cumsum(2, np.uint16).cumsum(3, np.uint16)  # modulo 65536
    return np.moveaxis(values, 1, -1).reshape(-1, 4)


def _cameras(split, size):
    """Returns V cameras on a golden spiral that look at the origin, most of them from above."""
    count = _COUNT[split]
    steps = np.arange(count)
    height = -0.25 + 1.2 * (steps + 0.5) / count  # sine of the elevation; below 1, where up is undefined
    golden = math.pi * (3 - math.sqrt(5))
    azimuth = golden * steps + list(_COUNT).index(split)  # one radian between splits, so that all poses differ
    around = np.sqrt(1 - height**2)
    # In numpy, whose bits no flag of XLA changes.
    back = np.stack([around * np.cos(azimuth), around * np.sin(azimuth), height], axis=-1)
    right = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(count)], axis=-1)
    to_world = np.stack([right, np.cross(back, right), back, _DISTANCE * back], axis=-1)
    return Camera(
        to_world=to_world.astype(np.float32),
        focal=np.full((count, 2), 1.36 * size, np.float32),  # the whole plinth is visible
        center=np.full((count, 2), size / 2, np.float32),
        height=size,
        width=size,
    )


def _no_folder(folder):
    raise ValueError(f"{folder}: the embedded scene is in no folder; give another format than 'synthetic'")


READER = Reader(
    _no_folder,
    detect=lambda folder: False,
    views=lambda data, split: load_synthetic(split=split, size=data.size, finish=data.finish),
)
