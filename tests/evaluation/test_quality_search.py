"""Rendering settings picked by error, and empty space found in a network trained along whole rays."""

import shutil

import jax.numpy as jnp
import pytest

from jaxnerf.data.ray_batches import random_rays
from jaxnerf.evaluation import quality_search
from jaxnerf.evaluation import restore as restore_module
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.models import occupancy
from runs import run

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")


@pytest.fixture(scope="module")
def picked(trained):
    """(choice, tried) of a budget that all meet; few settings, as each is compiled."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quality_search, "_SAMPLES", (1.0, 0.5))
        patch.setattr(quality_search, "_STOPS", (1e-3,))
        return quality_search.cheapest_settings(trained, 0.5, num_rays=256)


def test_the_cheapest_within_the_budget_is_picked(picked):
    choice, tried = picked
    assert choice in tried and choice.seconds == min(other.seconds for other in tried)
    assert {other.settings["bake_occupancy"] for other in tried} == {True, False}
    dense = [other.error for other in tried if not other.settings["bake_occupancy"]]
    assert 0 < dense[0] < dense[1] < 0.5, "fewer samples, more error"


def test_a_budget_that_nothing_meets_is_said(trained, monkeypatch):
    far_off = [quality_search.Choice({"sample_multiplier": 1.0}, 0.25, 1.0)]
    monkeypatch.setattr(quality_search, "_descend", lambda attempt, tried, *_, **__: tried.extend(far_off))
    with pytest.raises(ValueError, match="no settings stay within 0.1; the nearest, .* differ by 0.25"):
        quality_search.cheapest_settings(trained, 0.1, num_rays=64)


def test_what_is_skipped_afterwards_is_not_seen(trained, monkeypatch):
    """The extracted grid leaves the picture as asking everywhere in its box makes it."""

    def colours():
        run = restore_run(trained, settings={"bake_occupancy": True, "sample_multiplier": 2.0, "early_stop_eps": 0.0})
        weights = run.weights(newest_step(run, trained))
        rays = random_rays(run.experiment.load_views("test"), 128, run.experiment.view_rays)
        return run.render(weights, rays).rgb, weights[1].occupied

    skipped, occupied = colours()
    monkeypatch.setattr(
        occupancy,
        "visible_grid",
        lambda scene, schedule, rays, **_: schedule.create(jnp.ones(schedule.shape, bool)),
    )
    whole, everywhere = colours()
    assert 0 < occupied.sum() < everywhere.sum()
    assert float(abs(skipped - whole).max()) < 0.02  # five steps of 8 bits; half a step was asked for


def test_the_program_knows_the_flag():
    code, _, err = run("eval", "--workdir=nowhere", "--error_budget=-1")
    assert code == 2 and "error_budget" in err


def test_a_result_that_is_there_is_noticed_before_the_search(trained, tmp_path, monkeypatch):
    folder = tmp_path / "copy"
    shutil.copytree(trained, folder, ignore=shutil.ignore_patterns("eval"))
    steps = restore_module.restore_run(folder).steps()
    (folder / "eval" / str(steps[-1])).mkdir(parents=True)
    monkeypatch.setattr(quality_search, "cheapest_settings", lambda *_, **__: pytest.fail("searched"))
    with pytest.raises(ValueError, match="is there already; give --overwrite"):
        quality_search.choose(folder, 0.5)
