"""Prepares a program of this package for the import of libraries; in other programs it has no effect.

It is imported before everything else. `python -m` searches the working folder first, which may be a stranger's: it is
dropped, unless this package lies there; --plugins adds it at the end. Ctrl-C ends the program without a traceback while
jax is imported, which takes a second or more, as `signals` does later; so does a package that cannot be imported.
"""

import os
import sys

_program = "".join(sys.argv[:1])
# While `python -m` imports the packages of a module, it is "-m"; the option may be -um or without a space.
_command = " ".join(sys.orig_argv[1:])
_by_module = _program == "-m" and ("m jaxnerf." in _command or "mjaxnerf." in _command)
if _by_module and not sys.flags.safe_path and not __file__.startswith(os.path.join(sys.path[0], "")):
    del sys.path[0]
if _by_module or os.path.basename(_program).startswith("jaxnerf-"):
    import signal

    from jaxnerf.runtime import failed_imports

    sys.excepthook = failed_imports.show
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
