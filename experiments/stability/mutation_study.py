"""Counts the mutants of jaxnerf/core that its tests do not notice (mutation testing, DeMillo et al. 1978).

    python experiments/stability/mutation_study.py [--count=60] [--seed=0] [--seconds=0] [--out=runs/mutation_study]
        [--results=docs/results/mutation_study.md]

A mutant is one small change of one module, such as < for <=. Those of all modules are listed from their syntax trees,
and --count of them are drawn with --seed. For each, the tests that mirror the module run in a copy of the tree until
the first fails: the fast ones, then the slow ones and the hard cases. A mutant that no test notices has survived: it
shows a missing test, or it is equivalent.

Each result is kept in --out until its module or its tests change, so that the study continues where it stopped;
--seconds ends it after that time. --results is replaced with the table of what has finished.
"""

import ast
import collections
import hashlib
import json
import os
import pathlib
import random
import shutil
import subprocess
import sys
import tempfile
import time
from typing import NamedTuple

from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.runtime import cli
from jaxnerf.runtime.atomic_files import write_text

ROOT = pathlib.Path(__file__).resolve().parents[2]
CORE = pathlib.Path("jaxnerf/core")
COUNT = flags.DEFINE_integer("count", 60, "Number of mutants.", lower_bound=1)
SEED = flags.DEFINE_integer("seed", 0, "Seed of the draw.")
SECONDS = flags.DEFINE_float("seconds", 0, "Time after which no further mutant is tested; 0: no limit.")
OUT = flags.DEFINE_string("out", "runs/mutation_study", "Folder of the results of single mutants.")
RESULTS = flags.DEFINE_string("results", None, "Markdown file to write, for example docs/results/mutation_study.md.")
TIMEOUT = 900  # s; a mutant that runs longer has been noticed

# Modules whose tests are not (only) in the file of the same name.
TESTS = {
    "safe_math": "core/test_volume_rendering core/test_cameras core/test_sampling core/occupancy/test_packed",
    "poses": "core/test_poses evaluation/test_paths",
    "types": "test_types core/test_rendering core/test_sampling",
    "varying": "core/occupancy/test_special_values",
    "sampling": "core/test_sampling core/test_stepped_edges",
    "cameras": "core/test_cameras core/test_lens_and_ndc",
    "views": "data/test_views",
    "volume_rendering": "core/test_volume_rendering core/test_quadrature core/occupancy/test_packed",
    "rendering": "core/test_rendering core/test_quadrature core/occupancy/test_special_values",
    "contraction": "core/test_contraction",
    "occupancy/grid": "core/occupancy/test_grid core/test_contraction core/occupancy/test_special_values",
    "occupancy/packed": "core/occupancy/test_packed core/occupancy/test_special_values",
    "occupancy/importance": "core/occupancy/test_importance core/occupancy/test_special_values",
    "occupancy/ray_marching": "core/occupancy/test_ray_culling core/test_contraction",
    "occupancy/ray_culling": "core/occupancy/test_ray_culling core/occupancy/test_special_values",
}

HARD_CASES = "tests/core/test_stability.py"

# Survivors that change nothing a test could see: (line, before, after), and why.
EQUIVALENT = {
    ("return _Occupied(words.reshape(-1), ends, sizes.sum(-1, dtype=jnp.int32))", "-1", "1"): "it has two axes",
    (
        'used = n < count.at[ray, None].get(mode="fill", fill_value=0)',
        "0",
        "1",
    ): "what a slot without a ray computes is dropped",
    (
        "density, rgb = jnp.where(used, density, 0), jnp.where(used[..., None], rgb, 0)",
        "0",
        "1",
    ): "unused samples have length 0",
    (
        "if rays * (most + 1) > 2**32:  # too large for such numbers",
        "rays * (most + 1) > 2**32",
        "rays * (most + 1) >= 2 ** 32",
    ): "both sorts give the same order",
}

_SWAPPED = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult,
}  # fmt: skip
_RENAMED = {
    "minimum": "maximum", "maximum": "minimum", "min": "max", "max": "min", "floor": "ceil", "ceil": "floor",
    "any": "all", "all": "any", "cumsum": "cumprod", "float32": "bfloat16", "sin": "cos", "cos": "sin",
}  # fmt: skip


class Mutant(NamedTuple):
    """A change of one module.

    Attributes:
        module: its name below jaxnerf/core, as in TESTS.
        line: number of the line.
        before, after: source of the expression.
        text: the line.
        source: of the whole changed module.
    """

    module: str
    line: int
    before: str
    after: str
    text: str
    source: str

    @property
    def name(self) -> str:
        return f"{self.module}: {self.before} -> {self.after}"


def mutants_of(module: str, source: str) -> list[Mutant]:
    """Returns all mutants of a module."""
    found, lines = [], source.splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line.encode()))
    encoded = source.encode()
    for node in _expressions(ast.parse(source)):
        before = ast.get_source_segment(source, node)
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        for after in _changes(node):
            changed = (encoded[:begin] + f"({after})".encode() + encoded[end:]).decode()
            text = lines[node.lineno - 1].strip()
            found.append(Mutant(module, node.lineno, " ".join(before.split()), after, text, changed))
    return found


def _expressions(node):
    """Yields the expressions of a tree that run: not those of errors, annotations, docstrings and keyword defaults."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "bases") or isinstance(node, ast.Raise | ast.Subscript):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, ast.JoinedStr):
                if isinstance(child, ast.expr):
                    yield child
                yield from _expressions(child)


def _changes(node):
    """Yields the sources of the changed expressions."""
    if isinstance(node, ast.BinOp) and type(node.op) in _SWAPPED:
        yield ast.unparse(ast.BinOp(node.left, _SWAPPED[type(node.op)](), node.right))
    if isinstance(node, ast.Compare) and type(node.ops[0]) in _SWAPPED:
        yield ast.unparse(ast.Compare(node.left, [_SWAPPED[type(node.ops[0])](), *node.ops[1:]], node.comparators))
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Invert | ast.Not):
        yield ast.unparse(node.operand)
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        yield repr(node.value + 1 if isinstance(node.value, int) else 2 * node.value or 1.0)
    if isinstance(node, ast.Attribute) and node.attr in _RENAMED:
        yield ast.unparse(ast.Attribute(node.value, _RENAMED[node.attr]))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute | ast.Name):
        called = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id
        if called in ("stop_gradient", "clip", "clamp", "abs", "vary_like", "round") and node.args:
            yield ast.unparse(node.args[0])
        if called == "expm1":
            yield f"jnp.exp({ast.unparse(node.args[0])}) - 1"
        if called == "where" and len(node.args) == 3:
            yield ast.unparse(ast.Call(node.func, [node.args[0], node.args[2], node.args[1]], node.keywords))


def tests_of(module: str) -> list[str]:
    """Returns the test files of a module."""
    folder, _, name = f"core/{module}".rpartition("/")
    return [f"tests/{each}.py" for each in TESTS.get(module, f"{folder}/test_{name}").split()]


def test_mutant(mutant: Mutant, tree: pathlib.Path) -> str:
    """Returns "killed", "timeout" or "survived"; the tree is a copy of this one, and is left as it was."""
    path = tree / CORE / f"{mutant.module}.py"
    original = path.read_text()
    path.write_text(mutant.source)
    command = [sys.executable, "-B", "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    tests = tests_of(mutant.module)
    try:
        for chosen in (["-m", "not slow", *tests], ["-m", "slow", *tests, HARD_CASES]):
            done = subprocess.run([*command, *chosen], cwd=tree, env=environment, timeout=TIMEOUT, capture_output=True)
            if done.returncode in (1, 2):  # a test failed, or a module could not be imported
                return "killed"
            if done.returncode:
                output = done.stdout.decode()[-500:]
                raise RuntimeError(f"{mutant.name}: pytest ended with {done.returncode}: {output}")
    except subprocess.TimeoutExpired:
        return "timeout"
    finally:
        path.write_text(original)
    return "survived"


def _key(mutant):
    """Returns the name of a result: it changes with the module and with its tests."""
    content = [mutant.source, *((ROOT / test).read_text() for test in tests_of(mutant.module))]
    return hashlib.sha256("\0".join(content).encode()).hexdigest()[:16]


def report(results: list[tuple[Mutant, str]], total: int, drawn: int) -> str:
    """Returns the text of --results."""
    outcomes, modules = collections.Counter(outcome for _, outcome in results), collections.defaultdict(list)
    for mutant, outcome in results:
        modules[mutant.module].append(outcome)
    lines = [
        "# What tests notice",
        "",
        *common.provenance(),
        "",
        "A mutant is `jaxnerf/core` with one small change, such as `<` in place of `<=`. A mutant that no test notices "
        "shows a missing test, or computes the same.",
        "",
        f"Of {total:,} mutants {drawn} were drawn and {len(results)} tested; {outcomes['survived']} survived. "
        f"{outcomes['timeout']} never ended, which counts as noticed.",
        "",
        "| module | tested | survived |",
        "|---|---|---|",
    ]
    lines += [f"| {name} | {len(each)} | {each.count('survived')} |" for name, each in sorted(modules.items())]
    survivors = [mutant for mutant, outcome in results if outcome == "survived"]
    lines += ["", "| survivor | before | after | why |", "|---|---|---|---|"] if survivors else []
    for mutant in survivors:
        cells = [f"{mutant.module}:{mutant.line}: `{mutant.text}`", f"`{mutant.before}`", f"`{mutant.after}`"]
        cells.append(EQUIVALENT.get((mutant.text, mutant.before, mutant.after), "a test is missing"))
        lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return "\n".join(lines) + "\n"


def main(_) -> None:
    """Tests the mutants and writes the table."""
    started, folder = time.monotonic(), pathlib.Path(OUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    paths = sorted((ROOT / CORE).rglob("[!_]*.py"))
    every = []
    for path in paths:
        every += mutants_of(path.relative_to(ROOT / CORE).with_suffix("").as_posix(), path.read_text())
    drawn = random.Random(SEED.value).sample(every, min(COUNT.value, len(every)))
    results = []
    with tempfile.TemporaryDirectory() as place:
        tree = pathlib.Path(place) / "tree"
        for name in ("jaxnerf", "tests", "experiments"):
            shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
        for name in ("setup.cfg", "pyproject.toml"):
            shutil.copy(ROOT / name, tree)
        for mutant in drawn:
            kept = folder / f"{_key(mutant)}.json"
            if kept.exists():
                results.append((mutant, json.loads(kept.read_text())["outcome"]))
            elif not SECONDS.value or time.monotonic() - started < SECONDS.value:
                outcome = test_mutant(mutant, tree)
                write_text(kept, json.dumps({"mutant": mutant.name, "outcome": outcome}) + "\n")
                print(f"{outcome:9}{mutant.module}:{mutant.line}  {mutant.before} -> {mutant.after}", flush=True)
                results.append((mutant, outcome))
    text = report(results, len(every), len(drawn))
    print(text)
    if RESULTS.value:
        write_text(pathlib.Path(RESULTS.value), text)


if __name__ == "__main__":
    cli.run(main)
