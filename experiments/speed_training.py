"""The training part of speed_vs_error.py: curves of error against seconds."""

import importlib
import pathlib
import time

import speed_machine

from jaxnerf.evaluation.evaluate import evaluate, train_and_evaluate
from jaxnerf.training import metric_log, workdir


def _curve(config, seconds, **overrides):
    return {"config": config, "overrides": overrides, "seconds": seconds}


# The small network along whole rays: samples 0.03 apart where rays go from 2 to 6, and the octaves that
# engine.fit chooses for these images where it knows a box.
_DENSE = {"sampler": "hierarchical", "sampling.num_fine": 0, "sampling.num_coarse": 133}
_DENSE["fine.num_freqs"] = 7
# Where nothing is known to be empty: no alpha, and octaves and steps as far apart with skipping as without.
_EMBEDDED = {"data.format": "synthetic", "data.factor": 1, "occupancy.use_alpha": False, "fine.num_freqs": 7}
_EMBEDDED["occupancy.step_size"] = 0.03
_FERN = {"data.format": "llff", "data.dir": "fern", "data.ndc": True, "data.background": "none"}
_FERN |= {"occupancy.use_alpha": False, "occupancy.step_size": 2 / 133, "fine.num_freqs": 7}
_FOX = {"data.format": "transforms", "data.dir": "fox"}
# No look ever finds a cell empty, nothing is hidden, and the same pool takes all steps of fewer rays.
_NO_LOOKS = {
    "occupancy.update_every": 10**8,
    "occupancy.max_optical_depth": 0.0,
    "occupancy.long_steps_until": 0,
}
_NO_LOOKS |= {"occupancy.pool_samples_per_ray": 243, "train.batch_size": 43}
# At the rate that lego_mlp_fast.py had before Muon.
_ADAM = {"train.muon": 0.0, "train.lr_init": 8e-3, "train.lr_final": 3e-4}
_PAPER = {"data.format": "blender", "data.dir": "lego", "data.factor": 8}
CURVES = {
    "grid": _curve("lego_fast", (15, 30, 45, 60, 90, 120, 180, 300)),
    "grid without alpha": _curve("lego_fast", (30, 60, 90, 180, 300), **{"occupancy.use_alpha": False}),
    "grid 200": _curve("lego_fast", (30, 60, 100, 180, 360), **{"data.factor": 4}),
    "grid 400": _curve("lego_fast", (60, 150, 300, 600), **{"data.factor": 2}),
    "small network": _curve("lego_mlp_fast", (30, 60, 120, 240, 480)),
    "small network by Adam": _curve("lego_mlp_fast", (30, 60, 120, 240, 480), **_ADAM),
    "small network everywhere": _curve("lego_mlp_fast", (120, 480), **_DENSE),
    "embedded": _curve("lego_mlp_fast", (60, 180), **_EMBEDDED),
    "embedded everywhere": _curve("lego_mlp_fast", (60, 180), **_EMBEDDED | _DENSE),
    "fern": _curve("lego_mlp_fast", (120, 300), **_FERN),
    "fern everywhere": _curve("lego_mlp_fast", (120, 300), **_FERN | _DENSE),
    "fox": _curve("capture", (60, 120), **_FOX),
    "fox everywhere": _curve("capture", (60, 120), **_FOX | _NO_LOOKS),
    "dense": _curve("lego_small", (60, 120, 300, 600)),
    "paper": _curve("default", (600, 1800), **_PAPER),
    "paper skipping": _curve("default", (600, 1800), **_PAPER, **{"sampler": "occupancy"}),
}
SEEDED = "grid"  # the curve that is run with several seeds


def measure(kept, save, folder, names, seeds, seconds=()):
    """Runs curves to each of their times and scores the test views there; what is kept is not run again.

    Args:
        kept: what an earlier call saved, {} at first; is added to.
        save: is called after each score.
        folder: where the workdirs lie.
        names: of CURVES.
        seeds: of the curve SEEDED; of the others the first.
        seconds: in place of the curves' own.

    Returns:
        Whether all came to their end (False: stopped by Ctrl-C).
    """
    kept.setdefault("machine", speed_machine.describe())
    for name in names:
        plan = CURVES[name]
        described = {"config": plan["config"], "overrides": plan["overrides"]}
        curve = kept.setdefault("curves", {}).setdefault(name, {**described, "runs": {}})
        if {key: curve[key] for key in described} != described:
            raise ValueError(f"{name}: was measured with {curve['overrides']}; give another --out")
        for seed in seeds if name == SEEDED else seeds[:1]:
            points = curve["runs"].setdefault(str(seed), [])
            where = pathlib.Path(folder) / workdir_name(name, seed)
            for stop in sorted(seconds or plan["seconds"]):
                if points and (stop <= points[-1]["stop"] or points[-1]["ended"]):
                    continue
                point = run_to(stop, configuration(name, seed), where, points[-1] if points else None)
                if point is None:
                    return False
                points.append(point)
                save(kept)
                print(f"{name}, seed {seed}: {point['psnr']:.2f} dB in {point['seconds']:.0f} s", flush=True)
    return True


def configuration(name, seed=0):
    """Returns the configuration of a curve."""
    config = importlib.import_module(f"configs.{CURVES[name]['config']}").get_config()
    config.update_from_flattened_dict({**CURVES[name]["overrides"], "seed": seed})
    return config


def workdir_name(name, seed):
    return f"{name.replace(' ', '_')}-{seed}"


def run_to(stop, config, where, before):
    """Returns the scores of a run after so many seconds of training, or None where it was interrupted.

    before: the point at which it went on, or None. Comparable seconds add up over the pieces, each by the
    machine's speed just before and after it.
    """
    config.train.max_seconds = float(stop)
    fresh = not metric_log.read_rows(where)
    speed, started = [speed_machine.matrix_gflops()], time.perf_counter()
    if not train_and_evaluate(config, where):
        return None
    wall = time.perf_counter() - started
    speed.append(speed_machine.matrix_gflops())
    result = evaluate(where, overwrite=True)
    trained, compiling = result["training_seconds"], result["compile_seconds"]
    last = before or {"seconds": 0.0, "comparable": 0.0, "compile_seconds": compiling, "setup_seconds": None}
    piece = trained - last["seconds"]
    return {
        "stop": stop,
        "ended": result["step"] >= workdir.read_config(where).train.max_steps,
        "seconds": trained,
        "comparable": last["comparable"] + speed_machine.comparable(piece, sum(speed) / 2),
        "gflops": speed,
        "compile_seconds": last["compile_seconds"],  # of the first start
        "setup_seconds": wall - trained - compiling if fresh else last["setup_seconds"],
        "rays": result["rays_seen"],
        **{key: result[key] for key in ("step", "psnr", "ssim", "seconds_per_frame", "views", "parameters")},
    }
