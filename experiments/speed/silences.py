"""Measures for how long a program prints nothing: the CPU time between two outputs, on a terminal and in a log file.

    python experiments/speed/silences.py OUT [--datasets=lego,walk] [--programs=train,eval] [--most_cpu=60]

The first program trains the run in OUT that the others need. A program is interrupted, as Ctrl-C does, after --most_cpu
seconds of CPU time. CPU time is that of the process and all its children. In a log file a silence of a minute is meant.
"""

import fcntl
import os
import pathlib
import pty
import re
import select
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import time

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.runtime import cli

HEADS = (
    *("program", "dataset", "CPU s", "longest silence, CPU s (s)", "after this output", "before this one"),
    *("lines in a log file", "longest silence there, s"),
)
CONFIGS = {"lego": "lego_fast", "walk": "capture"}  # others: capture
PROGRAMS = {
    "train": "jaxnerf.train --config={config} --data_dir={data} --workdir={run} --config.train.max_steps=40",
    "train again": "jaxnerf.train --workdir={run}",
    "eval": "jaxnerf.eval --workdir={run} --overwrite",
    "render": "jaxnerf.render --workdir={run} --frames=3 --width=400 --overwrite",
    "export": "jaxnerf.tools.exporters.program --workdir={run} --kind=mesh --resolution=128 --num_views=20 --overwrite",
    "check": "jaxnerf.tools.capture_check.program --data_dir={data} --out={out}/check.png --overwrite",
    "view": "jaxnerf.tools.viewer.program --workdir={run} --port=0",
    "report": "jaxnerf.report {run}",
}
_DATASETS = flags.DEFINE_list("datasets", ["lego", "walk"], "Folders of datasets.")
_PROGRAMS = flags.DEFINE_list("programs", list(PROGRAMS), "Programs to start.")
_MOST_CPU = flags.DEFINE_float("most_cpu", 60.0, "The CPU time after which a program is interrupted.", lower_bound=1.0)
_COLUMNS = flags.DEFINE_integer("columns", 160, "The width of the terminal.", lower_bound=1)
_FILES = flags.DEFINE_bool("files", True, "Whether each program is started again with its output in a file.")
_TICKS = os.sysconf("SC_CLK_TCK")
_AT_REST = 20.0  # seconds without CPU time after which a program counts as waiting for its user


def main(argv: list[str]) -> None:
    """Starts each program and prints the table."""
    if len(argv) != 2:
        raise ValueError(f"{len(argv) - 1} arguments are given, expected one folder for the runs: OUT")
    rows = []
    for data in _DATASETS.value:
        out = pathlib.Path(argv[1]).absolute() / pathlib.Path(data).name
        out.mkdir(parents=True, exist_ok=True)
        names = {"data": data, "out": out, "config": CONFIGS.get(pathlib.Path(data).name, "capture")}
        for program in common.chosen("--programs", _PROGRAMS.value, list(PROGRAMS)):
            found = []
            for place in ("terminal", "file")[: 1 + _FILES.value]:
                run = out / f"run-{place}"
                if program == "train":
                    shutil.rmtree(run, ignore_errors=True)
                command = [sys.executable, "-m", *PROGRAMS[program].format(run=run, **names).split()]
                found.append(watch(command, on_terminal=place == "terminal"))
                print(f"{program} {data} {place}: {longest(found[-1][0], cpu=True)}", file=sys.stderr, flush=True)
            (outputs, cpu), *files = found
            gap, seconds, before, after = longest(outputs, cpu=True)
            row = (program, f"`{data}`", f"{cpu:.0f}", f"{gap:.1f} ({seconds:.1f})", f"`{before}`", f"`{after}`")
            in_file = [(str(len(lines) - 2), f"{longest(lines, cpu=False)[1]:.0f}") for lines, _ in files] or [("", "")]
            rows.append((*row, *in_file[0]))
    common.publish([*common.markdown(HEADS, rows), "", *common.provenance()], "silences")


def watch(command: list[str], *, on_terminal: bool) -> tuple[list[tuple[float, float, str]], float]:
    """Starts a program and follows its output.

    Args:
        command: the program and its arguments.
        on_terminal: whether its output is a terminal; a file otherwise.

    Returns:
        The CPU time of its processes and the time since its start, seconds, at each output, with that output; the first
        one is "(start)" and the last one "(end)". And the CPU time at its end.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment |= {"PYTHONPATH": str(common.ROOT), "COLUMNS": str(_COLUMNS.value)}
    with tempfile.TemporaryDirectory() as cache, tempfile.TemporaryFile() as file:
        environment["XDG_CACHE_HOME"] = cache
        reader, writer = pty.openpty() if on_terminal else (file.fileno(), file.fileno())
        if on_terminal:
            fcntl.ioctl(writer, termios.TIOCSWINSZ, struct.pack("4H", 50, _COLUMNS.value, 0, 0))
        streams = dict.fromkeys(("stdin", "stdout", "stderr") if on_terminal else ("stdout", "stderr"), writer)
        process = subprocess.Popen(command, cwd=common.ROOT, env=environment, start_new_session=True, **streams)
        try:
            return _follow(process.pid, reader, on_terminal)
        finally:
            process.returncode = 0  # _follow has waited for it
            if on_terminal:
                os.close(reader), os.close(writer)


def _follow(process, reader, on_terminal):
    started, outputs, position, cpu = time.perf_counter(), [(0.0, 0.0, "(start)")], 0, 0.0
    rested, interrupted = (0.0, started), False
    while True:
        text = b""
        if on_terminal and select.select([reader], [], [], 0.05)[0]:
            text = os.read(reader, 65536)
        elif not on_terminal:
            time.sleep(0.05)
            text = os.pread(reader, 2**24, position)
            position += len(text)
        ended, _, usage = os.wait4(process, os.WNOHANG)
        now = time.perf_counter() - started
        cpu = usage.ru_utime + usage.ru_stime if ended else max(cpu, cpu_of(process))
        outputs += [(cpu, now, line) for line in printed(text.decode(errors="replace"))]
        if ended:
            return [*outputs, (cpu, now, "(end)")], cpu
        if cpu > rested[0] + 0.2:
            rested = cpu, time.perf_counter()
        if not interrupted and (cpu > _MOST_CPU.value or time.perf_counter() - rested[1] > _AT_REST):
            os.kill(process, signal.SIGINT)
            interrupted = True


def printed(text: str) -> list[str]:
    """Returns the lines of an output, those that replace each other on a terminal, too."""
    lines = re.split(r"[\r\n]+|\x1b\[K", text)
    return [line.strip() for line in lines if line.strip()]


def cpu_of(process: int) -> float:
    """Returns the CPU time of a process and its children, those that have ended and been waited for included."""
    parents, times = {}, {}
    for stat in pathlib.Path("/proc").glob("[0-9]*/stat"):
        try:
            number, _, rest = stat.read_text().partition(" (")
        except OSError:  # it has just ended
            continue
        fields = rest.rpartition(") ")[2].split()
        parents[int(number)], times[int(number)] = int(fields[1]), sum(map(int, fields[11:15])) / _TICKS
    family, found = {process}, True
    while found:
        found = {child for child, parent in parents.items() if parent in family} - family
        family |= found
    return sum(times.get(each, 0.0) for each in family)


def longest(outputs: list[tuple[float, float, str]], *, cpu: bool) -> tuple[float, float, str, str]:
    """Returns the longest silence in CPU time and time, seconds, by one of them, and the outputs around it."""
    pairs = list(zip(outputs, outputs[1:], strict=False))
    one, other = max(pairs, key=lambda pair: pair[1][not cpu] - pair[0][not cpu])
    texts = (each[2].replace("|", "/").replace("`", "'")[:60] for each in (one, other))
    return other[0] - one[0], other[1] - one[1], *texts


if __name__ == "__main__":
    cli.run(main, positional=True, stopped="and the table was not printed")
