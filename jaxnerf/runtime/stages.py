"""Says on stderr what a program is doing, and how far it is.

Twice a second a thread looks at the stages that are running. On a terminal it rewrites one line. A log file gets a line
for each stage that lasts, and another for each further minute.
"""

import contextlib
import math
import shutil
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

from jaxnerf.runtime.printed_text import printable

_EVERY = 0.5  # seconds between lines of a terminal
_FIRST, _AGAIN = 4.0, 60.0  # seconds after which a log file gets a stage's line, and the next one
_now, _cpu, _spent = time.monotonic, time.process_time, 0.0
_shown = False  # whether a program has asked for it: who imports the functions gets no output
running: list["Stage"] = []  # each within the one before
_said: dict[str, float] = {}  # when a log file got the line of a stage
_lock = threading.RLock()  # held while something is written
_replaceable = _unfinished = False  # whether the terminal's last line shows a stage, or is other text without its end


class Stage:
    """A stage of a program's work, for a `with` statement. Of stages within stages the line shows all."""

    shown, unsaid = True, False  # whether it is shown; whether it has a result that no line has kept

    def __init__(self, text: str):
        """Takes what is done, such as "reading images"."""
        self.name, self.text, self.started = text, text, _now()
        self.done, self._total = 0, 0

    def __enter__(self) -> Any:
        self.started = _now()
        running.append(self)
        return self

    def __exit__(self, *_) -> None:
        running.remove(self)
        _between.started = _now()

    def update(self, done: int, total: int) -> None:
        """Records how much of the stage is done, for the next line."""
        self.done, self._total = done, total

    def part(self, seconds: str = "") -> str:
        """Returns what the stage does and how far it is."""
        done = f", {self.done:,} of {self._total:,} done" if self._total else ""
        return f"{self.text}{seconds}{done}"

    def head(self) -> str:
        """Returns how the line begins if no other stage contains this one."""
        return "working       " + self.part(f" for {_now() - self.started:.0f} s")


class Progress(Stage):
    """A stage of steps that have results: a bar on a terminal, where the last result stays."""

    def __init__(self, text: str, steps: int | None, shown: bool = True):
        """Takes what is said until there is a result, the number of steps if it is known, and whether to show it."""
        super().__init__(text)
        self._steps, self.shown, self._fraction = steps, shown, 0.0

    def __exit__(self, *error) -> None:
        super().__exit__(*error)
        if self.unsaid:
            _write([self], stays=True)

    def show(self, done: int, text: str, fraction: float | None = None) -> None:
        """Shows the result of a step as text; fraction: how much of the work is done, if not that of the steps."""
        self.done, self.text, self.unsaid = done, text, self.shown
        self._fraction = min(done / self._steps if fraction is None else fraction, 1.0)
        if self.shown and (sys.stderr.isatty() or _is_due([self])):
            _write([self])

    def head(self) -> str:
        text = f"{self.done}/{self._steps}  {self.text}" if self._steps else f"{self.done}  {self.text}"
        bar = f"[{'#' * int(24 * self._fraction):<24}] {100 * self._fraction:3.0f} %  "
        return bar + text if sys.stderr.isatty() and len(bar + text) < shutil.get_terminal_size().columns else text


_between = Stage("preparing")  # what a program does outside of its stages
stage = Stage


def show(shown: bool = True) -> None:
    """Sets whether the stages of this process are shown."""
    global _shown
    begins, _shown = shown and not _shown, shown
    if begins:
        _between.started = _now()
        threading.Thread(target=_watch, name="stages", daemon=True).start()
    with room():  # without the last line
        pass


@contextlib.contextmanager
def room(text: str = "\n") -> Iterator[None]:
    """Clears the line of the terminal that shows a stage, for a text that is written before the next such line."""
    global _replaceable, _unfinished
    with _lock:
        if _replaceable:
            _replaceable = False
            getattr(sys.stderr, "write_as_is", sys.stderr.write)("\r\033[K")
            sys.stderr.flush()
        _unfinished = not text.endswith("\n") if text else _unfinished
        yield


def tick() -> None:
    """Writes the line about the stages that are running, if it is due."""
    global _spent
    stages, before, _spent = running[:] or [_between], _spent, _cpu()
    if stages[0] is _between and _spent - before < 0.05 * _EVERY:  # the program waits for something
        _between.started = _now()
        return
    if not stages[0].shown:
        return
    if not sys.stderr.isatty():
        stages = stages[:1] if isinstance(stages[0], Progress) else stages  # its results are enough
        stages = [each for each in stages if _now() - each.started >= (_AGAIN if each is _between else _FIRST)]
        if not stages or not _is_due(stages):
            return
    _write(stages)


def _watch():
    while _shown:
        time.sleep(_EVERY)
        if _shown:
            tick()


def _is_due(stages: Sequence[Stage]) -> bool:
    """Returns whether a log file gets a line about stages within each other; it then counts as written."""
    name = ": ".join(each.name for each in stages)
    if _now() - _said.get(name, -math.inf) < _AGAIN:
        return False
    _said[name] = _now()
    return True


def _write(stages, *, stays=False):
    """Writes the line about stages within each other. On a terminal the next one replaces it, unless it stays."""
    global _replaceable, _unfinished
    replaceable = sys.stderr.isatty() and not stays
    line = ": ".join([stages[0].head(), *(each.part() for each in stages[1:])])
    line = printable(line)[: shutil.get_terminal_size().columns - 1] if replaceable else line + "\n"
    with _lock:
        if not (_unfinished and replaceable):
            with room():
                sys.stderr.write(line)
                sys.stderr.flush()
                _replaceable, _unfinished = replaceable, False
                stages[0].unsaid &= replaceable
