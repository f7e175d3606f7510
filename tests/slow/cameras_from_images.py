"""Estimates the cameras of real captures from their images alone and compares them with the given ones.

    JAXNERF_SCENES=DIR PYTHONPATH=.:tests python tests/slow/cameras_from_images.py [FOLDER [SCENE...]]

Runs jaxnerf-cameras on the images of `can` and `fox` (about 5 minutes on one core), aligns the cameras with the
given ones by a similarity, and prints the time, the number of registered images, the median and largest rotation
error, the position error as a fraction of the RMS distance of the cameras from their centroid, and the largest
rotation between consecutive images, estimated and given. Then it runs jaxnerf-check on the result. Exits with 1 if
a limit is exceeded. With the same folder, finished scenes are kept.

The can has one label on its front and back, and the given model of `can` folds the circle of its cameras into a
half: the poses jump by 167 to 174 degrees at images 14, 35 and 53, where consecutive images show one wall and their
matches give 7 to 16 degrees. The parts between these jumps are compared, each after an alignment of its own. fox
has its principal point 16 px from the images' centre, where COLMAP keeps it, which turns its cameras by 0.65 degrees.
"""

import os
import pathlib
import re
import subprocess
import sys
import tempfile
import time

import numpy as np

import runs
from jaxnerf.data.readers.base import read_capture

# Scene: the smallest fraction of registered images, and the largest median error in degrees and of the position.
LIMITS = {"can": (0.95, 1.0, 0.05), "fox": (0.95, 1.0, 0.01)}
PARTS = {"can": (0, 14, 35, 53)}  # the first image of each part
MAX_TURN = 45.0  # degrees between consecutive images of `can`
MAX_SIZE = 800  # px, for speed


def main(folder, scenes=tuple(LIMITS)):
    """Runs all scenes in a folder; returns whether all are within the limits."""
    source, good = pathlib.Path(os.environ["JAXNERF_SCENES"]), True
    columns = ("scene", "seconds", "CPU seconds", "registered", "rotation median, max", "position median, max")
    columns += ("largest turn: estimated, given", "points")
    print(f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}", flush=True)
    for scene in scenes:
        out = folder / scene
        elapsed, cpu = estimate(source / scene / "images", out, folder / f"{scene}.txt")
        found, given = read_capture(out), read_capture(source / scene)
        assert found.format == "colmap" and found.points is not None, out
        found_poses, given_poses = poses_by_name(found), poses_by_name(given)
        degrees, offsets = pose_errors(found_poses, given_poses, PARTS.get(scene, (0,)))
        turns = largest_turn(found_poses), largest_turn(given_poses)
        count = f"{len(found.frames)} of {len(given.frames)}"
        cells = (f"{elapsed:.0f}", f"{cpu:.0f}", count, spread(degrees), spread(offsets))
        cells += ("{:.0f}, {:.0f}".format(*turns), len(found.points))
        print(f"| {scene} | {' | '.join(map(str, cells))} |", flush=True)
        fraction, max_degrees, max_offset = LIMITS[scene]
        good &= len(found.frames) >= fraction * len(given.frames)
        good &= bool(np.median(degrees) <= max_degrees and np.median(offsets) <= max_offset)
        good &= scene not in PARTS or turns[0] <= MAX_TURN
        good &= check(out, folder / f"check-{scene}.png")
    print("all within the limits" if good else "NOT within the limits")
    return good


def estimate(images, out, report):
    """Runs jaxnerf-cameras unless its result exists; returns its wall and CPU seconds."""
    if not report.exists():
        start, before = time.monotonic(), os.times()
        flags = (f"--images={images}", f"--out={out}", f"--max_size={MAX_SIZE}", "--num_threads=1")
        command = [sys.executable, "-m", runs.module_of("cameras"), *flags]
        text = subprocess.run(command, cwd=runs.ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout
        after = os.times()
        cpu = after.children_user + after.children_system - before.children_user - before.children_system
        report.write_text(f"{text}seconds {time.monotonic() - start:.1f} {cpu:.1f}\n")
    text = report.read_text()
    print(text, file=sys.stderr)
    return map(float, re.search(r"^seconds (\S+) (\S+)$", text, re.MULTILINE).groups())


def check(out, plot):
    """Returns whether jaxnerf-check finds no error in a dataset, and the points in it."""
    command = [sys.executable, "-m", runs.module_of("check"), f"--data_dir={out}", f"--out={plot}"]
    done = subprocess.run(command, cwd=runs.ROOT, stdout=subprocess.PIPE, text=True)
    print(done.stdout, file=sys.stderr)
    return done.returncode == 0 and "points on which the images agree" in done.stdout


def poses_by_name(capture):
    return {pathlib.PurePath(frame.name).name: np.asarray(frame.camera.to_world) for frame in capture.frames}


def pose_errors(found, given, starts):
    """Returns the errors [V] of poses in degrees, and of positions relative to the spread, after alignment of parts."""
    names, errors = sorted(given), []
    for start, end in zip(starts, [*starts[1:], len(names)], strict=True):
        common = [name for name in names[start:end] if name in found]
        a, b = (np.stack([poses[name] for name in common]) for poses in (found, given))
        scale, turn, offset = similarity(a[:, :, 3], b[:, :, 3])
        size = np.linalg.norm(b[:, :, 3] - b[:, :, 3].mean(axis=0), axis=1)
        distance = np.linalg.norm(scale * a[:, :, 3] @ turn.T + offset - b[:, :, 3], axis=1)
        errors.append((angles(turn @ a[:, :, :3], b[:, :, :3]), distance / np.sqrt((size**2).mean())))
    return map(np.concatenate, zip(*errors, strict=True))


def largest_turn(poses):
    """Returns the largest rotation between consecutive images, in degrees."""
    rotations = np.stack([poses[name][:, :3] for name in sorted(poses)])
    return angles(rotations[:-1], rotations[1:]).max()


def angles(a, b):
    """Returns the angles [V] between rotations [V, 3, 3], in degrees."""
    cosine = ((a * b).sum(axis=(1, 2)) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def similarity(a, b):
    """Returns scale, rotation and offset that map points a [N, 3] closest to b [N, 3] (Umeyama 1991)."""
    centers = a.mean(axis=0), b.mean(axis=0)
    x, y = a - centers[0], b - centers[1]
    left, values, right = np.linalg.svd(y.T @ x)
    signs = np.array([1, 1, np.sign(np.linalg.det(left @ right))])
    turn = left * signs @ right
    scale = (values * signs).sum() / (x**2).sum()
    return scale, turn, centers[1] - scale * turn @ centers[0]


def spread(errors):
    return f"{np.median(errors):.3g}, {errors.max():.3g}"


if __name__ == "__main__":
    place = pathlib.Path(sys.argv[1]) if len(sys.argv) > 1 else pathlib.Path(tempfile.mkdtemp())
    place.mkdir(parents=True, exist_ok=True)
    sys.exit(0 if main(place, *([sys.argv[2:]] if sys.argv[2:] else [])) else 1)
