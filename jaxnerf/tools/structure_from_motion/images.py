"""The images of a capture whose cameras are to be estimated: finding, copying and pairing them."""

import filecmp
import os
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from PIL import ImageOps

from jaxnerf.data.geometry.path_poses import natural_order
from jaxnerf.data.images.image_files import image_size, open_image, read_image
from jaxnerf.runtime.atomic_files import partial_file, read_bytes

MIN_IMAGES = 3
MAX_EXHAUSTIVE = 200  # images; exhaustive matching takes time with the square of their number
_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")  # that both pycolmap and Pillow read
OVERLAP = 10  # neighbours of an image in sequential matching
_MAX_KEY_IMAGES = 60


def find_images(folder: Path) -> tuple[list[Path], str]:
    """Returns the image files of a folder in natural order, and a text that counts its other files.

    Files in subfolders and hidden files are skipped.

    Raises:
        ValueError: if there are fewer than 3.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder}: is no folder, expected one with images; correct --images")
    files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    found = [path for path in files if path.suffix.lower() in _SUFFIXES]
    others = Counter(path.suffix.lower() or "no suffix" for path in files if path not in found)
    counts = ", ".join(f"{count} {suffix}" for suffix, count in sorted(others.items()))
    if len(found) < MIN_IMAGES:
        kinds = ", ".join(_SUFFIXES)
        also = f" and other files ({counts})" if counts else ""
        raise ValueError(
            f"{folder}: holds {len(found) or 'no'} image{'s' * (len(found) != 1)}{also}, expected at least "
            f"{MIN_IMAGES} ({kinds}) directly in it; convert other formats, or correct --images"
        )
    return [found[index] for index in natural_order([path.name for path in found])], counts


def copy_name(path: Path) -> str:
    """Returns the name of an image's copy: what COLMAP's list of pairs cannot hold becomes _.

    That is white space, characters that are not printable or not UTF-8, and # at the start, which begins a comment.
    """
    name = "_" + path.name[1:] if path.name.startswith("#") else path.name
    return "".join("_" if character.isspace() or not character.isprintable() else character for character in name)


def check_images(paths: Sequence[Path], progress: Callable[[int], None]) -> None:
    """Decodes all images; raises a ValueError that names the first unreadable one."""
    for index, path in enumerate(paths, 1):
        read_image(path)
        progress(index)


def copy_images(paths: Sequence[Path], folder: Path, *, overwrite: bool, progress: Callable[[int], None]) -> int:
    """Copies images into a folder and turns those upright that their EXIF orientation says are rotated.

    COLMAP and the reader of its models ignore the EXIF orientation, so that rotated images would put the world
    on its side. A rotated JPEG is encoded again with quality 95; every other image is copied byte by byte.
    An equal file is not copied again. A turned copy has its image's time, by which it is recognised.

    Args:
        paths: images with different names.
        folder: exists.
        overwrite: whether other files of the same names are replaced.
        progress: receives the number of finished images.

    Returns:
        The number of images that have been turned.

    Raises:
        ValueError: if two copies would have one name, an image is unreadable, or another file has its name.
    """
    names = Counter(map(copy_name, paths))
    twice = [name for name, count in names.items() if count > 1]
    if twice:
        raise ValueError(f"{paths[0].parent}: {names[twice[0]]} images would be copied to {twice[0]!r}; rename them")
    turned = 0
    for index, path in enumerate(paths, 1):
        target = folder / copy_name(path)
        if not _is_copy(target, path, overwrite):
            if target.exists() and not overwrite:
                raise ValueError(f"{target}: exists and is no copy of {path}; add --overwrite or choose another --out")
            read_image(path)  # reports a damaged file
            _copy(path, target)
        turned += is_rotated_jpeg(path)
        progress(index)
    return turned


def _is_copy(target, path, overwrite):
    """Returns whether a file is a copy: equal; or, of a JPEG that was turned, of the same time unless overwrite."""
    if not target.is_file():
        return False
    if filecmp.cmp(target, path, shallow=False):
        return not is_rotated_jpeg(path)
    same_time = abs(target.stat().st_mtime - path.stat().st_mtime) <= 2  # some file systems round it to 2 s
    return same_time and not overwrite and is_rotated_jpeg(path)


def is_rotated_jpeg(path: Path) -> bool:
    """Returns whether a file is a JPEG that its EXIF orientation says is not upright."""
    with open_image(path) as image:  # an MPO is a JPEG with further images behind it, as phones write them
        return image.format in ("JPEG", "MPO") and image.getexif().get(0x0112, 1) in range(2, 9)


def _copy(path, target):
    with partial_file(target) as partial:
        if is_rotated_jpeg(path):
            with open_image(path) as image:
                upright = ImageOps.exif_transpose(image)
            kept = {name: upright.info[name] for name in ("exif", "icc_profile") if name in upright.info}
            upright.save(partial, format="JPEG", quality=95, **kept)
        else:
            partial.write_bytes(read_bytes(path))
        times = path.stat()
        os.utime(partial, ns=(times.st_atime_ns, times.st_mtime_ns))


def group_by_size(paths: Sequence[Path]) -> list[list[str]]:
    """Returns the names of images as one list for each size in px, of the pixels as they are stored."""
    groups = {}
    for path in paths:
        groups.setdefault(image_size(path, follow_exif=False), []).append(path.name)
    return list(groups.values())


def resolve_matching(matching: str, count: int) -> str:
    """Returns "exhaustive" or "sequential": the given method, or for "auto" the one that suits a number of images."""
    return matching if matching != "auto" else "exhaustive" if count <= MAX_EXHAUSTIVE else "sequential"


def image_pairs(names: Sequence[str], matching: str) -> list[tuple[str, str]]:
    """Returns the pairs of images to match, each once.

    Args:
        names: in the order of the capture.
        matching: "exhaustive": all pairs. "sequential": each image with the next 10 and with those 16, 32, 64,
            ... 512 places further; and up to 60 evenly spaced images with each other, which closes loops.
            "neighbours": each image with the next 10.
    """
    count = len(names)
    if matching == "exhaustive":
        found = {(first, second) for first in range(count) for second in range(first + 1, count)}
    else:
        far = (2**power for power in range(4, 10)) if matching == "sequential" else ()
        offsets = [*range(1, OVERLAP + 1), *far]
        found = {(first, first + offset) for first in range(count) for offset in offsets if first + offset < count}
    if matching == "sequential":
        key_images = range(0, count, -(-count // _MAX_KEY_IMAGES))
        found |= {(first, second) for first in key_images for second in key_images if first < second}
    return [(names[first], names[second]) for first, second in sorted(found)]
