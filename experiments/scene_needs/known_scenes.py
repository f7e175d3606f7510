"""Captures whose needs are known before anything is trained, because each is made with or without one thing.

A capture is a folder with transforms.json and images of 64 training views and 4 test views. Most show the embedded
still life with matt surfaces; the fog is a Gaussian cloud. SCENES states for each
which parts of the model it needs, and why that follows from its construction.

All images have noise as a sensor's. No model can predict it, so errors far below it count for nothing, and whether a
part pays does not depend on the last hundredth of the error. Every eighth training view, from the fourth, is one that
`data.hold_out=8` holds out. Errors of poses and exposures spare these views, and have mean zero over the others, so
that a model that undoes the errors agrees with the views that score it.
"""

import json
import math
import pathlib
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from PIL import Image

from jaxnerf.core.cameras import pixel_grid, rays_from_pixels
from jaxnerf.core.poses import look_at
from jaxnerf.core.types import Camera
from jaxnerf.data.images.image_files import average_tiles, to_straight
from jaxnerf.data.view_selection import held_out
from jaxnerf.runtime.atomic_files import write_text
from jaxnerf.tools.embedded_scene import render
from test_scenes import analytic

NUM_TRAIN, NUM_TEST, HOLD_OUT = 64, 4, 8
NEEDED, NOT_NEEDED = "needed", "not needed"
WHITE = (1.0, 1.0, 1.0)
_DISTANCE = 4.0  # of every camera from the origin, world units
_FOCAL = 1.36  # over the side of an image
_SKY = 30.0  # radius of the sphere behind the scene, world units
_CLOUD = {"density": 1.5, "deviation": 0.45}
_SLOPE = ((0.3, 0.0, 0.1), (0.0, 0.3, -0.1), (-0.1, 0.1, 0.3))  # of its colours
_look_at = jax.jit(look_at)


class Known(NamedTuple):
    """A capture, and what it needs.

    Attributes:
        about: what is special about it, in a few words.
        verdicts: {part: (NEEDED or NOT_NEEDED, reason)}; a part that is off in the complete model is needed if it pays.
        finish: of the still life's surfaces; "fog": the cloud in its place.
        tint: of all colours by the direction: a channel is multiplied by 1 - tint (1 + one of its components).
        sizes: sides of the images, px; view i has the side i modulo their number.
        rays: along each side of a pixel, whose colour is their mean.
        behind: "alpha": transparent; "black"; "sky": a textured sphere.
        has_box: whether the file states a box around the scene, so that nothing is inferred from alpha or the cameras.
        stops: standard deviation of the training images' exposures.
        degrees: standard deviation of the training poses' rotations about each axis.
        noise: standard deviation of the sensor's noise; values are in [0, 1].
    """

    about: str
    verdicts: dict[str, tuple[str, str]]
    finish: str = "matt"
    tint: float = 0.0
    sizes: tuple[int, ...] = (48,)
    rays: int = 1
    behind: str = "alpha"
    has_box: bool = False
    stops: float = 0.0
    degrees: float = 0.0
    noise: float = 0.02


# Names of parts and changes are those of jaxnerf-needs. "more" of a part that is off: needed if it pays.
_VIEWS, _EXPOSURES, _POSES = "view dependence, without", "exposures, more", "refined poses, more"
_SPACE, _FOOTPRINTS, _RAYS = "contraction of space", "footprints of pixels", "several rays a pixel, more"
_SAME_EXPOSURE = {_EXPOSURES: (NOT_NEEDED, "all images have the same exposure")}
_POINTS = {_RAYS: (NOT_NEEDED, "a pixel shows a point, which is one ray")}
SCENES = {
    "matt": Known(
        "matt surfaces",
        {_VIEWS: (NOT_NEEDED, "no colour depends on the direction")}
        | {f"{_FOOTPRINTS}, more": (NOT_NEEDED, "all pixels have one size")}
        | _SAME_EXPOSURE
        | _POINTS,
        noise=0.05,
    ),
    "iridescent": Known(
        "colours that change with the direction",
        {_VIEWS: (NEEDED, "the same surface has another colour from another side")},
        tint=0.3,
    ),
    "exposed": Known(
        "exposures that vary by half a stop",
        {_EXPOSURES: (NEEDED, "the same surface has other colours in other images")},
        stops=0.5,
    ),
    "turned": Known(
        "poses that are wrong by half a degree",
        {_POSES: (NEEDED, "rays miss what their pixels show, by 0.6 pixels about each axis")},
        behind="black",
        has_box=True,
        degrees=0.5,
    ),
    "exact": Known(
        "the same with exact poses",
        {_POSES: (NOT_NEEDED, "all poses are exact")} | _SAME_EXPOSURE,
        behind="black",
        has_box=True,
    ),
    "scales": Known(
        "pixels of three sizes",
        {
            f"{_FOOTPRINTS}, without": (NEEDED, "a large pixel is a mean, which a field of points has nowhere"),
        },
        sizes=(48, 24, 11),
        rays=4,
    ),
    "coarse": Known(
        "large pixels, each the mean of what it covers",
        {_RAYS: (NEEDED, "one ray shows the blurred image, not the mean of a sharp one")},
        sizes=(24,),
        rays=6,
    ),
    "sky": Known(
        "a textured sphere behind the scene",
        {f"{_SPACE}, without": (NEEDED, "the sphere is far outside of any box around the cameras")},
        behind="sky",
    ),
    "black": Known(
        "nothing behind the scene, and no alpha",
        {f"{_SPACE}, more": (NOT_NEEDED, "outside of the box there is nothing, and black is behind it")},
        behind="black",
    ),
    "fog": Known(
        "thin fog without a surface",
        {
            _VIEWS: (NOT_NEEDED, "no colour depends on the direction"),
            "samples a ray, less": (NOT_NEEDED, "density and colour hardly change within two steps"),
            "levels, less": (NOT_NEEDED, "nothing is smaller than the cells of the other levels"),
            "rows of the table, less": (NOT_NEEDED, "nothing is small, so that collisions agree"),
        },
        finish="fog",
        noise=0.05,
    ),
}


def write(known: Known, folder: pathlib.Path) -> pathlib.Path:
    """Writes a capture into a folder, which is returned; a finished one is kept."""
    if (folder / "transforms.json").exists():
        return folder
    (folder / "images").mkdir(parents=True, exist_ok=True)
    poses, rng = _poses(NUM_TRAIN + NUM_TEST), np.random.default_rng(0)
    gains = 2 ** (known.stops * _errors(rng, (1,)))
    stated = turned(poses, known.degrees * _errors(rng, (3,)))
    frames = []
    for index, (pose, gain) in enumerate(zip(poses, gains, strict=True)):
        size = known.sizes[index % len(known.sizes)]
        rgb, alpha = _image(known, pose, size)
        rgb = rgb * gain + known.noise * rng.normal(size=rgb.shape)
        pixels = np.concatenate([rgb, alpha[..., None]], axis=-1) if known.behind == "alpha" else rgb
        path = f"images/{index:03d}.png"
        Image.fromarray(np.uint8(np.rint(255 * np.clip(pixels, 0, 1)))).save(folder / path)
        matrix = [*stated[index].tolist(), [0.0, 0.0, 0.0, 1.0]]
        focal = dict.fromkeys(("fl_x", "fl_y"), _FOCAL * size) | dict.fromkeys(("cx", "cy"), size / 2)
        frames.append({"file_path": path, "w": size, "h": size, **focal, "transform_matrix": matrix})
    paths = [frame["file_path"] for frame in frames]
    content = {"camera_model": "PINHOLE", "frames": frames}
    content |= {"aabb_scale": 1} if known.has_box else {}  # of instant-ngp: from -1.5 to 1.5
    content |= {"train_filenames": paths[:NUM_TRAIN], "test_filenames": paths[NUM_TRAIN:]}
    write_text(folder / "transforms.json", json.dumps(content, indent=1) + "\n")
    return folder


def turned(poses: Float[np.ndarray, "V 3 4"], degrees: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3 4"]:
    """Returns poses that are turned about the axes of their cameras, whose positions stay."""
    result = np.array(poses, np.float64)
    for pose, (x, y, z) in zip(result, np.radians(degrees) / 2, strict=True):
        half = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        pose[:, :3] = pose[:, :3] @ np.linalg.solve(np.eye(3) - half, np.eye(3) + half)  # Cayley's rotation
    return result


def _errors(rng, shape):
    """Returns normal errors [V, *shape] of mean 0 and deviation 1 over the views in training; 0 in all others."""
    trained = np.setdiff1d(np.arange(NUM_TRAIN), held_out(NUM_TRAIN, HOLD_OUT))
    drawn = rng.normal(size=(len(trained), *shape))
    errors = np.zeros((NUM_TRAIN + NUM_TEST, *shape))
    errors[trained] = (drawn - drawn.mean(axis=0)) / drawn.std(axis=0)
    return errors


def _poses(count):
    """Returns poses [V, 3, 4] on a golden spiral, most of them from above; neighbours in the list are far apart."""
    steps = np.arange(count)
    height = -0.2 + 1.1 * np.mod(0.5 + 0.7548776662 * steps, 1)  # sine of the elevation
    angle, around = math.pi * (3 - math.sqrt(5)) * steps, np.sqrt(1 - height**2)
    eyes = _DISTANCE * np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=-1)
    up = np.float32([0, 0, 1])
    return np.stack([_look_at(np.float32(eye), np.zeros(3, np.float32), up) for eye in eyes])


def _image(known, pose, size):
    """Returns an image's colours [H, W, 3] in [0, 1], straight where there is alpha, and its alpha [H, W]."""
    fine = known.rays * size
    camera = Camera(
        to_world=pose[None],
        focal=np.full((1, 2), _FOCAL * fine, np.float32),
        center=np.full((1, 2), fine / 2, np.float32),
        height=fine,
        width=fine,
    )
    if known.finish == "fog":
        pixels = _fog(jax.tree.map(lambda leaf: leaf[0], camera))
    else:
        pixels = render.render_views(camera, known.finish)
    if known.tint:  # exact, as all samples of a ray have its direction
        tint = 1 - known.tint * (1 + render.scene_rays(camera).viewdirs)
        pixels = np.concatenate([np.uint16(np.rint(pixels[:, :3] * tint)), pixels[:, 3:]], axis=-1)
    if known.behind != "alpha":
        values = pixels / 65535
        behind = _sky(camera) if known.behind == "sky" else 0.0
        color = values[..., :3] * values[..., 3:] + (1 - values[..., 3:]) * behind
        pixels = np.uint16(np.rint(65535 * np.concatenate([color, np.ones_like(color[..., :1])], axis=-1)))
    pixels = pixels.reshape(fine, fine, 4)
    if known.rays > 1:
        pixels = average_tiles(pixels, known.rays, background=WHITE)
    return pixels[..., :3] / 65535, pixels[..., 3] / 65535


def _fog(camera):
    """Returns the exact pixels [H * W, 4] of the cloud."""
    exact = _exact_fog(rays_from_pixels(camera, pixel_grid(camera.height, camera.width).reshape(-1, 2), near=1, far=7))
    return to_straight(np.asarray(exact.rgb), np.asarray(exact.opacity), background=WHITE)


@jax.jit
def _exact_fog(rays):
    return analytic.blob(**_CLOUD, rgb_slope=_SLOPE).exact(rays)


def _sky(camera):
    """Returns the colours [H * W, 3] of the sphere along the rays of a camera [1] inside it."""
    rays = render.scene_rays(camera)
    along = (rays.origins * rays.viewdirs).sum(axis=-1, keepdims=True)
    way = -along + np.sqrt(along**2 - (rays.origins**2).sum(axis=-1, keepdims=True) + _SKY**2)
    x, y, z = ((rays.origins + way * rays.viewdirs) / _SKY).T
    waves = [np.sin(7 * x + 2 * z) * np.cos(5 * y), np.cos(6 * y - 3 * x), np.sin(9 * z + 2 * y)]
    return 0.5 + 0.4 * np.stack(waves, axis=-1)
