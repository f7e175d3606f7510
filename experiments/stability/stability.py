"""Measures how far the renderer is from exact on the hard cases, and what exactness costs.

    python experiments/stability/stability.py [--page=FILE.md] [--cost_only]

Prints for each case of tests/hard_cases the error that is nearest to its bar, or furthest beyond it, of the values
and of the gradients; the sums by family, beside the forms of the released codes on the same cases; and the time of
value and gradient of jaxnerf's compositing beside the released codes' cumulative product, in turn. With --page the
table of families in that file, between the lines <!-- stability --> and <!-- /stability -->, is replaced.
"""

import functools
import itertools
import pathlib
import statistics
import sys
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

sys.path += [str(pathlib.Path(__file__).resolve().parents[up] / name) for up, name in ((1, ""), (2, "tests"))]
import common

from hard_cases import ALL, compositing, importance, naive
from jaxnerf import Rays, Samples, render_samples
from jaxnerf.runtime import cli

HEADS = ("family", "cases", "checks", "failed", "worst value", "worst gradient", "naive: failed")
_COST_ONLY = flags.DEFINE_bool("cost_only", False, "Skip the table.")
_REPEATS = flags.DEFINE_integer("repeats", 101, "Pairs of timings; the median of their ratios counts.", lower_bound=1)
_SIZES = ((4096, 64), (1024, 192), (256, 768))  # rays, samples


def main(argv: list[str]) -> None:
    """Prints the cases and the table, then the cost."""
    del argv
    lines = [] if _COST_ONLY.value else _table()
    for line in cost():
        print(line, flush=True)
        lines.append(line + "  ")
    if common.PAGE.value and not _COST_ONLY.value:
        common.replace(pathlib.Path(common.PAGE.value), lines, "stability")


def _table():
    """Prints every case, then the families, and returns the lines of the families."""
    lines = common.markdown(HEADS, [family(*group) for group in _families()])
    outside, _ = importance.padding_bias(importance.PADDING)
    lines += [
        "",
        f"A padding of {importance.PADDING:g} on the weights puts {100 * outside:.1f} % of the samples outside "
        f"the weight, where that is {importance.OPACITY:g} in one of {importance.SEGMENTS} segments.",
        "",
    ]
    print("\n".join(lines))
    return lines


def family(name: str, cases: list, others: list) -> tuple[str, ...]:
    """Prints a family's cases and returns the row of their sums; others are the same cases of another form."""
    checks = []
    for case in cases:
        found = case.run()
        checks += found
        finite = all(check.passed for check in found if check.kind == "finite")
        print(
            f"{case}\n    value     {_worst(found, 'value')}\n    gradient  {_worst(found, 'gradient')}\n"
            f"    {'finite' if finite else 'NOT FINITE'}",
            flush=True,
        )
    # Its depth and disparity follow other conventions, so differences there are no failures.
    naive_checks = [
        check for case in others for check in case.run() if not ({"depth", "disparity"} & set(check.what.split()))
    ]
    return (
        name,
        str(len(cases)),
        str(len(checks)),
        str(_failed(checks)),
        _fraction(checks, "value"),
        _fraction(checks, "gradient"),
        f"{_failed(naive_checks)} of {len(naive_checks)}" if others else "-",
    )


def _families():
    """Yields (name, its cases, the cases of the released codes' form)."""
    others = {
        "compositing": compositing.cases(render=naive.render_samples),
        "compositing, bfloat16": compositing.cases(render=naive.render_samples, outputs="bfloat16"),
        "importance": importance.cases(invert=naive.inverse_cdf),
    }
    for name, cases in itertools.groupby(ALL, lambda case: case.family):
        yield name, list(cases), others.get(name, [])


def _failed(checks):
    return sum(not check.passed for check in checks)


def _ratio(check):
    """Returns the error over its bar; infinite for NaN and for any error where the bar is 0."""
    if check.error == 0:
        return 0.0
    return check.error / check.bar if check.bar and not np.isnan(check.error) else np.inf


def _worst(checks, kind):
    found = [check for check in checks if check.kind == kind]
    if not found:
        return "-"
    worst = max(found, key=_ratio)
    if worst.error == 0:
        return "no error"
    return f"{worst}" + ("" if worst.passed else "  <- FAILED")


def _fraction(checks, kind):
    ratios = [_ratio(check) for check in checks if check.kind == kind]
    return f"{100 * max(ratios):.0f} %" if ratios else "-"


def cost() -> Iterator[str]:
    """Yields a line for each size: time of value and gradient against the naive form, interleaved."""
    yield common.describe_machine()
    for shape in _SIZES:
        arrays = _arrays(*shape)
        ours, theirs = (_value_and_slopes(render) for render in (render_samples, naive.render_samples))
        pairs = []
        for turn in range(_REPEATS.value + 1):
            order = (ours, theirs) if turn % 2 else (theirs, ours)  # neither always runs in a warm cache
            times = {run: common.seconds(functools.partial(run, arrays)) for run in order}
            pairs.append((times[ours], times[theirs]))
        pairs = pairs[1:]  # the first compiles
        own, other = (1e3 * statistics.median(times) for times in zip(*pairs, strict=True))
        ratios = sorted(a / b for a, b in pairs)
        low, middle, high = (ratios[len(ratios) * part // 4] for part in (1, 2, 3))
        yield (
            f"{shape[0]} rays x {shape[1]} samples: value and gradient {own:.2f} ms, naive {other:.2f} ms, "
            f"median of ratios {middle:.3f} (quartiles {low:.3f} to {high:.3f})"
        )


def _arrays(rays, samples):
    """Returns random density, rgb, rays and samples, and the gradient that reaches each output."""
    rng = np.random.default_rng(0)
    shape = rays, samples
    edges = np.sort(rng.uniform(2, 6, (rays, samples + 1)), axis=-1)
    directions = rng.normal(size=(rays, 3))
    viewdirs = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return jax.tree.map(
        lambda leaf: jnp.asarray(leaf, jnp.float32),
        {
            "density": 4 * rng.exponential(size=shape) * (rng.uniform(size=shape) < 0.5),
            "rgb": rng.uniform(size=(*shape, 3)),
            "rays": Rays(
                origins=np.zeros((rays, 3)),
                directions=directions,
                viewdirs=viewdirs,
                near=np.full(rays, 2.0),
                far=np.full(rays, 6.0),
            ),
            "samples": Samples(t=(edges[:, 1:] + edges[:, :-1]) / 2, delta=np.diff(edges)),
            "slopes": {name: rng.normal(size=rays) for name in ("opacity", "depth", "disparity")}
            | {"rgb": rng.normal(size=(rays, 3))},
        },
    )


def _value_and_slopes(render):
    """Returns a compiled function of _arrays: all outputs, and their gradient by density and colour."""

    def total(field, rays, samples, slopes):
        seen = render(lambda x, viewdirs: field, rays, samples)
        return sum((getattr(seen, name) * slope).sum() for name, slope in slopes.items()), seen

    run = jax.jit(jax.value_and_grad(total, has_aux=True))
    return lambda given: run((given["density"], given["rgb"]), given["rays"], given["samples"], given["slopes"])


if __name__ == "__main__":
    cli.run(main)
