"""Any field trains with any sampler, and with the distortion loss.

tests/training/test_fast_training.py trains a hash grid with the occupancy sampler for longer.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnerf.training import auto_config
from jaxnerf.training.build import build
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step
from runs import PACKED, smoke_config

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")
STEPS = 40


@pytest.mark.parametrize(
    ("field", "sampler"),
    [
        ("mlp", "hierarchical"),
        pytest.param("hash_grid", "occupancy", marks=pytest.mark.extra),
        pytest.param("mlp", "occupancy", marks=pytest.mark.extra),
        pytest.param("hash_grid", "hierarchical", marks=pytest.mark.extra),
    ],
)
def test_the_loss_falls(field, sampler):
    config = smoke_config(max_steps=STEPS, lr_steps=STEPS, lr_init=1e-2, lr_final=1e-2)
    config.update_from_flattened_dict({**PACKED, "field": field, "sampler": sampler, "losses.distortion": 1e-3})
    resolved = auto_config.resolve(config)
    experiment = build(auto_config.resolve_for_device(resolved.config)[0])
    valid, data = experiment.prepare(resolved.views)
    assert (valid is None) == (sampler == "hierarchical")
    state = create_state(experiment.model, experiment.optimizer, 0, valid)
    step = jax.jit(make_train_step(experiment.model, experiment.optimizer, experiment.draw, experiment.losses))
    positions, losses = jnp.arange(config.train.batch_size)[None], []
    for _ in range(STEPS):
        state, metrics = step(state, data, positions)
        losses.append(float(metrics["mse_fine"]))
        assert metrics["loss_distortion"] >= 0
    assert np.mean(losses[-5:]) < 0.7 * np.mean(losses[:5])
    assert not state.counters["nonfinite"]


@pytest.mark.parametrize(("field", "value"), [("sampling.stratified", False), ("sampling.density_noise", 1.0)])
def test_the_occupancy_sampler_names_what_it_cannot_do(field, value):
    config = smoke_config()
    config.update_from_flattened_dict({**PACKED, "scene.lower": (-1.0,) * 3, "scene.upper": (1.0,) * 3})
    config.update_from_flattened_dict({field: value, "scene.contracted": False})
    with pytest.raises(ValueError, match=f"^--config.{field} is {value}.*sampler 'occupancy'.*'hierarchical'"):
        build(config)
