"""Runs programs in forks of a process that has imported what they need; runs.run_forked starts it and talks to it.

It starts without any JAX_ variable, so that each program takes all options of JAX from its own environment. It
never uses JAX itself: threads of a backend would not survive the fork.
"""

import gc
import json
import os
import runpy
import signal
import sys

import jax

import jaxnerf.evaluation.evaluate  # noqa: F401
import mlir_context

_SECONDS = 120  # after which a program is killed


def _become(request):
    """Turns a fresh fork into the program of a request, up to its own code."""
    os.environ.clear()
    os.environ.update(request["environment"])
    for name, value in jax.config.values.items():
        text = os.environ.get(name.upper())
        if text is not None:
            kind = (lambda text: text.lower() in ("1", "true")) if isinstance(value, bool) else type(value)
            jax.config.update(name, text if value is None else kind(text))
    os.chdir(request["folder"])
    for number, path, mode in ((0, os.devnull, "r"), (1, request["out"], "w"), (2, request["err"], "w")):
        with open(path, mode) as file:
            os.dup2(file.fileno(), number)
    places = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    program = request["program"]
    sys.path[:1] = [os.path.dirname(program) if program.endswith(".py") else request["folder"], *places]
    sys.argv[1:] = request["flags"]
    signal.alarm(_SECONDS)


def _serve():
    """Answers each request, a line of JSON, with the exit code of its program; returns the program to run in a fork."""
    for line in sys.stdin:
        request = json.loads(line)
        child = os.fork()
        if not child:
            _become(request)
            return request["program"]
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


if __name__ == "__main__":
    gc.collect()
    mlir_context.use_one_context()
    gc.freeze()  # or the first collection of each program would copy all of it
    program = _serve()
    if program and program.endswith(".py"):
        runpy.run_path(program, run_name="__main__")
    elif program:
        runpy.run_module(program, run_name="__main__", alter_sys=True)
