"""Runs examples/minimal_nerf.py on the embedded scene; exits with 1 unless it reaches 25 dB.

python tests/slow/minimal_nerf.py
"""

import pathlib
import re
import resource
import subprocess
import sys
import tempfile
import time

EXAMPLE = pathlib.Path(__file__).resolve().parents[2] / "examples" / "minimal_nerf.py"
PSNR, LINES = 25.0, 150


def main() -> int:
    """Runs the example in an empty folder, and prints its score, seconds of time and of CPU time, and lines."""
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        done = subprocess.run([sys.executable, EXAMPLE], cwd=folder, stdout=subprocess.PIPE, text=True, check=True)
        seconds, written = time.perf_counter() - started, (pathlib.Path(folder) / "minimal_nerf.png").stat().st_size
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_seconds = used.ru_utime + used.ru_stime
    score = float(re.search(r"PSNR ([\d.]+) dB", done.stdout).group(1))
    lines = len(EXAMPLE.read_text().splitlines())
    took = f"{seconds:.0f} s ({cpu_seconds:.0f} s of CPU time) with compilation and scoring"
    print(f"{score} dB in {took}; an image of {written:,} bytes; {lines} lines")
    return int(score < PSNR or lines > LINES)


if __name__ == "__main__":
    sys.exit(main())
