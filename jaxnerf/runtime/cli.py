"""What the command line programs share: errors of a user's making take one line and no traceback."""

import ctypes
import gc
import signal
import sys
import warnings

from absl import app, flags, logging

FORMATS = ("blender", "transforms", "colmap", "llff")


def run(main, *, positional=False, stopped="before there was anything to save; the same command starts again"):
    """Parses flags and runs main(argv); exits 2 on a wrong flag and 1 on bad input, each with one line.

    positional: whether arguments without a flag are taken, as argv[1:].
    stopped: what Ctrl-C or SIGTERM left behind, and what to do.
    """
    _keep_memory()
    # Tracing a step makes hundreds of thousands of objects, hardly any in cycles: looking for those every 700
    # objects, as Python does, takes a good part of its time.
    gc.set_threshold(50_000)
    signal.signal(signal.SIGTERM, _interrupt)
    app.run(_without_traceback(main, positional, stopped), flags_parser=_parse)


def use_data(config, data_dir, format=None):
    """Lets --data_dir override the scene's folder, and --format what is read there."""
    if data_dir:
        config.data.dir = data_dir
        if config.data.format == "synthetic":  # which has no folder: what is there counts
            config.data.format = "auto"
    if format:
        config.data.format = format
    return config


def define_count(name, help):
    """Defines a flag that is "auto", which gives 0, or a whole number of at least 1; None when not given."""
    return flags.DEFINE(_Count(), name, None, help)


class _Count(flags.ArgumentParser):
    syntactic_help = "auto, or a whole number of at least 1"

    def parse(self, argument):
        if argument == "auto":
            return 0
        if not str(argument).isdecimal() or int(argument) < 1:
            raise ValueError(f"wanted {self.syntactic_help}")
        return int(argument)


def _keep_memory():
    """Lets freed memory stay with the process, where the C library is glibc.

    It gives blocks of 32 MiB and more back at once. A step on a CPU takes one such block for its
    activations, and would fault in each page of it anew, which can take as long as the step itself.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt:
        mallopt(-4, 0)  # M_MMAP_MAX: no block apart from the others
        mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD
        mallopt(-2, 2**28)  # M_TOP_PAD, without which what other threads free is given back still


def _parse(argv):
    try:
        rest = flags.FLAGS(argv)
        if not flags.FLAGS["verbosity"].present:
            logging.set_verbosity(logging.FATAL)  # orbax tells of every file it touches
        return rest
    except AttributeError as error:
        _leave(2, f"the configuration has no such field ({error}); configs/default.py lists them all")
    except (
        flags.Error,
        KeyError,
        TypeError,
        ValueError,
        OSError,
        ImportError,
        SyntaxError,
        NameError,
    ) as error:
        _leave(2, error)


def _without_traceback(main, positional, stopped):
    def wrapped(argv):
        try:
            if len(argv) > 1 and not positional:
                raise ValueError(f"unexpected argument {argv[1]!r}; flags look like --name=value")
            from jaxnerf.runtime.compilation_cache import (
                use_compilation_cache,  # after the flags: a wrong one is said at once
            )

            use_compilation_cache()
            return main(argv)
        except (ValueError, OSError) as error:
            _leave(1, error)
        except KeyboardInterrupt as interrupt:
            _leave(128 + (interrupt.args or (signal.SIGINT,))[0], f"stopped {stopped}")

    return wrapped


def _interrupt(number, _):
    """Lets SIGTERM clean up as Ctrl-C does."""
    raise KeyboardInterrupt(number)


def _leave(code, error):
    line = " ".join(str(error).split())
    print(f"error: {line}", file=sys.stderr)
    # What was under way fails while it is torn down, as on a full disk, and has nothing to add.
    sys.unraisablehook = lambda _: None
    warnings.simplefilter("ignore")
    sys.exit(code)
