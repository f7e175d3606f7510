"""What a program says where a package that it needs cannot be imported, as where versions do not fit."""

import re
import sys
import traceback
from importlib import metadata
from typing import Any


def reason(error: BaseException) -> str | None:
    """Returns one line about an error in the import of an installed package; None for others, as of a config file."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__) if frame.f_code.co_name == "<module>"]
    package = str(frames[-1].f_globals.get("__name__") if frames else "").partition(".")[0]
    found, missing = metadata.packages_distributions(), isinstance(error, ModuleNotFoundError)
    if package not in found and package != "jaxnerf":
        return None
    if isinstance(error, ImportError) and error.name:
        package = error.name.partition(".")[0]
    project = found.get(package, [package])[0]
    needed = [re.split(r"[^\w-]", line)[0] for line in metadata.requires("jaxnerf") or () if "extra ==" not in line]
    versions = ", ".join(f"{each} {''.join(_versions(each)) or '(missing)'}" for each in needed)
    update = project if missing or project == "jax" else f"{project} jax"
    return (
        f"{package} cannot be imported ({type(error).__name__}: {' '.join(str(error).split())}); installed are "
        f"{versions}; update what does not fit: pip install -U {update}"
    )


def _versions(project):
    return [each.version for each in metadata.distributions(name=project)][:1]


def show(kind: type[BaseException], error: BaseException, trace: Any) -> None:
    """Prints an error that ends the program: one line about a failed import, otherwise its traceback."""
    line = reason(error)
    print(f"error: {line}", file=sys.stderr) if line else sys.__excepthook__(kind, error, trace)
