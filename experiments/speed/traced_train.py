"""Trains as jaxnerf-train does, and records the process's memory and CPU time while it does; memory.py starts it.

python experiments/speed/traced_train.py TRACE.json --config=capture --data_dir=DIR --workdir=DIR ...
"""

import json
import pathlib
import sys
import threading
import time

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2]))

from jaxnerf.runtime import stages

_EVERY = 0.02  # seconds between samples


def resident_mb() -> float:
    """Returns the resident memory of this process in MB (10^6 bytes), as Linux counts it."""
    pages = int(pathlib.Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def main() -> None:
    """Runs the program, and writes [{"stage", "seconds", "cpu", "mb"}], one for each sample."""
    path, samples, ended = sys.argv.pop(1), [], threading.Event()
    started = time.perf_counter()

    def sample():
        now = {"seconds": time.perf_counter() - started, "cpu": time.process_time(), "mb": resident_mb()}
        samples.append({"stage": ([None] + [each.text for each in stages.running])[-1], **now})

    def watch():
        while not ended.wait(_EVERY):
            sample()

    threading.Thread(target=watch, daemon=True).start()
    try:
        from jaxnerf import train

        train.run()
    finally:
        ended.set()
        sample()
        pathlib.Path(path).write_text(json.dumps(samples))


if __name__ == "__main__":
    main()
