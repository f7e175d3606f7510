"""The cameras of the training images, kept in the workdir: a run is rendered and exported without its dataset."""

import contextlib
import dataclasses
import io
import json
import os
import pathlib
import zipfile
from collections.abc import Callable

import numpy as np

from jaxnerf.core.types import Camera
from jaxnerf.core.views import Views
from jaxnerf.data import dataset
from jaxnerf.options import values_of
from jaxnerf.runtime import atomic_files
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.training.config import RunConfig
from jaxnerf.training.workdir import load_config

FILE = "cameras.npz"
_MAX_SIZE = 2**28  # bytes of all arrays; masks have a bit for each pixel
_APART = ("pixels", "cameras", "sparse")  # fields of Views that are dropped, or stored one by one
_AGAIN = "remove it, and it is made again from the dataset"


def save(workdir: str | os.PathLike, config: RunConfig, views: Views) -> None:
    """Writes the cameras of the split "train" of a resolved config: kilobytes, and the masks of images that have some.

    Raises:
        OSError: with the path.
    """
    values = {name: getattr(part, name) for part in (views, views.cameras) for name in _fields(part)}
    values |= {"channels": views.pixels.shape[1], "dtype": views.pixels.dtype.name, "key": _key(config)}
    values["mask"] = None if views.mask is None else np.packbits(np.asarray(views.mask))
    arrays = {name: np.asarray(value) for name, value in values.items() if hasattr(value, "shape")}
    about = json.dumps({name: value for name, value in values.items() if name not in arrays})
    with atomic_files.partial_file(pathlib.Path(workdir) / FILE) as partial, partial.open("wb") as file:
        np.savez_compressed(file, about=about, checksum=_checksum(about, arrays), **arrays)


def training_views(workdir: str | os.PathLike, read: Callable[[], Views] | None = None) -> Views:
    """Returns the Views of the split "train" that a run was trained on, without pixels and sparse points.

    They come from the file that `save` has written, or else from the run's dataset, and are then written; where
    there is neither, from read().

    Raises:
        ValueError: if the file is damaged, or of another run and the dataset is not there; if nothing is there.
    """
    config, path = load_config(workdir), pathlib.Path(workdir) / FILE
    if path.exists():
        views, key = _read(path)
        if key == _key(config):
            return views
        if not dataset.is_there(config.data):
            raise ValueError(f"{path}: is of a run with other data or another scene than config.json; give --data_dir")
    if read is not None and not dataset.is_there(config.data):
        return read()
    views = dataset.load_split(config.data, "train", fingerprint=config.fingerprint)
    with contextlib.suppress(OSError):  # the workdir may be someone else's
        save(workdir, config, views)
    return without_images(views)


def without_images(views: Views) -> Views:
    """Returns Views without pixels and sparse points, which still tell whether there is alpha."""
    return dataclasses.replace(views, pixels=np.zeros((0, *views.pixels.shape[1:]), views.pixels.dtype), sparse=None)


def is_of_run(workdir: str | os.PathLike, config: RunConfig) -> bool:
    """Returns whether a config reads the views that the run in a workdir was trained on."""
    return _key(config) == _key(load_config(workdir))


def _fields(part):
    return [field.name for field in dataclasses.fields(part) if field.name not in _APART]


def _key(config):
    parts = {**values_of(config.data), "dir": ""}, config.scene.lower, config.scene.upper, config.fingerprint
    return fingerprint(json.dumps(parts, sort_keys=True, default=str))


def _checksum(about, arrays):
    return fingerprint(about, *[each for name in sorted(arrays) for each in (name, arrays[name])])


def _read(path):
    try:
        content = io.BytesIO(atomic_files.read_bytes(path))
        if sum(each.file_size for each in zipfile.ZipFile(content).infolist()) > _MAX_SIZE:
            raise ValueError("it is too large")
        with np.load(content, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        about, checksum = str(arrays.pop("about")), str(arrays.pop("checksum"))
        if checksum != _checksum(about, arrays):
            raise ValueError("its numbers are not those that were saved")
        about = atomic_files.parse_json(about)
        views = _views_of(about, arrays)
    except Exception as error:  # a damaged zip file raises almost any exception
        reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
        raise ValueError(f"{path}: is damaged ({reason}), expected what training writes; {_AGAIN}") from None
    return views, about["key"]


def _views_of(about, arrays):
    """Makes Views of what a file holds, which may be a stranger's."""
    values, size, mask = {**about, **arrays}, arrays["size"], arrays.pop("mask", None)
    count, total = len(size), int(size.astype(np.int64).prod(axis=1).sum())
    axes = {"to_world": (3, 4), "distortion": (-1,), **dict.fromkeys(("size", "focal", "center"), (2,))}
    shapes = {name: (count, *axis) for name, axis in axes.items()} | {"box": (2, 3), "to_file": (4, 4)}
    for name, array in arrays.items():
        expected = tuple(m if n < 0 else n for n, m in zip(shapes.get(name, (count,)), array.shape, strict=True))
        if array.shape != expected or array.dtype.kind not in "iuf" or np.isnan(array).any():
            raise ValueError(f"{name} is {array.dtype}{list(array.shape)}, expected numbers {list(expected)}")
    names, behind = tuple(map(str, values["names"])), values["background"]
    if len(names) not in (0, count) or not 1 <= size.min() <= size.max() < 2**16:
        raise ValueError(f"it has {count} images, {len(names)} names, and sizes from {size.min()} px")
    arrays["mask"] = None if mask is None else np.unpackbits(mask, count=total).astype(bool)
    statics = {"names": names, "background": behind and tuple(map(float, behind)), "lens": str(values["lens"])}
    statics |= {"file_origin": tuple(map(float, values["file_origin"])), "height": None, "width": None}
    statics |= {side: int(about[side]) for side in ("height", "width") if about[side] is not None}
    required = {name: arrays[name] for name in ("to_world", "focal", "center", "near", "far", "offset")}
    found = {name: None for name in (*_fields(Views), *_fields(Camera))} | arrays | required | statics
    cameras = Camera(**{name: found[name] for name in _fields(Camera)})
    pixels = np.zeros((0, int(about["channels"])), np.dtype(about["dtype"]))
    return Views(pixels=pixels, cameras=cameras, **{name: found[name] for name in _fields(Views)})
