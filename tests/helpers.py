"""Helpers that several test files share."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf import Rays, create_grid


def compiled(function, *static):
    """Returns the function jitted, with results in numpy."""
    run = jax.jit(function, static_argnames=static)
    return lambda *args, **options: jax.tree.map(np.asarray, run(*args, **options))


def assert_same(a, b, rtol=1e-6, atol=1e-6):
    """Fails unless two trees of arrays have the same structure, shapes and, nearly, numbers."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert jnp.shape(x) == jnp.shape(y)
        np.testing.assert_allclose(x, y, rtol=rtol, atol=atol)


def assert_batch_is_vmap_is_jit(function, *arrays, **tolerance):
    """Fails unless a compiled batch equals a vmap over its rows."""
    whole = jax.jit(function)(*arrays)
    assert_same(jax.jit(jax.vmap(function))(*arrays), whole, **tolerance)


def random_rays(seed, shape, near=2.0, far=6.0):
    """Returns Rays, in numpy, whose directions are 0.5 to 2 long."""
    rng = np.random.default_rng(seed)
    viewdirs = rng.normal(size=(*shape, 3))
    viewdirs /= np.linalg.norm(viewdirs, axis=-1, keepdims=True)
    directions = viewdirs * rng.uniform(0.5, 2.0, (*shape, 1))
    return Rays(
        origins=rng.normal(size=(*shape, 3)).astype(np.float32),
        directions=directions.astype(np.float32),
        viewdirs=viewdirs.astype(np.float32),
        near=np.full(shape, near, np.float32),
        far=np.full(shape, far, np.float32),
    )


def rays_past_origin(seed, count):
    """Returns Rays [count] from about 4 away that pass near the origin, with t in [1, 7]."""
    rays = random_rays(seed, (count,), near=1.0, far=7.0)
    return dataclasses.replace(rays, origins=np.float32(0.4 * rays.origins - 4 * rays.directions))


def full_grid(half=30.0, shape=(6, 5, 8)):
    """Returns an OccupancyGrid of a cube around the origin, with every cell occupied."""
    return create_grid(np.full(3, -half), np.full(3, half), np.ones(shape, bool), initial_density=1.0)


def checked_grid(half=1.5, shape=(6, 5, 8)):
    """Returns an OccupancyGrid of a cube around the origin, with every other cell empty."""
    valid = np.indices(shape).sum(axis=0) % 2 == 0
    return create_grid(np.full(3, -half), np.full(3, half), valid, initial_density=1.0)


def without_damping(params, num_freqs):
    """Returns parameters of a plain `MLP` that sees points as the prefiltered one of these parameters does.

    Of a point all octaves are left, so that their rows of the first layer are part of its bias.
    """
    kernel, bias = (params["trunk_0"][name] for name in ("kernel", "bias"))
    return {**params, "trunk_0": {"kernel": kernel[:-num_freqs], "bias": bias + kernel[-num_freqs:].sum(axis=0)}}


def all_finite(tree):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def out_of_memory():
    """Returns the error that JAX raises where a device has no more memory."""
    return jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 9 bytes.")


def control_group(system):
    """Makes the folder of the control group /pod/job in a system's files, as that of this process; returns it."""
    group = system / "sys/fs/cgroup/pod/job"
    group.mkdir(parents=True)
    (system / "proc/self").mkdir(parents=True)
    (system / "proc/self/cgroup").write_text("0::/pod/job\n")
    return group
