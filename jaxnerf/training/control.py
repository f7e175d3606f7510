"""How long a run has trained, and whether it was asked to stop."""

import contextlib
import signal
import threading
import time


class Clock:
    """Seconds of training, without compilation and saving, counted on from an earlier start."""

    def __init__(self, seconds, rays):
        self._started = time.perf_counter() - seconds
        self._last = (seconds, rays)

    def seconds(self):
        return time.perf_counter() - self._started

    def rate(self, rays):
        """Returns rays a second since the last call."""
        (seconds, before), self._last = self._last, (self.seconds(), rays)
        return (rays - before) / max(self._last[0] - seconds, 1e-9)

    @contextlib.contextmanager
    def paused(self):
        entered = time.perf_counter()
        yield
        self._started += time.perf_counter() - entered


class Interrupt:
    """Turns the first Ctrl-C or SIGTERM into a flag; a second one ends the program as usual."""

    def __enter__(self):
        self.caught = False
        self._old = {}
        if threading.current_thread() is threading.main_thread():  # elsewhere signals are not ours
            self._old = {number: signal.signal(number, self._catch) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_):
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _catch(self, *_):
        self.caught = True
        self.__exit__()
