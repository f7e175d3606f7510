"""What the lenses of a dataset see, and whether its cameras could be one."""

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxnerf.core.cameras import undistort
from jaxnerf.core.types import Camera
from jaxnerf.data.readers.base import Capture
from jaxnerf.tools.capture_check.findings import Finding

_SAME_LENS = 1.25  # largest over smallest focal length that one lens with a fixed zoom is estimated to have
_MIN_CAMERAS = 5  # for as many images, that could share one


def field_of_view(camera: Camera) -> tuple[Float[np.ndarray, "3"], bool]:
    """Computes the angles that a camera sees from its left edge to its right, top to bottom, and corner to corner.

    Args:
        camera: one Camera; without a size, its centre is that of the image.

    Returns:
        Degrees [3], by the lens, so that a fisheye may have more than 180; and whether its image circle is smaller than
        the image. Then the angles end at the circle.
    """
    width, height = camera.width or 2 * camera.center[0], camera.height or 2 * camera.center[1]
    x, y = camera.center
    edges = np.array([[0, y], [width, y], [x, 0], [x, height], [0, 0], [width, height]], np.float64)
    angle, reached = angles(camera, edges)
    return np.degrees(angle[::2] + angle[1::2]), not reached.all()


def angles(camera: Camera, pixels: Float[np.ndarray, "N 2"]) -> tuple[Float[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """Computes the angles between a camera's axis and the rays through pixels.

    Returns:
        Radians, at most the largest angle of which the lens has an image; and whether the lens reaches the pixel.
    """
    points = (pixels - np.asarray(camera.center)) / np.asarray(camera.focal)
    radius = np.linalg.norm(points, axis=-1)
    if camera.distortion is None or camera.lens == "pinhole":
        return np.arctan(radius), np.ones(len(radius), bool)
    if camera.lens == "fisheye":
        angle = np.linspace(0, np.pi, 20_001)
        image = angle * np.polyval([*np.asarray(camera.distortion)[::-1], 1.0], angle**2)
        fold = np.flatnonzero(np.diff(image) <= 0)  # beyond it, the lens shows what it has shown before
        end = fold[0] + 1 if len(fold) else len(angle)
        return np.interp(radius, image[:end], angle[:end]), radius <= image[end - 1]
    found, reached = map(np.asarray, jax.jit(undistort)(camera, np.float32(pixels)))
    return np.where(reached, np.arctan(np.linalg.norm(found, axis=-1)), np.nan), reached


def describe(capture: Capture) -> str:
    """Returns the fields of view of a dataset's cameras in words."""
    cameras = {_key(frame.camera): frame.camera for frame in capture.frames}
    seen = [field_of_view(camera) for camera in cameras.values()]
    every = np.array([degrees for degrees, _ in seen])
    low, high = np.nanmin(every, axis=0), np.nanmax(every, axis=0)

    def span(index):
        return f"{low[index]:.1f}" + (f" to {high[index]:.1f}" if high[index] - low[index] > 0.5 else "")

    circle = sum(short for _, short in seen)
    text = f"field of view {span(0)} x {span(1)} degrees, {span(2)} from corner to corner"
    return text + (", up to the edge of the lens, which the image exceeds" if circle else "")


def judge_lenses(capture: Capture) -> list[Finding]:
    """Returns a Finding if about every image has a camera of its own that seems to be the same one."""
    kinds: dict[tuple, list[Camera]] = {}
    for camera in (frame.camera for frame in capture.frames):
        kinds.setdefault((camera.lens, camera.height, camera.width), []).append(camera)
    findings = []
    for group in kinds.values():
        count = len(group)
        focal = sorted({float(np.mean(camera.focal)) for camera in group})
        if count < _MIN_CAMERAS or len(focal) < 0.5 * count or focal[-1] > _SAME_LENS * focal[0]:
            continue
        found = f"{capture.source}: {count} images have {len(focal)} cameras, with focal lengths of {focal[0]:.5g} to "
        found += f"{focal[-1]:.5g} px"
        change = "nothing if the zoom or the focus changed; else share one, by which each image corrects the others: "
        change += "jaxnerf-cameras --images=DIR --out=NEW --single_camera"
        findings.append(Finding("warning", "lens", found, "one camera for the images of one lens", change))
    return findings


def _key(camera):
    parts = (camera.focal, camera.center, () if camera.distortion is None else camera.distortion)
    return camera.lens, camera.height, camera.width, *(tuple(map(float, part)) for part in parts)
