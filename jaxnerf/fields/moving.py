"""The field that moves: a small network displaces positions, by time, before a hash grid is evaluated there.

    density, rgb = H(x + side * d(x, t), viewdirs)

The hash grid H holds the scene at no particular time; d is 0 at first, so training starts from a scene at rest
(after arXiv:2011.13961, and arXiv:2205.15285 for a grid of features).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.core.encoding import encode_planes, planes_of
from jaxnerf.core.sampling import ONE_KEY, typed_key
from jaxnerf.core.scene import needs_of
from jaxnerf.fields import hash_grid
from jaxnerf.fields.base import WIDTH_PART, Dense, Field
from jaxnerf.fields.hash_grid import HashGridOptions
from jaxnerf.options import Ablation, Box, Device, Facts, at_least, between, infer, option
from jaxnerf.registry import Part

_MOTION = "motion"  # the entry of the parameters
_SCALE = 0.1  # of the box: a displacement of an output of 1, so that early steps move little
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
    motion_width: int = option(64, "outputs of such a layer", range=at_least(1), ablations=(WIDTH_PART,))
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
        depth: hidden layers.
        width: outputs of each.
        motion_freqs: octaves of positions.
        time_freqs: octaves of the time.
    """

    depth: int
    width: int
    motion_freqs: int
    time_freqs: int

    @linen.compact
    def __call__(self, place: Float[ArrayLike, "3 N"], time: Float[ArrayLike, " N"]) -> Float[Array, "3 N"]:
        """Returns displacements [3, N] at places and times, which are encoded from -1 to 1; fractions of the box."""
        hidden = [
            encode_planes(2 * place - 1, num_freqs=self.motion_freqs),
            encode_planes(2 * time[None] - 1, num_freqs=self.time_freqs),
        ]
        for layer in range(self.depth):
            hidden = [jax.nn.relu(Dense(self.width, name=f"layer_{layer}")(*hidden))]
        kernel = self.param("kernel", linen.initializers.zeros_init(), (self.width, 3))
        return _SCALE * jnp.tensordot(kernel, hidden[0], axes=(0, 0))


def moving_field(field: Field, motion: Motion, box: Box) -> Field:
    """Makes the Field whose positions a network displaces before another field is evaluated.

    Args:
        field: without a time of its own.
        motion: the network of displacements.
        box: lower and upper corner [3], world units, in which the field is defined.

    Returns:
        Field. apply asks for the time [..., 1 or S], beside what the other field asks for; displacements are continuous
        in x and time.
    """
    lower = np.float32(box[0])
    side = np.float32(box[1]) - lower

    def init(key):
        key = typed_key(key, ONE_KEY)
        params = motion.init(jax.random.fold_in(key, 1), jnp.zeros((3, 1)), jnp.zeros(1))["params"]
        return {**field.init(key), _MOTION: params}

    def moved(evaluate):
        def at_rest(params, x, viewdirs, time, **inputs):
            others = {name: value for name, value in params.items() if name != _MOTION}
            place = planes_of(x) - lower[:, None]
            time = jnp.broadcast_to(time, x.shape[:-1]).reshape(-1)
            offset = motion.apply({"params": params[_MOTION]}, place / side[:, None], time)
            x = x + side.reshape(*(1,) * (x.ndim - 1), 3) * jnp.moveaxis(offset, 0, -1).reshape(x.shape)
            return evaluate(others, x, viewdirs, **inputs)

        def apply(params, x, viewdirs, *, time):
            return at_rest(params, x, viewdirs, time)

        def apply_to_cones(params, x, viewdirs, *, time, radius):
            return at_rest(params, x, viewdirs, time, radius=radius)

        return apply_to_cones if "radius" in needs_of(evaluate) else apply

    ordered = field.apply_in_fixed_order
    return field._replace(
        init=init,
        apply=moved(field.apply),
        network=None,
        apply_in_fixed_order=None if ordered is None else moved(ordered),
    )


def from_options(options: MovingOptions, box: Box | None) -> Field:
    """Makes the field "moving" from its options, in the scene's box."""
    names = [each.name for each in dataclasses.fields(HashGridOptions)]
    field = hash_grid.from_options(HashGridOptions(**{name: getattr(options, name) for name in names}), box)
    if not options.motion_depth:
        return field
    motion = Motion(options.motion_depth, options.motion_width, options.motion_freqs, options.time_freqs)
    return moving_field(field, motion, box)


FIELD = Part(from_options, MovingOptions, section="moving")
