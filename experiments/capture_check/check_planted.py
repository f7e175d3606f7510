"""Plants every defect in a copy of every real scene and prints what jaxnerf-check finds.

    JAXNERF_SCENES=... python experiments/capture_check/check_planted.py [scene ...]

An image that several copies link to is read once, so only the first row of a scene, without a defect, shows
how long a check takes.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

import planting

from jaxnerf.tools.capture_check import images
from jaxnerf.tools.capture_check.report import inspect

SCENES = {"lego": "lego", "fern": "fern", "fox": "fox", "can": "can", "can as LLFF": "can"}


def defects(scene: str) -> dict[str, tuple]:
    """Returns name -> (the kind of finding expected, a function that plants the defect, flags of the check)."""
    edit = planting.edit_poses
    chosen = {
        "clean": (None, lambda folder: None, {}),
        "y and z flipped": ("axes", lambda folder: edit(folder, planting.flip(1, -1, -1)), {}),
        "z flipped": ("determinant", lambda folder: edit(folder, planting.flip(1, 1, -1)), {}),
        "x mirrored": ("determinant", lambda folder: edit(folder, planting.flip(-1, 1, 1)), {}),
        "world mirrored": ("axes", _mirror, {}),
        "focal x 0.8": ("focal", lambda folder: planting.scale_focal(folder, 0.8), {}),
        "focal x 1.2": ("focal", lambda folder: planting.scale_focal(folder, 1.2), {}),
        "far images swapped": ("swap", lambda folder: _swap(folder, 2, -3), {}),
        "next images swapped": ("swap", lambda folder: _swap(folder, 5, 6), {}),
        "image of 80 % size": ("size", lambda folder: planting.resize(planting.images(folder)[4], 0.8), {}),
        "image of 50 % size": ("size", lambda folder: planting.resize(planting.images(folder)[4], 0.5), {}),
        "truncated image": ("unreadable", lambda folder: planting.cut(planting.images(folder)[4]), {}),
        "flags in cm": ("bounds", lambda folder: None, {"near": 200.0, "far": 600.0}),
    }
    if scene == "can":  # its quaternions cannot mirror
        del chosen["z flipped"], chosen["x mirrored"]
    if scene in ("fern", "can as LLFF"):
        chosen["bounds in cm"] = ("bounds", lambda folder: planting.scale_bounds(folder, 100), {})
    if scene == "fox":
        chosen["frame without mask"] = (
            "mask",
            lambda folder: planting.add_masks(folder, without=["0007"]),
            {},
        )
        chosen["mask file missing"] = (
            "mask",
            lambda folder: planting.add_masks(folder, unwritten=["0007"]),
            {},
        )
    else:
        chosen["image without alpha"] = ("alpha", lambda folder: planting.remove_alpha(folder, 3), {})
    return chosen


def read_once():
    """Returns a replacement of images._summarize that reads each file once, however many links lead to it."""
    kept, summarize = {}, images._summarize

    def remembered(frame, longest):
        stat = frame.image.resolve().stat()
        key = frame.image.resolve(), stat.st_mtime_ns, frame.mask, frame.camera.height, longest
        if key not in kept:
            kept[key] = summarize(frame, longest)
        return kept[key]

    return remembered


def check(folder: Path, expected: str | None, flags: dict) -> tuple[str, list[str]]:
    """Checks a folder and returns (verdict, lines)."""
    try:
        findings = inspect(folder, **flags).findings
    except ValueError as error:
        line = str(error)
        return ("found by the reader" if expected and expected in line else "OTHER ERROR"), [line]
    errors = [finding for finding in findings if finding.severity == "error"]
    right = [f for f in findings if expected and (expected == f.kind or expected in f.found + f.expected)]
    others = sorted({finding.kind for finding in errors if finding not in right})
    if expected is None:
        verdict = "FALSE ALARM" if errors else "no error"
    else:
        verdict = f"found ({right[0].severity})" if right else "NOT FOUND"
    if others:
        verdict += f", also {', '.join(others)}"
    return verdict, [finding.line() for finding in right or errors]


def main(names: list[str]) -> None:
    """Plants and checks every defect in the named scenes, or in all."""
    images._summarize = read_once()
    for scene in names or SCENES:
        print(f"{scene}")
        for name, (expected, plant, flags) in defects(scene).items():
            with tempfile.TemporaryDirectory() as temporary:
                without = {"can as LLFF": ("sparse",), "can": ("poses_bounds.npy",)}.get(scene, ())
                source = _dataset_folder(SCENES[scene])
                folder = planting.copy(source, Path(temporary) / SCENES[scene], without=without)
                plant(folder)
                start, cpu = time.perf_counter(), time.process_time()
                verdict, lines = check(folder, expected, flags)
                seconds = f"{time.perf_counter() - start:5.1f} s, {time.process_time() - cpu:5.1f} s of CPU"
                print(f"  {name:22} {verdict:34} {seconds}", flush=True)
                for line in lines[:2]:
                    print(f"      {line.replace(temporary, '')[:260]}", flush=True)


def _dataset_folder(name):
    return Path(os.environ["JAXNERF_SCENES"]) / name


def _mirror(folder):
    planting.edit_poses(folder, planting.mirror)
    planting.mirror_points(folder)


def _swap(folder, first, second):
    files = planting.images(folder)
    planting.swap(files[first], files[second])


if __name__ == "__main__":
    main(sys.argv[1:])
