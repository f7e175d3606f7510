"""What the image files and lenses of a Capture leave open, in lines for people."""

import contextlib

from jaxnerf.data.images.downscaled_copies import with_size
from jaxnerf.data.images.image_files import exif_orientation
from jaxnerf.data.images.pixel_rays import fractions_of_pixels
from jaxnerf.data.readers.base import Capture, Frame

TIME_UNUSED = "images state one, which is not used: the scene is trained as static; see docs/extending/moving_scene.md"


def exif_line(capture: Capture) -> str:
    """Returns how many images have an EXIF orientation that is not followed, as size does not tell; "" if none has."""
    turned = []
    for frame in sized_frames(capture):
        with contextlib.suppress(ValueError):
            orientation, camera = exif_orientation(frame.image) if frame.follow_exif else 1, frame.camera
            if orientation > 1 and (orientation < 5 or camera.height == camera.width):
                turned.append(f"{orientation} in {frame.image.name}")
    if not turned:
        return ""
    return (
        f"EXIF orientation of {len(turned)} of {len(capture.frames)} images ({turned[0]}) is not followed, as programs "
        "that find poses ignore it; if yours are those of upright images, turn the files"
    )


def rays_line(capture: Capture) -> str:
    """Returns how many pixels of a Capture have no ray, and how many one beside the camera; "" if none."""
    cameras = [frame.camera for frame in sized_frames(capture)]
    if all(camera.distortion is None for camera in cameras):
        return ""
    without, beside = fractions_of_pixels(cameras)
    found = f"{_percent(without)} of the pixels have no ray: no direction is seen there by the lens; they are masked"
    sideways = f"{_percent(beside)} of the pixels are 90 degrees or more from the axis"
    return "; ".join([found] * (without > 0) + [sideways] * (beside > 0))


def sized_frames(capture: Capture) -> list[Frame]:
    """Returns the frames with the size of their camera, without unreadable images, which whoever reads them reports."""
    frames = []
    for frame in capture.frames:
        with contextlib.suppress(ValueError):
            frames.append(with_size(frame))
    return frames


def _percent(fraction):
    return f"{100 * fraction:.0f} %" if fraction >= 0.01 else f"{100 * fraction:.1g} %"
