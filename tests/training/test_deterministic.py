"""Training whose sums have a fixed order: what has none on an accelerator is refused there, and nowhere else."""

import jax
import pytest

from jaxnerf.data import synthetic
from jaxnerf.training import auto_config, build
from runs import PACKED, smoke_config


def built(**fields):
    config = smoke_config()
    config.update_from_flattened_dict({**PACKED, "train.deterministic": True, **fields})
    resolved = auto_config.resolve(config, synthetic.load_synthetic(size=24), platform="cpu").config
    return lambda: build.build(auto_config.resolve_for_device(resolved, "cpu")[0])


@pytest.mark.parametrize(
    "name, value", [("losses.depth", 0.1), ("cameras.exposure", True), ("cameras.refine", True), ("losses.mse", 1.0)]
)
def test_gradients_without_a_fixed_order_are_refused_on_an_accelerator(monkeypatch, name, value):
    make = built(**{name: value})
    make()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    if name == "losses.mse":
        make()
        return
    with pytest.raises(ValueError, match=name):
        make()
