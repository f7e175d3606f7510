"""How a program stops: signals, a second signal, and a terminal or a reader of its output that goes away.

SIGHUP says that the terminal has been closed. A program whose output nobody reads any more stops in the same way.
"""

import errno
import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable
from typing import Any, TextIO

from jaxnerf.runtime import stages
from jaxnerf.runtime.printed_text import printable

_GONE = (errno.EPIPE, errno.EIO, errno.EBADF)  # what writing to a closed pipe, terminal or file raises
_HANGUP = getattr(signal, "SIGHUP", signal.SIGTERM)  # Windows has no SIGHUP
_stopping = False  # whether a first signal has been received


def handle(handler: Callable) -> dict[int, Any]:
    """Sets the handler of all signals that stop a program, and returns the old ones.

    SIGHUP stays ignored where it is, as nohup expects. Only the main thread may set handlers; in others this does
    nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    numbers = {signal.SIGINT, signal.SIGTERM}
    if signal.getsignal(_HANGUP) is not signal.SIG_IGN:
        numbers.add(_HANGUP)
    return {number: signal.signal(number, handler) for number in numbers}


def interrupt(number: int, _: Any) -> None:
    """Raises KeyboardInterrupt(number), a handler; another signal ends the process at once, without a traceback."""
    global _stopping
    _stopping = True
    handle(lambda number, _: os._exit(128 + number))
    sys.unraisablehook = _raise_again
    raise KeyboardInterrupt(number)


def _raise_again(ignored):
    """Repeats an interrupt that has reached a callback of the garbage collector, where Python ignores exceptions."""
    if ignored.exc_type is KeyboardInterrupt:
        handle(interrupt)
        threading.Timer(0.01, os.kill, (os.getpid(), ignored.exc_value.args[0])).start()


class Interrupt:
    """Turns the first signal into the flag `caught`; a second one ends the program as usual.

    A SIGHUP that follows the first signal has no effect: a terminal that closes can send several.
    """

    def __enter__(self) -> Any:
        self.caught = False
        self._old = handle(self._catch)
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _catch(self, *_):
        global _stopping
        _stopping = self.caught = True
        self.__exit__()
        if _HANGUP in self._old:
            signal.signal(_HANGUP, lambda *_: None)


class _Output:
    """A stream of text that is made `printable`, and discarded after its reader has gone.

    The first write that fails stops the program as SIGHUP does, unless a signal is already stopping it: Ctrl-C also
    ends the other programs of a pipeline. Messages that a full disk cannot hold are discarded, too, but stop nothing.
    """

    def __init__(self, stream: TextIO, *, messages: bool = False):
        self._stream, self._messages = stream, messages

    def write(self, text: str) -> int:
        """Writes a text."""
        with stages.room(text):
            return self.write_as_is(printable(text, "\n\t"))

    def writelines(self, lines: Iterable[str]) -> None:
        """Writes several texts."""
        self.write("".join(lines))

    def write_as_is(self, text: str) -> int:
        """Writes a text of the program's own, with sequences that a terminal obeys."""
        return self._try(self._stream.write, text)

    def flush(self) -> None:
        """Writes what is still in memory."""
        self._try(self._stream.flush)

    def __getattr__(self, name):
        return getattr(self._stream, name)

    def _try(self, call, *arguments):
        try:
            return call(*arguments)
        except OSError as error:
            gone = error.errno in _GONE
            if not (gone or self._messages):
                raise
        _discard(self._stream.fileno())
        if gone and not _stopping:
            signal.raise_signal(_HANGUP)
        return call(*arguments)


def keep_streams() -> None:
    """Makes stdout and stderr usable until the program ends, also if they are closed (`2>&-`) or their reader goes."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:  # otherwise the next file that is opened would receive what libraries print
            _discard(number)
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # whatever the encoding, no character ends the program
            stream.reconfigure(errors="backslashreplace")
    sys.stdout, sys.stderr = _Output(sys.stdout), _Output(sys.stderr, messages=True)


def output(number: int) -> TextIO:
    """Returns a stream that writes messages to a file descriptor; a reader that goes away stops the program once."""
    return _Output(open(number, "w", buffering=1, errors="backslashreplace", closefd=False), messages=True)


def _discard(number):
    """Makes a file descriptor lead nowhere."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    if nowhere != number:
        os.dup2(nowhere, number)
        os.close(nowhere)
