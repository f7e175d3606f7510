"""Settings chosen by error, and a grid that is baked for a model trained without one."""

import shutil

import jax.numpy as jnp
import pytest

from jaxnerf import create_grid
from jaxnerf.data.ray_batches import random_rays
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.models import occupancy
from jaxnerf.tools.quality_search import search as quality_search
from runs import run_forked

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


@pytest.mark.slow
def test_the_fastest_candidate_within_the_budget_is_chosen(trained):
    def restore(settings=None):
        return restore_run(trained, settings=settings)

    options = {"num_rays": 256, "sample_multipliers": (1.0, 0.5), "early_stop_eps": (1e-3,)}
    best, candidates = quality_search.cheapest_settings(trained, restore, 0.5, **options)
    assert best in candidates and best.seconds == min(candidate.seconds for candidate in candidates)
    assert {candidate.settings["bake_occupancy"] for candidate in candidates} == {True, False}
    dense = [candidate.error for candidate in candidates if not candidate.settings["bake_occupancy"]]
    assert 0 < dense[0] < dense[1] < 0.5, "fewer samples, more error"


def test_the_search_ends_at_the_first_setting_beyond_the_budget():
    tried = []

    def is_within(multiplier, eps, bake):
        tried.append((multiplier, eps))
        return multiplier >= 0.5 and eps <= 0.01

    quality_search._search(is_within, (1.0, 0.5, 0.25, 0.1), (1e-3, 1e-2, 1e-1), False)
    assert tried == [(1.0, 1e-3), (0.5, 1e-3), (0.25, 1e-3), (0.5, 1e-2), (0.5, 1e-1)]


def test_a_budget_that_no_setting_meets_is_an_error():
    candidates = [quality_search.Candidate({"sample_multiplier": m}, 0.25 / m, 1.0) for m in (1.0, 0.5)]
    with pytest.raises(ValueError, match="no settings stay within 0.1; the closest, {.*: 1.0}, differ by 0.25"):
        quality_search._fastest(candidates, 0.1, "runs/a")


@pytest.mark.extra
def test_a_baked_grid_removes_nothing_visible(trained, monkeypatch):
    """The baked grid changes colours by less than five steps of 8 bits against the full grid of its box."""

    def colors():
        run = restore_run(trained, settings={"bake_occupancy": True, "sample_multiplier": 2.0, "early_stop_eps": 0.0})
        variables = run.variables(newest_step(run, trained))
        rays = random_rays(run.experiment.load_split("test"), 128, run.experiment.view_rays)
        return run.render(variables, rays).rgb, variables[1].occupied

    def full_grid(scene, rays, *, lower, upper, shape, contracted, **_):
        valid = jnp.ones(shape, bool)
        return create_grid(lower, upper, valid, initial_density=1.0, contracted=contracted)

    baked, occupied = colors()
    monkeypatch.setattr(occupancy, "visible_grid", full_grid)
    full, everywhere = colors()
    assert 0 < occupied.sum() < everywhere.sum()
    assert float(abs(baked - full).max()) < 0.02  # half a step is the aim


def test_a_negative_error_budget_is_a_wrong_flag():
    code, _, err = run_forked("eval", "--workdir=nowhere", "--error_budget=-1")
    assert code == 2 and "error_budget" in err


def test_an_existing_result_is_reported_before_the_search(trained, tmp_path, monkeypatch):
    folder = tmp_path / "copy"
    shutil.copytree(trained, folder, ignore=shutil.ignore_patterns("eval"))
    (folder / "eval" / str(restore_run(folder).steps()[-1])).mkdir(parents=True)
    monkeypatch.setattr(quality_search, "cheapest_settings", lambda *_, **__: pytest.fail("searched"))
    with pytest.raises(ValueError, match="exists already; give --overwrite"):
        quality_search.choose(folder, lambda: restore_run(folder), 0.5)
