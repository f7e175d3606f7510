"""The folder of a run: its config.json, and a lock that lets one training at a time write there."""

import contextlib
import json
import os
import pathlib
import socket
import sys
import time
from collections.abc import Iterator

from ml_collections import ConfigDict

from jaxnerf.configs import default
from jaxnerf.runtime import atomic_files

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

# A run may be resumed with other values of these fields and sections, as finished steps do not depend on them: some
# only say how others are inferred.
CHANGEABLE = (
    "data.dir",
    "train.max_steps",
    "train.max_seconds",
    "train.log_every",
    "train.save_every",
    "train.max_to_keep",
    "hash_grid.compute_dtype",
    "occupancy.update_chunk",
    "train.microbatch_size",
    "train.steps_per_dispatch",
    "train.parallel",
    "train.cpu_batch_size",
    "occupancy.cpu_pool_samples_per_ray",
    "train.max_nonfinite",
    "train.max_reinits",
    "train.preview_every",
    "eval.",
)
# Fields that older versions had, and the value with which they trained as this one does.
_REMOVED = {"occupancy.near_gradient_distance": 0.0}
_FOLDERS = ("checkpoints", "previews", "eval", "tensorboard")  # that training writes to
SECTIONS = ("data", "coarse", "fine", "sampling", "hash_grid", "occupancy", "losses", "train", "eval")


def claim(workdir: str | os.PathLike, config: ConfigDict) -> None:
    """Writes a resolved config into a new workdir, or checks that it belongs to the run in an existing one.

    The caller holds the `workdir_lock`. Partial files of killed processes are removed.

    Raises:
        ValueError: if the run in the workdir has another config; names the fields that differ.
    """
    path = pathlib.Path(workdir) / "config.json"
    if path.exists():
        old, new = _flat(read_config(workdir)), _flat(config)
        keys = sorted(key for key in old.keys() | new.keys() if old.get(key) != new.get(key))
        fixed = [key for key in keys if not key.startswith(CHANGEABLE)]
        unknown = [key for key in fixed if key not in old]
        if unknown:
            raise ValueError(
                f"{workdir}: belongs to a run of another version, whose config lacks {', '.join(unknown[:3])}; resume "
                "it with that version, or give another --workdir. It can still be evaluated, rendered and exported"
            )
        gone = [key for key, value in _REMOVED.items() if old.get(key, value) != value]
        if gone:
            raise ValueError(
                f"{workdir}: belongs to a run of another version, whose {gone[0]} no longer exists; resume it with "
                "that version, or give another --workdir. It can still be evaluated, rendered and exported"
            )
        if fixed:
            shown = ", ".join(f"{key} {old.get(key)!r} -> {new.get(key)!r}" for key in fixed[:3])
            more = f" and {len(fixed) - 3} more" if len(fixed) > 3 else ""
            raise ValueError(
                f"{workdir}: belongs to a run with another config ({shown}{more}); "
                "give another --workdir, or resume with the old config"
            )
    elif (path.parent / "checkpoints").exists():
        raise ValueError(f"{workdir}: has checkpoints but no config.json; give another --workdir")
    path.parent.mkdir(parents=True, exist_ok=True)
    for name in ("config.json", "metrics.jsonl"):
        for partial in path.parent.glob(f"{name}.*.tmp"):
            if not partial.is_dir():
                partial.unlink(missing_ok=True)
    atomic_files.write_text(path, config.to_json_best_effort(indent=2) + "\n")


def read_config(workdir: str | os.PathLike) -> ConfigDict:
    """Reads the config of the run in a workdir; raises ValueError if there is none."""
    path = pathlib.Path(workdir) / "config.json"
    try:
        content = atomic_files.read_json(path, "restore it or train again")
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file, expected the workdir of a training run; correct --workdir") from None
    if not isinstance(content, dict) or not all(isinstance(content.get(name), dict) for name in SECTIONS):
        raise ValueError(f"{path}: is not a config, expected an object with {SECTIONS}; restore it or train again")
    return ConfigDict(content, type_safe=False)  # JSON does not hold the types of "auto" fields


def config_to_resume(workdir: str | os.PathLike) -> ConfigDict:
    """Reads the config of the run in a workdir with the types of configs/default.py, so that flags can set its fields.

    Fields that an older version did not have get the default; `claim` rejects them if finished steps depend on them.
    """
    config = default.get_config()
    with config.ignore_type():  # JSON has lists for tuples
        config.update(read_config(workdir))
    return config


def _flat(config):
    """Returns {"section.field": value} as JSON holds it."""
    flat = {}
    for section, values in json.loads(config.to_json_best_effort()).items():
        fields = values.items() if isinstance(values, dict) else [(None, values)]
        flat.update({f"{section}.{key}" if key else section: value for key, value in fields})
    return flat


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
