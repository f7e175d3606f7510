"""The study of dead networks counts runs that died, were reinitialized, or did not change."""

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
