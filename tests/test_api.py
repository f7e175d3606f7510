"""The public API is a contract: names, parameters, docstrings, and what an import loads."""

import dataclasses
import inspect
import pathlib
import pickle
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

import jaxnerf

# Before "|": positional, in order. After it: keyword-only. "=" marks a default.
SURFACE = {
    "positional_encoding": "x | num_freqs include_input=True",
    "integrated_encoding": "x variance | num_freqs include_input=True",
    "frustum_variance": "viewdirs radius length |",
    "integrated_directional_encoding": "directions roughness | degrees=(1, 2, 4, 8)",
    "density_normals": "scene x viewdirs | spacing=None **inputs",
    "pixel_grid": "height width | offset=0.5",
    "undistort": "camera pixels |",
    "rays_from_pixels": "camera pixels | near far",
    "ndc_rays": "rays camera | near_plane=1.0",
    "ndc_to_t": "t rays camera=None | near_plane=1.0",
    "look_at": "eye target up |",
    "pixel_radius": "camera pixels |",
    "project": "camera x |",
    "se3_exponential": "twists |",
    "estimate_pose": "scene image camera start | near far num_samples=128 background=None render=None key=None "
    "pixels=None num_pixels=8192 with_focal=False with_gains=False max_iterations=30 chunk=1024",
    "uniform_edges": "near far | num_segments in_disparity=False",
    "stepped_edges": "key near far | step_size num_segments",
    "samples_from_edges": "key edges | rule='segments'",
    "samples_from_points": "t | last_delta=10000000000.0",
    "inverse_cdf": "edges weights u |",
    "importance_points": "key edges weights | num_points padding=0.0",
    "merge_edges": "edges points |",
    "points_on_rays": "rays t |",
    "weights_from_density": "density length | rule='segments'",
    "transmittance": "density length |",
    "composite": "weights values | background=None transmittance=None",
    "expected_depth": "weights t transmittance | far",
    "expected_disparity": "weights t |",
    "median_depth": "density length t delta | far rule='segments'",
    "render_samples": "scene rays samples | background=None median_depth=False",
    "render_rays": "key scene rays | num_samples rule='segments' in_disparity=False background=None render "
    "median_depth=False",
    "render_hierarchical": "key coarse fine rays | num_coarse num_fine rule='segments' in_disparity=False "
    "importance_padding=0.0 background=None median_depth=False",
    "render_image": "render rays | chunk map",
    "create_grid": "lower upper valid | initial_density contracted=False",
    "update_grid": "key grid scene cells | threshold spacing=None decay=0.6 smoothing=0.2 spread=True chunk=8192 "
    "radii=None index=None",
    "grid_from_scene": "key scene lower upper shape | threshold contracted=False num_updates=4 chunk=8192",
    "mask_scene": "scene grid |",
    "render_packed": "scene grid rays samples | max_samples early_stop_eps=0.0 background=None median_depth=False",
    "mse": "a b | mask=None",
    "psnr": "a b | mask=None",
    "ssim": "a b |",
    "round_to_8_bits": "image |",
    "distortion_loss": "outputs batch |",
    "turntable": "num_frames | center radius elevation up=(0.0, 0.0, 1.0)",
    "load_dataset": "dir | split='train' **options",
    "draw_batch": "seed step positions views active_pixels=None | batching='all_images' pixel_offset=0.5 ndc=False "
    "extras=() needs=() rays_per_side=1",
    "mlp_field": "| **options",
    "hash_grid_field": "| **options",
    "still_life": "x viewdirs |",
    "load_scene": "workdir |",
    "restore_run": "workdir config=None | data_dir=None settings=None time=None",
    "train_and_evaluate": "config workdir | views=None observe=None",
    "train_many": "configs workdirs |",
    "register_field": "name make | options=None",
    "register_sampler": "name make | options=None",
    "register_loss": "name function | on='renderings' needs=() weight=0.0 help=''",
    "register_reader": "name read | detect=None",
    "register_exporter": "name export | check=None options=None",
    "register_estimator": "name estimate |",
}
TYPES = ["Rays", "Samples", "PackedSamples", "Rendering", "Camera", "Views", "Batch", "OccupancyGrid", "SceneFn"]
TYPES += ["SparsePoints", "TrainedRun", "PoseEstimate"]
SOURCE = r"Eqs?\. ?\d|Section \d|Appendix|arXiv|\d{4} code|released codes?|\([A-Z][a-z]+ .*\d{4}"


def described(function):
    """Returns the signature in the notation above; a default that is a function is omitted."""
    positional, keyword = [], []
    for name, parameter in inspect.signature(function).parameters.items():
        default = parameter.default
        if default is not parameter.empty and not callable(default):
            name = f"{name}={default!r}"
        if parameter.kind is parameter.VAR_KEYWORD:
            name = f"**{name}"
        (keyword if parameter.kind in (parameter.KEYWORD_ONLY, parameter.VAR_KEYWORD) else positional).append(name)
    return " ".join([*positional, "|", *keyword])


@pytest.mark.parametrize("name", SURFACE)
def test_signature(name):
    assert name in jaxnerf.__all__
    assert described(getattr(jaxnerf, name)) == SURFACE[name]


@pytest.mark.parametrize("name", TYPES)
def test_types_are_public(name):
    assert name in jaxnerf.__all__ and hasattr(jaxnerf, name)


def test_every_public_name_is_listed_here():
    assert set(jaxnerf.__all__) == {*SURFACE, *TYPES}


def test_every_public_name_exists_once():
    assert len(set(jaxnerf.__all__)) == len(jaxnerf.__all__)
    assert [name for name in jaxnerf.__all__ if not hasattr(jaxnerf, name)] == []


FUNCTIONS = [name for name in jaxnerf.__all__ if inspect.isfunction(getattr(jaxnerf, name))]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_docstring_describes_arguments_and_result(name):
    function = getattr(jaxnerf, name)
    text = inspect.getdoc(function) or ""
    assert re.match(r"[A-Z][a-z]+s ", text), "expected a verb in the third person"
    parameters = inspect.signature(function).parameters
    assert [p for p in parameters if not re.search(rf"\b{p}\b", text)] == [], "parameters it does not name"
    if name != "points_on_rays":  # its docstring is one line
        assert "Args:" in text
        result = inspect.signature(function).return_annotation
        # A type with a docstring of its own needs no description.
        assert result in (None, jaxnerf.Views, jaxnerf.TrainedRun) or "Returns:" in text


# Functions with a source in the paper, its code or the literature name it. These are plain mathematics or read files.
PLAIN = {
    *("uniform_edges", "merge_edges", "points_on_rays", "render_image", "look_at", "turntable", "ndc_to_t"),
    *("mse", "psnr", "round_to_8_bits", "expected_depth", "expected_disparity", "median_depth", "transmittance"),
    *("load_dataset", "draw_batch", "still_life", "mlp_field", "load_scene", "restore_run", "train_and_evaluate"),
    "train_many",
    *("register_field", "register_sampler", "register_loss", "register_reader", "register_exporter"),
    "register_estimator",
}


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name not in PLAIN])
def test_docstring_names_its_source(name):
    text = " ".join((inspect.getdoc(getattr(jaxnerf, name)) or "").split())
    assert re.search(SOURCE, text), "expected an equation, a section, a paper or the released code"


def fog(x, viewdirs):
    return jnp.ones(x.shape[:-1]), jnp.ones(x.shape)


RAYS = jaxnerf.Rays(
    **{name: [[0.0, 0.0, 1.0]] for name in ("origins", "directions", "viewdirs")}, near=[1.0], far=[2.0]
)
POSE = jnp.eye(4)[:3]
CAMERA = jaxnerf.Camera(to_world=POSE, focal=jnp.ones(2), center=jnp.ones(2))
WRONG = {
    "scene is of type Rays, expected a function; the order is key, scene, rays": lambda: jaxnerf.render_rays(
        None, RAYS, fog, num_samples=2
    ),
    "key is a function, expected a key such as jax.random.key(0) or None": lambda: jaxnerf.render_rays(
        fog, RAYS, None, num_samples=2
    ),
    "rays.near is None, expected an array": lambda: jaxnerf.render_rays(
        None, fog, dataclasses.replace(RAYS, near=None), num_samples=2
    ),
    "num_samples is 2.0, expected a whole number": lambda: jaxnerf.render_rays(None, fog, RAYS, num_samples=2.0),
    "num_samples is a traced array ()": lambda: jax.jit(
        lambda count: jaxnerf.render_rays(None, fog, RAYS, num_samples=count)
    )(2),
    "grid is of type Rays, expected OccupancyGrid or None": lambda: jaxnerf.render_packed(
        fog, RAYS, RAYS, RAYS, max_samples=2
    ),
    "camera is an array (3, 4)": lambda: jaxnerf.rays_from_pixels(POSE, jnp.ones((1, 2)), near=1.0, far=2.0),
    "a is 'image.png', expected an array": lambda: jaxnerf.psnr("image.png", jnp.ones((2, 2, 3))),
    "outputs is of type Rays, expected a list": lambda: jaxnerf.distortion_loss(RAYS, RAYS),
    "expected (3, 4), of one camera; drop the last row": lambda: jaxnerf.rays_from_pixels(
        dataclasses.replace(CAMERA, to_world=jnp.eye(4)), jnp.ones((1, 2)), near=1.0, far=2.0
    ),
    "near has shape (3,), which does not fit (1,)": lambda: jaxnerf.rays_from_pixels(
        CAMERA, jnp.ones((1, 2)), near=jnp.ones(3), far=2.0
    ),
    "near is 3 and far 2, expected near <= far": lambda: jaxnerf.rays_from_pixels(
        CAMERA, jnp.ones((1, 2)), near=3.0, far=2.0
    ),
    "uniform_edges: near is 3 and far 2": lambda: jaxnerf.uniform_edges(3.0, 2.0, num_segments=2),
    "step_size is 0.0, expected more than 0": lambda: jaxnerf.stepped_edges(
        None, 1.0, 2.0, step_size=0.0, num_segments=2
    ),
    "eye and target are both [1. 2. 3.]": lambda: jaxnerf.look_at((1, 2, 3), (1, 2, 3), (0, 0, 1)),
    "radius is 0.0, expected more than 0": lambda: jaxnerf.turntable(2, center=(0, 0, 0), radius=0.0, elevation=0.0),
    "lower is 1 and upper -1": lambda: jaxnerf.create_grid(
        (1, 1, 1), (-1, -1, -1), jnp.ones((2, 2, 2), bool), initial_density=1.0
    ),
    "config is 'smoke', expected RunConfig or ConfigDict or a dict": lambda: jaxnerf.train_and_evaluate("smoke", "run"),
    "config is 'smoke', expected one such as": lambda: jaxnerf.train_many(["smoke"], ["run"]),
    "workdir is None, expected text or a path": lambda: jaxnerf.load_scene(None),
    "needs is 'alpha', expected a list": lambda: jaxnerf.register_loss("wrong", fog, needs="alpha"),
}


@pytest.mark.parametrize("message", WRONG)
def test_a_wrong_argument_is_named(message):
    with pytest.raises(ValueError, match=re.escape(message)):
        WRONG[message]()


def test_lists_of_rays_become_arrays():
    rendering = jaxnerf.render_rays(None, fog, RAYS, num_samples=2)
    assert rendering.rgb.shape == (1, 3) and pickle.loads(pickle.dumps(jaxnerf.render_rays)) is jaxnerf.render_rays


def test_import_is_light():
    heavy = ["absl", "ml_collections", "imageio", "flax", "optax", "orbax", "beartype"]
    code = f"import sys, jaxnerf; print([name for name in {heavy} if name in sys.modules])"
    root = pathlib.Path(__file__).resolve().parent.parent
    result = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
