"""Every config builds, and the paper's configs hold the paper's values."""

import importlib
import re

import jax
import optax
import pytest
from ml_collections import ConfigDict

from jaxnerf import Camera, Views
from jaxnerf.data import dataset, synthetic
from jaxnerf.data.dataset import DataOptions
from jaxnerf.options import AUTO, replaced
from jaxnerf.training.auto_config import resolve, resolve_for_device
from jaxnerf.training.build import build
from jaxnerf.training.config import changed, flatten, read_config, to_config_dict
from jaxnerf.training.optimizer import OptimizerOptions, make_optimizer
from runs import ROOT

NAMES = sorted(path.stem for path in (ROOT / "jaxnerf" / "configs").glob("[!_]*.py"))


def load(name):
    return importlib.import_module(f"jaxnerf.configs.{name}").get_config()


def resolved(config):
    """Returns the config resolved against views of the embedded scene, whatever its dataset is."""
    config = read_config(config)
    data = replaced(config.data, **{n: v for n, v in DATA.items() if getattr(config.data, n) == "auto"})
    views = synthetic.load_synthetic(size=24)
    resolved = resolve(replaced(config, data=DataOptions()), views).config  # its dataset need not exist
    return resolve_for_device(replaced(resolved, data=data))[0]


DATA = {"format": "blender", "factor": 1, "background": "none"}
DATA |= {"world": "file", "ndc": False}


def fields(config):
    """Returns {"section.field": value} of a config."""
    return flatten(config.to_dict())


@pytest.mark.parametrize("name", NAMES)
def test_config_builds_and_has_no_unknown_field(name):
    config, known = load(name), load("default")
    assert set(fields(config)) == set(fields(known))
    for section, values in known.items():
        for field in values if isinstance(values, ConfigDict) else ():
            assert config[section].get_type(field) is values.get_type(field), (section, field)
    experiment = build(resolved(config))
    params = jax.eval_shape(experiment.model.init, jax.random.key(0))
    assert ("coarse" in params) == (config.sampler == "hierarchical" and bool(config.sampling.num_fine))
    assert float(experiment.schedule(10**7)) == pytest.approx(config.train.lr_final)
    assert read_config(to_config_dict(experiment.config)) == experiment.config
    if config.data.background != "auto":
        assert dataset.conventions(experiment.config.data)["background"] == config.data.background


PAPER_NETWORK = {
    "depth": 8,
    "width": 256,
    "skip_layer": 4,
    "view_width": 128,
    "num_freqs": 10,
    "num_view_freqs": 4,
    "use_viewdirs": True,
    "density_activation": "relu",
    "density_bias": 0.0,
    "compute_dtype": "float32",
}
PAPER = {
    "sampling.num_coarse": 64,
    "sampling.num_fine": 128,
    "sampling.rule": "points",
    "sampling.in_disparity": False,
    "data.pixel_offset": 0.0,
    "train.lr_init": 5e-4,
    "train.lr_final": 5e-5,
    "train.lr_decay_power": 1.0,
    "train.beta2": 0.999,
    "train.epsilon": 1e-7,
    "train.warmup_steps": 0,
    "train.max_seconds": 0.0,
    **{f"{name}.{key}": value for name in ("coarse", "fine") for key, value in PAPER_NETWORK.items()},
}
BLENDER = {
    "data.format": "blender",
    "data.factor": 1,
    "data.background": "white",
    "data.ndc": False,
    "data.near": 2.0,
    "data.far": 6.0,
    "sampling.density_noise": 0.0,
    "train.batch_size": 1024,
    "train.batching": "single_image",
    "train.max_steps": 500_000,
    "train.lr_steps": 500_000,
}
LLFF = {
    "data.format": "llff",
    "data.factor": 4,
    "data.background": "black",
    "data.ndc": True,
    "sampling.density_noise": 1.0,
    "train.batch_size": 4096,
    "train.batching": "all_images",
    "train.max_steps": 200_000,
    "train.lr_steps": 250_000,
}


@pytest.mark.parametrize("name, own", [("blender_paper", BLENDER), ("llff_paper", LLFF)])
def test_values_of_the_paper(name, own):
    found, expected = fields(load(name)), {**PAPER, **own}
    assert {field: found[field] for field in expected} == expected
    params = jax.eval_shape(build(resolved(load(name))).model.init, jax.random.key(0))
    for network in ("coarse", "fine"):
        assert sum(leaf.size for leaf in jax.tree.leaves(params[network])) == 595_844


def test_comment_names_the_source_where_paper_and_code_disagree():
    for name in ("blender_paper", "llff_paper"):
        source = (ROOT / "jaxnerf" / "configs" / f"{name}.py").read_text()
        for word in ("pixel_offset", "importance_padding", "lr_init" if name == "llff_paper" else "batching"):
            place = source.index(word)
            assert re.search(r"#.*(paper|code)", source[place - 150 : place + 150]), (name, word)


def test_learning_rate_decays_exponentially():
    schedule = make_optimizer(read_config(load("blender_paper")).train)[1]
    for step, expected in ((0, 5e-4), (250_000, 5e-4 * 10**-0.5), (500_000, 5e-5), (600_000, 5e-5)):
        assert float(schedule(step)) == pytest.approx(expected, rel=1e-5)
    warm = make_optimizer(OptimizerOptions(warmup_steps=10))[1]
    assert float(warm(0)) == pytest.approx(5e-5, rel=1e-3)
    assert float(warm(9)) == pytest.approx(5e-4, rel=1e-3)


@pytest.mark.parametrize(
    "field, value, message",
    [
        ("data.background", "pink", "data.background is 'pink'"),
        ("sampling.rule", "boxes", "sampling.rule is 'boxes'"),
        ("train.batching", "rays", "train.batching is 'rays'"),
        ("fine.density_activation", "tanh", "density_activation is 'tanh'"),
        ("field", "voxels", "there is no field 'voxels'"),
        ("sampler", "rejection", "there is no sampler 'rejection'"),
        ("losses.mse", 0.0, "losses: no loss of the renderings has a weight; set losses.mse to 1"),
        ("losses.mse", ((5, 1.0), (2, 0.0)), "losses.mse is .* ascending steps"),
    ],
)
def test_invalid_value_is_an_error(field, value, message):
    with pytest.raises(ValueError, match=message):
        build(changed(resolved(load("smoke")), {field: value}))


@pytest.mark.parametrize("kind, name", [("field", "field"), ("sampler", "sampler"), ("loss", "losses.voxels")])
def test_a_part_that_is_not_registered_is_an_error_before_the_dataset_is_read(kind, name):
    values = {name: 1.0 if kind == "loss" else "voxels", "data.format": AUTO, "data.dir": "nowhere"}
    with pytest.raises(ValueError, match=f"there is no {kind} 'voxels'"):
        resolve(changed(read_config(load("smoke")), values))


def test_unresolved_config_is_an_error():
    config = load("smoke")
    config.sampler, config.field = "occupancy", "hash_grid"
    with pytest.raises(ValueError, match="is 'auto'; resolve the config"):
        build(config)


def test_options_that_are_off_add_no_operations():
    """Without fine samples there is no second network; without noise no random numbers are drawn for it."""
    config = changed(resolved(load("smoke")), {"sampling.num_fine": 0})
    assert set(jax.eval_shape(build(config).model.init, jax.random.key(0))) == {"fine"}
    draws = []
    for noise in (0.0, 1.0):
        noisy = changed(config, {"sampling.density_noise": noise})
        draws.append(str(_render_jaxpr(build(noisy))).count("random_bits"))
    assert draws[0] < draws[1]


def _render_jaxpr(experiment):
    model = experiment.model
    params = jax.eval_shape(model.init, jax.random.key(0))
    keys = jax.eval_shape(lambda key: jax.random.split(key, 4), jax.random.key(0))
    camera = Camera(to_world=jax.numpy.eye(3, 4)[None], focal=jax.numpy.ones((1, 2)), center=jax.numpy.ones((1, 2)))
    views = Views(pixels=None, offset=None, size=None, cameras=camera, near=jax.numpy.ones(1), far=jax.numpy.ones(1))
    rays = jax.eval_shape(lambda: experiment.view_rays(views, 0, jax.numpy.ones((4, 2))))
    return jax.make_jaxpr(model.render)(keys, params, None, rays, 0)


def test_optimizer_is_adam_with_the_configured_values():
    options = OptimizerOptions(lr_init=0.1, lr_final=0.1, beta2=0.75, epsilon=1e-3)
    optimizer, _ = make_optimizer(options)
    params, gradient = jax.numpy.array([1.0]), jax.numpy.array([0.01])
    update, _ = optimizer.update(gradient, optimizer.init(params), params)
    assert float(optax.apply_updates(params, update)[0]) == pytest.approx(1 - 0.1 * 0.01 / 0.011, rel=1e-4)
