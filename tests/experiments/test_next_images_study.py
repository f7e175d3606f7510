"""The study of next images: the views that are farthest away, and the area under a curve."""

import types

import numpy as np
import pytest

import captures
from studies import study as import_study

study = import_study("coverage/next_images")


def test_the_farthest_view_is_chosen(monkeypatch):
    monkeypatch.setattr(study, "_ADD", types.SimpleNamespace(value=2))
    pool = types.SimpleNamespace(cameras=captures.orbit(8))
    eyes = np.asarray(pool.cameras.to_world)[:, :, 3]
    first, second = study.by_distance(None, None, pool, [0], list(range(1, 8)), None)
    apart = np.linalg.norm(eyes[:, None] - eyes, axis=-1)
    assert first == apart[0].argmax()
    assert second == np.minimum(apart[0], apart[first]).argmax()


def test_the_area_is_a_mean_over_the_number_of_images():
    assert study.area({"10": 20.0, "15": 24.0, "20": 24.0}) == pytest.approx(23.0)


def test_the_table_compares_with_random_seed_by_seed():
    results = {"coverage": {0: {"10": 20.0, "20": 24.0}, 1: {"10": 20.0, "20": 22.0}}}
    results["random"] = {0: {"10": 20.0, "20": 23.0}, 1: {"10": 20.0, "20": 23.0}}
    rows = study.table("lego", results)
    assert rows[2].endswith("| +0.00 (1 of 2) |") and "| 23.00 |" in rows[2]
