"""Datasets: the Views of a split, read as a config's data section or a folder says."""

import copy
import dataclasses
import os
import pathlib

import jax
import numpy as np
from ml_collections import ConfigDict

from jaxnerf.core.types import Views
from jaxnerf.data import synthetic
from jaxnerf.data.geometry import bounds, world
from jaxnerf.data.images import downscaled_copies, image_files, load_images
from jaxnerf.data.readers import base, blender
from jaxnerf.data.readers.base import fingerprint
from jaxnerf.runtime.config_fields import is_auto

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "none": None}
WORLDS = {
    "file": "cameras stay as in the file",
    "forward": "all cameras look one way, which becomes -z",
    "around": "the point that the cameras look at becomes the origin, their distance 1",
}
_BLENDER_NEAR, _BLENDER_FAR = 2.0, 6.0  # of the NeRF paper's synthetic scenes, world units
_HELD_OUT_OFFSET = 3  # datasets often begin with views that differ from the rest, so not the first


def load_dataset(folder: str | os.PathLike, *, split: str = "train", **options) -> Views:
    """Reads the Views of a split of the dataset in a folder.

    Args:
        folder: of a dataset in any registered format: Blender, transforms.json, COLMAP or LLFF.
        split: "train", "test" or another that the dataset has.
        **options: fields of the config's data section, see configs/default.py. What is not given is inferred
            from the dataset; images are not shrunk.

    Returns:
        Views.

    Raises:
        ValueError: names the file, what was found, what is expected and what to do.
    """
    data = ConfigDict(_DEFAULTS | {"dir": str(folder)} | options)
    return load_split(resolve(data)[0], split)


_DEFAULTS = {
    "format": "auto",
    "dir": "",
    "fingerprint": "auto",
    "factor": 1,
    "width": 800,
    "size": 100,
    "finish": "usual",
    "near": 0.0,
    "far": 0.0,
    "background": "auto",
    "hold_out": 0,
    "num_views": 0,
    "pixel_offset": 0.5,
    "world": "auto",
    "ndc": False,
}


def resolve(data: ConfigDict, *, missing_ok: bool = False) -> tuple[ConfigDict, list[str]]:
    """Resolves a data section against its folder: every "auto" becomes a value.

    Args:
        data: see configs/default.py; it is not changed.
        missing_ok: whether all stays "auto" where there is no such folder.

    Returns:
        A copy of the section, and one line per inferred value with its reason.

    Raises:
        ValueError: if there is no such folder, or it holds no dataset.
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
    try:
        folder = scene_folder(data.dir)
    except ValueError:
        if missing_ok:
            return data, lines
        raise
    if is_auto(data.format):
        found = base.formats_in(folder)
        others = f", of {', '.join(found)}: --format selects another" if len(found) > 1 else ""
        infer("format", found[0], f"format        {found[0]}{others}")
    if data.format == "blender":
        # Each split has a file of its own, and the cameras are where they should be.
        infer("fingerprint", "")
        infer("world", "file")
    # Reading the cameras takes a while, so only where something is left to infer from them.
    left = [name for name in ("factor", "background", "fingerprint") if is_auto(data[name])]
    capture = base.read_capture(folder, data.format) if left or is_auto(data.world) else None
    if capture is not None:
        lines += [f"skipped       {note}" for note in capture.notes]
    if is_auto(data.factor):
        factor, width = downscaled_copies.factor_for(capture, data.width)
        infer("factor", factor, f"factor        {factor}, of images {width} px wide")
    if is_auto(data.world):
        kind = _default_world(data, capture)
        infer("world", kind, f"world         {kind}: {WORLDS[kind]}")
    if is_auto(data.background):
        color = "white" if image_files.has_alpha(capture.frames[0].image) else "none"
        infer("background", color, f"background    {color}")
    if capture is not None:
        infer("fingerprint", fingerprint(capture))
    infer("ndc", data.world == "forward", f"NDC           {'on' if data.world == 'forward' else 'off'}")
    return data, lines


_SYNTHETIC = {
    "format": "synthetic",
    "fingerprint": "",
    "factor": 1,
    "background": "white",
    "world": "file",
    "ndc": False,
}


def _default_world(data, capture):
    if data.format == "blender":
        return "file"
    return "forward" if data.ndc or world.looks_forward(capture) else "around"


def load_split(data: ConfigDict, split: str) -> Views:
    """Returns the Views of a split, as the data section of a configuration describes them.

    With data.hold_out a part of the training views is the split "held_out", and not in "train". With
    data.num_views only so many of those in "train" are.
    """
    if split == "train" and data.num_views:
        views = _without_held_out(data, split)
        return select_views(views, evenly("data.num_views", len(views.offset), data.num_views))
    return _without_held_out(data, split)


def _without_held_out(data, split):
    every = data.hold_out
    if not every or split not in ("train", "held_out"):
        return _read_views(data, split)

    def only(count):
        if not 2 <= every <= count:
            raise ValueError(f"data.hold_out is {every} of {count} views, wanted 2 to {count}, or 0 for none")
        indices = held_out(count, every)
        return indices if split == "held_out" else np.setdiff1d(range(count), indices)

    return _read_views(data, "train", only)


def _read_views(data, split, only=None):
    if data.format == "synthetic":
        views = synthetic.load_views(split=split, size=data.size, finish=data.finish)
        return views if only is None else select_views(views, only(len(views.offset)))
    data, _ = resolve(data)
    folder = scene_folder(data.dir)
    if data.world not in WORLDS or (data.format == "blender" and data.world != "file"):
        names = "'file'" if data.format == "blender" else ", ".join(WORLDS)
        raise ValueError(f"data.world is {data.world!r}, wanted {names} or 'auto'")
    if data.ndc and data.world != "forward":
        raise ValueError(
            f"data.ndc is on in the world {data.world!r}, wanted 'forward', with cameras that look one way; "
            "set data.ndc to False"
        )
    if data.format == "blender":
        return blender.load_views(
            folder,
            split=split,
            factor=data.factor,
            near=data.near or _BLENDER_NEAR,
            far=data.far or _BLENDER_FAR,
            background=background_of(data),
            only=only,
        )
    capture = base.read_capture(folder, data.format)
    if data.fingerprint not in ("", found := fingerprint(capture)):
        raise ValueError(
            f"{folder}: holds {found}, where training saw {data.fingerprint}: other photographs would be in each "
            "split, and the world another; restore what was there, or train anew in another --workdir"
        )
    capture = bounds.with_bounds(capture)
    to_file = np.eye(4)
    if data.world == "forward":
        if data.ndc and not world.looks_forward(capture, cosine=0.5):
            raise ValueError(f"{folder}: data.ndc is on and the cameras look all ways; set it to False")
        capture, to_file = world.recenter(capture)
    elif data.world == "around":
        capture, to_file = world.center(capture)
    capture = bounds.given(capture, data.near, data.far, to_file)
    views = load_images.load_views(capture, split=split, factor=data.factor, background=background_of(data), only=only)
    box = None if capture.box is None else np.float32(capture.box)
    return dataclasses.replace(views, to_file=np.float32(to_file), box=box)


def scene_folder(name):
    """Returns the folder of that name here, or else under $JAXNERF_SCENES."""
    scenes = os.environ.get("JAXNERF_SCENES")
    places = [pathlib.Path(name)] + ([pathlib.Path(scenes, name)] if scenes else [])
    found = [place for place in places if name and place.is_dir()]
    if not found:
        looked = " or ".join(str(place.absolute()) for place in places) if name else "no name"
        raise ValueError(f"data.dir is {name!r}, looked at {looked}: no such folder; give one with --data_dir")
    return found[0]


def background_of(data):
    """Returns the colour behind alpha and behind the scene, or None."""
    if data.background not in BACKGROUNDS:
        raise ValueError(f"data.background is {data.background!r}, wanted one of {sorted(BACKGROUNDS)}")
    return BACKGROUNDS[data.background]


def held_out(count, every):
    """Returns the indices of the held-out views among count, one in each `every`; ascending, int."""
    return np.arange(min(_HELD_OUT_OFFSET, every - 1), count, every)


def evenly(name, count, number):
    """Returns the indices of so many views of count, evenly spread from the first; ascending, int.

    Raises:
        ValueError: if there are not so many; names the field.
    """
    if not 1 <= number <= count:
        raise ValueError(f"{name} is {number} of {count} views, wanted 1 to {count}, or 0 for all")
    return np.arange(number) * count // number


def select_views(views, indices):
    """Returns the Views of the given indices [N], in that order; pixels are copied."""
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
        names=tuple(views.names[index] for index in indices) if views.names else (),
    )
