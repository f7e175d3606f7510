"""Sizes from the data: what a configuration leaves open (0 or empty) is chosen here, once, and recorded."""

import copy
import math

import numpy as np

from jaxnerf.data import hull, poses
from jaxnerf.data.batches import view_rays
from jaxnerf.engine import scenes

_SPACING = 0.7  # of a pixel's footprint: the finest thing that images can tell apart, and a little finer
_FINEST = (32, 256)  # vertices along the longest side, at least and at most
SIZES = ("lower", "upper", "resolution", "step", "outside")
OUTSIDE = ("nothing", "contracted")  # what is taken to be outside of the box
_MOST_STEPS = 144  # along the longest side: finer images need finer features sooner than finer steps
_TRAINING = 1000  # steps for the square root of a pixel: finer images need more, though not as many more
_WIDEST = 3.0  # times all of contracted space: a box that is wider is no better than that
_LARGEST_GRID = 128  # cells: beyond, looking at all of them costs more than the samples it saves


def fit_config(config, views):
    """Returns a copy of a configuration without open sizes, and lines that say what was chosen and why.

    What is set is kept. Nothing changes where the space section is off.

    Args:
        config: ConfigDict, see configs/default.py.
        views: the training Views.

    Raises:
        ValueError: if the cameras look at no common place.
    """
    config, lines = copy.deepcopy(config), []
    space = config.get("space")
    if not space or not space.skip_empty:
        return config, lines
    if not space.get("outside", "nothing"):
        space.outside, why = _outside(config, views)
        lines.append(f"outside     {space.outside}: {why}")
    footprint = _footprint(views, config.data.ndc)
    masks = space.masks and views.pixels.shape[-1] == 4 and not config.data.ndc
    if not (len(space.lower) and len(space.upper)):
        lower, upper, why = _box(
            views, masks, ndc=config.data.ndc, contracted=space.get("outside") == "contracted"
        )
        digits = 4 - math.floor(math.log10(max(upper - lower)))
        space.lower, space.upper = (
            tuple(given) or tuple(round(float(x), digits) for x in bound)
            for given, bound in ((space.lower, lower), (space.upper, upper))
        )
        lines.append(f"box         {_text(space.lower)} to {_text(space.upper)}, {why}")
    longest = max(high - low for low, high in zip(space.lower, space.upper, strict=True))
    finest = int(np.clip(round(longest / (_SPACING * footprint)), *_FINEST))
    if not space.step:
        space.step = longest / min(finest, _MOST_STEPS)
        lines.append(f"step        {space.step:.4g}, where a pixel covers {footprint:.4g}")
    if not space.resolution:
        space.resolution = min(finest, _LARGEST_GRID)
        lines.append(f"cells       {space.resolution} along the longest side")
    if config.field == "mlp" and not config.fine.num_freqs:
        config.fine.num_freqs = int(np.clip(round(1 + math.log2(2 * math.pi / (4 * footprint))), 1, 16))
        lines.append(f"octaves     {config.fine.num_freqs}, down to waves of four pixels")
    if config.field == "grid" and not len(config.features.resolutions):
        config.features.resolutions = tuple(max(finest // 2**level, 2) for level in (3, 2, 1, 0))
        lines.append(f"features    {config.features.resolutions} vertices along the longest side")
    train = config.train
    if not train.max_steps:
        train.max_steps = round(_TRAINING * float(np.sqrt(np.prod(views.size, axis=1)).mean()) ** 0.5)
        lines.append(f"training    {train.max_steps:,} steps, by the size of the images")
    train.lr_steps = train.lr_steps or train.max_steps
    lines.append("left out    coarse network and importance points: the cells say where to ask")
    if (config.fine if config.field == "mlp" else config.features).use_viewdirs:
        lines.append("kept        colour by direction: only training tells, see experiments/scene_needs.py")
    else:
        lines.append("left out    colour by direction: use_viewdirs is off")
    return config, lines


def fit_data(config, *, missing_ok=False):
    """Returns a copy of a configuration whose data section is settled, and lines that say what was found."""
    config = copy.deepcopy(config)
    data, lines = scenes.settle(config.data, missing_ok=missing_ok)
    config.data = data
    return config, lines


def is_open(config):
    """Returns whether something is still to be chosen."""
    if config.data.format != "synthetic" and scenes.is_open(config.data):
        return True
    space = config.get("space")
    if not space or not space.skip_empty:
        return False
    field = config.features.resolutions if config.field == "grid" else config.fine.num_freqs
    sizes = [*(space.get(name, "nothing") for name in SIZES), field]
    return not all([*sizes, config.train.max_steps, config.train.lr_steps])


def fill_from(config, fitted):
    """Returns a copy whose open sizes are those of a fitted configuration."""
    config = copy.deepcopy(config)
    if is_open(config):
        with config.data.unlocked():
            for name in scenes.OPEN:
                if config.data.get(name) in scenes.OPEN[name] and name in fitted.data:
                    config.data[name] = fitted.data[name]
            config.data.capture = config.data.get("capture") or fitted.data.get("capture", "")
        if not (config.get("space") and config.space.skip_empty):
            return config
        for name in SIZES:
            if not config.space.get(name, "nothing"):
                config.space[name] = fitted.space.get(name, "nothing")
        config.features.resolutions = config.features.resolutions or fitted.features.resolutions
        config.fine.num_freqs = config.fine.num_freqs or fitted.fine.num_freqs
        for name in ("max_steps", "lr_steps"):
            config.train[name] = config.train[name] or fitted.train[name]
    return config


def skipping(config):
    """Returns a copy of a configuration without a space, for fit_config to choose one by the cameras."""
    config = copy.deepcopy(config)
    if not config.get("space"):
        raise ValueError("eval.skip_empty: the configuration has no space section; give one with --config")
    config.space.update({"skip_empty": True, "masks": False})
    if config.data.get("world") == "around":  # there may be surroundings
        with config.space.unlocked():
            config.space.outside = ""
    return config


def _footprint(views, ndc):
    """Returns what a pixel covers where the cameras look, in world units."""
    if ndc:
        return 2 / float(np.max(views.size[:, 1]))
    eyes = np.asarray(views.cameras.to_world, np.float64)[:, :, 3]
    distances = np.linalg.norm(eyes - poses.gaze_center(views.cameras.to_world), axis=-1)
    return float(np.median(distances / np.asarray(views.cameras.focal)[:, 0]))


def _outside(config, views):
    """Returns what is outside of the box, and in words why."""
    if config.data.ndc:
        return "nothing", "normalised device coordinates hold all that is seen"
    if views.box is not None and _side(views.box) <= _WIDEST * 4 * _room(views):
        return "nothing", "the file says how far the scene goes"
    if config.space.masks and views.pixels.shape[-1] == 4:
        return "nothing", "alpha shows where the object ends"
    return "contracted", "nothing says how far the surroundings go"


def _box(views, masks, *, ndc, contracted):
    """Returns lower, upper, and in words where they come from."""
    if ndc:
        lower, upper = _ends_of_rays(views)
        return lower, upper, "which holds all rays"
    if views.box is not None and not contracted:
        return *np.asarray(views.box, np.float64), "as the file says"
    center, width = _widths(views)
    if contracted:
        room = _room(views)
        return (
            center - 2 * room,
            center + 2 * room,
            f"of which {room:.2g} around its middle are not contracted",
        )
    lower, upper = center - width.max(), center + width.max()
    if not masks:
        return lower, upper, "as wide as the images where all cameras look; nothing is known to be empty"
    return *hull.hull_bounds(views, lower, upper), "which holds all that the masks leave possible"


def _widths(views):
    """Returns the middle of what cameras look at [3], and half of how large images are there [V, 2]."""
    center = poses.gaze_center(views.cameras.to_world)
    distance = np.linalg.norm(np.asarray(views.cameras.to_world)[:, :, 3] - center, axis=-1)
    return center, distance[:, None] * np.asarray(views.size)[:, ::-1] / 2 / np.asarray(views.cameras.focal)


def _room(views):
    """Returns how far from the middle what most images hold whole reaches: that is worth most cells."""
    return float(np.median(_widths(views)[1].min(axis=1)))


def _side(box):
    return float(np.max(np.asarray(box[1]) - np.asarray(box[0])))


def _ends_of_rays(views):
    """Returns the box of all rays' ends: of those through the images' corners, as they are straight."""
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
