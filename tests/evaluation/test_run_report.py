"""jaxnerf-report states what is in the workdirs, and names what it cannot read."""

import csv
import json
import os
import subprocess
import sys

import imageio.v3 as iio
import pytest

from jaxnerf.evaluation import run_report
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
