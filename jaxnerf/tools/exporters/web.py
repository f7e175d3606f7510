"""The export "web": a page that renders the trained scene in a browser (WebGL 2), without a server or a network.

web_page/ holds the page's parts. The scene is one binary: JSON, then the arrays of textures, compressed by gzip, whose
checksum finds a broken file. It is inside the page or, with --split, in a file beside it.
"""

import base64
import gzip
import importlib.resources
import json
import pathlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.metrics import psnr, round_to_8_bits
from jaxnerf.core.views import Views
from jaxnerf.data.geometry import path_poses
from jaxnerf.data.geometry.poses import gaze_center, look_one_way, up_of
from jaxnerf.evaluation.paths import camera_path
from jaxnerf.evaluation.restore import TrainedRun, refined_views
from jaxnerf.fields.hash_grid import HashGrid
from jaxnerf.runtime import stages
from jaxnerf.tools.exporters import web_scene
from jaxnerf.tools.exporters.base import ExportSource, can_be_scored
from jaxnerf.tools.exporters.web_scene import WebScene

MAGIC = b"JAXNERF1"
MAX_LOSS = 0.05  # dB that 8-bit features may cost; otherwise they have 16
_NUM_SCORED = 4  # test views
_MAX_CAMERAS, _TOUR_FRAMES = 100, 48
_SWING = 0.1, 0.6  # radians: range of the angle up to which a camera turns in a scene that is seen from one side
_DATA_FILE = "scene.bin"
_TYPES = {"uint8": "u8", "float16": "f16", "float32": "f32", "uint32": "u32"}


class Score(NamedTuple):
    """PSNR over the first test views, dB: of the run, and of what the textures hold; and how many views."""

    of_run: float
    of_page: float
    num_views: int


def export_web(source: ExportSource, folder: pathlib.Path) -> None:
    """Writes index.html, which holds the scene; with `split` the scene is in scene.bin beside it."""
    experiment = source.run.experiment
    split = experiment.config.eval.split
    views = None
    if can_be_scored(source):
        views = refined_views(source.run, experiment.load_split(split), split, source.variables[0])
    quality = measured = ""
    for precision in web_scene.PRECISIONS:
        with stages.stage(f"packing features of {precision}"):
            scene = scene_of(source.run, source.variables, precision)
        if views is None:
            break
        score = measure(source, scene, views)
        quality = f"PSNR {score.of_page:.1f} dB on {score.num_views} test views"
        measured = f"{score.of_page:.2f} dB on {score.num_views} test views, where the run has {score.of_run:.2f} dB"
        measured = f"PSNR {measured}; "
        if score.of_run - score.of_page <= MAX_LOSS:
            break
        source.say(f"features of {precision} would lose {score.of_run - score.of_page:.2f} dB")
    with stages.stage("compressing the scene"):
        data = encode(scene, about(source, scene, quality))
    (folder / "index.html").write_text(page(None if source.settings.split else data))
    if source.settings.split:
        (folder / _DATA_FILE).write_bytes(data)
    size = sum(path.stat().st_size for path in folder.iterdir())
    source.say(f"{measured}features of {scene.precision}; {size:,} bytes")
    if source.settings.split:
        source.say("put both files on a web server: a browser reads no file beside a page that is opened from a folder")


def network_of(run: TrainedRun) -> HashGrid:
    """Returns the run's hash grid.

    Raises:
        ValueError: if the shader cannot render the run: names the reason.
    """
    config, model = run.experiment.config, run.experiment.model
    field, reason = model.fields.get(model.image_networks[-1]), None
    if field is None or not isinstance(field.network, HashGrid):
        reason = f"field is {config.field!r}, expected a hash grid"
    elif model.grid_schedule is None:
        reason = f"sampler is {config.sampler!r}, expected one that trains with an occupancy grid"
    elif model.needs:
        reason = f"the field asks for {', '.join(model.needs)}, expected position and direction"
    if reason:
        raise ValueError(f"web: {reason}; export such a run as --kind=splats or --kind=mesh")
    return field.network


def scene_of(run: TrainedRun, variables: tuple, precision: str) -> WebScene:
    """Packs variables of a run, with the steps and the early termination of its evaluation; see `network_of`."""
    experiment, (params, grid) = run.experiment, variables
    view = experiment.config.eval
    return web_scene.pack(
        network_of(run),
        params[experiment.model.image_networks[-1]],
        grid,
        precision=precision,
        step_size=experiment.model.grid_schedule.step_size / view.sample_multiplier,
        early_stop_eps=view.early_stop_eps,
        background=experiment.background,
        ndc=experiment.config.data.ndc,
    )


def measure(source: ExportSource, scene: WebScene, views: Views) -> Score:
    """Scores the run, and the run with the features that the textures hold."""
    params, grid = source.variables
    name = source.run.experiment.model.image_networks[-1]
    decoded = {**params, name: scene.decoded(params[name])}
    squares = []
    count = min(_NUM_SCORED, len(views.size))
    for index in range(count):
        pixels = pixel_grid(*(int(side) for side in views.size[index]))
        rays = source.run.experiment.view_rays(views, index, pixels)
        images = [source.run.render_image((each, grid), rays).rgb for each in (params, decoded)]
        truth = views.image(index)
        squares.append([float(psnr(round_to_8_bits(jnp.clip(image, 0, 1)), truth)) for image in images])
    return Score(*np.mean(squares, axis=0).tolist(), count)


def about(source: ExportSource, scene: WebScene, quality: str) -> dict[str, Any]:
    """Returns what the page says and where its cameras are; poses are in the run's world.

    Args:
        source: with the step and the training views.
        scene: that the page renders.
        quality: what is known of it, for people; "": nothing.
    """
    views, config = source.views, source.run.experiment.config
    poses = np.asarray(views.cameras.to_world, np.float64)
    name = pathlib.PurePath(config.data.dir).name or "embedded scene"
    names = views.names or tuple(f"view {index}" for index in range(len(poses)))
    some = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), _MAX_CAMERAS)).round().astype(int))
    up = camera_path.up_direction(config.data.up or None, views)
    tour = _tour(views, poses, config.data.up or None)
    target, swing = gaze_center(poses), None
    if look_one_way(poses):
        pose, radii, focus = path_poses.forward_frame(poses)
        target, swing = pose[:, 3] - focus * pose[:, 2], float(np.clip(2 * np.arctan(radii[:2].max() / focus), *_SWING))
    how = [f"trained for {source.step:,} steps on {len(poses)} images", quality, "made with jaxnerf"]
    return {
        "name": name,
        "step": source.step,
        "how": "; ".join(filter(None, how)),
        "cameras": [_camera(views, index, names[index]) for index in some],
        "tour": [_numbers(pose) for pose in tour],
        "target": _numbers(target),
        "swing": swing,
        "up": _numbers(up_of(poses) if up is None else up),
        "ndc_scale": _numbers(2 * np.asarray(views.cameras.focal)[0] / np.asarray(views.size)[0, ::-1]),
        "near": float(np.min(views.near)),
        "far": float(min(np.max(views.far), 1e9)),
        "operations": web_scene.operations_per_sample(scene),
    }


def _tour(views, poses, up):
    """Returns the poses of the path that `jaxnerf-render` selects; the first camera's where cameras define none."""
    try:
        kind, _ = path_poses.default_kind(poses, camera_path.up_direction(up, views))
        return camera_path.make_path(kind, views, num_frames=_TOUR_FRAMES, up=up).poses
    except ValueError:
        return poses[:1]


def _camera(views, index, name):
    height, width = (int(side) for side in views.size[index])
    camera = jax.tree.map(lambda leaf: np.asarray(leaf)[index], views.cameras)
    bounds = {"near": float(views.near[index]), "far": float(min(views.far[index], 1e9))}
    lens = {"focal": _numbers(camera.focal), "center": _numbers(camera.center)}
    return {"name": name, "pose": _numbers(camera.to_world), "width": width, "height": height, **lens, **bounds}


def _numbers(values):
    return [float(f"{value:.9g}") for value in np.asarray(values, np.float64).reshape(-1)]


def encode(scene: WebScene, description: dict[str, Any], *, level: int = 9) -> bytes:
    """Returns the bytes that the page reads: MAGIC, the length of the JSON (uint32), the JSON, the arrays; gzipped.

    Args:
        scene: WebScene.
        description: see `about`.
        level: of the compression, 0 (none) to 9 (small).
    """
    arrays, parts, place = [], [], 0
    for name, array in web_scene.textures(scene).items():
        kind = _TYPES[array.dtype.name]
        arrays.append({"name": name, "type": kind, "width": array.shape[1], "height": array.shape[0], "start": place})
        parts.append(array.astype(array.dtype.newbyteorder("<")).tobytes())
        place += len(parts[-1])
    content = {**description, "shader": web_scene.shader(scene), "arrays": arrays, "bytes": place}
    text = json.dumps(content).encode()
    text += b" " * (-(len(text) + 12) % 4)  # arrays begin at a multiple of 4 bytes
    return gzip.compress(MAGIC + np.uint32(len(text)).tobytes() + text + b"".join(parts), level, mtime=0)


def page(data: bytes | None, *, live: bool = False) -> str:
    """Returns the page.

    Args:
        data: the scene; None: the page reads scene.bin beside it.
        live: whether the scene is that of a viewer: the page asks for newer ones, and leaves for the viewer's frames
            where the browser cannot render.
    """
    files = importlib.resources.files("jaxnerf.tools.exporters") / "web_page"
    text = (files / "index.html").read_text()
    content = _DATA_FILE if data is None else base64.b64encode(data).decode()
    parts = {"style": (files / "style.css").read_text()}
    parts |= {name: (files / f"{name}.js").read_text() for name in ("renderer", "camera", "page")}
    parts |= {"kind": "live" if live else "file" if data is None else "embedded", "data": content}
    for name, value in parts.items():
        text = text.replace(f"@@{name}@@", value)
    return text
