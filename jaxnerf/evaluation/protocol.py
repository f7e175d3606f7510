"""The protocol of an evaluation: what its metrics depend on, and the published tables comparable with them.

It depends on the data alone: how the views were read, how many there are, and how large they are.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from jaxnerf.core.views import Views
from jaxnerf.evaluation.metrics import lpips_convention

METRICS = {
    "rounding": "psnr and ssim: 8 bits, to nearest, both images; psnr_float: none; psnr_truncated: 8 bits, "
    "the rendering truncated as by the 2020 code, the dataset's image to nearest",
    "ssim": "11 x 11 Gaussian window of deviation 1.5 where it fits, k1 0.01, k2 0.03, population variances, "
    "mean over windows and RGB",
    "alignment": "psnr_aligned, ssim_aligned: psnr and ssim after each channel of a rendering is multiplied by the "
    "gain that brings it closest to the dataset's image, by least squares",
    "data_range": 1.0,
    "pixels": "all; PSNR excludes masked pixels, and SSIM sees the dataset's image there",
    "mean": "over the images",
}
# Published tables: the protocol of their images, the metric of ours that corresponds, their pixel_offset.
_BLENDER = {"format": "blender", "split": "test", "factor": 1, "size": [800, 800], "views": 200}
_BLENDER["background"] = "white"
_LLFF = {"format": "llff", "split": "test", "factor": 4, "size": [756, 1008]}
_TABLES = (
    ("NeRF (arXiv:2003.08934), synthetic scenes", _BLENDER, "psnr_truncated", 0.0),
    ("JaxNeRF, synthetic scenes", _BLENDER, "psnr_float", 0.0),
    ("nerfbaselines, synthetic scenes", _BLENDER, "psnr_truncated", None),
    ("NeRF (arXiv:2003.08934), forward-facing scenes", _LLFF, "psnr_truncated", 0.0),
    ("JaxNeRF, forward-facing scenes", _LLFF, "psnr_float", 0.0),
)
_WHY = {
    "psnr_truncated": "its images were truncated to 8 bits: compare psnr_truncated (truncation costs up to "
    "0.02, 0.07 and 0.22 dB at 30, 35 and 40 dB, rounding to nearest 0.006, 0.018 and 0.055)",
    "psnr_float": "its renderings were not rounded: compare psnr_float (rounding to nearest costs 0.006, 0.018 "
    "and 0.055 dB at 30, 35 and 40 dB)",
}


def of_views(conventions: Mapping[str, Any], views: Views, *, split: str) -> dict[str, Any]:
    """Returns what results.json states about its metrics: {"conventions": ..., "comparable_with": ...}.

    Args:
        conventions: how the views were read, see `dataset.conventions`.
        views: Views, all of the split.
        split: its name.
    """
    conventions = dict(conventions)
    of_test = conventions.pop("test_split", "all that the dataset has")
    rule = of_test if split == "test" else f"all of {split!r}"
    if split == "held_out":
        rule = f"one in {conventions['hold_out']} of the training views"
    if shared := conventions.pop("shared_with_training", {}).get(split):
        conventions["shared_with_training"] = shared
    step = _number_step(views.names)
    selection = rule + (f"; the numbers in the names go up by {step}" if step else "")
    return of_images({**conventions, "split": split, "selection": selection}, views.size)


def of_images(conventions: Mapping[str, Any], size: ArrayLike | Sequence[Sequence[int]]) -> dict[str, Any]:
    """Returns the same as `of_views` for images of size [V, 2] (height, width), with any known conventions."""
    pairs = np.unique(np.asarray(size), axis=0).tolist()
    of_metrics = {**METRICS, "lpips": lpips_convention()}
    found = {**conventions, "views": len(size), "size": pairs[0] if len(pairs) == 1 else pairs, **of_metrics}
    return {"conventions": found, "comparable_with": comparable_with(found)}


def comparable_with(conventions: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Returns for each published table whether metrics of these conventions are comparable with it, and why.

    If they are, "why" states the remaining differences, in dB where that is known.
    """
    rows = []
    for table, expected, metric, pixel_offset in _TABLES:
        differences = [
            f"{name} is {conventions.get(name, 'not known')}, there {value}"
            for name, value in expected.items()
            if conventions.get(name) != value
        ]
        differences += [
            f"trained without some of the training views ({name} {conventions[name]}), there with all"
            for name in ("hold_out", "num_views", "view_indices")
            if conventions.get(name)
        ]
        if shared := conventions.get("shared_with_training"):
            differences.append(f"{shared['count']} of the views were trained on, there none")
        why = ["if the scene is the same", _WHY[metric]]
        offset = conventions.get("pixel_offset")
        if pixel_offset not in (None, offset):
            effect = "about 1 dB by the text of JaxNeRF's flag" if expected is _BLENDER else "of unknown effect"
            why.append(f"its rays have pixel_offset {pixel_offset:g}, here {offset}: {effect}")
        rows.append({"table": table, "comparable": not differences, "why": differences or why})
    return rows


def _number_step(names: Sequence[str]) -> int | None:
    """Returns the difference between the numbers that consecutive names end in, None where it varies."""
    ends = [re.search(r"\d+$", name) for name in names]
    steps = set(np.diff([int(end[0]) for end in ends])) if all(ends) else set()
    return int(steps.pop()) if len(steps) == 1 else None
