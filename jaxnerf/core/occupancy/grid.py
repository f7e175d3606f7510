"""Only where there is something: a grid of what may be occupied, learned beside the scene.

The grid is part of the model. A field that was trained under one means nothing where the grid is empty, so
whoever renders that field renders it with its grid.
"""

import dataclasses

import jax
import jax.numpy as jnp

from jaxnerf.core import contraction, volume_rendering
from jaxnerf.core.types import check_shapes, pytree

_JUST_INSIDE = 2 - 1e-6  # of a box from -2 to 2


@pytree(static=("contracted",))
class OccupancyGrid:
    """What is known of the X x Y x Z cells of a box, into which all of space may be contracted."""

    lower: jax.Array  # [3] world units, the box
    upper: jax.Array  # [3]
    valid: jax.Array  # [X, Y, Z] bool; False is empty for good, as alpha masks have shown
    density_max: jax.Array  # [X, Y, Z] 1 / world unit, the largest density found of late
    density_mean: jax.Array  # [X, Y, Z] 1 / world unit, the running mean of those found; -1 where not occupied
    occupied: jax.Array  # [X, Y, Z] bool, where a scene is asked
    contracted: bool = False  # the box's inner half is plain, and its outer half holds all the rest


def create_grid(lower, upper, valid, *, initial_density, contracted=False):
    """Returns the Grid of a box of which only is known what is possible (as the grids of arXiv:2201.05989).

    Args:
        lower, upper: [3] world units.
        possible: [X, Y, Z] bool, x first.
        assumed: 1 / world unit, the density taken for found everywhere. An empty cell is left out after as
            many looks as bring that down to the threshold: log(assumed / threshold) / log(1 / decay).
        contracted: whether there is space outside of the box, too: then the cells of its inner half are
            plain, and those of the outer half hold all the rest, see contraction.contract.

    Returns:
        Grid with fields [X, Y, Z], occupied wherever that is possible.

    Raises:
        ValueError: on other shapes.
    """
    lower, upper, valid = (jnp.asarray(value) for value in (lower, upper, valid))
    check_shapes("create_grid", lower=(lower, "3"), upper=(upper, "3"), valid=(valid, "X Y Z"))
    mean = jnp.where(valid, 0.0, -1.0)
    return OccupancyGrid(
        lower=lower,
        upper=upper,
        valid=valid,
        density_max=jnp.full_like(mean, initial_density),
        density_mean=mean,
        occupied=valid,
        contracted=contracted,
    )


def update_grid(key, grid, scene, cells, *, threshold, decay=0.6, smoothing=0.2, spread=True, chunk=8192):
    """Returns the Grid after a look at a random point in each of some cells (as in arXiv:2201.05989).

    A cell is occupied where the largest density of late exceeds the threshold, or, with spread, that of a
    neighbour does: a field that is still forming must not lose what it is about to grow.

    Args:
        key: where in each cell.
        grid: Grid.
        scene: see render_samples.
        cells: [M] int32, flat indices x first, each at most once; what lies past the last cell is ignored.
        threshold: 1 / world unit, a number or [X, Y, Z]; 0.01 over the spacing of samples there leaves out
            what absorbs 1 % of the light.
        decay: what of the peak outlasts a look that finds less.
        smoothing: the weight of a look in the running mean.
        spread: bool, traced or not. When the field has formed, its neighbours cost samples and are empty.
        chunk: cells asked at once.

    Returns:
        Grid. What is not possible stays empty. No gradient is meant to flow through it.

    Raises:
        ValueError: on other shapes.
    """
    check_shapes("update_grid", cells=(cells, "M"))
    corner = jnp.stack(jnp.unravel_index(cells, grid.occupied.shape), axis=-1)
    place = (corner + jax.random.uniform(key, corner.shape)) / jnp.array([grid.occupied.shape])
    if grid.contracted:
        # A draw of nearly 1 rounds up to the far end of the last cell, which is at infinity.
        place = (contraction.expand(jnp.clip(4 * place - 2, -_JUST_INSIDE, _JUST_INSIDE)) + 2) / 4
    x = grid.lower[None] + place * (grid.upper - grid.lower)[None]
    # Density has no direction; any will do.
    ask = lambda x: scene(x[None, None], jnp.array([[[0.0, 0.0, 1.0]]]))[0][0, 0]  # noqa: E731
    found = jax.lax.map(ask, x, batch_size=min(chunk, cells.size))
    peak, mean = grid.density_max.reshape(-1), jnp.maximum(grid.density_mean.reshape(-1), 0)
    peak = peak.at[cells].set(jnp.maximum(decay * peak[cells], found)).reshape(grid.density_max.shape)
    mean = mean.at[cells].add(smoothing * (found - mean[cells])).reshape(grid.density_mean.shape)
    dense = ~(peak <= threshold)  # NaN counts, and shows
    occupied = jnp.where(spread, _widen(dense), dense) & grid.valid
    return dataclasses.replace(grid, density_max=peak, density_mean=jnp.where(occupied, mean, -1), occupied=occupied)


def grid_from_scene(key, scene, lower, upper, shape, *, threshold, contracted=False, num_updates=4, chunk=8192):
    """Returns the Grid of a scene that was trained without one (a grid of arXiv:2201.05989).

    Args:
        key: where in the cells.
        scene: see render_samples.
        lower, upper: [3] world units, the box; outside of it nothing will be asked.
        shape: cells along x, y and z.
        threshold, chunk: see update_grid.
        contracted: see create_grid.
        num_updates: random points in each cell. A cell is occupied where one of them, or of a neighbour's, is
            above the threshold, so that matter much thinner than a cell may be missed.

    Returns:
        Grid.
    """
    grid = create_grid(lower, upper, jnp.ones(shape, bool), initial_density=0.0, contracted=contracted)
    cells = jnp.arange(grid.valid.size)

    def update(index, grid):
        options = {"threshold": threshold, "decay": 1.0, "smoothing": 1 / (index + 1), "chunk": chunk}
        return update_grid(jax.random.fold_in(key, index), grid, scene, cells, **options)

    return jax.lax.fori_loop(0, num_updates, update, grid)


def mark_cells(marked, grid, rays, t, chosen):
    """Returns marked [X, Y, Z] bool, with the cells of those of the samples at t that are chosen [..., S]."""
    index, inside = _cell(grid, _along(grid, rays, t))
    return marked.reshape(-1).at[index].max(chosen & inside).reshape(marked.shape)


def keep_cells(grid, marked):
    """Returns the Grid with only the cells that are marked [X, Y, Z], or between two that are, occupied."""
    between = marked
    for axis in range(3):
        around = jnp.pad(marked, [(1, 1) if i == axis else (0, 0) for i in range(3)])
        before, after = (jax.lax.slice_in_dim(around, i, i + marked.shape[axis], axis=axis) for i in (0, 2))
        between |= before & after
    occupied = grid.occupied & between
    return dataclasses.replace(grid, density_mean=jnp.where(occupied, grid.density_mean, -1), occupied=occupied)


def clip_rays_to_box(grid, rays):
    """Returns the Rays between their ends and inside the grid's box; near = far where they miss it."""
    origins, directions = rays.origins, rays.directions
    level = directions == 0
    lower, upper = (bound.reshape(*(1,) * rays.near.ndim, 3) for bound in (grid.lower, grid.upper))
    inside = (origins >= lower) & (origins < upper)
    ends = [(bound - origins) / jnp.where(level, 1, directions) for bound in (lower, upper)]
    enter = jnp.where(level, jnp.where(inside, -jnp.inf, jnp.inf), jnp.minimum(*ends)).max(axis=-1)
    leave = jnp.where(level, jnp.inf, jnp.maximum(*ends)).min(axis=-1)
    near = jnp.clip(enter, rays.near, rays.far)
    return dataclasses.replace(rays, near=near, far=jnp.clip(leave, near, rays.far))


def is_occupied(grid, rays, t):
    """Returns [..., S], whether the cell around x(t) may be occupied; a t that is NaN counts, and shows."""
    index, inside = _cell(grid, _along(grid, rays, t))
    return (inside & grid.occupied.reshape(-1)[index]) | jnp.isnan(t)


def mask_samples(grid, rays, samples, *, max_optical_depth=jnp.inf):
    """Returns the Samples [..., S], with delta 0 where the grid is empty or where a sample hardly shows.

    That is a guess for training, from the grid alone: no scene is asked.

    Args:
        grid: Grid. Its running mean is the guess: the peak would hide what still has to form.
        rays: Rays [...].
        samples: Samples [..., S].
        max_optical_depth: optical depth before a sample, by the guess, from which on it counts as hidden.

    Returns:
        Samples [..., S]; and hidden [...], whether a ray has samples left out that only the guess hides.
    """
    index, inside = _cell(grid, _along(grid, rays, samples.t))
    mean = jnp.where(inside & ~(samples.delta <= 0), grid.density_mean.reshape(-1)[index], -1)
    # A plain norm, as it is redone for every sample: a guess needs no care for directions of 1e-20.
    x, y, z = (rays.directions[..., axis] for axis in range(3))
    size = jnp.sqrt(x * x + y * y + z * z)[..., None]
    hidden = volume_rendering.exclusive_sum(jnp.maximum(mean, 0) * samples.delta * size) > max_optical_depth
    worth = ~(mean < 0) | jnp.isnan(samples.t)  # NaN counts, and shows
    kept = worth & ~hidden
    masked = dataclasses.replace(samples, delta=jnp.where(kept, samples.delta, 0))
    return masked, (worth & hidden).any(axis=-1)


def mask_scene(scene, grid):
    """Returns a scene with nothing where the grid is empty: what render_packed sees (arXiv:2201.05989).

    Args:
        scene: see render_samples.
        grid: Grid. Outside its box, too, there is nothing.

    Returns:
        A scene, whose density is 0, with gradient 0, in empty cells.
    """

    def restricted(x, viewdirs):
        density, rgb = scene(x, viewdirs)
        index, inside = _cell_around(grid, x)
        return jnp.where(inside & grid.occupied.reshape(-1)[index], density, 0), rgb

    return restricted


def drop_thin_density(scene, grid, threshold):
    """Returns a scene with nothing where its density is at most a threshold; what is NaN stays.

    Args:
        scene: see render_samples.
        grid: Grid, whose cells the threshold is of.
        threshold: see update_grid.
    """
    threshold = jnp.asarray(threshold, jnp.float32)

    def clear(x, viewdirs):
        density, rgb = scene(x, viewdirs)
        least = threshold.reshape(-1)[_cell_around(grid, x)[0]] if threshold.ndim else threshold
        return jnp.where(density <= least, 0, density), rgb

    return clear


def flat_index(places, shape):
    """Returns the indices [...] among all cells of a shape (X, Y, Z) of places, three times [...] int32.

    It is a sum over a stack, as XLA ends a loop there on a CPU: where one loop finds cells and looks into
    them, none of that is vectorised.
    """
    strides = jnp.array([shape[1] * shape[2], shape[2], 1]).reshape(3, *(1,) * places[0].ndim)
    return (jnp.stack(places) * strides).sum(axis=0)


def _widen(occupied):
    """Returns the cells that are occupied or share a side with one that is."""
    wide = occupied
    for axis in range(3):
        window = tuple(3 if i == axis else 1 for i in range(3))
        wide |= jax.lax.reduce_window(occupied, False, jax.lax.bitwise_or, window, (1, 1, 1), "SAME")
    return wide


def _along(grid, rays, t):
    """Returns x(t), three times [..., S], in cells from the box's lower corner."""
    places = []
    for axis in range(3):
        scale = _cells_per_unit(grid, axis)
        start = (rays.origins[..., axis] - grid.lower[axis]) * scale
        places.append(start[..., None] + t * (rays.directions[..., axis] * scale)[..., None])
    return places


def _cells_per_unit(grid, axis):
    return grid.occupied.shape[axis] / (grid.upper[axis] - grid.lower[axis])


def _cell_around(grid, x):
    """Returns _cell of positions x [..., 3]."""
    return _cell(grid, [(x[..., i] - grid.lower[i]) * _cells_per_unit(grid, i) for i in range(3)])


def _cell(grid, places):
    """Returns the flat index of the cell at each of the places, and whether they are inside the box."""
    along, inside = [], True
    if grid.contracted:
        places = _contracted(places, grid.occupied.shape)
    for place, size in zip(places, grid.occupied.shape, strict=True):
        inside &= (place >= 0) & (place < size)
        along.append(jnp.clip(place.astype(jnp.int32), 0, size - 1))
    return flat_index(along, grid.occupied.shape), inside


def _contracted(places, shape):
    """Returns where contract puts places, three times [...] in cells; axis by axis, as that is faster."""
    along = [place * (4 / size) - 2 for place, size in zip(places, shape, strict=True)]
    largest = jnp.maximum(jnp.maximum(*map(jnp.abs, along[:2])), jnp.abs(along[2]))
    safe = jnp.maximum(largest, 1)
    # Infinitely far away the box has an end, and what lies there is in its last cell.
    scale = jnp.minimum((2 - 1 / safe) / safe, _JUST_INSIDE / safe)
    return [(value * scale + 2) * (size / 4) for value, size in zip(along, shape, strict=True)]
