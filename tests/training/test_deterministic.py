"""Training whose sums have a fixed order: what has none on an accelerator is refused there, and nowhere else."""

import jax
import jax.numpy as jnp
import pytest

import jaxnerf
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


@pytest.mark.parametrize("platform, has_whole_numbers", [("cpu", False), ("gpu", True)])
def test_only_an_accelerator_trains_by_sums_of_whole_numbers(monkeypatch, platform, has_whole_numbers):
    make = built()
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    model = make().model
    params = jax.eval_shape(model.init, jax.random.key(0))
    grid = jax.eval_shape(model.grid_schedule.create, jnp.ones(model.grid_schedule.shape, bool))
    row, near = jnp.ones((4, 3)), jnp.ones(4)
    rays = jaxnerf.Rays(origins=row, directions=row, viewdirs=row, near=near, far=2 * near)

    def mean(params, grid):
        return model.render(jax.random.split(jax.random.key(0), 4), params, grid, rays, 0)["fine"].rgb.mean()

    assert ("i64" in str(jax.make_jaxpr(jax.grad(mean))(params, grid))) == has_whole_numbers
