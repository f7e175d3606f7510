"""From the photographs of a Capture to Views: reading, shrinking, masks, lenses, who is held out."""

import functools
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from jaxnerf.core.types import Camera, Views
from jaxnerf.data.images.decode import form_of, read_masks, read_pixels, scaled_camera
from jaxnerf.data.images.downscaled_copies import choose_copies
from jaxnerf.data.images.pixel_cache import workers
from jaxnerf.data.readers.validation import check_background, check_factor

_LENSES = {"pinhole": 0, "opencv": 5, "fisheye": 4}  # coefficients


def split_indices(capture, split, *, hold=8):
    """Returns the indices [N] of a split's frames.

    The capture's own splits count where it has some; training has all the others where it is not named, and
    so has the test where only training is. Otherwise every hold-th by name, from the first, is held out as
    "test"; "val" is the same, and so it is where a capture has only one of the two.

    Raises:
        ValueError: if there is no such split, or nothing in it.
    """
    if split not in ("train", "val", "test"):
        raise ValueError(f"{capture.source}: split is {split!r}, wanted 'train', 'val' or 'test'; give one")
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


def load_views(capture, *, split="train", factor=1, hold=8, background=None, only=None):
    """Returns one split of a capture, with all its pixels, see fill_pixels.

    Args:
        capture: Capture, with bounds in every frame.
        split, hold: see split_indices.
        factor: whole number; images are averaged down by it, cut at the right and below where it does not
            divide them. A folder images_N beside, with an N that divides it, is used where there is one.
        background: red, green, blue in [0, 1] behind images with alpha. None drops alpha.
        only: how many frames the split has -> the indices of those to read; None: all.

    Returns:
        Views in the order of the names; near and far are the frames' bounds. With images of 8 bits and of
        16, or with alpha and without, all become those with more. One size gives the cameras a height and
        width, several leave them None.

    Raises:
        ValueError: names the file, what was found, what was wanted and what to do.
    """
    factor, background = check_factor(factor), check_background(background)
    frames, shrink = choose_copies(capture.frames, factor)
    chosen = [frames[index] for index in split_indices(capture, split, hold=hold)]
    chosen = chosen if only is None else [chosen[index] for index in only(len(chosen))]
    with ThreadPoolExecutor(workers()) as pool:
        forms = list(pool.map(functools.partial(form_of, shrink=shrink, background=background), chosen))
    sizes = np.array([form.size for form in forms])
    ends = np.cumsum(sizes.prod(axis=1))
    if ends[-1] >= 2**31:  # offsets and pixel ids are int32
        raise ValueError(f"{capture.source}: has {ends[-1]} pixels, wanted less than 2^31; raise factor")
    offset = np.append(0, ends[:-1]).astype(np.int32)
    pixels = read_pixels(chosen, forms, offset, shrink, background)
    masks = read_masks(chosen, forms, shrink)
    bounds = np.float32([frame.bounds for frame in chosen])
    cameras = [scaled_camera(frame, form, shrink) for frame, form in zip(chosen, forms, strict=True)]
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
    )


def stack_cameras(cameras, names):
    """Returns one Camera [V] in float32 of several; ValueError if no one lens model holds all of them."""
    lenses = {camera.lens for camera in cameras}
    lens = max(lenses, key=list(_LENSES).index)
    if lens == "fisheye" and len(lenses) > 1:
        kinds = ", ".join(f"{name} {camera.lens}" for name, camera in zip(names[:9], cameras, strict=False))
        raise ValueError(f"the images mix lenses ({kinds}), wanted fisheye alone or none; undistort them")
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
