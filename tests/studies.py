"""The scripts under experiments/ as modules."""

import importlib
import sys
from types import ModuleType

from absl import flags

from runs import ROOT

if str(ROOT / "experiments") not in sys.path:
    sys.path.append(str(ROOT / "experiments"))

import common  # noqa: F401  before `study` removes flags: --page stays


def study(name: str) -> ModuleType:
    """Imports experiments/<name>.py without its flags: studies have flags of the same names."""
    known = set(flags.FLAGS)
    module = importlib.import_module(name.replace("/", "."))
    for flag in set(flags.FLAGS) - known:
        delattr(flags.FLAGS, flag)
    return module
