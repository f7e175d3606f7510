"""The interface of fields, parameters and a function of them that is a scene, and the layers that networks share."""

import functools
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen
from jaxtyping import Array, ArrayLike, Float, Num

from jaxnerf.core import contraction
from jaxnerf.core.loops import is_cpu
from jaxnerf.core.scene import needs_of
from jaxnerf.core.types import SceneFn, Vector
from jaxnerf.options import Ablation, Facts, double, half

_LEAST_SPREAD = 4.0  # of footprints: those of a hand-held capture differ by up to 1.7, those of four scales by 8
_CACHE_ROW = 512  # float32 numbers, 2 KiB
_FEW_RAYS = 16  # with fewer rays, padding by a whole ray costs too much
_MORE_SAMPLES = 32  # padding of each ray, if there are few

# Parts of the method that several fields have.
VIEW_PART = Ablation("view dependence", without=False, more=True)
WIDTH_PART = Ablation("width of the networks", less=half, more=double)
PREFILTER_PART = Ablation(
    "footprints of pixels", without=False, more=lambda value, options, facts: None if facts.ndc else True
)


class Field(NamedTuple):
    """A learned scene.

    Attributes:
        init: key -> params, any pytree of float arrays.
        apply: (params, x [..., S, 3], viewdirs [..., 1 or S, 3]) -> (density [..., S] in 1 / world unit, rgb
            [..., S, 3] in [0, 1]). A field may take `key` and `density_noise` as keywords, see `mlp_field`, and
            keyword-only what a scene may ask for, see `core.scene.NEEDS`.
        input_layers: keys of params: the layers that receive the position; empty: all layers. A field is dead
            if no gradient reaches these layers; training then reinitializes it.
        regularizers: by the name of a registered loss, the function (params) -> scalar; see `register_loss`.
        color_layers: keys of params: the first layers that serve colour alone; empty: not checked. A field is dead,
            too, if no gradient reaches these layers.
        network: what has the parameters, for tools that write it in another form; None: they cannot.
        apply_in_fixed_order: `apply`, with a gradient whose sums have a fixed order on an accelerator, too; None: those
            of `apply` have.
    """

    init: Callable[[jax.Array], Any]
    apply: Callable[..., tuple[jax.Array, jax.Array]]
    input_layers: tuple[str, ...] = ()
    regularizers: Mapping[str, Callable[[Any], jax.Array]] = {}
    color_layers: tuple[str, ...] = ()
    network: Any = None
    apply_in_fixed_order: Callable[..., tuple[jax.Array, jax.Array]] | None = None


def contract_field(field: Field, lower: Vector, upper: Vector) -> Field:
    """Makes a Field that covers all of space from one that covers a box.

    The inner half of the box from lower [3] to upper [3] is evaluated as it is; the outer half holds the rest
    of space, see `contraction.contract`. If the field asks for radius or length, they are scaled as the contraction
    scales lengths there, see `contraction.length_scale`; more than 1e30 counts as 1e30.
    """
    middle = (jnp.asarray(lower) + jnp.asarray(upper)) / 2
    quarter = (jnp.asarray(upper) - jnp.asarray(lower)) / 4

    @functools.wraps(field.apply)
    def apply(params, x, viewdirs, **options):
        lead = (1,) * (x.ndim - 1)
        center, scale = middle.reshape(*lead, 3), quarter.reshape(*lead, 3)
        for name in ("radius", "length"):
            if name in options:
                sizes = jnp.minimum(options[name], 1e30)  # infinity times 0 would be NaN
                options[name] = sizes * contraction.length_scale((x - center) / scale)
        return field.apply(params, center + scale * contraction.contract((x - center) / scale), viewdirs, **options)

    return field._replace(apply=apply, apply_in_fixed_order=None)


def at_time(field: Field, time: float) -> Field:
    """Returns the Field at rest that another one is at a time in [0, 1]; the parameters are the same."""

    @functools.wraps(field.apply)
    def apply(params, x, viewdirs, *, time, **inputs):
        return field.apply(params, x, viewdirs, time=jnp.full(x.shape[:-1], time, jnp.float32), **inputs)

    return field._replace(apply=functools.partial(apply, time=time), apply_in_fixed_order=None)


def field_scene(field: Field, params: Mapping[str, Any], name: str = "fine", **options: Any) -> SceneFn:
    """Makes the scene of a network: its field with its parameters.

    Args:
        field: Field.
        params: of a model; their entry "progress", if there is one, is bound where the field asks for it.
        name: of the network.
        **options: keywords of `field.apply`.
    """
    if "progress" in params and "progress" in needs_of(field.apply):
        options["progress"] = params["progress"]
    return functools.partial(field.apply, params[name], **options)


def needs_of_fields(*fields: Field) -> tuple[str, ...]:
    """Returns all that fields ask for, see `Model.needs`."""
    return tuple(sorted({name for field in fields for name in needs_of(field.apply)}))


def apply_network(
    network: linen.Module,
    params: Any,
    x: Float[ArrayLike, "*batch samples 3"],
    viewdirs: Float[ArrayLike, "*batch #samples 3"],
    **inputs: Num[ArrayLike, "..."],
) -> tuple[Float[Array, "*batch samples"], Float[Array, "*batch samples 3"]]:
    """Evaluates a network at positions in a layout that suits a CPU's cache.

    Rows of features whose length is a multiple of 2 KiB collide in the cache, which slows down each product.
    On a CPU such a batch is padded by one ray or, if there are few rays, by a few samples per ray. An accelerator
    prefers such a batch: it divides products among its processors.

    Args:
        network: its call takes x and viewdirs, and returns [..., S] and [..., S, 3].
        params: of the network.
        x: [..., S, 3].
        viewdirs: [..., 1 or S, 3].
        **inputs: what else the network's call takes, by name: each [..., 1 or S], or a number.

    Returns:
        What the network returns, the same as without padding.
    """
    *leading, samples = shape = x.shape[:-1]
    rays = math.prod(leading)
    if not rays * samples or rays * samples % _CACHE_ROW or not is_cpu():
        return network.apply({"params": params}, x, viewdirs, **inputs)
    more = (0, _MORE_SAMPLES) if rays < _FEW_RAYS else (1, 0)

    def pad(vectors):
        size = vectors.shape[-2:]
        vectors = jnp.broadcast_to(vectors, (*leading, *size)).reshape(rays, *size)
        return jnp.pad(vectors, [(0, more[0]), (0, more[1] * (vectors.shape[1] > 1)), (0, 0)])

    padded = {name: pad(value[..., None])[..., 0] if jnp.ndim(value) else value for name, value in inputs.items()}
    outputs = network.apply({"params": params}, pad(x), pad(viewdirs), **padded)
    return tuple(value[:rays, :samples].reshape(*shape, *value.shape[2:]) for value in outputs)


class Affine(linen.Module):
    """The parameters of an affine layer."""

    features: int

    @linen.compact
    def __call__(self, size: int) -> tuple[Float[Array, "size features"], Float[Array, " features"]]:
        """Returns kernel [size, features] and bias [features]."""
        kernel = self.param("kernel", linen.initializers.glorot_uniform(), (size, self.features))
        return kernel, self.param("bias", linen.initializers.zeros_init(), (self.features,))


class Dense(Affine):
    """An affine layer on the concatenation of its inputs, which is never materialised.

    The kernel has one row for each feature of the concatenation, so parameters and initialisation are those of
    the plain layer.

    Attributes:
        dtype: of the output; None: that of the inputs.
    """

    dtype: Any = None

    def __call__(
        self,
        *inputs: Float[ArrayLike, "..."],
        before: tuple[Float[ArrayLike, "inputs E"], Float[ArrayLike, " E"]] | None = None,
    ) -> Float[Array, "features ..."]:
        """Returns [features, ...] for inputs [D_i, ...], whose axes of length 1 are broadcast.

        Args:
            *inputs: [D_i, ...].
            before: kernel [D_0, E] and bias [E] of an affine layer that is applied to the first input. As there is
                no activation between them, the two layers are multiplied into one, which costs less than
                applying both to all samples.
        """
        sizes = [value.shape[0] for value in inputs]
        if before:
            sizes[0] = before[1].size
        kernel, bias = super().__call__(sum(sizes))
        parts = jnp.split(kernel, np.cumsum(sizes)[:-1])
        if before:
            first, highest = parts[0], jax.lax.Precision.HIGHEST
            bias = bias + jnp.matmul(before[1], first, precision=highest)
            parts[0] = jnp.matmul(before[0], first, precision=highest)
        dtype = inputs[0].dtype if self.dtype is None else self.dtype
        total = bias.astype(dtype).reshape(-1, *(1,) * (inputs[0].ndim - 1))
        for rows, value in zip(parts, inputs, strict=True):
            total = total + jnp.tensordot(
                rows.astype(value.dtype), value, axes=(0, 0), preferred_element_type=self.dtype
            )
        return total


def infer_prefilter(facts: Facts) -> tuple[bool, str]:
    """Returns whether a field should know the size of a pixel's footprint at its samples, and why."""
    if facts.ndc:
        return False, "rays in normalised device coordinates have no cones"
    spread = f"the footprints of pixels differ by a factor of {facts.footprint_spread:.2g}; on from {_LEAST_SPREAD:g}"
    return facts.footprint_spread >= _LEAST_SPREAD, spread
