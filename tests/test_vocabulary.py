"""Tests that identifiers, keys, flags and files are named by the vocabulary of the NeRF literature (docs/design.md)."""

import ast
import pathlib
import re

import pytest

from runs import ROOT

INSTEAD = {  # words that no name contains, and what is used instead
    "anew": "again",
    "capacity": "max_samples",
    "ema": "averaged",
    "lane": "slot",
    "left_out": "dropped, skipped or excluded",
    "passing": "transmittance",
    "photo": "image",
    "photograph": "image",
    "picture": "image",
    "revive": "reinitialize",
    "settle": "infer or resolve",
    "share": "fraction",
    "tell": "report",
    "told": "reported",
    "unseen": "culled",
}
ALLOWED = {"grad_ema", "request_share_url"}  # names of other projects
NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def defined_names(tree):
    """Yields identifiers that are defined, keys of dictionaries, and flags."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.arg(arg=name):
                yield name
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield name
            case ast.alias(asname=str(name)):
                yield name
            case ast.Dict(keys=keys):
                yield from (key.value for key in keys if isinstance(key, ast.Constant))
            case ast.Call(func=ast.Attribute(attr=called), args=[ast.Constant(value=name), *_]):
                if re.match("DEFINE|define_|add_argument", called):
                    yield name.lstrip("-")


def wrong_words(name):
    """Returns {word: what to use instead} of a name such as "ray_share" or "RayShares"."""
    if name in ALLOWED:
        return {}
    words = "_" + re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", name).lower().strip("_") + "_"
    return {word: better for word, better in INSTEAD.items() if re.search(f"_{word}s?_", words)}


def test_names_use_the_vocabulary():
    found = {}
    paths = {path for top in ("examples", "experiments", "jaxnerf", "tests") for path in (ROOT / top).rglob("*.py")}
    for path in sorted(paths - {pathlib.Path(__file__).resolve()}):
        names = {*defined_names(ast.parse(path.read_text())), *path.relative_to(ROOT).with_suffix("").parts}
        names = [name for name in names if isinstance(name, str) and NAME.fullmatch(name)]
        found |= {f"{path.relative_to(ROOT)}: {name}": wrong for name in names if (wrong := wrong_words(name))}
    assert found == {}


@pytest.mark.parametrize("name, wrong", [("shared", []), ("rays_left_out", ["left_out"]), ("RayShares", ["share"])])
def test_wrong_words_are_found(name, wrong):
    assert [*wrong_words(name)] == wrong
