"""An example of a field that asks for more: the paper's network with integrated positional encoding (mip-NeRF).

A pixel sees a cone, not a ray. The field asks for the cone's radius and the length of the interval around each sample,
and replaces sin and cos of the position by their expected values there (arXiv:2103.13415): detail that is finer than
the cone is averaged away, so an image of lower resolution than those of training is smooth instead of aliased. The
option `fine.prefilter` of the field `mlp` does this, too, but its frustum is no shorter than the pixel is wide there,
and the network also reads what the mean leaves of each octave.

Train with it by

    jaxnerf-train --plugins=cone_field --config=embedded_small --config.field=cone --config.sampling.num_fine=0 \\
        --workdir=runs/cone

where cone_field.py is in the current folder or on PYTHONPATH; `--config.cone.width=128` sets an option. To render well
at several resolutions, the field must see them in training: call `jaxnerf.train_and_evaluate(config, workdir,
views=multi_scale(views))` with the Views of the split "train".
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen

import jaxnerf
from jaxnerf.core.views import pixel_colors
from jaxnerf.extend import Field, Options, at_least, between, option


@dataclasses.dataclass(frozen=True)
class ConeOptions(Options):
    """The options of the field: the config's section `cone`."""

    depth: int = option(8, "layers before the density", range=between(1, 64))
    width: int = option(256, "outputs of a layer", range=at_least(1))
    skip_layer: int = option(4, "layer after which the encoded position is concatenated again", range=at_least(0))
    num_freqs: int = option(10, "octaves of the position's encoding", range=between(0, 64))
    num_view_freqs: int = option(4, "octaves of the direction's encoding", range=between(0, 64))


def make_cone_field(options, box):
    """Makes the field from its options; it needs no box."""
    del box
    network = ConeNetwork(**dataclasses.asdict(options))

    def init(key):
        ray, one = jnp.zeros((1, 1, 3)), jnp.zeros((1, 1))
        return network.init(key, ray, ray, one, one)["params"]

    def apply(params, x, viewdirs, *, radius, length):
        """Evaluates the field: the keyword-only names are what it asks for, each [..., S] in world units."""
        return network.apply({"params": params}, x, viewdirs, radius, length)

    return Field(init, apply)


class ConeNetwork(linen.Module):
    """The paper's layers: density from the encoded position, colour from that and the encoded direction."""

    depth: int
    width: int
    skip_layer: int
    num_freqs: int
    num_view_freqs: int

    @linen.compact
    def __call__(self, x, viewdirs, radius, length):
        variance = jaxnerf.frustum_variance(viewdirs, radius, length)
        encoded = hidden = jaxnerf.integrated_encoding(x, variance, num_freqs=self.num_freqs, include_input=False)
        for layer in range(self.depth):
            hidden = jax.nn.relu(linen.Dense(self.width)(hidden))
            if layer == self.skip_layer:
                hidden = jnp.concatenate([hidden, encoded], axis=-1)
        density = jax.nn.softplus(linen.Dense(1)(hidden)[..., 0] - 1)  # in 1 / world unit
        seen_from = jaxnerf.positional_encoding(viewdirs, num_freqs=self.num_view_freqs)
        seen_from = jnp.broadcast_to(seen_from, (*x.shape[:-1], seen_from.shape[-1]))
        view = jnp.concatenate([linen.Dense(self.width)(hidden), seen_from], axis=-1)
        view = jax.nn.relu(linen.Dense(self.width // 2)(view))
        return density, jax.nn.sigmoid(linen.Dense(3)(view))


def shrunk(views, factor):
    """Returns Views, of one size, with images averaged over factor x factor pixels and composited over white."""
    count, (height, width) = len(views.size), views.size[0] // factor
    rgb = np.asarray(pixel_colors(views.pixels, views.background)).reshape(count, height, factor, width, factor, 3)
    rgba = np.pad(rgb.mean((2, 4)).reshape(-1, 3), ((0, 0), (0, 1)), constant_values=1)
    focal, center = (np.asarray(each) / factor for each in (views.cameras.focal, views.cameras.center))
    cameras = dataclasses.replace(views.cameras, focal=focal, center=center, height=int(height), width=int(width))
    return dataclasses.replace(
        views,
        pixels=np.uint16(np.rint(65535 * rgba)),
        offset=np.arange(count, dtype=np.int32) * np.int32(height * width),
        size=np.tile(np.int32([[height, width]]), (count, 1)),
        cameras=cameras,
    )


def multi_scale(views, factors=(1, 2, 4)):
    """Returns Views with each image at several resolutions; smaller ones are repeated, so that as many rays see each.

    The radius of a ray follows from its camera's focal length in px, so nothing else has to say which scale it is of.
    """
    parts = [shrunk(views, factor) for factor in factors for _ in range(factor**2)]
    counts = [len(part.pixels) for part in parts]
    starts = np.cumsum([0, *counts[:-1]])

    def joined(name, of=lambda part: part):
        return np.concatenate([getattr(of(part), name) for part in parts])

    arrays = {name: joined(name, lambda part: part.cameras) for name in ("to_world", "focal", "center")}
    return dataclasses.replace(
        views,
        **{name: joined(name) for name in ("pixels", "size", "near", "far")},
        offset=np.concatenate([part.offset + np.int32(start) for part, start in zip(parts, starts, strict=True)]),
        cameras=dataclasses.replace(views.cameras, **arrays, height=None, width=None),
        names=tuple(f"{name}_{index}" for index, part in enumerate(parts) for name in part.names),
    )


jaxnerf.register_field("cone", make_cone_field, options=ConeOptions)
