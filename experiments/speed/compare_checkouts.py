"""Compares what a training costs in this checkout and in another one: seconds of a step, of compiling, and memory.

    JAXNERF_SCENES=... python experiments/speed/compare_checkouts.py --against=/path/to/checkout \
        [--runs=lego_fast,capture:fox] [--rounds=5] [--core=0]

Each round trains a config for the same number of steps in both checkouts, one after the other on the same core, in
alternating order. The time of a step is the mean over the second half of a run, memory the peak of the process. The
ratios are taken within a round. Both checkouts are driven through `python -m jaxnerf.train`, so their modules may have
different names.
"""

import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile

from absl import app, flags

_AGAINST = flags.DEFINE_string("against", None, "Root of the other checkout.", required=True)
_RUNS = flags.DEFINE_list("runs", ["lego_fast", "capture:fox"], "CONFIG or CONFIG:DATASET, which both checkouts have.")
_ROUNDS = flags.DEFINE_integer("rounds", 5, "Number of runs of each checkout.", lower_bound=1)
_STEPS = flags.DEFINE_integer("steps", 400, "Steps of a run.", lower_bound=2)
_CORE = flags.DEFINE_integer("core", 0, "CPU core that all runs are pinned to.")
_HERE = pathlib.Path(__file__).resolve().parents[2]
_FIGURES = {"step (ms)": 1e3, "compilation (s)": 1.0, "peak memory (MB)": 1e-3}


def main(argv: list[str]) -> None:
    """Measures each config and prints one line per round and one with the medians."""
    del argv
    roots = {"here": _HERE, "there": pathlib.Path(_AGAINST.value).resolve()}
    for name in _RUNS.value:
        rounds = []
        for turn in range(_ROUNDS.value):
            order = list(roots) if turn % 2 else list(roots)[::-1]
            found = {side: train(roots[side], *name.split(":")) for side in order}
            rounds.append([here / there for here, there in zip(found["here"], found["there"], strict=True)])
            sides = (f"{side} {', '.join(f'{value:.4g}' for value in found[side])}" for side in roots)
            print(f"{name} round {turn + 1}: {', '.join(_FIGURES)}: {'; '.join(sides)}", flush=True)
        for figure, ratios in zip(_FIGURES, zip(*rounds, strict=True), strict=True):
            middle, low, high = statistics.median(ratios), min(ratios), max(ratios)
            print(f"{name}: {figure} here / there {middle:.3f} (median of {len(ratios)}, {low:.3f} to {high:.3f})")


def train(root: pathlib.Path, config: str, dataset: str | None = None) -> list[float]:
    """Trains from the checkout at root, with nothing compiled before; returns the figures."""
    steps = _STEPS.value
    fields = {"max_steps": steps, "lr_steps": steps, "log_every": steps // 2, "save_every": steps, "max_seconds": 0}
    with tempfile.TemporaryDirectory() as folder:
        workdir = pathlib.Path(folder, "run")
        command = ["taskset", "-c", str(_CORE.value), sys.executable, "-m", "jaxnerf.train", f"--config={config}"]
        command += [f"--workdir={workdir}", *(f"--config.train.{field}={value}" for field, value in fields.items())]
        command += ["--config.train.preview_every=0", "--config.eval.summary_seconds=0"]
        command += [f"--data_dir={dataset}"] if dataset else []
        environment = {**os.environ, "PYTHONPATH": str(root), "JAX_COMPILATION_CACHE_DIR": f"{folder}/cache"}
        with open(f"{folder}/output", "w+") as output:
            process = subprocess.Popen(command, cwd=root, env=environment, stdout=output, stderr=output)
            _, status, usage = os.wait4(process.pid, 0)
            if status:
                output.seek(0)
                raise ValueError(f"{root}: {' '.join(command)} failed: {output.read().strip()[-2000:]}")
        rows = [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()]
    half, end = (next(row for row in rows if row["step"] == step) for step in (steps // 2, steps))
    seconds = (end["seconds"] - half["seconds"]) / (end["step"] - half["step"])
    return [
        factor * value
        for factor, value in zip(_FIGURES.values(), (seconds, end["compile_seconds"], usage.ru_maxrss), strict=True)
    ]


if __name__ == "__main__":
    app.run(main)
