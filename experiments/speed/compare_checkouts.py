"""Compares the time and the FLOPs of a training step between this checkout and another one.

    JAXNERF_SCENES=... python experiments/speed/compare_checkouts.py --against=/path/to/checkout \
        [--configs=lego_fast,lego_small] [--rounds=5] [--core=0]

Each round trains a config for the same number of steps in both checkouts, one after the other on the same core, in
alternating order. The time of a step is the mean over the second half of a run; the ratio is taken within a round.
Both checkouts are driven through `python -m jaxnerf.train`, so their modules may have different names. FLOPs are
XLA's count of the compiled step, in which the body of a loop over microbatches counts once.
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
_CONFIGS = flags.DEFINE_list("configs", ["lego_fast", "lego_small"], "Names of configs that both checkouts have.")
_ROUNDS = flags.DEFINE_integer("rounds", 5, "Number of runs of each checkout.", lower_bound=1)
_STEPS = flags.DEFINE_integer("steps", 0, "Steps of a run; 0: 1500 for lego_fast, 400 for others.", lower_bound=0)
_CORE = flags.DEFINE_integer("core", 0, "CPU core that all runs are pinned to.")
_DATA_DIR = flags.DEFINE_string("data_dir", None, "Folder of the dataset, in place of the config's.")
_HERE = pathlib.Path(__file__).resolve().parents[2]
_FLOPS = "largest compiled program:"
# Runs jaxnerf.train and reports the program with the most FLOPs of those that are compiled ahead of time.
_COUNT = f"""
import atexit, runpy, sys
import jax
compile_program, found = jax.stages.Lowered.compile, [0.0]
def counted(*args, **options):
    compiled = compile_program(*args, **options)
    found.append((compiled.cost_analysis() or {{}}).get("flops", 0.0))
    return compiled
jax.stages.Lowered.compile = counted
atexit.register(lambda: print("{_FLOPS}", max(found)))
sys.argv[0] = "jaxnerf.train"
runpy.run_module("jaxnerf.train", run_name="__main__", alter_sys=True)
"""


def main(argv: list[str]) -> None:
    """Measures each config and prints one line per round and one with the medians."""
    del argv
    roots = {"here": _HERE, "there": pathlib.Path(_AGAINST.value).resolve()}
    with tempfile.TemporaryDirectory() as cache:
        for name in _CONFIGS.value:
            steps = _STEPS.value or (1500 if name == "lego_fast" else 400)
            flops = {side: step_flops(root, name, steps, cache) for side, root in roots.items()}  # fills the cache
            rounds = []
            for turn in range(_ROUNDS.value):
                order = list(roots) if turn % 2 else list(roots)[::-1]
                seconds = {side: step_seconds(roots[side], name, steps, cache) for side in order}
                rounds.append(seconds)
                times = ", ".join(f"{side} {1e3 * seconds[side]:.2f} ms" for side in roots)
                print(f"{name} round {turn + 1}: {times}, ratio {seconds['here'] / seconds['there']:.3f}", flush=True)
            ratios = sorted(seconds["here"] / seconds["there"] for seconds in rounds)
            print(
                f"{name}: step time here / there {statistics.median(ratios):.3f} (median of {len(ratios)}, "
                f"{ratios[0]:.3f} to {ratios[-1]:.3f}); FLOPs {flops['here']:.6g} / {flops['there']:.6g} = "
                f"{flops['here'] / flops['there'] if flops['there'] else float('nan'):.4f}",
                flush=True,
            )


def step_seconds(root: pathlib.Path, name: str, steps: int, cache: str) -> float:
    """Returns the seconds of a step, the mean over the second half of a run."""
    with tempfile.TemporaryDirectory() as workdir:
        _train(["-m", "jaxnerf.train"], root, name, cache, workdir, steps, steps)
        rows = [json.loads(line) for line in pathlib.Path(workdir, "metrics.jsonl").read_text().splitlines()]
    half, end = (next(row for row in rows if row["step"] == step) for step in (steps // 2, steps))
    return (end["seconds"] - half["seconds"]) / (end["step"] - half["step"])


def step_flops(root: pathlib.Path, name: str, steps: int, cache: str) -> float:
    """Returns the FLOPs of the compiled training step as XLA counts them."""
    with tempfile.TemporaryDirectory() as workdir:
        output = _train(["-c", _COUNT], root, name, cache, workdir, steps, 2)
    return float(output.rsplit(_FLOPS, 1)[1].split()[0])


def _train(program, root, name, cache, workdir, schedule_steps, steps):
    """Trains for some steps from the checkout at root; returns what was printed."""
    fields = {"max_steps": steps, "lr_steps": schedule_steps, "log_every": max(steps // 2, 1), "save_every": steps}
    command = ["taskset", "-c", str(_CORE.value), sys.executable, *program, f"--config=configs/{name}.py"]
    command += [f"--workdir={workdir}", *(f"--config.train.{field}={value}" for field, value in fields.items())]
    command += [f"--data_dir={_DATA_DIR.value}"] if _DATA_DIR.value else []
    environment = {**os.environ, "PYTHONPATH": str(root), "JAX_COMPILATION_CACHE_DIR": cache}
    environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{root}: {' '.join(command)} exits with {done.returncode}: {done.stderr.strip()[-2000:]}")
    return done.stdout


if __name__ == "__main__":
    app.run(main)
