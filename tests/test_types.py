"""Type annotations: every public function has them, a type checker accepts typed code, and tests check them."""

import ast
import importlib
import inspect
import os
import pathlib
import pkgutil
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import ArrayLike, Float, TypeCheckError

import jaxnerf
import jaxnerf.core
from jaxnerf.core import cameras
from jaxnerf.core.types import check_shapes
from type_checks import checked

ROOT = pathlib.Path(jaxnerf.__file__).parent
SAMPLE = pathlib.Path(__file__).parent / "typing_sample.py"
CORE = [module.name for module in pkgutil.walk_packages(jaxnerf.core.__path__, "jaxnerf.core.") if not module.ispkg]


def unannotated(function):
    """Returns the parameters of a function, and "return", that have no annotation."""
    signature = inspect.signature(function)
    names = [p.name for p in signature.parameters.values() if p.annotation is inspect.Parameter.empty]
    return names + ["return"] * (signature.return_annotation is inspect.Signature.empty)


@pytest.mark.parametrize("name", jaxnerf.__all__)
def test_public_functions_are_annotated(name):
    value = getattr(jaxnerf, name)
    assert not inspect.isfunction(value) or unannotated(value) == []


@pytest.mark.parametrize("name", CORE)
def test_functions_of_core_are_annotated(name):
    functions = {
        key: value
        for key, value in vars(importlib.import_module(name)).items()
        if callable(value) and getattr(value, "__module__", None) == name
        if not inspect.isclass(value) and not key.startswith("_")
    }
    missing = {key: unannotated(value) for key, value in functions.items()}
    assert {key: names for key, names in missing.items() if names} == {}


def test_the_sample_uses_the_whole_public_api():
    tree = ast.parse(SAMPLE.read_text())
    used = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute) and is_package(node.value)}
    assert set(jaxnerf.__all__) - used == set()


def is_package(node):
    return isinstance(node, ast.Name) and node.id == "jaxnerf"


@pytest.fixture(scope="module")
def mypy(tmp_path_factory):
    """Returns a function that runs mypy on a file, and returns its exit status and output."""
    folder = tmp_path_factory.mktemp("mypy")
    flags = ["--strict", "--follow-imports=silent", "--disable-error-code=import-untyped", f"--cache-dir={folder}"]

    def run(path):
        command = [sys.executable, "-m", "mypy", *flags, path]
        environment = {**os.environ, "MYPYPATH": str(ROOT.parent)}
        result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        return result.returncode, result.stdout + result.stderr

    return run


@pytest.mark.slow
def test_mypy_accepts_typed_code(mypy):
    assert (ROOT / "py.typed").is_file()
    status, output = mypy(SAMPLE)
    assert status == 0, output


@pytest.mark.slow
def test_mypy_finds_wrong_arguments(mypy, tmp_path):
    lines = ["Rays(origins=1)", "pixel_grid('4', 4)", "no_such_name", "load_dataset(3)", "psnr('a', 'b')"]
    path = tmp_path / "wrong.py"
    path.write_text("\n".join(["import jaxnerf", *(f"jaxnerf.{line}" for line in lines)]))
    status, output = mypy(path)
    assert status == 1
    assert [number for number in range(2, 7) if f"wrong.py:{number}: error" not in output] == []


@pytest.mark.slow
def test_mypy_finds_options_that_do_not_exist(mypy, tmp_path):
    path = tmp_path / "wrong.py"
    head = "from jaxnerf.training.config import RunConfig\n\nconfig = RunConfig()\n"
    path.write_text(f"{head}print(config.train.batch_size, config.fine.width + 1)\nprint(config.train.batch_sise)\n")
    status, output = mypy(path)
    assert status == 1 and output.count("error:") == 1 and 'has no attribute "batch_sise"' in output, output


def test_a_wrong_shape_that_a_function_accepts_is_found():
    @checked
    def total(values: Float[ArrayLike, "*batch samples"], far: Float[ArrayLike, "*batch"]) -> Float[ArrayLike, ""]:
        return jnp.sum(values) + jnp.sum(far)

    assert total(np.ones((2, 3)), np.ones(2)) == 8
    with pytest.raises(TypeCheckError, match="far"):
        total(np.ones((2, 3)), np.ones(3))


def test_a_function_that_refuses_a_wrong_shape_raises_its_own_error():
    @checked
    def first(values: Float[ArrayLike, "*batch 3"]) -> Float[ArrayLike, "*batch"]:
        check_shapes("first", values=(values, "... 3"))
        return values[..., 0]

    with pytest.raises(ValueError, match="first: values has shape"):
        first(np.ones(2))


def test_functions_of_the_package_are_checked():
    with pytest.raises(TypeCheckError, match="height"):
        cameras.pixel_grid(np.float32(4), 4)
