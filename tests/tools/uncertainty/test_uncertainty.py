"""Predicted errors: calibration, sparsification, the deformation, and what is refused."""

import dataclasses
import math
import re
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import imageio.v3 as imageio
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnerf.core.occupancy.grid import create_grid, is_occupied
from jaxnerf.core.types import Batch, Rays
from jaxnerf.core.views import Views
from jaxnerf.evaluation.evaluate import score_run, train_and_evaluate
from jaxnerf.evaluation.restore import TrainedRun, restore_run
from jaxnerf.fields.base import Field
from jaxnerf.tools.uncertainty import calibration, cleaning, laplace, predict
from jaxnerf.tools.uncertainty.base import Estimate
from jaxnerf.tools.uncertainty.cleaning import cell_centers, cleaned
from jaxnerf.tools.uncertainty.laplace import deform, interpolate
from jaxnerf.tools.uncertainty.predict import make_predictor
from jaxnerf.tools.uncertainty.registration import ESTIMATORS
from runs import PACKED, evaluate, smoke_config

pytest_plugins = ["run_fixtures"]


def draws(seed, count=4000):
    """Returns scores, and errors whose spread is proportional to them."""
    rng = np.random.default_rng(seed)
    scores = rng.uniform(0.05, 0.5, count)
    return scores, np.abs(rng.normal(size=count)) * scores * 0.3


def calibrated(coverage=0.9):
    scores, errors = zip(*(draws(seed) for seed in range(6)), strict=True)
    return calibration.calibrate(scores, errors, [f"view_{index}" for index in range(6)], coverage)


@pytest.mark.parametrize("coverage", [0.5, 0.9, 0.99])
def test_intervals_hold_the_stated_fraction_of_new_errors(coverage):
    scores, errors = draws(99, 20_000)
    assert (errors <= calibrated(coverage).interval(scores)).mean() == pytest.approx(coverage, abs=0.015)


def test_predicted_errors_are_the_rms_error_and_keep_the_order_of_scores():
    scores = np.linspace(0.01, 1.0, 200)  # beyond those that were seen, too
    predicted = calibrated().predicted(scores)
    assert (np.diff(predicted) >= 0).all()
    np.testing.assert_allclose(predicted[20:], 0.3 * scores[20:], rtol=0.15)


def test_the_level_of_predicted_errors_is_that_of_all_views(monkeypatch):
    """Every second view has half the errors; intervals are those of the same map without its level."""
    scores, errors = zip(*(draws(seed) for seed in range(6)), strict=True)
    errors, names = [found / (1 + index % 2) for index, found in enumerate(errors)], list("abcdef")
    found = calibration.calibrate(scores, errors, names)
    squares = np.square(np.concatenate(errors)).mean()
    assert np.square(found.predicted(np.concatenate(scores)), dtype=float).mean() == pytest.approx(squares, rel=1e-3)
    monkeypatch.setattr(calibration, "_scaled", lambda known, predicted, errors: known)
    other = calibration.calibrate(scores, errors, names)
    assert other.factor < 0.9 * found.factor
    np.testing.assert_allclose(found.interval(scores[0]), other.interval(scores[0]), rtol=1e-5)


@pytest.mark.parametrize(
    "tied, fraction",
    [((0.01,), 0.8), ((0.01, 0.02, 0.05), 0.9), ((0.1, 0.2, 0.3), 1.0), (tuple(range(1, 31)), 1.0)],
    ids=str,
)
def test_pixels_of_equal_scores_get_their_own_rms_error(tied, fraction):
    """As culled pixels have, many: they were split by their index, and their map led on to the next score."""
    views, rng = [], np.random.default_rng(1)
    for seed in range(6):
        scores, errors = draws(seed)
        at = rng.random(scores.size) < fraction
        scores[at] = rng.choice(tied, at.sum())
        views.append((scores, np.where(at, 0.02 * scores, errors + 0.3) * np.linspace(0.1, 1.9, scores.size)))
    found = calibration.calibrate(*zip(*views, strict=True), list("abcdef"))
    scores, errors = map(np.concatenate, zip(*views, strict=True))
    for score in tied:
        expected = max(np.sqrt(np.square(errors[scores == score]).mean()), 1 / (255 * 12**0.5))
        assert found.predicted(score) == pytest.approx(expected, rel=0.1)


def test_scores_of_ties_that_are_out_of_order_get_one_value():
    scores, errors = np.repeat([1.0, 2.0, 2.1], 100), np.repeat([0.3, 0.1, 0.9], 100)
    found = calibration.calibrate([scores] * 2, [errors] * 2, ["a", "b"])
    np.testing.assert_allclose(found.predicted([1, 2, 2.1]), [0.05**0.5, 0.05**0.5, 0.9], rtol=1e-5)


def test_the_factor_has_the_finite_sample_correction():
    errors = [np.full(4, 0.1), np.array([0.1, 0.2, 0.3, 0.4])]
    found = calibration.calibrate([np.ones(4), np.ones(4)], errors, ["a", "b"], 0.8)
    # The 4th of 4, as ceil(5 * 0.8) = 4; the 80 % quantile is less.
    assert found.interval(1.0) == pytest.approx(0.4, rel=1e-5)
    with pytest.raises(ValueError, match="too few"):
        calibration.calibrate([np.ones(4), np.ones(4)], errors, ["a", "b"], 0.9)


@pytest.mark.parametrize(
    "scores, coverage", [([np.ones(9)], 0.9), ([np.ones(9)] * 2, 1.0), ([np.full(9, np.nan)] * 2, 0.5)]
)
def test_what_cannot_be_calibrated_is_refused(scores, coverage):
    with pytest.raises(ValueError):
        calibration.calibrate(scores, [np.ones(9)] * len(scores), ["a", "b"], coverage)


def test_a_stored_calibration_is_refused_for_another_checkpoint(tmp_path):
    path = tmp_path / "10" / "laplace.json"
    calibration.save(path, calibrated(), "this")
    assert calibration.load(path, "this") == calibrated()
    with pytest.raises(ValueError, match="other parameters"):
        calibration.load(path, "other")
    path.write_text('{"key": "this"}')
    with pytest.raises(ValueError, match="damaged"):
        calibration.load(path, "this")


@pytest.mark.parametrize(
    "wrong",
    [{"factor": value} for value in (-1.0, math.nan, math.inf, "2", True, None, [1.0], {})]
    + [{name: value} for name in ("scores", "errors") for value in ([], [1.0], "1", [-1.0], [math.nan], [["1"]], 3)]
    + [
        {"coverage": 1.5},
        {"coverage": "0.9"},
        {"num_pixels": "many"},
        {"num_pixels": -5},
        {"views": 3},
        {"views": [3]},
    ],
)
def test_a_calibration_of_other_values_is_damaged(tmp_path, wrong):
    path = tmp_path / "laplace.json"
    calibration.save(path, calibrated()._replace(**wrong), "this")
    with pytest.raises(ValueError, match="laplace.json: is damaged, expected numbers"):
        calibration.load(path, "this")


def test_ause_is_zero_for_true_errors_and_larger_the_less_the_score_says():
    error = np.random.default_rng(0).exponential(size=5000)
    noisy = error + np.random.default_rng(1).normal(size=5000)
    best, some, none = (
        calibration.sparsification(error, score)["ause_rmse"] for score in (error, noisy, np.zeros(5000))
    )
    assert best == pytest.approx(0, abs=1e-9)
    assert 0.05 < some < 0.8 * none


def test_the_order_of_scores_is_that_on_the_object_too():
    """A score that finds the object, and says nothing about it, has a small AUSE over the image only."""
    rng = np.random.default_rng(0)
    on_object = np.arange(60)[:, None] + np.zeros(60) < 20
    error = np.where(on_object, rng.exponential(size=(60, 60)), 0.001)
    kept = np.ones((60, 60), bool)
    found = calibration.score_order(error, on_object * 1.0, kept, on_object)
    alone = calibration.sparsification(error[on_object], np.zeros(on_object.sum()))
    assert found["ause_rmse"] < 0.4 * found["ause_rmse_object"]
    assert found["ause_rmse_object"] == pytest.approx(alone["ause_rmse"])
    assert set(calibration.score_order(error, error, kept, ~kept)) == {"ause_rmse", "ause_mae"}


def test_interpolation_is_exact_for_linear_functions_and_clipped():
    vertices = jnp.stack(jnp.meshgrid(*[jnp.arange(5.0)] * 3, indexing="ij"), axis=-1)
    x = jax.random.uniform(jax.random.key(0), (50, 3), maxval=4.0)
    np.testing.assert_allclose(interpolate(vertices, x), x, atol=1e-5)
    np.testing.assert_allclose(interpolate(vertices, jnp.array([[9.0, -1.0, 2.0]])), [[4, 0, 2]], atol=1e-6)
    assert jnp.isnan(interpolate(vertices, jnp.array([[jnp.nan, 1.0, 2.0]]))).all()


@pytest.mark.parametrize("contracted", [False, True])
def test_a_deformed_field_is_the_field_until_it_is_moved(contracted):
    field = Field(lambda key: jnp.ones(()), lambda params, x, viewdirs: (params * x[..., 0], x))
    moved = deform([-2.0] * 3, [2.0] * 3, contracted)(field)
    x = jnp.array([[[0.3, -0.2, 0.1], [0.7, 0.6, -0.5]]])
    still = jnp.zeros((5, 5, 5, 3))
    np.testing.assert_array_equal(moved.apply((1.0, still), x, x)[1], x)
    # Vertices are one world unit apart in the inner half, so that a displacement of 0.1 cells is 0.1.
    np.testing.assert_allclose(moved.apply((1.0, still + 0.1), x, x)[1], x + 0.1, rtol=1e-5)
    change = jax.jvp(lambda d: moved.apply((1.0, d), x, x)[0], (still,), (still + 1,))[1]
    np.testing.assert_allclose(change, 1, rtol=1e-5)


@pytest.mark.parametrize("damage", [lambda data: data[:100], lambda data: data[:70] + b"?" + data[71:], lambda _: b""])
def test_a_damaged_posterior_is_computed_again(tmp_path, monkeypatch, damage):
    monkeypatch.setattr(laplace, "RESOLUTION", 1)
    path, lines = tmp_path / "laplace.npz", []
    np.savez(path, key="a", std=np.ones((2, 2, 2, 3), np.float32), noise=np.float32(1))
    assert laplace._stored(path, "a", lines.append) is not None and laplace._stored(path, "b", lines.append) is None
    path.write_bytes(damage(path.read_bytes()))
    assert laplace._stored(path, "a", lines.append) is None
    assert lines == [f"{path}: is damaged, and computed again"]


_STD = np.ones((2, 2, 2, 3), np.float32)


@pytest.mark.parametrize(
    "arrays",
    [{"std": std} for std in (_STD[..., :2], _STD[0], np.ones((3, 3, 3, 3)), -_STD, 2 * _STD, np.nan * _STD)]
    + [{"std": std} for std in (_STD.astype(int), _STD.astype(str), np.float32(1), _STD.astype(complex))]
    + [{"noise": noise} for noise in (np.float32(-1), np.float32(0), np.nan, np.inf, "1", np.ones(1), np.ones(9))],
)
def test_a_posterior_of_other_arrays_is_computed_again(tmp_path, monkeypatch, arrays):
    monkeypatch.setattr(laplace, "RESOLUTION", 1)
    path, lines = tmp_path / "laplace.npz", []
    np.savez(path, **{"key": "a", "std": _STD, "noise": np.float32(1), **arrays})
    assert laplace._stored(path, "a", lines.append) is None
    assert lines == [f"{path}: is damaged, and computed again"]


def test_the_uncertainty_at_a_position_is_the_standard_deviation_there():
    std = np.ones((5, 5, 5, 3))
    std[1:] = 0.5, 0.1, 0.1
    at = laplace.std_at(laplace.Deformation(jnp.asarray(std), jnp.ones(())), [-2.0] * 3, [2.0] * 3, True)
    inside = np.sqrt(0.27 / 3)
    np.testing.assert_allclose(at(jnp.array([[0.0, 0.5, 0.0], [1e9, 0.0, 0.0]])), inside, rtol=1e-5)
    np.testing.assert_allclose(at(jnp.array([-1e9, 0.0, 0.0])), 1, rtol=1e-5)


def stub_run(grid, hold_out=0):
    """Returns a TrainedRun that has nothing but a checkpoint of step 5, with a grid."""
    data = SimpleNamespace(hold_out=hold_out, pixel_offset=0.5, ndc=False)
    config = SimpleNamespace(data=data)
    views = Views(**dict.fromkeys(field.name for field in dataclasses.fields(Views)))
    model = SimpleNamespace(needs=())
    experiment = SimpleNamespace(config=config, cameras=None, load_split=lambda split, **options: views, model=model)
    fields = dict.fromkeys(TrainedRun._fields) | {"experiment": experiment, "identity": "fixed", "settings": {}}
    return TrainedRun(**fields | {"steps": lambda: [5], "variables": lambda step: (np.ones(3), grid)})


@pytest.mark.parametrize("contracted", [False, True])
def test_cells_that_are_more_uncertain_than_the_limit_are_empty(tmp_path, monkeypatch, capsys, contracted):
    grid = create_grid([-1.0] * 3, [3.0] * 3, np.ones((8, 4, 4), bool), initial_density=1.0, contracted=contracted)
    estimate = Estimate(None, "fixed", lambda x: jnp.where(x[..., 0] > 2, 0.7, 0.3))
    monkeypatch.setitem(ESTIMATORS._parts, "laplace", lambda source: estimate)
    _, found = cleaned(stub_run(grid), tmp_path, 0.5).variables(5)
    # The box is [-1, 3]; where it is contracted its inner half is [0, 2], and its outer quarters hold the rest.
    kept = 6
    assert np.asarray(found.occupied).all(axis=(1, 2)).tolist() == [True] * kept + [False] * (8 - kept)
    np.testing.assert_array_equal(found.valid, found.occupied)
    np.testing.assert_array_equal(np.asarray(found.density_mean) < 0, ~np.asarray(found.occupied))
    assert "25.0 % of the occupied cells" in capsys.readouterr().err
    centers = cell_centers(grid).reshape(-1, 3)
    ends = jnp.zeros(len(centers))
    ray = Rays(origins=centers, directions=jnp.ones_like(centers), viewdirs=centers, near=ends, far=ends)
    np.testing.assert_array_equal(is_occupied(found, ray, jnp.zeros((128, 1)))[:, 0], found.occupied.reshape(-1))


def test_auto_removes_as_many_cells_as_training_rays_allow(tmp_path, monkeypatch, capsys):
    """The error of all rays grows by a tenth with the fraction of cells below x = 2 that are gone."""
    grid = create_grid([-1.0] * 3, [3.0] * 3, np.ones((8, 4, 4), bool), initial_density=1.0)
    estimate = Estimate(None, "fixed", lambda x: jnp.where(x[..., 0] > 2, 0.96, jnp.where(x[..., 0] > 1, 0.72, 0.3)))
    monkeypatch.setitem(ESTIMATORS._parts, "laplace", lambda source: estimate)
    batch = Batch(rays=None, rgb=jnp.full((4, 3), 0.5))
    monkeypatch.setattr(cleaning, "draw_batch", lambda *_, **__: (None, batch))

    def render_image(variables, rays):
        missing = 1 - np.asarray(variables[1].occupied)[:6].mean()
        return SimpleNamespace(rgb=batch.rgb + 0.1 * (1 + 0.1 * missing))

    run = stub_run(grid)._replace(render_image=render_image)
    _, found = cleaned(run, tmp_path, "auto").variables(5)
    assert np.asarray(found.occupied).all(axis=(1, 2)).tolist() == [True] * 6 + [False] * 2
    assert "25.0 % of the occupied cells are more uncertain than 0.75" in capsys.readouterr().err
    everywhere = Estimate(None, "fixed", lambda x: jnp.full(x.shape[:-1], 1.0 + 1e-6))
    monkeypatch.setitem(ESTIMATORS._parts, "laplace", lambda source: everywhere)
    assert cleaned(run, tmp_path, "auto").variables(5)[1] is grid and "no cell is removed" in capsys.readouterr().err


def test_cleaning_is_off_by_default_and_needs_a_grid(tmp_path):
    run = stub_run(None)
    assert cleaned(run, tmp_path, 1.0) is run and cleaned(run, tmp_path, None) is run
    for limit in (0.0, 1.5):
        with pytest.raises(ValueError, match=f"max_uncertainty is {limit}, expected more than 0 and at most 1"):
            cleaned(run, tmp_path, limit)
    with pytest.raises(ValueError, match="without an occupancy grid"):
        cleaned(run, tmp_path, 0.5).variables(5)


def test_one_of_several_processes_calibrates(tmp_path, monkeypatch):
    """The others wait for it; threads stand for processes, as a lock belongs to what opened the file."""
    calls, said = [], []

    def calibrate(*args):
        calls.append(args)
        time.sleep(0.3)
        return calibrated()

    monkeypatch.setattr(predict, "_calibrate", calibrate)
    monkeypatch.setitem(ESTIMATORS._parts, "fixed", lambda source: Estimate(lambda rays: rays.near, "fixed"))
    run = stub_run(None, hold_out=8)
    with ThreadPoolExecutor(3) as pool:
        made = [pool.submit(make_predictor, run, tmp_path, "fixed", say=said.append) for _ in range(3)]
        assert len({each.result().identity for each in made}) == 1
    assert len(calls) == 1 and sum("waits for another process" in line for line in said) == 2
    make_predictor(run, tmp_path, "fixed", coverage=0.8, say=said.append)
    assert len(calls) == 2 and "calibrated for a coverage of 0.9, and is calibrated again" in said[-2]
    make_predictor(run._replace(settings={"max_uncertainty": 0.25}), tmp_path, "fixed", say=said.append)
    assert len(calls) == 3
    assert {path.name for path in tmp_path.rglob("*.json")} == {"fixed.json", "fixed-max_uncertainty-0.25.json"}


@pytest.mark.slow
@pytest.mark.parametrize("members, message", [((), "--members"), ("same", "another seed")])
def test_an_ensemble_needs_other_runs(unoptimized, trained, members, message):
    with pytest.raises(ValueError, match=message):
        make_predictor(restore_run(trained), trained, "ensemble", members=[str(trained)] if members else ())


@pytest.mark.slow
def test_an_evaluation_writes_and_scores_predicted_errors(unoptimized, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(laplace, "NUM_BATCHES", 4)
    monkeypatch.setattr(laplace, "NUM_PROBES", 2)
    monkeypatch.setattr(laplace, "RESOLUTION", 12)
    config = smoke_config()
    config.update_from_flattened_dict(PACKED)
    config.data.hold_out = 10
    config.eval.at_end = False
    assert train_and_evaluate(config, tmp_path)

    def predictor(run):
        return make_predictor(run, tmp_path, "laplace", coverage=0.8)

    assert evaluate(tmp_path, predictor=predictor, shard=(0, 2)) is None
    (damaged,) = (tmp_path / "eval").glob("*/uncertainty/000.tiff")
    damaged.write_bytes(b"damaged")
    results = evaluate(tmp_path, predictor=predictor)
    assert f"{damaged}: is damaged" in capsys.readouterr().err
    found = results["uncertainty"]
    assert found["estimator"] == "laplace" and found["target_coverage"] == 0.8
    assert found["coverage"] == pytest.approx(0.8, abs=0.1) and found["interval"] > 0
    (folder,) = (tmp_path / "eval").glob("*/uncertainty")
    errors = [imageio.imread(path) for path in sorted(folder.glob("*.tiff"))]
    assert len(errors) == len(results["images"])
    assert all(np.isfinite(error).all() and error.min() > 0 and np.ptp(error) > 0 for error in errors)

    with np.load(tmp_path / "uncertainty" / "20" / "laplace.npz") as stored:
        limit = float(np.median(np.sqrt((stored["std"] ** 2).mean(axis=-1))))
    clean = score_run(cleaned(restore_run(tmp_path), tmp_path, limit), tmp_path, overwrite=True)
    assert clean["settings"]["max_uncertainty"] == limit and clean["psnr"] != results["psnr"]
    said = re.findall(r"cleaning +([\d.]+) % of the occupied cells", capsys.readouterr().err)
    assert len(said) == 1 and 10 < float(said[0]) < 90


def test_the_line_of_predicted_errors_names_what_results_hold():
    assert predict.line({"psnr": 30.0}) is None
    found = {"ause_rmse": 0.25, "ause_mae": 0.125, "target_coverage": 0.9, "coverage": 0.875}
    expected = "predicted errors: AUSE 0.250 (RMSE), 0.125 (MAE), 87.5 % of errors within intervals for 90 %"
    assert predict.line({"uncertainty": found}) == expected
    on_object = {"ause_rmse_object": 0.5, "ause_mae_object": 0.75}
    assert "on the object 0.500, 0.750" in predict.line({"uncertainty": found | on_object})
