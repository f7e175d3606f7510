"""An example of an exporter: the density of the field at the centres of a grid of cells, as a NumPy file.

Run it by

    jaxnerf-export --plugins=density_exporter --workdir=runs/demo --kind=density --num_cells=64

where density_exporter.py is in the current folder or on PYTHONPATH.
"""

import dataclasses

import jax
import numpy as np

import jaxnerf
from jaxnerf.extend import Options, between, option


@dataclasses.dataclass(frozen=True)
class DensityOptions(Options):
    """The options of the exporter: flags of jaxnerf-export, with checks and help."""

    num_cells: int = option(128, "cells along each side of the box", range=between(1, 1024))


def export_density(source, folder):
    """Writes density.npz into the folder, which is moved into place when this function returns.

    Args:
        source: ExportSource, the restored run and, as `source.settings`, the options of the command line.
        folder: a Path; it is empty.
    """
    grid = source.variables[1]  # every exported run has an occupancy grid, whose box holds the scene
    scene = source.run.experiment.model.scene(*source.variables)
    count = source.settings.num_cells
    lower, upper = np.asarray(grid.lower), np.asarray(grid.upper)
    along = (np.arange(count) + 0.5) / count
    places = np.stack(np.meshgrid(along, along, along, indexing="ij"), axis=-1)
    x = np.float32(lower + places * (upper - lower))
    up = np.float32([[[0.0, 0.0, 1.0]]])  # density does not depend on the direction

    density = jax.lax.map(lambda plane: scene(plane, up)[0], x)
    np.savez(folder / "density.npz", density=np.asarray(density), lower=lower, upper=upper)
    source.say(f"density at {count} x {count} x {count} cells")


jaxnerf.register_exporter("density", export_density, options=DensityOptions)
