"""Checks a dataset before training: describes it and lists its problems."""

import os
from collections import Counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxnerf.data import dataset
from jaxnerf.data.geometry import path_poses
from jaxnerf.data.geometry.bounds import known_bounds
from jaxnerf.data.geometry.path_poses import coverage
from jaxnerf.data.geometry.poses import axis_of, gaze_center, look_one_way, neighbours, sideways, up_of
from jaxnerf.data.geometry.world import poses_of
from jaxnerf.data.images.load_images import scored_splits, split_indices
from jaxnerf.data.readers import base
from jaxnerf.data.readers.base import Capture
from jaxnerf.options import AUTO, replaced
from jaxnerf.runtime.printed_text import printable
from jaxnerf.tools.capture_check import cameras, depths, exposure, folds, image_facts, mattes, mixed_axes, tracks
from jaxnerf.tools.capture_check import images as images_module
from jaxnerf.tools.capture_check import lenses as lenses_module
from jaxnerf.tools.capture_check.findings import Finding, percent

_SETS_UP = "--up sets it, and --config.data.up in training"
_FEW_FIT = 0.2  # fraction of matched corners that fit; 35 to 74 % in lego, mic, fox, fern, can
_OF_CAMERAS = ("axes", "focal", "overlap", "pose", "swap", "fold")  # kinds of findings that explain it
_SAME = 3  # findings about single files of one kind that are shown
_OFF_AXIS = 1.0  # degrees from the nearest axis of the files, from which up is stated as a vector
_LOOKS_UP = 5.0  # degrees in the mean, above which images may be upside down; -34 to 0 in lego, mic, fox, fern, can
_TILTED = 15.0  # degrees, in the median, by which images of a capture with a known up are not level
_MAX_IMAGES = 500  # that are read, at a fifth of a second each on two cores


class Report(NamedTuple):
    """The result of `inspect`.

    Attributes:
        capture: the frames that were inspected.
        facts: pairs of a name and a description.
        findings: errors first.
        poses: [V, 3, 4], corrected where the axes are wrong.
        points: [N, 3], on which the images agree.
        path: [M, 3, 4], the poses that jaxnerf-render selects; None: the cameras define no path.
        up: [3] unit vector, given or else as the cameras are held.
    """

    capture: Capture
    facts: tuple[tuple[str, str], ...]
    findings: tuple[Finding, ...]
    poses: Float[np.ndarray, "V 3 4"]
    points: Float[np.ndarray, "N 3"]
    path: Float[np.ndarray, "M 3 4"] | None
    up: Float[np.ndarray, "3"]

    @property
    def num_errors(self) -> int:
        """The number of findings that make training useless."""
        return sum(finding.severity == "error" for finding in self.findings)

    def text(self) -> str:
        """Returns the report as text: one line for each fact, one for each finding, and a summary."""
        width = max(len(name) for name, _ in self.facts)
        lines = [f"{name:{width}}  {printable(value)}" for name, value in self.facts]
        groups: dict[tuple[str, str], list[Finding]] = {}
        for finding in self.findings:  # of a fault that all images have, the first few are shown
            groups.setdefault((finding.severity, finding.kind), []).append(finding)
        for (_, kind), found in groups.items():
            shown = _SAME if kind in ("size", "file") else len(found)
            lines += [printable(finding.line()) for finding in found[:shown]]
            lines += [f"        and {len(found) - shown} more images like these"] if found[shown:] else []
        errors, warnings = self.num_errors, len(self.findings) - self.num_errors
        summary = f"{errors or 'no'} error{'s' * (errors != 1)}, {warnings or 'no'} warning{'s' * (warnings != 1)}"
        return "\n".join([*lines, summary])


def inspect(
    folder: str | os.PathLike,
    *,
    format: str = "auto",
    near: float | None = None,
    far: float | None = None,
    up: str | None = None,
) -> Report:
    """Checks the dataset in a folder.

    Args:
        folder, format: see `read_capture`.
        near, far: as training will use them, in t; None: training's defaults, or what the dataset states.
        up: the axis of the dataset's files that is up, such as "+z"; None: as the cameras are held.

    Raises:
        ValueError: if the cameras cannot be read; names the file, what was found, what is expected and what
            to do.
    """
    given = None if up is None else axis_of(up)
    available = base.detect_formats(folder)
    whole = base.read_capture(folder, format)
    capture = subset(whole)
    images, findings = images_module.read(capture)
    near_views = neighbours(poses_of(capture))
    findings += images_module.compare(capture, images, near_views)
    findings += depths.judge_model_points(capture) + folds.noted(capture)
    evidence = cameras.gather(capture, images, near_views)
    wrong = cameras.judge_positions(capture)
    if not wrong:  # from one position, rays fit any axes and focal length
        wrong, evidence = cameras.judge_axes(capture, evidence)
        mixed, evidence = mixed_axes.judge_mixed(capture, evidence)
        wrong = mixed or wrong
        focal, evidence = cameras.judge_focal(capture, evidence)
        views = cameras.judge_views(capture, evidence)
        findings += focal + views
        if not wrong:
            flagged = {index for finding in views for index in finding.frames if finding.severity == "error"}
            findings += folds.judge_folds(capture, evidence, flagged)
        if not any(finding.kind in _OF_CAMERAS for finding in (*wrong, *findings)):
            findings += cameras.judge_accuracy(capture, evidence)
        findings += exposure.judge_exposure(capture, images, evidence)
    findings += wrong
    if evidence.fraction < _FEW_FIT and not any(finding.kind in _OF_CAMERAS for finding in findings):
        found = f"{capture.source}: only {percent(evidence.fraction)} of the matched corners fit the cameras"
        change = "focal lengths, lens and poses, unless the texture of the scene repeats itself"
        findings.append(Finding("warning", "pose", found, "a third or more", change))
    points, point_tracks = cameras.points_of(evidence)
    bounds, stated = depths.ranges(capture, near, far)
    depth = depths.view_depths(evidence.poses, points, point_tracks)
    if stated or not wrong:  # bounds computed from wrong poses mean nothing
        findings += depths.judge_bounds(depth, bounds[point_tracks.views[:, 0]], stated)
    findings += depths.judge_box(capture, points)
    if not wrong:
        findings += mattes.judge_mattes(capture, [image and image.matte for image in images], bounds)
    findings += lenses_module.judge_lenses(capture)
    findings += _judge_splits(whole) + _refused_by_training(folder, whole, near, far, findings)
    findings += [Finding("warning", "skipped", note, "", "") for note in dict.fromkeys(whole.notes)]
    findings += image_facts.judge_files(whole)
    path, line = _path(whole, given)
    facts = _image_facts(whole, available, images) + _camera_facts(capture, evidence, images, given)
    facts += [("near, far", _range(bounds, stated, depth, capture)), ("path", line)]
    order = sorted(findings, key=lambda finding: finding.severity != "error")
    direction = up_of(evidence.poses) if given is None else given
    return Report(capture, tuple(facts), tuple(order), evidence.poses, points, path, direction)


def _judge_splits(capture):
    """Returns a Finding for each split whose views are training views, too."""
    shared = dataset.views_shared_with_training(dataset.DataOptions(format=capture.format), capture)
    expected = "views that training does not see"
    change = "the lists of views of the splits, or remove the copies"
    notes = dict.fromkeys(found["note"] for found in shared.values())
    return [Finding("warning", "leak", note, expected, change) for note in notes]


def _refused_by_training(folder, capture, near, far, findings):
    """Returns a Finding for each split that training would refuse to read, unless one says it already."""
    data = dataset.DataOptions(format=capture.format, factor=AUTO, background=AUTO, world=AUTO, ndc=AUTO)  # type: ignore
    data = replaced(data, dir=str(folder), near=near or 0.0, far=far or 0.0)
    known = {finding.found.split(": ")[0] for finding in findings if finding.severity == "error" and finding.frames}
    refused = {}
    for split in ("train", *scored_splits(capture)):
        try:
            dataset.load_split(data, split, with_pixels=False)
        except ValueError as error:
            finding = images_module.refused(str(error), (), "training")
            refused[finding.found] = finding._replace(found=f"training refuses this: {finding.found}")
    return [finding for found, finding in refused.items() if found.split(": ")[0] not in known]


def subset(capture: Capture) -> Capture:
    """Returns the capture with every n-th frame if there are very many."""
    step = -(-len(capture.frames) // _MAX_IMAGES)
    return capture if step == 1 else capture._replace(frames=capture.frames[::step], splits=None)


def _image_facts(capture, available, images):
    others = [name for name in available if name != capture.format]
    also = f"; other formats in the folder: {', '.join(others)} (--format selects one)" if others else ""
    splits = capture.splits or {name: split_indices(capture, name) for name in ("train", "test")}
    sizes = Counter("{1} x {0}".format(*image.size) for image in images if image)
    channels = Counter("alpha" if image.channels == 4 else "no alpha" for image in images if image)
    masks = sum(frame.mask is not None or frame.ignored is not None for frame in capture.frames)
    checked = "" if len(images) == len(capture.frames) else f"; {len(images)} were checked"
    counts = ", ".join(f"{len(chosen)} {name}" for name, chosen in splits.items())
    return [
        ("format", f"{capture.format} ({capture.source}){also}"),
        *(("read", choice) for choice in capture.choices),
        ("views", f"{len(capture.frames)}: {counts}{checked}"),
        ("images", f"{_counted(sizes)} px; {_counted(channels)}; {masks or 'no'} masks"),
        *([("rays", rays)] if (rays := image_facts.rays_of(capture)) else []),
        *(("time", line) for line in _time_facts(capture, splits)),
    ]


def _time_facts(capture, splits):
    """Returns lines about the times of images; none if they have none."""
    times = {name: [capture.frames[index].time for index in chosen] for name, chosen in splits.items()}
    times = {name: np.float64([time for time in found if time is not None]) for name, found in times.items()}
    train = np.unique(times.get("train", []))
    if not len(train):
        return []
    images = len(times["train"])
    each = "one image each" if images == len(train) else f"{images / len(train):.3g} images each, as of a rig"
    lines = [
        f"training images at {len(train)} time{'s' * (len(train) > 1)} from {train[0]:.3g} to {train[-1]:.3g}, {each}"
    ]
    if len(train) > 1:
        gap = int(np.diff(train).argmax())
        lines[0] += f"; the largest gap is {np.diff(train)[gap]:.3g}, from {train[gap]:.3g} to {train[gap + 1]:.3g}"
    for name, found in times.items():
        beyond = int(((found < train[0]) | (found > train[-1])).sum())
        if beyond:
            lines.append(f"{beyond} of {len(found)} {name} images are before or after all training images")
    return [*lines, "--config=moving trains a scene that moves; others train it as if nothing moved"]


def _camera_facts(capture, evidence, images, up):
    stack = [frame.camera for frame in capture.frames]
    first, poses = stack[0], evidence.poses
    focal = np.array([camera.focal for camera in stack]).mean(axis=0)
    size = np.array([first.width or 2 * first.center[0], first.height or 2 * first.center[1]])
    scale, stated = _scale_to_files(capture, images)
    off = scale * (np.asarray(first.center) - size / 2)
    lenses = _counted(Counter(camera.lens for camera in stack))
    each = sorted({scale * float(np.mean(camera.focal)) for camera in stack})
    if len(each) > 1:
        lenses += f"; {len(each)} different cameras, with focal lengths of {each[0]:.5g} to {each[-1]:.5g} px"
    middle = gaze_center(poses)
    distance = np.linalg.norm(poses[:, :, 3] - middle, axis=1)
    cover = coverage(poses, up)
    low, high = cover.elevation.min(), cover.elevation.max()
    shown = evidence.tracks.shown
    seen = shown.sum() / max(len(shown), 1)
    sure, error = cameras.circle_error(evidence)
    handed = "right-handed" if np.linalg.det(poses[:, :, :3]).min() > 0 else "mirrored"
    return [
        (
            "lens",
            f"focal length {scale * focal[0]:.5g}, {scale * focal[1]:.5g} px{stated}; "
            f"{lenses_module.describe(capture)}; principal point {off[0]:+.1f}, {off[1]:+.1f} px from the "
            f"image's centre; {lenses}",
        ),
        ("poses", f"{handed}; {_up_axis(poses, up)}"),
        (
            "direction",
            f"{_view_direction(capture)}; {distance.min():.4g} to {distance.max():.4g} from "
            f"{np.round(middle, 3).tolist()}",
        ),
        (
            "arcs",
            f"{360 - np.degrees(cover.gap):.0f} of 360 degrees around up, at elevations of {np.degrees(low):.0f} to "
            f"{np.degrees(high):.0f} degrees",
        ),
        (
            "overlap",
            f"{len(shown)} corners are matched, each in {seen:.1f} of {1 + evidence.near.shape[1]} views; "
            f"{percent(evidence.fraction)} fit the cameras within {tracks.INLIER:.0f} px; {sure} that a third "
            f"image confirms are {error:.2f} px off (median)",
        ),
    ]


def _scale_to_files(capture, images):
    """Returns the size of the files over that which their cameras state, and a remark if it is not 1."""
    for frame, image in zip(capture.frames, images, strict=True):
        height, width = frame.camera.height, frame.camera.width
        if image and height and width:
            scale = max(image.size) / max(height, width)  # an image may be stored sideways
            return scale, "" if scale == 1 else f" (of the cameras' {width} x {height} px: {1 / scale:.4g} times that)"
    return 1.0, ""


def _range(bounds, stated, depth, capture):
    near, far = np.median(bounds, axis=0)
    points, box = any(known_bounds(capture)), capture.box is not None
    sources = ["the cameras", *["points"] * points, *["the box of the file"] * box]
    computed = f"computed from {' and '.join(sources)}"
    line = f"{near:.4g} to {far:.4g} ({f'from {stated}' if stated else computed})"
    if len(depth):
        low, high = np.percentile(depth, [2, 98])
        line += f"; {len(depth)} points on which the images agree are at depths of {low:.4g} to {high:.4g}"
    return line


def _counted(counter):
    if len(counter) == 1:
        return next(iter(counter))
    return ", ".join(f"{count} of {name}" for name, count in counter.most_common())


def _view_direction(capture):
    """Returns how the cameras look: "inwards", "outwards", "forward" or "along a path"."""
    poses = poses_of(capture)
    if look_one_way(poses):
        return "forward"
    inwards = (((poses[:, :, 3] - gaze_center(poses)) * poses[:, :, 2]).sum(axis=1) > 0).mean()
    return "inwards" if inwards > 0.9 else "outwards" if inwards < 0.1 else "along a path"


def _up_axis(poses, given):
    """Returns how up was found: the world axis nearest to it, by which jaxnerf-render turns its paths."""
    if given is not None:
        return f"up is {'-' if given.sum() < 0 else '+'}{'xyz'[int(np.abs(given).argmax())]}, as --up gives it"
    up, turned = up_of(poses), sideways(poses)
    axis = int(np.abs(up).argmax())
    angle = np.degrees(np.arccos(np.clip(abs(up[axis]), 0, 1)))
    name = f"{'-' if up[axis] < 0 else '+'}{'xyz'[axis]}"
    vector = ", ".join(f"{value:.3f}" for value in up)
    line = f"up is {name}" if angle < _OFF_AXIS else f"up is ({vector}), {angle:.0f} degrees from {name}"
    level = np.where(turned, np.abs(poses[:, :, 1] @ up), np.abs(poses[:, :, 0] @ up))
    tilt = np.degrees(np.arcsin(np.clip(np.median(level), 0, 1)))
    if turned.any():
        line += f"; {turned.sum()} of {len(poses)} images are stored sideways"
    if tilt > _TILTED:
        line += f", not sure: the images are tilted by {tilt:.0f} degrees in the median; {_SETS_UP}"
    looks_up = np.degrees(np.arcsin(np.clip(-(poses[:, :, 2] @ up).mean(), -1, 1)))
    if looks_up > _LOOKS_UP:
        line += f", not sure: the cameras look up by {looks_up:.0f} degrees in the mean, as they seem to if the images "
        line += f"are stored upside down; {_SETS_UP}"
    return line


def _path(capture, up):
    """Returns the poses of the path that jaxnerf-render selects by the views of the split "train", and a line."""
    frames = [capture.frames[index] for index in split_indices(capture, "train")]
    poses = np.stack([frame.camera.to_world for frame in frames])
    try:
        kind, reason = path_poses.default_kind(poses, up=up)
    except ValueError as error:
        return None, str(error)
    line = f"jaxnerf-render selects {kind}, as {reason}"
    if kind != "interpolate":
        return path_poses.make_poses(kind, poses, up=up), line
    return path_poses.poses_through(poses[path_poses.natural_order([frame.name for frame in frames])])[0], line
