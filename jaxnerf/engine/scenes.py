"""The views of a split, as the data section of a configuration describes them."""

import os
import pathlib

import numpy as np

from jaxnerf.data import blender, llff, subset, synthetic

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "none": None}


def load_views(data, split):
    """Returns the Views of a split, as the data section of a configuration describes them.

    With data.hold_out a part of the training views is the split "held_out", and not in "train".
    """
    every = data.get("hold_out", 0)
    if not every or split not in ("train", "held_out"):
        return _read_views(data, split)
    views = _read_views(data, "train")
    count = len(views.offset)
    if not 2 <= every <= count:
        raise ValueError(f"data.hold_out is {every} of {count} views, wanted 2 to {count}, or 0 for none")
    indices = subset.held_out(count, every)
    return subset.select_views(views, indices if split == "held_out" else np.setdiff1d(range(count), indices))


def _read_views(data, split):
    if data.format == "synthetic":
        return synthetic.load_views(split=split, size=data.size)
    folder = _scene_folder(data.dir)
    if data.format == "blender":
        return blender.load_views(
            folder,
            split=split,
            factor=data.factor,
            near=data.near,
            far=data.far,
            background=background_of(data),
        )
    if data.format == "llff":
        return llff.load_views(folder, split=split, factor=data.factor)
    raise ValueError(f"data.format is {data.format!r}, wanted 'synthetic', 'blender' or 'llff'")


def _scene_folder(name):
    """Returns the folder of that name here, or else under $JAXNERF_SCENES."""
    scenes = os.environ.get("JAXNERF_SCENES")
    places = [pathlib.Path(name)] + ([pathlib.Path(scenes, name)] if scenes else [])
    found = [place for place in places if name and place.is_dir()]
    if not found:
        looked = " or ".join(str(place.absolute()) for place in places) if name else "no name"
        raise ValueError(
            f"data.dir is {name!r}, looked at {looked}: no such folder; give one with --data_dir"
        )
    return found[0]


def background_of(data):
    """Returns the colour behind alpha and behind the scene, or None."""
    if data.background not in BACKGROUNDS:
        raise ValueError(f"data.background is {data.background!r}, wanted one of {sorted(BACKGROUNDS)}")
    return BACKGROUNDS[data.background]
