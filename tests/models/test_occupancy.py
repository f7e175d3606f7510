"""The occupancy sampler's steps fit all samples of a batch into the buffer."""

import numpy as np
import pytest

from jaxnerf.models.occupancy import fit_steps


@pytest.mark.parametrize("seed", range(4))
def test_the_rays_with_most_samples_take_longer_steps(seed):
    count = np.random.default_rng(seed).integers(0, 90, size=200).astype(np.int32)
    stretch = np.asarray(fit_steps(count, 4000.0, 4.0))
    kept = count / stretch
    np.testing.assert_allclose(kept.sum(), 4000, rtol=1e-4)
    most = kept.max()
    np.testing.assert_allclose(kept, np.minimum(count, most), rtol=1e-5)
    assert most > 4 and (stretch == 1).any()


def test_steps_keep_their_length_where_all_samples_fit():
    assert (np.asarray(fit_steps(np.int32([3, 90, 0]), 93.0, 1.0)) == 1).all()


def test_a_ray_keeps_its_least_number_of_samples():
    stretch = np.asarray(fit_steps(np.int32([64, 64, 8, 0]), 20.0, 16.0))
    np.testing.assert_allclose(stretch, [4, 4, 1, 1])
