"""The documents: links lead somewhere, every public name and every page is listed, and Python examples run."""

import re

import jax
import pytest

import jaxnerf
from runs import ROOT

DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
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
        assert re.match(r"[a-z]+:", target) or (page.parent / target).exists(), target
    included = re.findall(r'^--8<-- "([^"]+)"$', page.read_text(), re.MULTILINE)
    assert len(included) == page.read_text().count("--8")
    for target in included:
        assert (ROOT / target).exists(), target


def test_every_page_is_in_the_navigation():
    listed = set(re.findall(r"\s(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    assert listed == {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")}


def test_every_public_name_is_on_one_page():
    text = "".join(page.read_text() for page in (DOCS / "api").iterdir())
    assert sorted(re.findall(r"^::: jaxnerf\.(\w+)$", text, re.MULTILINE)) == sorted(jaxnerf.__all__)


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 130


@pytest.mark.slow
@pytest.mark.parametrize("code", EXAMPLES)
def test_python_examples_run(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with jax.numpy_rank_promotion("allow"):
        exec(compile(code, "example", "exec"), {})
