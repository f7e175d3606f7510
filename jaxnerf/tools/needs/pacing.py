"""Seconds that mean the same all the time on a machine that other programs use, too.

Other programs slow a training step down by a third, also in CPU time, as they use the caches and the memory. A trial
therefore takes a few steps of the complete model in between, about every half second, and its own time is divided by
how much slower than at first these were.
"""

import pathlib
import statistics
from collections.abc import Callable

from jaxnerf.runtime.atomic_files import read_json, write_text

_BLOCK, _PROBE = 0.5, 0.08  # seconds between probes, and of a probe
_FIRST_PROBES = 8


class Pacer:
    """Measures how fast the machine is now, over how fast it was when a study began.

    Attributes:
        nominal: seconds of a step of the complete model when the study began.
    """

    def __init__(self, take: Callable[[int], None], clock: Callable[[], float], file: pathlib.Path | None = None):
        """Measures the nominal seconds, or reads them from the file of an earlier start.

        Args:
            take: takes so many steps of the complete model, and waits for them.
            clock: () -> seconds.
            file: that holds the nominal seconds; None: they are not kept.
        """
        self._take, self._clock = take, clock
        take(2)  # the first ones are slower
        if file is not None and file.exists():
            self.nominal = float(read_json(file, "remove the folder, or give another --out")["seconds_per_step"])
            return
        self.nominal = self._seconds(2)
        self.nominal = statistics.median(self._seconds(self._count) for _ in range(_FIRST_PROBES))
        if file is not None:
            write_text(file, f'{{"seconds_per_step": {self.nominal!r}}}\n')

    @property
    def _count(self):
        return max(round(_PROBE / self.nominal), 1)

    def _seconds(self, count):
        began = self._clock()
        self._take(count)
        return (self._clock() - began) / count

    def speed(self) -> float:
        """Returns the speed of the machine now, 1 as at first."""
        return self.nominal / max(self._seconds(self._count), 1e-9)


class PacedClock:
    """The seconds of a trial, at the nominal speed of the machine."""

    def __init__(self, clock: Callable[[], float], pacer: Pacer | None):
        """Starts; pacer: None counts the seconds of the clock."""
        self._clock, self._pacer = clock, pacer
        self._speed = pacer.speed() if pacer else 1.0
        self._total, self._since = 0.0, clock()

    def seconds(self) -> float:
        """Returns the seconds so far."""
        return self._total + (self._clock() - self._since) * self._speed

    def probe(self) -> None:
        """Measures the speed if that is due; call it when no step is running."""
        own = self._clock() - self._since
        if self._pacer is None or own < _BLOCK:
            return
        # The seconds so far stay: if they jumped, a trial could end before its learning rate is low.
        self._total += own * self._speed
        self._speed, self._since = self._pacer.speed(), self._clock()
