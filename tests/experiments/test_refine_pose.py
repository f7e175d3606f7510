"""Other code can build on the public names alone: a camera is refined through the renderer."""

import ast
import sys

import jax
import jax.numpy as jnp
import pytest

import jaxnerf
from runs import ROOT
from studies import study

refine_pose = study("refine_pose/refine_pose")
SOURCE = ast.parse((ROOT / "experiments" / "refine_pose" / "refine_pose.py").read_text())


def test_it_uses_public_names_only():
    modules = {"jaxnerf", "jaxnerf.fields", "jax", "jax.numpy", "numpy", "optax"}
    for node in ast.walk(SOURCE):
        if isinstance(node, ast.Import):
            assert all(name.name in modules | sys.stdlib_module_names for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module.split(".")[0] not in sys.stdlib_module_names:
            assert (node.module, [name.name for name in node.names]) == ("jaxnerf.fields", ["still_life"])
        elif isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "jaxnerf":
            assert node.attr in jaxnerf.__all__


def ball(x, viewdirs):
    """Replaces the embedded scene, and compiles faster: a soft ball with a wavy, glossy surface."""
    inside = 1.2 - jnp.linalg.norm(x, axis=-1)
    return 40 * jax.nn.sigmoid(20 * inside), 0.5 + 0.4 * jnp.sin(5 * x) + 0.1 * viewdirs


@pytest.mark.extra
def test_cameras_are_recovered():
    renders = refine_pose.through(ball, 192), refine_pose.through(ball, 64)
    for seed in range(3):
        angles, zooms = refine_pose.recover(seed, *renders, size=32, num_steps=80)
        assert (angles[0], zooms[0]) == pytest.approx((2.0, 0.05), rel=1e-3)
        assert len(angles) == len(zooms) == 81
        assert angles[-1] < refine_pose.TOLERANCE[0] and zooms[-1] < refine_pose.TOLERANCE[1]
