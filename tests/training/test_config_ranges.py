"""The ranges of numbers of a config."""

import math
import re

import pytest
from ml_collections import ConfigDict

from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.options import is_auto, replaced
from jaxnerf.runtime import devices
from jaxnerf.training import build
from jaxnerf.training.auto_config import resolve_for_device
from jaxnerf.training.config import RunConfig, declared, read_config
from jaxnerf.training.options import UNLIMITED_STEPS
from runs import PACKED, ROOT, smoke_config


@pytest.mark.parametrize(
    "field, value, expected",
    [
        ("train.max_steps", -5, "expected at least 1"),
        ("train.max_seconds", -1.0, "expected at least 0"),
        ("train.max_seconds", math.nan, r"expected a finite number of at most 3.4e\+38"),
        ("data.factor", -2, "expected from 1 to 4,096"),
        ("data.size", 4096, "expected from 1 to 1,024"),
        ("data.pixel_offset", 1e30, "expected from -1 to 1"),
        ("eval.sample_multiplier", 1e30, "expected more than 0 and at most 64"),
        ("eval.sample_multiplier", -1.0, "expected more than 0 and at most 64"),
        ("eval.chunk", 2**31 - 1, "expected from 1 to 16,777,216"),
        ("eval.max_samples", 2**31 - 1, "expected from 1 to 268,435,456"),
        ("sampling.num_coarse", 10**9, "expected from 1 to 16,384"),
        ("sampling.num_fine", 10**9, "expected from 0 to 16,384"),
        ("train.lr_init", 0.0, "expected more than 0"),
        ("train.beta2", 1.0, "expected at least 0 and below 1"),
        ("fine.width", 0, "expected at least 1"),
        ("fine.depth", 0, "expected from 1 to 64"),
        ("coarse.depth", 1_000_000, "expected from 1 to 64"),
    ],
)
def test_a_number_outside_its_range_makes_no_workdir(tmp_path, field, value, expected):
    config = smoke_config()
    config.update_from_flattened_dict({field: value})
    with pytest.raises(ValueError, match=rf"--config.{field} is {re.escape(str(value))}, {expected}; correct it"):
        train_and_evaluate(config, tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("field", ["max_steps", "lr_steps"])
def test_a_run_that_its_time_ends_cannot_become_one_without_a_limit(field):
    read_config(smoke_config(max_seconds=60.0, **{field: UNLIMITED_STEPS}))
    with pytest.raises(ValueError, match=rf"--config.train.{field} is 10,000,000, .* and that is 0; set a time"):
        read_config(smoke_config(max_seconds=0.0, **{field: UNLIMITED_STEPS}))


@pytest.mark.parametrize(
    "field, value, expected",
    [
        ("fine.width", 100_000_000, "needs .* GB .* are free; reduce it"),
        ("fine.compute_dtype", "float33", "expected one of"),
        ("fine.compute_dtype", "float64", "JAX_ENABLE_X64=1"),
        ("coarse.density_activation", 3, "expected str"),
        ("fine.num_freqs", 65, "expected from 0 to 64"),
        ("fine.depth", "8", "expected int"),
        ("fine.depth", 2.5, "expected int"),
        ("fine.use_viewdirs", "yes", "expected bool"),
        ("fine.surprise", 1, "is no field"),
        ("sampling.rule", "simpson", "expected one of"),
        ("sampling.stratified", None, "expected bool"),
        ("train.batch_size", 0, "expected at least 1"),
        ("train.cpu_batch_size", True, "expected int"),
        ("train.lr_init", math.inf, "expected a finite number"),
        ("train.lr_init", [1], "expected float"),
        ("hash_grid.resolutions", (), "expected 1 to 64 whole numbers"),
        ("hash_grid.resolutions", (16, "a"), "expected 1 to 64 whole numbers"),
        ("hash_grid.view_depth", 1000, "expected from 0 to 64"),
        ("scene.lower", (0.0, 1.0), "expected 3 finite numbers"),
        ("scene.upper", (0.0, 1.0, math.nan), "expected a finite number"),
        ("scene.upper", (0.0, 1.0, "a"), "expected 3 finite numbers"),
        ("losses.mse", "much", "expected schedule"),
        ("seed", "first", "expected int"),
        ("train.lr_final", 10**400, "expected a finite number"),
        ("train.batch_size", 2**31, r"expected a finite number of at most 2.14748e\+09"),
        ("train.warmup_steps", 2**40, "expected a finite number"),
        ("seed", 2**64, "expected a finite number"),
        ("coarse.density_bias", 1e39, "expected a finite number"),
        ("losses.mse", [[0, 1.0], [5, math.nan]], "expected a finite number"),
        ("losses.mse", 2 * [[10**400, 1]], "expected a finite number"),
        ("coarse.compute_dtype", "auto", "expected one of"),
        ("data.ndc", 10**6 * "a", "expected auto or bool"),
        ("train.log_every", None, "is missing"),
        ("train.save_every", None, "is missing"),
        ("train.max_reinits", None, "is missing"),
        ("train", 3, "expected a section"),
        ("train", None, "is missing"),
        ("eval.chunk", None, "is missing"),
    ],
)
def test_an_edited_config_is_rejected_with_its_field(field, value, expected):
    """config.json holds no types, and anyone may edit it. A value of None here: the field or section is removed."""
    content = smoke_config().to_dict()
    *section, name = field.split(".")
    place = content[section[0]] if section else content
    if value is None and expected == "is missing":
        del place[name]
    else:
        place[name] = value
    with pytest.raises(ValueError, match=rf"--config.{field} (is .*)?{expected}") as error:
        resolve_for_device(ConfigDict(content, type_safe=False))
    assert len(str(error.value)) < 400


@pytest.mark.parametrize(
    "field, other", [("train.batch_size", {"train.microbatch_size": "auto"}), ("train.lr_steps", {})]
)
def test_a_value_that_was_never_resolved_is_an_error(field, other):
    config = smoke_config()
    config.update_from_flattened_dict({field: "auto", **other})
    with pytest.raises(ValueError, match=f"{field} is 'auto'; resolve the config"):
        build.build(resolve_for_device(config)[0])


def test_a_pool_of_less_than_a_sample_per_ray_has_a_microbatch():
    assert devices.default_microbatch(64, 0.5, "cpu") == 64


@pytest.mark.parametrize(
    "field, value, expected",
    [
        ("occupancy.step_size", 1e-30, "at least 4.*e-05: the longest side"),
        ("occupancy.pool_samples_per_ray", 1e-9, "from 0.01 to 100,000"),
        ("occupancy.pool_samples_per_ray", 1e12, "from 0.01 to 100,000"),
    ],
)
def test_the_samples_of_ray_marching_are_limited(field, value, expected):
    config = smoke_config()
    config.update_from_flattened_dict(PACKED | {"scene.lower": (-1.5,) * 3, "scene.upper": (1.5,) * 3})
    config.update_from_flattened_dict({field: value})
    with pytest.raises(ValueError, match=f"--config.{field} is {value}, expected {expected}".replace("+", r"\+")):
        read_config(config)


@pytest.mark.parametrize(
    "field, value",
    [
        ("hash_grid.table_size", 10**9),
        ("hash_grid.width", 10**9),
        ("hash_grid.view_width", 10**7),
        ("occupancy.resolution", 10**6),
        ("train.batch_size", 10**9),
    ],
)
def test_what_does_not_fit_into_memory_is_rejected(field, value):
    config = smoke_config()
    config.update_from_flattened_dict(PACKED | {"hash_grid.resolutions": (2**20,), field: value})
    with pytest.raises(ValueError, match=rf"--config.{field} is .*, which needs .* GB"):
        read_config(config)


def test_defaults_are_of_their_types_and_in_their_ranges():
    names = [name for name, _, _, _ in declared(RunConfig())]
    assert len(set(names)) == len(names) > 100
    found = read_config(RunConfig().to_dict())
    assert found == replaced(RunConfig(), parts=found.parts) and found.parts.items() <= RunConfig().parts.items()
    for name, option, kind, value in declared(RunConfig()):
        assert option.help and not (option.range and kind not in (int, float)), name
        assert option.auto or not is_auto(value), name


@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "jaxnerf" / "configs").glob("[!_]*.py")))
def test_the_configs_are_in_their_ranges(name):
    module = __import__(f"jaxnerf.configs.{name}", fromlist=["get_config"])
    read_config(module.get_config())
