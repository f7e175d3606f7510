"""Follows a run's config through a start of training: which files of the package receive it, or a part of it.

    python experiments/structure/config_trace.py /path/to/a/checkout

It trains one step of configs/smoke.py under sys.setprofile and lists the files of the package whose functions get the
whole config, or the options of a part, as an argument: a ConfigDict, options, or a dict or a namespace of their values.
"""

import collections
import json
import pathlib
import subprocess
import sys

from absl import app

_TRACE = """
import collections, json, pathlib, sys, tempfile
from types import SimpleNamespace

root = pathlib.Path.cwd() / "jaxnerf"
calls = {"whole": collections.Counter(), "part": collections.Counter()}
marks = ("batch_size", "num_coarse", "resolutions", "threshold", "num_freqs", "early_stop_eps", "pixel_offset")


def kind(value):
    names = {base.__name__ for base in type(value).__mro__}
    if "RunConfig" in names or "ConfigDict" in names and "train" in value:
        return "whole"
    if "Options" in names or "ConfigDict" in names:
        return "part"
    fields = value if isinstance(value, dict) else vars(value) if isinstance(value, SimpleNamespace) else ()
    return "part" if any(mark in fields for mark in marks) else None


def profile(frame, event, argument):
    code = frame.f_code
    if event != "call" or not code.co_filename.startswith(str(root)) or code.co_name.startswith("<"):
        return
    count = code.co_argcount + code.co_kwonlyargcount
    found = {kind(frame.f_locals.get(name)) for name in code.co_varnames[:count]}
    place = str(pathlib.Path(code.co_filename).relative_to(root))
    for name in found & {"whole", "part"}:
        calls[name][place] += 1


from jaxnerf.configs import smoke
from jaxnerf.training import loop
config = smoke.get_config()
config.train.max_steps = config.train.save_every = 1
folder = tempfile.mkdtemp()
sys.setprofile(profile)
loop.train(config, folder)
sys.setprofile(None)
print(json.dumps(calls))
"""


def main(argv):
    checkouts = argv[1:] or ["."]
    for checkout in checkouts:
        folder = pathlib.Path(checkout).resolve()
        done = subprocess.run([sys.executable, "-c", _TRACE], cwd=folder, capture_output=True, text=True)
        if done.returncode:
            raise ValueError(f"{folder}: {done.stderr.strip().splitlines()[-1]}")
        calls = {name: collections.Counter(found) for name, found in json.loads(done.stdout).items()}
        print(folder)
        for name, found in calls.items():
            print(f"  {name}: {sum(found.values())} calls in {len(found)} files: {', '.join(sorted(found))}")
        files = calls["whole"].keys() | calls["part"].keys()
        print(f"  together: {len(files)} files")


if __name__ == "__main__":
    app.run(main)
