"""Every configuration builds; the paper's hold the paper's numbers; one module alone reads them."""

import ast
import importlib
import re

import jax
import optax
import pytest

from jaxnerf import Camera, Views
from jaxnerf.training.build import build
from runs import ROOT

NAMES = sorted(path.stem for path in (ROOT / "configs").glob("*.py"))


def load(name):
    return importlib.import_module(f"configs.{name}").get_config()


def with_sizes(config):
    """Returns the configuration with what its views would fill in."""
    if config.occupancy.skip_empty:
        sizes = {"lower": (-1.0,) * 3, "upper": (1.0,) * 3, "resolution": 8, "step": 0.1}
        sizes["outside"] = "nothing"
        config.data.background = config.data.background or "none"
        config.occupancy.update({name: size for name, size in sizes.items() if not config.occupancy[name]})
        config.hash_grid.resolutions = config.hash_grid.resolutions or (4, 8)
        config.fine.num_freqs = config.fine.num_freqs or 4
        config.train.max_steps = config.train.max_steps or 100
        config.train.lr_steps = config.train.lr_steps or config.train.max_steps
    return config


def fields(config):
    """Returns {"section.key": value} of all that a configuration holds."""
    plain = config.to_dict()
    return {
        f"{section}.{key}" if key else section: value
        for section, values in plain.items()
        for key, value in (values.items() if isinstance(values, dict) else [("", values)])
    }


@pytest.mark.parametrize("name", NAMES)
def test_it_builds_and_invents_no_field(name):
    config, default = load(name), load("default")
    known = fields(default)
    for field, value in fields(config).items():
        assert field in known, f"{field} is not in configs/default.py"
        assert value is None or type(value) is type(known[field]), field
    experiment = build(with_sizes(config))
    params = jax.eval_shape(experiment.model.init, jax.random.key(0))
    assert ("coarse" in params) == (bool(config.sampling.num_fine) and not config.occupancy.skip_empty)
    assert float(experiment.schedule(config.train.lr_steps)) == pytest.approx(config.train.lr_final)
    assert experiment.conventions["background"] == config.data.background


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
    "train.beta1": 0.9,
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
def test_the_papers_values(name, own):
    found, wanted = fields(load(name)), {**PAPER, **own}
    assert {field: found[field] for field in wanted} == wanted
    params = jax.eval_shape(build(load(name)).model.init, jax.random.key(0))
    for network in ("coarse", "fine"):
        assert sum(leaf.size for leaf in jax.tree.leaves(params[network])) == 595_844


def test_where_paper_and_code_disagree_a_comment_says_which():
    for name in ("blender_paper", "llff_paper"):
        source = (ROOT / "configs" / f"{name}.py").read_text()
        for word in ("pixel_offset", "importance_padding", "lr_init" if name == "llff_paper" else "batching"):
            place = source.index(word)
            assert re.search(r"#.*(paper|code)", source[place - 150 : place + 150]), (name, word)


def test_the_learning_rate_falls_exponentially():
    schedule = build(load("blender_paper")).schedule
    for step, wanted in ((0, 5e-4), (250_000, 5e-4 * 10**-0.5), (500_000, 5e-5), (600_000, 5e-5)):
        assert float(schedule(step)) == pytest.approx(wanted, rel=1e-5)
    config = load("default")
    config.train.warmup_steps = 10
    warm = build(config).schedule
    assert float(warm(0)) == pytest.approx(5e-5, rel=1e-3)
    assert float(warm(9)) == pytest.approx(5e-4, rel=1e-3)


@pytest.mark.parametrize(
    "field, value, wanted",
    [
        ("data.background", "pink", "data.background is 'pink'"),
        ("sampling.rule", "boxes", "sampling.rule is 'boxes'"),
        ("train.batching", "rays", "train.batching is 'rays'"),
        ("fine.density_activation", "tanh", "density_activation is 'tanh'"),
        ("field", "grid", "field is 'grid' with space.skip_empty off"),
        ("occupancy.skip_empty", True, "occupancy.lower is open"),
    ],
)
def test_what_cannot_be_built_is_named(field, value, wanted):
    config = load("smoke")
    config.update_from_flattened_dict({field: value})
    with pytest.raises(ValueError, match=wanted):
        build(config)


def test_options_that_are_off_are_not_in_the_step():
    """No fine samples, no second network; no noise, no numbers for it; no NDC, no background."""
    config = load("smoke")
    config.sampling.num_fine = 0
    assert set(jax.eval_shape(build(config).model.init, jax.random.key(0))) == {"fine"}
    draws = []
    for noise in (0.0, 1.0):
        config.sampling.density_noise = noise
        draws.append(str(_render_jaxpr(build(config))).count("random_bits"))
    assert draws[0] < draws[1]


def _render_jaxpr(experiment):
    model = experiment.model
    params = jax.eval_shape(model.init, jax.random.key(0))
    keys = jax.eval_shape(lambda key: jax.random.split(key, 4), jax.random.key(0))
    camera = Camera(to_world=jax.numpy.eye(3, 4)[None], focal=jax.numpy.ones((1, 2)), center=jax.numpy.ones((1, 2)))
    views = Views(pixels=None, offset=None, size=None, cameras=camera, near=jax.numpy.ones(1), far=jax.numpy.ones(1))
    rays = jax.eval_shape(lambda: experiment.view_rays(views, 0, jax.numpy.ones((4, 2))))
    return jax.make_jaxpr(model.render)(keys, params, None, rays, 0)


def test_one_module_alone_reads_the_configuration():
    """ConfigDict stays in workdir.py and the mains; sections are read in build.py, and filled in fit.py."""
    for path in sorted((ROOT / "jaxnerf").rglob("*.py")):
        name = str(path.relative_to(ROOT / "jaxnerf"))
        tree = ast.parse(path.read_text())
        imported = {
            module.split(".")[0]
            for node in ast.walk(tree)
            if isinstance(node, ast.Import | ast.ImportFrom)
            for module in (
                [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            )
        }
        main = "/" not in name
        assert "ml_collections" not in imported or main or name == "engine/workdir.py", name
        assert "absl" not in imported or main, name
        read = {
            node.attr
            for node in ast.walk(tree)
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "config"
        } - {"to_json_best_effort", "update"}
        # To put --data_dir and other settings in, or to read what fit.py looks at.
        allowed = {"engine/load.py": {"data", "eval"}, "engine/loop.py": {"data"}}
        allowed = allowed.get(name, {"data", "train"} if main else set())
        assert name in ("engine/build.py", "engine/fit.py") or read <= allowed, (name, read)


def test_the_optimizer_is_adam_with_the_configured_numbers():
    config = load("smoke")
    config.train.update({"lr_init": 0.1, "lr_final": 0.1, "beta1": 0.5, "beta2": 0.75, "epsilon": 1e-3})
    optimizer = build(config).optimizer
    weights, gradient = jax.numpy.array([1.0]), jax.numpy.array([0.01])
    update, _ = optimizer.update(gradient, optimizer.init(weights), weights)
    assert float(optax.apply_updates(weights, update)[0]) == pytest.approx(1 - 0.1 * 0.01 / 0.011, rel=1e-4)
