"""How long a start takes, from the command to the end of its first step: the first, a second, another seed.

    taskset -c 0 python experiments/startup.py [--configs=quickstart,lego_small,lego_fast] [--data_dir=lego] \
        [--repeats=3] [--readme=README.md]

Each configuration begins with an empty cache folder of its own; later starts find what the first left there,
and their median is shown. Whoever wants one core says so, as above. With --readme the table between
<!-- startup --> and <!-- end of startup --> in that file is replaced.
"""

import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

import paired_runs
import table  # which defines --readme
from absl import flags

from jaxnerf.runtime import cli

MARKS = ("<!-- startup -->", "<!-- end of startup -->")
HEADS = ("config", "first start", "of it compiling", "second start", "another seed")
_CONFIGS = flags.DEFINE_list("configs", ["quickstart", "lego_small", "lego_fast"], "Names of configurations.")
_DATA_DIR = flags.DEFINE_string("data_dir", "lego", "Capture of those that have none of their own.")
_REPEATS = flags.DEFINE_integer("repeats", 3, "Starts of a kind after the first.", lower_bound=1)
_ROOT = pathlib.Path(__file__).resolve().parent.parent


def main(argv):
    """Starts each configuration several times and prints the table."""
    del argv
    known = sorted(file.stem for file in (_ROOT / "configs").glob("*.py"))
    wrong = [config for config in _CONFIGS.value if config not in known]
    if wrong:
        raise ValueError(f"--configs has {wrong[0]!r}, wanted some of {', '.join(known)}")
    rows = []
    for config in _CONFIGS.value:
        with tempfile.TemporaryDirectory() as folder:
            first, compiling = start(config, pathlib.Path(folder), 0)
            again = [
                statistics.median(start(config, pathlib.Path(folder), seed)[0] for _ in range(_REPEATS.value))
                for seed in (0, 1)
            ]
        rows.append((f"`{config}`", *(f"{value:.1f} s" for value in (first, compiling, *again))))
    lines = table.markdown(HEADS, rows)
    print("\n".join(lines))
    if flags.FLAGS.readme:
        table.replace(pathlib.Path(flags.FLAGS.readme), lines, MARKS)


def start(config, cache, seed):
    """Returns the seconds of a training process up to the end of its first step, and those of compiling."""
    with tempfile.TemporaryDirectory() as workdir:
        fields = (f"seed={seed}", "train.max_steps=1", "train.log_every=1", "eval.at_end=False")
        synthetic = paired_runs.configuration(config).data.format == "synthetic"
        command = [
            *(sys.executable, "-u", "-m", "jaxnerf.train", f"--config=configs/{config}.py"),
            *(f"--config.{field}" for field in fields),
            *(f"--workdir={workdir}/run", *([] if synthetic else [f"--data_dir={_DATA_DIR.value}"])),
        ]
        environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_COMP")}
        environment |= {"XDG_CACHE_HOME": str(cache)}
        began, said, seconds, compiling = time.perf_counter(), [], None, None
        with subprocess.Popen(
            command, cwd=_ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as process:
            for line in process.stdout:
                said.append(line)
                if line.startswith("1/1"):
                    seconds = time.perf_counter() - began
                if "compiled in" in line:
                    compiling = float(line.split("compiled in")[1].split()[0])
    if process.returncode or seconds is None:
        raise ValueError(f"{config}: training did not come to its first step: {''.join(said[-3:]).strip()}")
    return seconds, compiling


if __name__ == "__main__":
    cli.run(main, stopped="and changed nothing")
