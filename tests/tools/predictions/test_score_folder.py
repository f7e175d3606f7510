"""Images rendered elsewhere: how they are paired with references, and that their scores are those of an evaluation."""

import json
import os
import shutil

import imageio.v3 as iio
import numpy as np
import pytest

import captures
from jaxnerf import load_dataset
from jaxnerf.evaluation import aggregate
from jaxnerf.evaluation.evaluate import summary
from jaxnerf.tools.predictions.score_folder import score_folder
from runs import evaluate, run_forked, smoke_config, start

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


def test_predictions_have_the_metrics_of_the_evaluation_that_wrote_them(trained, tmp_path):
    run = shutil.copytree(trained, tmp_path / "run")
    results, folder = evaluate(run), run / "eval" / "20"
    for source, config in ((folder, None), (folder / "color", smoke_config())):
        target = shutil.copytree(source, tmp_path / source.name, ignore=shutil.ignore_patterns("results.json"))
        found = score_folder(target, config=config)
        assert json.loads((target / "results.json").read_text()) == found
        assert found["psnr"] == pytest.approx(results["psnr"], abs=1e-4)
        assert found["ssim"] == pytest.approx(results["ssim"], abs=1e-5)
        assert found["psnr_truncated"] == found["psnr"]  # of 8 bits already
        assert found["conventions"]["size"] == [24, 24] and len(found["comparable_with"]) == 5
        with pytest.raises(ValueError, match="exists already"):
            score_folder(target, config=config)
    os.remove(tmp_path / "20" / "color" / "003.png")
    with pytest.raises(ValueError, match="color: holds 7 images, expected 8"):
        score_folder(tmp_path / "20", overwrite=True)


@pytest.mark.parametrize(
    "found, expected, how, pairs",
    [
        (["r_2", "r_10"], ["r_10", "r_2"], "name", [1, 0]),
        ([f"pred_{index}" for index in range(12)], [f"gt_{index:03d}" for index in range(12)], "number", range(12)),
        (["7", "8", "9", "10"], ["a9", "a7", "a10", "a8"], "number", [2, 0, 3, 1]),
        ([f"r_{index}" for index in range(5, 13)], [f"{index:03d}" for index in range(8)], "order", range(8)),
        (["cam1_0", "cam2_0", "cam10_0"], ["cam1/0", "cam10/0", "cam2/0"], "name", [0, 2, 1]),
        (["a__b.jpg", "B.c"], ["A/b", "b/c"], "name", [0, 1]),
        (["a/0", "b/0", "b/1"], ["images/b/0", "images/a/0", "images/b/1"], "name", [1, 0, 2]),
        (["cam10000", "cam20000"], ["cam2/0000", "cam1/0000"], "name", [1, 0]),
        (["0008", "0000"], ["cam1/0000", "cam2/0008"], "name", [1, 0]),
        (["c2-8", "c1-8"], ["cam1/0008", "cam2/0008"], "number", [1, 0]),
        (["1_1", "2_1"], ["a", "b"], "order", [0, 1]),
    ],
)
def test_predictions_are_paired_by_name_or_number_or_in_natural_order(tmp_path, caplog, found, expected, how, pairs):
    """The pictures are of grey levels, so that each pair is known."""
    for index, place in enumerate(pairs):
        level = np.full((12, 12, 3), 10 * index, np.uint8)
        for folder, name in ((tmp_path / "color", found[place]), (tmp_path / "gt-color", expected[index])):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            iio.imwrite(folder / f"{name}.png", level)
    results = score_folder(tmp_path)
    assert results["paired_by"] == how and results["psnr"] == np.inf
    warned = [record.getMessage() for record in caplog.records if "paired by" in record.getMessage()]
    assert len(warned) == (how != "name")
    assert (f"paired by {how}" in summary(results)) == (how != "name")
    assert f"{len(found)} images equal their references" in summary(results)
    written = json.loads((tmp_path / "results.json").read_text(), parse_constant=pytest.fail)  # Infinity is no JSON
    assert written == results == aggregate.read_results(tmp_path, "")


@pytest.mark.parametrize(
    "found, expected",
    [
        (["b", "a"], ["x", "y"]),
        (["cam1_0000", "cam2_0003"], ["cam1/0000", "cam2/0008"]),
        (["cam1_0001", "cam2_0000"], ["cam1/0000", "cam2/0001"]),
        (["frame_1", "frame_2"], ["frame_0", "frame_1"]),
        (["a_b_c", "d"], ["a/b_c", "a_b/c"]),
    ],
)
def test_predictions_whose_names_state_other_references_are_refused(tmp_path, found, expected):
    for folder, names in (("color", found), ("gt-color", expected)):
        for name in names:
            (tmp_path / folder / name).parent.mkdir(parents=True, exist_ok=True)
            iio.imwrite(tmp_path / folder / f"{name}.png", np.zeros((12, 12, 3), np.uint8))
    with pytest.raises(ValueError, match="color: .* do not pair up with the references"):
        score_folder(tmp_path)


def test_predictions_without_a_reference_and_missing_ones_are_named(tmp_path):
    for folder, names in (("color", "01349x"), ("gt-color", "0123456789")):
        (tmp_path / folder).mkdir()
        for name in names:
            iio.imwrite(tmp_path / folder / f"r_{name}.png", np.zeros((12, 12, 3), np.uint8))
    named = "without a reference: r_x; missing: r_2, r_5, r_6, r_7, r_8; add"
    with pytest.raises(ValueError, match=f"6 images, expected 10, .*; {named}"):
        score_folder(tmp_path)


@pytest.mark.parametrize(
    "size, hint", [((12, 15), "factor=2 reads a dataset at that size$"), ((12, 14), "give both one size$")]
)
def test_predictions_of_another_size_are_refused(tmp_path, size, hint):
    for folder, shape in ((tmp_path / "color", size), (tmp_path / "gt-color", (25, 30))):
        folder.mkdir()
        iio.imwrite(folder / "0.png", np.zeros((*shape, 3), np.uint8))
    with pytest.raises(ValueError, match=f"0.png: has shape .*, its reference .*; .*{hint}"):
        score_folder(tmp_path)


@pytest.mark.slow
def test_a_flat_folder_is_scored_against_a_dataset(tmp_path):
    """--data_dir alone names the dataset; without it the message says what to give."""
    shots = captures.shoot(captures.orbit(4))
    for split in ("train", "test"):
        captures.write_blender(tmp_path / "data", shots, split=split)
    views = load_dataset(tmp_path / "data", split="test")
    (tmp_path / "flat").mkdir()
    for index in range(4):
        iio.imwrite(tmp_path / "flat" / f"{index:03d}.png", np.uint8(np.rint(255 * np.asarray(views.image(index)))))
    flag = f"--predictions={tmp_path / 'flat'}"
    _, _, err = run_forked("eval", flag)
    assert "flat/gt-color: holds no images" in err and "name their dataset with --data_dir" in err
    process = start("eval", flag, f"--data_dir={tmp_path / 'data'}")
    process.communicate(timeout=120)
    results = json.loads((tmp_path / "flat" / "results.json").read_text())
    assert process.returncode == 0 and results["psnr"] > 50 and results["views"] == 4
