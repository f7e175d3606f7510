"""Runs of pixels are the same list as their ids one by one."""

import jax
import numpy as np
import pytest

from jaxnerf.data import pixel_runs


@pytest.mark.parametrize("share", [0.02, 0.5, 1.0])
def test_places_and_counts_are_those_of_the_ids(share):
    chosen = np.random.default_rng(1).random(500) < share
    ids = np.flatnonzero(chosen)
    parts = [pixel_runs.runs_of(chosen[start : start + 125], start) for start in range(0, 500, 125)]
    found = pixel_runs.join(parts)
    assert found.size == ids.size and found.first.dtype == found.before.dtype == np.int32
    np.testing.assert_array_equal(found.all_ids(), ids)
    got = jax.jit(lambda found, places: found.ids(places))(found, np.arange(ids.size))
    np.testing.assert_array_equal(got, ids)
    bounds = np.arange(501)
    counts = jax.jit(lambda found, bounds: found.count_below(bounds))(found, bounds)
    np.testing.assert_array_equal(counts, np.searchsorted(ids, bounds))


def test_a_list_of_nothing_has_no_size():
    found = pixel_runs.join([pixel_runs.runs_of(np.zeros(4, bool))])
    assert found.size == 0 and found.all_ids().size == 0
