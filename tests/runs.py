"""The run of seconds that the tests of the engine share, and the programs as processes."""

import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))  # for configs, however pytest was started

from configs import smoke  # noqa: E402

SMOKE_FLAGS = ("--config=configs/smoke.py", "--config.train.save_every=5")


def smoke_config(**train):
    """Returns configs/smoke.py with a checkpoint every 5 steps and other fields of train as given."""
    config = smoke.get_config()
    config.train.update({"save_every": 5, **train})
    return config


def start(program, *flags):
    """Starts python -m jaxnerf.<program> with its output in pipes."""
    command = [sys.executable, "-m", f"jaxnerf.{program}", *map(str, flags)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def run(program, *flags):
    """Returns (exit code, stdout, stderr) of python -m jaxnerf.<program>."""
    process = start(program, *flags)
    out, err = process.communicate(timeout=120)
    return process.returncode, out, err
