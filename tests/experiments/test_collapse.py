"""The study of dead networks counts runs that died, were reinitialized, or did not change."""

import pytest

from studies import study


def test_collapse_counts_dead_reinitialized_and_unaffected_runs():
    collapse = study("stability/collapse")
    row = {"dead": (), "num_reinits": 0, "found": [], "psnr": 20.0, "parameters": "a"}
    rows = [row | {"max_reinits": allowed, "seed": seed} for seed in range(3) for allowed in (0, 10)]
    rows[0] |= {"dead": ("fine",), "psnr": 8.0}
    rows[1] |= {"num_reinits": 2, "found": [100, 150], "psnr": 17.0, "parameters": "b"}
    without, reinitialized = map(collapse.summary, collapse.by_setting(rows))
    assert without == ("0", "3", "1", "0 times in 0 runs", "-", "20.00 dB", "8.00 dB")
    runs = ("2 times in 1 runs", "125 (first 100, last 150)", "20.00 dB", "17.00 dB")
    assert reinitialized == ("10", "3", "0", *runs)
    assert collapse.unaffected(rows).startswith("Of 2 runs in which no network died, 2 end with the same")
    rows[3]["parameters"] = "c"
    assert collapse.unaffected(rows).startswith("Of 2 runs in which no network died, 1 end with the same")


def test_painted_backgrounds_count_runs_hardly_better_than_the_background():
    collapse = study("stability/collapse")
    row = {"background": "white", "output": "sigmoid", "psnr_alone": 20.0}
    rows = [row | {"psnr": psnr} for psnr in (21.9, 22.1, 30.0)]
    cells = ("white", "`sigmoid`", "3", "1", "20.00 dB", "22.10 dB", "21.90 dB")
    assert collapse.painted_summary(rows) == cells


@pytest.mark.extra
def test_captures_with_painted_backgrounds_train():
    """With a plain sigmoid, both seeds in front of black and one of two in front of white collapse."""
    collapse = study("stability/collapse")
    trained = collapse.PaintedStudy(480, "color_activation")
    for background in collapse.BACKGROUNDS:
        for seed in range(2):
            row = trained.run(seed, background)
            assert row["psnr"] > row["psnr_alone"] + 2, row
