"""Measures how many planted images jaxnerf-check accuses, and how many good ones.

    JAXNERF_SCENES=... python experiments/capture_check/precision_recall.py [--images=10] [--seed=0]

Each check has one planted defect, in one random image (a swap concerns two). Images are read once for each scene, and
each pair of images is matched once, so that only the judgement of the views is repeated.
"""

import argparse
import functools
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
import common

from jaxnerf.data.geometry.poses import neighbours
from jaxnerf.data.geometry.world import poses_of
from jaxnerf.data.readers.base import read_capture
from jaxnerf.tools.capture_check import cameras, images, report, tracks, view_evidence
from test_scenes import synthetic_capture

SCENES = ("fern", "fox", "can", "lego")
PERIODS = (0.12, 0.3)  # of the dots in the embedded room, world units
DEFECTS = ("swapped with the next image", "swapped with a far image", "camera turned by 30 degrees", "camera displaced")


def main(count: int, seed: int) -> None:
    """Measures all scenes and prints the table."""
    cached = functools.cache(lambda first, second: tracks_match(*(_KEPT[key] for key in (first, second))))
    tracks_match = tracks.match
    remembered = lambda first, second: cached(_keep(first), _keep(second))  # noqa: E731
    tracks.match = view_evidence.match = remembered
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folders = {name: Path(os.environ["JAXNERF_SCENES"]) / name for name in SCENES}
        for period in PERIODS:
            name = f"room with dots every {period}"
            folders[name] = Path(temporary) / str(period)
            options = {"num_views": 40, "num_held_out": 2, "num_far": 2, "width": 320, "height": 240}
            synthetic_capture.write_capture(folders[name], repetition=period, num_points=500, **options)
        for name, folder in folders.items():
            rows += list(_measure(name, folder, count if name in SCENES else 0, seed))
            cached.cache_clear()
    print("\n".join([*common.provenance(), "", *_table(rows)]))


def _measure(name, folder, count, seed):
    """Yields (scene, defect, planted, found, false accusations, checks)."""
    capture = report.subset(read_capture(folder))
    summaries, _ = images.read(capture)
    keypoints, rng = tracks.keypoints_of(capture, summaries), np.random.default_rng(seed)
    scale = cameras.gather(capture, summaries, np.zeros((len(summaries), 0), int)).scale
    chosen = rng.permutation(len(keypoints))[:count]
    clean = len(_accused(capture, keypoints, poses_of(capture), scale))
    print(name, len(keypoints), "images, clean:", clean, file=sys.stderr, flush=True)
    yield name, "none", 0, 0, clean, 1
    for defect in DEFECTS if count else ():
        found = false = planted = 0
        for view in chosen:
            changed, poses, expected = _plant(defect, int(view), list(keypoints), poses_of(capture), rng)
            accused = _accused(capture, changed, poses, scale)
            planted, found, false = (
                planted + len(expected),
                found + len(accused & expected),
                false + len(accused - expected),
            )
        print(name, defect, planted, found, false, file=sys.stderr, flush=True)
        yield name, defect, planted, found, false, len(chosen)


def _plant(defect, view, keypoints, poses, rng):
    """Returns keypoints and poses with a defect in a view, and the views concerned."""
    if defect.startswith("swapped"):
        distance = np.linalg.norm(poses[:, :, 3] - poses[view, :, 3], axis=1)
        other = (view + 1) % len(poses) if "next" in defect else int(distance.argmax())
        keypoints[view], keypoints[other] = keypoints[other], keypoints[view]
        return keypoints, poses, {view, other}
    poses = poses.copy()
    if "turned" in defect:
        axis = rng.normal(size=3)
        poses[view, :, :3] = _rotation(np.radians(30) * axis / np.linalg.norm(axis)) @ poses[view, :, :3]
    else:
        spread = np.median(np.linalg.norm(poses[:, :, 3] - np.median(poses[:, :, 3], axis=0), axis=1))
        step = rng.normal(size=3)
        poses[view, :, 3] += 0.5 * spread * step / np.linalg.norm(step)
    return keypoints, poses, {view}


def _rotation(vector):
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * across + (1 - np.cos(angle)) * across @ across


def _accused(capture, keypoints, poses, scale):
    """Returns the views that errors name."""
    near = neighbours(poses)
    found = tracks.follow(keypoints, near)
    evidence = tracks.Evidence(keypoints, near, found, poses, scale, 0.0)
    findings = cameras.judge_views(capture, evidence)
    return {view for finding in findings if finding.severity == "error" for view in finding.frames}


_KEPT = {}


def _keep(keypoints):
    """Returns a key of Keypoints, which are kept so that no other object receives it."""
    _KEPT[id(keypoints)] = keypoints
    return id(keypoints)


def _table(rows):
    planted, found, false, checks = (sum(row[index] for row in rows) for index in (2, 3, 4, 5))
    precision = found / max(found + false, 1)
    heads = ("scene", "defect", "checks", "images planted", "of these flagged", "good images flagged")
    cells = [[scene, defect, *map(str, (n, there, right, wrong))] for scene, defect, there, right, wrong, n in rows]
    recall = found / max(planted, 1)
    together = f"precision {precision:.1%}, recall {recall:.1%}, {false} good images flagged in {checks} checks"
    return [*common.markdown(heads, cells), "", f"Together: {together}."]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--images", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="of the images and the defects")
    known = parser.parse_args()
    main(known.images, known.seed)
