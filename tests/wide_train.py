"""python -m jaxnerf.train whose cameras, and so rays and samples, are float64: for device_matrix.py.

Under JAX_ENABLE_X64 parameters and densities are float64 by themselves, but cameras are read as float32, and
roundings of what follows from them depend on how many rays a device has.
"""

import dataclasses

import jax
import numpy as np

from jaxnerf import train
from jaxnerf.runtime import cli
from jaxnerf.training import build

_load_views = build.load_views


def load_views(data, split):
    views = _load_views(data, split)
    cameras, near, far = jax.tree.map(_widen, (views.cameras, views.near, views.far))
    return dataclasses.replace(views, cameras=cameras, near=near, far=far)


def _widen(leaf):
    return np.asarray(leaf, np.float64) if np.issubdtype(np.asarray(leaf).dtype, np.floating) else leaf


if __name__ == "__main__":
    build.load_views = load_views
    cli.run(train.main)
