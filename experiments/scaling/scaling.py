"""Measures rays/s, memory, collective bytes and compile time against devices and processes, and models many more.

    python experiments/scaling/scaling.py --config=embedded_small --out=DIR [--devices=1,2,4,8] [--processes=2]

Each row is a process of its own (or two) with so many virtual CPU devices, which share the cores that there are: more
devices than cores cannot be faster, and show the cost of splitting. Writes DIR/scaling.json, DIR/scaling.md and, with
the extra `experiments`, DIR/scaling.png.
"""

import json
import math
import os
import pathlib
import re
import socket
import statistics
import subprocess
import sys
import time
from typing import Any, NamedTuple

import jax
from absl import flags
from ml_collections import config_flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.runtime import cli, devices
from jaxnerf.runtime import processes as processes_module
from jaxnerf.runtime.atomic_files import write_text
from jaxnerf.training import auto_config, build
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step

_OUT = flags.DEFINE_string("out", None, "Folder of the tables.", required=True)
_CONFIG = cli.define_config("Config of the run whose step is measured: a name, or the path of a file.")
_DEVICES = flags.DEFINE_list("devices", ["1", "2", "4", "8"], "Numbers of devices of one process.")
_PROCESSES = flags.DEFINE_integer("processes", 2, "Also measure so many processes with two devices each; 0: none.")
_STEPS = flags.DEFINE_integer("steps", 20, "Number of steps that are timed.", lower_bound=2)
_PROCESS = flags.DEFINE_string("process", None, "Internal: port,count,index of the process that measures here.")
flags.FLAGS.set_default("config", "embedded_small")
_COUNTS = (1, 8, 16, 32, 64, 128)
# The paper's two networks: 64 and 64 + 128 evaluations per ray, with batches of 4096 rays (arXiv:2003.08934).
PAPER = {"parameters": (595_844, 595_844), "evaluations": (64, 192), "rays": 4096}
_BYTES = {"pred": 1, "bf16": 2, "f16": 2, "f32": 4, "s32": 4, "u32": 4, "f64": 8, "s64": 8, "u64": 8}
_SCALARS = 4  # loss, two errors and the number of rays, which are summed with the gradient


class Machine(NamedTuple):
    """Devices and their links. Peaks and bandwidths are the vendors'; utilization and latency are assumed.

    Attributes:
        name: of the machine.
        peak: FLOP/s of a device, of the matrix unit's float32 mode.
        utilization: fraction of the peak that a step reaches.
        group: number of devices that the fast link joins.
        fast: bytes/s, each way, of a device's fast link.
        slow: bytes/s, each way, of a device's part of the link between groups.
        latency: s of one message.
        source: of peak and bandwidths.
    """

    name: str
    peak: float
    utilization: float
    group: int
    fast: float
    slow: float
    latency: float
    source: str


_NVIDIA = {"utilization": 0.3, "group": 8, "latency": 5e-6}
MACHINES = (
    Machine("A100 (NVLink, HDR)", peak=156e12, fast=300e9, slow=25e9, **_NVIDIA,
            source="NVIDIA's data sheets: TF32 156 TFLOP/s, NVLink 600 GB/s both ways; HDR 200 Gb/s a GPU"),
    Machine("H100 (NVLink, NDR)", peak=494.7e12, fast=450e9, slow=50e9, **_NVIDIA,
            source="NVIDIA's data sheets: TF32 494.7 TFLOP/s without sparsity, NVLink 900 GB/s both ways; NDR "
            "400 Gb/s a GPU"),
    Machine("TPU v3 core", peak=61.5e12, fast=166e9, slow=166e9, utilization=0.3, group=2048, latency=2e-6,
            source="Google's page of TPU v3: 123 TFLOP/s (bf16) a chip of 2 cores; all-reduce bandwidth 340 TB/s "
            "a pod of 1024 chips"),
)  # fmt: skip


def main(argv: list[str]) -> None:
    """Measures all rows and writes the tables and the plot."""
    del argv
    if _PROCESS.value:
        return _measure_here(*map(int, _PROCESS.value.split(",")))
    out = pathlib.Path(_OUT.value)
    out.mkdir(parents=True, exist_ok=True)
    places = [(1, int(count)) for count in _DEVICES.value]
    if _PROCESSES.value:
        places.append((_PROCESSES.value, 2))
    rows = []
    for processes, num_devices in places:
        rows.append(measure(processes, num_devices))
        print(f"{processes} x {num_devices}: {rows[-1]['rays_per_second']:,.0f} rays/s", file=sys.stderr)
    kept = {
        "config": pathlib.Path(config_flags.get_config_filename(flags.FLAGS["config"])).stem,
        "cores": len(os.sched_getaffinity(0)),
        "rows": rows,
    }
    common.write_json(out / "scaling.json", kept)
    lines = [*measured_table(kept), "", *paper_table()]
    write_text(out / "scaling.md", "\n".join(lines) + "\n")
    print("\n".join(lines))
    plot(kept, out / "scaling.png")


def measure(processes: int, num_devices: int) -> dict[str, Any]:
    """Returns the row of a run's step in so many processes with so many devices each."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": str(num_devices)}
    command = [sys.executable, *sys.argv]
    started = [
        subprocess.Popen(
            [*command, f"--process={port},{processes},{index}"], env=environment, stdout=subprocess.PIPE, text=True
        )
        for index in range(processes)
    ]
    outputs = [process.communicate()[0] for process in started]
    if any(process.returncode for process in started):
        raise ValueError(f"{' '.join(command)} failed; its message is above")
    found = next(line for line in outputs[0].splitlines() if line.startswith("{"))  # gloo prints there, too
    return {"processes": processes, "devices": num_devices, **json.loads(found)}


def _measure_here(port, processes, index):
    """Prints the row of this process, as JSON."""
    options = {"coordinator": f"127.0.0.1:{port}", "num_processes": processes, "process_id": index}
    with processes_module.cluster(**(options if processes > 1 else {"multihost": False})):
        row = _row(_STEPS.value)
        if processes_module.is_first():
            print(json.dumps(row), flush=True)


def _row(steps):
    config, views, _ = auto_config.resolve(_CONFIG.value)
    config, _ = auto_config.resolve_for_device(config)
    experiment = build.build(config)
    valid, data = experiment.prepare(views)
    state = create_state(experiment.model, experiment.optimizer, experiment.config.seed, valid)
    parts = experiment.model, experiment.optimizer, experiment.draw, experiment.losses
    step = make_train_step(*parts, pixel_rays=experiment.pixel_rays)
    parameters = sum(leaf.size for leaf in jax.tree.leaves(state.params))
    rays, started = experiment.config.train.batch_size, time.perf_counter()
    size = experiment.config.train.microbatch_size
    run, state, data = devices.compile_step(step, state, data, batch_size=rays, microbatch_size=size)
    compile_seconds, taken = time.perf_counter() - started, []
    for _ in range(steps):
        started = time.perf_counter()
        state, metrics = run(state, data)
        jax.block_until_ready(metrics)
        taken.append(time.perf_counter() - started)
    memory = run.compiled.memory_analysis()
    held = memory.argument_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes
    total, count = collective_bytes(run.compiled.as_text())
    return {
        "rays": rays,
        "parameters": parameters,
        "rays_per_second": rays / statistics.median(taken[1:]),
        "device_bytes": held + memory.temp_size_in_bytes,
        "collective_bytes": total,
        "collectives": count,
        "compile_seconds": compile_seconds,
    }


def step_flops(parameters: tuple[int, ...], evaluations: tuple[int, ...], rays: int) -> int:
    """Returns an upper bound of the FLOPs of a step: two per parameter and evaluation forward, four backward.

    It counts the bottleneck like other layers, although the network multiplies it with the next layer once for all
    samples.

    Args:
        parameters: number in each network.
        evaluations: per ray, of each network.
        rays: of the step.
    """
    return 6 * rays * sum(size * count for size, count in zip(parameters, evaluations, strict=True))


def all_reduce_seconds(machine: Machine, num_devices: int, size: float) -> float:
    """Returns the time to sum `size` bytes over all devices: rings in each group, then between groups."""
    inside = min(num_devices, machine.group)
    groups = math.ceil(num_devices / inside)
    seconds = 2 * (inside - 1) / inside * size / machine.fast + 2 * (inside - 1) * machine.latency
    # Each device of a group sends its part of the sum to the other groups.
    return seconds + 2 * (groups - 1) / groups * size / inside / machine.slow + 2 * (groups - 1) * machine.latency


def predict(
    machine: Machine, num_devices: int, *, flops: float, size: float, grow: bool = False
) -> tuple[float, float, float]:
    """Predicts a step on paper, without any overlap.

    Args:
        machine: the devices.
        num_devices: their number.
        flops: of the step, over all devices; with grow, of each.
        size: bytes of the gradient.
        grow: whether the batch grows with the devices (weak scaling).

    Returns:
        Seconds of arithmetic, seconds of the sum, and the efficiency: the rate per device over that of one device.
    """
    alone = flops / (machine.peak * machine.utilization)
    compute = alone if grow else alone / num_devices
    summing = all_reduce_seconds(machine, num_devices, size)
    return compute, summing, compute / (compute + summing)


def gradient_bytes(parameters: int, value_bytes: int = 4) -> int:
    """Returns the bytes that a step sums over the devices: one value per parameter, and the step's metrics."""
    return value_bytes * (parameters + _SCALARS)


def collective_bytes(text: str) -> tuple[int, int]:
    """Returns the bytes that the all-reduces in a compiled program's text return, and their number."""
    total = count = 0
    for line in text.splitlines():
        found = re.search(r"= (.*?) all-reduce(-start)?\(", line)
        if found:
            count += 1
            total += sum(_array_bytes(*shape) for shape in re.findall(r"(\w+)\[([\d,]*)\]", found[1]))
    return total, count


def _array_bytes(dtype, shape):
    return _BYTES[dtype] * math.prod(int(side) for side in shape.split(",") if side)


def measured_table(kept: dict[str, Any]) -> list[str]:
    """Returns the lines of the measured rows."""
    first, cells = kept["rows"][0], []
    for row in kept["rows"]:
        sent = f"{row['collective_bytes']:,} in {row['collectives']}"
        formula = gradient_bytes(row["parameters"])
        cells.append((f"{row['processes']} x {row['devices']}", f"{row['rays_per_second']:,.0f}",
                      f"{row['rays_per_second'] / first['rays_per_second']:.2f}",
                      f"{row['device_bytes'] / 1e6:.1f}", sent, f"{formula:,}",
                      f"{row['compile_seconds']:.1f}"))  # fmt: skip
    heads = ("processes x devices", "rays/s", "ratio", "MB a device", "bytes summed, in HLO", "by formula")
    return [
        f"A step of {kept['config']}, {first['rays']} rays over all devices, {first['parameters']:,} "
        f"parameters; virtual CPU devices on {kept['cores']} core(s), which may have been shared. On one "
        "device the all-reduces send nothing.",
        "",
        *common.markdown((*heads, "compiling, s"), cells),
    ]


def paper_table(counts: tuple[int, ...] = _COUNTS) -> list[str]:
    """Returns the lines of the model on paper: the paper's networks with its batch, split and grown."""
    flops, size = step_flops(**PAPER), gradient_bytes(sum(PAPER["parameters"]))
    cells = []
    for machine in MACHINES:
        for count in counts:
            compute, summing, split = predict(machine, count, flops=flops, size=size)
            grown = predict(machine, count, flops=flops, size=size, grow=True)[2]
            cells.append((machine.name, str(count), f"{1e3 * compute:.3f}", f"{1e3 * summing:.3f}",
                          f"{split:.0%}", f"{grown:.0%}"))  # fmt: skip
    heads = ("machine", "devices", "arithmetic, ms", "sum, ms", "efficiency", "efficiency, batch grown")
    sources = [f"{machine.name}: {machine.source}." for machine in MACHINES]
    return [
        f"On paper, not measured: {PAPER['rays']} rays a step over all devices (grown: each), "
        f"{flops / 1e12:.2f} TFLOP, {size / 1e6:.2f} MB of gradient. Published: {' '.join(sources)} "
        f"Assumed: that a step reaches {MACHINES[0].utilization:.0%} of the peak, "
        "rings, no overlap, and 2 to 5 us a message.",
        "",
        *common.markdown(heads, cells),
    ]


def plot(kept: dict[str, Any], path: pathlib.Path) -> None:
    """Plots the measured rays/s, and the efficiency on paper."""
    pyplot = common.pyplot()
    if pyplot is None:
        return
    figure, axes = pyplot.subplots(1, 2, figsize=(11, 4), layout="constrained")
    names = [f"{row['processes']} x {row['devices']}" for row in kept["rows"]]
    axes[0].bar(names, [row["rays_per_second"] for row in kept["rows"]])
    axes[0].set(xlabel="processes x virtual devices", ylabel=f"rays/s, {kept['cores']} core(s)")
    flops, size = step_flops(**PAPER), gradient_bytes(sum(PAPER["parameters"]))
    for index, machine in enumerate(MACHINES):
        for grow, style in ((False, "o-"), (True, "s--")):
            values = [predict(machine, n, flops=flops, size=size, grow=grow)[2] for n in _COUNTS]
            label = machine.name + (", batch grown" if grow else "")
            axes[1].plot(_COUNTS, values, style, color=f"C{index}", label=label)
    axes[1].set(xscale="log", xlabel="devices, on paper", ylabel="efficiency", ylim=(0, 1.05))
    axes[1].legend(fontsize=7)
    common.save_figure(figure, path)


if __name__ == "__main__":
    cli.run(main)
