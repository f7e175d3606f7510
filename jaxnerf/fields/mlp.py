"""The paper's network: a multilayer perceptron on encoded positions and directions (Fig. 7)."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.core.encoding import encode_planes, frustum_variance, planes_of
from jaxnerf.core.sampling import ONE_KEY, normal, typed_key
from jaxnerf.fields.base import (
    PREFILTER_PART,
    VIEW_PART,
    WIDTH_PART,
    Affine,
    Dense,
    Field,
    apply_network,
    infer_prefilter,
)
from jaxnerf.options import (
    DTYPES,
    Ablation,
    Box,
    Device,
    Facts,
    Options,
    at_least,
    between,
    double,
    infer,
    is_auto,
    option,
)
from jaxnerf.registry import Part

_MAX_LAYERS = 64  # JAX compiles each layer on its own; hundreds of them take hours
_MAX_OCTAVES = 64  # of encoding.positional_encoding
_PIXELS_PER_WAVE = 4  # length of the shortest wave of the encoding
_PIXEL_SIDE = math.sqrt(3)  # at a sample, over the radius of the cone, see `pixel_radius`

DENSITY_ACTIVATIONS = {"relu": jax.nn.relu, "softplus": jax.nn.softplus}


@dataclasses.dataclass(frozen=True)
class MlpOptions(Options):
    """The options of the paper's network (Fig. 7): 595,844 parameters."""

    needs_box = False

    depth: int = option(
        8,
        "layers before the density",
        range=between(1, _MAX_LAYERS),
        ablations=(Ablation("depth of the networks", less=lambda n, *_: n // 2 or None, more=double),),
    )
    width: int = option(256, "outputs of a layer", range=at_least(1), ablations=(WIDTH_PART,))
    skip_layer: int = option(
        4, "index of the layer after which the encoded position is concatenated again", range=at_least(0)
    )
    view_width: int = option(
        128, "outputs of the layer that takes the direction", range=at_least(1), ablations=(WIDTH_PART,)
    )
    num_freqs: int = option(
        10,
        "octaves of the position's encoding",
        range=between(0, _MAX_OCTAVES),
        auto=True,
        ablations=(Ablation("octaves", less=lambda n, *_: n - 2 if n > 2 else None, more=lambda n, *_: n + 2),),
    )
    num_view_freqs: int = option(4, "octaves of the direction's encoding", range=between(0, _MAX_OCTAVES))
    encode: bool = option(
        True,
        "whether position and direction have a positional encoding",
        ablations=(Ablation("positional encoding", without=False, more=True),),
    )
    prefilter: bool = option(
        False,
        "Whether the position's encoding is its mean over the part of the pixel's cone around a sample (integrated "
        "positional encoding, arXiv:2103.13415), taken to be no shorter than the pixel is wide there. The network also "
        "reads what the mean leaves of each octave. auto: as for `hash_grid.prefilter`.",
        auto=True,
        ablations=(PREFILTER_PART,),
    )
    use_viewdirs: bool = option(True, "whether colour depends on the direction", ablations=(VIEW_PART,))
    density_activation: str = option("relu", "activation of the density", choices=tuple(sorted(DENSITY_ACTIVATIONS)))
    density_bias: float = option(0.0, "added to the density before its activation")
    compute_dtype: str = option(
        "float32", "type of the numbers in the layers; `float64` requires JAX_ENABLE_X64=1", choices=DTYPES
    )

    def resolve(self, facts: Facts, device: Device) -> tuple["MlpOptions", list[str]]:
        """Infers the octaves from the size of a pixel, and whether they are averaged from the spread of the sizes."""
        octaves = 1 + math.log2(2 * math.pi / (_PIXELS_PER_WAVE * facts.footprint))
        octaves = min(max(round(octaves), 1), 16)
        line = f"octaves       {octaves} in {{section}}; the shortest wave is four pixels long"
        prefilter, why = infer_prefilter(facts)
        if not self.encode:
            prefilter, why = False, "positions have no encoding"
        return infer(
            self,
            num_freqs=(octaves, line),
            prefilter=(prefilter, f"prefilter     {'on' if prefilter else 'off'} in {{section}}: {why}"),
        )

    def check(self, box: Box | None = None) -> None:
        if self.compute_dtype == "float64" and not jax.config.jax_enable_x64:
            raise ValueError("compute_dtype is 'float64', which requires the environment's JAX_ENABLE_X64=1")
        if self.prefilter and not is_auto(self.prefilter) and not self.encode:
            raise ValueError("prefilter is True and encode False, which leaves no encoding to average; set one of them")

    def bytes_needed(self, box: Box | None) -> dict[str, float]:
        """Returns those of parameters, gradients and the optimizer, at least."""
        return {"width": 16 * self.width * (self.width * self.depth + self.view_width)}


def mlp_field(**options: Any) -> Field:
    """Makes a Field of the paper's network.

    Args:
        **options: of `MlpOptions`; the defaults are those of the paper, with 595,844 parameters. compute_dtype may be
            a type, too.

    Returns:
        Field. apply(params, x [..., S, 3], viewdirs [..., 1 or S, 3], key=None, density_noise=0.0)
        returns density [..., S] in 1 / world unit and rgb [..., S, 3] in [0, 1], both float32.
        With a key (one, or one per ray) normal noise of that standard deviation is added to the density
        before its activation, the paper's regulariser for real scenes. With prefilter, apply asks for the radius and
        the length [..., 1 or S] at each sample, too, see `cone_variance`.

    Raises:
        ValueError: if density_activation is unknown.
    """
    try:
        network = MlpOptions(**options)
    except TypeError as error:
        raise TypeError(str(error).replace("MlpOptions.__init__()", "mlp_field()")) from None
    return from_options(network, None)


def from_options(options: MlpOptions, box: Box | None) -> Field:
    """Makes the field "mlp" from its options; it needs no box."""
    del box
    if options.density_activation not in DENSITY_ACTIVATIONS:
        raise ValueError(
            f"mlp_field: density_activation is {options.density_activation!r}, expected one of "
            f"{sorted(DENSITY_ACTIVATIONS)}"
        )
    network, activation = MLP(options), DENSITY_ACTIVATIONS[options.density_activation]

    def init(key):
        inputs = dict.fromkeys(("radius", "length"), jnp.zeros((1, 1))) if options.prefilter else {}
        return network.init(typed_key(key, ONE_KEY), jnp.zeros((1, 1, 3)), jnp.zeros((1, 1, 3)), **inputs)["params"]

    def apply(params, x, viewdirs, *, key=None, density_noise=0.0):
        return evaluate(params, x, viewdirs, key, density_noise)

    def apply_to_cones(params, x, viewdirs, *, radius, length, key=None, density_noise=0.0):
        return evaluate(params, x, viewdirs, key, density_noise, radius=radius, length=length)

    def evaluate(params, x, viewdirs, key, density_noise, **inputs):
        inputs = {name: jnp.broadcast_to(value, x.shape[:-1]) for name, value in inputs.items()}
        density, rgb = apply_network(network, params, x, viewdirs, **inputs)
        if key is not None and density_noise:
            density = density + density_noise * normal(key, density.shape)
        return activation(density + options.density_bias), jax.nn.sigmoid(rgb)

    layers = (0, options.skip_layer + 1) if options.skip_layer + 1 < options.depth else (0,)
    color_layers = ("view",) if options.use_viewdirs else ("rgb",)
    scene = apply_to_cones if options.prefilter else apply
    input_layers = tuple(f"trunk_{layer}" for layer in layers)
    return Field(init, scene, input_layers, color_layers=color_layers)


FIELD = Part(from_options, MlpOptions, section="fine")


class MLP(linen.Module):
    """Fully connected layers with one skip connection from the encoded position, and a small head for colour.

    Attributes:
        options: its sizes. With prefilter the position's encoding is the `integrated_encoding` over the cone at each
            sample, of the variance `cone_variance`, followed by the `damping_of_octaves`; radius and length are inputs,
            too. Without use_viewdirs there is no bottleneck and no view layer. Outputs are at least float32.
    """

    options: MlpOptions

    @linen.compact
    def __call__(
        self,
        x: Float[ArrayLike, "*batch samples 3"],
        viewdirs: Float[ArrayLike, "*batch #samples 3"],
        radius: Float[ArrayLike, "*batch samples"] | None = None,
        length: Float[ArrayLike, "*batch samples"] | None = None,
    ) -> tuple[Float[Array, "*batch samples"], Float[Array, "*batch samples 3"]]:
        """Returns density [..., S] and rgb [..., S, 3] before their activations.

        Arrays inside are [features, N], so that the encoding and all three products of a layer's forward and
        backward pass read memory contiguously. A small network on a CPU gains most from this.
        """
        options, shape, compute_dtype = self.options, x.shape[:-1], jnp.dtype(self.options.compute_dtype)
        num_freqs = options.num_freqs * options.encode
        variance = planes_of(cone_variance(viewdirs, radius, length)) if options.prefilter else None
        encoded = encode_planes(planes_of(x), num_freqs=num_freqs, variance=variance)
        if options.prefilter:
            encoded = jnp.concatenate([encoded, damping_of_octaves(variance.mean(axis=0), num_freqs)])
        encoded = encoded.astype(compute_dtype)
        hidden = ()
        for layer in range(options.depth):
            joins = layer == 0 or layer == options.skip_layer + 1
            inputs = ((encoded,) if joins else ()) + hidden
            hidden = (jax.nn.relu(Dense(options.width, name=f"trunk_{layer}")(*inputs)),)
        dtype = jnp.promote_types(jnp.float32, compute_dtype)
        density = Dense(1, name="density")(*hidden).astype(dtype).reshape(shape)
        if options.use_viewdirs:
            # The direction is encoded and multiplied once per ray, and broadcast over its samples.
            directions = encode_planes(planes_of(viewdirs), num_freqs=options.num_view_freqs * options.encode)
            directions = directions.astype(compute_dtype).reshape(len(directions), *viewdirs.shape[:-1])
            bottleneck = Affine(options.width, name="bottleneck")(options.width)
            features = hidden[0].reshape(options.width, *shape)
            view = Dense(options.view_width, name="view")(features, directions, before=bottleneck)
            hidden = (jax.nn.relu(view).reshape(options.view_width, -1),)
        rgb = Dense(3, name="rgb")(*hidden).astype(dtype)
        return density, jnp.moveaxis(rgb.reshape(3, *shape), 0, -1)


def cone_variance(
    viewdirs: Float[ArrayLike, "*batch #samples 3"],
    radius: Float[ArrayLike, "*batch samples"],
    length: Float[ArrayLike, "*batch samples"],
) -> Float[Array, "*batch samples 3"]:
    """Computes the `frustum_variance` [..., S, 3] of samples that are no shorter than the pixel is wide.

    The side of the pixel at the sample is sqrt(3) times the radius. The Gaussian of a shorter sample would be flat, and
    another one for each direction of the ray, so that the network would have to learn a surface for all of them. As
    long as the pixel is wide, it is a ball with the variance of the pixel, the same for all directions.
    """
    return frustum_variance(viewdirs, radius, jnp.maximum(length, _PIXEL_SIDE * radius))


def damping_of_octaves(variance: Float[ArrayLike, " N"], num_freqs: int) -> Float[Array, "F N"]:
    """Computes what the mean over a Gaussian leaves of the waves of each octave, exp(-4^k variance / 2).

    A wave that is small in the encoding may be averaged away or near its zero; with this the network can tell.

    Args:
        variance: [N] at least 0.
        num_freqs: F octaves.
    """
    octaves = np.float32(2.0 ** np.arange(num_freqs))[:, None]
    return jnp.exp(-0.5 * octaves**2 * variance[None])
