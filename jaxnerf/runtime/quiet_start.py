"""Prepares a program of this package for the import of libraries; in other programs it has no effect.

It is imported before everything else. `python -m` searches the working folder first, which may be a stranger's: it is
dropped, unless this package lies there; --plugins adds it at the end. Ctrl-C ends the program without a traceback while
jax is imported, which takes a second or more, as `signals` does later; so does a package that cannot be imported.
"""

import os
import sys

# While `python -m` imports the packages of a module, argv[0] is "-m".
_by_module = sys.argv[0] == "-m" and sys.orig_argv[sys.orig_argv.index("-m") + 1].startswith("jaxnerf.")
_folder = os.path.join(sys.path[0], "")
if _by_module and not sys.flags.safe_path and not __file__.startswith(_folder):
    del sys.path[0]
if _by_module or os.path.basename(sys.argv[0]).startswith("jaxnerf-"):
    import signal

    from jaxnerf.runtime import failed_imports

    sys.excepthook = failed_imports.show
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
