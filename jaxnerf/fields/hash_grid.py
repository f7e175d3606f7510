"""The hash grid: features at the vertices of several levels, decoded by two small networks."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.core.fixed_order import add_rows, in_fixed_order
from jaxnerf.core.loops import is_cpu
from jaxnerf.core.safe_math import clamp, divide
from jaxnerf.core.sampling import ONE_KEY, typed_key
from jaxnerf.core.types import Vector, check_shapes
from jaxnerf.fields.base import Field, apply_network, infer_prefilter
from jaxnerf.fields.mlp import Dense
from jaxnerf.options import POSITIVE, Box, Changes, Device, Facts, Options, at_least, between, infer, is_auto, option
from jaxnerf.registry import Loss, Part

_glorot = linen.initializers.glorot_uniform()

_COMPUTE_DTYPES = {"float32": None, "bfloat16": jnp.bfloat16}
_PRIMES = (1, 2654435761, 805459861)  # of the spatial hash, arXiv:2201.05989, Eq. 4
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


class TableLevel(NamedTuple):
    """A level of the table of a hash grid.

    Attributes:
        size: vertices along x, y and z.
        rows: range of the table's rows; fewer than vertices where the level is hashed.
    """

    size: tuple[int, int, int]
    rows: range


def _wrong_levels(levels):
    right = 0 < len(levels) <= _MAX_LEVELS and all(isinstance(each, int) and 2 <= each <= 2**20 for each in levels)
    return None if right else f"1 to {_MAX_LEVELS} whole numbers, each from 2 to 2^20"


@dataclasses.dataclass(frozen=True)
class HashGridOptions(Options):
    """The options of the hash grid."""

    resolutions: tuple[int, ...] = option(
        "auto", "vertices along the longest side, one number per level", auto=True, check=_wrong_levels
    )
    features_per_level: int = option(4, "features of a vertex", range=at_least(1))
    table_size: int = option(
        2**17,
        "maximal rows per level; a level with more vertices is hashed. auto: 2^17 to 2^20, in proportion to an "
        "image's side; four times as many on an accelerator",
        range=at_least(1),
        auto=True,
    )
    width: int = option(
        64,
        "outputs of a hidden layer of the density network; auto: 64 on a CPU, 128 on an accelerator",
        range=at_least(1),
        auto=True,
    )
    geometry_features: int = option(
        15, "outputs of the density network that the colour network reads", range=at_least(0)
    )
    view_depth: int = option(
        2,
        "hidden layers of the colour network; auto: 3 on a CPU where the occupancy grid has fine cells, else 2",
        range=between(0, _MAX_LAYERS),
        auto=True,
    )
    view_width: int = option(
        128, "outputs of a hidden layer of the colour network; auto: as `width`", range=at_least(1), auto=True
    )
    use_viewdirs: bool = option(True, "whether colour depends on the direction")
    feature_scale: float = option(
        4.0, "features are table entries times this; it scales the table's learning rate", range=POSITIVE
    )
    prefilter: bool = option(
        "auto",
        "Whether the features of cells that are smaller than a pixel's footprint are damped (arXiv:2304.06706, Eq. 6). "
        "auto: where the footprints of the training images differ by 4 or more.",
        auto=True,
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
            "width": 16 * width * (inputs + 1 + self.geometry_features),
            "view_width": 16 * view_width * view_width * max(view_depth - 1, 0),
        }

    @property
    def is_large(self) -> bool:
        """Whether an update of the table takes as long as half of the rays of a step."""
        return self.table_size >= _LARGE_TABLE


def hash_grid_field(**options: Any) -> Field:
    """Makes a Field of multi-resolution features (after arXiv:2201.05989).

    Args:
        **options: attributes of HashGrid; lower and upper are required.

    Returns:
        Field. apply(params, x [..., S, 3], viewdirs [..., 1 or S, 3]) returns density [..., S] in
        1 / world unit, an exponential of at most e^15, and rgb [..., S, 3] in [0, 1], both float32.
        Outside the box the values are those of the nearest point inside. With prefilter, apply asks for the radius
        [..., 1 or S] of the cone at each sample, too, see `damping`.

    Raises:
        ValueError: if the box is empty, or a level has fewer than 2 vertices along its longest side.
    """
    try:
        network = HashGrid(**options)
    except TypeError as error:
        raise TypeError(str(error).replace("HashGrid.__init__()", "hash_grid_field()")) from None
    lower, upper = np.asarray(network.lower, float), np.asarray(network.upper, float)
    if lower.shape != (3,) or upper.shape != (3,) or not (lower < upper).all():
        raise ValueError(f"hash_grid_field: the box is {network.lower} to {network.upper}, expected lower < upper")
    if not network.resolutions or min(network.resolutions) < 2:
        raise ValueError(
            f"hash_grid_field: resolutions are {network.resolutions}, expected at least one, each at least 2"
        )

    def init(key):
        inputs = {"radius": jnp.zeros((1, 1))} if network.prefilter else {}
        return network.init(typed_key(key, ONE_KEY), jnp.zeros((1, 1, 3)), jnp.zeros((1, 1, 3)), **inputs)["params"]

    def apply(params, x, viewdirs, **inputs):
        density, rgb = apply_network(network, params, x, viewdirs, **inputs)
        return jnp.exp(jnp.minimum(density, _LARGEST_EXPONENT)), color_activation(rgb)

    def apply_to_rays(params, x, viewdirs):
        return apply(params, x, viewdirs)

    def apply_to_cones(params, x, viewdirs, *, radius):
        return apply(params, x, viewdirs, radius=jnp.broadcast_to(radius, x.shape[:-1]))

    color_layers = ("view_0",) if network.view_depth else ("rgb",)
    regularizers = {"total_variation": functools.partial(total_variation, levels=network.levels())}
    scene = apply_to_cones if network.prefilter else apply_to_rays
    return Field(init, scene, regularizers=regularizers, color_layers=color_layers, network=network)


def from_options(options: HashGridOptions, box: Box | None) -> Field:
    """Makes the field "hash_grid" from its options, in the scene's box."""
    if box is None:
        raise ValueError(
            "scene.lower or scene.upper is 'auto', expected the scene's box; resolve the config, or set both"
        )
    values = {**dataclasses.asdict(options), "compute_dtype": _COMPUTE_DTYPES[options.compute_dtype]}
    return hash_grid_field(lower=box[0], upper=box[1], **values)


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
        resolutions: vertices along the longest side, for each level.
        features_per_level: features of each vertex.
        table_size: maximal rows per level; a level with more vertices shares rows by a hash.
        width: features of the density network's hidden layer.
        geometry_features: outputs of the density network that the colour network reads.
        view_depth: hidden layers of the colour network.
        view_width: features of such a layer.
        use_viewdirs: False: colour does not depend on the direction.
        feature_scale: features over table entries. A step reaches few entries, so each should change more.
        prefilter: whether the features of each level are multiplied by its `damping`, which is an input, too.
        compute_dtype: of the inputs of both networks' layers; parameters, interpolation and outputs keep the
            precision of the table. None: that of the table for all.
    """

    lower: Sequence[float]
    upper: Sequence[float]
    resolutions: Sequence[int] = (16, 32, 64, 128)
    features_per_level: int = 4
    table_size: int = 2**17
    width: int = 64
    geometry_features: int = 15
    view_depth: int = 2
    view_width: int = 128
    use_viewdirs: bool = True
    feature_scale: float = 4.0
    prefilter: bool = False
    compute_dtype: Any = None

    @linen.nowrap
    def levels(self) -> tuple[TableLevel, ...]:
        """Returns the levels of the table."""
        side = np.asarray(self.upper, np.float32) - np.asarray(self.lower, np.float32)
        sizes = [vertices(side, resolution) for resolution in self.resolutions]
        ends = np.cumsum([0] + [min(np.prod(size), self.table_size) for size in sizes]).tolist()
        return tuple(TableLevel(size, range(*rows)) for size, rows in zip(sizes, itertools.pairwise(ends), strict=True))

    @linen.nowrap
    def _rounded(self, value):
        return value if self.compute_dtype is None else value.astype(self.compute_dtype)

    @linen.compact
    def __call__(
        self,
        x: Float[ArrayLike, "*batch samples 3"],
        viewdirs: Float[ArrayLike, "*batch #samples 3"],
        radius: Float[ArrayLike, "*batch samples"] | None = None,
    ) -> tuple[Float[Array, "*batch samples"], Float[Array, "*batch samples 3"]]:
        """Returns density [..., S] and rgb [..., S, 3] before their activations; arrays inside are [features, N]."""
        shape = x.shape[:-1]
        side = np.asarray(self.upper, np.float32) - np.asarray(self.lower, np.float32)
        place = _stored([(x[..., i].reshape(-1) - self.lower[i]) / side[i] for i in range(3)])
        levels = self.levels()
        # All levels share a table, so there is only one gradient to clear and one array to update.
        table = self.param("table", _near_zero, (levels[-1].rows.stop, self.features_per_level))
        features = self.feature_scale * interpolate(table, place, levels)
        if self.prefilter:
            cells = [float((side / (np.array(level.size) - 1)).max()) for level in levels]
            left = jnp.stack([damping(radius.reshape(-1), cell) for cell in cells], axis=-1)
            damped = features * jnp.repeat(left, self.features_per_level, axis=-1)
            features = jnp.concatenate([damped, left], axis=-1)
        features = self._rounded(features)
        kernel = self.param("kernel", _glorot, (features.shape[-1], self.width))
        bias = self.param("bias", linen.initializers.zeros_init(), (self.width,))
        kernel, bias = self._rounded(kernel), self._rounded(bias)
        hidden = jax.nn.relu(_first_product(kernel, features) + bias[:, None])
        # The logarithm of a density is up to 15, where bfloat16 has steps of 1/16.
        outputs = {"dtype": None if self.compute_dtype is None else table.dtype}
        geometry = Dense(1 + self.geometry_features, name="density", **outputs)(hidden)
        density, hidden = geometry[0], self._rounded(geometry[1:])
        if self.use_viewdirs:
            directions = jnp.broadcast_to(harmonics(viewdirs), (*shape, 9))
            hidden = jnp.concatenate([hidden, self._rounded(directions.reshape(-1, 9).T)])
        for layer in range(self.view_depth):
            hidden = jax.nn.relu(Dense(self.view_width, name=f"view_{layer}")(hidden))
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


def interpolate(
    table: Float[ArrayLike, "rows features"], place: Sequence[Float[ArrayLike, " N"]], levels: Sequence[TableLevel]
) -> Float[Array, "N levels_and_features"]:
    """Interpolates features linearly between the 8 vertices around each place, for each level.

    Args:
        table: [T, F] features of vertices.
        place: three arrays [N], x, y and z as fractions of the box; clamped to it.
        levels: L levels. Each has one row of the table per vertex, z fastest, or fewer rows, which vertices share by
            the hash of arXiv:2201.05989 (Eq. 4). All hashed levels have the same number of rows.

    Returns:
        [N, L F], level by level, at least float32. The derivative with respect to place is that of the linear pieces,
        also on a face of the box.

    Raises:
        ValueError: on another shape of the table, or if hashed levels have different numbers of rows.
    """
    check_shapes("interpolate", table=(table, "T F"), x=(place[0], "N"), y=(place[1], "N"), z=(place[2], "N"))
    counts = {len(level.rows) for level in levels if _is_hashed(level)}
    if len(counts) > 1:
        raise ValueError(f"interpolate: hashed levels have {sorted(counts)} rows, expected the same number in each")
    chosen = _interpolate_in_fixed_order if in_fixed_order() else _interpolate
    return chosen(tuple(levels), jnp.asarray(table), tuple(map(jnp.asarray, place)))


def _interpolated(levels, table, place):
    """Interpolates level by level, which on a CPU is faster than by `_all_corners` where no derivative is needed."""
    if not is_cpu():
        return _together(*_all_corners(levels, place), table)
    weights, features = [], []
    for level in levels:
        low, fractions = _cells(level.size, place)
        weights.append(_of_corners(jnp.multiply, [(1 - fraction, fraction) for fraction in fractions]))
        features.append([_read(table, row) for row in _corner_rows(low, level)])
    return _weighted_sums(weights, features)


_interpolate = jax.custom_jvp(_interpolated, nondiff_argnums=(0,))


@functools.partial(_interpolate.defjvp, symbolic_zeros=True)
def _interpolate_jvp(levels, primals, tangents):
    """Gathers the rows of all levels and vertices at once.

    Otherwise the gradient would compile loops of its own for the rows of each vertex of each level. The gathered
    features are split by vertex, as a loop over several vertices would divide an index for each element.
    """
    (table, place), (change, moved) = primals, tangents
    rows, weights = _all_corners(levels, place)
    tangent = 0.0
    if not isinstance(change, SymbolicZero) and not is_cpu():
        tangent = _change_together(rows, weights, change)
    elif not isinstance(change, SymbolicZero):
        read = jax.lax.split(_read(change, rows.reshape(-1)), [rows.shape[2]] * (rows.shape[0] * 8))
        tangent = _weighted_sums(weights, [read[start : start + 8] for start in range(0, len(read), 8)])
    if not all(isinstance(each, SymbolicZero) for each in moved):
        moved = tuple(
            jnp.zeros_like(value) if isinstance(each, SymbolicZero) else each
            for value, each in zip(place, moved, strict=True)
        )
        tangent += jax.jvp(functools.partial(_interpolated, levels, table), (place,), (moved,))[1]
    if not is_cpu():
        return _together(rows, weights, table), tangent
    return _weighted_sums(weights, [[_read(table, row) for row in level] for level in rows]), tangent


def _together(rows, weights, table):
    """Returns the weighted sums [N, L F] over the vertices [L, 8, N]: all levels at once, in the same way.

    The neighbouring threads of an accelerator then have the same work.
    """
    corners = (weights[:, corner, :, None] * _read(table, rows[:, corner]) for corner in range(8))
    return _by_sample(functools.reduce(jnp.add, corners))


def _change_together(rows, weights, change):
    """Returns what `_together` does, from one array of all rows: its transpose is a single scatter."""
    read = _read(change, rows.reshape(-1)).reshape(*rows.shape, -1)
    return _by_sample(jnp.sum(weights[..., None] * read, axis=1))


def _by_sample(features):
    """Returns [N, L F] for features [L, N, F]."""
    levels, samples, size = features.shape
    return jnp.moveaxis(features, 0, 1).reshape(samples, levels * size)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _interpolate_in_fixed_order(levels, table, place):
    return _together(*_all_corners(levels, place), table)


def _forward_in_fixed_order(levels, table, place):
    return _interpolate_in_fixed_order(levels, table, place), (table, place)


def _backward_in_fixed_order(levels, residuals, change):
    table, place = residuals
    rows, weights = _all_corners(levels, place)
    change_of_level = jnp.moveaxis(change.reshape(*rows.shape[2:], len(levels), -1), 1, 0)
    values = weights[..., None] * change_of_level[:, None]
    sums = add_rows(values.reshape(-1, values.shape[-1]), rows.reshape(-1), len(table))
    moved = jax.vjp(lambda place: _interpolated(levels, table, place), place)[1](change)[0]
    return sums.astype(table.dtype), moved


_interpolate_in_fixed_order.defvjp(_forward_in_fixed_order, _backward_in_fixed_order)


def _weighted_sums(weights, features):
    """Returns the sums over the vertices [N, L F] of weights and features by level and vertex, [N] and [N, F] each.

    Not as sums over an axis, for which XLA would write all products to memory.
    """
    return jnp.concatenate(
        [
            functools.reduce(jnp.add, (w[:, None] * f for w, f in zip(*level, strict=True)))
            for level in zip(weights, features, strict=True)
        ],
        axis=-1,
    )


def _stored(values):
    """Returns the same arrays [N], written to memory once.

    On a CPU, XLA would otherwise compute them again in the loops of each level and vertex, which it then does not
    vectorize. It never computes a reduction twice, hence a sum with zeros; an optimization_barrier does not help.
    """
    diagonal = jnp.eye(len(values), dtype=bool)[..., None]
    return list(jnp.where(diagonal, jnp.stack(values)[None], 0).sum(axis=1))


@jax.custom_jvp
def _first_product(kernel, features):
    """Returns the transposed product [F, N] of features [N, D] and a kernel [D, F].

    The table yields one row per sample, but the layers that follow are faster with features first.
    """
    return jnp.einsum("df,nd->fn", kernel, features)


@_first_product.defjvp
def _first_product_jvp(primals, tangents):
    """Differentiates the product with the features transposed, as the backward pass is then faster on a CPU.

    The barrier keeps XLA from merging the transpositions into the products. Without derivatives the transposition
    would only cost time.
    """
    kernel, features = primals
    features, change = (jax.lax.optimization_barrier(each.T) for each in (features, tangents[1]))

    def product(kernel, features):
        return jnp.einsum("df,dn->fn", kernel, features)

    return product(kernel, features), product(tangents[0], features) + product(kernel, change)


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


def _cells(size, place):
    """Returns, for each axis, the lower vertices of the cells around places, and the fractions of cells below them."""
    spread = [clamp(value, 0, 1) * np.float32(count - 1) for value, count in zip(place, size, strict=True)]
    low = [jnp.minimum(value.astype(jnp.int32), count - 2) for value, count in zip(spread, size, strict=True)]
    return low, [value - start for value, start in zip(spread, low, strict=True)]


def _corner_rows(low, level):
    """Returns the rows [N] of the 8 vertices around places; low holds the lowest along each axis."""
    if not _is_hashed(level):
        strides = (level.size[1] * level.size[2], level.size[2], 1)
        along = [(v * stride, v * stride + stride) for v, stride in zip(low, strides, strict=True)]
        return [level.rows.start + row for row in _of_corners(jnp.add, along)]
    first = [v.astype(jnp.uint32) for v in low]
    along = [(v * prime, (v + 1) * prime) for v, prime in zip(first, map(jnp.uint32, _PRIMES), strict=True)]
    scattered = _of_corners(jnp.bitwise_xor, along)
    return [level.rows.start + (row % jnp.uint32(len(level.rows))).astype(jnp.int32) for row in scattered]


def _of_corners(combine, along):
    """Returns the 8 combinations of two values along each of three axes, z fastest."""
    x, y, z = along
    pairs = [combine(*pair) for pair in itertools.product(x, y)]
    return [combine(*pair) for pair in itertools.product(pairs, z)]


def _all_corners(levels, place):
    """Returns the rows and the weights [L, 8, N] of the 8 vertices around places, z fastest."""
    size = np.array([level.size for level in levels], np.int32).T[..., None, None]
    corners = np.array(list(itertools.product((0, 1), repeat=3)), np.int32).T[:, None, :, None]
    low, fractions = _cells(size, [value[None, None] for value in place])
    weights = [jnp.where(corner == 1, value, 1 - value) for corner, value in zip(corners, fractions, strict=True)]
    vertices = list(map(jnp.add, low, corners))
    rows = functools.reduce(jnp.add, map(jnp.multiply, vertices, (size[1] * size[2], size[2], 1)))
    hashed = np.array([_is_hashed(level) for level in levels])
    if hashed.any():
        scattered = [v.astype(jnp.uint32) * jnp.uint32(prime) for v, prime in zip(vertices, _PRIMES, strict=True)]
        scattered = functools.reduce(jnp.bitwise_xor, scattered) % jnp.uint32(len(levels[hashed.argmax()].rows))
        rows = jnp.where(hashed[:, None, None], scattered.astype(jnp.int32), rows)
    starts = np.array([level.rows.start for level in levels], np.int32)
    # The remainder changes nothing, but without it XLA computes the rows once more for the gradient on a CPU.
    rows = jax.lax.rem(rows + starts[:, None, None], jnp.full(rows.shape, np.iinfo(np.int32).max, jnp.int32))
    return rows, functools.reduce(jnp.multiply, weights)


def _is_hashed(level):
    return len(level.rows) < np.prod(level.size)


def _read(table, rows):
    return jnp.asarray(table).at[rows].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _near_zero(key, shape):
    return jax.random.uniform(key, shape, minval=-0.025, maxval=0.025)
