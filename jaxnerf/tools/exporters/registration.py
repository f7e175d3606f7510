"""The exporters that `jaxnerf-export --kind` selects by name, and the function that adds one."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxnerf.registry import Registry


class Exporter(NamedTuple):
    """A way to export a trained run.

    Attributes:
        export: (ExportSource, folder) -> None.
        check: raises a ValueError for a TrainedRun that cannot be exported; None: all can.
    """

    export: Callable[..., None]
    check: Callable[..., Any] | None = None


EXPORTERS = Registry(
    "exporter",
    "jaxnerf.register_exporter",
    {name: f"jaxnerf.tools.exporters.{name}:EXPORTER" for name in ("mesh", "points", "depth", "splats", "web")},
)


def register_exporter(name: str, export: Callable[..., Any], *, check: Callable[..., Any] | None = None) -> None:
    """Registers a way to export a trained run under a name for `jaxnerf-export --kind`.

    Args:
        name: of the exporter.
        export: (source: ExportSource, folder: Path) -> None, see `jaxnerf.extend.ExportSource`. It writes files
            into the folder, which is moved into place when it returns.
        check: (run: TrainedRun) -> anything; raises a ValueError that says why the run cannot be exported. It is called
            before anything is computed, and for a run without a grid before one is extracted. None: all runs can be.

    Raises:
        ValueError: if another exporter has that name.
    """
    EXPORTERS.add(name, Exporter(export, check))
