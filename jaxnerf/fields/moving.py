"""The field that moves: a small network displaces positions, by time, before a hash grid is evaluated there.

    density, rgb = H(x + side * d(x, t), viewdirs, c(x, t))

The hash grid H holds the scene at no particular time; d is 0 at first, so training starts from a scene at rest
(arXiv:2011.13961). The network of densities also reads c, the last hidden layer of the network of d (after
arXiv:2205.15285), so that matter may appear or vanish where no displacement brings it.

Displacements follow the gradient of the coarser half of H's levels alone: that of the finer ones leads to matter that
fits by chance, as where cameras are refined (arXiv:2104.06405).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.core.encoding import encode_planes, planes_of
from jaxnerf.fields import hash_grid
from jaxnerf.fields.base import WIDTH_PART, Dense, Field
from jaxnerf.fields.hash_grid import HashGrid, HashGridOptions
from jaxnerf.options import Ablation, Box, Device, Facts, at_least, between, infer, option
from jaxnerf.registry import Part

_SCALE = 0.01  # of the box: a displacement of an output of 1, so that a step moves matter by little
_DEPTH = 2


@dataclasses.dataclass(frozen=True)
class MovingOptions(HashGridOptions):
    """The options of the field that moves: those of its hash grid, and of the network of displacements."""

    motion_depth: int = option(
        "auto",
        "hidden layers of the network of displacements; 0: nothing moves. auto: 2 where images have times, else 0",
        range=between(0, 16),
        auto=True,
        ablations=(Ablation("motion", without=0),),
    )
    motion_width: int = option(32, "outputs of such a layer", range=at_least(1), ablations=(WIDTH_PART,))
    motion_freqs: int = option(4, "octaves of the encoding of positions in it", range=between(0, 16))
    time_freqs: int = option(4, "octaves of the encoding of time in it", range=between(0, 16))

    def resolve(self, facts: Facts, device: Device) -> tuple["MovingOptions", list[str]]:
        """Infers what a hash grid infers, and whether anything moves."""
        options, lines = super().resolve(facts, device)
        depth = _DEPTH if facts.has_times else 0
        why = "images have times" if depth else "off, as images have no times: the field is a hash grid"
        options, more = infer(options, motion_depth=(depth, f"motion        {why}"))
        return options, lines + more


class Motion(linen.Module):
    """The network of displacements.

    Attributes:
        options: its sizes.
    """

    options: MovingOptions

    @linen.compact
    def __call__(
        self, place: Float[ArrayLike, "3 N"], time: Float[ArrayLike, " N"]
    ) -> tuple[Float[Array, "3 N"], Float[Array, "D N"]]:
        """Returns displacements [3, N], fractions of the box, at places and times from 0 to 1; and the last layer."""
        options = self.options
        hidden = [
            encode_planes(2 * place - 1, num_freqs=options.motion_freqs),
            encode_planes(2 * time[None] - 1, num_freqs=options.time_freqs),
        ]
        for layer in range(options.motion_depth):
            hidden = [jax.nn.relu(Dense(options.motion_width, name=f"layer_{layer}")(*hidden))]
        kernel = self.param("kernel", linen.initializers.zeros_init(), (options.motion_width, 3))
        return _SCALE * jnp.tensordot(kernel, hidden[0], axes=(0, 0)), hidden[0]


class MovingHashGrid(HashGrid):
    """A hash grid that is evaluated at displaced positions; its options are MovingOptions."""

    @linen.compact
    def __call__(
        self,
        x: Float[ArrayLike, "*batch samples 3"],
        viewdirs: Float[ArrayLike, "*batch #samples 3"],
        radius: Float[ArrayLike, "*batch samples"] | None = None,
        *,
        time: Float[ArrayLike, "*batch samples"],
    ) -> tuple[Float[Array, "*batch samples"], Float[Array, "*batch samples 3"]]:
        """Returns density [..., S] and rgb [..., S, 3] before their activations."""
        lower = np.float32(self.lower)
        side = np.float32(self.upper) - lower
        place = (planes_of(x) - lower[:, None]) / side[:, None]
        offset, code = Motion(self.options, name="motion")(place, time.reshape(-1))
        offset = jnp.moveaxis(side[:, None] * offset, 0, -1).reshape(x.shape)
        return super().__call__(x + offset, viewdirs, radius, code, x + jax.lax.stop_gradient(offset))


def _scene_of(network):
    """Returns the function `apply` of a MovingHashGrid's Field."""

    def apply(params, x, viewdirs, *, time):
        return hash_grid.evaluate(network, params, x, viewdirs, time=time)

    def apply_to_cones(params, x, viewdirs, *, radius, time):
        return hash_grid.evaluate(network, params, x, viewdirs, radius=radius, time=time)

    return apply_to_cones if network.options.prefilter else apply


def from_options(options: MovingOptions, box: Box | None) -> Field:
    """Makes the field "moving" from its options, in the scene's box; it asks for time unless nothing moves."""
    field = hash_grid.from_options(options, box)
    if not options.motion_depth:
        return field
    return hash_grid.network_field(MovingHashGrid(*box, options), _scene_of)._replace(network=None)


FIELD = Part(from_options, MovingOptions, section="moving")
