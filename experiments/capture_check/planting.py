"""Copies of datasets with one planted defect, which `jaxnerf-check` has to find.

Images are links to the originals, except for those that are changed.
"""

import json
import shutil
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from jaxnerf.data.images import downscaled_copies
from jaxnerf.data.images.image_files import image_size, open_image

_SWAP_YZ = np.diag([1.0, -1.0, -1.0])
_LLFF = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # from LLFF's axes (down, right, backwards)
_IMAGES = {".png", ".jpg", ".jpeg"}
Change = Callable[[np.ndarray], np.ndarray]  # of poses [V, 3, 4]


def copy(source: Path, target: Path, *, without: Sequence[str] = ()) -> Path:
    """Copies a dataset, without the files and folders of the given names; images become links."""
    for path in sorted(Path(source).rglob("*")):
        place = Path(target) / path.relative_to(source)
        if path.is_dir() or set(without) & set(place.parts):
            continue
        place.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix.lower() in _IMAGES:
            place.symlink_to(path.resolve())
        else:
            shutil.copyfile(path, place)
    return Path(target)


def images(folder: Path) -> list[Path]:
    """Returns the images that training would read, sorted by name."""
    for place in ("images", "images_4", "images_8", "train"):
        if found := downscaled_copies.list_images(Path(folder) / place):
            return found
    raise ValueError(f"{folder} has no images")


def edit_poses(folder: Path, change: Change) -> None:
    """Replaces the poses [V, 3, 4] (x right, y up, looking along -z) of a dataset by change(poses)."""
    for path in sorted(Path(folder).glob("transforms*.json")):
        content = json.loads(path.read_text())
        poses = np.array([frame["transform_matrix"] for frame in content["frames"]])[:, :3]
        for frame, pose in zip(content["frames"], change(poses), strict=True):
            frame["transform_matrix"] = [*pose.tolist(), [0, 0, 0, 1]]
        path.write_text(json.dumps(content))
    if (path := Path(folder) / "poses_bounds.npy").is_file():
        rows = np.load(path)
        matrices = rows[:, :15].reshape(-1, 3, 5)
        poses = change(np.concatenate([matrices[..., :3] @ _LLFF, matrices[..., 3:4]], axis=-1))
        matrices[..., :3], matrices[..., 3] = poses[..., :3] @ _LLFF.T, poses[..., 3]
        np.save(path, np.concatenate([matrices.reshape(-1, 15), rows[:, 15:]], axis=1))
    if (path := Path(folder) / "sparse" / "0" / "images.bin").is_file():
        _edit_colmap(path, change)


def flip(*signs: int) -> Change:
    """Returns the change that multiplies the axes of every camera by signs."""
    return lambda poses: np.concatenate([poses[..., :3] * signs, poses[..., 3:]], axis=-1)


def mirror(poses: np.ndarray) -> np.ndarray:
    """Returns poses in a world that is mirrored in x. Their x axes are mirrored too, so they stay rotations."""
    return flip(-1, 1, 1)(poses) * np.array([-1.0, 1, 1])[:, None]


def mirror_points(folder: Path) -> None:
    """Mirrors the points of a COLMAP model as `mirror` mirrors its cameras."""
    path = Path(folder) / "sparse" / "0" / "points3D.bin"
    if not path.is_file():
        return
    data, at = bytearray(path.read_bytes()), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        struct.pack_into("<d", data, at + 8, -struct.unpack_from("<d", data, at + 8)[0])
        at += 51 + 8 * struct.unpack_from("<Q", data, at + 43)[0]
    path.write_bytes(data)


def scale_focal(folder: Path, factor: float) -> None:
    """Multiplies the focal length in the files of a dataset."""
    for path in sorted(Path(folder).glob("transforms*.json")):
        content = json.loads(path.read_text())
        for key in ("fl_x", "fl_y"):
            if key in content:
                content[key] *= factor
        angle = content["camera_angle_x"]
        content["camera_angle_x"] = 2 * np.arctan(np.tan(angle / 2) / factor)
        path.write_text(json.dumps(content))
    if (path := Path(folder) / "poses_bounds.npy").is_file():
        rows = np.load(path)
        rows[:, 14] *= factor
        np.save(path, rows)
    if (path := Path(folder) / "sparse" / "0" / "cameras.bin").is_file():
        data, at = bytearray(path.read_bytes()), 8
        for _ in range(struct.unpack_from("<Q", data)[0]):  # SIMPLE_RADIAL, as in `can`
            kind, focal = (
                struct.unpack_from("<i", data, at + 4)[0],
                struct.unpack_from("<d", data, at + 24)[0],
            )
            if kind != 2:
                raise ValueError(f"{path}: a camera is of model {kind}, expected 2 (SIMPLE_RADIAL)")
            struct.pack_into("<d", data, at + 24, factor * focal)
            at += 24 + 4 * 8
        path.write_bytes(data)


def scale_bounds(folder: Path, factor: float) -> None:
    """Multiplies near and far in poses_bounds.npy."""
    path = Path(folder) / "poses_bounds.npy"
    rows = np.load(path)
    rows[:, 15:] *= factor
    np.save(path, rows)


def swap(first: Path, second: Path) -> None:
    """Exchanges two images."""
    one, two = first.read_bytes(), second.read_bytes()
    _write(first, two)
    _write(second, one)


def cut(path: Path) -> None:
    """Truncates a file to its first half."""
    data = path.read_bytes()
    _write(path, data[: len(data) // 2])


def resize(path: Path, fraction: float) -> None:
    """Resizes an image to a fraction of its size."""
    with open_image(path) as image:
        image.load()
    path.unlink()
    image.resize([round(side * fraction) for side in image.size]).save(path)


def remove_alpha(folder: Path, index: int) -> None:
    """Adds alpha to all images without, and removes it from one."""
    for place, path in enumerate(images(folder)):
        with open_image(path) as image:
            image.load()
        if place == index:
            path.unlink()
            image.convert("RGB").save(path, format="PNG")
        elif image.mode != "RGBA":
            path.unlink()
            half = image.resize([side // 2 for side in image.size]).convert("RGBA")
            half.save(path, format="PNG", compress_level=1)  # under the old name, which a COLMAP model refers to


def add_masks(folder: Path, *, without: Sequence[str] = (), unwritten: Sequence[str] = ()) -> None:
    """Adds masks to the frames of a transforms.json, except to some, and omits the files of some others."""
    source = Path(folder) / "transforms.json"
    content = json.loads(source.read_text())
    (Path(folder) / "masks").mkdir()
    for frame in content["frames"]:
        path, name = Path(folder) / frame["file_path"], Path(frame["file_path"]).stem
        if name not in without:
            frame["mask_path"] = f"masks/{name}.png"
        if path.is_file() and name not in (*without, *unwritten):
            Image.new("L", image_size(path, follow_exif=False), 255).save(Path(folder) / frame["mask_path"])
    source.write_text(json.dumps(content))


def _write(path, data):
    path.unlink()  # the link, not the original
    path.write_bytes(data)


def _edit_colmap(path, change):
    data, at, places = bytearray(path.read_bytes()), 8, []
    for _ in range(struct.unpack_from("<Q", data)[0]):
        places.append(at)
        at = data.index(b"\0", at + 64) + 1
        at += 8 + 24 * struct.unpack_from("<Q", data, at)[0]
    turns, eyes = [], []
    for place in places:
        w, *axis, x, y, z = struct.unpack_from("<7d", data, place + 4)
        turn = _rotation(w, np.array(axis))
        turns.append(turn.T @ _SWAP_YZ)
        eyes.append(-turn.T @ [x, y, z])
    poses = change(np.concatenate([np.array(turns), np.array(eyes)[..., None]], axis=-1))
    for place, pose in zip(places, poses, strict=True):
        turn = (pose[:, :3] @ _SWAP_YZ).T
        struct.pack_into("<7d", data, place + 4, *_quaternion(turn), *(-turn @ pose[:, 3]))
    path.write_bytes(data)


def _rotation(w, v):
    across = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * across + 2 * across @ across


def _quaternion(turn):
    """Returns w, x, y, z of a rotation [3, 3]: the eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = turn
    matrix = [
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ]
    return np.linalg.eigh(np.array(matrix))[1][:, -1]
