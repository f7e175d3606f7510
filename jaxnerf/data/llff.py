"""Forward-facing captures in the format of LLFF: poses_bounds.npy beside folders of photographs."""

from pathlib import Path

import numpy as np

from jaxnerf.core.structs import Camera, Views
from jaxnerf.data.checks import check_factor
from jaxnerf.data.images import average_blocks, read_image
from jaxnerf.data.poses import check_pose

_IMAGES = (".png", ".jpg", ".jpeg", ".webp")


def load_views(folder, *, split="train", factor=1, hold=8, bound_share=0.75):
    """Returns one split of an LLFF capture, recentred and scaled as in the released codes.

    The mean camera becomes the identity, so that all look roughly along -z, and the nearest bound
    lies at 1 / bound_share: what normalised device coordinates with a near plane of 1 want.

    Args:
        folder: holds poses_bounds.npy, and images_<factor>/ or images/ (then averaged down).
        split: "train", or "test" (also "val"): every hold-th view by name, from the first.
        factor: whole number, downsampling.
        hold: see split.
        bound_share: see above.

    Returns:
        Views in the order of the names; near and far are the view's bounds, in world units along the axis.

    Raises:
        ValueError: names the file, what was found, what was wanted and what to do.
    """
    folder, factor = Path(folder), check_factor(factor)
    if split not in ("train", "val", "test"):
        raise ValueError(f"{folder}: split is {split!r}, an LLFF capture has 'train' and 'test'; give one")
    poses, bounds, shapes = _read_poses(folder / "poses_bounds.npy")
    paths, shrink = _image_paths(folder, factor)
    if len(paths) != len(poses):
        raise ValueError(
            f"{paths[0].parent}: has {len(paths)} images, poses_bounds.npy has {len(poses)}; wanted one each"
        )
    scale = 1 / (bounds.min() * bound_share)
    poses[:, :, 3] *= scale
    poses = _recenter(poses)
    held = np.arange(len(paths)) % hold == 0
    chosen = np.flatnonzero(~held if split == "train" else held)
    if not len(chosen):
        raise ValueError(f"{folder}: split {split!r} of {len(paths)} images is empty; add images")
    images = [_read(paths[index], shrink) for index in chosen]
    for index, image in zip(chosen, images, strict=True):
        if image.shape != images[0].shape or image.dtype != images[0].dtype:
            raise ValueError(
                f"{paths[index]}: is {image.shape} {image.dtype}, {paths[chosen[0]].name} is "
                f"{images[0].shape} {images[0].dtype}; make all alike"
            )
    height, width, _ = images[0].shape
    count = len(images)
    focal = shapes[chosen, 2] * width / shapes[chosen, 1]
    return Views(
        pixels=np.concatenate([image.reshape(-1, 3) for image in images]),
        offset=np.arange(count, dtype=np.int32) * np.int32(height * width),
        size=np.tile(np.int32([[height, width]]), (count, 1)),
        cameras=Camera(
            to_world=poses[chosen].astype(np.float32),
            focal=np.stack([focal, focal], axis=-1).astype(np.float32),
            center=np.tile(np.float32([[width / 2, height / 2]]), (count, 1)),
            height=height,
            width=width,
        ),
        near=(bounds[chosen, 0] * scale).astype(np.float32),
        far=(bounds[chosen, 1] * scale).astype(np.float32),
        names=tuple(paths[index].stem for index in chosen),
    )


def _read_poses(path):
    """Returns poses [N, 3, 4] (x right, y up, looking along -z), bounds [N, 2] and (h, w, f) [N, 3]."""
    try:
        rows = np.load(path, allow_pickle=False)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file, wanted an LLFF capture; correct the folder") from None
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"{path}: unreadable ({error}), wanted an array of [N, 17]; make it again") from None
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows) or rows.dtype.kind != "f":
        raise ValueError(f"{path}: holds {rows.dtype} {rows.shape}, wanted floats [N, 17]; make it again")
    if not np.isfinite(rows).all():
        raise ValueError(f"{path}: row {np.argwhere(~np.isfinite(rows))[0][0]} is not finite; make it again")
    matrices, bounds = rows[:, :15].reshape(-1, 3, 5), rows[:, 15:]
    if not ((0 < bounds[:, 0]) & (bounds[:, 0] < bounds[:, 1])).all():
        raise ValueError(
            f"{path}: bounds {bounds.min()} to {bounds.max()}, wanted 0 < near < far in each row"
        )
    # The file's axes are down, right, backwards.
    axes = [matrices[..., 1], -matrices[..., 0], matrices[..., 2], matrices[..., 3]]
    poses = np.stack(axes, axis=-1).astype(np.float64)
    for index, pose in enumerate(poses):
        check_pose(np.concatenate([pose, [[0, 0, 0, 1]]]), source=f"{path}, row {index}")
    return poses, bounds.astype(np.float64), matrices[..., 4].astype(np.float64)


def _image_paths(folder, factor):
    """Returns the image files by name, and how many times they are still to be shrunk."""
    for name, shrink in ((f"images_{factor}", 1), ("images", factor)):
        files = sorted(path for path in (folder / name).glob("*") if path.suffix.lower() in _IMAGES)
        if files and (name != "images_1"):
            return files, shrink
    there = ", ".join(sorted(path.name for path in folder.glob("images*"))) or "none"
    raise ValueError(
        f"{folder}: has no images_{factor} or images, only {there}; choose data.factor among these"
    )


def _read(path, shrink):
    image = read_image(path)[..., :3]
    try:
        return image if shrink == 1 else average_blocks(image, shrink)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _recenter(poses):
    """Returns the poses as seen from their mean: position, looking direction and up averaged."""

    def unit(vector):
        return vector / np.linalg.norm(vector)

    center, back = poses[:, :, 3].mean(0), unit(poses[:, :, 2].sum(0))
    right = unit(np.cross(poses[:, :, 1].sum(0), back))
    mean = np.stack([right, np.cross(back, right), back], axis=-1)
    turned = np.einsum("ji,njk->nik", mean, poses)
    turned[:, :, 3] = np.einsum("ji,nj->ni", mean, poses[:, :, 3] - center)
    return turned
