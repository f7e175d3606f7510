"""What a field is: parameters, and a function of them that is a scene."""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen

from jaxnerf.core import contraction
from jaxnerf.registry import FIELDS

Box = tuple[tuple[float, float, float], tuple[float, float, float]]  # lower and upper corner, world units

_CACHE_ROW = 512  # float32 numbers, 2 KiB
_MORE_SAMPLES, _FEW_RAYS = 32, 16  # padding of few rays; fewer rays than that would grow much by one


class Field(NamedTuple):
    """A learned scene.

    Attributes:
        init: key -> params.
        apply: (params, x [..., S, 3], viewdirs [..., 1 or S, 3]) -> (density [..., S], rgb [..., S, 3]). A
            field may take `key` and `density_noise` as keywords, see `mlp_field`.
        input_layers: names in params of the layers that the position enters; empty: all of them. A field
            that no gradient reaches there is dead.
    """

    init: Callable[[jax.Array], Any]
    apply: Callable[..., tuple[jax.Array, jax.Array]]
    input_layers: tuple[str, ...] = ()


def make_field(name: str, options: Mapping[str, Any], box: Box | None) -> Field:
    """Makes a field by its registered name.

    Args:
        name: "mlp", "hash_grid", or a name given to `register_field`.
        options: of that field.
        box: of the scene, in world units; None where the run has none.

    Raises:
        ValueError: if there is no field of that name, or its options are wrong.
    """
    return FIELDS.get(name)(dict(options), box)


def contract_field(field: Field, lower, upper) -> Field:
    """Makes the Field of all of space from one that knows a box only.

    The inner half of the box [3] to [3] is evaluated as it is; the outer half holds the rest of space, see
    `contraction.contract`.
    """
    middle = (jnp.asarray(lower) + jnp.asarray(upper)) / 2
    room = (jnp.asarray(upper) - jnp.asarray(lower)) / 4

    def apply(params, x, viewdirs, **options):
        lead = (1,) * (x.ndim - 1)
        center, scale = middle.reshape(*lead, 3), room.reshape(*lead, 3)
        return field.apply(params, center + scale * contraction.contract((x - center) / scale), viewdirs, **options)

    return field._replace(apply=apply)


def apply_network(network: linen.Module, params, x, viewdirs) -> tuple[jax.Array, jax.Array]:
    """Evaluates a network at positions in a layout that suits a CPU's cache.

    Rows of features that are a multiple of 2 KiB long collide in the cache, which slows each product down.
    Such a batch is padded by one ray, or, if there are few rays, by a few samples for each.

    Args:
        network: its call takes x and viewdirs, and returns [..., S] and [..., S, 3].
        params: of the network.
        x: [..., S, 3].
        viewdirs: [..., 1 or S, 3].

    Returns:
        [..., S] and [..., S, 3], the same as without padding.
    """
    *leading, samples = shape = x.shape[:-1]
    rays = math.prod(leading)
    if not rays * samples or rays * samples % _CACHE_ROW:
        return network.apply({"params": params}, x, viewdirs)
    more = (0, _MORE_SAMPLES) if rays < _FEW_RAYS else (1, 0)

    def pad(vectors):
        vectors = jnp.broadcast_to(vectors, (*leading, *vectors.shape[-2:])).reshape(rays, -1, 3)
        return jnp.pad(vectors, [(0, more[0]), (0, more[1] * (vectors.shape[1] > 1)), (0, 0)])

    density, rgb = network.apply({"params": params}, pad(x), pad(viewdirs))
    return density[:rays, :samples].reshape(shape), rgb[:rays, :samples].reshape(*shape, 3)
