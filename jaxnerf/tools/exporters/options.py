"""The options of the built-in exporters, from which the flags of jaxnerf-export are derived.

They are apart from the exporters, whose libraries take seconds to import or may be missing, while flags and help need
the options alone. An exporter outside the package declares its own beside its function.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxnerf.data.geometry.poses import AXES
from jaxnerf.options import Box, Options, Range, between, is_auto, option, replaced

_PIXELS_PER_VOXEL = 1.25


def _wrong_box(box):
    if len(box) == 6 and np.isfinite(box).all() and (np.subtract(box[3:], box[:3]) > 0).all():
        return None
    return "six numbers X0,Y0,Z0,X1,Y1,Z1 in units of the dataset's files, each lower one below its upper one"


@dataclasses.dataclass(frozen=True)
class ExportOptions(Options):
    """What `surfaces.render_depth_images` and `surfaces.export_box` read; the options of the exporter "depth"."""

    box: tuple[float, ...] = option(
        "auto",
        "the box to export as X0,Y0,Z0,X1,Y1,Z1 in units of the dataset's files. auto: it holds all surfaces, or in an "
        "unbounded scene those between the cameras",
        auto=True,
        check=_wrong_box,
    )
    size: int = option(
        "auto",
        "the longer side in px of the depth images from which everything is made. auto: it is the resolution for a "
        "mesh, 1.25 times the resolution for points, and for depth that of the dataset's images",
        range=between(16, 4096),
        auto=True,
    )
    num_views: int = option(
        100,
        "the largest number of training views to render. For a mesh of a bounded scene half as many views from all "
        "around are added",
        range=between(1, 100_000),
    )

    @property
    def corners(self) -> Float[np.ndarray, "2 3"] | None:
        """The lower and the upper corner of the box; None where it is not given."""
        return None if is_auto(self.box) else np.float64(self.box).reshape(2, 3)

    def relative_to(self, origin: Sequence[float]) -> "ExportOptions":
        """Returns the options with a box relative to an origin, as positions are; see `Views.file_origin`."""
        corners = self.corners
        return self if corners is None else replaced(self, box=tuple((corners - origin).reshape(-1).tolist()))


@dataclasses.dataclass(frozen=True)
class SurfaceOptions(ExportOptions):
    """The options of exporters of surfaces, and of a registered exporter without options of its own."""

    resolution: int = option(256, "the voxels along the longest side of the box", range=between(16, 1024))

    @property
    def image_size(self) -> int:
        """The longer side of the depth images of points and splats, px."""
        return round(_PIXELS_PER_VOXEL * self.resolution) if is_auto(self.size) else self.size


@dataclasses.dataclass(frozen=True)
class MeshOptions(SurfaceOptions):
    """The options of the exporter "mesh"."""

    format: str = option("ply", "ply, glb or obj", choices=("ply", "glb", "obj"))
    up: str = option(
        "auto",
        "the axis of the dataset's files that is up in a glb, such as +z. auto: that of `data.up`, or as the cameras "
        "are held",
        choices=AXES,
        auto=True,
    )
    max_faces: int = option(
        0,
        "the number of triangles to which it is decimated; 0: it is not, or with a texture to 30,000",
        range=between(0, 10**9),
    )
    texture: int = option(
        0,
        "the side of a texture in px, which replaces the colours of vertices, of a glb or an obj; 0: off",
        range=Range("from 64 to 8,192, or 0", lambda size: size == 0 or 64 <= size <= 8192),
    )
    closed: bool = option(
        False,
        "whether to close holes: with the surfaces that the field happens to hold where no training view looks, and "
        "else as if what is not seen were solid",
    )
    min_piece: float = option(
        0.005, "connected pieces with fewer triangles than this fraction of all are dropped", range=between(0, 1)
    )

    def check(self, box: Box | None = None) -> None:
        if self.texture and self.format == "ply":
            raise ValueError(
                f"texture is {self.texture} and format is 'ply', expected 'glb' or 'obj'; give --format=glb or drop it"
            )


@dataclasses.dataclass(frozen=True)
class PointsOptions(SurfaceOptions):
    """The options of the exporter "points"."""

    num_points: int = option(200_000, "the largest number of points", range=between(1, 10_000_000))


@dataclasses.dataclass(frozen=True)
class SplatsOptions(SurfaceOptions):
    """The options of the exporter "splats"."""

    num_points: int = option(60_000, "the largest number of Gaussians", range=between(1, 10_000_000))
    fit_steps: int = option(
        400,
        "steps of fitting them to images of the field; 0: they stay as they are placed",
        range=between(0, 1_000_000),
    )


@dataclasses.dataclass(frozen=True)
class WebOptions(Options):
    """The options of the exporter "web"."""

    split: bool = option(False, "whether the scene's data is in a file beside the page, for hosting")


@dataclasses.dataclass(frozen=True)
class CamerasOptions(Options):
    """The options of the exporter "cameras": none."""
