"""The export "points": a point cloud of the surfaces, with colours and normals."""

import os
import pathlib
from collections.abc import Mapping, Sequence

import numpy as np

from jaxnerf.runtime import stages
from jaxnerf.tools.exporters.base import ExportSource
from jaxnerf.tools.exporters.surfaces import DepthImage, export_box, inside, render_depth_images

_TYPES = {"f": ("float", "<f4"), "u": ("uchar", "u1")}


def export_points(source: ExportSource, folder: pathlib.Path) -> None:
    """Writes points.ply: the points that pixels of the depth images show, thinned to one in each cell of a grid.

    Raises:
        ValueError: if no surface is in the box.
    """
    settings = source.settings
    images = render_depth_images(source, settings.image_size)
    box = export_box(source, images)
    with stages.stage("selecting points"):
        points, normals, rgb = surface_points(images, box)[:3]
        chosen = thinned(points, settings.num_points)
    write_ply(
        folder / "points.ply",
        {
            **dict(zip("xyz", points[chosen].T, strict=True)),
            **dict(zip(("nx", "ny", "nz"), normals[chosen].T, strict=True)),
            **dict(zip(("red", "green", "blue"), rgb[chosen].T, strict=True)),
        },
    )
    source.say(f"{len(chosen):,} points with normals and colours, in the dataset's units")


def surface_points(images: Sequence[DepthImage], box: np.ndarray) -> tuple[np.ndarray, ...]:
    """Returns the points [N, 3] in a box that pixels show, and for each its normal, rgb, extinction and field_x.

    Pixels at edges and those that graze a surface are not used. The most frontal views come first.

    Raises:
        ValueError: if there are none.
    """
    parts = []
    for image in images:
        points, (normals, cosine) = image.points(), image.normals()
        kept = (cosine > 0) & inside(points, box)
        fields = (points, normals, image.rgb, image.extinction, image.field_x, cosine)
        parts.append([field[kept] for field in fields])
    joined = [np.concatenate(fields) for fields in zip(*parts, strict=True)]
    if not len(joined[0]):
        raise ValueError(f"no surface is in the box {np.round(box, 4).tolist()}; give another --box")
    order = np.argsort(-joined[-1], kind="stable")
    return tuple(field[order] for field in joined[:-1])


def thinned(points: np.ndarray, most: int) -> np.ndarray:
    """Returns the indices of the first point in each cell of the finest grid with at most `most` occupied cells."""
    if len(points) <= most:
        return np.arange(len(points))
    extent, fine, coarse = float(np.ptp(points, axis=0).max()), 0.0, 1.0
    chosen = np.zeros(1, int)
    for _ in range(20):  # bisection of the cell's side, as a fraction of the cloud's
        side = (fine + coarse) / 2
        cells = np.floor((points - points.min(axis=0)) / max(extent * side, 1e-30)).astype(np.int64)
        flat = (cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2]
        first = np.unique(flat, return_index=True)[1] if side > 2**-20 else np.arange(len(points))
        if len(first) <= most:
            chosen, coarse = first, side
        else:
            fine = side
        if 0.97 * most <= len(chosen):
            break
    return np.sort(chosen)


def write_ply(path: str | os.PathLike, properties: Mapping[str, np.ndarray]) -> None:
    """Writes a binary PLY file (Turk 1994) with the element "vertex".

    Args:
        path: of the file.
        properties: arrays [N] by name, in the file's order; floating-point numbers as float, uint8 as uchar.
    """
    kinds = {name: _TYPES[np.asarray(values).dtype.kind] for name, values in properties.items()}
    count = len(next(iter(properties.values())))
    rows = np.empty(count, [(name, kind) for name, (_, kind) in kinds.items()])
    for name, values in properties.items():
        rows[name] = values
    lines = [f"property {kind} {name}" for name, (kind, _) in kinds.items()]
    header = "\n".join(["ply", "format binary_little_endian 1.0", f"element vertex {count}", *lines, "end_header\n"])
    with open(path, "wb") as file:
        file.write(header.encode("ascii"))
        file.write(rows.tobytes())
