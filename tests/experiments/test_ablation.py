"""Each variant of the ablation lacks the named part and nothing else, and finished runs are not repeated."""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnerf import Rays
from jaxnerf.data.dataset import DataOptions, load_split
from jaxnerf.options import replaced
from jaxnerf.training.build import build_model
from runs import smoke_config
from studies import common, study

ablation, reproducibility = study("ablation/ablation"), study("stability/reproducibility")
COMPLETE, variants = ablation.COMPLETE, ablation.variants
BASE = ablation.configuration()
VARIANTS = variants(BASE, 100)
RAYS = Rays(
    origins=jnp.zeros((2, 3)),
    directions=jnp.ones((2, 3)),
    viewdirs=jnp.ones((2, 3)) / 3**0.5,
    near=jnp.ones(2),
    far=jnp.full(2, 2.0),
)


@functools.cache
def params(name):
    """Returns {"network/layer": shape of its kernel}."""
    config = ablation.configuration(VARIANTS[name])
    tree = jax.eval_shape(build_model(config).init, jax.random.key(0))
    return {
        f"{network}/{layer}": leaves["kernel"].shape
        for network, layers in tree.items()
        for layer, leaves in layers.items()
    }


@functools.cache
def traced(name, **fields):
    """Returns the jaxpr of a rendering in training; fields are further ones of the section `sampling`."""
    more = {f"sampling.{field}": value for field, value in fields.items()}
    model = build_model(ablation.configuration(VARIANTS[name] | more))
    params = jax.eval_shape(model.init, jax.random.key(0))
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), 2))
    return str(jax.make_jaxpr(model.render)(keys, params, None, RAYS, 0))


def test_every_variant_changes_existing_fields_to_other_values():
    assert list(VARIANTS)[0] == COMPLETE and VARIANTS[COMPLETE] == {}
    flat = BASE.to_dict()
    for name, changes in VARIANTS.items():
        for field, value in changes.items():
            section, key = field.split(".")
            assert flat[section][key] != value, (name, field)
    assert len({json.dumps(changes, sort_keys=True) for changes in VARIANTS.values()}) == len(VARIANTS)


def test_without_encoding_the_networks_take_three_numbers():
    whole, plain = params(COMPLETE), params("no positional encoding")
    assert {name for name in whole if whole[name] != plain[name]} == {
        f"{network}/{layer}" for network in ("coarse", "fine") for layer in ("trunk_0", "trunk_3", "view")
    }
    width = BASE.fine.width
    assert plain["fine/trunk_0"][0] == 3 and plain["fine/trunk_3"][0] == plain["fine/view"][0] == 3 + width
    assert "scan[" in traced(COMPLETE) and "scan[" not in traced("no positional encoding")  # over octaves


def test_without_view_dependence_its_layers_are_absent():
    gone = set(params(COMPLETE)) - set(params("no view dependence"))
    assert gone == {f"{network}/{layer}" for network in ("coarse", "fine") for layer in ("bottleneck", "view")}


def test_without_hierarchy_one_network_is_evaluated_as_often_as_both():
    sampling = BASE.sampling
    both = 2 * sampling.num_coarse + sampling.num_fine
    assert VARIANTS["no hierarchy"]["sampling.num_coarse"] == both
    assert all(name.startswith("fine/") for name in params("no hierarchy"))
    evaluations = {2 * sampling.num_coarse: COMPLETE, 2 * both - 2 * sampling.num_coarse: COMPLETE}
    evaluations[2 * both] = "no hierarchy"
    for count, name in evaluations.items():
        found = [which for which in (COMPLETE, "no hierarchy") if f"f32[3,{count}]" in traced(which)]
        assert found == [name]  # the planes of x, y and z of two rays


def test_without_stratification_no_random_numbers_are_drawn_along_rays():
    assert "random_bits" in traced(COMPLETE) and "random_bits" not in traced("no stratification")
    assert params("no stratification") == params(COMPLETE)
    assert "random_bits" in traced("no stratification", density_noise=1.0)


def test_fewer_views_are_evenly_spread_and_other_splits_stay():
    every, data = load_split(DataOptions(size=24), "train"), DataOptions(size=24, num_views=15)
    some = load_split(data, "train")
    assert some.names == every.names[::4] and len(load_split(data, "test").names) == 8
    data = replaced(data, hold_out=6)  # comes first
    held = load_split(data, "held_out")
    assert len(held.names) == 10 and not set(held.names) & set(load_split(data, "train").names)
    for wrong in (-1, 51):
        data = replaced(data, num_views=wrong)
        with pytest.raises(ValueError, match=f"data.num_views is {wrong} of 50 views"):
            load_split(data, "train")


def test_a_finished_run_is_not_repeated_and_not_taken_for_another(tmp_path, monkeypatch):
    from jaxnerf.evaluation import evaluate, restore

    trained = []

    def train(config, folder, views):
        trained.append(views.names[0])
        return len(trained) > 1

    monkeypatch.setattr(evaluate, "train_and_evaluate", train)
    monkeypatch.setattr(restore, "restore_run", lambda folder: None)
    monkeypatch.setattr(evaluate, "score_run", lambda *given, views, **options: {"psnr": 20.0, "of": views.names[0]})
    monkeypatch.setattr(jax, "clear_caches", lambda: None)
    config = smoke_config()
    assert common.run(config, tmp_path) is None  # stopped
    done = {"psnr": 20.0, "of": "test_000"}
    assert [common.run(config, tmp_path) for _ in range(2)] == [done, done]
    assert trained == ["train_000"] * 2
    config.data.dir = "elsewhere"  # the place of a dataset does not change a run
    assert common.finished(config, tmp_path) == done
    config.train.lr_init = 1.0
    with pytest.raises(ValueError, match="finished run with config.train.lr_init 0.0005, expected 1.0"):
        common.run(config, tmp_path)


def test_the_table_pairs_seeds_and_reports_what_they_agree_on():
    def run(psnr):
        return {"psnr": psnr, "ssim": 0.5, "parameters": 1234, "views": 8}

    runs = {
        COMPLETE: {"0": run(20.0), "1": run(21.0), "10": run(22.0)},
        "no hierarchy": {"1": run(20.5), "0": run(19.0)},
        "5 octaves": {"0": run(20.5), "1": run(20.9)},
        "15 octaves": {"2": run(30.0)},
    }
    cost = {COMPLETE: {"flops": 2e6, "time": 1.0, "ms": 3.0}}
    lines = ablation.report({"steps": 1000, "cost": cost, "scenes": {"lego": {"views": 100, "runs": runs}}})
    assert "1,000 steps" in lines[0] and "seeds 0, 1, 2, 10" in lines[0]
    assert "| complete | 21.00 +- 1.00 | - |  | 0.500 +- 0.000 | 1,234 | 2,000 | 1.00 |" in lines
    assert "| no hierarchy | 19.75 +- 1.06 | -1.00, -0.50 | worse | 0.500 +- 0.000 | 1,234 | - | - |" in lines
    assert "| +0.50, -0.10 | undecided |" in lines[6]
    assert "| 30.00 | - | - | 0.500 |" in lines[7]
    assert lines[-1].endswith("Here worse: no hierarchy; undecided: 5 octaves.")
    verdicts = {(-1.0,): "worse (one seed)", (0.1, 0.2): "better", (0.0, 0.0): "undecided", (): "-"}
    assert {differences: ablation.verdict(differences) for differences in verdicts} == verdicts


@pytest.mark.parametrize(
    "moved, four, same, where",
    [
        (0, 20.2, "all 200 parameters are equal, bit for bit", "within"),
        (3, 25.0, "3 of 200 parameters differ, by up to 2.0e", "OUTSIDE"),
    ],
)
def test_the_lines_on_reproducibility_report_the_differences(moved, four, same, where):
    one, other = np.zeros(200, np.float32), np.zeros(200, np.float32)
    other[:moved] = 2.0
    again = reproducibility.difference(one, other)
    drift = reproducibility.difference(one, np.linspace(0, 1, 200, dtype=np.float32))
    smaller = reproducibility.difference(one, np.full(200, 3e-4, np.float32))
    lines = reproducibility.report(
        {0: 20.0, 1: 21.0}, again=again, four=four, drift=drift, paper_drift=smaller, steps=600
    )
    text = "\n".join(lines)
    assert same in text and f"{where} the seeds' spread of 1.00 dB" in text
    assert "20.50 +- 0.71 dB (20.00, 21.00)" in text
    assert "more than 5.0e-01, one in a hundred by more than 9.9e-01, the worst by 1.0e+00; at the" in text
    assert text.endswith("the worst by 3.0e-04.")
