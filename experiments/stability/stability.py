"""Measures how far core is from exact: on the hard cases, and on the worst inputs that a search finds.

    python experiments/stability/stability.py [--page=FILE.md] [--search] [--rows=psnr,ssim]

Prints for each case of tests/hard_cases the error that is nearest to its bar, or furthest beyond it, of the values
and of the gradients; and the sums by family, beside the forms of the released codes on the same cases. Prints the
known maximum errors of all public functions, see tests/known_errors. With --search it looks for larger ones first,
starting from those that are known, and records them with their bounds in tests/known_errors/bounds.json, for all
functions or for --rows only. With --page the tables in that file are replaced: "stability" and "known errors".
"""

import itertools
import json
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

sys.path += [str(pathlib.Path(__file__).resolve().parents[up] / name) for up, name in ((1, ""), (2, "tests"))]
import common

from hard_cases import ALL, compositing, importance, naive
from jaxnerf.runtime import cli
from jaxnerf.runtime.atomic_files import write_text
from known_errors import ROWS, Row, records, search
from known_errors.rows import flat

HEADS = ("family", "cases", "checks", "failed", "worst value", "worst gradient", "naive: failed")
_SEARCH = flags.DEFINE_bool("search", False, "Search for larger errors than those that are known.")
_NAMES = flags.DEFINE_list("rows", [], "Functions to search, all if empty; the hard cases are then not run.")
_GENERATIONS = flags.DEFINE_integer("generations", 40, "How often the search changes the worst inputs.", lower_bound=0)
_SEED = flags.DEFINE_integer("seed", 0, "Of the search.")
_BATCH, _REPEATS = 4096, 9  # of timings: inputs at once, and calls, of which the fastest counts


def main(argv: list[str]) -> None:
    """Prints the cases and the tables."""
    del argv
    names = common.chosen("--rows", _NAMES.value, [row.name for row in ROWS])
    if _SEARCH.value:
        search_rows(names)
    common.publish(errors_table(), "known errors")
    if not names:
        common.publish(_table(), "stability")


def _table():
    """Prints every case, and returns the lines of the families."""
    lines = common.markdown(HEADS, [family(*group) for group in _families()])
    outside, _ = importance.padding_bias(importance.PADDING)
    lines += [
        "",
        f"A padding of {importance.PADDING:g} on the weights puts {100 * outside:.1f} % of the samples outside "
        f"the weight, where that is {importance.OPACITY:g} in one of {importance.SEGMENTS} segments.",
    ]
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


def search_rows(names: list[str]) -> None:
    """Searches for the largest errors of rows, all if no names are given, and records them in the table of bounds."""
    table = records.read()
    for row in ROWS:
        if names and row.name not in names:
            continue
        meter, old = search.Meter(row), table.get(str(row), {})
        found = search.climb(meter, generations=_GENERATIONS.value, seed=_SEED.value, known=records.known(old))
        table[str(row)] = {"nanoseconds": nanoseconds(row)} | {
            " ".join(column): records.entry(worst) for column, worst in found.items()
        }
        table = {str(each): table[str(each)] for each in ROWS if str(each) in table}
        write_text(records.PATH, json.dumps(table) + "\n")
        errors = [f"{column} {worst.error:.3g}" for (column, worst) in ((" ".join(c), w) for c, w in found.items())]
        print(f"{row}: {', '.join(errors)}", flush=True)
        jax.clear_caches()


def nanoseconds(row: Row) -> float:
    """Returns the time of the jitted function for each number of its inputs or outputs, whichever are more."""
    z = np.random.default_rng(0).uniform(size=(_BATCH, row.size()))
    inputs = jax.tree.map(jnp.asarray, row.decode(z))
    run = jax.jit(jax.vmap(lambda given: flat(row.run(**given))))
    count = max(run(inputs).size, sum(x.size for name, x in inputs.items() if name not in row.fixed))
    return float(f"{1e9 * min(common.times(lambda: run(inputs), _REPEATS)) / count:.2g}")


def errors_table() -> list[str]:
    """Returns the lines of the table of known errors: of each function, the variant with the largest."""
    found: dict[str, dict[str, tuple[float, str]]] = {}
    for row in ROWS:
        record, columns = records.read()[str(row)], found.setdefault(row.name, {})
        for column, each in record.items():
            if isinstance(each, dict) and each["found"] >= columns.get(column, (-1.0, ""))[0]:
                variant = f"{row.variant}: " if row.variant else ""
                columns[column] = each["found"], variant + _abbreviated(row, each["inputs"])
        most = max(record["nanoseconds"], columns.get("nanoseconds", (0.0, ""))[0])
        columns["nanoseconds"] = most, ""
    rows = []
    for name, columns in found.items():
        cells = [" / ".join(_number(columns.get(f"{way} {kind}")) for kind in search.KINDS) for way in search.WAYS]
        worst = max(columns[f"jitted {kind}"] for kind in search.KINDS if f"jitted {kind}" in columns)
        rows.append((f"`{name}`", *cells, worst[1], f"{columns['nanoseconds'][0]:.2g}"))
    return common.markdown(("function", *search.WAYS, "jitted: the input with the largest error", "ns"), rows)


def _number(found):
    return "-" if found is None else f"{found[0]:.2g}" if found[0] < 100 else f"{found[0]:.0e}".replace("e+0", "e")


def _abbreviated(row, inputs):
    """Returns the inputs in a few characters: numbers and vectors of three, and the ends of longer ones."""
    parts = []
    for name, value in inputs.items():
        values = np.ravel(value)
        if name in row.fixed or name == "unused":
            continue
        shown = (
            " ".join(f"{x:.2g}" for x in values) if values.size <= 3 else f"{values.min():.2g} ... {values.max():.2g}"
        )
        parts.append(f"{name} {shown}")
    return ", ".join(parts)


if __name__ == "__main__":
    cli.run(main)
