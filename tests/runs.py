"""A run of seconds that tests share, and programs as processes."""

import dataclasses
import functools
import json
import os
import pathlib
import socket
import subprocess
import sys
import tempfile

from jaxnerf.configs import smoke

ROOT = pathlib.Path(__file__).resolve().parent.parent

SMOKE_FLAGS = ("--config=configs/smoke.py", "--config.train.save_every=5")


def smoke_config(**train):
    """Returns configs/smoke.py with a checkpoint every 5 steps and the given fields of its section `train`."""
    config = smoke.get_config()
    config.train.update({"save_every": 5, **train})
    return config


def smoke_experiment(**train):
    """Returns the Experiment of smoke_config."""
    from jaxnerf.training import auto_config, build

    return build.build(auto_config.resolve_for_device(smoke_config(**train))[0])


# Makes configs/smoke.py a hash grid with the occupancy sampler. All samples fit into its buffer, so nothing
# depends on how many devices share the batch.
PACKED = {
    "field": "hash_grid",
    "sampler": "occupancy",
    "occupancy.step_size": 0.2,
    "occupancy.resolution": 16,
    "occupancy.update_every": 4,
    "occupancy.pool_samples_per_ray": 32,
    "occupancy.min_views": 0,
    "hash_grid.resolutions": (8, 16),
    "hash_grid.table_size": 2048,
    "hash_grid.width": 16,
    "hash_grid.view_width": 16,
}


def as_flags(fields):
    """Returns the flags that set fields of a config."""
    return [f"--config.{name}={value}" for name, value in fields.items()]


def evaluate(folder, *, settings=None, predictor=None, **options):
    """Restores the run in a folder and scores it, as jaxnerf-eval does; predictor: TrainedRun -> Predictor."""
    from jaxnerf.evaluation.evaluate import score_run
    from jaxnerf.evaluation.restore import restore_run

    run = restore_run(folder, settings=settings)
    return score_run(run, folder, predictor=predictor and predictor(run), **options)


def render_path(folder, *, settings=None, predictor=None, **options):
    """Restores the run in a folder and renders it, as jaxnerf-render does; options: of `Frames` and of `Output`."""
    from jaxnerf.evaluation.paths.render_path import Frames, Output, render_path
    from jaxnerf.evaluation.restore import restore_run

    frames = {field.name: options.pop(field.name) for field in dataclasses.fields(Frames) if field.name in options}
    run = restore_run(folder, settings=settings)
    return render_path(run, folder, Frames(**frames), Output(**options), predictor=predictor)


# The folders of the programs below jaxnerf/tools.
TOOLS = {
    "cameras": "structure_from_motion",
    "check": "capture_check",
    "convert": "interop",
    "export": "exporters",
    "needs": "needs",
    "view": "viewer",
}


def module_of(program):
    """Returns the module of a program, by the name of its command without jaxnerf-."""
    return f"jaxnerf.tools.{TOOLS[program]}.program" if program in TOOLS else f"jaxnerf.{program}"


def start(program, *flags, **environment):
    """Starts a program, by its command without jaxnerf-, or a script in tests/ that ends in .py; output in pipes."""
    what = [str(ROOT / "tests" / program)] if program.endswith(".py") else ["-m", module_of(program)]
    command = [sys.executable, *what, *map(str, flags)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=ROOT, env={**os.environ, **environment}, **pipes)


def free_port():
    """Returns a free port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def start_together(count, program, *flags, **environment):
    """Starts `count` processes of one training run."""
    flags = (*flags, f"--coordinator=127.0.0.1:{free_port()}", f"--num_processes={count}")
    return [start(program, *flags, f"--process_id={index}", **environment) for index in range(count)]


@functools.cache
def _fork_server():
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), environment.get("PYTHONPATH", "")])
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, ROOT / "tests" / "fork_server.py"], env=environment, **pipes)


def run_forked(program, *flags, folder=ROOT):
    """Returns (exit code, stdout, stderr) of a program, or of a script, see `start`, without a new interpreter.

    It runs in a folder, as a fork of a process that has imported JAX: imports take longer than most of these programs.
    Tests of starting, of signals, of several processes and of variables that Python reads use `start`.
    """
    server = _fork_server()
    with tempfile.TemporaryDirectory() as streams:
        out, err = pathlib.Path(streams, "out"), pathlib.Path(streams, "err")
        what = str(program) if str(program).endswith(".py") else module_of(program)
        request = {"program": what, "flags": list(map(str, flags)), "folder": str(folder)}
        request |= {"environment": dict(os.environ), "out": str(out), "err": str(err)}
        print(json.dumps(request), file=server.stdin, flush=True)
        code = int(server.stdout.readline())
        return code, out.read_text(), err.read_text()
