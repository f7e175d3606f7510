"""The cells of an occupancy grid that the training cameras see, and those that they see through or past."""

import dataclasses
import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxnerf.core import contraction
from jaxnerf.core.cameras import project, undistort
from jaxnerf.core.occupancy.grid import cells_along, create_grid, widen
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.core.sampling import samples_from_edges, uniform_edges
from jaxnerf.core.views import Views
from jaxnerf.data.geometry.free_space import scipy_spatial, surface_range
from jaxnerf.data.ray_batches import view_rays
from jaxnerf.models.grid_schedule import GridSchedule
from jaxnerf.runtime import cores, stages

_CHUNK = 2**10  # rays
_CUBE = 8  # cells along each side of a cube, of which all or none are looked at for a view
_CHUNK_CUBES = 32  # that are looked at at once, so that their arrays fit the processor's cache
_SLOPES = 128  # directions along each side of an image that are looked up
_STEEPEST = 10.0  # of these: 84 degrees from the axis
_FREE_SAMPLES = 16  # between a camera and a surface
_CLEARANCE = 0.75  # of the distance from a camera to the nearest matter: nothing is within that, in any direction
_FEW_POINTS = 16  # nearest to a camera: fewer may be wrong matches
_JUST_INSIDE = 2 * (1 - 1e-4)  # contracted space ends at 2, which is at infinity


def seen_cells(
    views: Views, schedule: GridSchedule, *, min_views: int
) -> tuple[Bool[np.ndarray, "X Y Z"], Bool[np.ndarray, "X Y Z"]]:
    """Returns the cells that at least min_views views see, and those that are free.

    A view sees a cell if it sees one of its corners between near and far. A cell is free if it is in front of
    `Views.free_depth` for two of the views that see it, or for the only one, or if it touches a sphere around a camera
    of the radius `clear_radii`. What few cameras show close to a camera's place has little parallax, so a field would
    put fog there that hides the scene from cameras beside that place.

    Args:
        views: of the split that is trained on; a masked pixel sees nothing.
        schedule: of the box.
        min_views: at least 1.

    Raises:
        ValueError: if the lens of a view shows no pixel; names the view.
    """
    cubes = tuple(-(-size // _CUBE) for size in schedule.shape)
    number, num_slabs = math.prod(cubes), cores.num_at_once()
    length = -(-number // num_slabs)
    count = _view_counter(views, schedule, cubes, length)
    # Each slab has cubes from everywhere, so that all take as long; some cubes may repeat.
    slabs = np.minimum(np.arange(length * num_slabs), number - 1).reshape(length, num_slabs).T
    cells = np.zeros((2, number, _CUBE, _CUBE, _CUBE), bool)
    with stages.stage("finding the cells that the cameras see, by images") as stage:
        counts = cores.map_on_cores(functools.partial(count, stage), slabs)
        for slab, (num_seen, num_free, clear) in zip(slabs, counts, strict=True):
            free = clear | ((num_free > 0) & (num_free >= np.minimum(num_seen, 2)))
            cells[:, slab] = num_seen >= min_views, free
    return tuple(_joined(each, cubes, schedule.shape) for each in cells)


def clear_radii(views: Views) -> Float[np.ndarray, " V"]:
    """Returns the radius [V], in world units, of a sphere around each camera in which there is no matter.

    A photographer stands there, and where nothing in the image is close, nothing beside the image is much closer, in
    general. The radius is 0.75 times the distance to the nearest matter: `Views.free_depth`, or the distance to the
    16th nearest sparse point, seen from there or not, if that is less. It is 0 where neither is known, and without
    `Views.free_depth`.
    """
    if views.free_depth is None:
        return np.zeros(len(views.offset), np.float32)
    known = np.asarray(views.free_depth)
    nearest = np.where(known > 0, known, np.inf)
    if views.sparse is not None and len(views.sparse.positions) >= _FEW_POINTS:
        centers = np.asarray(views.cameras.to_world)[:, :, 3]
        distances, _ = scipy_spatial().cKDTree(views.sparse.positions).query(centers, [_FEW_POINTS])
        nearest = np.minimum(nearest, distances[:, 0])
    return np.float32(np.where(np.isinf(nearest), 0, _CLEARANCE * nearest))


def likely_empty_cells(
    views: Views, schedule: GridSchedule, *, min_views: int = 2, pixel_offset: float = 0.5
) -> Bool[np.ndarray, "X Y Z"]:
    """Returns the cells in front of the surfaces that views see, or where no view sees a surface.

    The surfaces are those of `surface_range`, so without sparse points no cell is likely to be empty.

    Args:
        views: of the split that is trained on.
        schedule: of the box.
        min_views: number of views that must tell that a cell is in front of a surface.
        pixel_offset: see `draw_batch`.
    """
    if views.sparse is None:
        return np.zeros(schedule.shape, bool)
    lower, upper = (jnp.asarray(bound, jnp.float32) for bound in (schedule.lower, schedule.upper))
    everywhere = np.ones(schedule.shape, bool)
    grid = create_grid(lower, upper, everywhere, initial_density=0.0, contracted=schedule.contracted)

    @jax.jit
    def cells_between(rays, near, far):
        edges = uniform_edges(rays.near, jnp.maximum(rays.near, near), num_segments=_FREE_SAMPLES)
        rays = dataclasses.replace(rays, near=jnp.maximum(rays.near, near), far=jnp.clip(far, rays.near, rays.far))
        samples = march_rays(None, grid, rays, step_size=min(schedule.cell), cell=schedule.cell)
        return cells_along(grid, rays, samples_from_edges(None, edges)), cells_along(grid, rays, samples)

    cameras = dataclasses.replace(views, pixels=np.zeros((1, 1), np.uint8), mask=None, sparse=None)
    surface = np.zeros(grid.valid.size + 1, bool)
    in_front = np.zeros((min_views, surface.size), bool)  # of a surface, by at least 1, 2, ... views

    def cells_of(view):
        pixels = _some_pixels(views, view, max(schedule.shape) // 2) + pixel_offset
        near, far = surface_range(views, view, pixels)
        of_view = np.zeros_like(surface)
        for start in range(0, len(pixels), _CHUNK):
            index = np.minimum(np.arange(start, start + _CHUNK), len(pixels) - 1)  # a single compiled shape
            before, between = cells_between(_view_rays(cameras, view, pixels[index]), near[index], far[index])
            of_view[np.asarray(before)] = surface[np.asarray(between)] = True
        return of_view

    with stages.stage("finding the cells in front of surfaces, by images") as stage:
        for done, of_view in enumerate(cores.map_on_cores(cells_of, range(len(views.offset)), compiles=True), 1):
            stage.update(done, len(views.offset))
            for fewer, more in reversed(list(itertools.pairwise(in_front))):
                more |= fewer & of_view
            in_front[0] |= of_view
    surface, in_front = (cells[:-1].reshape(schedule.shape) for cells in (surface, in_front[-1]))
    return ~np.asarray(widen(surface)) | in_front


def _view_counter(views, schedule, cubes, size):
    """Returns the function (stage, slab) -> counts in a slab of so many cubes, compiled.

    The counts are, for the cells of each cube of a slab, how many views see them, how many of these see them free, and
    whether they touch a clear sphere. Only cubes of cells are looked at whose boxes, see `_boxes`, a view may see.
    """
    free_depth = np.zeros(len(views.offset), np.float32) if views.free_depth is None else views.free_depth
    known = views.cameras.to_world, clear_radii(views), views.near, views.far, free_depth
    stack = *(np.asarray(each, np.float32) for each in known), *map(np.asarray, _shown_slopes(views))
    boxes, padding = _boxes(schedule, cubes), (-size) % _CHUNK_CUBES + size

    @functools.partial(jax.jit, donate_argnums=0)
    def count(counts, seen_by, slab, indices, num_chunks):
        def add(chunk, counts):
            chosen = jax.lax.dynamic_slice_in_dim(indices, chunk * _CHUNK_CUBES, _CHUNK_CUBES)
            seen, behind, clear = map(_any_corner, _sees(seen_by, _corners(schedule, cubes, slab[chosen])))
            before = [each[chosen] for each in counts]
            after = before[0] + seen, before[1] + (seen & ~behind), before[2] | clear
            return tuple(each.at[chosen].set(new) for each, new in zip(counts, after, strict=True))

        return jax.lax.fori_loop(0, num_chunks, add, counts)

    def no_counts():  # the last cube takes what is only padding
        return tuple(np.zeros((size + 1, _CUBE, _CUBE, _CUBE), kind) for kind in (np.int32, np.int32, bool))

    def count_views(stage, slab):
        counts, ids, of_slab = no_counts(), np.int32(np.append(slab, slab[-1])), [each[slab] for each in boxes]
        for view in range(len(views.offset)):
            stage.update(view, len(views.offset))
            seen_by = tuple(each[view] for each in stack)
            indices = np.flatnonzero(_may_see(*seen_by[:4], *seen_by[5:7], *of_slab))
            num_chunks = np.int32(-(-len(indices) // _CHUNK_CUBES))
            indices = np.append(indices, np.full(padding - len(indices), size))
            counts = compiled(counts, seen_by, ids, np.int32(indices), num_chunks)
        return [np.asarray(each)[:-1] for each in counts]

    # Here, as the calls that several threads make at once would compile it as often.
    integers = (jax.ShapeDtypeStruct(shape, np.int32) for shape in ((size + 1,), (padding,), ()))
    compiled = count.lower(no_counts(), tuple(each[0] for each in stack), *integers).compile()
    return count_views


def _corners(schedule, cubes, ids):
    """Returns the positions [3, N, _CUBE + 1, _CUBE + 1, _CUBE + 1] of the corners of the cells of N cubes."""
    first = jnp.stack(jnp.unravel_index(jnp.minimum(ids, math.prod(cubes) - 1), cubes)) * _CUBE
    place = first.reshape(3, -1, 1, 1, 1) + jnp.indices((_CUBE + 1,) * 3)[:, None]
    lower, upper = np.float32([schedule.lower, schedule.upper]).reshape(2, 3, 1, 1, 1, 1)
    place = place / np.float32(schedule.shape).reshape(3, 1, 1, 1, 1)
    if schedule.contracted:
        place = jnp.moveaxis(jnp.clip(4 * place - 2, -_JUST_INSIDE, _JUST_INSIDE), 0, -1)
        place = (jnp.moveaxis(contraction.expand(place), -1, 0) + 2) / 4
    return lower + place * (upper - lower)


def _boxes(schedule, cubes):
    """Returns the lower and upper corners [N, 3] of boxes that hold the cells' corners of each cube; float64."""
    number = math.prod(cubes)

    @jax.jit
    def bounds(ids):
        corners = _corners(schedule, cubes, ids)
        return corners.min(axis=(2, 3, 4)), corners.max(axis=(2, 3, 4))

    padded = np.arange(-(-number // _CHUNK_CUBES) * _CHUNK_CUBES).reshape(-1, _CHUNK_CUBES)
    parts = zip(*(bounds(ids) for ids in padded), strict=True)
    return tuple(np.concatenate(part, axis=1).T[:number].astype(np.float64) for part in parts)


def _may_see(to_world, clear_radius, near, far, least, scale, lower, upper):
    """Returns which boxes [N] a view may see, or has around its camera. It includes all boxes that the view sees."""
    turn, eye = np.float64(to_world[:, :3]), to_world[:, 3]
    middle, half = (lower + upper) / 2 - eye, (upper - lower) / 2 * (1 + 1e-5)
    ahead, beyond = -turn[:, 2], least + _SLOPES / scale
    inside = np.ones(len(lower), bool)
    for normal, offset in (
        (ahead, -near),
        (-ahead, far),
        *((turn[:, axis] - least[axis] * ahead, 0) for axis in range(2)),
        *((beyond[axis] * ahead - turn[:, axis], 0) for axis in range(2)),
    ):
        inside &= middle @ normal + half @ np.abs(normal) + offset >= 0
    nearest = np.maximum(np.abs(middle) - half, 0)
    return inside | ((nearest**2).sum(axis=1) < clear_radius**2 * (1 + 1e-5))


def _joined(parts, cubes, shape):
    """Returns the cells [X, Y, Z] of cubes [N, _CUBE, _CUBE, _CUBE]."""
    x, y, z = cubes
    grid = parts.reshape(x, y, z, _CUBE, _CUBE, _CUBE).transpose(0, 3, 1, 4, 2, 5)
    return grid.reshape(x * _CUBE, y * _CUBE, z * _CUBE)[: shape[0], : shape[1], : shape[2]]


def _sees(seen_by, x):
    """Returns which of the positions x [3, ...] a view sees, sees behind its free space, and has around its camera."""
    to_world, clear_radius, near, far, free_depth, least, scale, shown = seen_by
    offset = [x[axis] - to_world[axis, 3] for axis in range(3)]
    right, up, back = (sum(to_world[i, axis] * offset[i] for i in range(3)) for axis in range(3))
    depth = -back
    ahead = (depth >= near) & (depth <= far) & (depth > 0)
    safe = jnp.where(ahead, depth, 1)
    column, row = ((value / safe - least[i]) * scale[i] for i, value in enumerate((right, up)))
    inside = (column >= 0) & (row >= 0) & (column < _SLOPES) & (row < _SLOPES)
    column, row = (jnp.where(inside, value, 0).astype(jnp.int32) for value in (column, row))
    seen = ahead & inside & shown[row, column]
    close = sum(value**2 for value in offset) < clear_radius**2
    return seen, seen & (depth >= free_depth), close


def _shown_slopes(views):
    """Returns which directions (x, y, -1) from its camera each view [V] shows, as a table; masked pixels show none.

    A look into the table is much faster than a projection through a lens.

    Returns:
        The least x and y [V, 2], entries per unit of x and y [V, 2], and the table [V, _SLOPES, _SLOPES], y first.
    """
    least, scale, shown = [], [], []
    pixels = np.stack(np.meshgrid(*[np.linspace(0, 1, _SLOPES // 4)] * 2), axis=-1)
    for view, (height, width) in enumerate(np.asarray(views.size)):
        camera = jax.tree.map(lambda leaf, view=view: np.asarray(leaf)[view], views.cameras)
        camera = dataclasses.replace(camera, to_world=np.eye(3, 4, dtype=np.float32))
        slopes, exists = map(np.asarray, _undistort(camera, pixels * [width, height]))
        if not exists.any():
            name = views.names[view] if views.names else view
            raise ValueError(
                f"view {name}: its lens shows no pixel, expected a camera that does; correct its distortion"
            )
        slopes = np.clip(slopes[exists] * [1, -1], -_STEEPEST, _STEEPEST)
        lower, upper = slopes.min(axis=0), slopes.max(axis=0)
        x, y = (lower + (upper - lower) * (np.arange(_SLOPES) + 0.5)[:, None] / _SLOPES).T
        places = np.stack([*np.meshgrid(x, y), np.full([_SLOPES] * 2, -1.0)], axis=-1)
        at = np.asarray(_project(camera, places)[0])
        inside = ((at >= 0) & (at < [width, height])).all(axis=-1)
        if views.mask is not None:
            column, row = np.moveaxis(np.where(inside[..., None], at, 0).astype(int), -1, 0)
            inside &= np.asarray(views.mask)[views.offset[view] + row * width + column]
        least.append(lower), scale.append(_SLOPES / (upper - lower)), shown.append(inside)
    return jnp.float32(least), jnp.float32(scale), jnp.array(shown)


_undistort = jax.jit(undistort)
_project = jax.jit(project)


def _any_corner(flags):
    """Returns for each cell whether any of its corners is flagged; flags are one longer along each axis."""
    for axis in range(-3, 0):
        size = flags.shape[axis]
        flags = jax.lax.slice_in_dim(flags, 0, size - 1, axis=axis) | jax.lax.slice_in_dim(flags, 1, size, axis=axis)
    return flags


def _some_pixels(views, view, number):
    """Returns the places [N, 2] of about number x number unmasked pixels of a view."""
    height, width = np.asarray(views.size)[view]
    side = max(int(np.sqrt(height * width) / number), 1)
    y, x = (places.reshape(-1) for places in np.mgrid[side // 2 : height : side, side // 2 : width : side])
    if views.mask is not None:
        first = views.offset[view]
        unmasked = np.asarray(views.mask[first : first + height * width]).reshape(height, width)[y, x]
        y, x = y[unmasked], x[unmasked]
    return np.stack([x, y], axis=-1).astype(np.float32)


_view_rays = jax.jit(view_rays)
