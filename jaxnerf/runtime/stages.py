"""Says on stderr what a program is doing, and how far it is, while that takes long."""

import contextlib
import sys
import threading
import time
from collections.abc import Iterator

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

    A terminal shows one line, which disappears in the end; a log file gets a line each time. Of stages within stages
    the innermost is shown. Nothing is shown unless the program has called `show`.

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
                sys.stderr.write(f"\r\033[K{current.line()}" if wrote else current.line() + "\n")
                sys.stderr.flush()
        if wrote:
            sys.stderr.write("\r\033[K")
            sys.stderr.flush()

    _running.append(current)
    thread = threading.Thread(target=report, name="stage", daemon=True)
    thread.start()
    try:
        yield current
    finally:
        _running.remove(current)
        ended.set()
        thread.join()
