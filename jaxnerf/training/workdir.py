"""The folder of a run: which configuration it belongs to, files that are whole or not there."""

import contextlib
import json
import os
import pathlib

from ml_collections import ConfigDict

# What may change between the starts of one run, as it changes no step that was taken.
FREE = (
    "data.dir",
    "train.max_steps",
    "train.max_seconds",
    "train.log_every",
    "train.save_every",
    "train.max_to_keep",
)
FREE += ("train.microbatch_size", "train.parallel", "train.max_nonfinite", "train.max_reinits", "eval.")
SECTIONS = ("data", "coarse", "fine", "sampling", "train", "eval")


def claim(workdir, config):
    """Writes the configuration into a new workdir, or checks that an old one belongs to it.

    Raises:
        ValueError: if the workdir's run had another configuration; names the fields that differ.
    """
    path = pathlib.Path(workdir) / "config.json"
    if path.exists():
        old, new = _flat(read_config(workdir)), _flat(config)
        keys = sorted(key for key in old.keys() | new.keys() if old.get(key) != new.get(key))
        fixed = [key for key in keys if not key.startswith(FREE)]
        if fixed:
            shown = ", ".join(f"{key} {old.get(key)!r} -> {new.get(key)!r}" for key in fixed[:3])
            more = f" and {len(fixed) - 3} more" if len(fixed) > 3 else ""
            raise ValueError(
                f"{workdir}: belongs to a run with another configuration ({shown}{more}); "
                "give another --workdir, or the old configuration to go on"
            )
    elif (path.parent / "checkpoints").exists():
        raise ValueError(f"{workdir}: has checkpoints but no config.json; give another --workdir")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, config.to_json_best_effort(indent=2) + "\n")


def read_config(workdir):
    """Returns the configuration of the run in a workdir; ValueError if there is none."""
    path = pathlib.Path(workdir) / "config.json"
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file, wanted the workdir of a training run; correct --workdir") from None
    except ValueError as error:
        raise ValueError(f"{path}: malformed JSON ({error}); restore it or train anew") from None
    if not isinstance(content, dict) or not all(isinstance(content.get(name), dict) for name in SECTIONS):
        raise ValueError(f"{path}: holds no configuration, wanted an object with {SECTIONS}; restore it or train anew")
    return ConfigDict(content, type_safe=False)  # JSON does not tell the types of "auto" fields


def write_text(path, text):
    """Writes a text file so that it is there whole or not at all, after a loss of power too."""
    path = pathlib.Path(path)
    partial = path.with_name(path.name + ".tmp")
    try:
        with naming(path), partial.open("w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def naming(path):
    """Adds a path to errors of the system that name none, as while writing to a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


def _flat(config):
    flat = {}
    for section, values in json.loads(config.to_json_best_effort()).items():
        fields = values.items() if isinstance(values, dict) else [(None, values)]
        flat.update({f"{section}.{key}" if key else section: value for key, value in fields})
    return flat
