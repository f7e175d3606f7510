"""The views of a split, as the data section of a configuration describes them."""

import copy
import dataclasses
import os
import pathlib

import numpy as np

from jaxnerf.data import blender, bounds, copies, formats, images, photos, subset, synthetic, world
from jaxnerf.data.capture import fingerprint

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "none": None}
WORLDS = {
    "file": "as in the file",
    "forward": "all cameras look one way, which becomes -z",
    "around": "what the cameras look at becomes the origin, their distance 1",
}
# What is left to the capture.
OPEN = {
    "format": ("auto",),
    "factor": (0,),
    "world": (None, "auto"),
    "ndc": (None,),
    "background": ("",),
}


def settle(data, *, missing_ok=False):
    """Returns a copy of a data section without what is left to the capture, and lines that say what it is.

    See OPEN: the format, the factor that brings images to data.width, the world, what is behind alpha, and
    whether to use NDC. And data.capture says from now on which capture that was. missing_ok: whether all of
    it stays open where there is no such folder.
    """
    data, lines = copy.deepcopy(data), []
    if data.format == "synthetic" or not (is_open(data) or _is_new(data)):
        return data, lines
    try:
        folder = scene_folder(data.dir)
    except ValueError:
        if missing_ok:
            return data, lines
        raise
    if data.format == "auto":
        found = formats.formats_in(folder)
        data.format = found[0]
        others = f", of {', '.join(found)}: --format takes another" if len(found) > 1 else ""
        lines.append(f"format      {data.format}{others}")
    # A Blender scene's cameras stand where they should: there may be nothing to look up.
    known = data.format == "blender" and data.factor and data.background
    capture = None if known else formats.read_capture(folder, data.format)
    if capture is not None:
        lines += [f"left out    {note}" for note in capture.notes]
    if not data.factor:
        data.factor, width = copies.factor_for(capture, data.width)
        lines.append(f"factor      {data.factor}, of images {width} px wide")
    if data.get("world", "auto") == "auto":
        with data.unlocked():  # runs from before there was a choice have no such field
            data.world = _suited_world(data, capture)
        lines.append(f"world       {data.world}: {WORLDS[data.world]}")
    if data.get("background") == "":
        data.background = "white" if images.has_alpha(capture.frames[0].image) else "none"
        lines.append(f"background  {data.background}")
    if _is_new(data):
        data.capture = fingerprint(capture)
    if data.ndc is None:
        data.ndc = data.world == "forward"
        lines.append(f"rays        {'in normalised device coordinates' if data.ndc else 'straight'}")
    return data, lines


def _suited_world(data, capture):
    if data.format == "blender":
        return "file"
    if data.get("world") is None and data.format == "llff":
        return "forward"  # as it was before there was a choice
    return "forward" if data.ndc or world.looks_forward(capture) else "around"


def _is_new(data):
    """Returns whether data.capture is to be filled: not in old runs, nor for splits in files of their own."""
    return data.get("capture") == "" and data.format != "blender"


def is_open(data):
    """Returns whether settle has anything to choose."""
    return any(data.get(name) in values for name, values in OPEN.items())


def load_views(data, split):
    """Returns the Views of a split, as the data section of a configuration describes them.

    With data.hold_out a part of the training views is the split "held_out", and not in "train". With
    data.num_views only so many of those in "train" are.
    """
    if split == "train" and data.get("num_views", 0):
        views = _without_held_out(data, split)
        return subset.select_views(views, subset.evenly("data.num_views", len(views.offset), data.num_views))
    return _without_held_out(data, split)


def _without_held_out(data, split):
    every = data.get("hold_out", 0)
    if not every or split not in ("train", "held_out"):
        return _read_views(data, split)

    def only(count):
        if not 2 <= every <= count:
            raise ValueError(f"data.hold_out is {every} of {count} views, wanted 2 to {count}, or 0 for none")
        indices = subset.held_out(count, every)
        return indices if split == "held_out" else np.setdiff1d(range(count), indices)

    return _read_views(data, "train", only)


def _read_views(data, split, only=None):
    if data.format == "synthetic":
        finish = data.get("finish", "usual")  # as it was before there was a choice
        views = synthetic.load_views(split=split, size=data.size, finish=finish)
        return views if only is None else subset.select_views(views, only(len(views.offset)))
    data, _ = settle(data)
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
            near=data.near or 2.0,
            far=data.far or 6.0,
            background=background_of(data),
            only=only,
        )
    capture = formats.read_capture(folder, data.format)
    if data.get("capture") not in (None, "", found := fingerprint(capture)):
        raise ValueError(
            f"{folder}: holds {found}, where training saw {data.capture}: other photographs would be in each "
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
    # Runs from before data.width have near and far of Blender's scenes in every format.
    near, far = (data.near, data.far) if "width" in data else (0.0, 0.0)
    capture = bounds.given(capture, near, far, to_file)
    views = photos.load_views(
        capture, split=split, factor=data.factor, background=background_of(data), only=only
    )
    box = None if capture.box is None else np.float32(capture.box)
    return dataclasses.replace(views, to_file=np.float32(to_file), box=box)


def scene_folder(name):
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
