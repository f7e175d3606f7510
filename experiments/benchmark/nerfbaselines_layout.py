"""Writes scores in the layout of the results files of nerfbaselines (https://github.com/nerfbaselines/nerfbaselines).

A results file is JSON. "metrics" has the means, rounded to 5 decimals, and "metrics_raw" the values of all images as
base64 of little-endian float32, in the order of the images' names as text, so that r_10 precedes r_2. The values are
those that nerfbaselines computes from the PNG files of an evaluation here: colours of 8 bits, rounded to nearest where
its own renderings are truncated, which costs up to 0.07 dB at 35 dB. What is filled:

- "metrics", "metrics_raw": psnr, ssim, mse, mae, and lpips_vgg where LPIPS was computed. Its "lpips", with AlexNet, is
  absent.
- "metrics_sha256": of metrics_raw, as nerfbaselines computes it. "predictions_sha256", "ground_truth_sha256": of the
  PNG files in that order; absent where the folder of images is gone.
- "evaluation_protocol": "nerf" for Blender and LLFF, otherwise "default".
- "nb_info": method, num_iterations, total_train_time (seconds of training, without set-up and compilation),
  resources_utilization (MB), datetime, config_overrides, dataset_metadata and hparams (the whole config). There is no
  checkpoint_sha256 and no nb_version, as nerfbaselines did not run. "image_names" and "jaxnerf" (commit, machine and
  conventions) are additions.

"evaluate_version" names this project in place of a version of nerfbaselines.
"""

import base64
import hashlib
import pathlib
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from benchmark import jobs

import jaxnerf
from jaxnerf.data.images.image_files import read_stored

_DECIMALS = 5


def results_of(score: Mapping[str, Any], folder: pathlib.Path) -> dict[str, Any]:
    """Returns the content of a results file.

    Args:
        score: of a run, as jaxnerf.tools.curve.one_run writes it.
        folder: the workdir of the run, whose images are hashed and compared.
    """
    order = sorted(range(len(score["images"])), key=lambda index: score["images"][index]["name"])
    rows = [score["images"][index] for index in order]
    images = folder / "eval" / str(score["step"])
    values = {"psnr": [row["psnr"] for row in rows], "ssim": [row["ssim"] for row in rows]}
    values["mse"] = [10 ** (-row["psnr"] / 10) for row in rows]
    if all("lpips" in row for row in rows):
        values["lpips_vgg"] = [row["lpips"] for row in rows]
    paths = {kind: [images / kind / f"{index:03d}.png" for index in order] for kind in ("color", "gt-color")}
    hashes = {}
    if all(path.is_file() for files in paths.values() for path in files):
        values["mae"] = [_mean_absolute_error(*pair) for pair in zip(*paths.values(), strict=True)]
        hashes = {"predictions_sha256": _hash(paths["color"]), "ground_truth_sha256": _hash(paths["gt-color"])}
    job, when = jobs.JOBS[score["job"]], score["datetime"]
    protocol = jobs.PROTOCOLS[job.protocol]
    info = {
        "method": "jaxnerf",
        "num_iterations": score["step"],
        "total_train_time": round(score["seconds"], _DECIMALS),
        "resources_utilization": _resources(score),
        "datetime": when,
        "config_overrides": {"config": job.config, **score["overrides"], "train.max_seconds": score["time_limit"]},
        "dataset_metadata": _dataset(score, job, protocol),
        "evaluation_protocol": protocol.evaluation,
        "hparams": score["config"],
        "image_names": [row["name"] for row in rows],
        "jaxnerf": {key: score[key] for key in ("job", "commit", "machine", "conventions")},
    }
    return {
        "nb_info": info,
        "evaluate_datetime": when,
        "evaluate_version": f"jaxnerf {jaxnerf.__version__}",
        "metrics": {name: round(float(np.mean(each)), _DECIMALS) for name, each in values.items()},
        "metrics_raw": {name: encode(each) for name, each in values.items()},
        "metrics_sha256": _hash_of_metrics(values),
        **hashes,
        "evaluation_protocol": protocol.evaluation,
    }


def encode(values: Sequence[float]) -> str:
    """Returns numbers as base64 of little-endian float32."""
    return base64.b64encode(struct.pack(f"<{len(values)}f", *values)).decode("ascii")


def decode(text: str) -> list[float]:
    """Returns the numbers that `encode` wrote."""
    content = base64.b64decode(text)
    return list(struct.unpack(f"<{len(content) // 4}f", content))


def _dataset(score, job, protocol):
    """Returns the metadata of a dataset; the scene's name alone would stand for images of full size."""
    found = {"id": protocol.dataset, "scene": pathlib.Path(job.dataset).name, "color_space": "srgb"}
    if score["conventions"].get("background") == "white":
        found["background_color"] = [255, 255, 255]
    found |= {"downscale_factor": score["conventions"].get("factor"), "image_size": score["conventions"].get("size")}
    return {**found, "evaluation_protocol": protocol.evaluation}


def _resources(score):
    found = {"memory": round(score["peak_memory_mb"])}
    if score["peak_device_memory_mb"]:
        found |= {"gpu_memory": round(score["peak_device_memory_mb"]), "gpu_name": score["device"]}
    return found


def _mean_absolute_error(color, truth):
    pair = [read_stored(path).astype(float) / 255 for path in (color, truth)]
    return float(np.mean(np.abs(pair[0] - pair[1])))


def _hash(paths):
    found = hashlib.sha256()
    for path in paths:
        found.update(path.read_bytes())
    return found.hexdigest()


def _hash_of_metrics(values):
    """Returns the hash of metrics by name: each name, its sorted values as `encode` writes them, a newline."""
    found = hashlib.sha256()
    for name in sorted(values):
        found.update(f"{name}{encode(sorted(values[name]))}\n".encode())
    return found.hexdigest()
