"""Compares runs on 1, 2, 4 and 8 devices and in 2 processes with 2 devices each; takes a quarter of an hour.

    PYTHONPATH=.:tests python tests/slow/device_matrix.py [FOLDER [dense|packed [float32|float64]]]

Trains configs/smoke.py ("dense") and the same with a hash grid and the occupancy sampler ("packed"), each in
processes of its own with virtual CPU devices; scores it; and prints the largest differences from the run on one
device: of parameters and grid, and of any view's PSNR. Exits with 1 if a limit is exceeded or a ray was
dropped. With the same folder, finished runs are kept.
"""

import json
import pathlib
import sys
import tempfile

import jax
import numpy as np

import runs
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.training import metric_log

STEPS, LIMITS = {"float32": 10, "float64": 50}, {"float32": 1e-6, "float64": 1e-9}
SCORE_LIMIT = 1e-5  # dB
PLACES = {"1 device": (1, 1), "2 devices": (1, 2), "4 devices": (1, 4), "8 devices": (1, 8), "2 x 2": (2, 2)}


def main(folder, models=("dense", "packed"), precisions=tuple(STEPS)):
    """Runs the matrix in a folder; returns whether all differences are within the limits."""
    good = True
    print("| model | precision | steps | on | parameters differ by | PSNR by, dB | rays dropped |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for model in models:
        for precision in precisions:
            steps = STEPS[precision]
            one = train(folder, model, precision, "1 device")
            for place in list(PLACES)[1:]:
                found = train(folder, model, precision, place)
                apart, scores = difference(one, found)
                good &= apart <= LIMITS[precision] and scores <= SCORE_LIMIT and found["rays_dropped"] == 0
                cells = (
                    model,
                    precision,
                    steps,
                    place,
                    f"{apart:.1e}",
                    f"{scores:.1e}",
                    found["rays_dropped"],
                )
                print(f"| {' | '.join(map(str, cells))} |", flush=True)
    print("all within the limits" if good else "NOT within the limits")
    return good


def train(folder, model, precision, place):
    """Returns the variables, the metrics of each image and the number of dropped rays of a run."""
    target = folder / "-".join((model, precision, place.replace(" ", "")))
    processes, devices = PLACES[place]
    flags = ["--config=configs/smoke.py", f"--workdir={target}", "--config.eval.at_end=True"]
    flags += [f"--config.train.max_steps={STEPS[precision]}"]
    flags += runs.as_flags(runs.PACKED if model == "packed" else {})
    flags += [f"--config.{name}.compute_dtype={precision}" for name in ("coarse", "fine")]
    wide = str(int(precision == "float64"))
    program = "wide_train.py" if precision == "float64" else "train"
    environment = {
        "PYTHONPATH": f"{runs.ROOT}:{runs.ROOT / 'tests'}",
        "JAX_NUM_CPU_DEVICES": str(devices),
        "JAX_PLATFORMS": "cpu",
        "JAX_ENABLE_X64": wide,
    }
    if (target / "eval" / str(STEPS[precision]) / "results.json").exists():
        started = []
    elif processes > 1:
        started = runs.start_together(processes, program, *flags, **environment)
    else:
        started = [runs.start(program, *flags, **environment)]
    for process in started:
        _, err = process.communicate()
        if process.returncode:
            raise RuntimeError(err)
    jax.config.update("jax_enable_x64", precision == "float64")
    run = restore_run(target)
    variables = jax.device_get(run.variables(STEPS[precision]))
    results = json.loads((target / "eval" / str(STEPS[precision]) / "results.json").read_text())
    rays_dropped = metric_log.read_rows(target)[-1]["rays_dropped"]
    return {"variables": variables, "rows": results["images"], "rays_dropped": rays_dropped}


def difference(one, other):
    """Returns the largest differences of two runs: of variables, and of the PSNR of any view in dB."""
    pairs = zip(jax.tree.leaves(one["variables"]), jax.tree.leaves(other["variables"]), strict=True)
    apart = max(float(np.abs(np.subtract(a, b, dtype=np.float64)).max()) for a, b in pairs)
    rows = zip(one["rows"], other["rows"], strict=True)
    return apart, max(abs(a[key] - b[key]) for a, b in rows for key in ("psnr", "psnr_float"))


if __name__ == "__main__":
    place = pathlib.Path(sys.argv[1]) if len(sys.argv) > 1 else pathlib.Path(tempfile.mkdtemp())
    sys.exit(0 if main(place, *([name] for name in sys.argv[2:4])) else 1)
