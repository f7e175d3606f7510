"""The part "parts" of speed_vs_error.py: where the time of a training step goes.

The profiler times each operation of the compiled step, and the compiler's metadata says which lines of which functions
an operation comes from. An operation that fuses several lines belongs to the last of them. The profiler itself slows a
step down, so the table also has the time of a step without it.
"""

import collections
import gzip
import json
import pathlib
import re
import statistics
import tempfile
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import common
import jax

# The first entry whose file, and function if one is given, is in an operation's call stack names its part.
_PARTS = (
    ("update of the occupancy grid", "models/grid_schedule.py", ""),
    ("optimizer and averaging", "training/optimizer.py", ""),
    ("optimizer and averaging", "training/step.py", "descend"),
    ("interpolation in the hash grid", "fields/hash_interpolation.py", "interpolate"),
    ("interpolation in the hash grid", "fields/hash_interpolation.py", "stored"),
    ("networks", "fields/", ""),
    ("ray marching", "core/occupancy/ray_marching.py", ""),
    ("ray marching", "core/occupancy/sample_runs.py", "march_near_matter"),
    ("choice of samples", "core/occupancy/importance.py", ""),
    ("choice of samples", "core/occupancy/grid.py", ""),
    ("rays and pixels", "data/ray_batches.py", ""),
    ("compositing and losses", "core/", ""),
)
_OTHER = "gradient's norm, copies, counters"
_LEAST = 0.8  # of the time of a step that its parts must make up

RUNS = {
    "lego, 100 px": ("lego_fast", {"data.factor": 8}),
    "lego, 400 px": ("lego_fast", {"data.factor": 2}),
    "fox, 200 px": ("capture", {"data.dir": "fox"}),
    "can, 200 px": ("capture", {"data.dir": "can"}),
}


def measure_all(kept: dict[str, Any], save: Callable[[dict], None]) -> None:
    """Measures the step of each run; what was kept is not measured again."""
    for name, run in RUNS.items():
        if name not in kept:
            kept[name] = measure(common.configuration(*run))
            save(kept)


def measure(config, *, warm_up: int = 1500, num_steps: int = 64, num_parts: int = 1) -> dict[str, Any]:
    """Returns the time of each part of a step, in ms.

    Args:
        config: of the run.
        warm_up: steps before the measurement, in which the grid becomes sparse.
        num_steps: steps that are timed; a multiple of the interval of updates.
        num_parts: of the rays, whose gradients are computed at once.

    Raises:
        ValueError: if the profiler recorded less than _LEAST of the time; it drops events above about a million.
    """
    step = common.compile_step(config, num_parts=num_parts)
    state = step.state

    def take(count):
        nonlocal state
        for _ in range(count):
            state, _ = step.run(state, step.data, step.positions)
        jax.block_until_ready(state)

    take(warm_up)
    gflops = common.matrix_gflops()
    plain = min(common.times(lambda: take(num_steps), 3))
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            take(num_steps)
        (path,) = pathlib.Path(folder).rglob("*.trace.json.gz")
        events = json.loads(gzip.decompress(path.read_bytes()))["traceEvents"]
    part_of = parts_of_operations(step.run.as_text())
    parts: collections.Counter = collections.Counter()
    for name, microseconds in wall_times(events, part_of):
        parts[part_of[name]] += microseconds / 1e3 / num_steps
    if sum(parts.values()) < _LEAST * 1e3 * plain / num_steps:
        raise ValueError(
            f"the profiler recorded {sum(parts.values()):.1f} ms of {1e3 * plain / num_steps:.1f} ms a step; give "
            "fewer num_steps"
        )
    samples = step.positions.size * step.config.occupancy.pool_samples_per_ray
    return {
        "rays": int(step.positions.size),
        "samples": int(samples),
        "rows": int(step.state.params["fine"]["table"].shape[0]),
        "ms": 1e3 * plain / num_steps,
        "gflops": gflops,
        "network_gflop": 3 * samples * field_flops(state.params["fine"]) / 1e9,
        "parts": dict(parts.most_common()),
    }


def wall_times(events: Iterable[dict], names: Iterable[str]) -> list[tuple[str, float]]:
    """Returns (name, time until the next operation starts) of each event with one of the names.

    XLA starts an operation when the one before it is done, so this is the time of the step that it takes, whether one
    thread works on it or several. Where operations run beside each other, the later one is charged.

    Args:
        events: of a trace in Chrome's format: "name", "ph", "ts" and "dur".
        names: of the operations.
    """
    names = set(names)
    timed = [event for event in events if event.get("ph") == "X" and event["name"] in names]
    timed.sort(key=lambda event: (event["ts"], -event["dur"]))
    end = max((event["ts"] + event["dur"] for event in timed), default=0)
    starts = [event["ts"] for event in timed] + [end]
    return [(event["name"], after - event["ts"]) for event, after in zip(timed, starts[1:], strict=True)]


def part_of_stack(frames: Sequence[tuple[str, str]]) -> str:
    """Returns the part to which an operation belongs.

    Args:
        frames: (file, function) of its call stack.
    """
    for part, file, function in _PARTS:
        if any(f"jaxnerf/{file}" in path and name.endswith(function) for path, name in frames):
            return part
    return _OTHER


def parts_of_operations(text: str) -> dict[str, str]:
    """Returns {operation: part} of the text of a compiled program."""
    tables = {
        name: dict(re.findall(r"^(\d+) (.*)$", text.partition(f"\n{name}\n")[2].partition("\n\n")[0], re.MULTILINE))
        for name in ("FileNames", "FunctionNames", "FileLocations", "StackFrames")
    }

    def numbers(line):
        return dict(re.findall(r"(\w+)=(\d+)", line))

    def stack(frame):
        frames = []
        while frame in tables["StackFrames"]:
            entry = numbers(tables["StackFrames"][frame])
            place = numbers(tables["FileLocations"][entry["file_location_id"]])
            names = tables["FileNames"][place["file_name_id"]], tables["FunctionNames"][place["function_name_id"]]
            frames.append(tuple(name.strip('"') for name in names))
            frame = str(int(entry["parent_frame_id"]) - 1)  # printed as 1 for a frame without a parent
        return frames

    parts = {}
    for line in text.splitlines():
        found = re.match(r"\s*(?:ROOT )?%([\w.\-]+) = ", line)
        if found:
            frame = re.search(r"stack_frame_id=(\d+)", line)
            parts[found[1]] = part_of_stack(stack(frame[1])) if frame else _OTHER
    return parts


def table(kept: dict[str, Any]) -> list[str]:
    """Returns the lines of the table of several runs: {name: result of measure}."""
    results = list(kept.values())
    names = list(dict.fromkeys(part for result in results for part in result["parts"]))
    rows = [
        ("rays a step", *(f"{result['rays']:,}" for result in results)),
        ("samples", *(f"{result['samples']:,}" for result in results)),
        ("rows of the hash grid", *(f"{result['rows']:,}" for result in results)),
        ("ms a step", *(f"{result['ms']:.1f}" for result in results)),
        *((part, *(f"{result['parts'].get(part, 0):.2f}" for result in results)) for part in names),
        ("GFLOP of the networks", *(f"{result['network_gflop']:.2f}" for result in results)),
        ("their GFLOP/s, of a matrix product's", *(_fraction(result) for result in results)),
    ]
    product = statistics.mean(result["gflops"] for result in results)
    caption = (
        "Where the time of a training step goes, in ms, by the profiler, which slows a step down. "
        f"{common.describe_machine()}, matrix product {product:.0f} GFLOP/s."
    )
    return [caption, "", *common.markdown(("", *kept), rows)]


def _fraction(result):
    return f"{result['network_gflop'] / result['parts']['networks'] * 1e3 / result['gflops']:.0%}"


def field_flops(params) -> int:
    """Returns the FLOPs of one sample: twice the multiply-adds of its matrix products and interpolations.

    The bottleneck is not among them: it is multiplied with the next layer once for all samples.
    """
    sizes = [
        leaf.size
        for path, leaf in jax.tree.leaves_with_path(params)
        if leaf.ndim == 2 and not {"table", "bottleneck"} & {part.key for part in path}
    ]
    corners = 8 * params["kernel"].shape[0] if "table" in params else 0
    return 2 * (sum(sizes) + corners)
