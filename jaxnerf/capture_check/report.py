"""A capture looked over before hours are spent on it: what it is, and what is wrong with it."""

from collections import Counter
from typing import NamedTuple

import numpy as np

from jaxnerf.capture_check import cameras as cameras_module
from jaxnerf.capture_check import compare_images, depths, points, tracks
from jaxnerf.capture_check import images as images_module
from jaxnerf.capture_check.findings import Finding
from jaxnerf.data.geometry.poses import gaze_center
from jaxnerf.data.geometry.world import poses_of
from jaxnerf.data.images import load_images
from jaxnerf.data.readers import base
from jaxnerf.data.readers.base import Capture

_MOST = 160  # photographs that are opened: two cores read so many in half a minute


class Report(NamedTuple):
    """What `inspect` returns."""

    capture: Capture  # what was looked at
    facts: tuple[tuple[str, str], ...]  # what, and how it is
    findings: tuple[Finding, ...]  # what ruins training first
    poses: np.ndarray  # [V, 3, 4] as they are meant
    places: np.ndarray  # [N, 3] where the photographs agree that something is

    @property
    def ruined(self):
        """Whether training on the capture is time lost."""
        return any(finding.severity == "ruins" for finding in self.findings)

    def text(self):
        """Returns the report, a line a fact, then a line a finding."""
        width = max(len(name) for name, _ in self.facts)
        lines = [f"{name:{width}}  {value}" for name, value in self.facts]
        lines += [finding.line() for finding in self.findings]
        count = sum(finding.severity == "ruins" for finding in self.findings)
        verdict = f"{count} found that would ruin training" if count else "nothing found that would ruin training"
        return "\n".join([*lines, verdict])


def inspect(folder, *, format="auto", near=None, far=None):
    """Returns the Report on the capture in a folder.

    Args:
        folder, format: see base.read_capture.
        near, far: as training is going to have them, in t; None: its defaults, or what the capture says.

    Raises:
        ValueError: where the cameras cannot be read at all; names the file, what was found, what was wanted
            and what to do.
    """
    there = base.formats_in(folder)
    whole = base.read_capture(folder, format)
    capture = _part(whole)
    pictures, findings = images_module.read(capture)
    near_views = tracks.neighbours(poses_of(capture))
    findings += compare_images.compare(capture, pictures, near_views)
    findings += points.judge_points(capture)
    evidence = cameras_module.gather(capture, pictures, near_views)
    wrong = cameras_module.judge_places(capture)
    if not wrong:  # from one place the rays of all poses meet, in the eye
        wrong, evidence = cameras_module.judge_axes(capture, evidence)
        focal, evidence = cameras_module.judge_focal(capture, evidence)
        findings += focal + cameras_module.judge_views(capture, evidence)
    findings += wrong
    found, followed = cameras_module.places(evidence)
    bounds, stated = depths.ranges(capture, near, far)
    if stated or not wrong:  # computed from poses that are wrong, they mean nothing
        findings += depths.judge_bounds(capture, evidence, found, followed, bounds, stated)
    findings += depths.judge_box(capture, found)
    findings += [_noted(note) for note in whole.notes]
    facts = _facts(whole, there, pictures) + _camera_facts(capture, evidence)
    facts += _depth_facts(evidence, found, followed, bounds, stated)
    order = sorted(findings, key=lambda finding: finding.severity != "ruins")
    return Report(capture, tuple(facts), tuple(order), evidence.poses, found)


def _part(capture):
    """Returns the capture with every n-th frame only where there are very many."""
    step = -(-len(capture.frames) // _MOST)
    if step == 1:
        return capture
    kept = range(0, len(capture.frames), step)
    return capture._replace(frames=tuple(capture.frames[index] for index in kept), splits=None)


def _noted(note):
    return Finding("note", "missing", note, "nothing left out", "the files named, if that is not meant")


def _facts(capture, there, pictures):
    others = [name for name in there if name != capture.format]
    also = f"; also there: {', '.join(others)} (--format chooses)" if others else ""
    if capture.splits:
        splits = {name: len(chosen) for name, chosen in capture.splits.items()}
    else:
        splits = {name: len(load_images.split_indices(capture, name)) for name in ("train", "test")}
    sizes = Counter("{1} x {0}".format(*picture.size) for picture in pictures if picture)
    channels = Counter("alpha" if picture.channels == 4 else "no alpha" for picture in pictures if picture)
    masks = sum(frame.mask is not None for frame in capture.frames)
    opened = "" if len(pictures) == len(capture.frames) else f"; {len(pictures)} looked at"
    return [
        ("format", f"{capture.format} ({capture.source}){also}"),
        ("views", f"{len(capture.frames)}: {', '.join(f'{n} {name}' for name, n in splits.items())}{opened}"),
        ("images", f"{_counted(sizes)} px; {_counted(channels)}; {masks or 'no'} masks"),
    ]


def _camera_facts(capture, evidence):
    cameras = [frame.camera for frame in capture.frames]
    first, poses = cameras[0], evidence.poses
    focal = np.array([camera.focal for camera in cameras]).mean(axis=0)
    width, height = first.width or 2 * first.center[0], first.height or 2 * first.center[1]
    view = 2 * np.degrees(np.arctan(0.5 * np.array([width, height]) / focal))
    off = np.asarray(first.center) - np.array([width, height]) / 2
    lenses = _counted(Counter(camera.lens for camera in cameras))
    up, angle = depths.up_axis(poses)
    middle = gaze_center(poses)
    away = np.linalg.norm(poses[:, :, 3] - middle, axis=1)
    around, low, high = depths.arcs(poses)
    looks = depths.view_direction(capture)
    shown = evidence.tracks.shown
    seen = (shown.sum() / len(shown)) if len(shown) else 0.0
    right = np.linalg.det(poses[:, :, :3]).min() > 0
    return [
        (
            "lens",
            f"focal length {focal[0]:.5g}, {focal[1]:.5g} px, so {view[0]:.1f} x {view[1]:.1f} degrees; "
            f"centre {off[0]:+.1f}, {off[1]:+.1f} px off the middle; {lenses}",
        ),
        ("poses", f"{'right-handed' if right else 'mirrored'}; up is {up} within {angle:.0f} degrees"),
        ("looking", f"{looks}; {away.min():.4g} to {away.max():.4g} from {np.round(middle, 3).tolist()}"),
        ("arcs", f"{around:.0f} of 360 degrees around up, {low:.0f} to {high:.0f} above the plane across it"),
        (
            "overlap",
            f"{len(shown)} places are recognised, each in {seen:.1f} of {1 + evidence.near.shape[1]} views; "
            f"{100 * evidence.share:.0f} % fit the cameras within {cameras_module.consistency.NEAR:.0f} px",
        ),
    ]


def _depth_facts(evidence, found, followed, bounds, stated):
    (near, far), text = np.median(bounds, axis=0), "from the data" if stated is None else f"by {stated}"
    line = f"{near:.4g} to {far:.4g} ({text})"
    if len(found):
        depth = depths.view_depths(evidence, found, followed)
        low, high = np.percentile(depth, [2, 98])
        line += f"; {len(found)} places that the photographs agree on lie {low:.4g} to {high:.4g} away"
    return [("near, far", line)]


def _counted(counter):
    if len(counter) == 1:
        return next(iter(counter))
    return ", ".join(f"{count} of {name}" for name, count in counter.most_common())
