"""Counts what a training step does at the sizes of an accelerator, and the time that takes on paper.

    JAXNERF_SCENES=... python experiments/gpu/roofline.py [--out=docs/results/gpu_roofline.md] [--tiny]

The counts are those of the traced step: multiply-adds of its matrix products, rows that it gathers and adds to, and
values that its other operations write, which XLA fuses. No accelerator is needed. A loop counts as often as it runs,
and a branch as its most expensive case, except for the update of the occupancy grid, which has a row of its own.
"""

import dataclasses
import math
import pathlib
import re
import sys
from typing import Any

import jax
import jax.extend
import jax.numpy as jnp
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
sys.path.append(str(pathlib.Path(__file__).resolve().parent))
import common
import profiles

from jaxnerf.runtime import cli
from jaxnerf.runtime.atomic_files import write_text
from jaxnerf.training import auto_config, build
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step

_OUT = flags.DEFINE_string("out", "", "The page to write; when it is not given, the page is printed.")
_TINY = flags.DEFINE_bool("tiny", False, "Count a step of the embedded scene at tiny sizes, as a test.")
# At 800 x 800 the table is twice as large, and there is one level more; these images load faster.
_CONFIGS = {
    "lego_fast": {"data.factor": 2},
    "blender_paper": {"data.factor": 2},
}


@dataclasses.dataclass
class Counts:
    """What a traced function does.

    Attributes:
        flops: of matrix products, by the type of their operands.
        product_bytes: operands and results of these products.
        gathers, scatters: operations.
        gathered, scattered: their rows.
        row_bytes: what gathers and scatters move, at least a sector a row; an addition reads and writes.
        other_bytes: results of all other operations; those that are fused stay in registers.
        operations: other operations.
        conditionals: branches and loops with a traced condition, whose predicate the host may read.
    """

    flops: dict = dataclasses.field(default_factory=dict)
    product_bytes: float = 0
    gathers: int = 0
    scatters: int = 0
    gathered: int = 0
    scattered: int = 0
    row_bytes: float = 0
    other_bytes: float = 0
    operations: int = 0
    conditionals: int = 0

    def add(self, other: "Counts", times: int = 1) -> None:
        """Adds the counts of a function that is called so many times."""
        for name, value in vars(other).items():
            if name == "flops":
                for dtype, count in value.items():
                    self.flops[dtype] = self.flops.get(dtype, 0) + times * count
            else:
                setattr(self, name, getattr(self, name) + times * value)


def count(jaxpr) -> Counts:
    """Returns the Counts of a jaxpr."""
    total = Counts()
    for equation in jaxpr.eqns:
        name, inner = equation.primitive.name, [count(part) for part in _inner(equation)]
        sizes = [variable.aval.size * variable.aval.dtype.itemsize for variable in equation.outvars]
        if name == "scan":
            total.add(inner[0], equation.params["length"])
        elif None in (equation.params.get("branches_platforms") or ()):  # the others are for a CPU
            total.add(inner[equation.params["branches_platforms"].index(None)])
        elif name in ("cond", "while"):
            total.conditionals += 1
            total.add(max(inner, key=lambda part: sum(part.flops.values()) + part.row_bytes + part.other_bytes))
        elif name == "dot_general":
            left, right = (variable.aval for variable in equation.invars)
            (contracted, _), _ = equation.params["dimension_numbers"]
            flops = 2 * equation.outvars[0].aval.size * math.prod(left.shape[axis] for axis in contracted)
            total.flops[str(left.dtype)] = total.flops.get(str(left.dtype), 0) + flops
            total.product_bytes += sum(value.size * value.dtype.itemsize for value in (left, right)) + sum(sizes)
        elif name == "gather":
            indices = equation.invars[1].aval
            rows = indices.size // max(indices.shape[-1] if indices.shape else 1, 1)
            total.gathers, total.gathered = total.gathers + 1, total.gathered + rows
            total.row_bytes += max(sizes[0], profiles.SECTOR * rows) + sizes[0]
        elif name.startswith("scatter"):
            indices, updates = equation.invars[1].aval, equation.invars[2].aval
            rows = indices.size // max(indices.shape[-1] if indices.shape else 1, 1)
            total.scatters, total.scattered = total.scatters + 1, total.scattered + rows
            total.row_bytes += 2 * max(updates.size * updates.dtype.itemsize, profiles.SECTOR * rows)
        elif inner:
            for part in inner:
                total.add(part)
        else:
            total.operations += 1
            total.other_bytes += sum(sizes)
    return total


def _inner(equation):
    """Returns the jaxprs that an equation calls."""
    found = []
    for value in equation.params.values():
        for part in value if isinstance(value, tuple | list) else [value]:
            if isinstance(part, jax.extend.core.ClosedJaxpr):
                found.append(part.jaxpr)
            elif isinstance(part, jax.extend.core.Jaxpr):
                found.append(part)
    return found


def parts(config, views) -> tuple[dict[str, Counts], Any, tuple]:
    """Returns the Counts of a training step's parts at the sizes of a GPU, the resolved config, and the step.

    The step is the function, without updates of the grid, and its arguments.
    """
    resolved = auto_config.resolve(config, views, platform="gpu").config
    resolved, _ = auto_config.resolve_for_device(resolved, "gpu")
    experiment = build.build(resolved)
    model = experiment.model
    cells, data = experiment.prepare(views)
    state = jax.eval_shape(lambda: create_state(model, experiment.optimizer, experiment.config.seed, cells))
    positions = jax.ShapeDtypeStruct((1, resolved.train.batch_size), jnp.int32)
    without = data._replace(cells=None if data.cells is None else data.cells[:0])
    parts = model, experiment.optimizer, experiment.draw, experiment.losses
    step = make_train_step(*parts, pixel_rays=experiment.pixel_rays)

    def draw(step, positions, data):
        return experiment.draw(step, positions[0], data)[1]

    def descend(grads, state):
        return experiment.optimizer.update(grads, state.opt_state, state.params)

    def update(state, data):
        return model.grid_schedule.update(jax.random.key(0), state.step, state.params, state.grid, data.cells)

    found = {
        "whole step": _traced(step, state, without, positions),
        "drawing the rays": _traced(draw, state.step, positions, data),
        "optimizer": _traced(descend, state.params, state),
    }
    if model.grid_schedule is not None:
        found["update of the grid"] = _traced(update, state, data)
    return found, resolved, (step, (state, without, positions))


def _traced(function, *arguments):
    return count(jax.make_jaxpr(function)(*arguments).jaxpr)


def seconds(counts: Counts, peaks: profiles.Peaks) -> dict[str, float]:
    """Returns the seconds on paper of matrix products, of rows at random places, and of predicates on the host."""
    rates = {"bfloat16": peaks.bfloat16, "float32": peaks.tf32}
    products = sum(flops / rates.get(dtype, peaks.float32) for dtype, flops in counts.flops.items())
    return {
        "products": max(products, counts.product_bytes / peaks.bytes_per_second),
        "rows": counts.row_bytes / peaks.bytes_per_second,
        "host": counts.conditionals * peaks.visit_seconds,
    }


def compiled_counts(function, arguments) -> dict[str, float]:
    """Returns the kernels, FLOPs and bytes of a step that is compiled for this machine's processor.

    A compiler for another device fuses differently, so these say how many launches and bytes to expect, not more.
    """
    compiled = jax.jit(function).lower(*arguments).compile()
    entry = compiled.as_text().split("ENTRY", 1)[1]
    kinds = [match.group(1) for match in re.finditer(r"= [^=]*? ([a-z][\w-]*)\(", entry)]
    free = {"parameter", "constant", "get-tuple-element", "tuple", "bitcast"}
    costs = compiled.cost_analysis()
    kernels = sum(kind not in free for kind in kinds)
    return {"kernels": kernels, "flops": costs["flops"], "bytes": costs["bytes accessed"]}


def page(name: str, config, found: dict[str, Counts], compiled: dict[str, float]) -> list[str]:
    """Returns the lines about a config's step."""
    rays, samples = config.train.batch_size, build.build_model(config).samples_per_ray
    lines = [
        f"## {name}: {rays:,} rays, {rays * samples:,.0f} samples of the largest network",
        "",
        "| part | matrix products | gathered rows | added rows | bytes of rows | branches and loops |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for part, counts in found.items():
        flops = ", ".join(f"{value / 1e9:,.2f} GFLOP {dtype}" for dtype, value in sorted(counts.flops.items()))
        lines.append(
            f"| {part} | {flops or 'none'} | {counts.gathered:,} in {counts.gathers} | "
            f"{counts.scattered:,} in {counts.scatters} | {counts.row_bytes / 1e6:,.1f} MB | {counts.conditionals} |"
        )
    lines += [
        "",
        f"Compiled for a CPU the step has {compiled['kernels']} operations, {compiled['flops'] / 1e9:,.2f} GFLOP, and "
        f"accesses {compiled['bytes'] / 1e6:,.0f} MB.",
        "",
        "| on paper | products | rows | other bytes | launches | branches and loops | step |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    whole = found["whole step"]
    for device, peaks in profiles.PEAKS.items():
        times = seconds(whole, peaks)
        times["bytes"] = max(compiled["bytes"] - whole.row_bytes - whole.product_bytes, 0) / peaks.bytes_per_second
        times["launches"] = compiled["kernels"] * peaks.launch_seconds
        cells = [f"{1e3 * times[key]:.3f} ms" for key in ("products", "rows", "bytes", "launches", "host")]
        lines.append(f"| {device} | {' | '.join(cells)} | {1e3 * sum(times.values()):.2f} ms |")
    return lines


def main(argv: list[str]) -> None:
    """Counts the steps and writes the page."""
    del argv
    rates = [
        (name, f"{peaks.bytes_per_second / 1e12:g} TB/s")
        + tuple(f"{rate / 1e12:g} TFLOP/s" for rate in (peaks.float32, peaks.tf32, peaks.bfloat16))
        for name, peaks in profiles.PEAKS.items()
    ]
    lines = [
        "# A training step on paper, at the sizes of a GPU",
        "",
        *common.provenance(),
        "",
        "Nothing on this page was measured on an accelerator; [the measurements](gpu.md) are on another page. The "
        "operations of a training step are counted, at the sizes that `auto` fields get on a GPU, and divided by what "
        "the data sheets of GPUs state:",
        "",
        *common.markdown(("", "memory", "float32", "products of float32 (TF32)", "products of bfloat16"), rates),
        "",
        "Counts are those of the traced step. The update of the occupancy grid is not part of the whole step: most "
        f"steps have none. A row at a random place moves at least {profiles.SECTOR} bytes, and an addition reads and "
        "writes them. Products take the time of their FLOPs or of their operands, whichever is longer. Other bytes "
        "are those of the step compiled for a CPU, without rows and operands: more than a GPU's compiler leaves. "
        f"A launch is assumed to take {1e6 * profiles.PEAKS['H100'].launch_seconds:.0f} microseconds, and a predicate "
        f"that the host reads {1e6 * profiles.PEAKS['H100'].visit_seconds:.0f}. The sum is that of parts which do not "
        "overlap.",
        "",
        "Additions to the table's gradient are atomic on a GPU, in no fixed order, so float32 sums differ between "
        "runs. With `train.deterministic` two runs are the same bit for bit.",
    ]
    for name, overrides in _CONFIGS.items():
        config = profiles.configuration(name, overrides, tiny=_TINY.value)
        found, resolved, (step, arguments) = parts(config, common.load_split(config, "train"))
        lines += ["", *page(name, resolved, found, compiled_counts(step, arguments))]
    if _OUT.value:
        write_text(pathlib.Path(_OUT.value), "\n".join(lines) + "\n")
        print(f"wrote {_OUT.value}")
    else:
        print("\n".join(lines))


if __name__ == "__main__":
    cli.run(main)
