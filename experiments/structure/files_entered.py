"""Lists the files of the package that a training step, a rendered frame and `load_scene` enter.

    python experiments/structure/files_entered.py [/path/to/a/checkout ...]

Each checkout, this one where none is given, trains one step of a small hash grid on the embedded scene. A file is
entered where one of its functions is called: while JAX traces the step for the first time, while `jaxnerf.load_scene`
restores the run, and in the first call of the function that it returns. Importing modules does not count.
"""

import json
import os
import pathlib
import subprocess
import sys

from absl import app

ROOT = pathlib.Path(__file__).resolve().parents[2]
_ENTER = """
import contextlib, json, pathlib, sys, tempfile
import jax
import jaxnerf
from jaxnerf.configs import lego_fast
from jaxnerf.runtime import devices

root, entered = str(pathlib.Path.cwd() / "jaxnerf"), {}


@contextlib.contextmanager
def recorded(name):
    files = entered.setdefault(name, set())

    def profile(frame, event, argument):
        if event == "call" and frame.f_code.co_filename.startswith(root) and not imports(frame):
            files.add(str(pathlib.Path(frame.f_code.co_filename).relative_to(root)))

    sys.setprofile(profile)
    try:
        yield
    finally:
        sys.setprofile(None)


def imports(frame):
    while frame is not None:
        if frame.f_code.co_name == "<module>" and frame.f_code.co_filename.startswith(root):
            return True
        frame = frame.f_back
    return False


compile_step = devices.compile_step


def compile_recorded(train_step, *args, **options):
    def step(*args, **options):
        with recorded("training step"):
            return train_step(*args, **options)

    return compile_step(step, *args, **options)


devices.compile_step = compile_recorded
config = lego_fast.get_config()
config.data.format, config.data.size = "synthetic", 24
config.hash_grid.resolutions, config.hash_grid.table_size = (8, 16), 2**10
config.train.batch_size = 64
config.train.max_steps = config.train.lr_steps = config.train.save_every = 1
config.train.max_seconds = config.train.preview_every = config.eval.summary_seconds = 0.0
config.eval.at_end = False
workdir = tempfile.mkdtemp()
jaxnerf.train_and_evaluate(config, workdir)
rays = jaxnerf.restore_run(workdir).experiment.load_split("test").rays(0)
jax.clear_caches()
with recorded("load_scene"):
    scene, render = jaxnerf.load_scene(workdir)
with recorded("rendered frame"):
    jax.block_until_ready(render(rays))
print(json.dumps({name: sorted(files) for name, files in entered.items()}))
"""


def main(argv):
    for checkout in argv[1:] or [ROOT]:
        folder = pathlib.Path(checkout).resolve()
        environment = {**os.environ, "PYTHONPATH": str(folder)}
        done = subprocess.run(
            [sys.executable, "-c", _ENTER], cwd=folder, env=environment, capture_output=True, text=True
        )
        if done.returncode:
            raise ValueError(f"{folder}: {done.stderr.strip().splitlines()[-1]}")
        print(folder)
        for name, files in json.loads(done.stdout.splitlines()[-1]).items():
            print(f"  {name}: {len(files)} files: {', '.join(files)}")


if __name__ == "__main__":
    app.run(main)
