"""The benchmark: its jobs, what is repeated, its tables, its page, and its files in the layout of nerfbaselines."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import types

import imageio.v3 as iio
import numpy as np
import pytest

from jaxnerf.tools.curve import measure
from jaxnerf.tools.curve import runs as curve_runs
from runs import ROOT, run_forked
from studies import common, study

run = study("benchmark/run")
jobs, layout, tables, settings = (
    study(f"benchmark/{name}") for name in ("jobs", "nerfbaselines_layout", "tables", "settings")
)
published = study("speed/published")


def fake_score(job, time_limit, psnr, commit="1234567", *, size=None, when="2026-11-27T01:00:00", **values):
    """Returns what score.json holds of a run with two images, as far as the tables and files need it."""
    plain = common.plain_config(measure.at_time(jobs.configuration(jobs.JOBS[job]), time_limit))
    images = [{"name": name, "psnr": psnr + change, "ssim": 0.9} for name, change in (("r_2", 1.0), ("r_10", -1.0))]
    conventions = {"size": size or [800, 800], "background": "white", "factor": 1}
    return {
        **{"job": job, "overrides": dict(jobs.JOBS[job].overrides), "config": plain, "commit": commit},
        **{"datetime": when, "machine": "cpu, 1 core(s), XLA_FLAGS=''", "cpu": "a CPU", "backend": "cpu"},
        **{"device": "cpu", "time_limit": time_limit, "ended": False, "seconds": time_limit + 0.2},
        **{"comparable": time_limit, "gflops": [90.0, 93.0], "compile_seconds": 3.0, "setup_seconds": None},
        **{"peak_memory_mb": 1234.5, "peak_device_memory_mb": None, "step": 100, "psnr": psnr, "ssim": 0.9},
        **{"psnr_truncated": psnr - 0.02, "seconds_per_frame": 1.5, "views": 2, "workdir": f"{time_limit}s-{commit}"},
        **{"conventions": conventions, "images": images, **values},
    }


def test_every_job_follows_its_protocol_and_compares_with_figures_that_exist():
    kinds = {entry["what"] for entry in (*published.BENCHMARK, *published.TRAINING)}
    for name, job in jobs.JOBS.items():
        config = jobs.configuration(job)
        assert config.data.dir == job.dataset and list(job.seconds) == sorted(job.seconds), name
        assert set(job.beside) <= kinds, name
        assert measure.at_time(config, 7).train.max_seconds == 7.0


def test_options_that_contradict_a_protocol_are_refused():
    with pytest.raises(ValueError, match="data.background is 'black', expected 'white' by the protocol 'blender'"):
        jobs.configuration(jobs.JOBS["lego_100"], {"data.background": "black"})
    with pytest.raises(ValueError, match="data.hold_out is 8"):
        jobs.configuration(jobs.JOBS["fox_200"], {"data.hold_out": 8})


@pytest.mark.parametrize("values", [["0"], ["5", "-1"], ["x"], ["inf"], ["nan"]])
def test_seconds_are_positive_numbers(values):
    assert run._times(["60", "5.5"]) == [5.5, 60.0] and run._times([]) == []
    with pytest.raises(ValueError, match="--seconds is"):
        run._times(values)


def test_settings_are_values_of_options_that_exist():
    assert settings.parse(["data.factor=16", "data.width=auto"]) == {"data.factor": 16, "data.width": "auto"}
    for text in ("data.factor", "data.fly=1"):
        with pytest.raises(ValueError, match="--set is"):
            settings.parse([text])


def test_a_run_is_finished_if_config_and_commit_agree():
    config = jobs.configuration(jobs.JOBS["lego_100"])
    score = fake_score("lego_100", 60.0, 34.0)
    assert not run.is_finished([], 60.0, config, "1234567")
    assert run.is_finished([score], 60.0, config, "1234567")
    assert not run.is_finished([score], 15.0, config, "1234567")
    assert not run.is_finished([score], 120.0, config, "1234567")
    assert not run.is_finished([score], 60.0, config, "7654321")
    assert run.is_finished([score], 60.0, config, "7654321", any_commit=True)
    assert run.is_finished([score | {"ended": True}], 120.0, config, "1234567")  # longer than its steps take


def test_a_run_with_another_config_is_never_taken_for_finished():
    config = jobs.configuration(jobs.JOBS["lego_100"], {"data.factor": 16})
    score = fake_score("lego_100", 60.0, 34.0)
    with pytest.raises(ValueError, match="60.0s-1234567: holds a finished run with config.data.factor 8, expected 16"):
        run.is_finished([score], 60.0, config, "1234567")
    assert not run.is_finished([score], 60.0, config, "7654321", any_commit=True)


def test_scores_of_this_commit_are_shown_otherwise_the_newest(tmp_path):
    for commit, when, psnr in (("aaaaaaa", "2026-11-27T03", 3.0), ("bbbbbbb", "2026-11-27T02", 2.0)):
        folder = tmp_path / "lego_100" / f"60s-{commit}"
        common.write_json(folder / "score.json", fake_score("lego_100", 60.0, psnr, commit, when=when))
    (tmp_path / "lego_100" / "15s-aaaaaaa").mkdir()  # interrupted
    scores = run.read_scores(tmp_path, "lego_100")
    chosen = lambda commit: [score["psnr"] for score in run.selected(scores, (15.0, 60.0), commit)]  # noqa: E731
    assert chosen("bbbbbbb") == [2.0] and chosen("aaaaaaa") == chosen("ccccccc") == [3.0]
    assert scores[0]["workdir"] == "60s-aaaaaaa"


def test_a_missing_dataset_is_reported_with_the_command_that_makes_it(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAXNERF_SCENES", str(tmp_path))
    (tmp_path / "lego").mkdir()
    notes = run.missing(["lego_100", "can_undistorted"])
    assert list(notes) == ["can_undistorted"]
    assert "`jaxnerf-cameras --images=can/images" in notes["can_undistorted"]


def test_a_signal_lets_the_run_save_before_the_program_ends(tmp_path):
    code = """
import pathlib, signal, sys, time

def stop(*_):
    pathlib.Path(sys.argv[1], "saved").touch()
    sys.exit(1)

signal.signal(signal.SIGTERM, stop)
pathlib.Path(sys.argv[1], "started").touch()
time.sleep(60)
"""

    def interrupt(*_):
        if not (tmp_path / "started").exists():
            signal.setitimer(signal.ITIMER_REAL, 0.02)
            return
        raise KeyboardInterrupt(signal.SIGTERM)

    old = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        with pytest.raises(KeyboardInterrupt):
            curve_runs.run_to_end([sys.executable, "-c", code, str(tmp_path)], {})
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, old)
    assert (tmp_path / "saved").exists()


def test_the_list_has_every_job_and_the_time_of_all():
    lines = run.listing({"lego_100": (15.0, 60.0), "fox_200": (105.0,)})
    assert "| lego_100 | lego | lego_fast | data.format=blender data.factor=8 | blender | 1 | 15, 60 |" in lines
    assert lines[-1].startswith("0.1 h of training")


def scores_of_lego():
    return {
        "lego_100": [fake_score("lego_100", 15.0, 31.0, size=[50, 50])],
        "lego_800": [fake_score("lego_800", 600.0, 33.29), fake_score("lego_800", 2400.0, 35.8, "7654321")],
    }


def test_the_table_has_lpips_where_a_run_has_it():
    scores = scores_of_lego()
    assert not any("LPIPS" in line for line in tables.benchmark(scores))
    scores["lego_800"][0]["lpips"] = 0.0421
    lines = tables.benchmark(scores)
    assert "| lego_800 | 800x800 | 2 | 600 | 600 | 33.29 | 0.9000 | 0.0421 | 100 | 3 | - | 1,234 | 1.50 |" in lines
    assert any(line.startswith("| lego_800 | 800x800 | 2 | 2400 | 2400 | 35.80 | 0.9000 | - |") for line in lines)
    assert "1234567; 7654321: lego_800 after 2400 s, 2026-11-27" in lines[2]


def test_other_figures_are_beside_runs_of_the_same_images_by_descending_psnr():
    lines = tables.beside(scores_of_lego())
    assert not any("100x100" in line or "50x50" in line for line in lines)
    values = [float(line.split(" | ")[2].strip("*").split("*")[0]) for line in lines[2:]]
    assert values == sorted(values, reverse=True) and values.count(35.8) == 1
    assert (
        "| lego, 800x800, 25 test views | 3DGS | 35.94 | 6 min | A100 | nerfbaselines, results of each image |" in lines
    )
    assert any("**33.29** (33.27 truncated) | 10 min" in line for line in lines)


def test_figures_of_part_of_the_views_differ_from_those_of_all():
    assert tables.shift_of_views() == pytest.approx((31.21 - 31.37, 35.94 - 35.70))  # nerfacto and 3DGS on lego


def test_the_headline_has_figures_of_the_same_views_only():
    (row,) = [line for line in tables.headline(scores_of_lego()) if "its full size" in line]
    assert "33.3 dB (600 s), 35.8 dB (2400 s) | 1.50 s | 3DGS: 35.9 dB (6 min); Zip-NeRF: 35.9 dB (5.3 h)" in row
    assert "TensoRF" not in row and "one CPU core" in tables.headline(scores_of_lego())[0]


def test_figures_of_another_program_that_does_not_use_alpha_are_beside_the_run_that_does_not():
    scores = {"lego_100_no_alpha": [fake_score("lego_100_no_alpha", 60.0, 32.0, size=[100, 100])]}
    assert sum("| TensoRF |" in line for line in tables.beside(scores)) == 4


def test_options_of_a_try_are_in_the_table():
    score = fake_score("lego_100", 5.0, 30.0)
    score["overrides"]["data.factor"] = 16
    assert tables.changes_of(score) == " with data.factor=16"
    assert any(line.startswith("| lego_100 with data.factor=16 |") for line in tables.benchmark({"lego_100": [score]}))


def test_the_page_is_made_and_its_tables_are_replaced(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(common, "PAGE", types.SimpleNamespace(value=str(tmp_path / "benchmark.md")))
    lines_of = tables.all_tables(scores_of_lego())
    run._publish(lines_of)
    text = (tmp_path / "benchmark.md").read_text()
    assert "| lego_800 |" in text and "| Zip-NeRF |" in text and "its full size" not in text
    run._publish(lines_of)
    assert (tmp_path / "benchmark.md").read_text() == text
    readme = tmp_path / "README.md"
    readme.write_text("before\n<!-- headline -->\nold\n<!-- end of headline -->\nafter\n")
    monkeypatch.setattr(common, "PAGE", types.SimpleNamespace(value=str(readme)))
    run._publish(lines_of)
    text = readme.read_text()
    assert text.startswith("before\n") and "its full size" in text and "old" not in text and "GFLOP/s" not in text


def test_files_in_the_layout_of_nerfbaselines(tmp_path):
    score = fake_score("lego_800", 600.0, 33.0)
    colors = {"000": 50, "001": 100}  # r_2 and r_10; r_10 is first by text
    for name, value in colors.items():
        for kind, shift in (("color", 0), ("gt-color", 51)):
            path = tmp_path / "eval" / "100" / kind / f"{name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            iio.imwrite(path, np.full((4, 4, 3), value + shift, np.uint8))
    content = json.loads(json.dumps(layout.results_of(score, tmp_path)))
    decoded = {name: layout.decode(text) for name, text in content["metrics_raw"].items()}
    assert content["nb_info"]["image_names"] == ["r_10", "r_2"]
    assert decoded["psnr"] == [32.0, 34.0] and content["metrics"]["psnr"] == 33.0
    np.testing.assert_allclose(decoded["mse"], [10**-3.2, 10**-3.4], rtol=1e-6)
    np.testing.assert_allclose(decoded["mae"], [0.2, 0.2], rtol=1e-6)
    assert "lpips_vgg" not in decoded
    files = [tmp_path / "eval" / "100" / "color" / name for name in ("001.png", "000.png")]
    assert content["predictions_sha256"] == hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    assert content["evaluation_protocol"] == content["nb_info"]["evaluation_protocol"] == "nerf"
    assert content["nb_info"]["dataset_metadata"]["id"] == "blender"
    assert content["nb_info"]["total_train_time"] == 600.2
    assert content["nb_info"]["resources_utilization"] == {"memory": 1234}
    assert content["nb_info"]["hparams"]["train"]["max_seconds"] == 600.0


def test_images_that_are_gone_leave_the_metrics(tmp_path):
    score = fake_score("lego_800", 600.0, 33.0)
    for row in score["images"]:
        row["lpips"] = 0.25
    content = layout.results_of(score, tmp_path)
    assert layout.decode(content["metrics_raw"]["lpips_vgg"]) == [0.25, 0.25]
    assert "mae" not in content["metrics"] and "predictions_sha256" not in content


@pytest.mark.extra
@pytest.mark.scenes("lego")
def test_a_job_is_trained_scored_and_not_repeated(tmp_path):
    command = [sys.executable, "experiments/benchmark/run.py", "--jobs=lego_100", "--seconds=1", f"--out={tmp_path}"]
    command += ["--set=data.factor=32", f"--nerfbaselines={tmp_path / 'nerfbaselines'}"]
    environment = {**os.environ, "JAXNERF_COMMIT": "1234567"}

    def start(*flags):
        found = subprocess.run([*command, *flags], cwd=ROOT, env=environment, capture_output=True, text=True)
        assert found.returncode == 0, found.stderr
        return found.stdout

    assert "lego_100 after 1 s: starts in" in start()
    (score,) = json.loads((tmp_path / "lego_100" / "results.json").read_text())["runs"]
    assert len(score["images"]) == score["views"] == 25 and score["peak_memory_mb"] > 100
    assert score["machine"].startswith("cpu, 1 core(s)") and score["commit"] == "1234567"
    content = json.loads((tmp_path / "nerfbaselines" / "lego_100_1s.json").read_text())
    assert sorted(content["metrics"]) == [*(["lpips_vgg"] if "lpips" in score else []), "mae", "mse", "psnr", "ssim"]
    assert content["metrics"]["psnr"] == pytest.approx(score["psnr"], abs=1e-5)
    assert "lego_100 after 1 s: finished before" in start(f"--page={tmp_path / 'page.md'}")
    assert "| lego_100 with data.factor=32 | 25x25 | 25 |" in (tmp_path / "page.md").read_text()


@pytest.mark.parametrize(
    "flags, code, text",
    [
        (["--fly"], 2, "Unknown command line flag 'fly'"),
        (["--jobs=lego_100", "--report"], 1, "holds no scores of lego_100"),
    ],
)
def test_a_wrong_flag_is_reported_in_one_line(tmp_path, monkeypatch, flags, code, text):
    monkeypatch.setenv("JAXNERF_SCENES", str(tmp_path))
    (tmp_path / "lego").mkdir()
    found, _, err = run_forked(ROOT / "experiments" / "benchmark" / "run.py", f"--out={tmp_path}", *flags)
    assert found == code and err.startswith("error: ") and text in err and err.count("\n") == 1
