"""What a program says where a package that it needs cannot be imported, as where versions do not fit."""

import re
import sys
import traceback
from importlib import metadata
from typing import Any


def reason(error: BaseException) -> str | None:
    """Returns one line about an error in the import of an installed package; None for any other error.

    An error of a module of the user, such as a config file, is another one.
    """
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__) if frame.f_code.co_name == "<module>"]
    package = str(frames[-1].f_globals.get("__name__") if frames else "").partition(".")[0]
    found = metadata.packages_distributions()
    if package not in found and package != "jaxnerf":
        return None
    if isinstance(error, ImportError) and error.name:
        package = error.name.partition(".")[0]
    text = " ".join(str(error).split())
    project = found.get(package, [package])[0]
    return (
        f"{package} cannot be imported ({type(error).__name__}: {text}); installed are {_versions()}; update what does "
        f"not fit: pip install -U {project}"
        + ("" if isinstance(error, ModuleNotFoundError) or project == "jax" else " jax")
    )


def _versions():
    needed = [re.split(r"[^\w-]", line)[0] for line in metadata.requires("jaxnerf") or () if "extra ==" not in line]
    return ", ".join(f"{name} {_version(name)}" for name in needed)


def _version(name):
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "(missing)"


def show(kind: type[BaseException], error: BaseException, trace: Any) -> None:
    """Prints an error that ends the program: one line about a failed import, otherwise its traceback."""
    line = reason(error)
    if line is None:
        sys.__excepthook__(kind, error, trace)
    else:
        print(f"error: {line}", file=sys.stderr)
