"""Views of a Capture: splits, decoding, shrinking, masks, and cameras of several lenses."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from jaxnerf.core.types import Camera, SparsePoints
from jaxnerf.core.views import Views
from jaxnerf.data.images.downscaled_copies import choose_copies, with_size
from jaxnerf.data.images.image_files import average_tiles, fits, image_form, read_ignored, read_image, read_mask
from jaxnerf.data.images.pixel_cache import fill_pixels, num_workers
from jaxnerf.data.images.pixel_rays import pixels_with_rays
from jaxnerf.data.readers.base import Capture, Frame, frame_times

_LENSES = {"pinhole": 0, "opencv": 5, "fisheye": 4}  # number of coefficients


def split_indices(capture: Capture, split: str, *, hold: int = 8) -> Int[np.ndarray, " N"]:
    """Returns the indices of a split's frames.

    If the dataset defines splits, they are used. Frames in none of them form the split "train" or "test" if
    that one is not defined. Of "val" and "test", one stands for the other if only one is defined. If the
    dataset defines no splits, every hold-th frame by name, from the first, is in "test", which equals "val".

    Raises:
        ValueError: if the split is unknown or empty.
    """
    if split not in {"train", "val", "test", *(capture.splits or ())}:
        raise ValueError(f"{capture.source}: split is {split!r}, expected 'train', 'val' or 'test'; choose one")
    if capture.splits:
        other = {"val": "test", "test": "val"}.get(split, split)
        rest = np.setdiff1d(np.arange(len(capture.frames)), sum(capture.splits.values(), ()))
        chosen = np.array(capture.splits.get(split, capture.splits.get(other, rest)), int)
    else:
        held = np.arange(len(capture.frames)) % hold == 0
        chosen = np.flatnonzero(~held if split == "train" else held)
    if not len(chosen):
        raise ValueError(f"{capture.source}: split {split!r} of {len(capture.frames)} images is empty; add images")
    return chosen


def scored_splits(capture: Capture) -> list[str]:
    """Returns those of the splits "test" and "val" that a dataset defines and that have frames, at least "test"."""
    return [split for split in ("test", "val") if capture.splits and capture.splits.get(split)] or ["test"]


def load_capture(
    capture: Capture,
    *,
    split: str = "train",
    factor: int = 1,
    hold: int = 8,
    background: Sequence[float] | None = None,
    select: Callable[[int], Iterable[int]] | None = None,
    with_pixels: bool = True,
) -> Views:
    """Reads one split of a Capture with all its pixels, see `fill_pixels`.

    Images of 8 and 16 bits, or with and without alpha, may be mixed: all become 16 bit, or get alpha. The
    cameras have a height and width if all images have one size, otherwise None.

    Args:
        capture: with bounds in every frame.
        split, hold: see `split_indices`.
        factor: images are area-averaged down by this integer. Rows at the bottom and columns at the right that
            do not fill a block are cropped. If there is a folder images_N whose N divides the factor, its
            images are used.
        background: red, green, blue in [0, 1] behind images with alpha; None drops alpha.
        select: maps the number of the split's frames to the indices of those to read; None: all.
        with_pixels: False: only what the first bytes of each image tell is read and checked; no pixel and no mask is.

    Returns:
        Views in the order of the frames; near and far are the frames' bounds.

    Raises:
        ValueError: names the file, what was found, what is expected and what to do.
    """
    if capture.rendered:
        frames, shrink = tuple(map(with_size, capture.frames)), factor
    else:
        frames, shrink = choose_copies(capture.frames, factor)
    chosen = [frames[index] for index in split_indices(capture, split, hold=hold)]
    chosen = chosen if select is None else [chosen[index] for index in select(len(chosen))]
    if capture.rendered:
        _check_rendered(chosen, factor, background)
    return _load_frames(
        chosen, shrink, with_pixels, background=background, source=capture.source, points=capture.points
    )


def split_rule(capture: Capture) -> str:
    """Returns in words which frames are those of the split "test", see `split_indices`."""
    return "all that the dataset's own lists name" if capture.splits else "every 8th by name, from the first"


def _load_frames(chosen, shrink, with_pixels, *, background, source, points):
    """Reads frames, whose cameras have a height and width, with sparse points as `load_capture` does."""
    with ThreadPoolExecutor(num_workers()) as pool:
        forms = list(pool.map(functools.partial(_form, shrink=shrink, background=background), chosen))
    sizes = np.array([form.size for form in forms])
    ends = np.cumsum(sizes.prod(axis=1))
    if ends[-1] >= 2**31:  # offsets and pixel ids are int32
        raise ValueError(f"{source}: has {ends[-1]} pixels, expected fewer than 2^31; raise data.factor")
    offset = np.append(0, ends[:-1]).astype(np.int32)
    pixels = np.zeros((0, max(form.channels for form in forms)), np.uint8)
    if with_pixels:
        pixels = _read_pixels(chosen, forms, offset, shrink, background)
    bounds = np.float32([frame.bounds for frame in chosen])
    cameras = [_scaled_camera(frame, form, shrink) for frame, form in zip(chosen, forms, strict=True)]
    masks = _read_masks(chosen, forms, shrink, pixels_with_rays(cameras)) if with_pixels else None
    return Views(
        pixels=pixels,
        offset=offset,
        size=sizes.astype(np.int32),
        cameras=stack_cameras(cameras, [frame.name for frame in chosen]),
        near=bounds[:, 0],
        far=bounds[:, 1],
        mask=masks,
        names=tuple(frame.name for frame in chosen),
        background=background if pixels.shape[-1] == 4 else None,
        sparse=_sparse_points(points, chosen, forms, shrink),
        time=frame_times(frame.time for frame in chosen),
    )


def _check_rendered(frames, factor, background):
    """Raises a ValueError if a rendered image has no alpha to composite, or another size than stated or usual."""
    (*usual, _), usual_dtype = image_form(frames[0].image)
    for frame in frames:
        path, declared = frame.image, (frame.camera.height, frame.camera.width)
        (height, width, channels), dtype = image_form(path)
        if background is not None and channels != 4:
            raise ValueError(
                f"{path}: has no alpha, expected RGBA; set data.background to 'none' (background=None) for RGB"
            )
        if declared != (height, width):
            expected = f"w = {declared[1]}, h = {declared[0]} as its file states"
            raise ValueError(f"{path}: is {width} x {height}, expected {expected}; correct one of them")
        if height % factor or width % factor:
            common = math.gcd(height, width)
            works = ", ".join(str(k) for k in range(1, common + 1) if common % k == 0)
            found = f"factor {factor} does not divide {width} x {height}"
            raise ValueError(f"{path}: {found}, expected a divisor; choose one of {works}")
        if [height, width] != usual or dtype != usual_dtype:
            expected = f"{usual[1]} x {usual[0]} {usual_dtype} as {frames[0].image.name}"
            raise ValueError(f"{path}: is {width} x {height} {dtype}, expected {expected}; render all alike")


def stack_cameras(cameras: Sequence[Camera], names: Sequence[str]) -> Camera:
    """Stacks cameras into one Camera [V] in float32.

    A pinhole becomes an "opencv" lens without distortion if others have one.

    Raises:
        ValueError: if fisheye lenses are mixed with others.
    """
    lenses = {camera.lens for camera in cameras}
    lens = max(lenses, key=list(_LENSES).index)
    if lens == "fisheye" and len(lenses) > 1:
        kinds = ", ".join(f"{name} {camera.lens}" for name, camera in zip(names[:9], cameras, strict=False))
        raise ValueError(f"the images mix lenses ({kinds}), expected only fisheye or none; undistort them")
    distortion = None
    if lens != "pinhole":
        distortion = np.zeros((len(cameras), _LENSES[lens]), np.float32)
        for row, camera in zip(distortion, cameras, strict=True):
            given = () if camera.distortion is None else camera.distortion
            row[: len(given)] = given
    sizes = {(camera.height, camera.width) for camera in cameras}
    height, width = sizes.pop() if len(sizes) == 1 else (None, None)
    numbers = {
        name: np.float32([getattr(camera, name) for camera in cameras]) for name in ("to_world", "focal", "center")
    }
    return Camera(**numbers, distortion=distortion, lens=lens, height=height, width=width)


def check_size(path: Path, found: tuple[int, int], declared: tuple[int, int]) -> None:
    """Checks that an image (height, width) has its camera's size, or is smaller by a whole factor.

    Raises:
        ValueError: names the image and both sizes.
    """
    if not fits(found, declared):
        change = "copy the original or correct the camera"
        if fits(found, declared[::-1]):
            change = "swap the camera's width and height, and look at its focal lengths and centre, too"
        raise ValueError(
            f"{path}: is {found[1]} x {found[0]}, its camera is for {declared[1]} x {declared[0]}; expected "
            f"that size, or both sides smaller by one whole number; {change}"
        )


class _Form(NamedTuple):
    """The size and type that a frame's image will have, known from the file's first bytes.

    Attributes:
        full: (height, width) px of the file, upright.
        size: (height, width) px after shrinking.
        channels: 3 or 4.
        dtype: uint8 or uint16.
    """

    full: tuple[int, int]
    size: tuple[int, int]
    channels: int
    dtype: np.dtype


def _form(frame, shrink, background):
    """Returns the _Form of a frame; ValueError if the image does not fit its camera."""
    declared = frame.camera.height, frame.camera.width
    (height, width, channels), dtype = image_form(frame.image, camera_size=declared, follow_exif=frame.follow_exif)
    check_size(frame.image, (height, width), declared)
    if background is None:
        channels = 3
    if shrink == 1:
        return _Form((height, width), (height, width), channels, dtype)
    if not height // shrink or not width // shrink:
        raise ValueError(f"{frame.image}: is {width} x {height}, too small for factor {shrink}; lower data.factor")
    return _Form((height, width), (height // shrink, width // shrink), channels, np.dtype(np.uint16))


def _scale(frame, form, shrink):
    """Returns [2], pixels of the shrunk image per pixel of the frame's camera, along x and y."""
    return np.array(form.full[::-1]) / (frame.camera.width, frame.camera.height) / shrink


def _scaled_camera(frame, form, shrink):
    """Returns the frame's camera for the shrunk image."""
    camera, scale = frame.camera, _scale(frame, form, shrink)
    height, width = form.size
    return dataclasses.replace(
        camera, focal=camera.focal * scale, center=camera.center * scale, height=height, width=width
    )


def _sparse_points(points, frames, forms, shrink):
    """Returns the SparsePoints of the shrunk images, or None if there are no points."""
    if points is None:
        return None
    parts = []
    for index, (frame, form) in enumerate(zip(frames, forms, strict=True)):
        seen = np.zeros(0, np.int32) if frame.seen is None else np.asarray(frame.seen, np.int32)
        at = np.zeros((0, 2)) if frame.seen is None else frame.seen_at
        pixel = np.float32(at * _scale(frame, form, shrink))
        inside = ((pixel >= 0) & (pixel < form.size[::-1])).all(axis=1)  # shrinking may crop the image
        parts.append((np.full(inside.sum(), index, np.int32), seen[inside], pixel[inside]))
    view, point, pixel = (np.concatenate(column) for column in zip(*parts, strict=True))
    return SparsePoints(positions=np.float32(points), view=view, point=point, pixel=pixel)


def _read_pixels(frames, forms, offset, shrink, background):
    """Returns the pixels [P, C] of all frames, with the largest of their types and numbers of channels."""
    channels = max(form.channels for form in forms)
    dtype = max((form.dtype for form in forms), key=lambda dtype: dtype.itemsize)
    pairs = list(zip(frames, forms, strict=True))
    return fill_pixels(
        [frame.image for frame in frames],
        [functools.partial(_read, frame, form, shrink, background, channels, dtype) for frame, form in pairs],
        shape=(sum(form.size[0] * form.size[1] for form in forms), channels),
        dtype=dtype,
        offsets=offset,
        depends=("images", shrink, background, [(frame.follow_exif, form) for frame, form in pairs]),
    )


def _read(frame, form, shrink, background, channels, dtype):
    """Returns the pixels [H, W, channels] of a frame."""
    camera = frame.camera
    pixels = read_image(frame.image, camera_size=(camera.height, camera.width), follow_exif=frame.follow_exif)
    if background is None:
        pixels = pixels[..., :3]
    if shrink > 1:
        height, width = (side * shrink for side in form.size)
        pixels = average_tiles(pixels[:height, :width], shrink, background=background)
    if pixels.dtype != dtype:
        pixels = pixels.astype(dtype) * dtype.type(257)
    if pixels.shape[-1] == channels:
        return pixels
    opaque = np.full((*pixels.shape[:2], 1), np.iinfo(dtype).max, dtype)
    return np.concatenate([pixels, opaque], axis=-1)


def _read_masks(frames, forms, shrink, with_rays):
    """Returns the mask [P] of all frames, or None if all pixels count; with_rays: see `pixels_with_rays`."""

    def read(frame, form, mask):
        own = read_frame_mask(frame, form.full)
        if own is not None:
            own = own if shrink == 1 else _all_in_tiles(own, *form.size, shrink)
            mask = own if mask is None else own & mask
        return mask

    with ThreadPoolExecutor(num_workers()) as pool:
        masks = list(pool.map(read, frames, forms, with_rays))
    if all(mask is None for mask in masks):
        return None
    pairs = zip(masks, forms, strict=True)
    return np.concatenate(
        [np.ones(math.prod(form.size), bool) if mask is None else mask.reshape(-1) for mask, form in pairs]
    )


def read_frame_mask(frame: Frame, full: tuple[int, int]) -> Bool[np.ndarray, "H W"] | None:
    """Returns which pixels of a frame's image count, by its masks and its crop_radius; None: all.

    Args:
        frame: whose camera has a height and width.
        full: (height, width) of its image. Masks of the original's size are shrunk.

    Raises:
        ValueError: if a mask is unreadable or of another size; names it.
    """
    masks = []
    for path, read in ((frame.mask, read_mask), (frame.ignored, read_ignored)):
        if path is not None:
            masks.append(_shrunk_mask(path, read(path, camera_size=full), frame, full))
    if frame.crop_radius is not None:
        y, x = ((np.arange(side) + 0.5) / side - 0.5 for side in full)
        across = np.hypot((x * frame.camera.width)[None], (y * frame.camera.height)[:, None])
        masks.append(across <= frame.crop_radius)
    return np.all(masks, axis=0) if masks and not all(mask.all() for mask in masks) else None


def _shrunk_mask(path, mask, frame, full):
    """Returns a mask at its image's size."""
    times = max(round(mask.shape[0] / full[0]), 1)
    if not fits(full, mask.shape) or any(times * have > side for have, side in zip(full, mask.shape, strict=True)):
        raise ValueError(
            f"{path}: is {mask.shape[1]} x {mask.shape[0]}, expected {full[1]} x {full[0]} as "
            f"{frame.image.name}; export the mask again"
        )
    return _all_in_tiles(mask, *full, times)


def _all_in_tiles(mask, height, width, times):
    """Returns [height, width] bool: whether all pixels of a block of the mask are True."""
    return mask[: height * times, : width * times].reshape(height, times, width, times).all((1, 3))
