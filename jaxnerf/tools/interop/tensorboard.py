"""The event file of a run, beside its metrics.jsonl."""

import os
import pathlib
import sys
import time
from collections.abc import Mapping
from typing import Any


class EventFile:
    """An event file for TensorBoard where tensorboardX is installed; an error in writing it only prints a line."""

    def __init__(self, workdir: str | os.PathLike, *, first_step: int):
        """Opens a new file; TensorBoard ignores what earlier files hold after first_step."""
        self._folder, self._writer = pathlib.Path(workdir) / "tensorboard", None
        try:
            # Not SummaryWriter: it writes from a thread, and waits forever for it once the disk is full.
            from tensorboardX.event_file_writer import EventsWriter
            from tensorboardX.proto.event_pb2 import SessionLog
        except ImportError:
            return

        def begin():
            self._folder.mkdir(parents=True, exist_ok=True)
            self._writer = EventsWriter(str(self._folder / "events"))
            self._write(first_step, file_version="brain.Event:2")
            self._write(first_step, session_log=SessionLog(status=SessionLog.START))

        self._try(begin)

    def append(self, row: Mapping[str, Any]) -> None:
        """Adds the numbers of a row."""

        def add():
            from tensorboardX.summary import scalar

            for name, value in row.items():
                self._write(row["step"], summary=scalar(name, value))
            self._writer.flush()

        if self._writer is not None:
            self._try(add)

    def close(self) -> None:
        """Ends the file."""
        if self._writer is not None:
            self._try(self._writer.close)

    def _write(self, step, **content):
        from tensorboardX.proto.event_pb2 import Event

        self._writer.write_event(Event(step=step, wall_time=time.time(), **content))

    def _try(self, write):
        try:
            write()
        except OSError as error:
            self._writer = None
            why = f"event files end here ({error.strerror}); metrics.jsonl holds all metrics"
            print(f"{self._folder}: {why}", file=sys.stderr)
