"""Copies of captures with one thing made wrong: what `jaxnerf.check` has to find.

Photographs are links to the originals but for those that are changed.
"""

import json
import shutil
import struct
from pathlib import Path

import numpy as np
from PIL import Image

from jaxnerf.data.images import downscaled_copies

_SWAP_YZ = np.diag([1.0, -1.0, -1.0])
_LLFF = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # our axes by the file's: down, right, backwards


def copy(source, target, *, without=()):
    """Copies a capture: files that hold cameras are written anew, photographs are links."""
    for path in sorted(Path(source).rglob("*")):
        place = Path(target) / path.relative_to(source)
        if path.is_dir() or any(part in without for part in place.parts):
            continue
        place.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix.lower() in downscaled_copies.IMAGES:
            place.symlink_to(path.resolve())
        else:
            shutil.copyfile(path, place)
    return Path(target)


def images(folder):
    """Returns the photographs that training would read, by name."""
    for place in ("images", "images_4", "images_8", "train"):
        if found := downscaled_copies.image_files(Path(folder) / place):
            return found
    raise ValueError(f"{folder} has no images")


def edit_poses(folder, change):
    """Writes change(poses) for the poses [V, 3, 4] (x right, y up, looking along -z) of a capture."""
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


def flip(*signs):
    """Returns the change that multiplies the axes of every camera with signs."""
    return lambda poses: np.concatenate([poses[..., :3] * signs, poses[..., 3:]], axis=-1)


def mirror(poses):
    """Returns poses in a world that is mirrored in x, their images mirrored with it: all are rotations."""
    return flip(-1, 1, 1)(poses) * np.array([-1.0, 1, 1])[:, None]


def mirror_points(folder):
    """Mirrors the points of a COLMAP model as `mirror` does its cameras."""
    path = Path(folder) / "sparse" / "0" / "points3D.bin"
    if not path.is_file():
        return
    data, at = bytearray(path.read_bytes()), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        struct.pack_into("<d", data, at + 8, -struct.unpack_from("<d", data, at + 8)[0])
        at += 51 + 8 * struct.unpack_from("<Q", data, at + 43)[0]
    path.write_bytes(data)


def scale_focal(folder, factor):
    """Multiplies the focal length that a capture's files state."""
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
        for _ in range(struct.unpack_from("<Q", data)[0]):  # SIMPLE_RADIAL, as `can` has
            kind, focal = (
                struct.unpack_from("<i", data, at + 4)[0],
                struct.unpack_from("<d", data, at + 24)[0],
            )
            if kind != 2:
                raise ValueError(f"{path}: a camera is of kind {kind}, wanted 2 (SIMPLE_RADIAL)")
            struct.pack_into("<d", data, at + 24, factor * focal)
            at += 24 + 4 * 8
        path.write_bytes(data)


def scale_bounds(folder, factor):
    """Multiplies near and far in poses_bounds.npy."""
    path = Path(folder) / "poses_bounds.npy"
    rows = np.load(path)
    rows[:, 15:] *= factor
    np.save(path, rows)


def swap(first, second):
    """Exchanges two photographs."""
    one, two = first.read_bytes(), second.read_bytes()
    _write(first, two)
    _write(second, one)


def cut(path):
    """Leaves the first half of a file."""
    data = path.read_bytes()
    _write(path, data[: len(data) // 2])


def resize(path, share):
    """Makes a photograph smaller."""
    image = Image.open(path)
    image.load()
    path.unlink()
    image.resize([round(side * share) for side in image.size]).save(path)


def remove_alpha(folder, index):
    """Gives all photographs alpha, where they have none, and takes it from one."""
    for place, path in enumerate(images(folder)):
        image = Image.open(path)
        image.load()
        if place == index:
            path.unlink()
            image.convert("RGB").save(path, format="PNG")
        elif image.mode != "RGBA":
            path.unlink()
            half = image.resize([side // 2 for side in image.size]).convert("RGBA")
            half.save(path, format="PNG", compress_level=1)  # by whatever name, as a COLMAP model knows it


def add_masks(folder, *, without=(), unwritten=()):
    """Gives the frames of a transforms.json masks, but for some that get none or whose file is missing."""
    source = Path(folder) / "transforms.json"
    content = json.loads(source.read_text())
    (Path(folder) / "masks").mkdir()
    for frame in content["frames"]:
        path, name = Path(folder) / frame["file_path"], Path(frame["file_path"]).stem
        if name not in without:
            frame["mask_path"] = f"masks/{name}.png"
        if path.is_file() and name not in (*without, *unwritten):
            Image.new("L", Image.open(path).size, 255).save(Path(folder) / frame["mask_path"])
    source.write_text(json.dumps(content))


def _write(path, data):
    path.unlink()  # the link and not what it leads to
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
