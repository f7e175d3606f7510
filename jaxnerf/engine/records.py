"""What a run says of itself: metrics.jsonl, TensorBoard events, and a line or a bar on the terminal."""

import json
import logging
import pathlib
import sys

from jaxnerf.engine.workdir import write_text


class Records:
    """The metrics of a run, a JSON object a line, ascending in step."""

    def __init__(self, workdir, *, first_step, write=True):
        """Opens the file to append; what lies past first_step, or was cut mid-line, is dropped.

        write: False keeps rows in memory only, as of several processes one writes.
        """
        self._path = pathlib.Path(workdir) / "metrics.jsonl"
        self.rows = [row for row in read_rows(workdir) if row["step"] <= first_step]
        self._write, self._events = write, None
        if not write:
            return
        write_text(self._path, "".join(json.dumps(row) + "\n" for row in self.rows))
        try:
            from tensorboardX import SummaryWriter
        except ImportError:
            pass
        else:
            self._events = SummaryWriter(str(pathlib.Path(workdir) / "tensorboard"), purge_step=first_step)

    def append(self, row):
        """Adds a row: step and other numbers. NaN and infinity are written as JSON knows them in Python."""
        self.rows.append(row)
        if not self._write:
            return
        with self._path.open("a") as file:
            file.write(json.dumps(row) + "\n")
        if self._events is not None:
            for name, value in row.items():
                self._events.add_scalar(name, value, row["step"])

    def close(self):
        if self._events is not None:
            self._events.close()


def read_rows(workdir):
    """Returns the whole rows of a workdir's metrics; a last line cut short is left out."""
    path = pathlib.Path(workdir) / "metrics.jsonl"
    rows = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            rows.append(json.loads(line))
        except ValueError:
            logging.warning("%s: left out a line that was cut short", path)
    return rows


class Progress:
    """A bar that stays in place on a terminal, and plain lines in a log file."""

    def __init__(self, total, stream=sys.stderr, show=True):
        self._total, self._stream, self._shown = total, stream, show
        self._terminal = show and stream.isatty()

    def show(self, done, text):
        """Shows how many of the total steps are done, and a text of the moment."""
        if not self._shown:
            return
        share = min(done / self._total, 1.0)
        if self._terminal:
            bar = "#" * int(24 * share)
            self._stream.write(f"\r\033[K[{bar:<24}] {100 * share:3.0f} %  {text}")
        else:
            self._stream.write(f"{done}/{self._total}  {text}\n")
        self._stream.flush()

    def close(self):
        if self._terminal:
            self._stream.write("\n")
