"""Small datasets of the embedded scene in every format that the package reads, for tests.

    shots = captures.shoot(captures.orbit(8), captures.orbit(4, height=30, width=20, first=8))
    captures.write_transforms(tmp_path, shots, kind="jpg", masks=True)

Shots are exact: each pixel is the colour along the ray that a reader's camera has to reproduce.
"""

import functools
import json
import math
import struct
import zlib
from typing import NamedTuple

import jax
import numpy as np
from PIL import Image

from jaxnerf.core import cameras, rendering
from jaxnerf.core.poses import look_at
from jaxnerf.core.types import Camera, Rays
from jaxnerf.core.views import Views
from jaxnerf.data.geometry import bounds
from jaxnerf.data.images.load_images import load_capture
from jaxnerf.data.readers import blender
from jaxnerf.tools.embedded_scene import render, still_life

WHITE = (1.0, 1.0, 1.0)
SKY = 30.0  # radius of the textured sphere around an unbounded dataset, world units
HIDDEN = (0.25, 0.5)  # the interval of the height and of the width that masks exclude
_LENSES = {
    "pinhole": (1.36, None),  # focal over the shorter side; coefficients
    "opencv": (1.1, (-0.28, 0.09, 0.006, -0.004)),
    "fisheye": (0.8, (0.06, -0.02, 0.004, -0.001)),
}
_ORIENTATION = 0x0112


def black_views(cameras: Camera, **fields) -> Views:
    """Returns Views of black images of stacked cameras of one size, between t = 1 and 9; fields: others of Views."""
    count = len(cameras.to_world)
    size = np.tile(np.int32([[cameras.height, cameras.width]]), (count, 1))
    counts = size.prod(axis=1)
    return Views(
        pixels=np.zeros((counts.sum(), 3), np.uint8),
        offset=np.int32(np.cumsum(counts) - counts),
        size=size,
        cameras=cameras,
        near=np.ones(count, np.float32),
        far=np.full(count, 9, np.float32),
        **fields,
    )


class Shot(NamedTuple):
    """One image and its camera.

    Attributes:
        name: such as "000".
        camera: a single one in numpy float32, with height and width.
        pixels: [H, W, 4] uint16, straight alpha.
    """

    name: str
    camera: Camera
    pixels: np.ndarray


class Points(NamedTuple):
    """Points on opaque surfaces, and the shots that see them.

    Attributes:
        xyz: [N, 3] float64, world units.
        rgb: [N, 3] uint8.
        seen: [V, N] bool, whether a shot sees a point.
        at: [V, N, 2] px, valid where seen.
        depth: [V, N] along the camera's axis, valid where seen.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    seen: np.ndarray
    at: np.ndarray
    depth: np.ndarray


def orbit(count, *, height=24, width=32, lens="pinhole", distance=4.0, first=0, **changes):
    """Returns Camera [count] on a golden spiral around the origin, looking at it.

    Args:
        count: number of cameras.
        height, width: px.
        lens: "pinhole", "opencv" or "fisheye"; the last two have strong distortion.
        distance: from the origin, above 1.7.
        first: position on the spiral of the first camera, so that two stacks do not coincide.
        **changes: focal [2], center [2] or distortion [K] instead of the lens's defaults.
    """
    steps = np.arange(first, first + count)
    up = -0.2 + 0.9 * np.mod(0.5 + 0.7548776662 * steps, 1)
    angle = math.pi * (3 - math.sqrt(5)) * steps
    around = np.sqrt(1 - up**2)
    eyes = distance * np.stack([around * np.cos(angle), around * np.sin(angle), up], axis=-1)
    return _aim(eyes, np.zeros((count, 3)), height, width, lens, changes)


def front(count, *, height=24, width=32, lens="pinhole", distance=4.0, spread=0.4, **changes):
    """Returns Camera [count] side by side in front of the scene, all looking along +y, as in LLFF's datasets."""
    steps = np.arange(count)
    across = spread * (np.mod(0.5 + 0.7548776662 * steps, 1) - 0.5) * 2
    up = spread * (np.mod(0.5 + 0.5698402910 * steps, 1) - 0.5) * 2
    eyes = np.stack([across, np.full(count, -distance), up + 0.2], axis=-1)
    return _aim(eyes, eyes + [0.0, 1.0, -0.05], height, width, lens, changes)


def shoot(*stacks, sky=False):
    """Renders the Shots of stacks of cameras; sky: over a textured sphere, opaque; otherwise with alpha."""
    shots = []
    for stack in stacks:
        count = len(stack.to_world)
        pixels = _rendered(stack, sky).reshape(count, stack.height, stack.width, 4)
        for index in range(count):
            camera = jax.tree.map(lambda leaf, index=index: leaf[index], stack)
            shots.append(Shot(f"{len(shots):03d}", camera, pixels[index]))
    return shots


def noise(*stacks, seed=0):
    """Returns the Shots of stacks of cameras with random pixels, for tests that do not need the scene's."""
    rng, shots = np.random.default_rng(seed), []
    for stack in stacks:
        for index in range(len(stack.to_world)):
            camera = jax.tree.map(lambda leaf, index=index: leaf[index], stack)
            pixels = rng.integers(0, 65536, (stack.height, stack.width, 4), np.uint16)
            shots.append(Shot(f"{len(shots):03d}", camera, pixels))
    return shots


def sky_color(origins, viewdirs):
    """Returns the colour [..., 3] of the sphere of radius SKY along rays from inside it, in [0.1, 0.9]."""
    origins, viewdirs = np.asarray(origins, np.float64), np.asarray(viewdirs, np.float64)
    along = (origins * viewdirs).sum(-1, keepdims=True)
    way = -along + np.sqrt(along**2 - (origins**2).sum(-1, keepdims=True) + SKY**2)
    x, y, z = np.moveaxis((origins + way * viewdirs) / SKY, -1, 0)
    waves = [np.sin(7 * x + 2 * z) * np.cos(5 * y), np.cos(6 * y - 3 * x), np.sin(9 * z + 2 * y)]
    return 0.5 + 0.4 * np.stack(waves, axis=-1)


def over(pixels, background=WHITE):
    """Returns integer pixels [..., 4] composited over a background: [..., 3] in [0, 1]."""
    values = pixels / np.iinfo(pixels.dtype).max
    return values[..., :3] * values[..., 3:] + (1 - values[..., 3:]) * np.asarray(background)


def hidden(height, width):
    """Returns the mask [H, W] bool of masks=True: False in a rectangle."""
    mask = np.ones((height, width), bool)
    rows, columns = (slice(*(int(part * size) for part in HIDDEN)) for size in (height, width))
    mask[rows, columns] = False
    return mask


def write_images(folder, shots, *, kind="png", bits=8, background=WHITE, rgba=False, masks=False, orientation=1):
    """Writes images/<name>.<kind> and masks/<name>.png, and returns the images' paths below the folder.

    Args:
        folder: a Path; created if it does not exist.
        shots: see `shoot`.
        kind: "png", "jpg" (lossy, no alpha) or "webp" (lossless).
        bits: 8, or 16 for PNG.
        background: colour behind the scene, unless rgba.
        rgba: whether alpha is written.
        masks: whether a rectangle of each image is noise and masked.
        orientation: of EXIF; 6: the pixels are stored rotated by 90 degrees counterclockwise.
    """
    paths = []
    for index, shot in enumerate(shots):
        pixels = shot.pixels / 65535 if rgba else over(shot.pixels, background)
        if masks:
            mask = hidden(*pixels.shape[:2])
            noise = np.random.default_rng(index).uniform(size=pixels.shape)
            pixels = np.where(mask[..., None], pixels, noise)
            (folder / "masks").mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.uint8(255 * mask)).save(folder / "masks" / f"{shot.name}.png")
        top, dtype = (255, np.uint8) if bits == 8 else (65535, np.uint16)
        whole = np.rint(pixels * top).astype(dtype)
        paths.append(f"images/{shot.name}.{kind}")
        (folder / "images").mkdir(parents=True, exist_ok=True)
        write_image(folder / paths[-1], whole, orientation=orientation)
    return paths


def write_image(path, pixels, *, orientation=1):
    """Writes [H, W, 3 or 4] uint8 or uint16 as PNG, JPEG or WebP, by the path's suffix."""
    if orientation not in (1, 6):
        raise ValueError(f"orientation is {orientation}, expected 1 or 6")
    stored = np.ascontiguousarray(np.rot90(pixels) if orientation == 6 else pixels)
    exif = Image.Exif()
    exif[_ORIENTATION] = orientation
    if pixels.dtype == np.uint16:
        write_png16(path, stored, exif=exif.tobytes()[6:] if orientation != 1 else None)
        return
    options = {".jpg": {"quality": 97, "subsampling": 0}, ".webp": {"lossless": True}}.get(path.suffix, {})
    options |= {"exif": exif} if orientation != 1 else {}
    Image.fromarray(stored).save(path, **options)


def write_png16(path, pixels, *, exif=None):
    """Writes [H, W, 3 or 4] uint16, which Pillow does not support."""

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    height, width, channels = pixels.shape
    header = struct.pack(">IIBBBBB", width, height, 16, {3: 2, 4: 6}[channels], 0, 0, 0)
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    parts = [chunk(b"IHDR", header), *([chunk(b"eXIf", exif)] if exif else [])]
    parts += [chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


def write_transforms(folder, shots, *, per_frame=None, splits=None, extra=None, masks=False, **images):
    """Writes a dataset in nerfstudio's format and returns the content of its transforms.json.

    Args:
        folder: a Path.
        shots: see `shoot`.
        per_frame: whether every frame states its intrinsics; None: if they differ.
        splits: {"train": indices, ...} for explicit lists of names.
        extra: additional entries of the file, such as {"aabb_scale": 4}.
        masks, **images: see `write_images`.
    """
    paths = write_images(folder, shots, masks=masks, **images)
    stated = [_intrinsics(shot.camera) for shot in shots]
    if per_frame is None:
        per_frame = any(own != stated[0] for own in stated)
    frames = []
    for shot, path, own in zip(shots, paths, stated, strict=True):
        frame = {"file_path": path, "transform_matrix": [*shot.camera.to_world.tolist(), [0, 0, 0, 1]]}
        frame |= {"mask_path": f"masks/{shot.name}.png"} if masks else {}
        frames.append(frame | (own if per_frame else {}))
    content = {**({} if per_frame else stated[0]), "frames": frames, **(extra or {})}
    for split, indices in (splits or {}).items():
        content[f"{split}_filenames"] = [paths[index] for index in indices]
    if len({own["camera_model"] for own in stated}) == 1:
        content["camera_model"] = stated[0]["camera_model"]
    (folder / "transforms.json").write_text(json.dumps(content))
    return content


def write_blender(folder, shots, *, split="train"):
    """Writes one split of a dataset in the NeRF paper's Blender format; the shots have one pinhole camera."""
    (folder / split).mkdir(parents=True, exist_ok=True)
    frames = []
    for shot in shots:
        write_image(folder / split / f"{shot.name}.png", np.uint8(np.rint(shot.pixels / 257)))
        pose = [*shot.camera.to_world.tolist(), [0.0, 0.0, 0.0, 1.0]]
        frames.append({"file_path": f"./{split}/{shot.name}", "transform_matrix": pose})
    camera = shots[0].camera
    angle = 2 * math.atan(0.5 * camera.width / float(camera.focal[0]))
    content = {"camera_angle_x": angle, "frames": frames}
    (folder / f"transforms_{split}.json").write_text(json.dumps(content))


def load_blender(folder, *, split="train", factor=1, near=0.0, far=0.0, background=WHITE, select=None):
    """Returns the Views of a split of a Blender dataset; near and far are 2 and 6 unless they are given."""
    capture = bounds.with_bounds(blender.read_capture(folder, split=split))
    capture = bounds.override_bounds(capture, near, far, np.eye(4))
    return load_capture(capture, split=split, factor=factor, background=background, select=select)


def write_colmap(folder, shots, *, points=None, **images):
    """Writes a COLMAP dataset with a text model in sparse/0, and returns its Points.

    Args:
        folder, **images: see `write_images`.
        shots: see `shoot`. Those with equal intrinsics share a camera.
        points: Points of the same shots; None: surface_points(shots).
    """
    paths = write_images(folder, shots, **images)
    points = surface_points(shots) if points is None else points
    models, lines = {}, []
    tracks = [[] for _ in points.xyz]
    for index, (shot, path) in enumerate(zip(shots, paths, strict=True)):
        model = models.setdefault(_colmap_camera(shot.camera), len(models) + 1)
        rotation = shot.camera.to_world[:, :3].astype(np.float64) * [1, -1, -1]  # COLMAP: y down, z forward
        shift = -rotation.T @ shot.camera.to_world[:, 3]
        pose = " ".join(repr(float(value)) for value in (*_quaternion(rotation.T), *shift))
        lines.append(f"{index + 1} {pose} {model} {path.removeprefix('images/')}")
        marks = np.flatnonzero(points.seen[index])
        lines.append(" ".join(f"{x!r} {y!r} {k + 1}" for k in marks for x, y in [points.at[index, k].tolist()]))
        for place, k in enumerate(marks):
            tracks[k].append(f"{index + 1} {place}")
    model_lines = [f"{number} {line}" for line, number in models.items()]
    point_lines = [
        f"{k + 1} {x!r} {y!r} {z!r} {r} {g} {b} 0.1 {' '.join(tracks[k])}"
        for k, ((x, y, z), (r, g, b)) in enumerate(zip(points.xyz.tolist(), points.rgb.tolist(), strict=True))
    ]
    target = folder / "sparse" / "0"
    target.mkdir(parents=True)
    for name, rows in (("cameras", model_lines), ("images", lines), ("points3D", point_lines)):
        (target / f"{name}.txt").write_text("\n".join(["# written by tests/captures.py", *rows, ""]))
    return points


def write_llff(folder, shots, *, points=None, **images):
    """Writes an LLFF dataset, images/ and poses_bounds.npy; the shots have one pinhole camera."""
    if len({tuple(_intrinsics(shot.camera).items()) for shot in shots}) > 1 or shots[0].camera.lens != "pinhole":
        raise ValueError("LLFF has one pinhole camera for all images, these shots have several; change the shots")
    write_images(folder, shots, **images)
    points = surface_points(shots) if points is None else points
    rows = []
    for shot, seen, depth in zip(shots, points.seen, points.depth, strict=True):
        right, up, back, place = shot.camera.to_world.T.astype(np.float64)
        size = [shot.camera.height, shot.camera.width, shot.camera.focal[0]]
        bounds = np.percentile(depth[seen], [0.1, 99.9])  # as in LLFF's tool
        rows.append([*np.stack([-up, right, back, place, size], axis=-1).ravel(), *bounds])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return points


def write_ply(path, points, *, order="<"):
    """Writes points [N, 3] as a PLY file with colours; order "<" or ">": binary, None: ASCII."""
    kind = {"<": "binary_little_endian", ">": "binary_big_endian", None: "ascii"}[order]
    fields = [("x", "double"), ("y", "double"), ("z", "double"), ("red", "uchar")]
    header = ["ply", f"format {kind} 1.0", f"element vertex {len(points)}"]
    header += [*(f"property {kind} {name}" for name, kind in fields), "end_header", ""]
    if order is None:
        body = "".join(f"{x!r} {y!r} {z!r} 7\n" for x, y, z in np.asarray(points, float).tolist()).encode()
    else:
        rows = np.zeros(len(points), [(name, f"{order}f8") for name in "xyz"] + [("red", "u1")])
        for name, column in zip("xyz", np.transpose(points), strict=True):
            rows[name] = column
        body = rows.tobytes()
    path.write_bytes("\n".join(header).encode() + body)


def surface_points(shots, *, count=200, seed=0, sharp=0.06):
    """Returns Points on opaque surfaces, at the expected depth of random pixels with opacity above 0.99.

    Args:
        shots: see `shoot`.
        count: number of pixels; points that fewer than two shots see are dropped.
        seed: of the choice.
        sharp: world units. A ray whose termination depth has a larger standard deviation hits no surface. A shot
            sees a point if the depth along the ray to it differs by less.
    """
    rng = np.random.default_rng(seed)
    found, colors = [], []
    for index in range(len(shots)):
        shot = shots[index]
        stack = jax.tree.map(lambda leaf: leaf[None], shot.camera)
        rays, height = render.scene_rays(stack), shot.camera.height
        opaque = np.flatnonzero((rays.far > rays.near) & (shot.pixels[..., 3].ravel() > 0.99 * 65535))
        chosen = rng.choice(opaque, min(-(-count // len(shots)), len(opaque)), replace=False)
        rays = jax.tree.map(lambda leaf, chosen=chosen: leaf[chosen], rays)
        depth, opacity, spread = _depths(rays)
        kept = (opacity > 0.99) & (spread < sharp)
        found.append((rays.origins + depth[:, None] * rays.directions)[kept])
        colors.append(shot.pixels.reshape(height * shot.camera.width, 4)[chosen][kept, :3] // 257)
    xyz, rgb = np.concatenate(found).astype(np.float64), np.concatenate(colors).astype(np.uint8)
    views = [_sight(shot.camera, xyz, sharp) for shot in shots]
    seen, at, depth = (np.stack(part) for part in zip(*views, strict=True))
    kept = seen.sum(axis=0) >= 2
    return Points(xyz[kept], rgb[kept], seen[:, kept], at[:, kept], depth[:, kept])


_look_at = jax.jit(look_at)


def _aim(eyes, targets, height, width, lens, changes):
    count, short = len(eyes), min(height, width)
    up = np.array([0.0, 0.0, 1.0], np.float32)
    pairs = zip(np.float32(eyes), np.float32(targets), strict=True)
    poses = np.stack([_look_at(eye, target, up) for eye, target in pairs])
    focal, distortion = _LENSES[lens]
    stated = {"focal": (focal * short,) * 2, "center": (width / 2, height / 2), "distortion": distortion}
    stated = {key: value for key, value in (stated | changes).items() if value is not None}
    return Camera(
        to_world=poses,
        **{key: np.tile(np.float32(value), (count, 1)) for key, value in stated.items()},
        lens=lens,
        height=height,
        width=width,
    )


def _rendered(stack, sky):
    """Returns the pixels [V * H * W, 4]; equal cameras are rendered once per process."""
    leaves = tuple((leaf.shape, leaf.tobytes()) for leaf in jax.tree.leaves(stack))
    return _render_once(leaves, jax.tree.structure(stack), sky)


@functools.lru_cache(maxsize=64)
def _render_once(leaves, structure, sky):
    stack = structure.unflatten([np.frombuffer(data, np.float32).reshape(shape) for shape, data in leaves])
    pixels = render.render_views(stack)
    if sky:
        rays = render.scene_rays(stack)
        color = sky_color(rays.origins, rays.viewdirs)
        values = np.concatenate([over(pixels, color), np.ones((len(pixels), 1))], axis=-1)
        pixels = np.rint(values * 65535).astype(np.uint16)
    pixels.setflags(write=False)
    return pixels


def _depths(rays, chunk=512):
    """Returns expected depth in t, opacity, and standard deviation of the depth in world units, each [R]."""
    count, parts = len(rays.near), []
    for start in range(0, count, chunk):
        index = np.minimum(np.arange(start, start + chunk), count - 1)  # a single compiled shape
        parts.append(_depth_of(jax.tree.map(lambda leaf, index=index: np.float32(leaf[index]), rays)))
    return tuple(np.concatenate(part)[:count] for part in zip(*parts, strict=True))


@jax.jit
def _depth_of(rays):
    result = rendering.render_rays(None, still_life.still_life, rays, num_samples=384)
    middle = (np.arange(384, dtype=np.float32) + 0.5) / 384
    t = rays.near[:, None] + (rays.far - rays.near)[:, None] * middle[None]
    square = (result.weights * (t - result.depth[:, None]) ** 2).sum(axis=-1)
    return result.depth, result.opacity, jax.numpy.sqrt(square * (rays.directions**2).sum(axis=-1))


_project = jax.jit(cameras.project)


def _sight(camera, xyz, sharp):
    """Returns whether a camera sees points [N], their positions [N, 2] px, and depths [N] along its axis."""
    at, depth = (np.asarray(part, np.float64) for part in _project(camera, np.float32(xyz)))
    offset = xyz - camera.to_world[:, 3]
    distance = np.linalg.norm(offset, axis=-1)
    viewdirs = offset / distance[:, None]
    origins = np.broadcast_to(camera.to_world[:, 3], xyz.shape)
    near = np.maximum(distance - 2.8, 0.05)  # the scene's diameter in front of the point
    rays = Rays(origins=origins, directions=viewdirs, viewdirs=viewdirs, near=near, far=distance + 0.2)
    found, opacity, _ = _depths(rays)
    inside = ((at > 0) & (at < [camera.width, camera.height])).all(axis=-1)
    return inside & (depth > 0) & (opacity > 0.99) & (np.abs(found - distance) < sharp), at, depth


def _intrinsics(camera):
    models = {"pinhole": "PINHOLE", "opencv": "OPENCV", "fisheye": "OPENCV_FISHEYE"}
    names = {"opencv": ("k1", "k2", "p1", "p2", "k3"), "fisheye": ("k1", "k2", "k3", "k4")}
    (fl_x, fl_y), (cx, cy) = camera.focal.tolist(), camera.center.tolist()
    stated = {"camera_model": models[camera.lens], "fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy}
    stated |= {"w": camera.width, "h": camera.height}
    if camera.distortion is not None:
        stated |= dict(zip(names[camera.lens], camera.distortion.tolist(), strict=False))
    return stated


def _colmap_camera(camera):
    """Returns a line of cameras.txt without its number."""
    model, values = _intrinsics(camera)["camera_model"], [*camera.focal, *camera.center]
    values += [] if camera.distortion is None else list(camera.distortion)
    if camera.lens == "opencv" and len(values) == 9:
        model, values = "FULL_OPENCV", [*values, 0, 0, 0]
    return f"{model} {camera.width} {camera.height} {' '.join(repr(float(value)) for value in values)}"


def _quaternion(rotation):
    """Returns w, x, y, z of a rotation [3, 3]: the eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    return np.linalg.eigh(matrix)[1][:, -1]
