"""The tables of the benchmark, and the page around them."""

import collections
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import common
from benchmark import jobs
from speed import published

Scores = Mapping[str, Sequence[Mapping[str, Any]]]  # of a job, by ascending time
PAGE_TABLES = ("benchmark", "beside")
NOTES = (
    "Seconds of training exclude set-up and compilation. Those of others are CPU seconds of the whole process, or were",
    "published and not measured here. Lego and mic, and the others beside them, are scored on 25 of 200 test views.",
    "[The benchmark](docs/results/benchmark.md) has commands, commit and machine.",
)
_PAGE = """# Benchmark

What PSNR is reached by the published protocols, after how much training, on one CPU core or whatever device there is?
Beside it stand published figures, and programs that were run on the same images.

- **Protocols.** Colours are rounded to 8 bits; PSNR and SSIM are means over the test images, of which lego and mic have
  25, every 8th of the 200. nerfbaselines truncates colours, which costs up to 0.07 dB at 35 dB.
{protocols}
- **Training.** Each row is a run of its own, whose learning rate reaches its end when its time does. Seconds exclude
  set-up (reading images, marking cells) and compilation; a run that was interrupted has no time of set-up. With
  `--report` the command writes what it trained before, one job and time after another. Comparable
  seconds are seconds times the GFLOP/s of a matrix product just before and after the run, over {reference:.0f}; they
  compare CPUs of one kind.
- **Memory.** The peak of the whole process, which reads, trains and scores, or of the accelerator.

<!-- benchmark -->
<!-- end of benchmark -->

## Beside others

Hardware and time are those of the source. Only figures of the same images compare. Where the images of lego and mic
have no number of views, they are all 200 test views, where no figure of the 25 is known; published figures of
the 25 views are {shift[0]:+.2f} to {shift[1]:+.2f} dB from those of all.

<!-- beside -->
<!-- end of beside -->
"""


def all_tables(scores: Scores) -> dict[str, list[str]]:
    """Returns the lines of each table by the name of its marks."""
    return {"benchmark": benchmark(scores), "beside": beside(scores), "headline": headline(scores)}


def empty_page() -> str:
    """Returns the page before its tables are put in."""
    protocols = "\n".join(f"    - {name}: {protocol.text}." for name, protocol in jobs.PROTOCOLS.items())
    return _PAGE.format(protocols=protocols, reference=common.REFERENCE_GFLOPS, shift=shift_of_views())


def shift_of_views() -> tuple[float, float]:
    """Returns the smallest and the largest difference, in dB, of a published figure of 25 views from that of all."""
    figures = {(entry["what"], entry["name"]): entry["psnr"] for entry in published.BENCHMARK}
    of_all = {(f"{what}, 25 test views", name): psnr for (what, name), psnr in figures.items()}
    shifts = [psnr - of_all[key] for key, psnr in figures.items() if key in of_all]
    return min(shifts), max(shifts)


def benchmark(scores: Scores) -> list[str]:
    """Returns the lines of the provenance and of the table of all runs."""
    with_lpips = any("lpips" in score for runs in scores.values() for score in runs)
    heads = ["job", "images", "views", "s", "comparable s", "PSNR", "SSIM", *(["LPIPS"] if with_lpips else [])]
    heads += ["steps", "compiling s", "set-up s", "peak MB", "s a frame"]
    rows = []
    for name, runs in scores.items():
        for score in runs:
            row = [name + changes_of(score), images_of(score), str(score["views"]), f"{score['seconds']:.0f}"]
            row.append(f"{score['comparable']:.0f}" if score["backend"] == "cpu" else "-")
            row += [f"{score['psnr']:.2f}", f"{score['ssim']:.4f}"]
            row += [f"{score['lpips']:.4f}" if "lpips" in score else "-"] if with_lpips else []
            row += [f"{score['step']:,}", f"{score['compile_seconds']:.0f}", _number(score["setup_seconds"], "{:.0f}")]
            row += [_number(peak_of(score), "{:,.0f}"), f"{score['seconds_per_frame']:.2f}"]
            rows.append(row)
    return [*provenance(scores), "", *common.markdown(heads, rows)]


def provenance(scores: Scores) -> list[str]:
    """Returns the lines of a table with the command, the commits and date of the runs, and their machines."""
    runs = [score for each in scores.values() for score in each]
    by_commit = collections.defaultdict(list)
    for score in runs:
        by_commit[score["commit"]].append(f"{score['job']} after {score['time_limit']:g} s")
    (main, _), *others = sorted(by_commit.items(), key=lambda item: -len(item[1]))
    commits = "; ".join([main, *(f"{commit}: {', '.join(names)}" for commit, names in others)])
    machines = dict.fromkeys(f"{score['machine']} ({score['cpu']})" for score in runs)
    speeds = [value for score in runs if score["backend"] == "cpu" for value in score["gflops"]]
    speed = [f"{min(speeds):.0f} to {max(speeds):.0f} GFLOP/s"] if speeds else []
    program = pathlib.Path(sys.argv[0]).resolve()
    program = program.relative_to(common.ROOT) if program.is_relative_to(common.ROOT) else program
    arguments = [each for each in sys.argv[1:] if each != "--report"]  # without it, the command measures
    command = " ".join(["python", str(program), *arguments])
    date = max(score["datetime"] for score in runs)[:10]
    return common.markdown(
        ("command", "commit", "machine"), [(f"`{command}`", f"{commits}, {date}", "; ".join([*machines, *speed]))]
    )


def beside(scores: Scores) -> list[str]:
    """Returns the lines of the table of runs and of what others reach on the same images, by descending PSNR."""
    heads = ("images", "method", "PSNR", "training", "hardware", "source")
    rows = []
    for name, runs in scores.items():
        others = others_of(jobs.JOBS[name], runs)
        found = [(entry["psnr"], _row_of_other(entry)) for entry in others]
        found += [(score["psnr"], _own_row(score)) for score in runs if others]
        rows += [row for _, row in sorted(found, key=lambda item: -item[0])]
    return common.markdown(heads, rows) if rows else ["No figures of the same images are known."]


def _row_of_other(entry):
    psnr, time = f"{entry['psnr']:.2f}", _duration(entry["seconds"])
    return entry["what"], entry["name"], psnr, time, entry["hardware"], entry["source"]


def _own_row(score):
    job, psnr = jobs.JOBS[score["job"]], f"**{score['psnr']:.2f}**"
    if job.protocol != "capture":
        psnr += f" ({score['psnr_truncated']:.2f} truncated)"
    images = f"{job.dataset}, {images_of(score)}, {score['views']} test views"
    time = _duration(score["seconds"])
    return images, f"**jaxnerf**, {score['job']}{changes_of(score)}", psnr, time, score["machine"], "this page"


def headline(scores: Scores) -> list[str]:
    """Returns the lines of the table of the README: PSNR by seconds, and what others reach on the same images."""
    rows = []
    for name, runs in scores.items():
        ours = ", ".join(f"{score['psnr']:.1f} dB ({score['seconds']:.0f} s)" for score in runs)
        grouped = collections.defaultdict(list)
        for entry in others_of(jobs.JOBS[name], runs, all_views=False):
            time = f" ({_duration(entry['seconds'])})" if entry["seconds"] else ""
            grouped[entry["name"]].append(f"{entry['psnr']:.1f} dB{time}")
        cell = "; ".join(f"{other}: {', '.join(each)}" for other, each in grouped.items())
        work, frame = jobs.JOBS[name].work + changes_of(runs[-1]), f"{runs[-1]['seconds_per_frame']:.2f} s"
        rows.append((work, ours, frame, cell or "-"))
    devices = dict.fromkeys(
        "one CPU core" if score["machine"].startswith("cpu, 1 core") else score["machine"].partition(", XLA")[0]
        for runs in scores.values()
        for score in runs
    )
    heads = (f"dataset, {' or '.join(devices)}", "PSNR (seconds of training)", "a frame", "others (their time)")
    return [*common.markdown(heads, rows), "", *NOTES]


def others_of(job: jobs.Job, runs: Sequence[Mapping[str, Any]], *, all_views: bool = True) -> list[dict[str, Any]]:
    """Returns the entries of `published` beside the runs of a job, whose images have their size.

    Args:
        job: of the runs.
        runs: its scores.
        all_views: whether figures of a whole test split are among them, where none of the part of the runs is known.
    """
    kinds, sizes = job.beside if all_views else job.beside[:1], {images_of(score) for score in runs}
    kinds = [kind for kind in kinds if any(size in kind for size in sizes)]
    entries = [entry for entry in (*published.BENCHMARK, *published.TRAINING) if entry["what"] in kinds]
    part = ", 25 test views"
    parts = {(entry["what"].removesuffix(part), entry["name"]) for entry in entries if entry["what"].endswith(part)}
    return [entry for entry in entries if (entry["what"], entry["name"]) not in parts]


def images_of(score: Mapping[str, Any]) -> str:
    """Returns the size of the scored images, as width x height."""
    size = score["conventions"]["size"]
    height, width = size if isinstance(size[0], int) else size[0]
    return f"{width}x{height}" + ("" if isinstance(size[0], int) else " and others")


def changes_of(score: Mapping[str, Any]) -> str:
    """Returns " with option=value" for the options of --set that are not the job's own, otherwise ""."""
    own = jobs.JOBS[score["job"]].overrides
    changes = [f"{key}={value}" for key, value in score["overrides"].items() if own.get(key) != value]
    return f" with {', '.join(changes)}" if changes else ""


def peak_of(score: Mapping[str, Any]) -> float | None:
    """Returns the peak memory in MB of the device that trained; None where it does not report it."""
    return score["peak_memory_mb"] if score["backend"] == "cpu" else score["peak_device_memory_mb"]


def _duration(seconds):
    """Returns a time in a suitable unit, "not said" for None."""
    if seconds is None:
        return "not said"
    for unit, size, least in (("days", 86400, 1.5), ("h", 3600, 1.5), ("min", 60, 3)):
        if seconds >= least * size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.0f} s"


def _number(value, text):
    return "-" if value is None else text.format(value)
