"""The public surface is a contract: names, parameters, docstrings, and what an import costs."""

import inspect
import pathlib
import re
import subprocess
import sys

import pytest

import jaxnerf

# Before "|": positional, in order. After it: keyword-only. "=" marks a default.
SURFACE = {
    "positional_encoding": "x | num_freqs include_input=True",
    "pixel_grid": "height width | offset=0.5",
    "undistort": "camera pixels |",
    "rays_from_pixels": "camera pixels | near far",
    "ndc_rays": "rays camera | near_plane=1.0",
    "ndc_to_t": "t rays camera=None | near_plane=1.0",
    "look_at": "eye target up |",
    "uniform_edges": "near far | num_segments in_disparity=False",
    "stepped_edges": "key near far | step num_segments",
    "samples_from_edges": "key edges | rule='segments'",
    "samples_from_points": "t | last_delta=10000000000.0",
    "inverse_cdf": "edges weights u |",
    "importance_points": "key edges weights | num_points floor=0.0",
    "merge_edges": "edges points |",
    "points_on_rays": "rays t |",
    "weights_from_density": "density length | rule='segments'",
    "transmittance": "density length |",
    "composite": "weights values | background=None transmittance=None",
    "expected_depth": "weights t transmittance | far",
    "expected_disparity": "weights t |",
    "render_samples": "scene rays samples | background=None",
    "render_rays": "key scene rays | num_samples rule='segments' in_disparity=False background=None render",
    "render_hierarchical": "key coarse fine rays | num_coarse num_fine rule='segments' in_disparity=False "
    "importance_floor=0.0 background=None",
    "render_image": "render rays | chunk",
    "create_grid": "lower upper possible | assumed contracted=False",
    "update_grid": "key grid scene cells | threshold decay=0.6 smoothing=0.2 spread=True chunk=8192",
    "grid_of_scene": "key scene lower upper shape | threshold contracted=False looks=4 chunk=8192",
    "restrict_scene": "scene grid |",
    "render_packed": "scene grid rays samples | capacity stop=0.0 background=None",
    "psnr": "a b | mask=None",
    "ssim": "a b |",
    "load_scene": "workdir |",
}
TYPES = ["Rays", "Samples", "Rendering", "Camera", "Views", "Batch", "Grid", "SceneFn"]
SOURCE = r"Eqs?\. ?\d|Section \d|Appendix|arXiv|\d{4} code|released codes?|\([A-Z][a-z]+ .*\d{4}"


def described(function):
    """Returns the signature in the notation above; a default that is a function goes without its address."""
    positional, keyword = [], []
    for name, parameter in inspect.signature(function).parameters.items():
        default = parameter.default
        if default is not parameter.empty and not callable(default):
            name = f"{name}={default!r}"
        (keyword if parameter.kind is parameter.KEYWORD_ONLY else positional).append(name)
    return " ".join([*positional, "|", *keyword])


@pytest.mark.parametrize("name", SURFACE)
def test_signature(name):
    assert name in jaxnerf.__all__
    assert described(getattr(jaxnerf, name)) == SURFACE[name]


@pytest.mark.parametrize("name", TYPES)
def test_types_are_public(name):
    assert name in jaxnerf.__all__ and hasattr(jaxnerf, name)


def test_every_public_name_exists_once():
    assert len(set(jaxnerf.__all__)) == len(jaxnerf.__all__)
    assert [name for name in jaxnerf.__all__ if not hasattr(jaxnerf, name)] == []


FUNCTIONS = [name for name in jaxnerf.__all__ if inspect.isfunction(getattr(jaxnerf, name))]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_docstring_says_what_goes_in_and_what_comes_out(name):
    function = getattr(jaxnerf, name)
    text = inspect.getdoc(function) or ""
    assert text.startswith("Returns ")
    if name in SURFACE:
        parameters = inspect.signature(function).parameters
        assert [p for p in parameters if not re.search(rf"\b{p}\b", text)] == [], "parameters it does not name"
    if name in SURFACE and name not in ("points_on_rays", "look_at"):  # these say it all in a line
        assert "Args:" in text and ("Returns:" in text or "Returns [" in text)


# What has a source in the paper, its code or the literature names it; the others are one plain line of maths.
PLAIN = {
    "uniform_edges",
    "merge_edges",
    "points_on_rays",
    "render_image",
    "load_scene",
    "look_at",
    "turntable",
}
PLAIN |= {
    "mse",
    "round_to_8_bits",
    "expected_depth",
    "expected_disparity",
    "ndc_to_t",
    "transmittance",
    "psnr",
}


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name not in PLAIN])
def test_docstring_names_its_source(name):
    text = " ".join((inspect.getdoc(getattr(jaxnerf, name)) or "").split())
    assert re.search(SOURCE, text), "wanted an equation, a section, a paper or the released code"


def test_import_is_light():
    heavy = ["absl", "ml_collections", "imageio", "flax", "optax"]
    code = f"import sys, jaxnerf; print([name for name in {heavy} if name in sys.modules])"
    root = pathlib.Path(__file__).resolve().parent.parent
    result = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
