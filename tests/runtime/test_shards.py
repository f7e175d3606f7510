"""Frames rendered by many processes: the same as by one, each once, none damaged, none mixed with others."""

import functools
import json
import math
import os
import shutil
import threading

import pytest

from jaxnerf.evaluation import aggregate, image_renderer
from jaxnerf.evaluation.evaluate import score_run
from jaxnerf.evaluation.restore import restore_run
from jaxnerf.runtime import shards
from jaxnerf.training import workdir
from runs import render_path, run_forked

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


@pytest.fixture(scope="module")
def run(trained, tmp_path_factory):
    """A copy of the trained workdir, and it opened."""
    folder = shutil.copytree(trained, tmp_path_factory.mktemp("shards") / "run")
    opened = restore_run(folder)
    # Threads stand for processes here, and orbax is for one thread.
    return folder, opened._replace(variables=functools.cache(opened.variables))


@pytest.fixture(scope="module")
def whole(run):
    """The results of an unsharded evaluation, and its folder, moved aside."""
    folder, opened = run
    results = score_run(opened, folder)  # which caches the variables, too
    return results, shutil.move(folder / "eval" / "20", folder / "whole")


@pytest.fixture
def fresh(run, whole):
    """A function that scores a shard in a workdir without results; and the folder of results."""
    folder, opened = run
    shutil.rmtree(folder / "eval", ignore_errors=True)
    return lambda text=None, **options: score_run(opened, folder, shard=shards.parse(text), **options), folder / "eval"


@pytest.fixture
def rendered(monkeypatch):
    """A list that grows by an entry for each rendered frame."""
    calls, render_image = [], image_renderer.render_image
    monkeypatch.setattr(image_renderer, "render_image", lambda *a, **k: calls.append(1) or render_image(*a, **k))
    return calls


def contents(folder):
    """Returns the bytes of a folder's files by name, except results.json, which holds times."""
    files = (path for path in folder.rglob("*.*") if path.name != "results.json")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def without_times(results):
    rows = [{name: value for name, value in row.items() if name != "seconds"} for row in results["images"]]
    return {**results, "images": rows, "seconds_per_frame": 0, "rays_per_second": 0}


def test_shards_in_any_order_give_the_result_of_one_call(fresh, whole, rendered):
    score, folder = fresh
    assert score("2/3") is None and score("0/3") is None
    assert len(rendered) == 2 + 3 and [path.name for path in folder.iterdir()] == ["20.tmp"]
    results = score("1/3")
    assert without_times(results) == without_times(whole[0])
    assert json.loads((folder / "20" / "results.json").read_text()) == results
    assert contents(folder / "20") == contents(whole[1])
    assert [path.name for path in folder.iterdir()] == ["20"]
    assert score("1/3") == results and len(rendered) == 8, "a finished shard renders nothing"
    assert results["seconds_per_frame"] < 2 * max(row["seconds"] for row in results["images"])


def test_an_interrupted_call_loses_only_the_view_that_it_rendered(fresh, whole, rendered, monkeypatch):
    score, folder = fresh
    finish = aggregate.mark_finished

    def stopped(folder, index, *rest, **options):
        if index == 2:
            raise KeyboardInterrupt
        finish(folder, index, *rest, **options)

    monkeypatch.setattr(aggregate, "mark_finished", stopped)
    with pytest.raises(KeyboardInterrupt):
        score()
    monkeypatch.setattr(aggregate, "mark_finished", finish)
    (folder / "20.tmp" / "rows" / "005.json.0a1b.tmp").write_text("{")  # as a kill leaves it
    assert len(rendered) == 3 and not (folder / "20").exists()
    assert without_times(score()) == without_times(whole[0])
    assert len(rendered) == 3 + 6 and contents(folder / "20") == contents(whole[1])


def test_damaged_files_are_named_and_their_views_rendered_again(fresh, whole, rendered, capsys):
    score, folder = fresh
    score("0/2")
    damaged = [folder / "20.tmp" / name for name in ("color/000.png", "depth/002.tiff", "contact_sheet/004.png")]
    for path in (*damaged, folder / "20.tmp" / "rows" / "006.json"):
        os.truncate(path, path.stat().st_size // 2)
    (folder / "20.tmp" / "rows" / "stranger.tmp").mkdir()
    (folder / "20.tmp" / "color" / "stranger.tmp").mkdir()
    assert without_times(score()) == without_times(whole[0])
    (folder / "20" / "color" / "stranger.tmp").rmdir()
    assert len(rendered) == 4 + 8 and contents(folder / "20") == contents(whole[1])
    said = capsys.readouterr().err
    assert all(f"{path}: is damaged; its view is rendered again" in said for path in damaged)
    assert "rows/006.json: is damaged" in said


def test_only_complete_rows_and_results_are_believed(whole, tmp_path):
    results, folder = whole
    row = {**results["images"][0], "seconds": 1.0}
    good = {"row": row, "first": True, "rays": 9}
    assert aggregate.is_finished(good)
    wrong = [{}, [], 5, None, {**good, "row": []}, {**good, "rays": None}, {**good, "first": 1}]
    wrong += [{**good, "row": {**row, name: value}} for name in ("psnr", "seconds") for value in (None, "1", True)]
    wrong += [{**good, "row": {**row, "name": 3}}, {**good, "row": {**row, "seconds": 0.0}}]
    wrong += [{**good, "row": {**row, "seconds": math.inf}}, {**good, "rays": -math.inf}, {**good, "rays": math.nan}]
    assert not any(map(aggregate.is_finished, wrong))
    provenance = {"split": "test"}
    for content in ("[]", "{}", json.dumps({**results, "psnr": "high"})):
        (tmp_path / aggregate.PROVENANCE).write_text(json.dumps(provenance))
        (tmp_path / "results.json").write_text(content)
        with pytest.raises(ValueError, match="results.json: lacks metrics, .*remove it"):
            aggregate.read(tmp_path, provenance, "remove it")


def test_two_shards_that_finish_together_both_return_the_result(fresh, monkeypatch):
    """The second one finishes between the first one's check and its move; a third one follows."""
    score, folder = fresh
    score("0/2")
    replace, others = os.replace, []

    def overtaken(source, target):
        if str(target).endswith("eval/20") and not others:
            others.append("running")
            others.extend([score("1/2"), score("0/2")])
        replace(source, target)

    monkeypatch.setattr(aggregate.os, "replace", overtaken)
    results = score("1/2")
    assert others[1:] == [results, results] and [path.name for path in folder.iterdir()] == ["20"]


@pytest.mark.parametrize("late", [False, True])
def test_a_call_that_is_overtaken_keeps_the_result_of_the_other(fresh, whole, monkeypatch, late):
    """The other one finishes after this one has written results.json; a late third one makes the folder again."""
    score, folder = fresh
    replace, others = os.replace, []

    def overtaken(source, target):
        replace(source, target)
        if str(target).endswith("20.tmp/results.json") and not others:
            others.append("running")
            others.append(score())
            if late:
                (folder / "20.tmp" / "rows").mkdir(parents=True)
                (folder / "20.tmp" / "rows" / "000.json").write_text("{}")

    monkeypatch.setattr(aggregate.os, "replace", overtaken)
    results = score()
    assert others[1] == results and contents(folder / "20") == contents(whole[1])
    assert [path.name for path in folder.iterdir()] == ["20"]


def test_concurrent_calls_damage_no_file(fresh, whole):
    score, folder = fresh
    found, texts = [], ["0/2", "1/2", "0/2", "1/2", "0/1"]
    threads = [threading.Thread(target=lambda text=text: found.append(score(text))) for text in texts]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert len(found) == len(texts) and any(found)
    assert contents(folder / "20") == contents(whole[1])
    assert [path.name for path in folder.iterdir()] == ["20"]


def test_views_of_other_settings_are_not_mixed(fresh, run, whole):
    score, folder = fresh
    score("0/2")
    other = restore_run(run[0], settings={"sample_multiplier": 2.0})
    with pytest.raises(ValueError, match=r"20.tmp: holds .* sample_multiplier 1.0, not 2.0; give --overwrite without"):
        score_run(other, run[0], shard=(1, 2))
    config = workdir.load_config(run[0], fine={"density_bias": 0.5})
    with pytest.raises(ValueError, match="rendered with config"):
        score_run(restore_run(run[0], config), run[0])
    chunked = restore_run(run[0], settings={"chunk": 577})
    with pytest.raises(ValueError, match="--overwrite with --shard would delete other shards' frames"):
        score("0/2", overwrite=True)
    assert score_run(chunked, run[0], shard=(1, 2))["images"][0]["name"] == "test_000", "the chunk changes no pixel"
    with pytest.raises(ValueError, match="eval/20: holds .* sample_multiplier 1.0, not 2.0"):
        score_run(other, run[0], shard=(1, 2))


@pytest.mark.slow
def test_shards_of_a_path_make_its_video_when_all_frames_exist(run, rendered, tmp_path, capsys):
    folder = shutil.copytree(run[0], tmp_path / "run", ignore=shutil.ignore_patterns("eval", "whole"))
    options = {"path": "turntable", "num_frames": 3, "width": 8, "height": 8, "video": "gif", "settings": {"chunk": 64}}
    target = folder / "renders" / "turntable-20"
    assert render_path(folder, shard=(1, 2), **options) == [target]
    assert "shard 1/2 is done, 2 frames of others are missing" in capsys.readouterr().err
    assert [path.name for path in (target / "color").iterdir()] == ["0001.png"] and len(rendered) == 1
    assert not list((target / "depth").glob("*.png")), "one range for the whole path"
    with pytest.raises(ValueError, match="would delete other shards' frames; remove .*turntable-20 first"):
        render_path(folder, shard=(0, 2), overwrite=True, **options)
    assert render_path(folder, shard=(0, 2), **options) == [target, target.with_name("turntable-20.gif")]
    assert len(rendered) == 3 and len(list((target / "depth").glob("*.png"))) == 3
    assert render_path(folder, shard=(1, 2), **options)[1].exists() and len(rendered) == 3


def test_the_flag_names_a_shard_by_index_and_count(monkeypatch):
    assert shards.parse(None) == shards.parse("0/1") == (0, 1) and shards.parse("3/16") == (3, 16)
    assert sorted(sum((shards.indices_of(range(7), (k, 3)) for k in range(3)), [])) == list(range(7))
    assert shards.indices_of(range(2), (2, 3)) == []
    for wrong in ("16/16", "1", "-1/2", "1/0", "0/0", "a/b", "1/2/3", "", " 1/2"):
        with pytest.raises(ValueError, match="--shard is .*, expected K/N with K from 0 below N"):
            shards.parse(wrong)
    with pytest.raises(ValueError, match="neither srun nor mpirun"):
        shards.parse("auto")
    monkeypatch.setenv("SLURM_PROCID", "2")
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "8")
    assert shards.parse("auto") == (2, 8)


def test_shard_with_watch_is_an_error(run):
    code, _, err = run_forked("eval", f"--workdir={run[0]}", "--shard=0/2", "--watch")
    assert code == 1 and "not --watch; drop" in err and len(err.splitlines()) == 1
