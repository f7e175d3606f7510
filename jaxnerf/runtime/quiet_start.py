"""Lets Ctrl-C end a program of this package without a traceback while it imports libraries; `signals` does so later.

It is imported before jax, whose import takes a second or more, and has no effect where another program imports the
package.
"""

import re
import signal
import sys

if re.match(r"-m jaxnerf\.|\S*\bjaxnerf-\w+( |$)", " ".join(sys.orig_argv[1:3])):
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
