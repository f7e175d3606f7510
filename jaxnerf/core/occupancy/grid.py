"""The occupancy grid: which cells of a box may hold matter, updated while the scene trains (arXiv:2201.05989).

The grid is part of the model. A field that was trained with one is undefined in its empty cells, so it must be
rendered with its grid.
"""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from jaxnerf.core import contraction, types, volume_rendering
from jaxnerf.core.loops import vary_like
from jaxnerf.core.safe_math import at_least_float32
from jaxnerf.core.sampling import ONE_KEY, typed_key
from jaxnerf.core.scene import evaluate_scene, inputs_of, needs_of
from jaxnerf.core.types import Keys, Rays, Samples, SceneFn, Vector, broadcast, check_order, check_shapes, pytree

_JUST_INSIDE = 2 - 1e-6  # of a box from -2 to 2
_ABSORBED = 0.01  # the fraction of light that matter of the threshold's density absorbs between samples
_LEAST_LIGHT = 1e-30  # transmitted by any cell, so that density_mean is finite
_SMALLEST_THRESHOLD = 1e-30  # 1 / world unit, so that a threshold of 0 has a spacing
# Updates of a cell in a row evaluate a scene that moves once in each of so many parts of [0, 1), and jump between them.
NUM_TIMES, _TIME_STRIDE = 50, 31


@pytree(static=("contracted",))
class OccupancyGrid:
    """The X x Y x Z cells of a box, into which all of space may be contracted.

    Attributes:
        lower: [3] world units, the box's lower corner.
        upper: [3] world units, its upper corner.
        valid: [X, Y, Z] bool; False for cells that are always empty, as determined from alpha.
        density_max: [X, Y, Z] 1 / world unit, the largest density that recent updates found.
        density_mean: [X, Y, Z] 1 / world unit, density of uniform matter whose transmittance over one spacing of
            samples is the running mean of those found; -1 in empty cells.
        occupied: [X, Y, Z] bool; a scene is evaluated only in these cells.
        contracted: whether the box's outer half holds all of space outside its inner half.
    """

    lower: Float[Array, "3"]
    upper: Float[Array, "3"]
    valid: Bool[Array, "X Y Z"]
    density_max: Float[Array, "X Y Z"]
    density_mean: Float[Array, "X Y Z"]
    occupied: Bool[Array, "X Y Z"]
    contracted: bool = False


def create_grid(
    lower: Vector,
    upper: Vector,
    valid: Bool[ArrayLike, "X Y Z"],
    *,
    initial_density: Float[ArrayLike, ""] | Float[ArrayLike, "X Y Z"],
    contracted: bool = False,
) -> OccupancyGrid:
    """Creates the grid of a box before any update, when only the valid cells are known (as in arXiv:2201.05989).

    Args:
        lower: [3] world units.
        upper: [3] world units.
        valid: [X, Y, Z] bool, x first.
        initial_density: 1 / world unit, the density_max of every cell, a number or [X, Y, Z]. An empty cell stays
            occupied until updates bring that down to the threshold: log(initial_density / threshold) /
            log(1 / decay) of them. In an array, a cell of density 0 is not occupied until an update finds density.
        contracted: whether the box holds all of space: the cells of its inner half are then not contracted,
            and those of its outer half hold all the rest, see contraction.contract.

    Returns:
        OccupancyGrid with fields [X, Y, Z], occupied wherever it is valid, unless its own density is 0.
    """
    lower, upper, valid = (jnp.asarray(value) for value in (lower, upper, valid))
    check_shapes("create_grid", lower=(lower, "3"), upper=(upper, "3"), valid=(valid, "X Y Z"))
    _check_bool("create_grid", valid=valid)
    check_order("create_grid", lower=lower, upper=upper)
    (density,) = broadcast("create_grid", valid.shape, initial_density=jnp.asarray(initial_density, jnp.float32))
    # Without an update a single number says nothing about any cell.
    occupied = valid if jnp.ndim(initial_density) == 0 else valid & (density > 0)
    return OccupancyGrid(
        lower=lower,
        upper=upper,
        valid=valid,
        density_max=density,
        density_mean=jnp.where(occupied, 0.0, -1.0),
        occupied=occupied,
        contracted=contracted,
    )


def update_grid(
    key: Keys,
    grid: OccupancyGrid,
    scene: SceneFn,
    cells: Int[ArrayLike, " cells"],
    *,
    threshold: Float[ArrayLike, ""] | Float[ArrayLike, "X Y Z"],
    spacing: Float[ArrayLike, ""] | Float[ArrayLike, "X Y Z"] | None = None,
    decay: Float[ArrayLike, ""] = 0.6,
    smoothing: Float[ArrayLike, ""] = 0.2,
    spread: Bool[ArrayLike, ""] = True,
    chunk: int = 8192,
    radii: Float[ArrayLike, "2"] | None = None,
    index: Int[ArrayLike, ""] | None = None,
) -> OccupancyGrid:
    """Updates some cells from the density at a random point in each (as in arXiv:2201.05989).

    A cell is occupied if its density_max exceeds the threshold or, with spread, if that of a neighbour does. Early
    in training, neighbours let the density of the field grow into cells next to dense ones.

    Args:
        key: for the point in each cell.
        grid: OccupancyGrid.
        scene: see render_samples. A scene that asks for more gets what `cell_inputs` computes, with the spacing as
            length, and a time for each cell: a cell is occupied if matter is there at any time, or for a cone of any
            of the radii.
        cells: [M] int32, flat indices x first, each at most once; indices past the last cell are ignored.
        threshold: 1 / world unit, a number or [X, Y, Z]; 0.01 over the spacing of samples there empties cells
            that absorb less than 1 % of the light.
        spacing: world units, of samples, a number or [X, Y, Z]; None: 0.01 / threshold, where a threshold of 0
            counts as 1e-30. density_mean is at most 69 / spacing.
        decay: the factor of density_max at an update that finds less.
        smoothing: the weight of an update in the mean transmittance from which density_mean follows. After n updates
            that find opaque matter the transmittance is (1 - smoothing)^n; one that finds none adds smoothing.
        spread: bool, may be traced. Once the field has formed, neighbours of dense cells only cost samples.
        chunk: cells evaluated at once.
        radii: [2] world units, above 0, the smallest and the largest radius for which the scene is rendered where
            space is not contracted; that of a cell is drawn between them, uniform in its logarithm. None: see
            `cell_inputs`.
        index: int32, how often these cells were updated before, for scenes that ask for time: NUM_TIMES updates in a
            row then are 1 / NUM_TIMES apart, and find what fills a cell for so long. None: times are random.

    Returns:
        OccupancyGrid. Cells that are not valid stay empty. The update is not meant to be differentiated.

    Raises:
        ValueError: on other shapes, if the grid's cells are not bool, or if key is no key.
    """
    check_shapes("update_grid", cells=(cells, "M"))
    _check_bool("update_grid", valid=grid.valid)
    key = typed_key(key, ONE_KEY)
    corner = jnp.stack(jnp.unravel_index(cells, grid.occupied.shape), axis=-1)
    place = (corner + jax.random.uniform(key, corner.shape)) / jnp.array([grid.occupied.shape])
    if grid.contracted:
        # A draw of nearly 1 rounds up to the far end of the last cell, which is at infinity.
        place = (contraction.expand(jnp.clip(4 * place - 2, -_JUST_INSIDE, _JUST_INSIDE)) + 2) / 4
    x = grid.lower[None] + place * (grid.upper - grid.lower)[None]
    length = _spacings(grid, threshold, spacing)[cells] if needs_of(scene) else None
    radius = None
    if radii is not None and "radius" in needs_of(scene):
        smallest, largest = jnp.log(radii)
        at = jax.random.uniform(jax.random.fold_in(key, 2), x.shape[:-1])  # another key than those of place and time
        radius = _stretch(grid, x) * jnp.exp(smallest + (largest - smallest) * at)
    time = _cell_times(key, cells, index) if "time" in needs_of(scene) else 0.0
    inputs = cell_inputs("update_grid", scene, grid, x, length=length, radius=radius, time=time)

    def density_at(at):
        x, inputs = at
        # Density has no direction; any will do.
        given = {name: value[None, None] for name, value in inputs.items()}
        return evaluate_scene("update_grid", scene, x[None, None], jnp.array([[[0.0, 0.0, 1.0]]]), given)[0][0, 0]

    found = jax.lax.map(density_at, (x, inputs), batch_size=min(chunk, cells.size)).astype(grid.density_max.dtype)
    largest, mean = grid.density_max.reshape(-1), jnp.maximum(grid.density_mean.reshape(-1), 0)
    largest = largest.at[cells].set(jnp.maximum(decay * largest[cells], found)).reshape(grid.density_max.shape)
    # Light passes beside the matter in a cell. A mean of densities would make a half-empty cell opaque.
    spacing = _spacings(grid, threshold, spacing)[cells]
    through = (1 - smoothing) * jnp.exp(-spacing * mean[cells]) + smoothing * jnp.exp(-spacing * found)
    uniform = -jnp.log(jnp.clip(through, _LEAST_LIGHT, 1)) / spacing  # a negative density would be an empty cell
    mean = mean.at[cells].set(uniform.astype(mean.dtype)).reshape(grid.density_mean.shape)
    dense = ~(largest <= threshold)  # NaN counts as dense, so that it is visible
    occupied = jnp.where(spread, widen(dense), dense) & grid.valid
    return dataclasses.replace(grid, density_max=largest, density_mean=jnp.where(occupied, mean, -1), occupied=occupied)


def _cell_times(key, cells, index):
    """Returns the time of each cell [M] in [0, 1), see update_grid."""
    if index is None:  # another key than that of the places, which do not depend on what the scene asks for
        return jax.random.uniform(jax.random.fold_in(key, 1), cells.shape)
    offset = (jnp.asarray(cells, jnp.uint32) * jnp.uint32(2654435769) >> 8) / jnp.float32(2**24)  # Fibonacci hashing
    return (jnp.asarray(index) % NUM_TIMES * _TIME_STRIDE % NUM_TIMES + offset) / NUM_TIMES


def _spacings(grid, threshold, spacing):
    """Returns the spacing of samples [X Y Z] of each cell, see update_grid."""
    if spacing is None:
        spacing = _ABSORBED / jnp.maximum(threshold, _SMALLEST_THRESHOLD)
    return jnp.broadcast_to(spacing, grid.occupied.shape).reshape(-1)


def grid_from_scene(
    key: Keys,
    scene: SceneFn,
    lower: Vector,
    upper: Vector,
    shape: tuple[int, int, int],
    *,
    threshold: Float[ArrayLike, ""] | Float[ArrayLike, "X Y Z"],
    contracted: bool = False,
    num_updates: int = 4,
    chunk: int = 8192,
) -> OccupancyGrid:
    """Creates the grid of a scene that was trained without one (after arXiv:2201.05989).

    Args:
        key: for the points in the cells.
        scene: see render_samples.
        lower: [3] world units, a corner of the box; the scene is not evaluated outside of it.
        upper: [3] world units, the opposite corner.
        shape: cells along x, y and z.
        threshold: see update_grid.
        chunk: see update_grid.
        contracted: see create_grid.
        num_updates: random points in each cell, at least NUM_TIMES where the scene asks for time, see `update_grid`.
            A cell is occupied if the density at one of them, or at one of a neighbour's, exceeds the threshold. Matter
            much thinner than a cell may be missed.

    Returns:
        OccupancyGrid.
    """
    key = typed_key(key, ONE_KEY)
    grid = create_grid(lower, upper, jnp.ones(shape, bool), initial_density=0.0, contracted=contracted)
    cells = jnp.arange(grid.valid.size)
    num_updates = max(num_updates, NUM_TIMES * ("time" in needs_of(scene)))

    def update(index, grid):
        options = {"threshold": threshold, "decay": 1.0, "smoothing": 1 / (index + 1), "chunk": chunk, "index": index}
        return update_grid(jax.random.fold_in(key, index), grid, scene, cells, **options)

    return jax.lax.fori_loop(0, num_updates, update, vary_like(grid, jax.eval_shape(update, 0, grid)))


def cell_inputs(
    function: str,
    scene: SceneFn,
    grid: OccupancyGrid,
    x: Float[ArrayLike, "*batch 3"],
    *,
    length: Num[ArrayLike, "*batch"] | None = None,
    radius: Num[ArrayLike, "*batch"] | None = None,
    time: Num[ArrayLike, "*#batch"] = 0.0,
) -> dict[str, Num[Array, "*batch"]]:
    """Computes what a scene asks for at positions that are on no ray, such as those in the cells of a grid.

    Args:
        function: name of the calling function, for messages.
        scene: see render_samples.
        grid: OccupancyGrid.
        x: [..., 3] world units.
        length: [...] world units; None: the size of the cell around x, the cube root of its volume.
        radius: [...] world units; None: half that size.
        time: [...], or a number.

    Returns:
        By name, each [...]: radius; length; time; image_index, 0.

    Raises:
        ValueError: if the scene asks for progress, which must be bound.
    """
    shape = x.shape[:-1]
    return inputs_of(
        function,
        scene,
        radius=lambda: _cell_sizes(grid, x) / 2 if radius is None else radius,
        length=lambda: _cell_sizes(grid, x) if length is None else length,
        time=lambda: jnp.broadcast_to(jnp.asarray(time, jnp.float32), shape),
        image_index=lambda: jnp.zeros(shape, jnp.int32),
    )


def _cell_sizes(grid, x):
    """Returns [...], the cube root of the volume of the cell around positions x [..., 3], in world units."""
    size = jnp.cbrt(jnp.prod((grid.upper - grid.lower) / jnp.array(grid.occupied.shape)))
    return size * _stretch(grid, x)


def _stretch(grid, x):
    """Returns [...], lengths at positions x [..., 3] over those that contraction makes of them; 1 without it."""
    if not grid.contracted:
        return jnp.ones(x.shape[:-1])
    lead, middle, quarter = (1,) * (x.ndim - 1), (grid.lower + grid.upper) / 2, (grid.upper - grid.lower) / 4
    return 1 / contraction.length_scale((x - middle.reshape(*lead, 3)) / quarter.reshape(*lead, 3))


def cells_along(grid: OccupancyGrid, rays: Rays, samples: Samples) -> Int[Array, "*batch samples"]:
    """Returns the flat index of the cell around each sample; X Y Z where its length is 0 or it is outside the box."""
    index, inside = _cells_of(grid, _along_rays(grid, rays, samples.t))
    return jnp.where(inside & (samples.delta > 0), index, grid.valid.size)


def mark_cells(
    marked: Bool[ArrayLike, "X Y Z"],
    grid: OccupancyGrid,
    rays: Rays,
    t: Float[ArrayLike, "*batch samples"],
    chosen: Bool[ArrayLike, "*batch samples"],
) -> Bool[Array, "X Y Z"]:
    """Returns marked [X, Y, Z] with the cells of the chosen samples marked, too."""
    index, inside = _cells_of(grid, _along_rays(grid, rays, t))
    return marked.reshape(-1).at[index].max(chosen & inside).reshape(marked.shape)


def widen(occupied: Bool[ArrayLike, "X Y Z"]) -> Bool[Array, "X Y Z"]:
    """Returns the cells that are occupied or share a side with one that is."""
    wide = occupied
    for axis in range(3):
        window = tuple(3 if i == axis else 1 for i in range(3))
        wide |= jax.lax.reduce_window(occupied, False, jax.lax.bitwise_or, window, (1, 1, 1), "SAME")
    return wide


def clip_rays_to_box(grid: OccupancyGrid, rays: Rays) -> Rays:
    """Returns the rays with near and far clipped to the grid's box; near = far where they miss it, NaN stays NaN."""
    return clip_rays(rays, grid.lower, grid.upper)


def clip_rays(rays: Rays, lower: Float[ArrayLike, "3"], upper: Float[ArrayLike, "3"]) -> Rays:
    """Returns the rays with near and far clipped to a box from lower to upper; see clip_rays_to_box."""
    origins, directions = rays.origins, rays.directions
    level = directions == 0
    lower, upper = (jnp.asarray(bound).reshape(*(1,) * rays.near.ndim, 3) for bound in (lower, upper))
    inside = jnp.where((origins >= lower) & (origins < upper), -jnp.inf, jnp.inf)
    inside = jnp.where(jnp.isnan(origins), jnp.nan, inside)
    ends = [(bound - origins) / jnp.where(level, 1, directions) for bound in (lower, upper)]
    enter = jnp.where(level, inside, jnp.minimum(*ends)).max(axis=-1)
    leave = jnp.where(level, jnp.inf, jnp.maximum(*ends)).min(axis=-1)
    near = jnp.clip(enter, rays.near, rays.far)
    return dataclasses.replace(rays, near=near, far=jnp.clip(leave, near, rays.far))


def is_occupied(
    grid: OccupancyGrid, rays: Rays, t: Float[ArrayLike, "*batch samples"]
) -> Bool[Array, "*batch samples"]:
    """Returns whether the cell around each x(t) is occupied; True where t or the ray is NaN, so that it is visible."""
    _check_bool("OccupancyGrid", occupied=grid.occupied)
    index, inside = _cells_of(grid, _along_rays(grid, rays, t))
    return (inside & grid.occupied.reshape(-1)[index]) | jnp.isnan(t) | types.has_nan(rays)[..., None]


def near_occupied(
    grid: OccupancyGrid, rays: Rays, t: Float[ArrayLike, "*batch samples"], radius: int
) -> Bool[Array, "*batch samples"]:
    """Returns True where a cell within a radius of x(t) is occupied, and False if none within two radii is.

    It looks up coarse cells, whose side is the radius: whether that around x(t) or one beside it holds an occupied
    cell. Places outside the box count as those at its border.

    Args:
        grid: OccupancyGrid, not contracted.
        rays: Rays [...].
        t: [..., S] in t.
        radius: cells along each axis, >= 1.
    """
    coarse = grid.occupied
    for axis in range(3):
        # One pass for each axis: the first, over all cells, is then vectorised.
        coarse = jax.lax.optimization_barrier(_pooled(coarse, radius, axis))
    for axis in range(3):
        around = jnp.pad(coarse, [(1, 1) if i == axis else (0, 0) for i in range(3)])
        before, after = (jax.lax.slice_in_dim(around, i, i + coarse.shape[axis], axis=axis) for i in (0, 2))
        coarse |= before | after
    places = [place / radius for place in _along_rays(grid, rays, t)]
    along = [jnp.clip(x.astype(jnp.int32), 0, size - 1) for x, size in zip(places, coarse.shape, strict=True)]
    return coarse.reshape(-1)[flat_index(along, coarse.shape)]


def _pooled(cells, side, axis):
    """Returns whether any of `side` cells along an axis is true; the last ones may be fewer."""
    whole = cells.shape[axis] // side * side
    parts = [jax.lax.slice_in_dim(cells, i, whole, side, axis) for i in range(side if whole else 0)]
    parts = [functools.reduce(jnp.logical_or, parts)] if whole else []
    if whole < cells.shape[axis]:
        parts.append(jax.lax.slice_in_dim(cells, whole, None, axis=axis).any(axis=axis, keepdims=True))
    return jnp.concatenate(parts, axis=axis)


def _check_bool(function, **cells):
    """Raises a ValueError unless arrays of cells are bool; numbers would be masks by accident."""
    for name, array in cells.items():
        if array.dtype != bool:
            raise ValueError(f"{function}: {name} has type {array.dtype}, expected bool; compare it with a threshold")


def estimate_optical_depth(
    grid: OccupancyGrid, rays: Rays, samples: Samples
) -> tuple[Bool[Array, "*batch samples"], Float[Array, "*batch samples"]]:
    """Estimates the optical depth of samples from the grid's density_mean; no scene is evaluated.

    density_max would make cells opaque while their density is still forming.

    Args:
        grid: OccupancyGrid.
        rays: Rays [...].
        samples: Samples [..., S].

    Returns:
        [..., S] bool, whether a sample has a length and is in an occupied cell, or it or its ray is NaN, so that it is
        visible; and [..., S], its optical depth, 0 where it is not, and at most 1e4.
    """
    index, inside = _cells_of(grid, _along_rays(grid, rays, samples.t))
    has_length = ~(samples.delta <= 0)
    mean = jnp.where(inside & has_length, grid.density_mean.reshape(-1)[index], -1)
    # A plain norm, as it is computed again for every sample; an estimate need not be accurate at lengths of 1e-20.
    x, y, z = (at_least_float32(rays.directions[..., axis])[0] for axis in range(3))
    size = jnp.sqrt(x * x + y * y + z * z)[..., None]
    # The bound keeps sums finite: the mean of a cell of an older checkpoint may be infinite.
    optical_depth = jnp.where(mean > 0, jnp.minimum(mean * samples.delta * size, volume_rendering.OPAQUE), 0)
    unknown = jnp.isnan(samples.t) | (has_length & types.has_nan(rays)[..., None])
    return ~(mean < 0) | unknown, optical_depth


def mask_scene(scene: SceneFn, grid: OccupancyGrid) -> SceneFn:
    """Makes a scene that is empty in the grid's empty cells, as render_packed renders it (arXiv:2201.05989).

    Args:
        scene: see render_samples.
        grid: OccupancyGrid. Outside its box space is empty, too.

    Returns:
        A scene, whose density is 0, with gradient 0, in empty cells; its colour there is that of another position.
        The given scene is not evaluated in empty cells unless no position is in an occupied one. NaN is evaluated, so
        that it is visible.
    """
    _check_bool("mask_scene", occupied=grid.occupied)

    @functools.wraps(scene)
    def masked(x, viewdirs, **inputs):
        index, inside = cells_around(grid, x)
        kept = (inside & grid.occupied.reshape(-1)[index]) | jnp.isnan(x).any(axis=-1)
        flat = x.reshape(-1, 3)
        # Where the scene is undefined, the gradient of what is masked would be NaN.
        first = jnp.argmax(kept.reshape(-1)) if flat.size else None
        safe = jax.lax.stop_gradient(flat[first]) if flat.size else jnp.zeros(3)
        x = jnp.where(kept[..., None], x, safe.reshape(*(1,) * (x.ndim - 1), 3))
        if flat.size:
            per_sample = {name: value for name, value in inputs.items() if jnp.shape(value) == kept.shape}
            fixed = {name: jax.lax.stop_gradient(value.reshape(-1)[first]) for name, value in per_sample.items()}
            inputs |= {name: jnp.where(kept, value, fixed[name]) for name, value in per_sample.items()}
        density, rgb = evaluate_scene("mask_scene", scene, x, viewdirs, inputs)
        return jnp.where(kept, density, 0), rgb

    return masked


def flat_index(places: Sequence[Int[Array, "*batch"]], shape: tuple[int, ...]) -> Int[Array, "*batch"]:
    """Returns the flat indices [...] of cells in a grid of a shape (X, Y, Z); places are three arrays [...] int32.

    The sum over a stack makes XLA end a loop there on a CPU. A single loop that computed indices and read cells
    would not be vectorised at all.
    """
    strides = jnp.array([shape[1] * shape[2], shape[2], 1]).reshape(3, *(1,) * places[0].ndim)
    return (jnp.stack(places) * strides).sum(axis=0, dtype=jnp.int32)


def _along_rays(grid, rays, t):
    """Returns x(t), three arrays [..., S], in cells from the box's lower corner."""
    places = []
    for axis in range(3):
        scale = _cells_per_unit(grid, axis)
        start = (rays.origins[..., axis] - grid.lower[axis]) * scale
        places.append(start[..., None] + t * (rays.directions[..., axis] * scale)[..., None])
    return places


def _cells_per_unit(grid, axis):
    return grid.occupied.shape[axis] / (grid.upper[axis] - grid.lower[axis])


def cells_around(
    grid: OccupancyGrid, x: Float[ArrayLike, "*batch 3"]
) -> tuple[Int[Array, "*batch"], Bool[Array, "*batch"]]:
    """Returns the flat index of the cell around each position, and whether it is inside the box."""
    return _cells_of(grid, [(x[..., i] - grid.lower[i]) * _cells_per_unit(grid, i) for i in range(3)])


def _cells_of(grid, places):
    """Returns the flat index of the cell at each of the places, and whether they are inside the box."""
    along, inside = [], True
    if grid.contracted:
        places = _contracted(places, grid.occupied.shape)
    for place, size in zip(places, grid.occupied.shape, strict=True):
        inside &= (place >= 0) & (place < size)
        along.append(jnp.clip(place.astype(jnp.int32), 0, size - 1))
    return flat_index(along, grid.occupied.shape), inside


def _contracted(places, shape):
    """Returns where contract puts places, three arrays [...] in cells; axis by axis, which is faster."""
    # Bounded as in contraction.contract: infinity times a scale of 0 would be NaN.
    along = [jnp.clip(place * (4 / size) - 2, -1e30, 1e30) for place, size in zip(places, shape, strict=True)]
    largest = jnp.maximum(jnp.maximum(*map(jnp.abs, along[:2])), jnp.abs(along[2]))
    safe = jnp.maximum(largest, 1)
    inverse = 1 / safe
    # The box ends at infinity, and a point there is in its last cell.
    scale = jnp.minimum((2 - inverse) * inverse, _JUST_INSIDE * inverse)
    return [(value * scale + 2) * (size / 4) for value, size in zip(along, shape, strict=True)]
