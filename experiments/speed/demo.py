"""Measures `make demo` in fresh clones with empty caches: wall and CPU seconds, the first image, and PSNR.

    taskset -c 0 python experiments/speed/demo.py [--commits=2990dae,HEAD] [--python=/usr/bin/python3.13] \
        [--rounds=1] [--page=FILE.md]

The commits alternate. Packages come from where pip finds them, without its cache, so the time depends on the network,
too. With --page the table between <!-- demo --> and <!-- end of demo --> in that file is replaced.
"""

import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.runtime import cli

HEADS = ("commit", "wall, s", "CPU, s", "first image after, s", "PSNR, dB", "matrix product, GFLOP/s")
_COMMITS = flags.DEFINE_list("commits", ["2990dae", "HEAD"], "Commits to compare.")
_PYTHON = flags.DEFINE_string("python", "python3", "The interpreter that makes the virtual environment.")
_ROUNDS = flags.DEFINE_integer("rounds", 1, "Number of demos of each commit; medians are shown.", lower_bound=1)


def main(argv: list[str]) -> None:
    """Runs the demos and prints the table."""
    del argv
    found = {_name(commit): [] for commit in _COMMITS.value}  # HEAD may move meanwhile
    for _ in range(_ROUNDS.value):
        for commit, figures in found.items():
            figures.append(demo(commit))
            print(commit, *(f"{value:.1f}" for value in figures[-1]), file=sys.stderr, flush=True)
    rows = []
    for commit, runs in found.items():
        wall, cpu, preview, psnr, gflops = (statistics.median(values) for values in zip(*runs, strict=True))
        rows.append((commit, f"{wall:.0f}", f"{cpu:.0f}", f"{preview:.0f}", f"{psnr:.2f}", f"{gflops:.0f}"))
    common.publish([*common.markdown(HEADS, rows), "", *common.provenance()], "demo")


def demo(commit: str) -> tuple[float, ...]:
    """Returns wall and CPU seconds, seconds until the first image, PSNR and GFLOP/s of one `make demo`.

    Raises:
        ValueError: if it fails; quotes its last lines.
    """
    with tempfile.TemporaryDirectory() as folder:
        clone = pathlib.Path(folder, "jaxnerf")
        subprocess.run(["git", "clone", "--quiet", str(common.ROOT), str(clone)], check=True)
        subprocess.run(["git", "-C", str(clone), "checkout", "--quiet", commit], check=True)
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("JAX", "PYTHON", "XDG_"))}
        environment = {**kept, "HOME": folder, "PIP_NO_CACHE_DIR": "1"}
        gflops = [common.matrix_gflops()]
        with open(f"{folder}/output", "w+") as output:
            started, clock = time.time(), time.perf_counter()
            command = ["make", "--silent", "demo", f"PYTHON={_PYTHON.value}"]
            process = subprocess.Popen(command, cwd=clone, env=environment, stdout=output, stderr=output)
            _, status, usage = os.wait4(process.pid, 0)
            wall = time.perf_counter() - clock
            if status:
                output.seek(0)
                raise ValueError(f"make demo of {commit} failed: {output.read().strip()[-2000:]}")
        gflops.append(common.matrix_gflops())
        run = clone / "runs/demo"
        preview = min((path.stat().st_mtime for path in run.glob("previews/*.png")), default=float("nan"))
        (results,) = run.glob("eval/*/results.json")
        psnr = json.loads(results.read_text())["psnr"]
        return wall, usage.ru_utime + usage.ru_stime, preview - started, psnr, statistics.fmean(gflops)


def _name(commit):
    command = ["git", "-C", str(common.ROOT), "rev-parse", "--short", commit]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    cli.run(main)
