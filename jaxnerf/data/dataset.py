"""Datasets: the Views of a split, for a folder or for the data section of a config."""

import dataclasses
import os
import pathlib
from typing import Any

import numpy as np

from jaxnerf.core.views import Views
from jaxnerf.data.facts import LookAt
from jaxnerf.data.geometry import bounds, world
from jaxnerf.data.geometry.poses import AXES, axis_of, look_one_way, travel
from jaxnerf.data.images import downscaled_copies, image_files, load_images, pixel_rays
from jaxnerf.data.readers import base
from jaxnerf.data.readers.base import Capture
from jaxnerf.data.scene import BACKGROUNDS
from jaxnerf.data.shared_views import found_by_split
from jaxnerf.data.synthetic import FINISHES
from jaxnerf.data.view_selection import select_views, selection
from jaxnerf.options import AUTO, Changes, Options, between, declarations, infer, is_auto, option, read_value, replaced
from jaxnerf.registry import READERS, needs_folder

WORLDS = {
    "file": "cameras stay as in the file",
    "forward": "all cameras look in one direction, which becomes -z",
    "around": "the point that the cameras look at becomes the origin, their distance 1",
}
_NO_FOLDER = {"factor": 1, "background": "white", "world": "file", "ndc": False}  # of a dataset that is rendered
_NEAR = 0.02  # times the cameras' distance from what they look at; hardly anything in focus is closer


def _wrong_indices(indices):
    valid = all(isinstance(index, int) and not isinstance(index, bool) and index >= 0 for index in indices)
    return None if valid and len(set(indices)) == len(indices) else "different whole numbers of at least 0"


@dataclasses.dataclass(frozen=True)
class DataOptions(Options):
    """The options of the dataset: which images are read, and how."""

    format: str = option(
        "synthetic",
        "`synthetic` (the embedded scene), `blender`, `transforms`, `colmap`, `llff`, or "
        "the name of a registered reader; auto: what the folder holds",
        auto=True,
        protocol=True,
    )
    dir: str = option("", "the dataset's folder: a path, or a name below $JAXNERF_SCENES", changes=Changes.NOTHING)
    factor: int = option(
        1,
        "images are shrunk by this whole number (area average); auto: the one whose images are nearest to `width`",
        range=between(1, 4096),
        auto=True,
        protocol=True,
    )
    width: int = option(800, "see `factor`", unit="px", range=between(1, 65_536))
    size: int = option(100, "side of the embedded scene's images", unit="px", range=between(1, 1024))
    finish: str = option(
        "usual",
        "surfaces of the embedded scene; `matt` ones do not depend on the view direction",
        choices=FINISHES,
    )
    near: float = option(
        AUTO,
        "Where rays start, along the camera's axis. 0: each image has its own, from the dataset. auto: one small "
        "distance where space is contracted and its empty cells are skipped, otherwise 0.",
        unit="of the dataset's files",
        range=between(0, 10**9),
        auto=True,
    )
    far: float = option(0.0, "where rays end, as `near`", unit="of the dataset's files", range=between(0, 10**9))
    background: str = option(
        "white",
        "The colour behind alpha and behind the scene. `none`: alpha is dropped, and `scene.background` is behind the "
        "scene. auto: `white` for images with alpha, otherwise `none`.",
        choices=tuple(BACKGROUNDS),
        auto=True,
        protocol=True,
    )
    hold_out: int = option(
        0, "every n-th training view belongs to the split `held_out`; 0: none", range=between(0, 10**6), protocol=True
    )
    num_views: int = option(
        0, "number of training views to use, spread evenly; 0: all", range=between(0, 10**6), protocol=True
    )
    view_indices: tuple[int, ...] = option(
        (),
        "indices of the training views to use, in the dataset's order from 0, as published protocols with few views "
        "name them; (): all",
        check=_wrong_indices,
        protocol=True,
    )
    pixel_offset: float = option(
        0.5, "rays pass through pixel centres (0.5) or corners (0)", unit="px", range=between(-1, 1), protocol=True
    )
    world: str = option(
        AUTO,
        "The world's coordinates: `file` (as in the dataset), `forward` (recentred for NDC), or `around` (centred on "
        "and scaled to the region that the cameras see).",
        choices=tuple(WORLDS),
        auto=True,
    )
    up: str = option(
        "",
        "The axis of the dataset's files that is up, such as `+z`. It becomes z in the world `around`, and paths, the "
        "viewer and a GLB have it, too. Empty: up follows from how the cameras are held, see `jaxnerf-check`.",
        choices=("", *AXES),
    )
    ndc: bool = option(
        False, "whether rays are in normalised device coordinates; requires the world `forward`", auto=True
    )


def load_dataset(dir: str | os.PathLike, *, split: str = "train", **options: Any) -> Views:
    """Reads the Views of a split of the dataset in a folder.

    Images keep their size unless `factor` is given. Everything else that `options` does not set is inferred from
    the dataset.

    Args:
        dir: of a dataset in any registered format: Blender, transforms.json, COLMAP or LLFF, for example.
        split: "train", "test", or another split of the dataset.
        **options: options of DataOptions. Where near or far is not set, each
            view has its own, from the dataset.

    Returns:
        Views of the split.

    Raises:
        ValueError: names the file, what was found, what is expected and what to do.
    """
    inferred = DataOptions(format=AUTO, background=AUTO, world=AUTO, ndc=AUTO)  # type: ignore[arg-type]
    known = declarations(DataOptions)
    if unknown := sorted(set(options) - set(known)):
        raise ValueError(f"load_dataset: {unknown[0]} is no option, expected one of {', '.join(known)}; correct it")
    plain = {
        name: value.tolist() if isinstance(value, np.generic | np.ndarray) else value for name, value in options.items()
    }
    options = {name: read_value(*known[name], value, f"load_dataset: {name}") for name, value in plain.items()}
    return load_split(replaced(inferred, **{"dir": str(dir)} | options), split)


def resolve(data: DataOptions) -> tuple[DataOptions, list[str], Capture | None]:
    """Resolves the options of a dataset against its folder.

    `near` stays "auto", see `resolve_near`.

    Args:
        data: the options.

    Returns:
        The options; one line per inferred value with its reason; and the Capture, None if there is none or it is
        unreadable and nothing was inferred from it.

    Raises:
        ValueError: if the folder does not exist or holds no dataset.
    """
    data, lines, capture = _resolve(data)
    capture = capture or _readable(data)
    notes = [found["note"] for found in views_shared_with_training(data, capture).values()]
    return data, lines + [f"note          {note}" for note in dict.fromkeys(notes)], capture


def _resolve(data):
    """Returns what `resolve` does, without what concerns test views."""
    if not needs_folder(data.format):
        return infer(data, **{name: (value, "") for name, value in _NO_FOLDER.items()})[0], [], None
    lines, capture = [], None
    folder = dataset_folder(data.dir)
    if pathlib.Path(data.dir).is_dir():  # a name below $JAXNERF_SCENES stays a name
        data = replaced(data, dir=str(folder.absolute()))
    read = data.format
    if is_auto(data.format):
        found = base.detect_formats(folder)
        others = f", of {', '.join(found)}: --format selects another" if len(found) > 1 else ""
        lines.append(f"format        {found[0]}{others}")
        data = replaced(data, format=found[0])
    # Reading the cameras takes a while, so they are only read to infer something from them.
    if any(map(is_auto, (data.factor, data.world, data.background))):
        capture = base.read_capture(folder, read)
        data, more = infer(data, **_of_capture(data, capture))
        lines += [*_facts_of(data, capture), *more]
    if data.up:
        lines.append(f"up            {data.up} of the dataset's files, as data.up says")
    ndc = data.world == "forward"
    data, more = infer(data, ndc=(ndc, f"NDC           {'on' if ndc else 'off'}"))
    return data, lines + more, capture


def _facts_of(data, capture):
    """Returns lines about what the reader has chosen and skipped."""
    lines = [f"read          {choice}" for choice in capture.choices]
    lines += [f"note          {note}" for note in capture.notes]
    if rays := pixel_rays.rays_line([downscaled_copies.with_size(frame).camera for frame in capture.frames]):
        lines.append(f"rays          {rays}")
    masks = [frame.mask for frame in capture.frames if frame.mask is not None]
    if masks:
        where = f"{len(masks)} of {len(capture.frames)} images have one, such as {masks[0]}"
        lines.append(f"masks         {where}: dark pixels are ignored in training and metrics")
    if capture.bounds_reason and not (data.near and not is_auto(data.near) and data.far):
        near, far = capture.bounds
        lines.append(f"near, far     {near:.4g} and {far:.4g}, {capture.bounds_reason}")
    return lines


def _of_capture(data, capture):
    """Returns {name: (value, line)} of the options that are inferred from a Capture."""
    found = {}
    if is_auto(data.factor):
        factor, width = downscaled_copies.factor_for(capture, data.width)
        found["factor"] = factor, f"factor        {factor}, of images {width} px wide"
    if is_auto(data.world):
        found["world"] = _world_of(data, capture)
    if is_auto(data.background):
        color = "white" if image_files.has_alpha(capture.frames[0].image) else "none"
        found["background"] = color, f"background    {color}"
    return found


def _world_of(data, capture):
    """Returns the world of a Capture, and the line that reports it."""
    if capture.normalised:
        return "file", ""
    forward = data.ndc is True or look_one_way(world.poses_of(capture))
    unsuited = forward and data.ndc is not True and bounds.unsuited_to_ndc(capture)
    why = f"; the cameras look one way, but {unsuited}" if unsuited else ""
    kind = "forward" if forward and not unsuited else "around"
    return kind, f"world         {kind}: {WORLDS[kind]}{why}"


def fingerprint(data: DataOptions, capture: Capture | None = None) -> str:
    """Returns a line that changes whenever the dataset's cameras, images' names, masks or splits do.

    It is empty for formats that store each split in a file of its own, whose images do not depend on the others', and
    for the embedded scene.

    Args:
        data: the options, resolved.
        capture: of the dataset; None: it is read where it is needed.
    """
    if not needs_folder(data.format) or base.has_split_files(data.format):
        return ""
    return base.fingerprint(capture or base.read_capture(dataset_folder(data.dir), data.format))


def views_shared_with_training(data: DataOptions, capture: Capture | None = None) -> dict[str, dict[str, Any]]:
    """Returns {split: {"count", "names", "note"}} of the splits "test" and "val" with views that are trained on.

    Args:
        data: the options, resolved.
        capture: of the dataset; None: it is read. If it cannot be read, nothing is known and {} is returned.
    """
    capture = capture or _readable(data)
    try:
        return {} if capture is None else found_by_split(capture, selection(data, "train"))
    except (ValueError, OSError):
        return {}


def _readable(data):
    """Returns the Capture; None if it cannot be read, which whoever reads the images reports, or if there is none."""
    try:
        return base.read_capture(dataset_folder(data.dir), data.format) if needs_folder(data.format) else None
    except (ValueError, OSError):
        return None


def resolve_near(data: DataOptions, views: Views, *, fills_space: bool) -> tuple[DataOptions, Views, list[str]]:
    """Resolves where rays start.

    In unbounded captures each image's own near follows from what it shows. No ray would then train the space between
    a camera and its near, so that another camera could see fog there.

    Args:
        data: the options, otherwise resolved.
        views: of the split "train".
        fills_space: see `Facts`.

    Returns:
        The options, the views with their near, and one line per inferred value.
    """
    if not is_auto(data.near):
        return data, views, []
    if not fills_space:
        return replaced(data, near=0.0), views, []
    unit = 1.0 if views.to_file is None else world.unit_of(views.to_file)
    distance = float(np.median(LookAt(views).distance))
    data = replaced(data, near=float(f"{_NEAR * distance * unit:.4g}"))
    near = np.float32(data.near / unit)
    line = f"near          {near:.3g} for all images, so that the space in front of each camera is trained"
    return data, dataclasses.replace(views, near=np.full_like(views.near, near)), [line]


def load_split(
    data: DataOptions,
    split: str,
    *,
    max_views: int | None = None,
    capture: Capture | None = None,
    fingerprint: str = "",
    with_pixels: bool = True,
) -> Views:
    """Reads the Views of a split of the dataset that options describe.

    With `hold_out`, some views of "train" form the split "held_out" instead. With `num_views`, "train" has only
    that many of its views, with `view_indices` those that it names. Fields that are still "auto" are resolved first.

    Args:
        data: the options.
        split: of the dataset.
        max_views: read at most so many of its views, spread evenly; None: all.
        capture: of the dataset, as `resolve` returns it; None: it is read.
        fingerprint: that the dataset has to have, see `fingerprint`; "": any.
        with_pixels: see `load_capture`.

    Raises:
        ValueError: names the field or file, what was found, what is expected and what to do.
    """
    select = selection(data, split, max_views)
    source = "train" if split == "held_out" and data.hold_out else split
    if not needs_folder(data.format):
        views = READERS.get(data.format).views(data, source)
        return views if select is None else select_views(views, select(len(views.offset)))
    data, _, found = _resolve(data)
    capture, folder = capture or found, dataset_folder(data.dir)
    if capture is None or base.has_split_files(data.format):
        capture = base.read_capture(folder, data.format, split=source)
    _check_world(data, capture)
    if fingerprint and (found := base.fingerprint(capture)) != fingerprint:
        raise ValueError(
            f"{folder}: holds {found}, expected {fingerprint} as in training: other images would be in each "
            "split, and the world would differ; restore the dataset, or train again in another --workdir"
        )
    known = bounds.known_bounds(capture)
    near = 0.0 if is_auto(data.near) else data.near  # it is resolved later, against the views
    if near and data.far and data.world != "forward":  # which scales by the nearest bound
        capture = capture._replace(bounds=(near, data.far))  # what the cameras see need not be found
    capture, to_file = _in_world(data, bounds.with_bounds(capture))
    nearest = {frame.name: frame.bounds[0] if sure else 0.0 for frame, sure in zip(capture.frames, known, strict=True)}
    # On a walk a camera sees far points past railings and walls that have none, so points do not tell what is free.
    known = () if capture.points is not None and travel(world.poses_of(capture)) else known
    capture = bounds.override_bounds(capture, near, data.far, to_file)
    background = background_of(data)
    options = {"factor": data.factor, "background": background, "select": select, "with_pixels": with_pixels}
    views = load_images.load_capture(capture, split=source, **options)
    return dataclasses.replace(
        views,
        to_file=None if capture.normalised else np.float32(to_file),
        file_origin=(0.0, 0.0, 0.0) if capture.origin is None else tuple(map(float, capture.origin)),
        box=None if capture.box is None else np.float32(capture.box),
        free_depth=np.float32([nearest[name] for name in views.names]) if any(known) else None,
    )


def _in_world(data, capture):
    """Returns a Capture with bounds in every frame in the world of resolved options, and [4, 4] back to the file's."""
    if data.world == "forward":
        if data.ndc and not look_one_way(world.poses_of(capture), cosine=0.5):
            raise ValueError(
                f"{dataset_folder(data.dir)}: data.ndc is True and the cameras look in all directions, expected one "
                "direction; set data.ndc to False"
            )
        return world.recenter(capture)
    if data.world == "around":
        return world.center(capture, up=axis_of(data.up) if data.up else None)
    return capture, np.eye(4)


def is_there(data: DataOptions) -> bool:
    """Returns whether the dataset has a folder that exists, or needs none."""
    try:
        return not needs_folder(data.format) or dataset_folder(data.dir).is_dir()
    except ValueError:
        return False


def dataset_folder(name: str) -> pathlib.Path:
    """Returns the folder of that path, or else of that name below $JAXNERF_SCENES; ValueError if neither exists."""
    scenes = os.environ.get("JAXNERF_SCENES")
    places = [pathlib.Path(name)] + ([pathlib.Path(scenes, name)] if scenes else [])
    found = [place for place in places if name and place.is_dir()]
    if not found:
        searched = " or ".join(dict.fromkeys(str(place.absolute()) for place in places)) if name else "nothing"
        raise ValueError(f"data.dir is {name!r}: no such folder, searched {searched}; set it with --data_dir")
    return found[0]


def background_of(data: DataOptions) -> tuple[float, float, float] | None:
    """Returns the colour behind alpha, or None where alpha is dropped."""
    return BACKGROUNDS[data.background]


def conventions(data: DataOptions, capture: Capture | None = None) -> dict[str, Any]:
    """Returns what an evaluation protocol records about how views are read.

    Args:
        data: the options, resolved.
        capture: of the dataset; None: it is read.

    Returns:
        The values of options; "test_split", in words which views are tested; and the test views that are trained on.
    """
    found = {name: getattr(data, name) for name, (each, _) in declarations(DataOptions).items() if each.protocol}
    found = {name: list(value) if isinstance(value, tuple) else value for name, value in found.items()}  # as in JSON
    if capture := capture or _readable(data):
        found["test_split"] = load_images.split_rule(capture)
    shared = views_shared_with_training(data, capture)
    return found | ({"shared_with_training": shared} if shared else {})


def _check_world(data, capture):
    worlds = ("file",) if capture.normalised else tuple(WORLDS)
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
