"""The folder of a run: its config.json, and a lock that lets one training at a time write there."""

import contextlib
import json
import os
import pathlib
import socket
import sys
import time
from collections.abc import Iterator
from typing import Any

from ml_collections import ConfigDict

from jaxnerf.options import Changes
from jaxnerf.registry import LOSSES
from jaxnerf.runtime import atomic_files
from jaxnerf.training.config import RunConfig, changed, declared, flatten, read_config, to_config_dict
from jaxnerf.training.earlier_options import in_todays_names, refuse

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

_FOLDERS = ("checkpoints", "previews", "eval", "tensorboard")  # that training writes to


def save_config(workdir: str | os.PathLike, config: RunConfig) -> None:
    """Writes a resolved config into a new workdir, or checks that it belongs to the run in an existing one.

    The caller holds the `workdir_lock`. Partial files of killed processes are removed.

    Raises:
        ValueError: if the run in the workdir has another config; names the options that differ.
    """
    path = pathlib.Path(workdir) / "config.json"
    if path.exists():
        _check_same_run(workdir, config)
    elif (path.parent / "checkpoints").exists():
        raise ValueError(f"{workdir}: has checkpoints but no config.json; give another --workdir")
    path.parent.mkdir(parents=True, exist_ok=True)
    for name in ("config.json", "metrics.jsonl", "cameras.npz"):
        for partial in path.parent.glob(f"{name}.*.tmp"):
            if not partial.is_dir():
                partial.unlink(missing_ok=True)
    atomic_files.write_text(path, config.to_json() + "\n")


def _check_same_run(workdir, config):
    content, left = _saved(workdir)
    refuse(left, f"{workdir}: belongs to a run of another version, whose ", Changes.TRAINING)
    old, new = (_without_unused_losses(flatten(json.loads(each.to_json()))) for each in (read_config(content), config))
    free = {name for name, option, _, _ in declared(config) if not option.changes & Changes.TRAINING}
    fixed = [key for key in sorted(old.keys() | new.keys()) if old.get(key) != new.get(key) and key not in free]
    if "fingerprint" in fixed:
        raise ValueError(
            f"{workdir}: the dataset holds {config.fingerprint or 'other images'}, expected {old.get('fingerprint')} "
            "that the run was trained on; restore the dataset, or give another --workdir"
        )
    if fixed:
        shown = ", ".join(f"{key} {old.get(key)!r} -> {new.get(key)!r}" for key in fixed[:3])
        more = f" and {len(fixed) - 3} more" if len(fixed) > 3 else ""
        raise ValueError(
            f"{workdir}: belongs to a run with another config ({shown}{more}); "
            "give another --workdir, or resume with the old config"
        )


def saved_options(workdir: str | os.PathLike) -> dict[str, Any]:
    """Returns {"section.option": value} of the run in a workdir as JSON has it, without losses of weight 0.

    Unlike `load_config` it needs neither the modules that register the run's parts nor the memory that a run takes.

    Raises:
        ValueError: if there is no run; names the file.
    """
    return _without_unused_losses(flatten(_saved(workdir)[0]))


def _without_unused_losses(flat):
    """Returns {"section.option": value} without losses of weight 0: plug-ins may have added some."""
    return {name: value for name, value in flat.items() if not (name.startswith("losses.") and value == 0)}


def load_config(workdir: str | os.PathLike, **values: Any) -> RunConfig:
    """Reads the config of the run in a workdir, with other values of some sections' options: section={option: value}.

    Raises:
        ValueError: if there is no run; names the file.
    """
    content, left = _saved(workdir)
    refuse(left, f"{workdir}: ", Changes.IMAGES)
    try:
        config = read_config(content)
    except ValueError as error:
        if not str(error).startswith("--config."):
            raise
        where = pathlib.Path(workdir) / "config.json"
        raise ValueError(f"{where}: {str(error).removeprefix('--config.')}, or use the version that wrote it") from None
    return changed(config, flatten(values)) if values else config


def load_config_dict(path: str | os.PathLike) -> ConfigDict:
    """Reads the config.json of a run as a ConfigDict, whose fields flags may set.

    Raises:
        ValueError: if the file has another name, or is none.
    """
    path = pathlib.Path(path)
    if path.name != "config.json":
        raise ValueError(f"--config={path} is not a run's config.json; give that, a name, or a Python file")
    return to_config_dict(load_config(path.parent))


def _saved(workdir):
    """Returns the content of a config.json in today's names, and its options that are gone, see `in_todays_names`.

    What it lacks was added after it was written, or registered since: losses are off, and other options on which
    training does not depend have their defaults.
    """
    path = pathlib.Path(workdir) / "config.json"
    try:
        content = atomic_files.read_json(path, "restore it or train again")
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file, expected the workdir of a training run; correct --workdir") from None
    if not isinstance(content, dict) or not isinstance(content.get("train"), dict):
        raise ValueError(f"{path}: is not a config, expected what training has written; restore it or train again")
    content, left = in_todays_names(content)
    added = {name: value for name, option, _, value in declared(RunConfig()) if not option.changes & Changes.TRAINING}
    for name, value in {**added, **{f"losses.{name}": 0.0 for name in LOSSES.names()}}.items():
        section, _, field = name.partition(".")
        if isinstance(content.get(section), dict):
            content[section].setdefault(field, value)
    return content, left


@contextlib.contextmanager
def workdir_lock(workdir: str | os.PathLike) -> Iterator[None]:
    """Holds a workdir, made if missing, for one training.

    The lock is a flock on the file "running", which names its holder. The system releases it however the
    process ends. Packages such as `filelock` do not name the holder.

    Raises:
        ValueError: if another process holds it, or nothing can be written there, or a symbolic link would lead
            what training writes to another place; names the folder or the link.
    """
    path = pathlib.Path(workdir) / "running"
    atomic_files.check_utf8(workdir)
    for name in _FOLDERS:
        atomic_files.check_tree(path.with_name(name))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = _locked(path)
        with atomic_files.naming(path):
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()} since {time.strftime('%F %T')}\n")
            file.flush()
    except OSError as error:
        raise ValueError(
            f"{workdir}: cannot be written ({error.strerror}); make it writable, free disk space, or give another "
            "--workdir"
        ) from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # a file that remains does not lock anybody out
            path.unlink()
        file.close()


def _locked(path):
    """Returns the file, opened and locked; raises ValueError if another process holds it."""
    while True:
        file = atomic_files.open_regular(path, "a+")
        try:
            if fcntl is None:
                raise OSError(None, "this system has no flock")
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read().strip() or "another process"
            file.close()
            raise ValueError(
                f"{path.parent}: {holder} is training there; wait for it, stop it, or give another --workdir"
            ) from None
        except OSError as error:  # as on some network file systems
            why = f"cannot be locked ({error.strerror}), so a second training there would go unnoticed"
            print(f"{path.parent}: {why}", file=sys.stderr)
            return file
        with contextlib.suppress(FileNotFoundError):
            if os.fstat(file.fileno()).st_ino == path.stat().st_ino:
                return file
        file.close()  # the previous holder has just removed it
