"""Masks in a folder beside the images, which the dataset's format does not state."""

from collections.abc import Sequence
from pathlib import Path

from jaxnerf.data.images.image_files import IMAGE_SUFFIXES

FOLDERS = ("images_mask", "images_masks", "masks")


def find_masks(folder: Path, images: Sequence[tuple[str, str]]) -> tuple[list[Path] | None, list[str]]:
    """Returns the mask of each image from images_mask/, images_masks/ or masks/ of a dataset's folder, and notes.

    The mask of images/side/0001.jpg is masks/side/0001.png or, as COLMAP names it, masks/side/0001.jpg.png.

    Args:
        folder: of the dataset.
        images: (name, suffix) of each, such as ("side/0001", ".jpg").

    Returns:
        The masks, or None if there are none; and one line for each folder that holds no image's mask.

    Raises:
        ValueError: if some images have a mask and others have none; names the first of the latter.
    """
    notes = []
    for place in (folder / name for name in FOLDERS):
        if not place.is_dir():
            continue
        paths = sorted(path for path in place.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES)
        files = {path.relative_to(place).with_suffix("").as_posix(): path for path in paths}
        masks = [files.get(name) or files.get(name + suffix) for name, suffix in images]
        if None not in masks:
            return masks, notes
        first, count = images[masks.index(None)][0], sum(mask is not None for mask in masks)
        if count:
            raise ValueError(
                f"{place}: has no {first}.png, but masks of {count} of {len(masks)} images, expected one for each; "
                "add the missing ones, or rename the folder to train without masks"
            )
        notes.append(f"{place}: has no {first}.png and no other image's mask, so its files are not used")
    return None, notes
