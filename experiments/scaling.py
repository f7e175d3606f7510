"""Rays/s, memory, collective bytes and compile time against devices and processes; and on paper, far beyond.

    python experiments/scaling.py --config=configs/quickstart.py --out=DIR [--devices=1,2,4,8] [--processes=2]

Each row is a process of its own (or two) with so many virtual CPU devices, which share the cores that there
are: more devices than cores cannot be faster, and show what splitting costs. Writes DIR/scaling.json and
scaling.md, and scaling.png where there is matplotlib.
"""

import json
import os
import pathlib
import socket
import subprocess
import sys

import scaling_model
import table
from absl import flags

from jaxnerf.runtime import cli
from jaxnerf.training.workdir import write_text

_OUT = flags.DEFINE_string("out", None, "Folder of the tables.", required=True)
_CONFIG = flags.DEFINE_string("config", "configs/quickstart.py", "Of the run whose step is measured.")
_DEVICES = flags.DEFINE_list("devices", ["1", "2", "4", "8"], "Of one process.")
_PROCESSES = flags.DEFINE_integer("processes", 2, "Also so many processes, of half the cores each; 0: none.")
_STEPS = flags.DEFINE_integer("steps", 20, "That are timed.", lower_bound=2)
_COUNTS = (1, 8, 16, 32, 64, 128)
_WORKER = pathlib.Path(__file__).with_name("scaling_worker.py")
# The paper's two networks: 64 and 64 + 128 evaluations a ray, with batches of 4096 rays (arXiv:2003.08934).
PAPER = {"parameters": (595_844, 595_844), "evaluations": (64, 192), "rays": 4096}


def main(argv):
    """Measures, and writes the tables and the plot."""
    del argv
    out = pathlib.Path(_OUT.value)
    out.mkdir(parents=True, exist_ok=True)
    places = [(1, int(count)) for count in _DEVICES.value]
    if _PROCESSES.value:
        places.append((_PROCESSES.value, 2))
    rows = []
    for processes, devices in places:
        rows.append(measure(_CONFIG.value, processes, devices, _STEPS.value))
        print(f"{processes} x {devices}: {rows[-1]['rays_per_second']:,.0f} rays/s", file=sys.stderr)
    kept = {"config": _CONFIG.value, "cores": len(os.sched_getaffinity(0)), "rows": rows}
    write_text(out / "scaling.json", json.dumps(kept, indent=2) + "\n")
    lines = [*measured_table(kept), "", *paper_table()]
    write_text(out / "scaling.md", "\n".join(lines) + "\n")
    print("\n".join(lines))
    draw(kept, out / "scaling.png")


def measure(config, processes, devices, steps):
    """Returns the row of a run's step in so many processes with so many devices each."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": str(devices)}
    command = [sys.executable, str(_WORKER), config, str(steps), str(port), str(processes)]
    started = [
        subprocess.Popen([*command, str(index)], env=environment, stdout=subprocess.PIPE, text=True)
        for index in range(processes)
    ]
    said = [process.communicate()[0] for process in started]
    if any(process.returncode for process in started):
        raise ValueError(f"{' '.join(command)} ended with an error; its message is above")
    found = next(line for line in said[0].splitlines() if line.startswith("{"))  # gloo speaks there, too
    return {"processes": processes, "devices": devices, **json.loads(found)}


def measured_table(kept):
    """Returns the lines of what was measured."""
    first, cells = kept["rows"][0], []
    for row in kept["rows"]:
        sent = f"{row['collective_bytes']:,} in {row['collectives']}"
        formula = scaling_model.gradient_bytes(row["parameters"])
        cells.append((f"{row['processes']} x {row['devices']}", f"{row['rays_per_second']:,.0f}",
                      f"{row['rays_per_second'] / first['rays_per_second']:.2f}",
                      f"{row['device_bytes'] / 1e6:.1f}", sent, f"{formula:,}",
                      f"{row['compile_seconds']:.1f}"))  # fmt: skip
    heads = ("processes x devices", "rays/s", "ratio", "MB a device", "bytes summed, in HLO", "by formula")
    return [
        f"A step of {kept['config']}, {first['rays']} rays over all devices, {first['parameters']:,} "
        f"parameters; virtual CPU devices on {kept['cores']} core(s), which may have been shared. On one "
        "device the sum is there, and sends nothing.",
        "",
        *table.markdown((*heads, "compiling, s"), cells),
    ]


def paper_table(counts=_COUNTS):
    """Returns the lines of the model on paper: the paper's networks with its batch, split, and grown."""
    flops, size = scaling_model.step_flops(**PAPER), scaling_model.gradient_bytes(sum(PAPER["parameters"]))
    cells = []
    for machine in scaling_model.MACHINES:
        for count in counts:
            compute, summing, split = scaling_model.predict(machine, count, flops=flops, size=size)
            grown = scaling_model.predict(machine, count, flops=flops, size=size, grow=True)[2]
            cells.append((machine.name, str(count), f"{1e3 * compute:.3f}", f"{1e3 * summing:.3f}",
                          f"{split:.0%}", f"{grown:.0%}"))  # fmt: skip
    heads = ("machine", "devices", "arithmetic, ms", "sum, ms", "efficiency", "efficiency, batch grown")
    sources = [f"{machine.name}: {machine.source}." for machine in scaling_model.MACHINES]
    return [
        f"On paper, not measured: {PAPER['rays']} rays a step over all devices (grown: each), "
        f"{flops / 1e12:.2f} TFLOP, {size / 1e6:.2f} MB of gradient. Published: {' '.join(sources)} "
        f"Assumed: that a step reaches {scaling_model.MACHINES[0].share:.0%} of the peak, "
        "rings, no overlap, and 2 to 5 us a message.",
        "",
        *table.markdown(heads, cells),
    ]


def draw(kept, path):
    """Draws rays/s measured, and efficiency on paper; says so where there is no matplotlib."""
    try:
        import matplotlib
    except ImportError:
        print("no plot, which needs matplotlib: pip install 'jaxnerf[experiments]'", file=sys.stderr)
        return
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(11, 4), layout="constrained")
    names = [f"{row['processes']} x {row['devices']}" for row in kept["rows"]]
    axes[0].bar(names, [row["rays_per_second"] for row in kept["rows"]])
    axes[0].set(xlabel="processes x virtual devices", ylabel=f"rays/s, {kept['cores']} core(s)")
    flops, size = scaling_model.step_flops(**PAPER), scaling_model.gradient_bytes(sum(PAPER["parameters"]))
    for index, machine in enumerate(scaling_model.MACHINES):
        for grow, style in ((False, "o-"), (True, "s--")):
            values = [scaling_model.predict(machine, n, flops=flops, size=size, grow=grow)[2] for n in _COUNTS]
            label = machine.name + (", batch grown" if grow else "")
            axes[1].plot(_COUNTS, values, style, color=f"C{index}", label=label)
    axes[1].set(xscale="log", xlabel="devices, on paper", ylabel="efficiency", ylim=(0, 1.05))
    axes[1].legend(fontsize=7)
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    cli.run(main)
