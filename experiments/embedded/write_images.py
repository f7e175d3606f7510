"""Renders the images of the embedded scene that ship with the package, and writes them to jaxnerf/data/still_life.npz.

    python experiments/embedded/write_images.py

Run it after a change of the scene or of its renderer; tests/tools/embedded_scene finds that it is needed. It takes
about a minute on one core.
"""

import numpy as np
from absl import app

from jaxnerf.data import synthetic
from jaxnerf.tools.embedded_scene.render import render_views


def main(argv: list[str]) -> None:
    """Renders and writes the splits train and test."""
    del argv
    splits = {}
    for split in ("train", "test"):
        stack = synthetic._cameras(split, synthetic.SHIPPED_SIZE)
        pixels = render_views(stack)
        splits[split] = compressible(pixels.reshape(-1, synthetic.SHIPPED_SIZE, synthetic.SHIPPED_SIZE, 4))
    np.savez_compressed(synthetic.SHIPPED, **splits)
    print(f"{synthetic.SHIPPED}: {synthetic.SHIPPED.stat().st_size / 1e6:.1f} MB")


def compressible(pixels: np.ndarray) -> np.ndarray:
    """Returns pixels [V, H, W, 4] as high and low bytes [2, V, 4, H, W] of differences along rows and columns.

    The differences are modulo 65536; they compress to two thirds of what the pixels do.
    """
    values = np.moveaxis(pixels, -1, 1)
    for axis in (2, 3):
        values = np.diff(values, axis=axis, prepend=np.zeros_like(values.take([0], axis)))
    values = values + np.uint16(128)  # small differences of both signs have the same high byte
    return np.stack([values >> 8, values & 255]).astype(np.uint8)


if __name__ == "__main__":
    app.run(main)
