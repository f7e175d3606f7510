"""Reads the images of a dataset as training would, finds their corners, and compares each image with the others."""

import contextlib
import re
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt

from jaxnerf.data.geometry.world import poses_of
from jaxnerf.data.images.downscaled_copies import with_size
from jaxnerf.data.images.image_files import open_image, read_image
from jaxnerf.data.images.load_images import check_size, read_frame_mask
from jaxnerf.data.readers.base import Capture, Frame
from jaxnerf.runtime import stages
from jaxnerf.tools.capture_check.findings import Finding, named

_LONGEST = 512  # px of the reduced images, to whose pixels all pixel errors refer
_MAX_CORNERS = 400  # of one image
_THUMBNAIL = 24  # px
_MATTE = 128  # px, longest side
_AROUND = 7  # px around a corner whose mean is its colour
_SAME = 0.0015  # mean difference of thumbnails, in [0, 1], below which two images are the same
_PLAIN = 1e-6  # sharpness of an image without texture
_BLURRED = 0.25  # of the median sharpness of the neighbours


class ImageSummary(NamedTuple):
    """The properties of an image that the check keeps.

    Attributes:
        size: (height, width) px of the file.
        channels: 3 or 4.
        reduced: (height, width) px of the reduced image.
        corners: [N, 2] px of the camera.
        descriptors: [N, 128] of length 1.
        colors: [N, 3] around the corners, in [0, 1].
        thumbnail: grey.
        sharpness: standard deviation of the Laplacian of the reduced image.
        matte: mean alpha of the pixels of a small image, in [0, 1]; None without alpha.
    """

    size: tuple[int, int]
    channels: int
    reduced: tuple[int, int]
    corners: Float[np.ndarray, "N 2"]
    descriptors: Float[np.ndarray, "N 128"]
    colors: Float[np.ndarray, "N 3"]
    thumbnail: Float[np.ndarray, "24 24"]
    sharpness: float
    matte: Float[np.ndarray, "h2 w2"] | None


def read(capture: Capture) -> tuple[list[ImageSummary | None], list[Finding]]:
    """Returns the ImageSummary of every frame, None where an image is unreadable, and Findings about these."""

    longest = _reduced_side(capture.frames)

    def one(item):
        try:
            return _summarize(item[1], longest), None
        except ValueError as error:
            return None, refused(str(error), (item[0],))

    both: list = []
    with ThreadPoolExecutor(2) as pool, stages.stage("reading images") as stage:  # OpenCV releases Python's lock
        for found in pool.map(one, enumerate(capture.frames)):
            both.append(found)
            stage.update(len(both), len(capture.frames))
    return [image for image, _ in both], [finding for _, finding in both if finding]


def reduce(pixels: UInt[np.ndarray, "H W C"], longest: int) -> Float[np.ndarray, "h w"]:
    """Returns an image as grey float32 in [0, 1], resized to a longest side; alpha is composited over white."""
    limit, has_alpha = np.float32(np.iinfo(pixels.dtype).max), pixels.shape[-1] == 4
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGBA2GRAY if has_alpha else cv2.COLOR_RGB2GRAY) / limit
    if has_alpha:
        grey = 1 + pixels[..., 3] / limit * (grey - 1)
    return _resized(grey, longest)


def _resized(image, longest):
    factor = longest / max(image.shape[:2])
    height, width = (max(round(side * factor), 1) for side in image.shape[:2])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def _colors_at(pixels, corners, longest):
    """Returns the mean colours [N, 3] in [0, 1] around corners [N, 2] px of the reduced image."""
    blurred = cv2.blur(_resized(pixels, longest), (_AROUND, _AROUND)) / np.float32(np.iinfo(pixels.dtype).max)
    if pixels.shape[-1] == 4:
        blurred[..., :3] = 1 + blurred[..., 3:] * (blurred[..., :3] - 1)
    x, y = np.minimum(corners.astype(int), np.array(blurred.shape[1::-1]) - 1).T
    return np.float64(blurred[y, x, :3])


def find_corners(grey: Float[np.ndarray, "h w"]) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 128"]]:
    """Returns the corners of a grey image, px, and their SIFT descriptors, of length 1.

    Corners are those of Shi and Tomasi (1994). Descriptors have one size and no rotation: neighbouring images
    of a dataset show the scene upright and at a similar scale.
    """
    image = np.uint8(np.rint(255 * grey))
    corners = cv2.goodFeaturesToTrack(image, _MAX_CORNERS, qualityLevel=1e-4, minDistance=8, blockSize=7)
    if corners is None:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 20, 0.01)
    corners = cv2.cornerSubPix(image, corners, (3, 3), (-1, -1), until)
    keypoints = [cv2.KeyPoint(float(x), float(y), 3.4, 0.0) for x, y in corners[:, 0]]  # 4 x 4 cells of 5 px
    keypoints, descriptors = cv2.SIFT_create().compute(image, keypoints)
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    # OpenCV's (0, 0) is the centre of the first pixel.
    return np.array([keypoint.pt for keypoint in keypoints]) + 0.5, descriptors / np.maximum(lengths, 1e-9)


def compare(capture: Capture, images: Sequence[ImageSummary | None], near: Int[np.ndarray, "V K"]) -> list[Finding]:
    """Returns Findings about sizes, alpha, masks, duplicates and blur; near holds the neighbours of each view."""
    readable = [index for index, image in enumerate(images) if image is not None]
    findings = _odd_sizes(capture, images, readable) + _odd_alpha(capture, images, readable) + _odd_masks(capture)
    return findings + _duplicates(capture, images, readable) + _blurred(capture, images, near)


def _reduced_side(frames: Sequence[Frame]) -> int:
    """Returns the longest side of the reduced images: the median of the dataset's, divided by a whole number.

    All images are reduced to one size because the descriptors are not invariant to scale.
    """
    sides = []
    for frame in frames:
        with contextlib.suppress(Exception), open_image(frame.image) as image:  # reported when the image is read
            sides.append(max(image.size))
    median = int(np.median(sides or [_LONGEST]))
    return median // -(-median // _LONGEST)


def _summarize(frame: Frame, longest: int) -> ImageSummary:
    frame = with_size(frame)
    camera = frame.camera
    declared = camera.height, camera.width
    pixels = read_image(frame.image, camera_size=declared, follow_exif=frame.follow_exif)
    size = pixels.shape[:2]
    check_size(frame.image, size, declared)
    grey = reduce(pixels, longest)
    corners, descriptors = find_corners(grey)
    colors = _colors_at(pixels, corners, longest)
    corners *= np.array(size[::-1]) / grey.shape[::-1]
    mask = read_frame_mask(frame, size)
    if mask is not None:
        x, y = np.minimum(corners.astype(int), np.array(size[::-1]) - 1).T
        corners, descriptors, colors = (each[mask[y, x]] for each in (corners, descriptors, colors))
    thumbnail = cv2.resize(grey, (_THUMBNAIL, _THUMBNAIL), interpolation=cv2.INTER_AREA)
    sharpness = float(cv2.Laplacian(grey, cv2.CV_32F).std())
    scale = np.array(declared)[::-1] / size[::-1]
    found = corners * scale, descriptors, colors, thumbnail, sharpness, _matte(pixels)
    return ImageSummary(size, pixels.shape[-1], grey.shape, *found)


def _matte(pixels):
    if pixels.shape[-1] == 3:
        return None
    return _resized(pixels[..., 3] / np.float32(np.iinfo(pixels.dtype).max), min(_MATTE, max(pixels.shape)))


def refused(message: str, frames: tuple[int, ...], kind: str = "file") -> Finding:
    """Returns the Finding for the message of a reader: "file: found, expected X; change"."""
    found, *rest = re.split("[,;] expected ", message, maxsplit=1)
    expected, _, change = "".join(rest).partition("; ")
    kind = "size" if kind == "file" and (" x " in expected or "that size" in expected) else kind
    expected, change = expected or "a complete image file", change or "copy the file again"
    return Finding("error", kind, found, expected, change, frames)


def _odd_sizes(capture, images, readable):
    """Returns Findings about images of another size than most, beside the one that their cameras state."""
    groups: dict[tuple, list[int]] = {}
    for index in readable:  # cameras without a size are compared with those of the same lens
        camera = capture.frames[index].camera
        alone = capture.rendered or None not in (camera.height, camera.width)
        group = () if alone else (*map(float, camera.focal), *map(float, camera.center))
        groups.setdefault(group, []).append(index)
    findings = []
    for group, members in groups.items():
        scaled = not capture.rendered and not group
        sizes = [_over_camera(capture.frames[k], images[k]) if scaled else images[k].size for k in members]
        (usual, count), *_ = Counter(sizes).most_common(1)
        if count >= 0.5 * len(members):
            odd = [index for index, size in zip(members, sizes, strict=True) if size != usual]
            findings += [_odd_size(capture, index, images[index].size, usual) for index in odd]
    return findings


def _over_camera(frame, image):
    """Returns the size of an image over that which its camera states."""
    return max(image.size) / max(frame.camera.height, frame.camera.width)


def _odd_size(capture, index, size, usual):
    (height, width), frame = size, capture.frames[index]
    severity, of_camera = "error" if capture.rendered else "warning", ""
    if isinstance(usual, tuple):
        expected = f"{usual[1]} x {usual[0]} as most images"
    else:
        expected = f"{usual:.4g} times the size of its camera, as most images"
        of_camera = f", its camera {frame.camera.width} x {frame.camera.height}"
    found, change = f"{frame.image} is {width} x {height}{of_camera}", "that file: copy or render it again at that size"
    return Finding(severity, "size", found, expected, change, (index,))


def _odd_alpha(capture, images, readable):
    opaque = [index for index in readable if images[index].channels == 3]
    if opaque and len(opaque) < len(readable):
        few = opaque if 2 * len(opaque) <= len(readable) else sorted(set(readable) - set(opaque))
        has = "no alpha" if few is opaque else "alpha"
        found = f"{named(capture, few)} has {has}, unlike the other {len(readable) - len(few)} images"
        change = "those files: export them again as the others"
        return [Finding("error", "mask", found, "alpha in all images or in none", change, tuple(few))]
    if not opaque or not capture.rendered:
        return []
    found = "no image has alpha, and rendered images are composited over white by default"
    return [Finding("warning", "mask", found, "RGBA", "--config.data.background=none, or render RGBA")]


def _odd_masks(capture):
    without = [index for index, frame in enumerate(capture.frames) if frame.mask is None]
    if len(without) in (0, len(capture.frames)):
        return []
    found = f"{named(capture, without)} has no mask, {len(capture.frames) - len(without)} others have one"
    change = "add the missing mask files (white where no pixel is ignored), or remove all masks"
    return [Finding("error", "mask", found, "a mask for every image or for none", change, tuple(without))]


def _duplicates(capture, images, readable):
    if len(readable) < 2:
        return []
    thumbnails = np.stack([images[index].thumbnail.reshape(-1) for index in readable])
    poses, findings = poses_of(capture), []
    for row, index in enumerate(readable):
        same = np.flatnonzero(np.abs(thumbnails[row + 1 :] - thumbnails[row]).mean(axis=1) < _SAME) + row + 1
        for other in (readable[k] for k in same):
            cameras = "different cameras" if np.abs(poses[index] - poses[other]).max() > 1e-6 else "the same camera"
            found = f"{capture.frames[index].name} and {capture.frames[other].name} are the same image from {cameras}"
            change = "remove one of the two, or copy the right file"
            findings.append(Finding("warning", "duplicate", found, "different images", change, (index, other)))
    return findings[:10]


def _blurred(capture, images, near):
    findings = []
    for index, others in enumerate(near):
        beside = [images[other].sharpness for other in others if images[other] is not None]
        if images[index] is None or len(beside) < 2 or np.median(beside) <= _PLAIN:
            continue
        fraction = images[index].sharpness / np.median(beside)
        if fraction < _BLURRED:
            found = f"{capture.frames[index].image} has {100 * fraction:.0f} % of the detail of its neighbours"
            findings.append(Finding("warning", "blur", found, "sharp images", "remove that image", (index,)))
    return findings
