"""The card says what a figure was taken of, and beside which published tables that lets it stand."""

import types

import numpy as np
import pytest

import oracle
from configs import lego_small
from jaxnerf.evaluation import protocol
from jaxnerf.evaluation.evaluate import scores
from jaxnerf.training.build import build

_PART = "trained without some of the training views"
READ = {"format": "blender", "background": "white", "pixel_offset": 0.5, "factor": 1, "hold_out": 0}


def card_of(count, size, *, split="test", names=None, **read):
    """Returns the card of `count` views of one size, read as given."""
    names = tuple(f"r_{index}" for index in range(count)) if names is None else names
    views = types.SimpleNamespace(size=np.tile(np.int32([size]), (count, 1)), names=names)
    return protocol.metric_card(READ | read, views, split=split)


def beside(found):
    return [row["table"] for row in found["comparable_with"] if row["comparable"]]


def test_the_papers_images_stand_beside_its_tables_and_say_what_differs():
    found = card_of(200, (800, 800))
    assert [table.split()[0] for table in beside(found)] == ["NeRF", "JaxNeRF,", "nerfbaselines,"]
    paper, jaxnerf, other = ("; ".join(row["why"]) for row in found["comparable_with"][:3])
    assert "psnr_truncated" in paper and "0.22 dB" in paper and "pixel_offset 0, here 0.5" in paper
    assert "psnr_float" in jaxnerf and "about 1 dB" in jaxnerf
    assert "pixel_offset" not in other
    assert "pixel_offset" not in str(card_of(200, (800, 800), pixel_offset=0.0)["comparable_with"][:3])


@pytest.mark.parametrize(
    "count, size, options, wanted",
    [
        (25, (100, 100), {"factor": 8}, ("views is 25, there 200", "size is [100, 100], there [800, 800]")),
        (25, (800, 800), {}, ("views is 25, there 200",)),
        (200, (800, 800), {"background": "black"}, ("background is black, there white",)),
        (200, (800, 800), {"split": "val"}, ("split is val, there test",)),
        (200, (800, 800), {"num_views": 25}, (f"{_PART} (num_views 25), there with all",)),
        (200, (800, 800), {"hold_out": 8}, (f"{_PART} (hold_out 8), there with all",)),
        (200, (800, 800), {"format": "transforms"}, ("format is transforms, there blender",)),
        (8, (100, 100), {"format": "synthetic"}, ("format is synthetic, there blender",)),
    ],
)
def test_other_images_stand_beside_none_and_why(count, size, options, wanted):
    found = card_of(count, size, **options)
    assert beside(found) == []
    assert set(wanted) <= set(found["comparable_with"][0]["why"])


def test_forward_facing_photographs_stand_beside_those_tables():
    found = card_of(3, (756, 1008), format="llff", factor=4)
    assert [table.split(", ")[-1] for table in beside(found)] == ["forward-facing scenes"] * 2
    assert "of unknown worth" in str(found["comparable_with"][3]["why"])
    assert beside(card_of(3, (378, 504), format="llff", factor=8)) == []


def test_images_of_an_unknown_source_stand_beside_none():
    found = protocol.card_of({"reference": "gt-color"}, [(800, 800)] * 200)
    assert beside(found) == [] and found["conventions"]["views"] == 200
    assert "format is not known, there blender" in found["comparable_with"][0]["why"]


def test_it_says_which_views_and_what_of_them():
    of = lambda *args, **options: card_of(*args, **options)["conventions"]  # noqa: E731
    every_8th = of(3, (9, 9), names=("r_0", "r_8", "r_16"))["skip"]
    assert every_8th == "all that transforms_test.json lists; the numbers in the names go up by 8"
    assert of(3, (9, 9), names=("a", "b", "c"), format="llff")["skip"] == "every 8th by name, from the first"
    assert of(2, (9, 9), split="held_out", hold_out=8)["skip"].startswith("one in 8 of the training views")
    views = types.SimpleNamespace(size=np.int32([[9, 12], [12, 9], [9, 12]]), names=())
    mixed = protocol.metric_card(READ, views, split="test")["conventions"]
    assert (mixed["views"], mixed["size"]) == (3, [[9, 12], [12, 9]])
    assert {"rounding", "ssim", "data_range", "pixels", "mean", "lpips", *READ} < mixed.keys()


@pytest.mark.scenes("lego")
def test_lego_at_100_pixels_stands_beside_none(scenes_dir):
    experiment = build(lego_small.get_config())
    found = protocol.metric_card(experiment.conventions, experiment.load_views("test"), split="test")
    assert beside(found) == []
    about = found["conventions"]
    assert (about["format"], about["factor"], about["views"], about["size"]) == ("blender", 8, 25, [100, 100])
    assert about["skip"].endswith("go up by 8")


def test_truncation_leaves_8_bits_alone_and_else_costs_what_the_card_says():
    levels = np.resize(np.arange(256) / 255, (16, 32, 3)).astype(np.float32)
    found = scores(levels, 1 - levels)
    assert found["psnr_truncated"] == found["psnr"]
    rng = np.random.default_rng(0)
    truth = (rng.integers(80, 176, size=(128, 128, 3)) / 255).astype(np.float32)
    for decibels, rounding, truncation in ((30, 0.006, 0.02), (35, 0.018, 0.07), (40, 0.055, 0.22)):
        image = truth + np.float32(10 ** (-decibels / 20)) * rng.normal(size=truth.shape).astype(np.float32)
        found = scores(image, truth)
        assert found["psnr_float"] == pytest.approx(decibels, abs=0.1)
        assert found["psnr_float"] - found["psnr"] == pytest.approx(rounding, abs=0.006)
        assert found["psnr_float"] - found["psnr_truncated"] == pytest.approx(truncation, abs=0.012)
        cut_off = np.floor(255 * np.clip(image, 0, 1).astype(np.float32)) / 255
        assert found["psnr_truncated"] == pytest.approx(oracle.psnr(cut_off, truth), abs=1e-3)
