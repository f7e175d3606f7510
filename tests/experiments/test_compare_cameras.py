"""The comparison of the cameras of two datasets, in groups."""

import numpy as np

from jaxnerf.core.poses import se3_exponential
from jaxnerf.data.synthetic import load_synthetic
from studies import study

compare = study("pose_estimation/compare_cameras")
TRUTH = np.float64(load_synthetic(size=200).cameras.to_world)


def test_a_folded_group_is_turned_against_the_first():
    names = [f"{index:04d}" for index in range(len(TRUTH))]
    half = len(names) // 2
    turn = np.asarray(se3_exponential(np.float32([0, 0, np.pi - 0.2, 0, 0, 0])), np.float64)[:, :3]
    folded = np.concatenate([TRUTH[:half], turn @ TRUTH[half:]])
    every, first, second = compare.rows(names, folded, TRUTH, [0, half])
    assert [row[0] for row in (first, second)] == ["0000 to 0029 (30)", "0030 to 0059 (30)"]
    assert float(every[1]) > 60 and first[1:] == ("0.00", "0.0", "0")
    assert second[1:] == ("0.00", "0.0", f"{180 - np.degrees(0.2):.0f}")
    assert len(compare.rows(names, folded, TRUTH, [0])) == 1
