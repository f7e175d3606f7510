"""Tests of what all command-line programs share: config names, flags, plugins and memory."""

import os
import platform
import subprocess
import sys

import pytest

from jaxnerf.registry import FIELDS
from jaxnerf.runtime import cli
from runs import ROOT, run_forked

_FAULTS = """
import ctypes, resource, threading
from jaxnerf.runtime import cli

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

def fill():
    block = ctypes.CDLL(None).malloc
    block.restype, block.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
    free = ctypes.CDLL(None).free
    free.argtypes = [ctypes.c_void_p]
    for step in range(10):
        if step == 1:
            before = faults()
        start = block(SIZE)
        ctypes.memset(start, 1, SIZE)
        free(start)
    print(faults() - before)

SIZE = 40 * 2**20
cli._keep_memory()
fill()
thread = threading.Thread(target=fill)
thread.start()
thread.join()
"""

_PROGRAM = '''"""Prints a count and the names of all fields."""
from jaxnerf.registry import FIELDS
from jaxnerf.runtime import cli

COUNT = cli.define_value("count", "The number of things.", int, cli.COUNT)
LIMIT = cli.define_value("limit", "The most of a thing.", float, cli.PART)

def main(argv):
    print(COUNT.value, *FIELDS.names(), *[LIMIT.value] * (LIMIT.value is not None))

cli.run(main)
'''


def call(folder, *flags):
    """Returns (exit code, stdout, stderr) of _PROGRAM with flags."""
    program = folder / "program.py"
    program.write_text(_PROGRAM)
    return run_forked(program, *flags, folder=folder)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc returns large blocks at once")
def test_freed_memory_stays_in_the_process():
    """Allocates blocks of 40 MiB (10,240 pages) repeatedly, in the main thread and in another one."""
    out = subprocess.run([sys.executable, "-c", _FAULTS], capture_output=True, text=True, check=True).stdout
    assert all(int(count) < 2000 for count in out.split()), out


def test_a_config_name_becomes_a_path():
    assert cli.config_path("smoke") == str(cli.CONFIGS / "smoke.py")
    assert cli.config_path("smoke:16") == str(cli.CONFIGS / "smoke.py:16")
    assert cli.CONFIGS.resolve() == ROOT / "jaxnerf" / "configs"


def test_a_config_name_wins_over_a_file_of_the_working_folder(tmp_path, monkeypatch):
    """A config is code, and a stranger's folder may hold a file of that name."""
    monkeypatch.chdir(tmp_path)
    for name in ("smoke", "mine"):
        (tmp_path / name).write_text("")
    assert cli.config_path("smoke:small") == f"{cli.CONFIGS / 'smoke.py'}:small"
    assert cli.config_path("./smoke:small") == "./smoke:small"
    assert cli.config_path("mine:small") == "mine:small"


def test_a_wrong_config_name_lists_the_names():
    with pytest.raises(ValueError, match="no config 'lego_slow', expected a path or one of .*lego_fast, lego_mlp_fast"):
        cli.config_path("lego_slow")
    with pytest.raises(ValueError, match="no config 'lego_fats', .*; did you mean lego_fast"):
        cli.config_path("lego_fats")


@pytest.mark.parametrize(
    "flags, added",
    [
        (["--workdir=run"], True),
        (["--workdir", "run", "--config.train.max_steps=3"], True),
        (["-workdir=run", "--nomultihost"], True),
        (["--workdir=run", "--config=smoke"], False),
        (["--config", "smoke", "--workdir=run"], False),
        (["--workdir=other"], False),
        (["--workdir"], False),
        ([], False),
    ],
)
def test_the_saved_config_is_used_without_another_one(tmp_path, monkeypatch, flags, added):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text("{}")
    config = ["--config=run/config.json"] if added else []
    assert cli.with_saved_config(["program", *flags]) == ["program", *config, *flags]


@pytest.mark.parametrize(
    "flags, added",
    [
        (["--workdir=run"], False),
        (["--workdir=run", "--config.eval.chunk=3"], True),
        (["--noconfig.eval.bake_occupancy", "-workdir=run"], True),
        (["--workdir=run", "--config=smoke", "--config.eval.chunk=3"], False),
    ],
)
def test_the_saved_config_may_be_used_for_fields_only(tmp_path, monkeypatch, flags, added):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text("{}")
    config = ["--config=run/config.json"] if added else []
    assert cli.with_saved_config(["program", *flags], only_for_fields=True) == ["program", *config, *flags]


@pytest.mark.parametrize(
    "program, flag",
    [
        ("eval", "--error_budget=nan"),
        ("eval", "--error_budget=2"),
        ("eval", "--poll_seconds=inf"),
        ("eval", "--coverage=nan"),
        ("eval", "--step=-1"),
        ("eval", "--chunk=1e400"),
        ("eval", f"--chunk={10**30}"),
        ("render", "--fps=nan"),
        ("render", f"--frames={10**9}"),
        ("render", "--max_uncertainty=-inf"),
        ("train", "--join_seconds=inf"),
        ("train", "--heartbeat_seconds=nan"),
        ("train", "--stopped_code=256"),
        ("check", "--near=nan"),
        ("check", "--far=inf"),
        ("cameras", f"--max_size={10**30}"),
        ("cameras", f"--num_threads={10**30}"),
        ("export", f"--step={10**30}"),
    ],
)
def test_absurd_numbers_are_refused_before_anything_is_read(tmp_path, program, flag):
    needed = {"cameras": ["--images=none", "--out=none"], "export": ["--workdir=none", "--kind=mesh"], "check": []}
    code, out, err = run_forked(program, *needed.get(program, ["--workdir=none"]), flag, folder=tmp_path)
    assert code == 2 and not out
    assert err.startswith("error: ") and err.count("\n") == 1 and flag[2:].split("=")[0] in err


def test_a_plugin_registers_a_field(tmp_path):
    plugin = "import jaxnerf\n\njaxnerf.register_field('mine', lambda options, box: None)\n"
    (tmp_path / "my_plugin.py").write_text(plugin)
    code, out, err = call(tmp_path, "--plugins=my_plugin", "--count=auto")
    names = out.split()  # another test of this process may have registered fields, the program has not
    assert (code, names) == (0, ["auto", "mlp", "hash_grid", "moving", "mine"]), err


def test_a_plugin_that_fails_is_reported_in_one_line(tmp_path):
    (tmp_path / "broken.py").write_text("1 / 0\n")
    code, out, err = call(tmp_path, "--plugins=broken")
    assert code == 1 and not out
    assert err.startswith("error: --plugins: cannot import 'broken' (ZeroDivisionError") and err.count("\n") == 1


def test_a_cache_that_cannot_be_used_is_reported(tmp_path, monkeypatch):
    cache = tmp_path / "cache" / "jaxnerf"
    cache.mkdir(parents=True)
    cache.chmod(0o777)
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache.parent))
    load = "user_cache.load_or_make(None, 'name', lambda: {'x': numpy.ones(1)}, is_valid=lambda found: True)"
    (tmp_path / "loads.py").write_text(f"import numpy\nfrom jaxnerf.runtime import user_cache\n\n{load}\n")
    code, _, err = call(tmp_path, "--plugins=loads", "--count=1")
    assert code == 0 and "jaxnerf can be written by other users" in err


@pytest.mark.parametrize(
    "flag, expected",
    [
        ("--count=0", "auto, or an integer (from 1 to 2,147,483,647)"),
        ("--limit=half", "auto, or a number (from 0 to 1)"),
        ("--limit=nan", "auto, or a number (from 0 to 1)"),
    ],
)
def test_a_wrong_number_is_reported_in_one_line(tmp_path, flag, expected):
    code, out, err = call(tmp_path, flag)
    assert code == 2 and not out
    assert flag[2:7] in err and f"expected {expected}" in err and err.count("\n") == 1


@pytest.mark.parametrize("value, printed", [("auto", "auto"), ("0.5", "0.5"), ("1", "1.0")])
def test_a_limit_is_a_number_or_auto(tmp_path, value, printed):
    assert call(tmp_path, f"--limit={value}")[1].split()[-1] == printed


@pytest.mark.parametrize(
    "field, message",
    [
        ("occupancy.sizes", ""),
        ("qqq.step_size", "did you mean --config.occupancy.step_size? "),
        ("occupancy.resolutions", "did you mean --config.occupancy.resolution? "),
        ("lr", "did you mean --config.train.lr_init or --config.train.lr_final or "),
        ("train.lr", "did you mean --config.train.lr_init or --config.train.lr_final or "),
    ],
)
def test_an_unknown_field_is_named_in_one_line(tmp_path, field, message):
    code, out, err = run_forked("train", "--config=smoke", f"--workdir={tmp_path}", f"--config.{field}=3")
    assert code == 2 and not out
    assert err.startswith(f"error: --config.{field}: no such option; {message}")
    assert "--config=help:options lists all options" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    "lines, message",
    [
        (
            ["c.data.widht = 3", "return c"],
            "{file}: config.data.widht is no field, did you mean width? expected one of",
        ),
        (["c.train.lr_init = -1.0", "return c"], "{file}: config.train.lr_init is -1.0, expected more than 0"),
        (["c.trian.batch_size = 3"], "--config: {file}, line 5: AttributeError: 'trian', did you mean \"train\""),
        (["c.train.lr_init = 'low'"], "--config: {file}, line 5: TypeError: "),
        (["open('nothing')"], "--config: {file}: [Errno 2] No such file or directory: 'nothing'"),
        (["pass"], "--config: {file}: get_config() returns NoneType, expected a ConfigDict"),
        (["return {'train': {}}"], "--config: {file}: get_config() returns dict, expected a ConfigDict"),
    ],
)
def test_a_wrong_config_file_is_named(tmp_path, lines, message):
    file = tmp_path / "mine.py"
    head = "from jaxnerf.configs import smoke\n\ndef get_config():\n    c = smoke.get_config()\n"
    file.write_text(head + "".join(f"    {line}\n" for line in lines))
    code, out, err = run_forked("train", f"--config={file}", f"--workdir={tmp_path}/run", "--data_dir=nothing")
    assert code in (1, 2) and not out
    assert err.startswith("error: " + message.format(file=file)) and err.count("\n") == 1, err


def test_other_flags_that_a_beginner_gets_wrong(tmp_path):
    (tmp_path / "mine.py").write_text("config = 3\n")
    for flags, message in {
        ("--config=mine",): "did you mean mine.py?",
        ("--config=mine.py",): "--config: mine.py: defines no get_config()",
        ("--config=smoke", "--plugins=mine.py"): f"not a file: mine, with PYTHONPATH={tmp_path}",
        ("--config=smoke", "--data_dir="): "--data_dir is empty",
        (
            "--config=smoke",
            "--config.data.format=auto",
            "--config.data.dir=",
        ): "data.dir is '': no such folder",
    }.items():
        code, out, err = run_forked("train", "--workdir=run", *flags, folder=tmp_path)
        assert code in (1, 2) and not out and message in err and err.count("\n") == 1, err


@pytest.mark.parametrize(
    "program, flag, expected",
    [
        (
            "export",
            "--workdir=x",
            "--kind is missing: what to export: mesh, points, depth, splats, cameras, web, or a",
        ),
        ("train", "--max_steps=3", "--max_steps: no such flag; did you mean --config.train.max_steps?"),
        ("train", "--train.lr_init=1", "--train.lr_init: no such flag; did you mean --config.train.lr_init?"),
        ("train", "--max-step=1", "--max-step: no such flag; did you mean --config.train.max_steps?"),
        ("train", "--field=mlp", "--field: no such flag; did you mean --config.field?"),
        ("train", "--lr=1", "--lr: no such flag; did you mean --config.train.lr_init or --config.train.lr_final or"),
        ("train", "--chunk=3", "--chunk: no such flag; did you mean --config.eval.chunk?"),
        ("train", "--nomuon", "--nomuon: no such flag; did you mean --config.train.muon?"),
        ("train", "--seed=1", "--seed: no such flag; did you mean --config.seed?"),
        ("train", "--distortion=1", "--distortion: no such flag; did you mean --config.losses.distortion?"),
        ("train", "--skip_layer=1", "did you mean --config.coarse.skip_layer or --config.fine.skip_layer?"),
        ("train", "--stretch=1", "did you mean --config.testing.stretch?"),  # of a plug-in
        ("eval", "--early_stop_eps=1", "did you mean --config.eval.early_stop_eps?"),
        ("train", "--qqq=1", "Unknown command line flag 'qqq'"),
        ("render", "--max_steps=3", "Unknown command line flag 'max_steps'"),  # it takes no config
    ],
)
def test_an_option_without_its_section_is_named_in_full(tmp_path, program, flag, expected):
    (tmp_path / "mine.py").write_text(
        "import dataclasses\nimport jaxnerf\nfrom jaxnerf.options import Options, option\n\n\n"
        "@dataclasses.dataclass(frozen=True)\nclass Stretched(Options):\n"
        "    stretch: float = option(1.0, 'how far')\n\n\n"
        "jaxnerf.register_field('testing', lambda options, box: None, options=Stretched)\n"
    )
    code, out, err = run_forked(program, "--workdir=run", flag, "--plugins=mine", folder=tmp_path)
    assert code == 2 and not out
    assert expected in err and err.startswith("error: ") and err.count("\n") == 1


@pytest.mark.parametrize("fault", ['{}["nothing"]', "sys.nothing"])
def test_a_fault_in_a_config_file_is_not_an_unknown_field(tmp_path, fault):
    file = tmp_path / "mine.py"
    file.write_text(f"import sys\n\n\ndef get_config():\n    return {fault}\n")
    code, out, err = run_forked("train", f"--config={file}", f"--workdir={tmp_path}")
    assert code == 2 and not out
    assert err.startswith(f"error: --config: {file}, line 5: ") and err.count("\n") == 1


@pytest.mark.parametrize(
    "package, content, expected",
    [
        ("optax", "import jax\njax.config.update('jax_gone', 1)\n", "optax cannot be imported (AttributeError: Unrec"),
        ("flax", "from jax.core import gone\n", "jax cannot be imported (ImportError: cannot import name 'gone'"),
        ("optax", "import nowhere_to_be_found\n", "nowhere_to_be_found cannot be imported (ModuleNotFoundError: No m"),
        ("jaxtyping", "1 / 0\n", "jaxtyping cannot be imported (ZeroDivisionError: division by zero)"),
        ("config", "1 / 0\n", "--config: config.py, line 1: ZeroDivisionError: division by zero; correct the file"),
        ("config", "import nowhere_to_be_found\n", "--config: config.py, line 1: ModuleNotFoundError: No module named"),
    ],
)
def test_a_package_that_cannot_be_imported_is_named(tmp_path, package, content, expected):
    """The config is blamed for its own code only."""
    (tmp_path / f"{package}.py").write_text(content)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path / package), str(ROOT)])}
    if package != "config":
        (tmp_path / package).mkdir()
        (tmp_path / f"{package}.py").rename(tmp_path / package / f"{package}.py")
    config = "config.py" if package == "config" else "smoke"
    command = [sys.executable, "-P", "-m", "jaxnerf.train", f"--config={config}", "--workdir=run"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.returncode in (1, 2) and not done.stdout
    assert done.stderr.startswith(f"error: {expected}") and done.stderr.count("\n") == 1
    assert ("installed are jax " in done.stderr and "pip install -U" in done.stderr) == (package != "config")


def test_help_lists_the_flags_of_the_program(tmp_path):
    code, out, _ = call(tmp_path, "--help")
    assert code == 0
    assert out.startswith("Prints a count and the names of all fields.")
    assert "--count: The number of things." in out
    assert "--plugins: " in out and "--logtostderr" not in out


def test_a_name_from_a_workdir_is_not_imported():
    """Names that a config.json could contain are looked up, and never imported."""
    with pytest.raises(ValueError, match="no field 'os:system'.*register_field with --plugins"):
        FIELDS.get("os:system")


def test_too_little_memory_is_one_line(tmp_path):
    program = tmp_path / "program.py"
    program.write_text("import numpy\nfrom jaxnerf.runtime import cli\ncli.run(lambda argv: numpy.zeros(2**58))\n")
    code, _, err = run_forked(program, folder=tmp_path)
    assert code == 1
    assert err.startswith("error: out of memory (Unable to allocate") and err.count("\n") == 1


@pytest.mark.parametrize("flag", ["--help", "--config=help"])
def test_a_reader_that_goes_away_while_flags_are_parsed_is_one_line(flag):
    """As in `jaxnerf-train --help | head -1`."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "jaxnerf.train", "--workdir=run", flag]
    done = subprocess.run(command, cwd=ROOT, stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert done.returncode == 129
    assert done.stderr.startswith("stopped before") and len(done.stderr.splitlines()) == 1


def test_a_name_that_no_library_takes_is_reported_in_one_line(tmp_path):
    program = tmp_path / "program.py"
    program.write_text("from jaxnerf.runtime import cli\ncli.run(lambda argv: 'runs/\\udcff'.encode())\n")
    code, _, err = run_forked(program, folder=tmp_path)
    assert (code, err) == (
        1,
        "error: a name is not UTF-8: 'runs/\\udcff' (surrogates not allowed); rename the file or the folder\n",
    )


def test_a_signal_after_the_end_prints_nothing(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(
        "import atexit, os, signal\nfrom jaxnerf.runtime import cli\n"
        "atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT))\ncli.run(lambda argv: None)\n"
    )
    done = subprocess.run([sys.executable, program], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "")
