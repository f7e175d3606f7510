"""What a run says of itself: metrics.jsonl, TensorBoard events, and a line or a bar on the terminal."""

import json
import logging
import pathlib
import shutil
import sys

from jaxnerf.training.events import Events
from jaxnerf.training.workdir import naming, write_text


class MetricLog:
    """The metrics of a run, a JSON object a line, ascending in step."""

    def __init__(self, workdir, *, first_step, write=True):
        """Opens the file to append; what lies past first_step, or is no row, is dropped, the latter aloud.

        write: False keeps rows in memory only, as of several processes one writes.
        """
        self._path = pathlib.Path(workdir) / "metrics.jsonl"
        rows, damaged, cut = _parse(self._path)
        self.rows = [row for row in rows if row["step"] <= first_step]
        self._write, self._events = write, None
        if not write:
            return
        if damaged:
            kept = self._path.with_name("metrics.jsonl.damaged")
            shutil.copyfile(self._path, kept)
            lines = f"{len(damaged)} lines from line {damaged[0]} on that are no rows"
            print(f"{self._path}: left out {lines}; the file is kept as {kept.name}", file=sys.stderr)
        if cut:
            print(f"{self._path}: left out a last line that was cut short", file=sys.stderr)
        write_text(self._path, "".join(json.dumps(row) + "\n" for row in self.rows))
        self._events = Events(workdir, first_step=first_step)

    def append(self, row):
        """Adds a row: step and other numbers. NaN and infinity are written as JSON knows them in Python."""
        self.rows.append(row)
        if not self._write:
            return
        with naming(self._path), self._path.open("a") as file:
            file.write(json.dumps(row) + "\n")
        self._events.append(row)

    def close(self):
        if self._events is not None:
            self._events.close()


def read_rows(workdir):
    """Returns the whole rows of a workdir's metrics; a last line may be in writing and is left out."""
    path = pathlib.Path(workdir) / "metrics.jsonl"
    rows, damaged, _ = _parse(path)
    if damaged:
        logging.warning("%s: left out %d lines from line %d on", path, len(damaged), damaged[0])
    return rows


def _parse(path):
    """Returns rows, the numbers of lines that are none, and whether the last line was cut short."""
    *lines, last = path.read_bytes().split(b"\n") if path.exists() else [b""]
    found = [_row(line) for line in lines]
    damaged = [number for number, row in enumerate(found, 1) if row is None]
    if _row(last):
        found.append(_row(last))
    return [row for row in found if row], damaged, bool(last) and not _row(last)


def _row(line):
    """Returns the row that a line in bytes holds, or None."""
    try:
        row = json.loads(line)
    except ValueError:
        return None
    return row if isinstance(row, dict) and type(row.get("step")) is int and "seconds" in row else None


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
