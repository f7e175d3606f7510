"""The part "training" of speed_vs_error.py: curves of PSNR against seconds of training."""

import pathlib
import statistics
from collections.abc import Callable, Sequence
from typing import Any

import common

from jaxnerf.tools.curve.measure import covers, run_to


def _curve(config, seconds, **overrides):
    return {"config": config, "overrides": overrides, "seconds": seconds}


# Without a grid the small network has samples 0.03 apart where rays go from 2 to 6, and the octaves that
# auto_config infers from these images where the box is known.
_DENSE = {"sampler": "hierarchical", "sampling.num_fine": 0, "sampling.num_coarse": 133, "fine.num_freqs": 7}
# Where no space is known to be empty: no alpha, and the same octaves and sample distance with and without a grid.
_EMBEDDED = {"data.format": "synthetic", "data.factor": 1, "scene.use_alpha": False, "fine.num_freqs": 7}
_EMBEDDED["occupancy.step_size"] = 0.03
_FERN = {"data.format": "llff", "data.dir": "fern", "data.ndc": True, "data.background": "none"}
_FERN |= {"scene.use_alpha": False, "occupancy.step_size": 2 / 133, "fine.num_freqs": 7}
_FOX = {"data.format": "transforms", "data.dir": "fox"}
# No update ever empties a cell, nothing is occluded, and the same buffer takes all samples of fewer rays.
_NO_UPDATES = {
    "occupancy.update_every": 10**8,
    "occupancy.max_optical_depth": 0.0,
    "occupancy.pool_samples_per_ray": 243.0,
    "train.batch_size": 43,
}
# The learning rate that lego_mlp_fast.py had before Muon.
_ADAM = {"train.muon": 0.0, "train.lr_init": 8e-3, "train.lr_final": 3e-4, "train.lr_decay_power": 1.0}
_PAPER = {"data.format": "blender", "data.dir": "lego", "data.factor": 8}
CURVES = {
    "small network": _curve("lego_mlp_fast", (30, 60, 120, 240, 480)),
    "small network by Adam": _curve("lego_mlp_fast", (30, 60, 120, 240, 480), **_ADAM),
    "small network everywhere": _curve("lego_mlp_fast", (120, 480), **_DENSE),
    "embedded": _curve("lego_mlp_fast", (60, 180), **_EMBEDDED),
    "embedded everywhere": _curve("lego_mlp_fast", (60, 180), **_EMBEDDED | _DENSE),
    "fern": _curve("lego_mlp_fast", (120, 300), **_FERN),
    "fern everywhere": _curve("lego_mlp_fast", (120, 300), **_FERN | _DENSE),
    "fox": _curve("capture", (60, 120), **_FOX),
    "fox everywhere": _curve("capture", (60, 120), **_FOX | _NO_UPDATES),
    "dense": _curve("lego_small", (60, 120, 300, 600)),
    "paper": _curve("default", (600, 1800), **_PAPER),
    "paper skipping": _curve("default", (600, 1800), **_PAPER, **{"sampler": "occupancy"}),
}


_DETAILS = ("settings", "conventions", "comparable_with", "images")  # of a score, which a curve does not need


def measure(
    kept: dict[str, Any],
    save: Callable[[dict], None],
    folder: pathlib.Path,
    names: Sequence[str],
    seeds: Sequence[int],
    seconds: Sequence[float] = (),
) -> bool:
    """Trains a run for each time of each curve and scores the test views; kept points are not repeated.

    The learning rate reaches its end when the time does, so a point of a curve is no part of a longer run.

    Args:
        kept: what an earlier call saved, {} at first; it is extended.
        save: called with kept after each score.
        folder: of the workdirs.
        names: of CURVES.
        seeds: of each curve.
        seconds: in place of the curves' own.

    Returns:
        Whether all curves were completed (False: interrupted by Ctrl-C).
    """
    kept.setdefault("machine", common.describe_machine())
    for name in names:
        plan = CURVES[name]
        described = {"config": plan["config"], "overrides": plan["overrides"]}
        curve = kept.setdefault("curves", {}).setdefault(name, {**described, "runs": {}})
        if {key: curve[key] for key in described} != described:
            raise ValueError(f"{name}: was measured with {curve['overrides']}; give another --out")
        for seed in seeds:
            points = curve["runs"].setdefault(str(seed), [])
            for time_limit in sorted(seconds or plan["seconds"]):
                if any(covers(point, time_limit) for point in points):
                    continue
                point = run_to(time_limit, configuration(name, seed), folder / workdir_name(name, seed, time_limit))
                if point is None:
                    return False
                points.append({key: value for key, value in point.items() if key not in _DETAILS})
                points.sort(key=lambda point: point["time_limit"])
                save(kept)
                print(f"{name}, seed {seed}: {point['psnr']:.2f} dB in {point['seconds']:.0f} s", flush=True)
    return True


def configuration(name: str, seed: int = 0):
    """Returns the config of a curve."""
    return common.configuration(CURVES[name]["config"], CURVES[name]["overrides"], seed=seed)


def workdir_name(name: str, seed: int, time_limit: float) -> str:
    """Returns the name of the workdir of a curve's point."""
    return f"{name.replace(' ', '_')}-{seed}-{time_limit:g}"


def medians(runs: dict[str, list[dict]]) -> list[dict]:
    """Returns the points of a curve: the medians over its runs, at each time at which all were scored."""
    time_limits = sorted(set.intersection(*({point["time_limit"] for point in points} for points in runs.values())))
    found = []
    for time_limit in time_limits:
        same = [point for points in runs.values() for point in points if point["time_limit"] == time_limit]
        numbers = [key for key, value in same[0].items() if isinstance(value, (int, float))]
        found.append({key: statistics.median(point[key] for point in same) for key in numbers})
        found[-1]["seeds"] = [point["psnr"] for point in same]
    return found
