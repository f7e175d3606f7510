"""Plants every defect in a copy of every real scene and prints what jaxnerf.check finds.

    JAXNERF_SCENES=... python experiments/check_planted.py [scene ...]

A photograph that is the same file in several copies is read once, so only the first row of a scene, which is
the clean one, tells how long a check takes.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

import planting

from jaxnerf.capture_check import images as images_module
from jaxnerf.capture_check import report as report_module

SCENES = {"lego": "lego", "fern": "fern", "fox": "fox", "can": "can", "can as LLFF": "can"}


def defects(scene):
    """Returns name -> (kind of finding that is wanted, what plants it in a folder, flags of the check)."""
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
    if scene == "can":  # a quaternion cannot mirror
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
    """Returns inspect_photos._read such that what was seen in a photograph stands for every link to it."""
    kept, read = {}, images_module._read

    def remembered(frame):
        stat = frame.image.resolve().stat()
        key = frame.image.resolve(), stat.st_mtime_ns, frame.mask, frame.camera.height, frame.camera.width
        if key not in kept:
            kept[key] = read(frame)
        return kept[key]

    return remembered


def check(folder, wanted, flags):
    """Returns (verdict, lines) on a planted folder."""
    try:
        report = report_module.inspect(folder, **flags)
    except ValueError as error:
        line = str(error)
        return ("found by the reader" if wanted and wanted in line else "OTHER ERROR"), [line]
    ruins = [finding for finding in report.findings if finding.severity == "ruins"]
    right = [f for f in report.findings if wanted and (wanted == f.kind or wanted in f.found + f.wanted)]
    others = sorted({finding.kind for finding in ruins if finding not in right})
    if wanted is None:
        verdict = "WRONG ALARM" if ruins else "nothing ruins"
    else:
        verdict = f"found ({right[0].severity})" if right else "NOT FOUND"
    if others:
        verdict += f", also {', '.join(others)}"
    return verdict, [finding.line() for finding in right or ruins]


def main(names):
    images_module._read = read_once()
    for scene in names or SCENES:
        print(f"{scene}")
        for name, (wanted, plant, flags) in defects(scene).items():
            with tempfile.TemporaryDirectory() as temporary:
                without = {"can as LLFF": ("sparse",), "can": ("poses_bounds.npy",)}.get(scene, ())
                source = _scene_folder(SCENES[scene])
                folder = planting.copy(source, Path(temporary) / SCENES[scene], without=without)
                plant(folder)
                start, cpu = time.perf_counter(), time.process_time()
                verdict, lines = check(folder, wanted, flags)
                seconds = f"{time.perf_counter() - start:5.1f} s, {time.process_time() - cpu:5.1f} s of CPU"
                print(f"  {name:22} {verdict:34} {seconds}", flush=True)
                for line in lines[:2]:
                    print(f"      {line.replace(temporary, '')[:260]}", flush=True)


def _scene_folder(name):
    """Returns the folder of a real scene."""
    return Path(os.environ["JAXNERF_SCENES"]) / name


def _mirror(folder):
    planting.edit_poses(folder, planting.mirror)
    planting.mirror_points(folder)


def _swap(folder, first, second):
    files = planting.images(folder)
    planting.swap(files[first], files[second])


if __name__ == "__main__":
    main(sys.argv[1:])
