"""Which format the capture in a folder has."""

from pathlib import Path

from jaxnerf.data import blender, colmap, llff, transforms

READERS = {  # in the order in which they are looked for
    "blender": blender.read_capture,
    "transforms": transforms.read_capture,
    "colmap": colmap.read_capture,
    "llff": llff.read_capture,
}


def formats_in(folder):
    """Returns the names of the formats whose files lie in a folder, the one that counts first.

    Raises:
        ValueError: if there is none.
    """
    folder = Path(folder)
    there = {
        "blender": (folder / "transforms_train.json").is_file(),
        "transforms": (folder / "transforms.json").is_file(),
        "colmap": bool(colmap.models_in(folder)),
        "llff": (folder / "poses_bounds.npy").is_file(),
    }
    found = [name for name, is_there in there.items() if is_there]
    if not found:
        raise ValueError(
            f"{folder}: holds no capture, wanted transforms_train.json (Blender), transforms.json, a COLMAP "
            "model in sparse/0, or poses_bounds.npy (LLFF); correct the folder"
        )
    return found


def read_capture(folder, format="auto"):
    """Returns the Capture in a folder, in a given format or in the first that is found.

    Raises:
        ValueError: names the file, what was found, what was wanted and what to do.
    """
    if format != "auto" and format not in READERS:
        raise ValueError(f"data.format is {format!r}, wanted 'auto' or one of {', '.join(READERS)}")
    return READERS[formats_in(folder)[0] if format == "auto" else format](folder)
