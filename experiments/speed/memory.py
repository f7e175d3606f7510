"""Measures where the memory and the time of a training program go, stage by stage.

    JAXNERF_SCENES=... taskset -c 0 python experiments/speed/memory.py --data_dir=can \
        [--config=capture] [--seconds=60] [--at_end] [--page=FILE.md]

The program is started twice: with empty caches, and with those that the first start leaves. The resident memory and the
CPU time of its process are sampled 50 times a second, and added up by the stage that it is in: those that the program
itself reports, "start" before the first one, "training" between reading the checkpoint and saving the last one, and
"other" between the others. With --page the table between <!-- memory --> and <!-- end of memory --> in that file is
replaced. It needs Linux.
"""

import json
import os
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.runtime import cli

HEADS = ("stage", "s", "CPU s", "MB at its end", "peak MB")
COLUMNS = (*(f"first start: {head}" if head != "stage" else head for head in HEADS), *HEADS[1:])
_CONFIG = flags.DEFINE_string("config", "capture", "Name of a config.")
_DATA_DIR = flags.DEFINE_string("data_dir", "can", "Dataset, of a config that has none.")
_SECONDS = flags.DEFINE_float("seconds", 60.0, "Seconds of training.", lower_bound=0.1)
_AT_END = flags.DEFINE_bool("at_end", True, "Whether the program scores the test views when it has trained.")
_TRAINING, _LAST, _SAVING = "training", "reading the checkpoint", "saving the checkpoint"


def main(argv: list[str]) -> None:
    """Starts the program twice, and prints the table."""
    del argv
    common.chosen("--config", [_CONFIG.value], cli.config_names())
    with tempfile.TemporaryDirectory() as folder:
        starts = [by_stage(traced(pathlib.Path(folder), index)) for index in range(2)]
    common.publish([*common.provenance(), "", *table(*starts)], "memory")


def traced(folder: pathlib.Path, index: int) -> list[dict[str, Any]]:
    """Returns the samples of a start, see traced_train.py; raises ValueError if the program fails."""
    trace = folder / f"{index}.json"
    synthetic = common.configuration(_CONFIG.value).data.format == "synthetic"
    fields = {"train.max_seconds": _SECONDS.value, "train.preview_every": 0.0, "eval.at_end": _AT_END.value}
    command = [
        *(sys.executable, pathlib.Path(__file__).with_name("traced_train.py"), trace),
        *(f"--config={_CONFIG.value}", f"--workdir={folder}/run_{index}"),
        *(f"--config.{name}={value}" for name, value in fields.items()),
        *([] if synthetic else [f"--data_dir={_DATA_DIR.value}"]),
    ]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_COMP")}
    environment |= {"XDG_CACHE_HOME": str(folder / "cache")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ValueError(f"training failed: {' '.join(done.stderr.split()[-40:])}")
    return json.loads(trace.read_text())


def by_stage(samples: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Returns what each stage took, {stage: {head: number}} in the order in which they begin; "whole program" last."""
    found, name, before = {}, "start", {"seconds": 0.0, "cpu": 0.0}
    for sample in samples:
        name = sample["stage"] or _unnamed(name)
        each = [found.setdefault(stage, dict.fromkeys(HEADS[1:], 0.0)) for stage in (name, "whole program")]
        for values in each:
            values["s"] += sample["seconds"] - before["seconds"]
            values["CPU s"] += sample["cpu"] - before["cpu"]
            values["MB at its end"] = sample["mb"]
            values["peak MB"] = max(values["peak MB"], sample["mb"])
        before = sample
    found["whole program"] = found.pop("whole program")
    return found


def _unnamed(before):
    """Returns the name of what the program does between stages."""
    return {"start": "start", _LAST: _TRAINING, _TRAINING: _TRAINING}.get(before, "other")


def table(first: Mapping[str, Mapping[str, float]], second: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Returns the lines of the table of two starts, a row for each stage."""
    rows = []
    for name in [*(name for name in first if name != "whole program"), "whole program"]:
        cells = [name]
        for start in (first, second):
            values = start.get(name)
            texts = values and [
                f"{values[head]:.1f}" if "s" in head.split() else f"{values[head]:,.0f}" for head in HEADS[1:]
            ]
            cells += texts or ["-"] * 4
        rows.append(cells)
    return common.markdown(COLUMNS, rows)


if __name__ == "__main__":
    cli.run(main, stopped="and changed nothing")
