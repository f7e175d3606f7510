"""Copies scenes to a folder of limited size, to be carried to a machine that cannot reach them.

    python experiments/gpu/pack.py --scenes=lego --to=.gpu/scenes [--megabytes=56]

A scene of the Blender format that does not fit keeps as many training views as do, evenly spread, and the program
names how many; all other scenes are copied whole. There, JAXNERF_SCENES names the copy.
"""

import json
import os
import pathlib
import shutil
import sys

import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
from jaxnerf.runtime import cli
from jaxnerf.runtime.atomic_files import write_text

_SCENES = flags.DEFINE_list("scenes", ["lego"], "Folders below $JAXNERF_SCENES.")
_TO = flags.DEFINE_string("to", ".gpu/scenes", "The folder to write; it must not exist.")
_MEGABYTES = flags.DEFINE_float("megabytes", 56.0, "The size of the folder, 2^20 bytes.", lower_bound=0.0)
_TRAINING = "transforms_train.json"


def main(argv: list[str]) -> None:
    """Copies the scenes."""
    del argv
    source, target = os.environ.get("JAXNERF_SCENES"), pathlib.Path(_TO.value)
    if not source:
        raise ValueError("JAXNERF_SCENES is unset; set it to the folder of the scenes")
    if target.exists():
        raise ValueError(f"{target}: exists already; remove it, or give another --to")
    left = _MEGABYTES.value * 2**20
    for name in _SCENES.value:
        left -= pack(pathlib.Path(source) / name, target / name, left)


def pack(source: pathlib.Path, target: pathlib.Path, space_left: float) -> int:
    """Copies a scene, or the part of it that fits into so many bytes; returns its bytes and prints a line.

    Raises:
        ValueError: if there is no such scene, or not even a part of it fits.
    """
    if not source.is_dir():
        raise ValueError(f"{source}: no such folder; correct --scenes or JAXNERF_SCENES")
    files = {path: path.stat().st_size for path in sorted(source.rglob("*")) if path.is_file()}
    size, note = sum(files.values()), ""
    if size > space_left:
        files, frames, count = _fewer_views(source, files, space_left)
        size, note = sum(files.values()), f", {len(frames)} of {count} training views"
    for path in files:
        copy = target / path.relative_to(source)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)
    if note:
        content = json.loads((source / _TRAINING).read_text())
        write_text(target / _TRAINING, json.dumps(content | {"frames": frames}))
    print(f"{source.name}: {size / 2**20:.1f} MiB{note}")
    return size


def _fewer_views(source, files, space_left):
    """Returns the files that fit, with their sizes; the frames of the training views among them; how many there were"""
    path = source / _TRAINING
    frames = json.loads(path.read_text())["frames"] if path.exists() else []
    images = [source / os.path.normpath(f"{frame['file_path']}.png") for frame in frames]
    others = {path: size for path, size in files.items() if path not in images}
    free = space_left - sum(others.values())
    for count in range(len(frames) - 1, 0, -1):
        chosen = np.linspace(0, len(frames) - 1, count).round().astype(int)
        kept = {images[index]: files[images[index]] for index in chosen if images[index] in files}
        if sum(kept.values()) <= free:
            return others | kept, [frames[index] for index in chosen], len(frames)
    needed = sum(files.values()) / 2**20
    raise ValueError(
        f"{source}: has {needed:.1f} MiB, and {space_left / 2**20:.1f} are left; name fewer --scenes, or raise "
        "--megabytes"
    )


if __name__ == "__main__":
    cli.run(main)
