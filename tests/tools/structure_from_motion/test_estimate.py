"""Tests jaxnerf-cameras: refusals that change no file, its report, and, where pycolmap is installed, its results."""

import contextlib
import importlib.machinery
import json
import os
import pathlib
import shutil
import signal
import sqlite3
import sys
import time
import types

import numpy as np
import pytest
from PIL import Image

import captures
import runs
from jaxnerf.data.readers import colmap
from jaxnerf.data.readers.base import read_capture
from jaxnerf.tools.structure_from_motion import colmap_process, estimate
from jaxnerf.tools.structure_from_motion import images as images_module
from jaxnerf.tools.structure_from_motion.colmap_process import Model
from jaxnerf.tools.structure_from_motion.estimate import CAMERA_MODELS, Report, Settings, estimate_cameras


@pytest.fixture
def images(tmp_path):
    """Returns a folder with three images."""
    folder = tmp_path / "in"
    folder.mkdir()
    for name in "abc":
        Image.new("RGB", (12, 8)).save(folder / f"{name}.png")
    return folder


@pytest.fixture
def pycolmap(monkeypatch):
    """Replaces pycolmap by an empty module."""
    module = types.ModuleType("pycolmap")
    module.__spec__ = importlib.machinery.ModuleSpec("pycolmap", None)
    monkeypatch.setitem(sys.modules, "pycolmap", module)


def files(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_without_pycolmap_the_command_that_installs_it_is_named(images, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)  # as if it were not installed
    with pytest.raises(ValueError, match=r"pycolmap is not installed.*pip install 'jaxnerf\[cameras\]'"):
        estimate_cameras(images, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("setting, value", [("camera_model", "FOV"), ("matching", "all")])
def test_wrong_settings_are_reported(images, tmp_path, pycolmap, setting, value):
    with pytest.raises(ValueError, match=f"--{setting} is '{value}', expected one of "):
        estimate_cameras(images, tmp_path / "out", Settings(**{setting: value}))
    assert not (tmp_path / "out").exists()


def test_a_folder_without_images_is_reported_in_one_line(tmp_path):
    code, out, err = runs.run_forked("cameras", f"--images={tmp_path}", f"--out={tmp_path / 'out'}")
    assert (code, out) == (1, "")
    assert err.startswith(f"error: {tmp_path}: holds no images, expected at least 3 ") and err.count("\n") == 1


def test_a_missing_folder_is_reported(tmp_path, pycolmap):
    with pytest.raises(ValueError, match="nowhere: is no folder"):
        estimate_cameras(tmp_path / "nowhere", tmp_path / "out")


def test_a_damaged_image_is_named(images, tmp_path, pycolmap):
    data = (images / "b.png").read_bytes()
    (images / "b.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match="b.png: unreadable"):
        estimate_cameras(images, tmp_path / "out", say=lambda line: None)


def test_an_existing_model_is_not_replaced(images, tmp_path, pycolmap):
    out = tmp_path / "out"
    captures.write_colmap(out, captures.noise(captures.orbit(3)))
    before = files(tmp_path)
    with pytest.raises(ValueError, match="sparse/0: exists; add --overwrite to replace .*/sparse, or choose another"):
        estimate_cameras(images, out)
    assert files(tmp_path) == before


def test_a_dataset_of_another_format_is_reported(images, tmp_path, pycolmap):
    out = tmp_path / "out"
    captures.write_transforms(out, captures.noise(captures.orbit(3)))
    for overwrite in (False, True):
        with pytest.raises(ValueError, match="holds a dataset of the format transforms, which would be read instead"):
            estimate_cameras(images, out, overwrite=overwrite)


def test_a_database_of_other_settings_is_not_used(images, tmp_path, pycolmap):
    work = tmp_path / "out" / "cameras"
    work.mkdir(parents=True)
    (work / "database.db").write_bytes(b"features")
    before = files(tmp_path)
    with pytest.raises(ValueError, match="database.db: was made of other images or with other settings.*--overwrite"):
        estimate_cameras(images, tmp_path / "out", say=lambda line: None)
    assert files(tmp_path) == before


@pytest.mark.parametrize(
    "sql, found",
    [
        (
            "CREATE VIEW descriptors AS WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x+1 FROM c) SELECT * FROM c",
            "view",
        ),
        ("CREATE TABLE a (b); CREATE TRIGGER t AFTER INSERT ON a BEGIN DELETE FROM a; END", "the trigger 't'"),
        ("CREATE TABLE images (name, size AS (length(name)))", "the table 'images'"),
        ("CREATE VIRTUAL TABLE images USING fts5(name)", "the table 'images'"),
        (None, "is no database of COLMAP"),
    ],
)
def test_a_database_of_anything_but_tables_is_refused(images, tmp_path, pycolmap, monkeypatch, sql, found):
    monkeypatch.setattr(estimate._Stages, "_claim", lambda self: None)  # as if the settings were the same
    database = tmp_path / "out" / "cameras" / "database.db"
    database.parent.mkdir(parents=True)
    if sql:
        with contextlib.closing(sqlite3.connect(database)) as connection:
            connection.executescript(sql)
    else:
        database.write_text("no database")
    with pytest.raises(ValueError, match=f"database.db: .*{found}.*; remove .*cameras"):
        estimate_cameras(images, tmp_path / "out", say=lambda line: None)


def test_a_query_without_an_end_is_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(colmap_process, "_QUERY_SECONDS", 0.1)
    endless = "(WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x+1 FROM c) SELECT x FROM c)"
    with contextlib.closing(sqlite3.connect(tmp_path / "a.db")) as connection:
        connection.execute("CREATE TABLE a (b)")
    assert colmap_process.count_rows(tmp_path / "a.db", endless) == 0


def test_white_space_in_names_is_reported_where_images_are_used_in_place(tmp_path, images, pycolmap):
    (images / "a.png").rename(images / "a 1.png")
    images = images.rename(tmp_path / "images")
    with pytest.raises(ValueError, match="'a 1.png': the name has characters that .* expected 'a_1.png'"):
        estimate_cameras(images, tmp_path)


def test_camera_models_are_those_that_the_reader_reads(tmp_path):
    from jaxnerf.data.readers import colmap

    assert set(CAMERA_MODELS) <= set(colmap._LENSES)


def test_the_report_names_what_is_registered_and_the_next_commands():
    folder = pathlib.Path("out") / "cameras" / "models"
    models = (
        Model(folder / "1", ("a", "b", "c"), 100, 2.5, 0.666),
        Model(folder / "0", ("d", "e"), 10, 2.0, 0.5),
    )
    report = Report(pathlib.Path("out"), tuple("abcdef"), ("OPENCV",), models, {"features": 3.2}, ("as copied",))
    text = report.text()
    for part in (
        "3 of 6 images, the largest of 2 models",
        "the others have 2 images and are in out/cameras/models",
        "d, e, f; more images between these",
        "0.67 px, mean reprojection error",
        "100, each in 2.5 images on average",
        "as copied",
        "features 3 s",
        "\n  jaxnerf-check --data_dir=out\n",
        "\n  jaxnerf-train --config=capture --data_dir=out --workdir=runs/out",
    ):
        assert part in text
    alone = report._replace(models=models[:1], images=tuple("abc")).text()
    assert alone.startswith("registered      3 of 3 images\n") and "not registered" not in alone


def test_a_model_that_contradicts_consecutive_images_is_estimated_again(images, tmp_path, pycolmap, monkeypatch):
    """Fakes COLMAP: all matches give a model that contradicts a pair, those of close images one that does not."""
    folded = (Model(None, ("a.png", "b.png", "c.png"), 9, 2.0, 0.9, (("a.png", "b.png"),)),)
    right, mapped = (folded[0]._replace(error=0.5, contradictions=()),), []

    def call(stage, *arguments, log, progress):
        database = arguments[0]
        if stage is colmap_process.import_images:
            with contextlib.closing(sqlite3.connect(database)) as made:
                made.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
                made.execute("CREATE TABLE descriptors (image_id INTEGER)")
                made.execute("CREATE TABLE two_view_geometries (pair_id INTEGER, rows INTEGER)")
                for key, name in enumerate(arguments[2][0], 1):
                    made.execute("INSERT INTO images VALUES (?, ?)", (key, name))
                    made.execute("INSERT INTO descriptors VALUES (?)", (key,))
                for first, second in ((1, 2), (1, 3), (2, 3)):
                    made.execute("INSERT INTO two_view_geometries VALUES (?, 9)", (first * 2147483647 + second,))
                made.commit()
            return arguments[2][0]
        assert stage is colmap_process.map_images, "features and matches are complete"
        pairs = colmap_process.count_rows(database, "two_view_geometries")
        mapped.append(pairs)
        (result,) = folded if pairs == 3 else right
        captures.write_colmap(arguments[3] / "fake", captures.noise(captures.orbit(3)))
        shutil.move(arguments[3] / "fake" / "sparse" / "0", arguments[3] / "0")
        shutil.rmtree(arguments[3] / "fake")
        for file in "abc":
            shutil.copy(images / f"{file}.png", tmp_path / "out" / "images" / f"{ord(file) - ord('a'):03d}.png")
        return [result._replace(folder=arguments[3] / "0")]

    monkeypatch.setattr(colmap_process, "call", call)
    monkeypatch.setattr(images_module, "OVERLAP", 1)
    report = estimate_cameras(images, tmp_path / "out", say=lambda line: None)
    assert mapped == [3, 2]
    assert report.models[0].error == 0.5
    assert "a first model contradicted 1 pair of consecutive images, such as a.png and b.png" in report.text()
    assert sorted(path.name for path in (tmp_path / "out" / "cameras").iterdir()) == ["database.db", "settings.json"]


def test_counting_rows_takes_no_lock_while_colmap_runs(tmp_path):
    """COLMAP fails if it opens a database that another process reads."""
    database = tmp_path / "database.db"
    with contextlib.closing(sqlite3.connect(database, isolation_level=None)) as writer:
        writer.execute("CREATE TABLE descriptors (image_id INTEGER)")
        writer.execute("INSERT INTO descriptors VALUES (1)")
        writer.execute("BEGIN EXCLUSIVE")
        assert colmap_process.count_rows(database, "descriptors", running=True) == 1
    assert colmap_process.count_rows(database, "descriptors") == 1
    assert colmap_process.count_rows(tmp_path / "missing.db", "descriptors", running=True) == 0


def failing_stage(*, report):
    report(5)
    raise RuntimeError("no such thing")


def killed_stage(*, report):
    os.kill(os.getpid(), signal.SIGABRT)


@pytest.mark.parametrize("stage, reason", [(failing_stage, "RuntimeError: no such thing"), (killed_stage, "SIGABRT")])
def test_a_stage_that_fails_names_the_log(tmp_path, stage, reason):
    log = tmp_path / "log.txt"
    with pytest.raises(ValueError, match=rf"log.txt: COLMAP failed \({reason}\)"):
        colmap_process.call(stage, log=log, progress=lambda count: None)
    assert stage is killed_stage or "no such thing" in log.read_text()


@pytest.mark.extra
@pytest.mark.scenes("can")
def test_cameras_of_a_few_images_agree_with_the_given_ones_and_an_interrupted_call_continues(scenes_dir, tmp_path):
    pytest.importorskip("pycolmap")
    images, out = tmp_path / "in", tmp_path / "out"
    images.mkdir()
    for path in sorted((scenes_dir / "can" / "images").iterdir())[:8]:
        shutil.copy(path, images / path.name.replace("00", "00 "))
    flags = (f"--images={images}", f"--out={out}", "--max_size=500", "--num_threads=1")

    process = runs.start("cameras", *flags)
    database = out / "cameras" / "database.db"
    log = out / "cameras" / "log.txt"
    while not (log.exists() and "Processed file" in log.read_text()):  # the database is COLMAP's while it runs
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()
    assert process.returncode == 130 and err.startswith("stopped") and err.count("\n") == 1, err
    assert not (out / "sparse").exists()
    extracted = colmap_process.count_rows(database, "descriptors")

    code, text, err = runs.run_forked("cameras", *flags)
    assert code == 0, err
    assert "registered      8 of 8 images\n" in text
    assert sum(line.count("Processed file") for line in (out / "cameras" / "log.txt").open()) <= 8 + 8 - extracted + 1

    found, given = read_capture(out), read_capture(scenes_dir / "can")
    assert found.format == "colmap" and len(found.points) > 100
    assert {frame.camera.lens for frame in found.frames} == {"opencv"}
    turns = [[np.asarray(frame.camera.to_world)[:, :3] for frame in capture.frames[:8]] for capture in (found, given)]
    for first, second in zip(*turns, strict=True):  # rotations between pairs of images do not depend on the world
        apart = turns[0][0].T @ first @ (turns[1][0].T @ second).T
        assert np.degrees(np.arccos(min((np.trace(apart) - 1) / 2, 1.0))) < 1.0

    before = files(out / "sparse")
    code, _, err = runs.run_forked("cameras", *flags)
    assert code == 1 and "add --overwrite" in err and files(out / "sparse") == before
    code, text, err = runs.run_forked("cameras", *flags, "--overwrite")
    assert code == 0 and files(out / "sparse") == before, err
    assert json.loads((out / "cameras" / "settings.json").read_text())["matching"] == "exhaustive"

    given = colmap.read_capture(out)
    shutil.move(out / "sparse", tmp_path / "sparse")
    shutil.copytree(out / "images", tmp_path / "images")
    code, text, err = runs.run_forked("cameras", *flags, f"--cameras_of={tmp_path}")
    assert code == 0 and "triangulation: 8 of 8 images" in text, err
    found = colmap.read_capture(out)
    assert len(found.points) > 100 and all(len(frame.seen) for frame in found.frames)
    for first, second in zip(found.frames, given.frames, strict=True):
        np.testing.assert_allclose(first.camera.to_world, second.camera.to_world, atol=1e-12)
        np.testing.assert_allclose(first.camera.focal, second.camera.focal)


def test_known_cameras_are_those_of_the_images_size_in_the_axes_of_colmap(tmp_path, images):
    pose = np.column_stack([np.diag([1.0, -1, -1]), [1, 2, 3]])  # looks along +z
    lens = {"camera_model": "OPENCV", "k1": 0.1, "k2": 0.0, "p1": 0.0, "p2": 0.02}
    content = {"w": 48, "h": 32, "fl_x": 40.0, "fl_y": 44.0, "cx": 25.0, "cy": 15.0, **lens}
    content["frames"] = [
        {"file_path": f"{name}.png", "transform_matrix": [*pose.tolist(), [0, 0, 0, 1]]} for name in "abc"
    ]
    (images / "transforms.json").write_text(json.dumps(content))
    paths = sorted(images.glob("*.png"))
    known = estimate.known_cameras(images, paths)
    assert list(known) == ["a.png", "b.png", "c.png"]
    kind, parameters, to_camera = known["b.png"]
    assert kind == "OPENCV"
    np.testing.assert_allclose(parameters, [10, 11, 6.25, 3.75, 0.1, 0, 0, 0.02])
    np.testing.assert_allclose(to_camera, np.column_stack([np.eye(3), [-1, -2, -3]]))
    with pytest.raises(ValueError, match="has no camera of d.png, expected one of each of the 1 images"):
        estimate.known_cameras(images, [images / "d.png"])
