"""jaxnerf-report --curve: runs of each length, the log of a run, figures of other programs, and what is written."""

import csv
import dataclasses
import io
import os

import pytest

from jaxnerf.runtime.printed_text import printable
from jaxnerf.tools.curve import curve, drawing, measure, points
from jaxnerf.tools.curve import runs as curve_runs
from jaxnerf.tools.curve.points import Point
from runs import run_forked, smoke_config

pytest_plugins = ["run_fixtures"]

OTHERS = "program,seconds,psnr,memory_mb,note\nsplats,25,26.1,,CPU s of the whole process\nsplats,109,30.2,512,\n"


def score(length, psnr, **values):
    """Returns what score.json holds of a run, as far as a curve needs it."""
    return {
        **{
            "config": curve._plain(measure.read_config(smoke_config())),
            "seconds": length,
            "psnr": psnr,
            "ssim": 0.9,
            "step": 10 * length,
        },
        **{"ended": False, "compile_seconds": 3.0, "setup_seconds": None, "seconds_per_frame": 0.5},
        **{"backend": "cpu", "peak_memory_mb": 900.0, "machine": "cpu, 1 core(s)", **values},
    }


@pytest.fixture
def trained_lengths(monkeypatch):
    """Returns the lengths that are trained, in place of training them."""
    asked = []

    def train(config, seconds, workdir, *, about, plugins):
        asked.append(seconds)
        workdir.mkdir(parents=True)
        found = score(seconds, 20.0 + seconds, **about)
        (workdir / curve_runs.SCORE).write_text(curve_runs.to_json(found))
        return found

    monkeypatch.setattr(curve_runs, "train_and_score", train)
    return asked


def read(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def test_a_dataset_has_a_run_of_each_length_and_others_join_the_table(trained_lengths, tmp_path, capsys):
    (tmp_path / "others.csv").write_text(OTHERS)
    data, out, compare = tmp_path / "scene", tmp_path / "out", str(tmp_path / "others.csv")
    data.mkdir()
    for _ in range(2):  # the second time nothing is trained
        curve.report(data, smoke_config(), ["5", "1"], out, compare=compare)
    assert trained_lengths == [1.0, 5.0]
    printed = capsys.readouterr().out
    assert "21.00 dB" in printed and "splats" in printed and "30.20 dB" in printed and "CPU s of the whole" in printed
    rows = read(out / curve.CSV)
    assert [(row["program"], row["seconds"], row["psnr"], row["memory_mb"]) for row in rows[1:3]] == [
        (rows[0]["program"], "5.0", "25.0", "900.0"),
        ("splats", "25.0", "26.1", ""),
    ]
    assert (out / curve.PLOT).read_bytes().startswith(b"\x89PNG")


def test_points_survive_their_csv(tmp_path):
    known = [Point("a, b", 1.5, 20.25, ssim=0.5, steps=10.0, note="=1+1"), Point("c", 2.0, -3.0, memory_mb=7.0)]
    (tmp_path / "points.csv").write_text(points.to_csv(known))
    assert points.read_csv(tmp_path / "points.csv") == known


@pytest.mark.parametrize(
    "text, message",
    [
        ("program,seconds\na,1\n", "lacks psnr"),
        ("program,seconds,psnr,fps\na,1,2,3\n", "has the column 'fps'"),
        ("program,seconds,psnr\na,1\n", "line 2 has 2 cells, expected 3"),
        ("program,seconds,psnr\na,fast,2\n", "line 2 has seconds 'fast'"),
        ("program,seconds,psnr\na,-1,2\n", "line 2 has seconds '-1'"),
        ("program,seconds,psnr\n,1,2\n", "line 2 names no program"),
        ("", "lacks program"),
    ],
)
def test_a_wrong_csv_is_named_with_its_line(text, message, tmp_path):
    (tmp_path / "others.csv").write_text(text)
    with pytest.raises(ValueError, match="others.csv") as error:
        points.read_csv(tmp_path / "others.csv")
    assert message in str(error.value)


@pytest.mark.parametrize("values", [["0"], ["x"], ["-5", "5"], ["inf"]])
def test_seconds_are_positive_numbers(values, tmp_path):
    with pytest.raises(ValueError, match="--seconds is"):
        curve.report(tmp_path, smoke_config(), values, tmp_path)


def test_a_run_of_another_config_is_not_taken(trained_lengths, tmp_path):
    config = smoke_config()
    curve.of_dataset(measure.read_config(config), [1.0], tmp_path)
    other = measure.read_config(smoke_config(lr_init=1e-4))
    with pytest.raises(ValueError, match=r"1s: holds a scored run with another config"):
        curve.of_dataset(other, [1.0], tmp_path)


def test_a_run_that_ended_by_its_steps_is_the_last(monkeypatch, tmp_path):
    monkeypatch.setattr(curve_runs, "train_and_score", lambda *args, **options: score(1.0, 20.0, ended=True))
    found, failed = curve.of_dataset(measure.read_config(smoke_config()), [1.0, 5.0], tmp_path)
    assert len(found) == 1 and not failed


def test_a_run_that_fails_keeps_no_other_from_the_table(monkeypatch, tmp_path, capsys):
    results = {1.0: None, 5.0: score(5.0, 25.0)}
    monkeypatch.setattr(curve_runs, "train_and_score", lambda config, seconds, *args, **options: results[seconds])
    with pytest.raises(ValueError, match="failed: 1 s"):
        curve.report(tmp_path, smoke_config(), ["1", "5"], tmp_path / "out")
    assert "25.00 dB" in capsys.readouterr().out and len(read(tmp_path / "out" / curve.CSV)) == 1


def test_the_knee_is_the_point_farthest_above_the_chord():
    assert drawing.knee([(1, 10.0), (2, 18.0), (3, 19.0), (10, 20.0)]) == 1
    assert drawing.knee([(1, 20.0), (2, 21.0)]) == 0
    assert drawing.lines({"a": [(1, 10.0), (2, 18.0), (10, 20.0)]}, "PSNR")[2].endswith(" *")
    assert not any(line.endswith(" *") for line in drawing.lines({"a": [(1, 10.0), (2, 18.0)]}, "PSNR"))


def test_columns_of_which_nothing_is_known_are_not_shown():
    (head, row) = points.table([Point("a", 1.0, 20.0, steps=3)])
    assert head.split() == ["program", "seconds", "PSNR", "steps"] and row.split()[-1] == "3"
    every = dataclasses.replace(Point("a", 1.0, 20.0), **dict.fromkeys(points.COLUMNS[3:-1], 1.0), note="b")
    assert len(points.table([every])[0].split("  ")) >= len(points.COLUMNS)


def test_a_finished_run_has_its_own_curve(trained, tmp_path):
    code, out, err = run_forked("report", f"--curve={trained}", f"--out={tmp_path / 'out'}")
    assert (code, err) == (0, "")
    rows = read(tmp_path / "out" / curve.CSV)
    assert {row["program"] for row in rows} & {f"{trained.name}, batches of training"}
    assert "PSNR" in out and "csv:" in out


def test_flags_of_a_curve_need_one(tmp_path):
    code, _, err = run_forked("report", tmp_path, "--seconds=5")
    assert code == 1 and "--seconds, --compare and --config belong to --curve" in err
    code, _, err = run_forked("report", f"--curve={tmp_path}")
    assert code == 1 and "--seconds is missing" in err
    code, _, err = run_forked("report", f"--curve={tmp_path}", "--csv=a.csv", "--seconds=5")
    assert code == 1 and "--curve takes no RUN, --csv or --plot" in err


@pytest.mark.parametrize(
    "text", ["=1+1", "+1+1", "-1+1", "@SUM(1)", "\t=1", "\r=1", " =1", "=cmd|' /C calc'!A0", "\uff1d1"]
)
def test_a_spreadsheet_computes_no_text(text):
    assert points.spreadsheet_cell(text) == "'" + printable(text)


@pytest.mark.parametrize("value", [-1.5, 3, None, "-1.5", "+2e3", "-inf", "run", "a=b", "", os.sep])
def test_numbers_and_other_texts_stay_as_they_are_in_cells(value):
    assert points.spreadsheet_cell(value) == value
    file = io.StringIO()
    csv.writer(file).writerow([points.spreadsheet_cell(value)])
