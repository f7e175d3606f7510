"""Resolves a config against a dataset: every "auto" becomes a value, with a line that gives its reason."""

import copy
import math
from typing import Any, NamedTuple

import jax
import numpy as np
from ml_collections import ConfigDict

from jaxnerf.core.types import Views
from jaxnerf.data import dataset
from jaxnerf.data.geometry import poses, visual_hull
from jaxnerf.data.ray_batches import view_rays
from jaxnerf.runtime import devices
from jaxnerf.runtime.config_fields import AUTO, is_auto
from jaxnerf.training.build import build_model

_SPACING = 0.7  # of a pixel's footprint: the finest detail that images resolve, and a little finer
_FINEST = (32, 256)  # vertices along the longest side, at least and at most
_MOST_STEPS = 144  # along the longest side: finer images need finer features sooner than finer steps
_STEPS_PER_ROOT_PIXEL = 1000  # training steps: finer images need more, though not as many more
_WIDEST_BOX = 3.0  # times all of contracted space: a box that is wider is no better than that
_LARGEST_GRID = 128  # cells: beyond, updating them costs more than the samples that they save

# These depend on the device, so they are inferred at every start and stay "auto" in the workdir.
DEVICE_FIELDS = ("train.microbatch_size", "eval.chunk", "eval.max_samples")


class Resolved(NamedTuple):
    """A config without "auto", the views that it was resolved against, and what was inferred."""

    config: ConfigDict
    views: Views  # of the split "train"
    lines: list[str]  # one per inferred value, with its reason


def resolve(config: ConfigDict, views: Views | None = None) -> Resolved:
    """Resolves a config against its dataset; explicit values are never changed.

    Only DEVICE_FIELDS may stay "auto"; see `resolve_for_device`. Sections that a run does not use are
    resolved, too: evaluation may use them later, as `eval.bake_occupancy` does.

    Args:
        config: see configs/default.py; it is not changed.
        views: of the split "train" where they have been read.

    Raises:
        ValueError: names the field or file, what was found and what is expected.
    """
    config = copy.deepcopy(config)
    config.data, lines = dataset.resolve(config.data)
    views = dataset.load_split(config.data, "train") if views is None else views
    lines = lines + _resolve_sizes(config, views)
    left = [name for name in auto_fields(config) if name not in DEVICE_FIELDS]
    if left:
        raise ValueError(f"{left[0]} is 'auto', which nothing infers; set a value")
    return Resolved(config, views, lines)


def resolve_for_device(config: ConfigDict) -> tuple[ConfigDict, list[str]]:
    """Resolves the fields that depend on the device that runs this process, of an otherwise resolved config."""
    config, lines = copy.deepcopy(config), []
    cpu = jax.default_backend() == "cpu"
    if is_auto(config.eval.max_samples):
        # On a CPU activations stay in the cache; an accelerator is slow with little to do.
        config.eval.max_samples = 2**10 if cpu else 2**17
        lines.append(f"images        {config.eval.max_samples} samples evaluated at once, for this device")
    if is_auto(config.eval.chunk):
        config.eval.chunk = 2**12 if cpu else 2**16
        lines.append(f"images        {config.eval.chunk} rays rendered at once, for this device")
    if is_auto(config.train.microbatch_size):
        samples = build_model(config).samples_per_ray
        config.train.microbatch_size = devices.microbatch_of(config.train, samples)
    return config, lines


def fill_from(config: ConfigDict, resolved: ConfigDict) -> ConfigDict:
    """Returns a copy of a config whose "auto" fields have the values of a resolved one."""
    config = copy.deepcopy(config)
    for name in auto_fields(config):
        *sections, field = name.split(".")
        ours, theirs = config, resolved
        for section in sections:
            ours, theirs = ours[section], theirs[section]
        ours[field] = theirs[field]
    return config


def auto_fields(config: ConfigDict) -> list[str]:
    """Returns the dotted names of the fields that are "auto" by inference; train.parallel knows "auto" itself."""

    def names(section, prefix):
        for key, value in section.items():
            if isinstance(value, dict):
                yield from names(value, f"{prefix}{key}.")
            elif is_auto(value):
                yield prefix + key

    return [name for name in names(config.to_dict(), "") if name != "train.parallel"]


def _resolve_sizes(config: ConfigDict, views: Views) -> list[str]:
    """Fills the sizes of grids, networks and training into a config; returns lines."""
    lines: list[str] = []
    section, train, ndc = config.occupancy, config.train, config.data.ndc

    def infer(owner: Any, name: str, value: Any, line: str) -> None:
        if is_auto(owner[name]):
            owner[name] = value
            lines.append(line)

    # Alpha prunes the box of what is trained in it; a grid that is baked later is for the cameras alone.
    in_box = config.sampler != "hierarchical" or config.field != "mlp"
    use_alpha = in_box and section.use_alpha and views.pixels.shape[-1] == 4 and not ndc
    if is_auto(section.contracted):
        section.contracted, why = _contracted(config, views, use_alpha)
        lines.append(f"contraction   {'on' if section.contracted else 'off'}: {why}")
    footprint = _footprint(views, ndc)
    if is_auto(section.lower) or is_auto(section.upper):
        lower, upper, why = _box(views, use_alpha, ndc=ndc, contracted=section.contracted)
        digits = 4 - math.floor(math.log10(max(upper - lower)))
        for name, bound in (("lower", lower), ("upper", upper)):
            if is_auto(section[name]):
                section[name] = tuple(round(float(x), digits) for x in bound)
        lines.append(f"box           {_text(section.lower)} to {_text(section.upper)}, {why}")
    longest = max(high - low for low, high in zip(section.lower, section.upper, strict=True))
    if not longest > 0:
        raise ValueError(
            f"occupancy.lower is {section.lower} and occupancy.upper {section.upper}, expected lower < upper"
        )
    finest = int(np.clip(round(longest / (_SPACING * footprint)), *_FINEST))
    step_size = longest / min(finest, _MOST_STEPS)
    infer(section, "step_size", step_size, f"step size     {step_size:.4g}, a pixel covers {footprint:.4g}")
    resolution = min(finest, _LARGEST_GRID)
    infer(section, "resolution", resolution, f"grid          {resolution} cells along the longest side")
    octaves = int(np.clip(round(1 + math.log2(2 * math.pi / (4 * footprint))), 1, 16))
    for name in ("coarse", "fine"):
        infer(
            config[name],
            "num_freqs",
            octaves,
            f"octaves       {octaves}, down to waves of four pixels ({name})",
        )
    levels = tuple(max(finest // 2**level, 2) for level in (3, 2, 1, 0))
    infer(config.hash_grid, "resolutions", levels, f"hash grid     {levels} vertices along the longest side")
    root = float(np.sqrt(np.prod(views.size, axis=1)).mean()) ** 0.5
    steps = round(_STEPS_PER_ROOT_PIXEL * root)
    infer(train, "max_steps", steps, f"training      {steps:,} steps, by the size of the images")
    infer(train, "lr_steps", train.max_steps, f"learning rate falls for {train.max_steps:,} steps, all of them")
    return lines


def _footprint(views, ndc):
    """Returns the size of a pixel at the point that the cameras look at, in world units."""
    if ndc:
        return 2 / float(np.max(views.size[:, 1]))
    eyes = np.asarray(views.cameras.to_world, np.float64)[:, :, 3]
    distances = np.linalg.norm(eyes - poses.gaze_center(views.cameras.to_world), axis=-1)
    return float(np.median(distances / np.asarray(views.cameras.focal)[:, 0]))


def _contracted(config, views, use_alpha):
    """Returns whether the box holds all of space, and why."""
    if config.data.ndc:
        return False, "normalised device coordinates hold all that is seen"
    if config.data.world != "around":
        return False, f"the world is {config.data.world!r}"
    if views.box is not None and _side(views.box) <= _WIDEST_BOX * 4 * _inner_half_side(views):
        return False, "the file states the scene's bounds"
    if use_alpha:
        return False, "alpha shows where the object ends"
    return True, "nothing states how far the surroundings extend"


def _box(views, use_alpha, *, ndc, contracted):
    """Returns lower, upper, and how they were found."""
    if ndc:
        lower, upper = _ends_of_rays(views)
        return lower, upper, "the bounds of all rays"
    if views.box is not None and not contracted:
        return *np.asarray(views.box, np.float64), "as the file states"
    center, width = _widths(views)
    if contracted:
        half = _inner_half_side(views)
        return center - 2 * half, center + 2 * half, f"not contracted within {half:.2g} of its centre"
    lower, upper = center - width.max(), center + width.max()
    if not use_alpha:
        return lower, upper, "as wide as the images where all cameras look"
    return *visual_hull.hull_bounds(views, lower, upper), "the bounds of what alpha leaves"


def _widths(views):
    """Returns the point that the cameras look at [3], and half the size of the images there [V, 2]."""
    center = poses.gaze_center(views.cameras.to_world)
    distance = np.linalg.norm(np.asarray(views.cameras.to_world)[:, :, 3] - center, axis=-1)
    return center, distance[:, None] * np.asarray(views.size)[:, ::-1] / 2 / np.asarray(views.cameras.focal)


def _inner_half_side(views):
    """Returns half the side of the cube that most images show whole, which is worth most cells."""
    return float(np.median(_widths(views)[1].min(axis=1)))


def _side(box):
    return float(np.max(np.asarray(box[1]) - np.asarray(box[0])))


def _ends_of_rays(views):
    """Returns the bounds of all rays: of those through the images' corners, as NDC rays are straight."""
    ends = []
    for index, (height, width) in enumerate(np.asarray(views.size)):
        corners = np.float32([[0, 0], [width, 0], [0, height], [width, height]])
        rays = view_rays(views, index, corners, ndc=True)
        for t in (rays.near, rays.far):
            ends.append(np.asarray(rays.origins + t[:, None] * rays.directions))
    ends = np.concatenate(ends)
    return ends.min(axis=0), ends.max(axis=0)


def _text(point):
    return "(" + ", ".join(f"{value:.2f}" for value in point) + ")"


__all__ = ["AUTO", "DEVICE_FIELDS", "Resolved", "auto_fields", "fill_from", "resolve", "resolve_for_device"]
