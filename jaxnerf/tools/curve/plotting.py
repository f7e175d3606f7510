"""Matplotlib, imported without the matplotlibrc of the working folder.

Matplotlib prefers that file to the user's own settings. It can hold what fails, starts LaTeX or names a module to
import, and the working folder may be a stranger's. MATPLOTLIBRC and the user's own file count as usual.
"""

import contextlib
import os

if os.environ.get("MATPLOTLIBRC"):
    os.environ["MATPLOTLIBRC"] = os.path.abspath(os.environ["MATPLOTLIBRC"])
with contextlib.chdir(os.path.dirname(__file__)):
    from matplotlib.collections import LineCollection as LineCollection
    from matplotlib.figure import Figure as Figure
