"""python -m jaxnerf.train with float64 cameras, and so float64 rays and samples: for device_matrix.py.

Under JAX_ENABLE_X64 parameters and densities are float64, but cameras are read as float32, and the rounding of
what is computed from them depends on how many rays a device has.
"""

import dataclasses

import jax
import numpy as np

from jaxnerf import train
from jaxnerf.data import dataset
from jaxnerf.runtime import cli

_load_split = dataset.load_split


def load_split(data, split):
    views = _load_split(data, split)
    cameras, near, far = jax.tree.map(_widen, (views.cameras, views.near, views.far))
    return dataclasses.replace(views, cameras=cameras, near=near, far=far)


def _widen(leaf):
    return np.asarray(leaf, np.float64) if np.issubdtype(np.asarray(leaf).dtype, np.floating) else leaf


if __name__ == "__main__":
    dataset.load_split = load_split
    cli.run(train.main)
