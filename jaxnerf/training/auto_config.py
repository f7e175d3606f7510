"""Resolves a config against a dataset: every "auto" becomes a value, and a line gives the reason."""

import copy
import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from ml_collections import ConfigDict

from jaxnerf.core.types import Views
from jaxnerf.data import dataset
from jaxnerf.data.geometry import poses, visual_hull, world
from jaxnerf.data.observations import num_shared
from jaxnerf.data.ray_batches import view_rays
from jaxnerf.runtime import devices, processes
from jaxnerf.runtime.config_fields import UNLIMITED_STEPS, is_auto
from jaxnerf.training.build import build_model
from jaxnerf.training.config_ranges import check_ranges
from jaxnerf.training.dead_networks import CHECK_EVERY

_CELL_PER_PIXEL = 0.7  # cells a little finer than a pixel's footprint, the finest detail that images resolve
_FINEST = (32, 256)  # vertices along the longest side, minimum and maximum, of the last of four levels
# Levels of the hash grid. Contracted space, whose box is larger, gets one more, and so do fine occupancy grids (below)
# and images of at least _FIVE_LEVELS_SIDE px a side.
_LEVELS, _FIVE_LEVELS_SIDE = 4, 600
# Rows of a hash grid's level per pixel of an image's side; finer images show what collisions of the hash cost.
_ROWS_PER_PIXEL, _MIN_ROWS, _MAX_ROWS = 1311, 2**17, 2**20
_LARGE_TABLE = 2**19  # rows of a level, from which on an update of the table takes as long as half of the step's rays
_SAMPLE_MULTIPLIER = 1.5  # samples of images over those of training: no jitter averages over a step in rendering
_MAX_STEPS_PER_SIDE = 144  # along the longest side: finer images need finer features rather than finer steps
# But a step is at most as long as a cell, since training skips the cells that no middle of a step is in. With more than
# _MAX_RESOLUTION cells it is a little shorter, which gains 0.1 dB at 400 px.
_FINE_STEPS_PER_CELL = 1.125
_TRAIN_STEPS_PER_ROOT_PIXEL = 1000  # training steps are proportional to the root of an image's side in pixels
# Space is not contracted as far as the cameras, so that cells near them are small: large ones fill with fog. But the
# cube is at most this many times as large as that which most images show: what they look at gets fewer cells then.
_MAX_INNER_BOX = 3.0
# Times twice the side of the cube that most images show; a stated box that is larger is no better than contraction.
_MAX_STATED_BOX = 3.0
_MIN_OBSERVATIONS = 100  # of sparse points, for a depth loss
_DEPTH_WEIGHT = ((0, 0.1), (1000, 0.0))  # of the depth loss: between points the depth is a guess, so it ends
_NEAR = 0.02  # times the cameras' distance from what they look at; hardly anything in focus is closer
_MAX_RESOLUTION = 128  # cells: updating more of them costs more than the samples that they save
# A fine grid has a cell for two of the vertices that detail needs, if that makes more than _MAX_RESOLUTION cells and
# alpha empties most of them.
_FINE_RESOLUTION, _MAX_ALPHA = 256, 0.5
_MAX_OPEN_RESOLUTION = 96  # where no alpha empties most cells before training, so that all of them are updated

# These depend on the device, so they are inferred at every start and stay "auto" in the workdir.
DEVICE_FIELDS = (
    "hash_grid.compute_dtype",
    "occupancy.update_chunk",
    "train.microbatch_size",
    "train.steps_per_dispatch",
    "eval.chunk",
    "eval.max_samples",
)

_ADDED = {"data.background_color": ()}  # fields that workdirs of older versions lack, and what these versions did


class Resolved(NamedTuple):
    """A resolved config.

    Attributes:
        config: without "auto", except in DEVICE_FIELDS.
        views: of the split "train", which it was resolved against.
        lines: one per inferred value that the run uses, with its reason.
    """

    config: ConfigDict
    views: Views
    lines: list[str]


def resolve(config: ConfigDict, views: Views | None = None, *, platform: str | None = None) -> Resolved:
    """Resolves a config against its dataset; explicit values are never changed.

    Only DEVICE_FIELDS may stay "auto"; see `resolve_for_device`. Sections that a run does not use are
    resolved, too: evaluation may use them later, as `eval.bake_occupancy` does.

    Args:
        config: see configs/default.py; it is not changed.
        views: of the split "train" where they have been read.
        platform: see `resolve_for_device`. It determines the number of rays and samples per step, and the sizes of
            the hash grid.

    Raises:
        ValueError: names the field or file, what was found and what is expected.
    """
    check_ranges(config)
    config, platform = copy.deepcopy(config), platform or jax.default_backend()
    config.data, lines = dataset.resolve(config.data)
    views = dataset.load_split(config.data, "train") if views is None else views
    lines = lines + _resolve_sizes(config, views, devices.profile_of(platform))
    _resolve_background(config, views, lines)
    _resolve_schedule(config, views, lines, platform)
    views = _resolve_near(config, views, lines)
    left = [name for name in auto_fields(config) if name not in DEVICE_FIELDS]
    if left:
        raise ValueError(f"{left[0]} is 'auto', which is not inferred for this field; set a value")
    return Resolved(config, views, lines)


def resolve_for_device(config: ConfigDict, platform: str | None = None) -> tuple[ConfigDict, list[str]]:
    """Resolves DEVICE_FIELDS of an otherwise resolved config for the devices of this process.

    Args:
        config: see configs/default.py; it is not changed.
        platform: of the devices to resolve for in place of those of this process: "cpu", "gpu" or "tpu".

    Returns:
        A copy of the config, and one line per inferred value.

    Raises:
        ValueError: on a value that no run can have, see `check_ranges`; config.json may have been edited.
    """
    check_ranges(config)
    config, lines = copy.deepcopy(config), []
    infer = _inferring(lines)
    profile = devices.profile_of(platform or jax.default_backend())
    rays, samples = profile.chunk.get(config.sampler, min(profile.chunk.values())), profile.max_samples
    infer(config.eval, "max_samples", samples, f"images        {samples} samples per batch, for this device")
    infer(config.eval, "chunk", rays, f"images        {rays} rays per chunk, for this device")
    line = f"precision     {profile.compute_dtype} in the layers of the hash grid's networks, for this device"
    infer(config.hash_grid, "compute_dtype", profile.compute_dtype, line, used=config.field == "hash_grid")
    cells = profile.update_chunk
    line = f"grid          {cells} cells evaluated at once in an update, for this device"
    infer(config.occupancy, "update_chunk", cells, line, used=config.sampler == "occupancy")
    if is_auto(config.train.microbatch_size):
        if is_auto(config.train.batch_size):
            raise ValueError("train.batch_size is 'auto'; resolve the config against a dataset, or set a number")
        used = devices.devices_of(config.train.parallel)
        device_rays = config.train.batch_size // len(used)
        size = devices.default_microbatch(
            device_rays, build_model(config).samples_per_ray, platform or used[0].platform
        )
        infer(config.train, "microbatch_size", size, f"microbatch    {size} rays, for this device")
    whole = math.gcd(*host_intervals(config.train))
    steps = max(count for count in range(1, profile.steps_per_dispatch + 1) if whole % count == 0)
    infer(config.train, "steps_per_dispatch", steps, f"dispatch      {steps} training steps at a time, for this device")
    return config, lines


def host_intervals(train: Any) -> tuple[int, ...]:
    """Returns the numbers of steps at whose multiples training logs, saves or decides on the host.

    Args:
        train: the config's section.
    """
    intervals = (train.log_every, train.save_every)
    if train.max_reinits:
        intervals += (CHECK_EVERY,)
    return intervals + ((processes.AGREE_EVERY,) if jax.process_count() > 1 else ())


def fill_from(config: ConfigDict, resolved: ConfigDict) -> ConfigDict:
    """Returns a copy of a config whose "auto" fields have the values of a resolved one.

    Raises:
        ValueError: if the resolved one lacks such a field, except for DEVICE_FIELDS, which stay "auto".
    """
    config = copy.deepcopy(config)
    for name in auto_fields(config):
        *sections, field = name.split(".")
        ours, theirs = config, resolved
        for section in sections:
            ours, theirs = ours[section], theirs.get(section, {})
        if field not in theirs and name in DEVICE_FIELDS:  # of an older version, which lacks some
            continue
        if field not in theirs and name in _ADDED:
            ours[field] = _ADDED[name]
            continue
        if field not in theirs:
            raise ValueError(f"{name} is 'auto', and the config of the workdir has no such field; set a value")
        ours[field] = theirs[field]
    return config


def auto_fields(config: ConfigDict) -> list[str]:
    """Returns the dotted names of the fields that are "auto"; train.parallel = "auto" is a value of its own."""

    def names(section, prefix):
        for key, value in section.items():
            if isinstance(value, dict):
                yield from names(value, f"{prefix}{key}.")
            elif is_auto(value):
                yield prefix + key

    return [name for name in names(config.to_dict(), "") if name != "train.parallel"]


def _inferring(lines: list[str]) -> Callable[..., None]:
    """Returns the function that fills in a field if it is "auto", and adds a line if the run uses the field."""

    def infer(section: Any, name: str, value: Any, line: str, *, used: bool = True) -> None:
        if name in section and is_auto(section[name]):  # configs of older versions lack some fields
            section[name] = value
            if used:
                lines.append(line)

    return infer


def _resolve_background(config: ConfigDict, views: Views, lines: list[str]) -> None:
    """Fills the colour behind the scene into a config.

    Distant walls and sky have little texture, so training leaves them partly transparent. With black behind them they
    are too dark, and bright fog in front of single cameras takes their place.
    """
    data = config.data
    color = data.get("background_color", ())  # configs of older versions lack it
    if is_auto(color):
        data.background_color = ()
        if data.background == "none" and config.sampler == "occupancy" and config.occupancy.contracted:
            data.background_color = tuple(round(value, 3) for value in dataset.mean_color(views))
            lines.append(f"behind        {data.background_color}, the mean colour of the training images")
    elif len(color) and data.background != "none":
        raise ValueError(
            f"data.background_color is {tuple(color)} and data.background {data.background!r}, which is behind the "
            "scene, too; set data.background to 'none', or data.background_color to ()"
        )


def _resolve_sizes(config: ConfigDict, views: Views, profile: devices.DeviceProfile) -> list[str]:
    """Fills the sizes of grids and networks into a config; returns lines."""
    lines: list[str] = []
    infer = _inferring(lines)
    section, ndc = config.occupancy, config.data.ndc
    paper = config.sampler == "hierarchical" and config.field == "mlp"  # has no box
    use_box = {"used": not paper or config.eval.bake_occupancy}
    # Alpha bounds the box of a field that is defined in it. A box only for rendering holds all that cameras see.
    use_alpha = not paper and section.use_alpha and views.pixels.shape[-1] == 4 and not ndc
    if is_auto(section.contracted):
        contracted, why = _contracted(config, views, use_alpha)
        infer(section, "contracted", contracted, f"contraction   {'on' if contracted else 'off'}: {why}", **use_box)
    footprint = 2 / float(np.max(views.size[:, 1])) if ndc else _LookAt(views).footprint
    if is_auto(section.lower) or is_auto(section.upper):
        lower, upper, why = _box(views, use_alpha, ndc=ndc, contracted=section.contracted)
        digits = 4 - math.floor(math.log10(max(upper - lower)))
        for name, bound in (("lower", lower), ("upper", upper)):
            infer(section, name, tuple(round(float(x), digits) for x in bound), "", used=False)
        if use_box["used"]:
            lines.append(f"box           {_point(section.lower)} to {_point(section.upper)}, {why}")
    longest = max(high - low for low, high in zip(section.lower, section.upper, strict=True))
    if not longest > 0:
        raise ValueError(
            f"occupancy.lower is {section.lower} and occupancy.upper {section.upper}, expected lower < upper"
        )
    side, detail = _side(views), round(longest / (_CELL_PER_PIXEL * footprint))
    fine = use_alpha and not section.contracted and config.sampler == "occupancy" and detail > 2 * _MAX_RESOLUTION
    fine = fine and dataset.sample_pixels(views)[:, 3].mean() < _MAX_ALPHA
    # Half of a contracted box holds the surroundings.
    more = int(section.contracted or fine or side >= _FIVE_LEVELS_SIDE)
    vertices = int(np.clip(detail, _FINEST[0], _FINEST[1] << more))
    finest = min(vertices, _FINEST[1])
    line = f"images        {_SAMPLE_MULTIPLIER:g} times the samples of training"
    infer(config.eval, "sample_multiplier", _SAMPLE_MULTIPLIER, line)
    open_box = not (use_alpha or section.contracted or ndc)
    most = _MAX_OPEN_RESOLUTION if open_box else _MAX_RESOLUTION
    resolution = min(detail // 2, _FINE_RESOLUTION) if fine else min(finest, most)
    infer(section, "resolution", resolution, f"grid          {resolution} cells along the longest side", **use_box)
    per_cell = _FINE_STEPS_PER_CELL if section.resolution > _MAX_RESOLUTION else 1
    step_size = longest / max(min(finest, _MAX_STEPS_PER_SIDE), per_cell * section.resolution)
    line = f"step size     {step_size:.4g}; a pixel covers {footprint:.4g} world units"
    infer(section, "step_size", step_size, line, **use_box)
    octaves = int(np.clip(round(1 + math.log2(2 * math.pi / (4 * footprint))), 1, 16))
    for name, used in (("coarse", config.sampler == "hierarchical"), ("fine", config.field == "mlp")):
        line = f"octaves       {octaves} in {name}; the shortest wave is four pixels long"
        infer(config[name], "num_freqs", octaves, line, used=used)
    levels = tuple(max(vertices // 2**level, 2) for level in reversed(range(_LEVELS + more)))
    line = f"hash grid     {levels} vertices along the longest side"
    infer(config.hash_grid, "resolutions", levels, line, used=config.field == "hash_grid")
    rows = profile.table_scale * 2 ** round(math.log2(np.clip(_ROWS_PER_PIXEL * side, _MIN_ROWS, _MAX_ROWS)))
    line = f"hash grid     at most {rows:,} rows per level, for images of about {side:.0f} x {side:.0f} px"
    infer(config.hash_grid, "table_size", rows, line, used=config.field == "hash_grid")
    for name, network in (("width", "density"), ("view_width", "colour")):
        line = f"hash grid     {profile.layer_width} outputs per hidden layer of the {network} network, for this device"
        infer(config.hash_grid, name, profile.layer_width, line, used=config.field == "hash_grid")
    if "cameras" in config:  # older versions had no such section
        infer(config.cameras, "num_images", len(views.size), "", used=False)
    return lines


def _side(views):
    """Returns the mean side of square images with as many pixels, px."""
    return float(np.sqrt(np.prod(views.size, axis=1)).mean())


def _resolve_schedule(config: ConfigDict, views: Views, lines: list[str], platform: str) -> None:
    """Fills the numbers of rays and samples per step and of steps into a config.

    A run is planned as a number of rays: steps of fewer rays than would be inferred are more steps. An accelerator
    takes more rays in the same number of steps.
    """
    infer, train, side = _inferring(lines), config.train, _side(views)
    rays, why = config.train.get("cpu_batch_size"), "train.cpu_batch_size"
    large = config.field == "hash_grid" and config.hash_grid.table_size >= _LARGE_TABLE
    if config.sampler == "occupancy" and large:
        rays, why = 2 * rays, "twice train.cpu_batch_size, as the hash grid's table is large"
    section, samples = config.occupancy, devices.profile_of(platform).samples_per_step
    slots = section.pool_samples_per_ray
    slots = section.cpu_pool_samples_per_ray if is_auto(slots) else slots
    if samples is not None and config.sampler == "occupancy":
        rays, why = 2 ** max(math.floor(math.log2(samples / slots)), 0), "they keep this device busy"
    infer(train, "batch_size", rays, f"batch         {rays:,} rays per step: {why}")
    if samples is not None:
        slots = float(np.clip(samples / train.batch_size, slots, 2 * slots))
    line = f"batch         at most {slots:g} samples per ray on average"
    infer(section, "pool_samples_per_ray", slots, line, used=config.sampler == "occupancy")
    planned = max(round(_TRAIN_STEPS_PER_ROOT_PIXEL * side**0.5 * rays / train.batch_size), 1)
    steps, why = planned, f"{planned:,} steps of {train.batch_size:,} rays, for images of {side:.0f} x {side:.0f} px"
    if train.get("max_seconds"):
        steps, why = UNLIMITED_STEPS, f"ends after train.max_seconds = {train.max_seconds:g}"
    infer(train, "max_steps", steps, f"training      {why}")
    decay_steps, end = train.max_steps, f"step {train.max_steps:,}"
    if train.max_steps >= UNLIMITED_STEPS and jax.process_count() == 1:
        end = "the end"
    elif train.max_steps >= UNLIMITED_STEPS:  # several processes have no common clock
        decay_steps, end = planned, f"step {planned:,}"
    infer(train, "lr_steps", decay_steps, f"training      learning rate decays until {end}")


def _resolve_near(config: ConfigDict, views: Views, lines: list[str]) -> Views:
    """Fills what concerns the space in front of the cameras into a config; returns the views with their near.

    In unbounded captures each image's own near follows from what it shows. No ray would then train the space between
    a camera and its near, so that another camera could see fog there.
    """
    infer, section = _inferring(lines), config.occupancy
    everywhere = config.sampler == "occupancy" and section.contracted
    line = "valid cells   those that a training view sees"
    infer(section, "min_views", 1 if everywhere else 0, line, used=everywhere)
    count = num_shared(views) if everywhere else 0
    observed = count >= _MIN_OBSERVATIONS
    line = f"depth         {count:,} observations of sparse points guide the start of training"
    infer(config.losses, "depth", _DEPTH_WEIGHT if observed else 0.0, line, used=observed)
    if not is_auto(config.data.near):
        return views
    if not everywhere:
        config.data.near = 0.0
        return views
    unit = 1.0 if views.to_file is None else world.unit_of(views.to_file)
    distance = float(np.median(_LookAt(views).distance))
    config.data.near = float(f"{_NEAR * distance * unit:.4g}")
    near = np.float32(config.data.near / unit)
    lines.append(f"near          {near:.3g} for all images, so that the space in front of each camera is trained")
    return dataclasses.replace(views, near=np.full_like(views.near, near))


class _LookAt:
    """What the cameras look at.

    Attributes:
        center: [3] world units, the point nearest to the cameras' axes. If the axes are parallel, all
            cameras are at one point, or there is one view, no such point lies in front of the cameras; the
            center is then the mean of the middles of the views' depth ranges.
        distance: [V] from the cameras to the center.
        reach: half the side of the cube around the center that holds nine in ten cameras.
        half_size: [V, 2] half the width and height of the images at that distance.
        footprint: the size of a pixel at that distance, the median over views.
    """

    def __init__(self, views):
        to_world = np.asarray(views.cameras.to_world, np.float64)
        eyes, axes = to_world[:, :, 3], to_world[:, :, 2]
        near, far = np.asarray(views.near, np.float64), np.asarray(views.far, np.float64)
        middle = np.where(np.isfinite(far), near + far, 3 * np.where(near > 0, near, 1)) / 2
        self.center = poses.gaze_center(to_world)
        self.distance = np.linalg.norm(eyes - self.center, axis=-1)
        spread = np.linalg.eigvalsh(np.eye(3) - axes.T @ axes / len(axes))[0]
        if spread < 1e-6 or np.median(self.distance) < 1e-3 * np.median(np.where(near > 0, near, middle)):
            self.center = (eyes - middle[:, None] * axes).mean(axis=0)
            self.distance = middle
        self.reach = float(np.quantile(np.abs(eyes - self.center).max(axis=-1), 0.9))
        focal = np.asarray(views.cameras.focal, np.float64)
        self.half_size = self.distance[:, None] * np.asarray(views.size)[:, ::-1] / 2 / focal
        self.footprint = float(np.median(self.distance / focal[:, 0]))

    @property
    def inner_half_side(self):
        """Half the side of the cube that most images show completely."""
        return float(np.median(self.half_size.min(axis=1)))


def _contracted(config, views, use_alpha):
    """Returns whether the box holds all of space, and why."""
    if config.data.ndc:
        return False, "normalised device coordinates hold everything in view"
    if config.data.world != "around":
        return False, f"the world is {config.data.world!r}"
    if views.box is not None:
        side = float(np.max(np.asarray(views.box[1]) - np.asarray(views.box[0])))
        if side <= _MAX_STATED_BOX * 4 * _LookAt(views).inner_half_side:
            return False, "the dataset states the scene's bounds"
    if use_alpha:
        return False, "alpha bounds the object"
    return True, "nothing bounds the surroundings"


def _box(views, use_alpha, *, ndc, contracted):
    """Returns lower [3], upper [3], and how they were found."""
    if ndc:
        return *_ends_of_rays(views), "the bounds of all rays"
    if views.box is not None and not contracted:
        return *np.asarray(views.box, np.float64), "as the dataset states"
    look_at = _LookAt(views)
    if contracted:
        seen = look_at.inner_half_side
        half, why = max((seen, "as far as most images show"), (look_at.reach, "where the cameras are"))
        if half > _MAX_INNER_BOX * seen:
            half, why = _MAX_INNER_BOX * seen, f"{_MAX_INNER_BOX:g} times as far as most images show"
        why = f"not contracted within {half:.2g} of its centre, {why}"
        return look_at.center - 2 * half, look_at.center + 2 * half, why
    half = look_at.half_size.max()
    lower, upper = look_at.center - half, look_at.center + half
    if not use_alpha:
        return lower, upper, "as large as the images at the point that all cameras look at"
    return *visual_hull.hull_bounds(views, lower, upper), "the bounds of the visual hull"


def _ends_of_rays(views):
    """Returns lower [3] and upper [3] of all rays: NDC rays are straight, so the corners' rays bound all."""
    ends = []
    for index, (height, width) in enumerate(np.asarray(views.size)):
        corners = np.float32([[0, 0], [width, 0], [0, height], [width, height]])
        rays = view_rays(views, index, corners, ndc=True)
        for t in (rays.near, rays.far):
            ends.append(np.asarray(rays.origins + t[:, None] * rays.directions))
    ends = np.concatenate(ends)
    return ends.min(axis=0), ends.max(axis=0)


def _point(point):
    return "(" + ", ".join(f"{value:.2f}" for value in point) + ")"
