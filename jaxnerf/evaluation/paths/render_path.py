"""Pictures of a trained scene along a camera path, resumed where they stopped, and a video of them."""

import functools
import hashlib
import pathlib
import sys

import imageio.v3 as iio
import jax
import numpy as np

from jaxnerf.data import dataset
from jaxnerf.evaluation import pictures
from jaxnerf.evaluation.paths import camera_path, video
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.runtime import shards
from jaxnerf.training.metric_log import Progress


def render_path(
    folder,
    *,
    path=None,
    step=None,
    data_dir=None,
    settings=None,
    size=(None, None),
    num_frames=None,
    closed=False,
    fps=None,
    chunk=None,
    name=None,
    rgba=False,
    depth=False,
    kind="auto",
    overwrite=False,
    shard=shards.WHOLE,
):
    """Renders a camera path to <workdir>/renders/<path>-<step>/ and a video beside that folder.

    The folder holds color/0000.png; depth/0000.tiff, float32, the distance along the view direction in world
    units of the capture's file, where what passes through counts at the far end of the ray (in NDC that is
    infinity, so a ray that meets nothing has inf); depth/0000.png, a picture of it, with one range for the
    whole path; and path.json, what they were rendered with. A frame that is there is not rendered again.

    Args:
        folder: the workdir.
        path: see paths.make_path; when None paths.suited_kind chooses, and says so.
        step: of the checkpoint; the newest when None.
        data_dir: the scene's folder in place of the configuration's.
        settings: see open_run.
        size: (width, height) px, see paths.resize.
        num_frames, closed: see paths.make_path.
        fps: frames a second; the path file's, or 24, when None.
        chunk: rays at once; the configuration's eval.chunk when None; 0: see image_renderer.
        name: in place of the path's in the names of what is written.
        rgba: whether rgba/0000.png is written too: straight alpha, without the background.
        depth: whether there is a video of the depth too.
        kind: of video, see video.video_suffix.
        overwrite: whether frames of that name are deleted first.
        shard: (index, count): only every count-th frame from that index on. The call after which no frame is
            missing, of whatever shard, makes the pictures of depth and the videos.

    Returns:
        The paths written: the folder and the videos.

    Raises:
        ValueError: if there is no such run, checkpoint or path, or frames of that name differ from it.
    """
    suffix = video.video_suffix(kind)
    if name and (pathlib.Path(name).name != name or name.startswith(".")):
        raise ValueError(f"name is {name!r}, wanted a plain file name; leave out folders and a dot in front")
    run = restore_run(folder, data_dir=data_dir, settings=settings)
    step = newest_step(run, folder, step)
    views = run.experiment.load_split("train")
    path = camera_path.make_path(path or _said(views), views, num_frames=num_frames, closed=closed)
    path = camera_path.resize(path, *size)
    target = pathlib.Path(folder) / "renders" / f"{name or path.name}-{step}"
    shards.refuse_overwrite(overwrite, shard, target)
    shards.claim_folder(target, _origin(run, step, views, path, closed), overwrite=overwrite)
    missing = write_frames(target, run, step, views, path, chunk=chunk, rgba=rgba, shard=shard)
    written = [target]
    if missing:
        print(f"shard {shard[0]}/{shard[1]} is done, {missing} frames of others are missing", file=sys.stderr)
        return written
    for folder, end in (("color", ""), ("depth", "-depth")) if depth else (("color", ""),):
        if suffix:
            written.append(target.with_name(f"{target.name}{end}{suffix}"))
            files = [target / folder / f"{index:04d}.png" for index in range(len(path.poses))]
            video.write_video(written[-1], files, fps or path.fps or 24.0)
    return written


def write_frames(target, run, step, views, path, *, chunk=None, rgba=False, shard=shards.WHOLE):
    """Renders those frames of a CameraPath that are a shard's and not in a folder yet; see render_path.

    Returns:
        How many frames of other shards are missing still; 0 when all that render_path says is there.
    """
    kinds = ("depth/{:04d}.tiff", "color/{:04d}.png", *(("rgba/{:04d}.png",) if rgba else ()))
    files = [[target / kind.format(index) for kind in kinds] for index in range(len(path.poses))]

    def missing():
        return [index for index, group in enumerate(files) if not all(file.is_file() for file in group)]

    frames = shards.own(range(len(files)), shard)
    todo = shards.own(missing(), shard)
    if todo:
        render = functools.partial(run.render_image, run.variables(step))
        posed, progress = camera_path.posed_views(views, path), Progress(len(frames))
        for done, index in enumerate(todo, len(frames) - len(todo) + 1):
            pixels = camera_path.path_pixels(posed, path, index, offset=run.experiment.pixel_offset)
            rays = run.experiment.view_rays(posed, index, pixels)
            image = render(rays, chunk=chunk)
            distance = run.experiment.world_depth(posed, index, pixels, image.depth)
            planes = [np.asarray(distance, np.float32), pictures.to_8_bits(image.rgb)]
            if rgba:
                planes.append(pictures.cut_out(image.rgb, image.opacity, _background(run)))
            for file, plane in zip(files[index], planes, strict=True):
                pictures.write_whole(file, plane)
            progress.show(done, f"frames of {target}")
        progress.close()
    if not missing():
        _write_depth_pictures([group[0] for group in files])
        shards.sweep(target)
    return len(missing())


def _said(views):
    kind = camera_path.default_kind(views)
    seen = "one way" if kind == "spiral" else "from all around"
    print(f"path: {kind}, as the cameras look {seen}; --path takes another", file=sys.stderr)
    return kind


def _origin(run, step, views, path, closed):
    """Returns all that the frames depend on, for path.json."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves((views.cameras, views.near, views.far, views.to_file)):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    digest.update("/".join(views.names).encode())
    origin = {"path": path.source, "frames": len(path.poses), "width": path.width, "height": path.height}
    if path.source == "interpolate":
        origin["closed"] = closed
    settings = {
        name: vars(run.experiment.eval).get(name) for name in ("sample_multiplier", "early_stop_eps", "bake_occupancy")
    }
    return {**origin, "step": step, **settings, "cameras": digest.hexdigest()}


def _background(run):
    return dataset.BACKGROUNDS[run.experiment.conventions["background"]]


def _write_depth_pictures(files):
    near, far = pictures.depth_range(iio.imread(file) for file in files)
    for file in files:
        pictures.write_whole(file.with_suffix(".png"), pictures.depth_picture(iio.imread(file), near, far))
