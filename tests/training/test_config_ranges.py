"""The ranges of numbers of a config."""

import math

import pytest

from jaxnerf.configs import default
from jaxnerf.evaluation.evaluate import train_and_evaluate
from jaxnerf.runtime.config_fields import is_auto
from jaxnerf.training import config_ranges
from runs import ROOT, smoke_config


@pytest.mark.parametrize(
    "field, value, expected",
    [
        ("train.max_steps", -5, "expected at least 1"),
        ("train.max_seconds", -1.0, "expected at least 0"),
        ("train.max_seconds", math.nan, "expected at least 0"),
        ("data.factor", -2, "expected at least 1"),
        ("train.lr_init", 0.0, "expected more than 0"),
        ("train.beta2", 1.0, "expected at least 0 and below 1"),
    ],
)
def test_a_number_outside_its_range_makes_no_workdir(tmp_path, field, value, expected):
    config = smoke_config()
    config.update_from_flattened_dict({field: value})
    with pytest.raises(ValueError, match=rf"--config.{field} is {value}, {expected}; correct it"):
        train_and_evaluate(config, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_every_range_is_one_of_a_number():
    names = [name for _, _, names in config_ranges._RANGES for name in names.split()]
    assert len(set(names)) == len(names)
    for name in names:
        section, field = name.split(".")
        value = default.get_config()[section][field]
        assert is_auto(value) or isinstance(value, int | float), name


@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "configs").glob("[!_]*.py")))
def test_the_configs_are_in_their_ranges(name):
    module = __import__(f"jaxnerf.configs.{name}", fromlist=["get_config"])
    config_ranges.check_ranges(module.get_config())
