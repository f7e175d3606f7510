"""The scripts under experiments/ as modules."""

import importlib
from types import ModuleType

import common  # noqa: F401  before `study` removes flags: --page stays
from absl import flags


def study(name: str) -> ModuleType:
    """Imports experiments/<name>.py without its flags: studies have flags of the same names."""
    known = set(flags.FLAGS)
    module = importlib.import_module(name.replace("/", "."))
    for flag in set(flags.FLAGS) - known:
        delattr(flags.FLAGS, flag)
    return module
