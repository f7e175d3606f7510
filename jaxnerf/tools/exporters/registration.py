"""The exporters that `jaxnerf-export --kind` selects by name, and the function that adds one."""

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

from jaxnerf.options import Options
from jaxnerf.registry import Registry, checked_options
from jaxnerf.tools.exporters.options import (
    CamerasOptions,
    ExportOptions,
    MeshOptions,
    PointsOptions,
    SplatsOptions,
    SurfaceOptions,
    WebOptions,
)


class Exporter(NamedTuple):
    """A way to export a trained run.

    Attributes:
        export: (ExportSource, folder) -> None.
        check: raises a ValueError for a TrainedRun that cannot be exported; None: all can.
        options: the class of `ExportSource.settings`.
        is_absolute: whether what it writes is relative to the origin of the dataset's files, however far away that is.
    """

    export: Callable[..., None]
    check: Callable[..., Any] | None = None
    options: type[Options] = SurfaceOptions
    is_absolute: bool = False


def _on_demand(module, name):
    """Returns a function of the package's exporters whose module is imported when it is called."""
    return lambda *args: getattr(importlib.import_module(f"jaxnerf.tools.exporters.{module}"), name)(*args)


EXPORTERS = Registry(
    "exporter",
    "jaxnerf.register_exporter",
    {
        "mesh": Exporter(_on_demand("mesh", "export_mesh"), options=MeshOptions),
        "points": Exporter(_on_demand("points", "export_points"), options=PointsOptions),
        "depth": Exporter(_on_demand("depth", "export_depth"), options=ExportOptions),
        "splats": Exporter(_on_demand("splats", "export_splats"), options=SplatsOptions),
        "cameras": Exporter(
            _on_demand("cameras", "export_cameras"), _on_demand("cameras", "check_refined"), CamerasOptions, True
        ),
        "web": Exporter(_on_demand("web", "export_web"), _on_demand("web", "network_of"), WebOptions),
    },
)


def register_exporter(
    name: str,
    export: Callable[..., Any],
    *,
    check: Callable[..., Any] | None = None,
    options: type[Options] | None = None,
) -> None:
    """Registers a way to export a trained run under a name for `jaxnerf-export --kind`.

    Args:
        name: of the exporter.
        export: (source: ExportSource, folder: Path) -> None, see `jaxnerf.extend.ExportSource`. It writes files
            into the folder, which is moved into place when it returns.
        check: (run: TrainedRun) -> anything; raises a ValueError that says why the run cannot be exported. It is called
            before anything is computed, and for a run without a grid before one is extracted. None: all runs can be.
        options: the class of `source.settings`, see `jaxnerf.extend.Options`: each option is a flag of jaxnerf-export,
            with checks and help. None: those that the exporters of surfaces have in common, see `SurfaceOptions`.

    Raises:
        ValueError: if another exporter has that name, or if `options` is no such class.
    """
    EXPORTERS.add(name, Exporter(export, check, checked_options("register_exporter", options) or SurfaceOptions))
