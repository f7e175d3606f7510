"""Captures whose needs are known, and the table of verdicts about them."""

import json

import numpy as np
import pytest

import jaxnerf
from jaxnerf.data.facts import footprint_spread
from jaxnerf.data.view_selection import held_out
from studies import study

known_verdicts = study("scene_needs/known_verdicts")
known_scenes = known_verdicts.known_scenes


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Returns a function (name, changes of the scene) -> the folder of a small capture, written once."""
    folder, done = tmp_path_factory.mktemp("known"), {}

    def write(name, **changes):
        path = folder / name
        small = known_scenes.SCENES[name]
        sizes = tuple(size // 4 for size in small.sizes)
        done.setdefault(name, known_scenes.write(small._replace(sizes=sizes, rays=1, **changes), path))
        return path

    return write


def stated_poses(folder):
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    return np.array([frame["transform_matrix"] for frame in frames])[:, :3]


def test_wrong_poses_are_wrong_by_as_much_as_stated_and_spare_the_held_out_views(written):
    exact, stated = stated_poses(written("matt")), stated_poses(written("turned"))
    trained = np.setdiff1d(np.arange(64), held_out(64, 8))
    same = np.setdiff1d(np.arange(68), trained)
    np.testing.assert_array_equal(stated[same], exact[same])
    np.testing.assert_array_equal(stated[..., 3], exact[..., 3])
    turns = np.einsum("vji,vjk->vik", exact[trained, :, :3], stated[trained, :, :3])
    angles = np.degrees(np.arccos((np.trace(turns, axis1=1, axis2=2) - 1) / 2))
    assert np.sqrt((angles**2).mean()) == pytest.approx(0.5 * 3**0.5, rel=1e-3)


def test_exposures_vary_in_training_alone(written):
    read = {"format": "transforms", "background": "none"}
    plain = jaxnerf.load_dataset(written("matt", noise=0.0), split="train", **read)
    varied = jaxnerf.load_dataset(written("exposed", noise=0.0), split="train", **read)
    ratios = []
    for index in range(64):
        one, other = (np.float64(views.image(index)) for views in (plain, varied))
        chosen = (one > 20 / 255) & (other < 250 / 255) & (other > 20 / 255)
        ratios.append(np.log2(np.median(other[chosen] / one[chosen])))
    spared = held_out(64, 8)
    np.testing.assert_allclose(np.array(ratios)[spared], 0, atol=0.05)  # rounded alpha and colours
    rest = np.delete(ratios, spared)
    assert abs(rest.mean()) < 0.05 and rest.std() == pytest.approx(0.5, rel=0.1)


def test_three_sizes_of_pixels_differ_enough_for_prefiltering_and_one_size_does_not(written):
    scales = jaxnerf.load_dataset(written("scales"), split="train")
    assert len(np.unique(np.asarray(scales.size))) == 3 and footprint_spread(scales) >= 4
    assert footprint_spread(jaxnerf.load_dataset(written("matt"), split="train")) < 1.5


def test_alpha_is_where_a_scene_says_so(written):
    alpha = {name: jaxnerf.load_dataset(written(name), split="test").pixels for name in ("fog", "sky")}
    assert alpha["fog"].shape[-1] == 4 and alpha["sky"].shape[-1] == 3


def results_of(name, **verdicts):
    """Returns results of the program that agree with what is known, but for some verdicts."""
    known = known_scenes.SCENES[name].verdicts
    effect = {"mean": 0.5, "lower": None, "upper": None}
    rows = []
    for change, (verdict, _) in known.items():
        part, _, kind = change.rpartition(", ")
        rows.append({"part": part, "change": kind, "verdict": verdicts.get(part, verdict), "effect": effect})
    return {"parts": rows}


def test_a_wrong_verdict_is_counted_and_an_open_one_is_open():
    changed = {"exposures": "needed", "footprints of pixels": "cannot tell"}
    found = known_verdicts.compared("matt", known_scenes.SCENES["matt"], results_of("matt", **changed))
    grades = {each.change: each.grade for each in found}
    assert grades.pop("exposures, more") == "WRONG" and grades.pop("footprints of pixels, more") == "open"
    assert set(grades.values()) == {"right"}
    lines = known_verdicts.table(found)
    assert lines[0] == f"{len(found) - 2} of {len(found)} right, 1 open, 1 wrong."
    assert sum("+0.50" in line for line in lines) == len(found)


def test_a_part_that_the_program_does_not_have_is_an_error():
    results = results_of("matt")
    results["parts"].pop(0)
    with pytest.raises(ValueError, match="matt: the program has no row 'view dependence, without'"):
        known_verdicts.compared("matt", known_scenes.SCENES["matt"], results)


def test_twelve_verdicts_and_more_are_known_each_with_a_reason():
    verdicts = [each for known in known_scenes.SCENES.values() for each in known.verdicts.values()]
    assert len(verdicts) >= 12 and all(reason for _, reason in verdicts)
    assert {verdict for verdict, _ in verdicts} == {"needed", "not needed"}
