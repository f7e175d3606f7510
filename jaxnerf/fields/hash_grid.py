"""The hash grid: features at the vertices of several levels, decoded by two small networks."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.core.safe_math import clamp, divide
from jaxnerf.core.sampling import ONE_KEY, typed_key
from jaxnerf.core.scene import needs_of
from jaxnerf.core.types import Vector
from jaxnerf.fields.base import PREFILTER_PART, VIEW_PART, WIDTH_PART, Dense, Field, apply_network, infer_prefilter
from jaxnerf.fields.hash_interpolation import TableLevel, interpolate, stored, transposed_product
from jaxnerf.options import Ablation, Box, Changes, Device, Facts, Options, at_least, between, infer, is_auto, option
from jaxnerf.registry import Loss, Part

_glorot = linen.initializers.glorot_uniform()

GEOMETRY_FEATURES = 15  # outputs of the density network that the colour network reads, as in arXiv:2201.05989
FEATURE_SCALE = 4.0  # features over table entries: a step reaches few entries, so each should change more

_COMPUTE_DTYPES = {"float32": None, "bfloat16": jnp.bfloat16}
_LARGEST_EXPONENT = 15.0  # a density that is opaque within 1e-5 world units
# The sigmoid has this slope at this logit, where its value is 0.001 from 1: a quarter of an 8-bit level.
_END_SLOPE, _END_LOGIT = 1e-3, 6.9
_ERF_IS_1 = 4.0  # erf(4) = 1 - 1.5e-8, which float32 rounds to 1

_MAX_LEVELS = _MAX_LAYERS = 64  # JAX compiles each layer on its own; hundreds of them take hours
_FINEST = (32, 256)  # vertices along the longest side, minimum and maximum, of the last of four levels
# Contracted space, whose box is larger, gets one level more, and so do fine occupancy grids and images of at least
# _FIVE_LEVELS_SIDE px a side.
_LEVELS, _FIVE_LEVELS_SIDE = 4, 600
# Rows of a level per pixel of an image's side; finer images show what collisions of the hash cost.
_ROWS_PER_PIXEL, _MIN_ROWS, _MAX_ROWS = 1311, 2**17, 2**20
_LARGE_TABLE = 2**19  # rows of a level, from which on an update of the table takes as long as half of the step's rays
# With fine cells a third layer for the colour costs 7 % of a step's time, with others a quarter
# (docs/results/settings.md).
_FINE_DEPTH, _DEPTH = 3, 2
# A larger table and wider networks take little time on an accelerator: each gained 0.3 dB for lego at 800 x 800 on an
# H200 (docs/guides/accelerators.md).
_CPU_WIDTH, _ACCELERATOR_WIDTH, _ACCELERATOR_ROWS = 64, 128, 4


_LEVELS_PART = Ablation(
    "levels",
    less=lambda levels, *_: levels[:-1] or None,
    more=lambda levels, *_: (*levels, 2 * levels[-1]) if len(levels) < _MAX_LEVELS and levels[-1] < 2**19 else None,
)
_ROWS_PART = Ablation(  # a level with fewer vertices has no more rows than these
    "rows of the table",
    less=lambda rows, options, _: rows // 2 if 1 < rows < 2 * options.resolutions[-1] ** 3 else None,
    more=lambda rows, options, _: 2 * rows if rows < options.resolutions[-1] ** 3 else None,
)


def _wrong_levels(levels):
    right = 0 < len(levels) <= _MAX_LEVELS and all(isinstance(each, int) and 2 <= each <= 2**20 for each in levels)
    return None if right else f"1 to {_MAX_LEVELS} whole numbers, each from 2 to 2^20"


@dataclasses.dataclass(frozen=True)
class HashGridOptions(Options):
    """The options of the hash grid."""

    resolutions: tuple[int, ...] = option(
        "auto",
        "vertices along the longest side, one number per level",
        auto=True,
        check=_wrong_levels,
        ablations=(_LEVELS_PART,),
    )
    features_per_level: int = option(4, "features of a vertex", range=at_least(1))
    table_size: int = option(
        2**17,
        "maximal rows per level; a level with more vertices is hashed. auto: 2^17 to 2^20, in proportion to an "
        "image's side; four times as many on an accelerator",
        range=at_least(1),
        auto=True,
        ablations=(_ROWS_PART,),
    )
    width: int = option(
        64,
        "outputs of a hidden layer of the density network; auto: 64 on a CPU, 128 on an accelerator",
        range=at_least(1),
        auto=True,
        ablations=(WIDTH_PART,),
    )
    view_depth: int = option(
        2,
        "hidden layers of the colour network; auto: 3 on a CPU where the occupancy grid has fine cells, else 2",
        range=between(0, _MAX_LAYERS),
        auto=True,
        ablations=(
            Ablation("depth of the networks", less=lambda n, *_: n // 2 if n else None, more=lambda n, *_: n + 1),
        ),
    )
    view_width: int = option(
        128,
        "outputs of a hidden layer of the colour network; auto: as `width`",
        range=at_least(1),
        auto=True,
        ablations=(WIDTH_PART,),
    )
    use_viewdirs: bool = option(True, "whether colour depends on the direction", ablations=(VIEW_PART,))
    prefilter: bool = option(
        "auto",
        "Whether the features of cells that are smaller than a pixel's footprint are damped (arXiv:2304.06706, Eq. 6). "
        "auto: where the footprints of the training images differ by 4 or more.",
        auto=True,
        ablations=(PREFILTER_PART,),
    )
    compute_dtype: str = option(
        "auto",
        "type of the numbers in the networks' layers; all else is float32",
        choices=tuple(_COMPUTE_DTYPES),
        auto=True,
        changes=Changes.SPEED | Changes.IMAGES,
    )

    def resolve(self, facts: Facts, device: Device) -> tuple["HashGridOptions", list[str]]:
        """Infers levels from what images resolve, rows from their size, and widths from the device.

        Whether features are damped follows from the footprints of the images.
        """
        more = int(facts.contracted or facts.has_fine_cells or facts.side >= _FIVE_LEVELS_SIDE)
        vertices = min(max(facts.detail, _FINEST[0]), _FINEST[1] << more)
        levels = tuple(max(vertices // 2**level, 2) for level in reversed(range(_LEVELS + more)))
        rows = 2 ** round(math.log2(min(max(_ROWS_PER_PIXEL * facts.side, _MIN_ROWS), _MAX_ROWS)))
        rows, width = (rows, _CPU_WIDTH) if device.is_cpu else (_ACCELERATOR_ROWS * rows, _ACCELERATOR_WIDTH)
        size = f"{facts.side:.0f} x {facts.side:.0f} px"
        prefilter, why = infer_prefilter(facts)
        depth = _FINE_DEPTH if device.is_cpu and facts.has_fine_cells else _DEPTH
        per_layer = f"hash grid     {width} outputs per hidden layer of the {{}} network, for this device"
        return infer(
            self,
            resolutions=(levels, f"hash grid     {levels} vertices along the longest side"),
            table_size=(rows, f"hash grid     at most {rows:,} rows per level, for images of about {size}"),
            width=(width, per_layer.format("density")),
            view_width=(width, per_layer.format("colour")),
            view_depth=(depth, f"hash grid     {depth} hidden layers of the colour network"),
            prefilter=(prefilter, f"prefilter     {'on' if prefilter else 'off'}: {why}"),
        )

    def resolve_for_device(self, device: Device) -> tuple["HashGridOptions", list[str]]:
        """Infers the precision of the layers."""
        dtype = "float32" if device.is_cpu else "bfloat16"
        line = f"precision     {dtype} in the layers of the hash grid's networks, for this device"
        return infer(self, compute_dtype=(dtype, line))

    def bytes_needed(self, box: Box | None) -> dict[str, float]:
        """Returns those of parameters, gradients and the optimizer, at least."""
        table, width, view_width, view_depth = (
            1 if is_auto(value) else value for value in (self.table_size, self.width, self.view_width, self.view_depth)
        )
        levels = None if is_auto(self.resolutions) else self.resolutions
        rows = table if levels is None else sum(min(table, level**3) for level in levels)
        inputs = self.features_per_level * len(levels or [1])
        return {
            "table_size": 12 * rows * self.features_per_level,  # one moment, see `train.table_momentum`
            "width": 16 * width * (inputs + 1 + GEOMETRY_FEATURES),
            "view_width": 16 * view_width * view_width * max(view_depth - 1, 0),
        }

    @property
    def is_large(self) -> bool:
        """Whether an update of the table takes as long as half of the rays of a step."""
        return self.table_size >= _LARGE_TABLE


def hash_grid_field(**options: Any) -> Field:
    """Makes a Field of multi-resolution features (after arXiv:2201.05989).

    Args:
        **options: lower and upper, [3] world units, opposite corners of the box; and options of `HashGridOptions`, in
            place of four levels of 16 to 128 vertices without prefilter. compute_dtype may be a type, too; None: that
            of the parameters.

    Returns:
        Field. apply(params, x [..., S, 3], viewdirs [..., 1 or S, 3]) returns density [..., S] in
        1 / world unit, an exponential of at most e^15, and rgb [..., S, 3] in [0, 1], both float32.
        Outside the box the values are those of the nearest point inside. With prefilter, apply asks for the radius
        [..., 1 or S] of the cone at each sample, too, see `damping`.

    Raises:
        ValueError: if the box is empty, or a level has fewer than 2 vertices along its longest side.
    """
    if missing := [repr(name) for name in ("lower", "upper") if name not in options]:
        names = " and ".join(missing)
        raise TypeError(f"hash_grid_field() missing {len(missing)} required keyword-only arguments: {names}")
    box = options.pop("lower"), options.pop("upper")
    usual = {"resolutions": (16, 32, 64, 128), "prefilter": False, "compute_dtype": None}
    try:
        chosen = HashGridOptions(**{**usual, **options})
    except TypeError as error:
        raise TypeError(str(error).replace("HashGridOptions.__init__()", "hash_grid_field()")) from None
    return from_options(chosen, box)


def from_options(options: HashGridOptions, box: Box | None) -> Field:
    """Makes the field "hash_grid" from its options, in the scene's box."""
    if box is None:
        raise ValueError(
            "scene.lower or scene.upper is 'auto', expected the scene's box; resolve the config, or set both"
        )
    lower, upper = (np.asarray(corner, float) for corner in box)
    if lower.shape != (3,) or upper.shape != (3,) or not (lower < upper).all():
        raise ValueError(f"hash_grid_field: the box is {box[0]} to {box[1]}, expected lower < upper")
    resolutions = tuple(options.resolutions)
    if min(resolutions, default=0) < 2:
        raise ValueError(f"hash_grid_field: resolutions are {resolutions}, expected at least one, each at least 2")
    return network_field(HashGrid(*box, options), _scene_of)


def network_field(network: "HashGrid", scene_of: Callable[["HashGrid"], Callable[..., Any]]) -> Field:
    """Makes the Field of a network whose function `apply` another one makes, by `evaluate`."""
    inputs = {name: jnp.zeros((1, 1)) for name in needs_of(scene_of(network))}

    def init(key):
        return network.init(typed_key(key, ONE_KEY), jnp.zeros((1, 1, 3)), jnp.zeros((1, 1, 3)), **inputs)["params"]

    return Field(
        init,
        scene_of(network),
        regularizers={"total_variation": functools.partial(total_variation, levels=network.levels())},
        color_layers=("view_0",) if network.options.view_depth else ("rgb",),
        network=network,
        apply_in_fixed_order=scene_of(network.clone(fixed_order=True)),
    )


def evaluate(
    network: "HashGrid",
    params: Any,
    x: Float[ArrayLike, "*batch samples 3"],
    viewdirs: Float[ArrayLike, "*batch #samples 3"],
    **inputs: Float[ArrayLike, "*batch #samples"],
) -> tuple[Float[Array, "*batch samples"], Float[Array, "*batch samples 3"]]:
    """Returns density and colour of a network, after their activations; inputs: what else its call takes."""
    inputs = {name: jnp.broadcast_to(value, x.shape[:-1]) for name, value in inputs.items()}
    density, rgb = apply_network(network, params, x, viewdirs, **inputs)
    return jnp.exp(jnp.minimum(density, _LARGEST_EXPONENT)), color_activation(rgb)


def _scene_of(network):
    """Returns the function `apply` of a HashGrid's Field."""

    def apply_to_rays(params, x, viewdirs):
        return evaluate(network, params, x, viewdirs)

    def apply_to_cones(params, x, viewdirs, *, radius):
        return evaluate(network, params, x, viewdirs, radius=radius)

    return apply_to_cones if network.options.prefilter else apply_to_rays


FIELD = Part(from_options, HashGridOptions, section="hash_grid")


@jax.custom_jvp
def color_activation(logits: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
    """Computes the sigmoid, with a derivative that vanishes slowly at both ends.

    The logits of a scene that is mostly white or black grow within some hundred steps until the sigmoid is exactly
    1 or 0 in float32, also where the scene is not white or black. Its own derivative s (1 - s) is then 0, and colour
    is never learnt. Where the value is within 0.001 of 0 or 1, the derivative is therefore at least
    0.001 (6.9 / logit)^2. With a constant bound, a few colours that should be above 1 would push their logits, and with
    them all weights, to any size: the gradient of a weight is the derivative times an activation, which grows with
    the logit. The values and the signs of derivatives stay. A wider range, (1 + 2 e) s - e (arXiv:2103.13415), does
    not help: its derivative vanishes, too.

    Args:
        logits: [...].

    Returns:
        [...] in [0, 1].
    """
    return jax.nn.sigmoid(logits)


@color_activation.defjvp
def _color_activation_jvp(primals, tangents):
    value = color_activation(*primals)
    least = _END_SLOPE * (_END_LOGIT / jnp.maximum(jnp.abs(primals[0]), _END_LOGIT)) ** 2
    return value, jnp.maximum(value * (1 - value), least) * tangents[0]


class HashGrid(linen.Module):
    """Interpolated features, a network for the density's logarithm, and one for colour (arXiv:2201.05989).

    Attributes:
        lower: [3] world units, a corner of the box.
        upper: [3] world units, the opposite corner.
        options: its sizes. With prefilter the features of each level are multiplied by its `damping`, and the radius is
            an input, too. Parameters, interpolation and outputs keep the precision of the table.
        fixed_order: see `interpolate`.
    """

    lower: Sequence[float]
    upper: Sequence[float]
    options: HashGridOptions
    fixed_order: bool = False

    @linen.nowrap
    def levels(self) -> tuple[TableLevel, ...]:
        """Returns the levels of the table."""
        side = np.asarray(self.upper, np.float32) - np.asarray(self.lower, np.float32)
        sizes = [vertices(side, resolution) for resolution in self.options.resolutions]
        ends = np.cumsum([0] + [min(np.prod(size), self.options.table_size) for size in sizes]).tolist()
        return tuple(TableLevel(size, range(*rows)) for size, rows in zip(sizes, itertools.pairwise(ends), strict=True))

    @linen.compact
    def __call__(
        self,
        x: Float[ArrayLike, "*batch samples 3"],
        viewdirs: Float[ArrayLike, "*batch #samples 3"],
        radius: Float[ArrayLike, "*batch samples"] | None = None,
        code: Float[ArrayLike, "D N"] | None = None,
        fixed: Float[ArrayLike, "*batch samples 3"] | None = None,
    ) -> tuple[Float[Array, "*batch samples"], Float[Array, "*batch samples 3"]]:
        """Returns density [..., S] and rgb [..., S, 3] before their activations; arrays inside are [features, N].

        A code [D, N] is read by a further layer of the density network. Fixed positions [..., S, 3], equal to x with
        another derivative, are those of the finer half of the levels.
        """
        options, shape = self.options, x.shape[:-1]
        dtype = _COMPUTE_DTYPES.get(options.compute_dtype, options.compute_dtype)

        def rounded(value):
            return value if dtype is None else value.astype(dtype)

        side = np.asarray(self.upper, np.float32) - np.asarray(self.lower, np.float32)
        levels = self.levels()
        half = len(levels) if fixed is None else (len(levels) + 1) // 2
        halves = [(x, levels[:half]), (fixed, levels[half:])]
        # All levels share a table, so there is only one gradient to clear and one array to update.
        table = self.param("table", _near_zero, (levels[-1].rows.stop, options.features_per_level))
        parts = [
            interpolate(
                table,
                stored([(at[..., i].reshape(-1) - self.lower[i]) / side[i] for i in range(3)]),
                some,
                fixed_order=self.fixed_order,
            )
            for at, some in halves
            if some
        ]
        features = FEATURE_SCALE * (parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=-1))
        if options.prefilter:
            cells = [float((side / (np.array(level.size) - 1)).max()) for level in levels]
            left = jnp.stack([damping(radius.reshape(-1), cell) for cell in cells], axis=-1)
            damped = features * jnp.repeat(left, options.features_per_level, axis=-1)
            features = jnp.concatenate([damped, left], axis=-1)
        features = rounded(features)
        kernel = self.param("kernel", _glorot, (features.shape[-1], options.width))
        bias = self.param("bias", linen.initializers.zeros_init(), (options.width,))
        kernel, bias = rounded(kernel), rounded(bias)
        hidden = jax.nn.relu(transposed_product(kernel, features) + bias[:, None])
        if code is not None:
            hidden = jax.nn.relu(Dense(options.width, name="code")(hidden, rounded(code)))
        # The logarithm of a density is up to 15, where bfloat16 has steps of 1/16.
        outputs = {"dtype": None if dtype is None else table.dtype}
        geometry = Dense(1 + GEOMETRY_FEATURES, name="density", **outputs)(hidden)
        density, hidden = geometry[0], rounded(geometry[1:])
        if options.use_viewdirs:
            directions = jnp.broadcast_to(harmonics(viewdirs), (*shape, 9))
            hidden = jnp.concatenate([hidden, rounded(directions.reshape(-1, 9).T)])
        for layer in range(options.view_depth):
            hidden = jax.nn.relu(Dense(options.view_width, name=f"view_{layer}")(hidden))
        rgb = Dense(3, name="rgb", **outputs)(hidden)
        return density.reshape(shape), jnp.moveaxis(rgb.reshape(3, *shape), 0, -1)


def vertices(side: Vector, resolution: int) -> tuple[int, int, int]:
    """Returns the number of vertices along each side [3] of a box, for cells that are nearly cubes."""
    side = np.asarray(side, np.float64)
    return tuple(int(max(round(fraction * (resolution - 1)), 1)) + 1 for fraction in side / side.max())


def damping(radius: Float[ArrayLike, "*shape"], cell: float) -> Float[Array, "*shape"]:
    """Computes the fraction of a cone's cross-section that a cell holds, erf(cell / (sqrt(8) sigma)).

    It is the mass, along one axis, of a Gaussian of the variance sigma^2 = (radius / 2)^2 of the cross-section,
    a disk, within half a cell on both sides (arXiv:2304.06706, Eq. 6 with n = 1 / cell): how much of a level's detail
    the mean over the cross-section keeps.

    Args:
        radius: [...] world units, at least 0.
        cell: world units, the side of a cell.

    Returns:
        [...] in [0, 1]: exactly 1, with derivative 0, for a radius of less than 0.17 cells, where float32 has no
        number between the value and 1; 0, with derivative 0, for an infinite one.
    """
    least = cell / (math.sqrt(2) * _ERF_IS_1)
    return jax.lax.erf(divide(cell / math.sqrt(2), clamp(radius, least, jnp.inf)))


def total_variation(params: Mapping[str, Any], *, levels: Sequence[TableLevel]) -> Float[Array, ""]:
    """Computes the mean squared difference of neighbouring vertices' features, summed over axes (arXiv:2112.05131).

    Only levels with a row for each vertex count, with the same weight each; the neighbours in a hashed level share
    their rows with vertices elsewhere. Such levels have at most table_size rows, so all of them are evaluated.

    Args:
        params: of the field.
        levels: of the table.

    Returns:
        A number; 0 if all levels are hashed.
    """
    table = params["table"]
    dense = [level for level in levels if len(level.rows) == math.prod(level.size)]
    total = jnp.zeros(())
    for level in dense:
        vertices = table[level.rows.start : level.rows.stop].reshape(*level.size, -1)
        total += sum((jnp.diff(vertices, axis=axis) ** 2).mean() for axis in range(3))
    return total / max(len(dense), 1)


TOTAL_VARIATION = Loss(
    None,
    on="field",
    help="mean squared difference of neighbouring vertices in the levels of the hash grid that are not hashed",
)


def harmonics(directions: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 9"]:
    """Returns the 9 real spherical harmonics [..., 9] of degree up to 2 of unit vectors [..., 3]."""
    x, y, z = (directions[..., i] for i in range(3))
    return jnp.stack(
        [
            jnp.full_like(x, 0.28209479),
            *(0.48860251 * value for value in (y, z, x)),
            *(1.0925484 * value for value in (x * y, y * z, x * z)),
            0.31539157 * (3 * z**2 - 1),
            0.54627421 * (x**2 - y**2),
        ],
        axis=-1,
    )


def _near_zero(key, shape):
    return jax.random.uniform(key, shape, minval=-0.025, maxval=0.025)
