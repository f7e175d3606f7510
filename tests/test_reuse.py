"""The public functions inside a user's own JAX code, and with no dependency but jax and jaxtyping."""

import functools
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from helpers import assert_same
from jaxnerf import Camera, look_at, pixel_grid, rays_from_pixels, render_hierarchical, render_rays, turntable
from runs import ROOT

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")

OPTIONS = {"num_samples": 8, "background": np.ones(3, np.float32)}


def fog(params, x, viewdirs):
    """A soft ball whose colour depends on the direction, too."""
    density = params["density"] * jax.nn.sigmoid(8 * (params["radius"] - jnp.linalg.norm(x, axis=-1)))
    return density, jnp.broadcast_to(0.5 + 0.25 * viewdirs, x.shape)


PARAMS = {"density": np.float32(3.0), "radius": np.float32(1.0)}


def render(params, camera):
    """Returns the colours of a 4 x 4 image."""
    rays = rays_from_pixels(camera, pixel_grid(4, 4), near=2.0, far=6.0)
    return render_rays(None, functools.partial(fog, params), rays, **OPTIONS).rgb


@pytest.fixture(scope="module")
def cameras():
    """Camera [4]."""
    poses = turntable(4, center=jnp.zeros(3), radius=4.0, elevation=0.3)
    return Camera(
        to_world=jnp.asarray(poses),
        focal=jnp.full((4, 2), 4.0),
        center=jnp.full((4, 2), 2.0),
        height=4,
        width=4,
    )


@pytest.fixture(scope="module")
def images(cameras):
    """[4, 4, 4, 3], rendered one camera at a time."""
    run = jax.jit(render)
    return np.stack([run(PARAMS, jax.tree.map(lambda leaf, i=i: leaf[i], cameras)) for i in range(4)])


def test_vmap_over_cameras(cameras, images):
    assert np.ptp(images[..., 0]) > 0.1 and np.ptp(images, axis=0).max() > 0.1
    found = jax.jit(jax.vmap(render, in_axes=(None, 0)))(PARAMS, cameras)
    np.testing.assert_allclose(found, images, atol=1e-6)


def test_scan_over_cameras(cameras, images):
    last, found = jax.jit(
        lambda params, stack: jax.lax.scan(lambda n, camera: (n + 1, render(params, camera)), 0, stack)
    )(PARAMS, cameras)
    assert last == 4
    np.testing.assert_allclose(found, images, atol=1e-6)


def test_shard_map_over_cameras(cameras, images):
    mesh = Mesh(np.array(jax.devices()), ("camera",))
    mapped = jax.shard_map(
        jax.vmap(render, in_axes=(None, 0)), mesh=mesh, in_specs=(P(), P("camera")), out_specs=P("camera")
    )
    found = jax.jit(mapped)(PARAMS, cameras)
    assert len(found.sharding.device_set) == 4
    np.testing.assert_allclose(found, images, atol=1e-6)


def test_gradients_through_scan_vmap_and_shard_map_equal_finite_differences(cameras):
    mesh = Mesh(np.array(jax.devices()), ("camera",))

    def loss(params):
        return (jax.vmap(render, in_axes=(None, 0))(params, cameras) ** 2).mean()

    def scanned(params):
        return jax.lax.scan(lambda s, camera: (s + (render(params, camera) ** 2).mean(), None), 0.0, cameras)[0] / 4

    def sharded(params):
        def mean(params, stack):
            return jax.lax.pmean((jax.vmap(render, in_axes=(None, 0))(params, stack) ** 2).mean(), "camera")

        return jax.shard_map(mean, mesh=mesh, in_specs=(P(), P("camera")), out_specs=P())(params, cameras)

    expected = jax.jit(jax.grad(loss))(PARAMS)
    value = jax.jit(loss)
    for name in PARAMS:
        up, down = ({**PARAMS, name: PARAMS[name] + step} for step in (1e-2, -1e-2))
        assert float(expected[name]) == pytest.approx(float(value(up) - value(down)) / 2e-2, rel=1e-2), name
    for other in (scanned, sharded):
        assert_same(jax.jit(jax.grad(other))(PARAMS), expected, rtol=1e-4, atol=1e-6)


def test_gradients_reach_the_camera_pose(cameras):
    """Through rays, samples and scene."""

    def loss(eye):
        camera = jax.tree.map(lambda leaf: leaf[0], cameras)
        pose = look_at(eye, jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]))
        camera = Camera(**{**vars(camera), "to_world": pose})
        return (render(PARAMS, camera)[..., 0] ** 2).mean()

    eye = jnp.array([3.0, 2.0, 1.5])
    slope = np.asarray(jax.jit(jax.grad(loss))(eye))
    assert np.isfinite(slope).all() and np.abs(slope).max() > 1e-4


def test_render_hierarchical_composes_with_vmap_and_one_key_per_ray(cameras):
    scene = functools.partial(fog, PARAMS)

    def both(keys, camera):
        rays = rays_from_pixels(camera, pixel_grid(4, 4), near=2.0, far=6.0)
        return [r.rgb for r in render_hierarchical(keys, scene, scene, rays, num_coarse=4, num_fine=4)]

    keys = jax.random.split(jax.random.key(0), (4, 4, 4))
    whole = jax.jit(jax.vmap(both))(keys, cameras)
    one = jax.jit(both)(keys[2], jax.tree.map(lambda leaf: leaf[2], cameras))
    assert_same([rgb[2] for rgb in whole], one)


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """Runs Python with this package's wheel, jax, jaxtyping and what these two require, and nothing else."""
    folder = tmp_path_factory.mktemp("bare")
    source, packages = folder / "source", folder / "packages"
    source.mkdir()  # a build leaves files behind
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "jaxnerf", source / "jaxnerf", ignore=shutil.ignore_patterns("__pycache__"))
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "install", source, "--no-deps", f"--target={packages}"], check=True)
    for name in _required_by("jax") | _required_by("jaxtyping"):
        files = importlib.metadata.files(name)
        for top in {file.parts[0] for file in files if file.parts[0] not in ("..", "__pycache__")}:
            (packages / top).symlink_to(importlib.metadata.distribution(name).locate_file(top))

    def run(*arguments):
        command = [sys.executable, "-S", *map(str, arguments)]  # -S: without the packages of this python
        environment = {**os.environ, "PYTHONPATH": str(packages)}
        return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)

    return run


def _required_by(name):
    """Returns the names of a distribution and of all that it requires, without extras."""
    names = {name}
    for line in importlib.metadata.requires(name) or ():
        if "extra ==" not in line:
            names |= _required_by(re.match(r"[\w.-]+", line).group())
    return names


@pytest.mark.slow
def test_the_readmes_first_example_needs_jax_and_jaxtyping_only(bare, tmp_path):
    found = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    (tmp_path / "example.py").write_text(found.group(1))
    result = bare(tmp_path / "example.py")
    assert result.returncode == 0, result.stderr
    assert "(100, 100, 3)" in result.stdout
    for name in ("flax", "absl", "imageio", "ml_collections", "optax", "orbax", "PIL"):
        assert bare("-c", f"import {name}").returncode == 1, name
    place = bare("-c", "import jaxnerf; print(jaxnerf.__file__)")
    assert "packages/jaxnerf/" in place.stdout, place.stderr


def test_importing_jaxnerf_loads_no_other_dependency():
    code = "import jaxnerf, sys; print(*sorted({name.split('.')[0] for name in sys.modules}))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"absl", "ml_collections", "imageio", "flax", "optax", "orbax", "PIL"} & set(result.stdout.split())
