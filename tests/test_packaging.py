"""Tests that the wheel holds the package and its configs, and that programs run from it."""

import os
import pathlib
import shutil
import subprocess
import sys
import zipfile

import pytest

from runs import ROOT

pytest_plugins = ["run_fixtures"]
SOURCES = ("jaxnerf", "LICENSE", "README.md", "pyproject.toml", "setup.cfg")


def call(*command, **options):
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=300, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Returns the path of the wheel, built from the source distribution."""
    source = tmp_path_factory.mktemp("source")
    for name in SOURCES:
        path = ROOT / name
        if path.is_dir():
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(path, source / name, symlinks=True, ignore=ignored)
        else:
            shutil.copy(path, source)
    call(sys.executable, "-m", "build", "--no-isolation", source)
    (wheel,) = (source / "dist").glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """Returns two functions, which call a program of the installed wheel and any command, and their empty folder."""
    target, empty = tmp_path_factory.mktemp("target"), tmp_path_factory.mktemp("empty")
    call(sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", target, wheel)

    # The folder of the wheel comes before that of an editable install.
    def run(*command):
        return call(*command, cwd=empty, env={**os.environ, "PYTHONPATH": str(target)})

    source = run(sys.executable, "-c", "import jaxnerf; print(jaxnerf.__file__)")
    assert target in pathlib.Path(source).parents
    return lambda program, *flags: run(target / "bin" / program, *flags), run, empty


def test_the_wheel_holds_one_package_with_configs_and_types(wheel):
    files = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in files if ".dist-info/" not in name} == {"jaxnerf"}
    assert {"jaxnerf/py.typed", "jaxnerf/data/still_life.npz"} <= set(files)
    for path in (ROOT / "jaxnerf").rglob("*.py"):
        assert path.relative_to(ROOT).as_posix() in files
    for path in (ROOT / "jaxnerf" / "tools" / "exporters" / "web_page").iterdir():
        assert path.relative_to(ROOT).as_posix() in files


@pytest.mark.extra
def test_programs_of_the_wheel_find_the_configs(installed):
    program, _, _ = installed
    listed = program("jaxnerf-train", "--config=help")
    assert {line.split()[0] for line in listed.splitlines()} == {
        path.stem for path in (ROOT / "jaxnerf" / "configs").glob("[!_]*.py")
    }
    for name in ("eval", "render", "view", "cameras", "check", "convert", "export", "report"):
        assert "--plugins: " in program(f"jaxnerf-{name}", "--help")


@pytest.mark.slow
def test_the_wheel_trains_and_evaluates(installed, unoptimized):
    program, run, folder = installed
    program("jaxnerf-train", "--config=smoke", "--workdir=runs/demo", "--batch=auto")
    assert "dB" in program("jaxnerf-eval", "--workdir=runs/demo", "--chunk=auto")
    user_config = folder / "mine.py"
    user_config.write_text(
        "from jaxnerf.configs import smoke\n\n"
        "def get_config(size):\n"
        "    config = smoke.get_config()\n"
        "    config.data.size = int(size)\n"
        "    return config\n"
    )
    flags = ("--config=mine.py:16", "--config.train.max_steps=1", "--workdir=runs/mine")
    run(sys.executable, "-m", "jaxnerf.train", *flags)
    assert '"size": 16' in (folder / "runs" / "mine" / "config.json").read_text()
