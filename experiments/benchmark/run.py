"""Trains and scores datasets by the published protocols, and writes tables with published figures beside them.

    JAXNERF_SCENES=... python experiments/benchmark/run.py [--jobs=lego_100,fox_200] [--list] [--seconds=5] \
        [--set=data.factor=16] [--page=docs/results/benchmark.md] [--nerfbaselines=DIR]

Each job of jobs.py is trained for each of its times: one run in a process of its own, on one core where there is only a
CPU. OUT/<job>/<seconds>s-<commit>/ is its workdir, with the scores in score.json, and OUT/<job>/results.json has the
scores of all times. A run that is scored is not repeated by the same commit (with --any_commit by no commit) if its
config agrees; the same command continues one that was interrupted. A job whose dataset is missing is skipped, and a run
that fails does not keep the others from running.

--page replaces the tables of the marks "benchmark" and "beside" in a file, which is made if missing, or the table of
the mark "headline", as in the README. --nerfbaselines writes each run's scores in the layout of nerfbaselines, see
nerfbaselines_layout.py.
"""

import pathlib
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
from benchmark import jobs, nerfbaselines_layout, settings, tables

from jaxnerf.data.dataset import dataset_folder
from jaxnerf.runtime import cli
from jaxnerf.runtime.atomic_files import write_text
from jaxnerf.tools.curve import measure
from jaxnerf.tools.curve.measure import SCORE
from jaxnerf.tools.curve.runs import train_and_score

_JOBS = flags.DEFINE_list("jobs", list(jobs.JOBS), "Names of jobs, see --list.")
_LIST = flags.DEFINE_bool("list", False, "Print the jobs, and do nothing else.")
_SECONDS = flags.DEFINE_list("seconds", [], "Seconds of training, in place of the jobs' own.")
_SET = settings.define_set()
_OUT = flags.DEFINE_string("out", "runs/benchmark", "Folder of the runs and their scores.")
_ANY_COMMIT = flags.DEFINE_bool("any_commit", False, "Do not repeat runs of other commits with the same config.")
_REPORT = flags.DEFINE_bool("report", False, "Train nothing; write the tables of what is there.")
_NERFBASELINES = flags.DEFINE_string("nerfbaselines", None, "Folder for the scores in the layout of nerfbaselines.")


def main(argv: list[str]) -> None:
    """Trains what is missing, then reports everything that is there."""
    del argv
    names, out = common.chosen("--jobs", _JOBS.value, list(jobs.JOBS)), pathlib.Path(_OUT.value)
    plan = {name: _times(_SECONDS.value) or sorted(jobs.JOBS[name].seconds) for name in names}
    overrides = settings.parse(_SET.value)
    configs = {name: jobs.configuration(jobs.JOBS[name], overrides) for name in names}
    if _LIST.value:
        print("\n".join(listing(plan)))
        return
    commit, notes, failed = common.commit(), missing(names), []
    for note in notes.values():
        print(note, file=sys.stderr)
    if not _REPORT.value:
        failed = _measure({name: plan[name] for name in names if name not in notes}, configs, out, commit)
    scores = {name: selected(read_scores(out, name), plan[name], commit) for name in names}
    scores = {name: found for name, found in scores.items() if found}
    if not scores:
        raise ValueError(f"{out}: holds no scores of {', '.join(names)}" + "".join(f"; {each}" for each in failed))
    _publish(tables.all_tables(scores))
    for name, runs in scores.items():
        common.write_json(out / name / "results.json", {"job": name, "runs": runs})
    if _NERFBASELINES.value:
        _export(scores, out, pathlib.Path(_NERFBASELINES.value))
    if failed:
        raise ValueError(f"failed: {', '.join(failed)}; see above, and the same command tries again")


def _times(values):
    """Returns the numbers of --seconds, ascending."""
    try:
        times = sorted(float(value) for value in values)
    except ValueError:
        times = [0.0]
    if times and not 0 < times[0] <= times[-1] < float("inf"):
        raise ValueError(f"--seconds is {','.join(values)!r}, expected positive numbers such as 60,600")
    return times


def listing(plan: Mapping[str, Sequence[float]]) -> list[str]:
    """Returns the lines of --list."""
    rows = []
    for name, times in plan.items():
        job = jobs.JOBS[name]
        changes = " ".join(f"{key}={value}" for key, value in job.overrides.items() if key != "data.dir")
        seconds = ", ".join(f"{time:g}" for time in times)
        rows.append((name, job.dataset, job.config, changes or "-", job.protocol, str(job.cores), seconds))
    total = sum(sum(times) for times in plan.values())
    heads = ("job", "dataset", "config", "options", "protocol", "cores", "seconds of training")
    return [*common.markdown(heads, rows), "", f"{total / 3600:.1f} h of training, without set-up and scoring"]


def missing(names: Sequence[str]) -> dict[str, str]:
    """Returns for each job whose dataset is missing a line that says so."""
    notes = {}
    for name in names:
        try:
            dataset_folder(jobs.JOBS[name].dataset)
        except ValueError:
            dataset, origin = jobs.JOBS[name].dataset, jobs.JOBS[name].origin
            notes[name] = f"{name}: skipped, as there is no folder {dataset!r}, neither here nor below $JAXNERF_SCENES"
            notes[name] += f"; `{origin}` makes it" if origin else ""
    return notes


def read_scores(out: pathlib.Path, name: str) -> list[dict[str, Any]]:
    """Returns the scores of a job's finished runs, each with its workdir, the newest first."""
    paths = sorted((out / name).glob(f"*/{SCORE}"))
    found = [{**common.read_json(path), "workdir": path.parent.name} for path in paths]
    return sorted(found, key=lambda score: score["datetime"], reverse=True)


def selected(scores: Sequence[Mapping], times: Sequence[float], commit: str) -> list[Mapping]:
    """Returns one score for each time that has any, by ascending time: of this commit, otherwise the newest one."""
    found = []
    for time in times:
        same = [score for score in scores if score["time_limit"] == time]
        found += [score for score in same if score["commit"] == commit][:1] or same[:1]
    return found


def is_finished(
    scores: Sequence[Mapping], time_limit: float, config: Any, commit: str, *, any_commit: bool = False
) -> bool:
    """Returns whether a run need not be trained: it is scored, or a shorter one ended by its steps.

    Args:
        scores: of the job's finished runs, see `read_scores`.
        time_limit: seconds of training of the run.
        config: of the job.
        commit: of the program.
        any_commit: whether runs of other commits count, too.

    Raises:
        ValueError: if this commit has scored a run of that time with another config; names an option that differs.
    """
    for score in scores:
        time = score["time_limit"]
        if not measure.covers(score, time_limit):
            continue
        expected = common.plain_config(measure.at_time(config, time))
        if score["commit"] == commit and time == time_limit:
            remedy = "give another --out, or remove that folder"
            common.check_origin({"config": score["config"]}, {"config": expected}, score["workdir"], remedy)
        if score["config"] == expected and (any_commit or score["commit"] == commit):
            return True
    return False


def _measure(plan, configs, out, commit):
    """Trains and scores what is missing; returns what failed."""
    failed, on_cpu = [], None
    for name, times in plan.items():
        for time in times:
            run = f"{name} after {time:g} s"
            scores = read_scores(out, name)
            if is_finished(scores, time, configs[name], commit, any_commit=_ANY_COMMIT.value):
                print(f"{run}: finished before", flush=True)
                continue
            workdir = out / name / f"{time:g}s-{commit}"
            print(f"{run}: {'continues' if workdir.exists() else 'starts'} in {workdir}", flush=True)
            on_cpu = _is_cpu() if on_cpu is None else on_cpu
            about = {"job": name, "overrides": {**jobs.JOBS[name].overrides, **settings.parse(_SET.value)}}
            about |= {"commit": commit, "config": common.plain_config(measure.at_time(configs[name], time))}
            with common.few_cores(jobs.JOBS[name].cores if on_cpu else None):
                score = train_and_score(configs[name], time, workdir, about=about)
            if score is None:
                failed.append(run)
            else:
                print(f"{run}: {score['psnr']:.2f} dB, SSIM {score['ssim']:.4f}", flush=True)
    return failed


def _is_cpu():
    """Returns whether JAX finds only a CPU; in another process, so that this one takes no memory of a device."""
    command = [sys.executable, "-c", "import jax; print(jax.default_backend())"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    if found.returncode:
        raise ValueError(f"JAX finds no device: {found.stderr.strip().splitlines()[-1]}")
    return found.stdout.split()[-1] == "cpu"


def _publish(lines_of):
    """Prints the tables, and replaces those whose marks the page has; makes the page if it is missing."""
    print("\n".join(line for lines in lines_of.values() for line in [*lines, ""]))
    if not common.PAGE.value:
        return
    page = pathlib.Path(common.PAGE.value)
    if not page.exists():
        page.parent.mkdir(parents=True, exist_ok=True)
        write_text(page, tables.empty_page())
        print(f"made {page}; a page below docs/ is to be listed in mkdocs.yml, and in docs/results/index.md")
    text = page.read_text()
    for name in [name for name in lines_of if f"<!-- {name} -->" in text] or tables.PAGE_TABLES:
        common.replace(page, lines_of[name], name)


def _export(scores, out, folder):
    """Writes the files in the layout of nerfbaselines."""
    for name, runs in scores.items():
        for score in runs:
            content = nerfbaselines_layout.results_of(score, out / name / score["workdir"])
            common.write_json(folder / f"{name}_{score['time_limit']:g}s.json", content)
    print(f"wrote {folder}: {sum(map(len, scores.values()))} files in the layout of nerfbaselines")


if __name__ == "__main__":
    cli.run(main, stopped="within a run; what is finished is saved, and the same command continues")
