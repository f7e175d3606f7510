"""Flags of samples, 32 in a word: to look through words in place of samples is what makes packing cheap."""

import jax
import jax.numpy as jnp


def pack(flags):
    """Returns flags [B, S] as words [B, W] uint32, the first flag lowest."""
    flags = jnp.pad(flags, ((0, 0), (0, -flags.shape[-1] % 32))).reshape(flags.shape[0], -1, 32)
    return (flags * (jnp.uint32(1) << jnp.arange(32, dtype=jnp.uint32))[None, None]).sum(-1, dtype=jnp.uint32)


def count(words):
    """Returns how many flags are set in each word, int32."""
    return jax.lax.population_count(words).astype(jnp.int32)


def nth(words, n):
    """Returns the place in each word of the n-th flag that is set, the lowest being n = 0."""
    place = jnp.zeros_like(n)
    for half in (16, 8, 4, 2, 1):
        low = count((words >> place.astype(jnp.uint32)) & jnp.uint32(2**half - 1))
        above = n >= low
        n, place = n - jnp.where(above, low, 0), place + jnp.where(above, half, 0)
    return place
