"""Compares the parameters that two checkouts train, bit for bit, with the same flags on the same machine.

    python experiments/stability/same_bits.py --other=/path/to/another/checkout

It prints a line for each case, and exits with 1 if any differ. A change of the code that should not change training is
checked by it; the runs are kept in --out and not repeated.
"""

import json
import pathlib
import subprocess
import sys

from absl import app, flags

_OTHER = flags.DEFINE_string("other", None, "The other checkout.", required=True)
_STEPS = flags.DEFINE_integer("steps", 300, "The training steps of each run.", lower_bound=1)
_OUT = flags.DEFINE_string("out", "runs/same_bits", "The folder of the runs.")
_CASES = flags.DEFINE_list("cases", [], "Of lego_fast, capture and paper; empty: all.")

ROOT = pathlib.Path(__file__).resolve().parents[2]
CASES = {
    "lego_fast": ["--config=lego_fast", "--config.data.factor=8"],
    # The clock would decide about the learning rate.
    "capture": ["--config=capture", "--data_dir=fox", "--config.train.max_seconds=0"],
    "paper": ["--config=default", "--config.data.size=24", "--config.train.batch_size=32"],
}
_READ = """
import hashlib, jax, json, sys
import numpy as np
import jaxnerf
params = jaxnerf.restore_run(sys.argv[1]).variables(int(sys.argv[2]))[0]
leaves = jax.tree_util.tree_leaves_with_path(params)
digest = hashlib.sha256()
for path, leaf in leaves:
    digest.update(jax.tree_util.keystr(path).encode() + np.asarray(leaf).tobytes())
print(json.dumps({"sha256": digest.hexdigest(), "numbers": sum(leaf.size for _, leaf in leaves)}))
"""


def main(argv):
    del argv
    differ = []
    for name in _CASES.value or CASES:
        first, second = (parameters(checkout, name) for checkout in (ROOT, pathlib.Path(_OTHER.value).resolve()))
        same = first == second
        print(f"{name:10} {first['numbers']:,} numbers after {_STEPS.value} steps: {'equal' if same else 'DIFFERENT'}")
        differ += [] if same else [name]
    sys.exit(1 if differ else 0)


def parameters(checkout, name):
    """Returns the fingerprint of the parameters that a checkout trains."""
    folder = pathlib.Path(_OUT.value).resolve() / f"{checkout.name}-{name}-{_STEPS.value}"
    steps = [f"--config.train.{field}={_STEPS.value}" for field in ("max_steps", "lr_steps", "save_every")]
    quiet = ["--config.train.preview_every=0", "--config.eval.summary_seconds=0"]
    _run(checkout, ["-m", "jaxnerf.train", *CASES[name], *steps, *quiet, f"--workdir={folder}"])
    return json.loads(_run(checkout, ["-c", _READ, str(folder), str(_STEPS.value)]))


def _run(checkout, arguments):
    done = subprocess.run([sys.executable, *arguments], cwd=checkout, capture_output=True, text=True)
    if done.returncode:
        raise ValueError(f"{checkout}: {' '.join(arguments[:4])} failed: {done.stderr.strip().splitlines()[-1]}")
    return done.stdout


if __name__ == "__main__":
    app.run(main)
