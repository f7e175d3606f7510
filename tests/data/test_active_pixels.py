"""Which cells and pixels of a scene count before training; what was found is kept for the next start."""

import dataclasses

import numpy as np
import pytest
from jaxnerf.data.survey import valid_cells
from test_grid_schedule import BOX, a_space

from helpers import assert_same, compiled
from jaxnerf.data import active_pixels as active_pixels_module
from jaxnerf.data import survey, synthetic
from jaxnerf.data.active_pixels import find_active_pixels
from jaxnerf.fields import still_life


@pytest.fixture(scope="module")
def views():
    return synthetic.load_views(size=24)


def test_all_is_possible_without_masks(views):
    schedule = a_space()
    assert valid_cells(views, schedule, masks=False).all()
    opaque = dataclasses.replace(views, pixels=views.pixels[:, :3])
    valid = valid_cells(opaque, schedule, masks=True)
    assert valid.all() and valid.shape == schedule.shape == (8, 8, 6)


@pytest.mark.parametrize("resolution", [16, 37])
def test_possible_cells_hold_all_matter_of_the_embedded_scene(views, resolution):
    """Also where the hull is made of more cells than the box has."""
    schedule = a_space(resolution=resolution)
    valid = valid_cells(views, schedule, masks=True)
    assert valid.shape == schedule.shape and valid.mean() < 0.8
    lower, upper = (np.float32(bound) for bound in BOX)
    x = lower + np.random.default_rng(2).uniform(size=(1, 200_000, 3)).astype(np.float32) * (upper - lower)
    density, _ = compiled(still_life.still_life)(x, x)
    cells = np.floor((x[0] - lower) / (upper - lower) * schedule.shape).astype(int)
    seen = density[0] > 1.0  # thinner matter may leave no alpha
    assert seen.mean() > 0.02 and valid[tuple(cells[seen].T)].all()


@pytest.mark.parametrize("step", [0.05, 0.3])
def test_every_pixel_that_shows_something_is_live(views, step):
    schedule = a_space(resolution=32, step=step)
    valid, met, cells = survey.survey(views, schedule, masks=True)
    np.testing.assert_array_equal(cells, np.flatnonzero(valid))
    met = met.all_ids()
    assert met.dtype == cells.dtype == np.int32 and (np.diff(met) > 0).all()
    shown = np.flatnonzero(views.pixels[:, 3] > 0)
    assert np.isin(shown, met).all()
    assert met.size < 0.98 * len(views.pixels)
    # Their rays are not followed; all others are.
    np.testing.assert_array_equal(met, find_active_pixels(views, schedule, valid).all_ids())


def test_pixels_outside_their_mask_are_not_live(views):
    mask = np.arange(len(views.pixels)) % 3 == 0
    masked = dataclasses.replace(views, mask=mask)
    schedule = a_space()
    valid = np.ones(schedule.shape, bool)
    wanted = find_active_pixels(views, schedule, valid).all_ids()
    got = find_active_pixels(masked, schedule, valid, chunk=1000).all_ids()  # a chunk is no matter
    np.testing.assert_array_equal(got, wanted[mask[wanted]])
    fourth = np.where(np.arange(mask.size)[:, None] % 4 == 0, np.uint16(9), np.uint16(0)).repeat(4, axis=1)
    masked = dataclasses.replace(masked, pixels=fourth)
    got = find_active_pixels(masked, schedule, ~valid, masks=True).all_ids()
    np.testing.assert_array_equal(got, np.arange(0, mask.size, 12))


def test_of_very_many_pixels_tiles_are_asked_and_none_is_lost(views, monkeypatch):
    mask = np.random.default_rng(0).random(len(views.pixels)) < 0.9
    pixels = np.where(np.arange(len(mask))[:, None] == 7, 9, np.zeros_like(views.pixels))  # in a corner
    views = dataclasses.replace(views, pixels=pixels, mask=mask | (np.arange(len(mask)) == 7))
    schedule = a_space(resolution=32)
    valid = np.zeros(schedule.shape, bool)
    valid[13:19, 13:19, 9:14] = True
    wanted = find_active_pixels(views, schedule, valid, masks=True).all_ids()
    monkeypatch.setattr(active_pixels_module, "_EACH", 0)
    monkeypatch.setattr(active_pixels_module, "_TILES", len(mask) / 2.5**2)  # of 3 x 3 px
    got = find_active_pixels(views, schedule, valid, masks=True).all_ids()
    assert 7 in wanted and np.isin(wanted, got).all() and views.mask[got].all()
    assert wanted.size < got.size < 0.6 * mask.sum()


def test_a_box_that_no_ray_meets_is_named(views):
    with pytest.raises(ValueError, match=r"no ray of 60 views .*\(50, 50, 50\).* correct space.lower"):
        survey.survey(views, a_space(box=((50, 50, 50), (51, 51, 51))), masks=False)


def test_a_survey_is_kept_until_something_of_it_changes(views, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(survey, "_SLOW", 0.0)
    asked, whole = [], survey.find_active_pixels

    def asking(*args, **options):
        asked.append(options)
        return whole(*args, **options)

    monkeypatch.setattr(survey, "pixels_that_meet", asking)

    def look(views=views, masks=True, **options):
        return survey.survey(views, a_space(**options), masks=masks)

    first, again = look(), look()
    assert len(asked) == 1 and first[1].all_ids().size == again[1].size > 0
    for one, other in zip(first, again, strict=True):
        assert_same(one, other, rtol=0, atol=0)
    pixels = views.pixels.copy()
    pixels[0, 0] ^= 1  # a colour tells nothing, alpha does
    look(dataclasses.replace(views, pixels=pixels))
    assert len(asked) == 1
    pixels[0, 3] += 1
    others = (
        {"views": dataclasses.replace(views, pixels=pixels)},
        {"views": dataclasses.replace(views, near=views.near + np.float32(0.1))},
        {"views": dataclasses.replace(views, mask=np.arange(len(pixels)) % 3 > 0)},
        {"masks": False},
        {"resolution": 9},
        {"step": 0.2},
    )
    for count, other in enumerate(others, 2):
        look(**other)
        assert len(asked) == count, other
    for file in (tmp_path / "jaxnerf").iterdir():
        file.write_bytes(file.read_bytes()[:-9])
    assert_same(look()[1], first[1], rtol=0, atol=0)
    assert len(asked) == len(others) + 2
