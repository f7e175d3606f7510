"""TensorBoard's events of a run, where tensorboardX is installed."""

import pathlib
import sys
import time


class Events:
    """A file of scalars. Failing to write it ends no training: metrics.jsonl has all that it has."""

    def __init__(self, workdir, *, first_step):
        """Opens a new file, before which TensorBoard shows nothing past first_step."""
        self._folder, self._writer = pathlib.Path(workdir) / "tensorboard", None
        try:
            # Its SummaryWriter writes from a thread, and waits for it without an end once the disk is full.
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

    def append(self, row):
        """Adds the numbers of a row, which has a step."""

        def add():
            from tensorboardX.summary import scalar

            for name, value in row.items():
                self._write(row["step"], summary=scalar(name, value))
            self._writer.flush()

        if self._writer is not None:
            self._try(add)

    def close(self):
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
            why = f"no more events are written ({error.strerror}), metrics.jsonl has them all"
            print(f"{self._folder}: {why}", file=sys.stderr)
