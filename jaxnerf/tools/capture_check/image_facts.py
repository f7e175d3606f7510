"""What image files and cameras state that may be wrong, although training reads them as they are."""

import io
from collections import defaultdict

import numpy as np
from PIL import ImageCms

from jaxnerf.data.images.image_files import open_image
from jaxnerf.data.readers.base import Capture
from jaxnerf.data.reading_notes import exif_line, rays_line, sized_frames
from jaxnerf.tools.capture_check.findings import Finding


def judge_files(capture: Capture) -> list[Finding]:
    """Returns Findings about orientations, colour profiles, principal points, and pixels without rays."""
    frames = sized_frames(capture)
    found = _profiles(frames) + _centers(frames)
    if line := exif_line(capture):
        found.append(Finding("warning", "skipped", line, "", ""))
    if "no ray" in (line := rays_line(capture)) and any(frame.camera.lens != "fisheye" for frame in frames):
        change = "calibrate again with fewer coefficients, or crop the images"
        found.append(Finding("warning", "lens", f"{capture.source}: {line}", "a ray for each", change))
    return found


def _profiles(frames):
    """Returns a Finding if images have different colour profiles; one without is taken to be sRGB."""
    named = defaultdict(list)
    for frame in frames:
        try:
            with open_image(frame.image) as image:
                profile, name = image.info.get("icc_profile"), "sRGB"
            if profile:
                name = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile))).strip()
        except Exception:  # reported where the image is read; Pillow's decoders raise almost any
            continue
        named["sRGB" if "sRGB" in name else name[:40]].append(frame.image.name)
    if len(named) < 2:
        return []
    listed = ", ".join(f"{len(files)} {name} ({files[0]})" for name, files in named.items())
    found = f"colour profiles differ, and images are read as they are: {listed}"
    return [Finding("warning", "file", found, "one profile", "convert all images to sRGB")]


def _centers(frames):
    outside = []
    for index, frame in enumerate(frames):
        center, size = np.asarray(frame.camera.center), np.array([frame.camera.width, frame.camera.height])
        if not ((center >= 0) & (center <= size)).all():
            outside.append((index, center, size))
    if not outside:
        return []
    index, center, size = outside[0]
    found = f"the principal point of {frames[index].name} is {_pair(center)} px in an image of {_pair(size)} px"
    found += f", so outside, as in {len(outside)} of {len(frames)} images"
    change = "cx and cy, or the size that they refer to; correct as it is if the images were cropped"
    return [Finding("warning", "lens", found, f"near {_pair(size / 2)}", change)]


def _pair(values):
    return ", ".join(f"{value:.5g}" for value in values)
