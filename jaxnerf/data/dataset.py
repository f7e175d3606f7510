"""Datasets: the Views of a split, for a folder or for the data section of a config."""

import copy
import dataclasses
import os
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int
from ml_collections import ConfigDict

from jaxnerf.core.types import SparsePoints, Views
from jaxnerf.data import synthetic
from jaxnerf.data.geometry import bounds, world
from jaxnerf.data.images import downscaled_copies, image_files, load_images
from jaxnerf.data.readers import base, blender
from jaxnerf.data.readers.base import fingerprint
from jaxnerf.runtime.config_fields import AUTO, is_auto

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "none": None}
WORLDS = {
    "file": "cameras stay as in the file",
    "forward": "all cameras look in one direction, which becomes -z",
    "around": "the point that the cameras look at becomes the origin, their distance 1",
}
_SYNTHETIC = {"fingerprint": "", "factor": 1, "background": "white", "world": "file", "ndc": False}
BLENDER_RANGE = (2.0, 6.0)  # near and far of the NeRF paper's synthetic scenes, world units
_MEAN_RUNS, _MEAN_RUN = 2**10, 2**10  # of pixels, of whose colours the mean is taken
_HELD_OUT_OFFSET = 3  # not 0, as the first views of a dataset often differ from the others


def load_dataset(dir: str | os.PathLike, *, split: str = "train", **options: Any) -> Views:
    """Reads the Views of a split of the dataset in a folder.

    Images keep their size unless `factor` is given. Everything else that `options` does not set is inferred from
    the dataset.

    Args:
        dir: of a dataset in any registered format: Blender, transforms.json, COLMAP or LLFF, for example.
        split: "train", "test", or another split of the dataset.
        **options: fields of the config's data section, see configs/default.py. Where near or far is not set, each
            view has its own, from the dataset.

    Returns:
        Views of the split.

    Raises:
        ValueError: names the file, what was found, what is expected and what to do.
    """
    from jaxnerf.configs import default

    data = default.get_config().data
    inferred = {name: AUTO for name in ("format", "background", "world", "ndc")}
    known = [name for name in data if name != "background_color"]  # of renderings, not of images
    if unknown := sorted(set(options) - set(known)):
        raise ValueError(f"load_dataset: {unknown[0]} is no option, expected one of {', '.join(known)}; correct it")
    data.update(inferred | {"dir": str(dir)} | options)
    return load_split(data, split)


def resolve(data: ConfigDict) -> tuple[ConfigDict, list[str]]:
    """Resolves a data section against its folder: every "auto" becomes a value.

    Args:
        data: see configs/default.py; it is not changed.

    Returns:
        A copy of the section, and one line per inferred value with its reason.

    Raises:
        ValueError: if the folder does not exist or holds no dataset.
    """
    data, lines = copy.deepcopy(data), []

    def infer(name, value, line=None):
        if is_auto(data[name]):
            data[name] = value
            if line:
                lines.append(line)

    if data.format == "synthetic":
        for name, value in _SYNTHETIC.items():
            infer(name, value)
        return data, lines
    folder = dataset_folder(data.dir)
    if pathlib.Path(data.dir).is_dir():  # a name below $JAXNERF_SCENES stays a name
        data.dir = str(folder.absolute())
    if is_auto(data.format):
        found = base.detect_formats(folder)
        others = f", of {', '.join(found)}: --format selects another" if len(found) > 1 else ""
        infer("format", found[0], f"format        {found[0]}{others}")
    if data.format == "blender":
        # Each split has a file of its own, and the world of the cameras is already normalised.
        infer("fingerprint", "")
        infer("world", "file")
    # Reading the cameras takes a while, so they are only read to infer something from them.
    if any(is_auto(data[name]) for name in ("factor", "world", "background", "fingerprint")):
        capture = base.read_capture(folder, data.format)
        lines += [f"note          {note}" for note in capture.notes]
        masks = [frame.mask for frame in capture.frames if frame.mask is not None]
        if masks:
            where = f"{len(masks)} of {len(capture.frames)} images have one, such as {masks[0]}"
            lines.append(f"masks         {where}: dark pixels are ignored in training and metrics")
        if is_auto(data.factor):
            factor, width = downscaled_copies.factor_for(capture, data.width)
            infer("factor", factor, f"factor        {factor}, of images {width} px wide")
        if is_auto(data.world):
            forward = data.ndc is True or world.looks_forward(capture)
            kind = "forward" if forward else "around"
            infer("world", kind, f"world         {kind}: {WORLDS[kind]}")
        if is_auto(data.background):
            color = "white" if image_files.has_alpha(capture.frames[0].image) else "none"
            infer("background", color, f"background    {color}")
        infer("fingerprint", fingerprint(capture))
    infer("ndc", data.world == "forward", f"NDC           {'on' if data.world == 'forward' else 'off'}")
    return data, lines


def load_split(data: ConfigDict, split: str, *, max_views: int | None = None) -> Views:
    """Reads the Views of a split of the dataset that a config's data section describes.

    With `hold_out`, some views of "train" form the split "held_out" instead. With `num_views`, "train" has only
    that many of its views. Fields that are still "auto" are resolved first.

    Args:
        data: see configs/default.py.
        split: of the dataset.
        max_views: read at most so many of its views, spread evenly; None: all.

    Raises:
        ValueError: names the field or file, what was found, what is expected and what to do.
    """
    select = _selection(data, split)
    if max_views is not None:
        select = _at_most(max_views, select)
    source = "train" if split == "held_out" and data.hold_out else split
    if data.format == "synthetic":
        views = synthetic.load_synthetic(split=source, size=data.size, finish=data.finish)
        return views if select is None else select_views(views, select(len(views.offset)))
    data, _ = resolve(data)
    _check_world(data)
    near = 0.0 if is_auto(data.near) else data.near  # it is resolved later, against the views
    folder = dataset_folder(data.dir)
    reading = {"split": source, "factor": data.factor, "background": background_of(data), "select": select}
    if data.format == "blender":
        near, far = near or BLENDER_RANGE[0], data.far or BLENDER_RANGE[1]
        return blender.load_blender(folder, near=near, far=far, **reading)
    capture = base.read_capture(folder, data.format)
    if data.fingerprint not in ("", found := fingerprint(capture)):
        raise ValueError(
            f"{folder}: holds {found}, expected {data.fingerprint} as in training: other images would be in each "
            "split, and the world would differ; restore the dataset, or train again in another --workdir"
        )
    known = bounds.known_bounds(capture)
    capture = bounds.with_bounds(capture)
    to_file = np.eye(4)
    if data.world == "forward":
        if data.ndc and not world.looks_forward(capture, cosine=0.5):
            raise ValueError(
                f"{folder}: data.ndc is True and the cameras look in all directions, expected one direction; set "
                "data.ndc to False"
            )
        capture, to_file = world.recenter(capture)
    elif data.world == "around":
        capture, to_file = world.center(capture)
    nearest = [frame.bounds[0] if sure else 0.0 for frame, sure in zip(capture.frames, known, strict=True)]
    free_until = dict(zip((frame.name for frame in capture.frames), nearest, strict=True))
    capture = bounds.override_bounds(capture, near, data.far, to_file)
    box = None if capture.box is None else np.float32(capture.box)
    views = load_images.load_capture(capture, **reading)
    free_until = np.float32([free_until[name] for name in views.names])
    return dataclasses.replace(views, to_file=np.float32(to_file), box=box, free_until=free_until)


def dataset_folder(name: str) -> pathlib.Path:
    """Returns the folder of that path, or else of that name below $JAXNERF_SCENES.

    Raises:
        ValueError: if neither exists.
    """
    scenes = os.environ.get("JAXNERF_SCENES")
    places = [pathlib.Path(name)] + ([pathlib.Path(scenes, name)] if scenes else [])
    found = [place for place in places if name and place.is_dir()]
    if not found:
        searched = " or ".join(str(place.absolute()) for place in places) if name else "nothing"
        raise ValueError(f"data.dir is {name!r}: no such folder, searched {searched}; set it with --data_dir")
    return found[0]


def background_of(data: ConfigDict) -> tuple[float, float, float] | None:
    """Returns the colour behind alpha, or None where alpha is dropped."""
    if data.background not in BACKGROUNDS:
        raise ValueError(f"data.background is {data.background!r}, expected one of {sorted(BACKGROUNDS)}; correct it")
    return BACKGROUNDS[data.background]


def color_behind(data: ConfigDict) -> tuple[float, float, float] | None:
    """Returns the colour behind the scene of a resolved data section; None: black."""
    color = data.get("background_color", ())  # configs of older versions lack it
    if data.background != "none" or len(color) == 0:
        return background_of(data)
    if is_auto(color):
        raise ValueError(
            "data.background_color is 'auto'; resolve the config against a dataset, or set red, green and blue, or () "
            "for black"
        )
    return tuple(color)


def mean_color(views: Views) -> tuple[float, float, float]:
    """Returns the mean colour of the views' pixels in [0, 1], alpha dropped; see `sample_pixels`."""
    return tuple(float(value) for value in sample_pixels(views)[:, :3].mean(axis=0))


def sample_pixels(views: Views) -> Float[np.ndarray, "N C"]:
    """Returns pixels of all views in [0, 1].

    Of more than 2^20 pixels some are chosen: runs of them at random places, as single pixels of a file on disk would
    take as long to read as all. Pixels that a mask excludes do not count, unless it excludes all that were chosen.
    """
    total, chosen = len(views.pixels), np.arange(len(views.pixels))
    if total > _MEAN_RUNS * _MEAN_RUN:
        starts = np.sort(np.random.default_rng(0).integers(0, total - _MEAN_RUN, _MEAN_RUNS))
        chosen = (starts[:, None] + np.arange(_MEAN_RUN)).reshape(-1)
    if views.mask is not None and views.mask[chosen].any():
        chosen = chosen[views.mask[chosen]]
    pixels = views.pixels[chosen]
    return pixels / np.iinfo(pixels.dtype).max


def held_out(count: int, every: int) -> Int[np.ndarray, " N"]:
    """Returns the indices of the held-out views among count, one in each `every`, in ascending order."""
    return np.arange(min(_HELD_OUT_OFFSET, every - 1), count, every)


def select_views(views: Views, indices: Sequence[int] | Int[np.ndarray, " N"]) -> Views:
    """Returns the Views of the given indices, in their order; pixels are copied."""
    indices = np.asarray(indices)
    size, first = np.asarray(views.size)[indices], np.asarray(views.offset)[indices]
    counts = size.prod(axis=1)

    def pick(values):
        return np.concatenate([values[start : start + count] for start, count in zip(first, counts, strict=True)])

    def take(leaf):
        return np.asarray(leaf)[indices]

    return dataclasses.replace(
        views,
        pixels=pick(views.pixels),
        offset=np.append(0, np.cumsum(counts)[:-1]).astype(np.int32),
        size=size,
        cameras=jax.tree.map(take, views.cameras),
        near=take(views.near),
        far=take(views.far),
        mask=None if views.mask is None else pick(views.mask),
        free_until=None if views.free_until is None else take(views.free_until),
        names=tuple(views.names[index] for index in indices) if views.names else (),
        sparse=None if views.sparse is None else _select_observations(views.sparse, indices),
    )


def _select_observations(sparse: SparsePoints, indices: np.ndarray) -> SparsePoints:
    """Returns all points with their observations in the views of the given indices, in their order."""
    first, ends = (np.searchsorted(sparse.view, indices, side=side) for side in ("left", "right"))
    kept = np.concatenate([np.arange(*own) for own in zip(first, ends, strict=True)]).astype(int)
    return dataclasses.replace(
        sparse,
        view=np.repeat(np.arange(len(indices), dtype=np.int32), ends - first),
        point=np.asarray(sparse.point)[kept],
        pixel=np.asarray(sparse.pixel)[kept],
        confidence=None if sparse.confidence is None else np.asarray(sparse.confidence)[kept],
    )


def _selection(data: ConfigDict, split: str) -> Callable[[int], np.ndarray] | None:
    """Returns a function from the number of views to the indices of those that a split has; None: all."""
    every = data.hold_out if split in ("train", "held_out") else 0
    number = data.num_views if split == "train" else 0
    if not every and not number:
        return None

    def select(count):
        indices = np.arange(count)
        if every:
            if not 2 <= every <= count:
                raise ValueError(
                    f"data.hold_out is {every} of {count} views, expected 2 to {count}, or 0 for none; correct it"
                )
            held = held_out(count, every)
            indices = held if split == "held_out" else np.setdiff1d(indices, held)
            count = len(indices)
        if number:
            if not 1 <= number <= count:
                raise ValueError(
                    f"data.num_views is {number} of {count} views, expected 1 to {count}, or 0 for all; correct it"
                )
            indices = indices[np.arange(number) * count // number]
        return indices

    return select


def _at_most(number, select):
    """Returns the selection of at most that many of the views that another one selects."""

    def select_some(count):
        indices = np.arange(count) if select is None else select(count)
        kept = min(number, len(indices))
        return indices[np.arange(kept) * len(indices) // kept]

    return select_some


def _check_world(data):
    worlds = ("file",) if data.format == "blender" else tuple(WORLDS)
    if data.world not in worlds:
        raise ValueError(
            f"data.world is {data.world!r}, expected one of {', '.join(worlds)} or auto for the format "
            f"{data.format!r}; correct it"
        )
    if data.ndc and data.world != "forward":
        raise ValueError(
            f"data.ndc is True in the world {data.world!r}, expected the world 'forward' and cameras that look in "
            "one direction; set data.ndc to False"
        )
