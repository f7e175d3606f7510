"""Kills a training run again and again at random moments, and compares its end with an undisturbed run.

    python tests/slow/faults/kill_many.py --kills=50 --seed=0 --out=FOLDER

Each start gets SIGKILL at a random moment while it reads, compiles, takes steps or writes a checkpoint. It must
continue from the newest complete checkpoint. In the end every number of the state, and every row of the metrics
except its times, must equal that of a run without a kill, bit for bit.
"""

import argparse
import json
import pathlib
import random
import re
import subprocess
import sys
import time

import jax
import numpy as np

ROOT = pathlib.Path(__file__).resolve().parents[3]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from jaxnerf.training import auto_config, build, workdir  # noqa: E402
from jaxnerf.training.checkpoint import Checkpoints  # noqa: E402
from jaxnerf.training.metric_log import read_rows  # noqa: E402
from jaxnerf.training.state import create_state  # noqa: E402

SAVE_EVERY = 20
CLOCKS = ("seconds", "compile_seconds", "rays_per_second")


def main(*, kills, seed, out, config="configs/smoke.py", flags=(), say=print):
    """Runs the test; raises an AssertionError that says what was lost. Returns the number of repeated steps."""
    random_, out = random.Random(seed), pathlib.Path(out)
    killed, whole = out / "killed", out / "whole"
    started, starting, lost, phases = time.time(), 4.0, 0, {}
    for number in range(1, kills + 1):
        before = max(Checkpoints(killed).steps(), default=0)
        process, log = _start(killed, config, 10**6, flags)
        aim = random_.choice(("starting", "steps", "steps", "saving", "saving"))
        starting = _wait(process, killed, log, aim, random_, starting) or starting
        seconds = time.time() - process.started
        phase = _phase(killed, log)
        process.kill()
        process.wait()
        resumed, after = _resumed(log), max(Checkpoints(killed).steps(), default=0)
        reached = max([row["step"] for row in read_rows(killed)], default=0)
        assert resumed in (None, before), f"continued from {resumed}, though {before} was complete"
        assert after >= before, f"checkpoint {before} is gone"
        redone = max(reached - after, 0)
        assert redone <= SAVE_EVERY, f"{redone} steps are lost, a checkpoint is written every {SAVE_EVERY}"
        if phase == "steps":
            with (killed / "metrics.jsonl").open("a") as file:
                file.write('{"step": 12, "sec')  # as a process killed while writing leaves it
        lost, phases[phase] = lost + redone, phases.get(phase, 0) + 1
        came = f"from {'-' if resumed is None else resumed:>4} to {reached:4d}, saved {after:4d}"
        say(f"kill {number:2d}  {seconds:5.1f} s  {phase:9}  {came}")
    end = max(Checkpoints(killed).steps(), default=0) + SAVE_EVERY
    for folder in (killed, whole):
        process, log = _start(folder, config, end, flags)
        assert process.wait() == 0, log.read_text()
    say(f"{kills} kills in {time.time() - started:.0f} s: {phases}; {end} steps, {lost} repeated")
    say(_compare(killed, whole, end))
    return lost


def _start(folder, config, max_steps, flags):
    folder.parent.mkdir(parents=True, exist_ok=True)
    log = folder.with_suffix(".log")
    options = {"max_steps": max_steps, "save_every": SAVE_EVERY, "log_every": 1}
    command = [sys.executable, "-m", "jaxnerf.train", f"--config={config}", f"--workdir={folder}", *flags]
    command += [f"--config.train.{name}={value}" for name, value in options.items()]
    with log.open("w") as file:
        process = subprocess.Popen(command, cwd=ROOT, stdout=file, stderr=file)
    process.started = time.time()
    return process, log


def _wait(process, folder, log, aim, random_, starting):
    """Waits for a random moment of the phase; returns the seconds until the first step, if there was one."""
    if aim == "starting":
        time.sleep(random_.uniform(0.0, starting))
        return None
    while _phase(folder, log) in ("reading", "compiling"):
        assert process.poll() is None, log.read_text()
        time.sleep(0.005)
    starting = time.time() - process.started
    time.sleep(random_.uniform(0.0, 1.5))
    if aim == "saving":
        while not _writing(folder):
            assert process.poll() is None, log.read_text()
            time.sleep(0.001)
        time.sleep(random_.uniform(0.0, 0.15))
    return starting


def _phase(folder, log):
    text = log.read_text()
    if "dB" not in text:
        return "compiling" if "dataset " in text else "reading"
    return "saving" if _writing(folder) else "steps"


def _writing(folder):
    """Returns whether a checkpoint is being written."""
    return any(folder.glob("checkpoints/*-tmp*"))


def _resumed(log):
    found = re.search(r"^steps +(\d+) of", log.read_text(), re.MULTILINE)
    return int(found[1]) if found else None


def _compare(killed, whole, end):
    """Returns a line about what is equal; raises AssertionError if something differs."""
    a, b = (_state(folder, end) for folder in (killed, whole))
    assert jax.tree.structure(a) == jax.tree.structure(b)
    leaves = list(zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
    for x, y in leaves:
        np.testing.assert_array_equal(x, y)
    rows = [[_row(row) for row in read_rows(folder)] for folder in (killed, whole)]
    assert [row["step"] for row in read_rows(killed)] == list(range(1, end + 1))
    assert rows[0] == rows[1]
    seconds = [row["seconds"] for row in read_rows(killed)]
    assert seconds == sorted(seconds), "the clock went back"
    left = [path.name for path in killed.rglob("*") if "tmp" in path.name or "unreadable" in path.name]
    assert not left and not (killed / "running").exists(), left
    numbers = sum(x.size for x, _ in leaves)
    return f"bit-exact with the undisturbed run: {numbers:,} numbers of the state, {end} rows of metrics"


def _state(folder, step):
    experiment = build.build(auto_config.resolve_for_device(workdir.load_config(folder))[0])
    like = create_state(experiment.model, experiment.optimizer, experiment.config.seed)
    return jax.device_get(Checkpoints(folder).load(step, like))


def _row(row):
    return json.dumps({name: value for name, value in row.items() if name not in CLOCKS})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--config", default="configs/smoke.py")
    parser.add_argument("--out", required=True)
    known, rest = parser.parse_known_args()
    main(**vars(known), flags=rest)
