"""Says on stderr what a program is doing, and how far it is.

On a terminal a line takes the place of the one before; a log file gets all of them.
"""

import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from typing import TextIO

_FIRST, _EVERY = 2.0, 4.0  # seconds after which a stage says something, and between further lines
_shown = False  # whether a program has asked for it: who imports the functions gets no output
_running: list["Stage"] = []


class Stage:
    """A stage of a program's work; see `stage`."""

    def __init__(self, text: str, note: str = ""):
        self.text, self._note, self._started = text, note, time.perf_counter()
        self._done, self._total = 0, 0

    def update(self, done: int, total: int) -> None:
        """Records how much of the stage is done, for the next line."""
        self._done, self._total = done, total

    def line(self) -> str:
        """Returns what the stage is doing, since when, and how far it is."""
        seconds = f"for {time.perf_counter() - self._started:.0f} s"
        done = f", {self._done:,} of {self._total:,} done" if self._total else ""
        return f"working       {self.text} {seconds}{done}{self._note}"


def show(shown: bool = True) -> None:
    """Sets whether the stages of this process are shown."""
    global _shown
    _shown = shown


def innermost() -> str | None:
    """Returns what the innermost stage of a program is doing; None between stages, and where nothing is shown."""
    running = _running[-1:]
    return running[0].text if running else None


@contextlib.contextmanager
def stage(text: str, note: str = "") -> Iterator[Stage]:
    """Shows a stage of work on stderr after two seconds, and again every four seconds until it ends.

    On a terminal the line disappears in the end. Of stages within stages the innermost is shown. Nothing is shown
    unless the program has called `show`.

    Args:
        text: what is done, such as "reading images".
        note: what follows the line, such as how long it took the last time.
    """
    current, ended = Stage(text, note), threading.Event()
    if not _shown:
        yield current
        return

    def report():
        wait, wrote = _FIRST, False
        while not ended.wait(wait):
            wait = _EVERY
            if _shown and _running and _running[-1] is current:
                wrote = sys.stderr.isatty()
                _write(sys.stderr, current.line())
        if wrote:
            _write(sys.stderr, "")

    _running.append(current)
    thread = threading.Thread(target=report, name="stage", daemon=True)
    thread.start()
    try:
        yield current
    finally:
        _running.remove(current)
        ended.set()
        thread.join()


class Progress:
    """Work of a known number of steps: a bar on a terminal, plain lines in a log file."""

    def __init__(self, total: int | None, stream: TextIO | None = None, show: bool = True):
        self._total, self._stream, self._shown = total, stream or sys.stderr, show
        self._terminal = show and self._stream.isatty()

    def show(self, done: int, text: str, fraction: float | None = None) -> None:
        """Shows how many of the total steps are done, followed by a text.

        Args:
            done: steps.
            text: what follows.
            fraction: which part of the work is done, if not that of the steps.
        """
        if not self._shown:
            return
        fraction = min(done / self._total if fraction is None else fraction, 1.0)
        steps = f"{done}/{self._total}" if self._total else f"{done}"
        bar = f"[{'#' * int(24 * fraction):<24}] {100 * fraction:3.0f} %"
        _write(self._stream, f"{bar if self._terminal else steps}  {text}")

    def note(self, *lines: str) -> None:
        """Prints lines of their own, above the bar."""
        for line in lines if self._shown else ():
            _write(self._stream, line, stays=True)

    def close(self) -> None:
        """Ends the line of the bar."""
        if self._terminal:
            self._stream.write("\n")


def _write(stream, line, *, stays=False):
    """Writes a line in place of the one before on a terminal; stays: whether the next one leaves it there."""
    terminal = stream.isatty()
    if terminal:
        getattr(stream, "write_as_is", stream.write)("\r\033[K")
    stream.write(line + ("" if terminal and not stays else "\n"))
    stream.flush()
