"""The metric card of a score: all that makes its figures comparable, and with which published tables.

It follows from the data alone: how the views were read, how many they are, and how large.
"""

import re

import numpy as np

METRICS = {
    "rounding": "psnr and ssim: 8 bits, to nearest, both images; psnr_float: none; psnr_truncated: 8 bits, "
    "the rendering cut off as the 2020 code's pictures are, the photograph to nearest",
    "ssim": "11 x 11 Gaussian window of deviation 1.5 where it fits, k1 0.01, k2 0.03, population variances, "
    "mean over windows and RGB",
    "data_range": 1.0,
    "pixels": "all; those that a mask leaves out are in no PSNR, and SSIM sees the photograph there",
    "mean": "of the images' figures",
    "lpips": "absent: its networks' weights come with no package",
}
_HELD_OUT = {  # what a reader takes as the split "test"
    "synthetic": "all that the embedded scene has",
    "blender": "all that transforms_test.json lists",
    "transforms": "all that the file's own lists name, else every 8th by name, from the first",
    "colmap": "every 8th by name, from the first",
    "llff": "every 8th by name, from the first",
}

# Published tables: what their images were, which figure of ours was taken as theirs, their pixel_offset.
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
    "psnr_truncated": "its pictures were truncated to 8 bits: set psnr_truncated beside it (truncation takes "
    "up to 0.02, 0.07 and 0.22 dB at 30, 35 and 40 dB, rounding to nearest 0.006, 0.018 and 0.055)",
    "psnr_float": "its renderings were not rounded: set psnr_float beside it (rounding to nearest takes "
    "0.006, 0.018 and 0.055 dB at 30, 35 and 40 dB)",
}


def metric_card(read, views, *, split):
    """Returns what results.json says of scores: {"conventions": ..., "comparable_with": ...}.

    Args:
        read: how the views were read, an Experiment's conventions.
        views: Views.
        split: of which they are all.
    """
    rule = _HELD_OUT[read["format"]] if split == "test" else f"all of the split {split!r}"
    if split == "held_out":
        rule = f"one in {read['hold_out']} of the training views"
    step = _number_step(views.names)
    skip = rule + (f"; the numbers in the names go up by {step}" if step else "")
    return card_of({**read, "split": split, "skip": skip}, views.size)


def card_of(known, size):
    """Returns the same for images of size [V, 2] (height, width); a dict says what else is known."""
    pairs = np.unique(np.asarray(size), axis=0).tolist()
    conventions = {**known, "views": len(size), "size": pairs[0] if len(pairs) == 1 else pairs, **METRICS}
    return {"conventions": conventions, "comparable_with": comparable_with(conventions)}


def comparable_with(found):
    """Returns for each published table whether figures of these conventions may be set beside it, and why.

    Where they may, "why" says what differs all the same, and how much that is worth where it is known.
    """
    rows = []
    for table, wanted, figure, pixel_offset in _TABLES:
        unlike = [
            f"{name} is {found.get(name, 'not known')}, there {value}"
            for name, value in wanted.items()
            if found.get(name) != value
        ]
        unlike += [
            f"trained without some of the training views ({name} {found[name]}), there with all"
            for name in ("hold_out", "num_views")
            if found.get(name)
        ]
        why = ["if the scene is the same", _WHY[figure]]
        if pixel_offset not in (None, found.get("pixel_offset")):
            worth = "worth about 1 dB by the text of JaxNeRF's flag" if wanted is _BLENDER else "of unknown worth"
            why.append(f"its rays have pixel_offset {pixel_offset:g}, here {found.get('pixel_offset')}: {worth}")
        rows.append({"table": table, "comparable": not unlike, "why": unlike or why})
    return rows


def _number_step(names):
    """Returns by how much the numbers that names end in go up, None where there is no one such step."""
    ends = [re.search(r"\d+$", name) for name in names]
    steps = set(np.diff([int(end[0]) for end in ends])) if all(ends) else set()
    return int(steps.pop()) if len(steps) == 1 else None
