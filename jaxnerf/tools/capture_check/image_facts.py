"""What image files and cameras state that may be wrong, although training reads them as they are."""

import contextlib
import io
from collections import defaultdict

import numpy as np
from PIL import ImageCms

from jaxnerf.data.images.downscaled_copies import with_size
from jaxnerf.data.images.image_files import open_image
from jaxnerf.data.images.pixel_rays import rays_line
from jaxnerf.data.readers.base import Capture, Frame
from jaxnerf.tools.capture_check.findings import Finding


def judge_files(capture: Capture) -> list[Finding]:
    """Returns Findings about orientations, colour profiles, principal points, and pixels without rays."""
    frames = sized_frames(capture)
    found = _turned(frames) + _profiles(frames) + _centers(frames)
    if "no ray" in (line := rays_of(capture)) and any(frame.camera.lens != "fisheye" for frame in frames):
        change = "calibrate again with fewer coefficients, or crop the images"
        found.append(Finding("warning", "lens", f"{capture.source}: {line}", "a ray for each", change))
    return found


def rays_of(capture: Capture) -> str:
    """Returns the `rays_line` of all cameras."""
    return rays_line([frame.camera for frame in sized_frames(capture)])


def sized_frames(capture: Capture) -> list[Frame]:
    """Returns the frames with the size of their camera, without unreadable images, which whoever reads them reports."""
    frames = []
    for frame in capture.frames:
        with contextlib.suppress(ValueError):
            frames.append(with_size(frame))
    return frames


def _turned(frames):
    """Returns a Finding if images have an EXIF orientation that is not followed, as no size tells whether to."""
    turned = []
    for frame in frames:
        with contextlib.suppress(Exception), open_image(frame.image) as image:  # reported where the image is read
            orientation, camera = image.getexif().get(0x0112, 1), frame.camera
            if frame.follow_exif and 1 < orientation <= (8 if camera.height == camera.width else 4):
                turned.append(f"{orientation} in {frame.image.name}")
    if not turned:
        return []
    found = f"EXIF orientation of {len(turned)} of {len(frames)} images ({turned[0]}) is not followed, as programs that"
    found += " find poses ignore it"
    change = "turn the files if the poses are those of upright images, or else remove the orientation"
    return [Finding("warning", "skipped", found, "poses of the pixels as stored", change)]


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
