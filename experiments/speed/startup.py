"""Measures the time from the command to the end of the first step: first start, second start, another seed.

    taskset -c 0 python experiments/speed/startup.py [--configs=quickstart,lego_small,lego_fast] [--data_dir=lego] \
        [--repeats=3] [--page=FILE.md]

Each config begins with an empty cache folder of its own. Later starts find what the first one left there; their
median is shown. `taskset` selects the cores. With --page the table between <!-- startup --> and
<!-- end of startup --> in that file is replaced.
"""

import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.runtime import cli
from jaxnerf.training.metric_log import read_rows

HEADS = ("config", "first start", "of it compiling", "second start", "another seed")
_CONFIGS = flags.DEFINE_list("configs", ["quickstart", "lego_small", "lego_fast"], "Names of configs.")
_DATA_DIR = flags.DEFINE_string("data_dir", "lego", "Dataset of the configs that do not use the embedded scene.")
_REPEATS = flags.DEFINE_integer("repeats", 3, "Number of starts of each kind after the first.", lower_bound=1)


def main(argv: list[str]) -> None:
    """Starts each config several times and prints the table."""
    del argv
    rows = []
    for config in common.chosen("--configs", _CONFIGS.value, cli.config_names()):
        with tempfile.TemporaryDirectory() as folder:
            first, compiling = start(config, pathlib.Path(folder), 0)
            later = [
                statistics.median(start(config, pathlib.Path(folder), seed)[0] for _ in range(_REPEATS.value))
                for seed in (0, 1)
            ]
        rows.append((f"`{config}`", *(f"{value:.1f} s" for value in (first, compiling, *later))))
    common.publish(common.markdown(HEADS, rows), "startup")


def start(config: str, cache: pathlib.Path, seed: int) -> tuple[float, float]:
    """Returns the seconds of a training process up to the end of its first step, and those of compiling.

    Raises:
        ValueError: if the process fails or never reaches its first step; quotes its last lines.
    """
    with tempfile.TemporaryDirectory() as workdir:
        fields = (f"seed={seed}", "train.max_steps=1", "train.log_every=1", "eval.at_end=False")
        synthetic = common.configuration(config).data.format == "synthetic"
        command = [
            *(sys.executable, "-u", "-m", "jaxnerf.train", f"--config=configs/{config}.py"),
            *(f"--config.{field}" for field in fields),
            *(f"--workdir={workdir}/run", *([] if synthetic else [f"--data_dir={_DATA_DIR.value}"])),
        ]
        environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_COMP")}
        environment |= {"XDG_CACHE_HOME": str(cache)}
        began, output, seconds = time.perf_counter(), [], None
        with subprocess.Popen(
            command, cwd=common.ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as process:
            for line in process.stdout:
                output.append(line)
                if line.startswith("1/1"):
                    seconds = time.perf_counter() - began
        if process.returncode or seconds is None:
            raise ValueError(f"{config}: training did not reach its first step: {''.join(output[-3:]).strip()}")
        return seconds, read_rows(f"{workdir}/run")[-1]["compile_seconds"]


if __name__ == "__main__":
    cli.run(main, stopped="and changed nothing")
