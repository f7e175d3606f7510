"""The documents: links lead somewhere, every public name and every page is listed, and Python examples run."""

import re

import jax
import pytest
from ml_collections import ConfigDict

import jaxnerf
from jaxnerf import registry
from jaxnerf.configs import default
from jaxnerf.options import declarations
from jaxnerf.tools.exporters.registration import EXPORTERS
from jaxnerf.tools.uncertainty.registration import ESTIMATORS
from runs import ROOT, run_forked

pytest_plugins = ["run_fixtures"]

DOCS = ROOT / "docs"
PUBLIC = r"^::: jaxnerf\.(\w+)$"
# `make docs` writes these pages, see examples/notebooks/pages.py.
OF_NOTEBOOKS = {DOCS / f"tutorials/notebooks/{each.stem}.md" for each in (ROOT / "examples/notebooks").glob("*.ipynb")}
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted({*DOCS.rglob("*.md")} - OF_NOTEBOOKS)]
EXAMPLES = [
    pytest.param(found.group(1), id=f"{page.relative_to(ROOT)}:{page.read_text()[: found.start()].count(chr(10)) + 2}")
    for page in PAGES
    for found in re.finditer(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
    # tests/test_reuse.py runs the README's example; a trained run is needed where load_scene is called first.
    if not re.search(r"--8<--|^scene, render =", found.group(1), re.MULTILINE) and page.name != "README.md"
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_included_files_exist(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    for target in re.findall(r"\]\(([^)#\s]+)", text):
        path = (page.parent / target).resolve()
        assert re.match(r"[a-z]+:", target) or path.exists() or path in OF_NOTEBOOKS, target
    for target, place in re.findall(r"\]\(([^)#:\s]*)#([^)\s]+)\)", text):
        headings = re.findall(r"^#+ (.*)$", (page.parent / target if target else page).read_text(), re.MULTILINE)
        assert place in {re.sub(r"[^\w -]", "", head).strip().lower().replace(" ", "-") for head in headings}, place
    included = re.findall(r'^--8<-- "([^"]+)"$', page.read_text(), re.MULTILINE)
    assert len(included) == page.read_text().count("--8")
    for target in included:
        assert (ROOT / target).exists(), target


def test_every_page_is_in_the_navigation():
    listed = set(re.findall(r"\s(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    assert listed == {str(page.relative_to(DOCS)) for page in OF_NOTEBOOKS.union(DOCS.rglob("*.md"))}


@pytest.mark.parametrize("page", sorted({*(DOCS / "results").glob("*.md")} - {DOCS / "results" / "index.md"}), ids=str)
def test_results_state_command_commit_date_and_machine(page):
    rows = re.findall(
        r"^\| command \| commit \| machine \|\n.*\n\| (.*) \| (.*) \| (.+) \|$", page.read_text(), re.MULTILINE
    )
    assert rows
    for command, commit, _ in rows:
        assert re.search(r"`.*\.py|`jaxnerf-|as above", command)
        assert re.search(r"\b[0-9a-f]{7}\b.*, \d{4}-\d\d-\d\d$", commit)


def test_pages_that_studies_name_exist():
    named = {
        path for file in (ROOT / "experiments").rglob("*.py") for path in re.findall(r"docs/\S+\.md", file.read_text())
    }
    assert [path for path in sorted(named) if not (ROOT / path).exists()] == []


def test_every_page_of_results_is_in_its_index():
    listed = re.findall(r"^\| \[.*?\]\((\w+\.md)\)", (DOCS / "results" / "index.md").read_text(), re.MULTILINE)
    assert sorted([*listed, "index.md"]) == sorted(page.name for page in (DOCS / "results").glob("*.md"))


def test_every_public_name_is_on_one_page():
    text = "".join(page.read_text() for page in (DOCS / "api").iterdir())
    assert sorted(re.findall(PUBLIC, text, re.MULTILINE)) == sorted(jaxnerf.__all__)


@pytest.mark.parametrize("page", sorted((DOCS / "api").iterdir()), ids=lambda page: page.name)
def test_every_public_name_is_in_an_example_of_its_page(page):
    code = "".join(re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE))
    names = re.findall(PUBLIC, page.read_text(), re.MULTILINE)
    assert [name for name in names if not re.search(rf"\bjaxnerf\.{name}\b", code)] == []


def fenced_lines(page):
    """Returns the lines of a page's blocks without a language, without comments."""
    fences = re.findall(r"^```\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
    lines = [line for fence in fences for line in fence.replace("\\\n", " ").splitlines()]
    return [line.split(" #")[0].strip() for line in lines]


def commands(page):
    """Yields the commands of a page: lines of its blocks, and code in the text that begins as one."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    for line in [*fenced_lines(page), *re.findall(r"`([^`]+)`", text)]:
        for command in re.split(r"; |&& ", line.replace("\n", " ")):
            command = re.sub(r"^(\w+=\S* |taskset -c \d )+", "", command.strip())
            if re.match(r"(jaxnerf-\w|python3? |make |pip3? install|--\w)", command):
                yield command


def defined_flags(files):
    """Returns the names of the flags that Python files define, by absl or argparse."""
    text = "".join(file.read_text() for file in files)
    return set(re.findall(r'(?:DEFINE_\w+|define_\w+)\(\s*"(\w+)"', text)) | set(
        re.findall(r'add_argument\("--(\w+)"', text)
    )


PROGRAMS = dict(re.findall(r"^    (jaxnerf-\w+) = ([\w.]+):run$", (ROOT / "setup.cfg").read_text(), re.MULTILINE))
COMMON = {"help", "config", "plugins", "verbosity", "page"}  # of absl, jaxnerf/runtime/cli.py, experiments/common.py
FLAGS = {name: COMMON | defined_flags([ROOT / f"{module.replace('.', '/')}.py"]) for name, module in PROGRAMS.items()}
FLAGS["jaxnerf-export"] |= {name for kind in EXPORTERS.names() for name in declarations(EXPORTERS.get(kind).options)}
for name in ("jaxnerf-eval", "jaxnerf-render"):
    FLAGS[name] |= defined_flags([ROOT / "jaxnerf" / "evaluation" / "run_flags.py"])
ALL_FLAGS = set.union(*FLAGS.values(), defined_flags((ROOT / "experiments").rglob("*.py")))


EXAMPLE_SECTIONS = {  # of the config, with the plugins of the documents
    name
    for file in (ROOT / "tests" / "extending").glob("*.py")
    for name in re.findall(r'register_(?:field|sampler)\("(\w+)"', file.read_text())
}


def faults(command):
    """Returns what a command names and does not exist: programs, files, targets, extras, flags, configs and fields."""
    words = command.split()
    found, flags = [], ALL_FLAGS
    if words[0] in PROGRAMS:
        flags = FLAGS[words[0]]
    elif words[0].startswith("jaxnerf-"):
        found.append(words[0])
    elif words[0] == "make" and not re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE):
        found.append(words[1])
    elif words[0] == "pip":
        extras = re.findall(r"^(\w+) =", (ROOT / "setup.cfg").read_text().split("extras_require]")[1], re.MULTILINE)
        found += [
            extra for names in re.findall(r"'\.\[(.*?)\]", command) for extra in set(names.split(",")) - {*extras}
        ]
    elif words[0].startswith("python") and words[1].endswith(".py"):
        script = ROOT / words[1]
        if not script.exists():
            return [words[1]]
        flags = COMMON | defined_flags(script.parent.glob("*.py"))
    elif words[0].startswith("python"):
        return []
    for name, value in re.findall(r"--([\w.]+)(?:=(\S+))?", command):
        if name.startswith("config."):
            found += _missing_field(name)
        elif words[0] != "pip" and name.removeprefix("no") not in flags and name not in flags:
            found.append(f"--{name}")
        if name == "config" and re.fullmatch("[a-z]\\w*", value) and value != "help":
            found += [] if (ROOT / "jaxnerf" / "configs" / f"{value}.py").exists() else [f"--config={value}"]
    return found


def _missing_field(name):
    """Returns [name] if no config has this field."""
    section = default.get_config()
    if name.split(".")[1] in EXAMPLE_SECTIONS:
        return []
    for part in name.split(".")[1:]:
        if part.isupper():  # stands for any name
            return []
        if part not in section:
            return [f"--{name}"]
        section = section[part]
    return []


def test_the_page_of_options_is_what_the_program_prints():
    code, printed, _ = run_forked("train", "--config=help:options")
    assert code == 0
    _, _, rest = (DOCS / "configuration.md").read_text().partition("<!-- options -->\n")
    found, _, _ = rest.partition("<!-- end of options -->")
    assert found == printed, "write what jaxnerf-train --config=help:options prints between the marks"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_and_config_fields_exist(page):
    assert {command: found for command in commands(page) if (found := faults(command))} == {}
    fields = re.findall(r"`(\w+\.(?!(?:py|bin)`)\w+)(?:=\S+)?`", page.read_text())
    if page.name == "what_moved.md":  # it has the names of before
        return
    sections = {name for name, value in default.get_config().items() if isinstance(value, ConfigDict)}
    assert [f for f in fields if f.split(".")[0] in sections and _missing_field(f"config.{f}")] == []


@pytest.mark.parametrize(
    "command",
    [
        *("jaxnerf-fly --workdir=x", "jaxnerf-eval --fly", "jaxnerf-train --config=fly", "--config.train.fly=1"),
        *("make fly", "pip install '.[fly]'", "python examples/fly.py", "python examples/minimal_nerf.py --fly=1"),
    ],
)
def test_faults_of_commands_are_found(command):
    assert len(faults(command)) == 1


OPTIONAL = ("equinox", "wandb")  # packages of examples that the package does not need; without them these are skipped


READ_VALUES = ("docs/index.md", "docs/concepts/one_idea.md", "docs/guides/other_libraries.md")  # of arrays


@pytest.fixture
def run_example(tmp_path, monkeypatch):
    """Returns a function that runs the code of an example in a folder of its own."""

    def run(code):
        for name in OPTIONAL:
            if re.search(rf"^import {name}\b", code, re.MULTILINE):
                pytest.importorskip(name)
        with jax.numpy_rank_promotion("allow"):
            exec(compile(code, "example", "exec"), {})

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "offline")
    (tmp_path / "runs" / "lego").mkdir(parents=True)
    (tmp_path / "runs" / "lego" / "config.json").write_text('{"seed": 0}')
    (tmp_path / "runs" / "lego" / "metrics.jsonl").write_text('{"step": 1, "seconds": 2.0, "psnr_fine": 20.0}\n')
    of_runs = (registry.LOSSES, registry.FIELDS, registry.SAMPLERS, registry.READERS)
    for parts in (*of_runs, EXPORTERS, ESTIMATORS):
        monkeypatch.setattr(parts, "_parts", dict(parts._parts))  # what an example registers is forgotten
    return run


@pytest.mark.parametrize("code", [each for each in EXAMPLES if not each.id.startswith(READ_VALUES)])
def test_python_examples_are_traced(code, run_example):
    """Names, arguments and shapes are right: tracing takes a hundredth of the time of running op by op."""
    jax.eval_shape(lambda: run_example(code))


@pytest.mark.parametrize(
    "code",
    [
        pytest.param(
            *each.values, id=each.id, marks=pytest.mark.slow if each.id.startswith(READ_VALUES) else pytest.mark.extra
        )
        for each in EXAMPLES
    ],
)
def test_python_examples_run(code, unoptimized, run_example):
    run_example(code)
