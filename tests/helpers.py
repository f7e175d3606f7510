"""What several test files share."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf import Rays


def assert_same(a, b, rtol=1e-6, atol=1e-6):
    """Fails unless two trees of arrays have the same structure, shapes and, nearly, numbers."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert jnp.shape(x) == jnp.shape(y)
        np.testing.assert_allclose(x, y, rtol=rtol, atol=atol)


def assert_batch_is_vmap_is_jit(function, *arrays, **tolerance):
    """Fails unless a compiled batch gives what its rows give in vmap. The other tests run step by step."""
    whole = jax.jit(function)(*arrays)
    assert_same(jax.jit(jax.vmap(function))(*arrays), whole, **tolerance)


def random_rays(seed, shape, near=2.0, far=6.0):
    """Returns Rays whose directions are 0.5 to 2 long."""
    rng = np.random.default_rng(seed)
    viewdirs = rng.normal(size=(*shape, 3))
    viewdirs /= np.linalg.norm(viewdirs, axis=-1, keepdims=True)
    directions = viewdirs * rng.uniform(0.5, 2.0, (*shape, 1))
    return Rays(
        origins=jnp.asarray(rng.normal(size=(*shape, 3)), jnp.float32),
        directions=jnp.asarray(directions, jnp.float32),
        viewdirs=jnp.asarray(viewdirs, jnp.float32),
        near=jnp.full(shape, near, jnp.float32),
        far=jnp.full(shape, far, jnp.float32),
    )


def all_finite(tree):
    return all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))
