"""The scripts under experiments/ as modules."""

import importlib
import sys

from absl import flags

from runs import ROOT

if str(ROOT / "experiments") not in sys.path:
    sys.path.insert(0, str(ROOT / "experiments"))


def study(name):
    """Returns experiments/<name>.py, without its flags: studies have flags of the same names."""
    module = importlib.import_module(name)
    for flag in tuple(flags.FLAGS.flags_by_module_dict().get(name, ())):
        delattr(flags.FLAGS, flag.name)
    return module
