"""jaxnerf-report states what is in the workdirs, and names what it cannot read."""

import csv
import json
import os
import subprocess
import sys

import imageio.v3 as iio
import pytest

from jaxnerf.evaluation import run_report
from jaxnerf.runtime import atomic_files
from jaxnerf.runtime.printed_text import printable
from jaxnerf.tools.viewer.live import score_of
from jaxnerf.training import auto_config, workdir
from runs import ROOT, run_forked, smoke_config

METRICS = ("psnr", "ssim", "psnr_float", "psnr_truncated", "psnr_aligned", "ssim_aligned")


def write_run(folder, *, psnr=20.0, scores=(), lr_init=1e-2):
    """Writes the workdir of a run of 100 steps in 50 s, scored at some (step, split, PSNR)."""
    config = auto_config.resolve(smoke_config(lr_init=lr_init)).config
    workdir.save_config(folder, config)
    rows = [
        {"step": step, "seconds": step / 2, "psnr_coarse": 1.0, "psnr_fine": psnr * step / 100, "lr": lr_init}
        for step in (10, 50, 100)
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    for step, split, score in scores:
        name = f"{step}" if split == "test" else f"{step}-{split}"
        (folder / "eval" / name).mkdir(parents=True)
        results = dict.fromkeys(METRICS, score) | {"ssim": 0.5, "views": 4, "step": step}
        results |= {"training_seconds": step / 2, "conventions": {"split": split}}
        (folder / "eval" / name / "results.json").write_text(json.dumps(results))
    (folder / "eval" / "7.tmp").mkdir(parents=True)  # of an evaluation that was killed
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A folder with two runs, run_10 after run_9; the second is one level deeper."""
    folder = tmp_path_factory.mktemp("runs")
    scores = [(50, "test", 21.0), (100, "test", 23.5), (100, "held_out", 22.0), (100, "train", 30.0)]
    write_run(folder / "run_9", scores=scores)
    write_run(folder / "sweep" / "run_10", psnr=18.0, lr_init=1e-3)
    return folder


def test_the_table_has_scores_and_differing_options(runs):
    code, out, err = run_forked("report", runs)
    head, first, second = out.splitlines()
    assert (code, err) == (0, "")
    assert head.split()[:5] == ["run", "steps", "seconds", "PSNR", "SSIM"]
    assert head.split()[-1] == "train.lr_init"
    # The split of the config, though other splits were scored at the same step.
    assert first.split("  ")[0] == "run_9" and "23.50 dB  0.500  4 test, step 100" in first
    assert first.split()[-3:] == ["20.00", "dB", "0.01"]
    assert "run_10  100    50.0" in second and "not yet" in second and second.split()[-3:] == ["18.00", "dB", "0.001"]


def test_csv_and_plot_are_not_replaced_silently(runs, tmp_path):
    pytest.importorskip("matplotlib")
    files = {"csv": tmp_path / "runs.csv", "png": tmp_path / "runs.png", "svg": tmp_path / "runs.svg"}
    code, out, err = run_forked("report", runs, f"--csv={files['csv']}", f"--plot={files['png']}")
    assert (code, err) == (0, "") and f"csv: {files['csv']}" in out
    with files["csv"].open(newline="") as file:
        first, second = csv.DictReader(file)
    assert first["run"] == "run_9" and first["workdir"] == str(runs / "run_9")
    assert float(first["scored_psnr"]) == 23.5 and first["scored_split"] == "test" and first["steps"] == "100"
    assert second["scored_psnr"] == "" and float(second["training_psnr"]) == 18 and second["train.lr_init"] == "0.001"
    assert iio.imread(files["png"]).shape == (500, 1300, 4)
    before = files["png"].read_bytes()
    for flags in ([f"--csv={files['csv']}"], [f"--plot={files['png']}"]):
        code, out, err = run_forked("report", runs, *flags)
        assert code == 1 and "exists already; give --overwrite" in err and err.count("\n") == 1 and not out
    assert files["png"].read_bytes() == before
    code, _, err = run_forked(
        "report", runs / "run_9", f"--plot={files['svg']}", f"--csv={files['csv']}", "--overwrite"
    )
    assert code == 0 and "<svg" in files["svg"].read_text() and len(files["csv"].read_text().splitlines()) == 2


def test_names_and_links(runs, tmp_path):
    """A run counts once, two of one name are told apart by their paths, and links are followed to runs only."""
    write_run(tmp_path / "run_9")
    (tmp_path / "linked").symlink_to(runs / "sweep" / "run_10")
    (tmp_path / "loop").symlink_to(tmp_path)
    found = run_report.read_runs([tmp_path, runs, runs / "run_9"])
    assert [each.name for each in found] == ["run_10", str(tmp_path / "run_9"), str(runs / "run_9")]


def test_a_run_that_has_only_begun_is_reported(tmp_path):
    write_run(tmp_path / "run")
    (tmp_path / "run" / "metrics.jsonl").write_text('{"step": 1')
    (found,) = run_report.read_runs([tmp_path])
    assert (found.steps, found.training_psnr, found.scores) == (0, None, [])
    assert run_report.table([found]).splitlines()[1].split() == ["run", "0", "0.0", "-", "-", "not", "yet", "-"]


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([], "no run is named; give workdirs"),
        (["missing"], "missing: no such folder, expected the workdir of a run"),
        (["file"], "file: is no folder"),
        (["empty"], "empty: contains no run, expected config.json"),
        (["damaged"], "results.json: malformed JSON"),
        (["lacking"], "results.json: lacks metrics"),
        (["config"], "config.json: is not a config"),
        (["run", "--plot=a.jpg"], "--plot is 'a.jpg', expected a name that ends in .png or .svg"),
        (["run", "--plot=a.png", "--csv=a.png"], "--csv and --plot both name a.png"),
        (["run", "--csv=no/a.csv"], "no is not a folder; create it first"),
        (["run", "--csv=run"], "run exists already; it is no file"),
    ],
)
def test_bad_input_is_one_line(arguments, message, tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "config.json").write_text("[]")
    for name, content in (("damaged", "{"), ("lacking", '{"psnr": 3}'), ("run", None)):
        folder = write_run(tmp_path / name, scores=[(100, "test", 23.0)])
        if content:
            (folder / "eval" / "100" / "results.json").write_text(content)
    code, out, err = run_forked("report", *arguments, folder=tmp_path)
    assert code == 1 and not out
    assert message in err and err.count("\n") == 1 and err.startswith("error: ")


def test_a_plot_without_matplotlib_says_what_to_install(runs, tmp_path):
    (tmp_path / "matplotlib.py").write_text("raise ImportError('none here')")
    command = [sys.executable, "-m", "jaxnerf.report", runs, "--plot=a.png"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (tmp_path, ROOT)))}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.returncode == 1 and "pip install matplotlib" in done.stderr and not (tmp_path / "a.png").exists()


def test_plots_ignore_the_matplotlibrc_of_the_working_folder(tmp_path):
    pytest.importorskip("matplotlib")
    write_run(tmp_path / "_run $x_{$")  # of a name that is no formula, and is listed though it begins with _
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nsavefig.dpi: nonsense\n")
    code, out, err = run_forked("report", "_run $x_{$", "--plot=a.svg", folder=tmp_path)
    assert (code, err) == (0, "") and "plot: a.svg" in out
    assert (tmp_path / "a.svg").read_text().count("_run $x_{$") == 1


def test_a_report_shows_text_of_strangers_and_obeys_none(tmp_path):
    """Names of folders, of options and their values, those that are not UTF-8 too."""
    for name, value in (
        ("\x1b[2J\n=1+1", "\u202egnp\x07"),
        ("=cmd|'C calc'!A0", "=1+1"),
        (b"\xff".decode("utf-8", "surrogateescape"), "x" * 999),
    ):
        folder = write_run(tmp_path / "runs" / name)
        config = json.loads((folder / "config.json").read_text())
        config["data"] |= {"dir": value, "\x1b]0;title\x07": value}
        (folder / "config.json").write_text(json.dumps(config))
    files = tmp_path / "a.csv", tmp_path / "a.svg"
    code, out, err = run_forked("report", tmp_path / "runs", f"--csv={files[0]}", f"--plot={files[1]}")
    assert (code, err) == (0, "") and printable(out, keep="\n") == out
    assert len(out.splitlines()) == 6 and all(len(line) < 400 for line in out.splitlines())
    with files[0].open(newline="") as file:
        rows = [*csv.reader(file)]
    assert {row[0] for row in rows[1:]} == {"\\x1b[2J\\n=1+1", "'=cmd|'C calc'!A0", "\\udcff"}
    assert not any(cell.startswith("=") or printable(cell) != cell for row in rows for cell in row)


@pytest.mark.parametrize("key", ["views", "psnr", "ssim", "step", "training_seconds", "lpips", "conventions"])
@pytest.mark.parametrize(
    "value", ["Infinity", "-Infinity", "NaN", "1e400", '"8"', "-1", "true", "[]", "{}", "10000000000000000000000"]
)
def test_no_value_of_a_result_is_a_traceback(key, value, tmp_path):
    folder = write_run(tmp_path / "run", scores=[(100, "test", 23.0)])
    path = folder / "eval" / "100" / "results.json"
    path.write_text(path.read_text()[:-1] + f', "{key}": {value}}}')  # of equal keys the last one counts
    try:
        text = run_report.table(run_report.read_runs([tmp_path]))
        accepted = key in ("psnr", "ssim", "lpips") and value[0] not in '"t[{' or (key, value) == ("conventions", "{}")
        assert accepted and ("23.00" in text) == (key != "psnr")
    except ValueError as error:
        assert "results.json: " in str(error) and str(error).endswith("score it again with --overwrite")
    assert isinstance(score_of(folder, 100), str)


def test_folders_that_are_nested_without_end_are_an_error(tmp_path):
    place = os.open(tmp_path, os.O_RDONLY)
    for _ in range(3000):
        os.mkdir("d", dir_fd=place)
        place, above = os.open("d", os.O_RDONLY, dir_fd=place), place
        os.close(above)
    code, _, err = run_forked("report", ".", folder=tmp_path)
    assert (
        code == 1 and err.startswith("error: d/d/d/") and err.count("\n") == 1 and "name the folder of the runs" in err
    )
    with pytest.raises(ValueError, match="folders that are nested more than 100 levels deep"):
        list(atomic_files.files_below(tmp_path))
    subprocess.run(["rm", "-r", tmp_path / "d"], check=True)  # pytest's own removal would fail
