"""Short runs that are trained once, compiled steps, timings, tables and plots: what the studies share."""

import contextlib
import copy
import importlib
import json
import math
import os
import pathlib
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.views import Views
from jaxnerf.data import dataset
from jaxnerf.evaluation.metrics import image_metrics, pixel_mask
from jaxnerf.evaluation.supersampling import render_pixels
from jaxnerf.runtime.atomic_files import partial_file, write_text
from jaxnerf.runtime.devices import split_positions
from jaxnerf.tools.curve.machine import (  # noqa: F401
    REFERENCE_GFLOPS,
    comparable,
    matrix_gflops,
    seconds,
    times,
)
from jaxnerf.tools.curve.machine import describe as describe_machine
from jaxnerf.training import auto_config, build
from jaxnerf.training import config as run_config
from jaxnerf.training.config import RunConfig
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step

ROOT = pathlib.Path(__file__).resolve().parents[1]
_SCORED = "scored.json"  # in the workdir of a run that is trained to its end and scored
_MOST_SPLITS = 6
_splits: dict[tuple[str, str], Views] = {}
PAGE = flags.DEFINE_string(
    "page", None, "Markdown file, such as docs/results/benchmark.md, in which the tables of this study are replaced."
)


def configuration(base: str, overrides: Mapping[str, Any] | Sequence = (), *, seed: int = 0):
    """Returns the config of that name with {"section.field": value} and the seed replaced."""
    config = importlib.import_module(f"jaxnerf.configs.{base}").get_config()
    return changed(config, {**dict(overrides), "seed": seed})


def changed(config, overrides: Mapping[str, Any]):
    """Returns a copy of a config, read or not, with {"section.field": value} replaced."""
    if isinstance(config, RunConfig):
        return run_config.changed(config, overrides)
    config = copy.deepcopy(config)
    config.update_from_flattened_dict(overrides)
    return config


def run(config, folder, *, split: str | None = None) -> dict[str, Any] | None:
    """Trains a run to its end and scores it; resumes an interrupted run and does not repeat a finished one.

    Args:
        config: of the run.
        folder: its workdir.
        split: to score; the config's eval.split when None.

    Returns:
        The content of results.json, or None if Ctrl-C stopped the training, which was saved.

    Raises:
        ValueError: as `train_and_evaluate`, and if the folder holds a finished run with another config.
    """
    done = finished(config, folder, split=split)
    if done is not None:
        return done
    from jaxnerf.evaluation import evaluate, restore

    if not evaluate.train_and_evaluate(config, folder, views=load_split(config, "train")):
        return None
    views = load_split(config, split or config.eval.split)
    results = evaluate.score_run(restore.restore_run(folder), folder, split=split, overwrite=True, views=views)
    origin = {"config": plain_config(config), "split": split}
    write_text(pathlib.Path(folder) / _SCORED, json.dumps({"origin": origin, "results": results}) + "\n")
    jax.clear_caches()  # no other run has this step and this renderer
    return results


def finished(config, folder, *, split: str | None = None) -> dict[str, Any] | None:
    """Returns the results of a finished run, or None; raises ValueError if that run has another config."""
    path = pathlib.Path(folder) / _SCORED
    if not path.exists():
        return None
    kept = json.loads(path.read_text())
    origin = {"config": plain_config(config), "split": split}
    check_origin(kept["origin"], origin, folder, "give another folder, or the old settings")
    return kept["results"]


def check_origin(old: Mapping[str, Any], new: Mapping[str, Any], folder: Any, remedy: str) -> None:
    """Raises ValueError if the run in a folder has another origin, and names the first value that differs."""
    if old != new:
        old, new = _flat(old), _flat(new)
        key = next(key for key in sorted(old.keys() | new.keys()) if old.get(key) != new.get(key))
        raise ValueError(
            f"{folder}: holds a finished run with {key} {old.get(key)!r}, expected {new.get(key)!r}; {remedy}"
        )


def load_split(config, split: str) -> Views:
    """Returns the Views of a split; those used last are kept in memory."""
    data = run_config.read_config(config).data
    key = repr(data), split
    views = _splits.pop(key, None) or dataset.load_split(data, split)
    if len(_splits) == _MOST_SPLITS:
        _splits.pop(next(iter(_splits)))
    _splits[key] = views
    return views


def mean_psnr(run, variables, views: Views, *, most: int = 25) -> float:
    """Returns the mean PSNR, dB, over views of a split, at most `most` of them, evenly spread over all.

    Args:
        run: a TrainedRun.
        variables: of its checkpoint.
        views: of the split; pixels that a mask excludes do not count.
        most: number of views that are scored.
    """
    found = []
    for index in np.unique(np.linspace(0, len(views.names) - 1, most).astype(int)):
        height, width = (int(side) for side in views.size[index])
        pixels = pixel_grid(height, width, offset=run.experiment.config.data.pixel_offset)
        rgb = render_pixels(run, variables, views, index, pixels)[0].rgb
        found.append(image_metrics(rgb, views.image(index), pixel_mask(views, index))["psnr"])
    return statistics.fmean(found)


def plain_config(config) -> dict[str, Any]:
    """Returns a config as JSON holds it, without the place of the dataset."""
    plain = json.loads(run_config.read_config(config).to_json())
    return plain | {"data": {key: value for key, value in plain["data"].items() if key != "dir"}}


def _flat(tree, prefix=""):
    if not isinstance(tree, dict):
        return {prefix[:-1]: tree}
    flat = {}
    for name, part in tree.items():
        flat.update(_flat(part, f"{prefix}{name}."))
    return flat


class Step(NamedTuple):
    """A compiled training step on one device, to be timed and counted.

    Attributes:
        config: resolved.
        run: (state, data, positions) -> (state, metrics); consumes the state.
        state: at step 0.
        data: TrainData.
        positions: [microbatches, rays] int32, or [parts, microbatches, rays].
        count_flops: () -> FLOPs of the step without updates of the grid, the whole batch as one microbatch:
            XLA counts the body of a loop once, however often it runs.
    """

    config: Any
    run: Any
    state: Any
    data: Any
    positions: Any
    count_flops: Callable[[], float]


def compile_step(config, views=None, num_parts: int = 1) -> Step:
    """Compiles the training step of a config; views are those of the split "train", read when None.

    With several parts, their gradients are computed at once, as on several cores.
    """
    config, views, _ = auto_config.resolve(config, load_split(config, "train") if views is None else views)
    config, _ = auto_config.resolve_for_device(config)
    experiment = build.build(config)
    valid, data = experiment.prepare(views)
    state = create_state(experiment.model, experiment.optimizer, experiment.config.seed, valid)
    parts = experiment.model, experiment.optimizer, experiment.draw, experiment.losses
    step = make_train_step(*parts, pixel_rays=experiment.pixel_rays)
    batch, size = config.train.batch_size, config.train.microbatch_size
    if num_parts > 1:
        size = math.gcd(size or batch, batch // num_parts)
    positions = jnp.asarray(split_positions(batch, num_parts, size))
    positions = positions if num_parts > 1 else positions[0]

    def count_flops():
        no_updates = data._replace(cells=None if data.cells is None else data.cells[:0])
        return jax.jit(step).lower(state, no_updates, positions.reshape(1, -1)).compile().cost_analysis()["flops"]

    run = jax.jit(step, donate_argnums=0).lower(state, data, positions).compile()
    return Step(config, run, state, jax.device_put(data), positions, count_flops)


def spread(values: Sequence[float]) -> tuple[float, float]:
    """Returns mean and standard deviation over seeds; the deviation of a single value is NaN."""
    return statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else math.nan


def differences(scores: Mapping[int, float], others: Mapping[int, float]) -> list[float]:
    """Returns score - other for the seeds that both {seed: score} have, by ascending seed."""
    return [scores[seed] - others[seed] for seed in sorted(scores.keys() & others.keys())]


def commit() -> str:
    """Returns the commit of the working tree, with "-dirty" after it where files differ; "unknown" outside git.

    The environment variable JAXNERF_COMMIT replaces it, for a copy of the tree without its history.
    """
    if os.environ.get("JAXNERF_COMMIT"):
        return os.environ["JAXNERF_COMMIT"]
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--exclude=*"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"


@contextlib.contextmanager
def few_cores(count: int | None) -> Iterator[None]:
    """Lets the processes that are started inside use the first so many of this process's cores; all where None."""
    if count is None or not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(cores)[:count])
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def read_json(path: pathlib.Path) -> dict[str, Any]:
    """Returns the content of a JSON file, or {} if there is none."""
    return json.loads(path.read_text()) if path.exists() else {}


def write_json(path: pathlib.Path, content: Any) -> None:
    """Writes a JSON file whole or not at all; its folder is made if missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(content, indent=1) + "\n")


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Returns the lines of a table."""
    return ["| " + " | ".join(cells) + " |" for cells in (heads, ["---"] * len(heads), *rows)]


def provenance() -> list[str]:
    """Returns the lines of a table with this program's command line, the commit, today's date and the machine."""
    program = pathlib.Path(sys.argv[0]).resolve().relative_to(ROOT)
    command = " ".join(["python", str(program), *sys.argv[1:]])
    row = (f"`{command}`", f"{commit()}, {time.strftime('%F')}", describe_machine())
    return markdown(("command", "commit", "machine"), [row])


def publish(lines: Sequence[str], name: str) -> None:
    """Prints the lines of a study; with --page replaces the table of that name in the file, too."""
    print("\n".join(lines))
    if PAGE.value:
        replace(pathlib.Path(PAGE.value), lines, name)


def replace(path: pathlib.Path, lines: Sequence[str], name: str) -> None:
    """Replaces the lines between <!-- name --> and <!-- end of name --> (or <!-- /name -->) in a file.

    Raises:
        ValueError: if the file lacks these marks.
    """
    text = path.read_text()
    marks = rf"(<!-- {re.escape(name)} -->\n).*?(<!-- (?:end of |/){re.escape(name)} -->)"
    found = re.search(marks, text, re.DOTALL)
    if not found:
        raise ValueError(
            f"{path}: lacks the lines <!-- {name} --> and <!-- end of {name} -->; add them where the table belongs"
        )
    write_text(path, text[: found.end(1)] + "\n".join(lines) + "\n" + text[found.start(2) :])


def pyplot():
    """Returns matplotlib.pyplot, or None, reported on stderr, where matplotlib is missing."""
    try:
        import matplotlib
    except ImportError:
        print("No plot, which needs matplotlib: pip install matplotlib", file=sys.stderr)
        return None
    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def save_figure(figure, path: pathlib.Path) -> None:
    """Writes a figure as PNG, whole or not at all, and closes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with partial_file(path) as partial:
        figure.savefig(partial, format="png", dpi=100)
    pyplot().close(figure)
    print(f"wrote {path}")


def chosen(flag: str, names: Sequence[str], known: Sequence[str]) -> list[str]:
    """Returns the names that a flag lists; raises ValueError for one that is not known."""
    names = [name.strip() for name in names]
    wrong = [name for name in names if name not in known]
    if wrong:
        raise ValueError(f"{flag} contains {wrong[0]!r}, expected some of {', '.join(known)}")
    return names


def seeds_of(flag: str, values: Sequence[str], *, least: int = 1) -> list[int]:
    """Returns the different seeds that a flag lists, in its order; raises ValueError if there are too few."""
    if not all(value.strip().isdigit() for value in values) or len(set(values)) < least:
        raise ValueError(f"{flag} is {','.join(values)!r}, expected at least {least} integers such as 0,1,2")
    return list(dict.fromkeys(int(value) for value in values))
