"""Whether a model's own points lie where its cameras saw them."""

import jax
import numpy as np

from jaxnerf.capture_check.findings import Finding, named, percent
from jaxnerf.core.cameras import project
from jaxnerf.data.geometry.bounds import depths

_OBSERVED = 0.01  # of the longer side: a good model's points are off by a tenth of that
_BEHIND = 0.02  # share of points


def judge_points(capture):
    """Returns Findings about how a model's own points lie before its cameras."""
    if capture.points is None or all(frame.seen is None or not len(frame.seen) for frame in capture.frames):
        return []
    behind, off = np.array([_of_points(frame, capture.points) for frame in capture.frames]).T
    findings = []
    if np.nanmean(behind) > _BEHIND:
        found = f"{capture.source}: {percent(np.nanmean(behind))} of its points lie behind cameras that see them"
        change = "the poses: export the model again, poses and points together"
        findings.append(Finding("ruins", "points", found, "none", change))
    bad = np.flatnonzero(off > _OBSERVED)
    if len(bad) and np.isfinite(off).any():
        share = percent(np.nanmedian(off[bad]), 1)
        found = f"{capture.source}: its points are {share} of the image off in {named(capture, bad)}"
        change = "poses and lens: copy cameras, images and points of one model, or run COLMAP again"
        wanted = f"less than {percent(_OBSERVED)}"
        findings.append(Finding("ruins", "points", found, wanted, change, tuple(bad.tolist())))
    return findings


def _of_points(frame, points):
    """Returns the share of a frame's points behind it, and how far off they are, as a share of its size."""
    if frame.seen is None or not len(frame.seen):
        return np.nan, np.nan
    seen = points[frame.seen]
    behind = float((depths(frame.camera, seen) <= 0).mean())
    padded = np.repeat(seen[:1], 1 << (len(seen) - 1).bit_length(), axis=0)  # few shapes to compile
    padded[: len(seen)] = seen
    at = np.asarray(jax.jit(project)(frame.camera, padded)[0])[: len(seen)]
    off = np.linalg.norm(at - frame.seen_at, axis=1)
    return behind, float(np.median(off)) / max(frame.camera.height or 1, frame.camera.width or 1)
