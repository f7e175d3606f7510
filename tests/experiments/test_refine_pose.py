"""The proof that other code can build on the public names: a camera refined through the renderer."""

import ast
import pathlib
import sys

import jax
import jax.numpy as jnp
import pytest

import jaxnerf
from runs import ROOT

sys.path.insert(0, str(pathlib.Path(ROOT, "experiments")))

import refine_pose

SOURCE = ast.parse((ROOT / "experiments" / "refine_pose.py").read_text())


def test_it_uses_public_names_alone():
    modules = {"jaxnerf", "jaxnerf.fields", "jax", "jax.numpy", "numpy", "optax"}
    for node in ast.walk(SOURCE):
        if isinstance(node, ast.Import):
            assert all(name.name in modules | sys.stdlib_module_names for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert (node.module, [name.name for name in node.names]) == ("jaxnerf.fields", ["showcase"])
        elif isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "jaxnerf":
            assert node.attr in jaxnerf.__all__


def ball(x, viewdirs):
    """As the embedded scene, but compiled in no time: soft, with waves all over it, and a gloss."""
    inside = 1.2 - jnp.linalg.norm(x, axis=-1)
    return 40 * jax.nn.sigmoid(20 * inside), 0.5 + 0.4 * jnp.sin(5 * x) + 0.1 * viewdirs


def test_cameras_are_found_again():
    renders = refine_pose.through(ball, 192), refine_pose.through(ball, 64)
    for seed in range(3):
        angles, shares = refine_pose.recover(seed, *renders, size=32, num_steps=80)
        assert (angles[0], shares[0]) == pytest.approx((2.0, 0.05), rel=1e-3)
        assert len(angles) == len(shares) == 81
        assert angles[-1] < refine_pose.ENOUGH[0] and shares[-1] < refine_pose.ENOUGH[1]
