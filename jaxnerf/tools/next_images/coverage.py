"""The directions from which cameras have seen the cells of a trained run, and how familiar a further view is."""

import heapq
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from jaxnerf.core.occupancy.grid import cells_along
from jaxnerf.core.occupancy.ray_marching import march_rays
from jaxnerf.core.types import Rays
from jaxnerf.core.views import Views
from jaxnerf.evaluation.metrics import pixel_mask
from jaxnerf.evaluation.restore import TrainedRun
from jaxnerf.models.occupancy import render_with_grid
from jaxnerf.tools.next_images.seen_directions import familiarity_scene, nearest_direction

_CHUNK = 2**13  # rays whose cells are listed at once
_SIDE = 40  # rays along each side of an image that is scored
_LEAST_OPACITY = 1e-4  # of an image that shows anything
_BLOCKED = 0.5  # opacity of a line through which no camera can be moved


class ViewScore(NamedTuple):
    """How familiar a view is.

    Attributes:
        score: mean over its rays of the sum of w_i (1 + cos a_i) / 2, see `familiarity_scene`. Light that passes the
            scene counts as familiar where images have alpha, so that it comes from nothing, and otherwise as unseen.
        shown: the same mean over what the view shows: with alpha, over the matter alone; 1 if it shows none.
    """

    score: float
    shown: float

    @property
    def angle(self) -> float:
        """From how far aside it has been seen, degrees: of which `shown` is (1 + cos) / 2; 180: not at all."""
        return float(np.degrees(np.arccos(np.clip(2 * self.shown - 1, -1, 1))))


class ViewCoverage:
    """The directions from which cameras have seen each occupied cell of a run's grid.

    A camera sees a cell if one of its rays reaches the cell, or one that touches it, before half of the light is lost.
    The rays are one for each cell along the grid's longest side, in both directions of the image, and half the light is
    lost at the median depth of the trained field. So a camera costs one small rendering, whatever the number of cells
    is, and any field and sampler will do. The cells that touch those on the rays are those between the rays, and those
    just behind a soft surface, from which part of a ray's colour comes. In normalised device coordinates the cells are
    those of the box, and directions those of the world.
    """

    def __init__(self, run: TrainedRun, variables: tuple):
        """Makes the coverage of no camera.

        Args:
            run: restored with a grid, as with the setting bake_occupancy=True.
            variables: of its checkpoint.
        """
        grid = variables[1]
        self._run, self._variables, self._shape = run, variables, grid.occupied.shape
        cell = [float(side) / count for side, count in zip(grid.upper - grid.lower, self._shape, strict=True)]
        self._steps = {"step_size": min(cell), "cell": cell}
        self._words, self._seen = np.zeros(self._shape, np.uint64), None
        self._occupied = np.asarray(grid.occupied)
        self._list, self._render = jax.jit(self._cells_and_direction), jax.jit(self._rendered)

    def clear(self) -> None:
        """Removes all cameras."""
        self._words[:], self._seen = 0, None

    def add(self, views: Views, index: int) -> None:
        """Adds a camera of Views; masked pixels see nothing."""
        height, width = (int(side) for side in views.size[index])
        pixels = _positions(height, width, max(self._shape))
        rays = self._run.experiment.view_rays(views, index, pixels)
        depth = self._run.render_image(self._variables, rays, median_depth=True).median_depth
        mask = pixel_mask(views, index)
        if mask is not None:
            column, row = np.moveaxis(pixels.astype(int), -1, 0)
            depth = jnp.where(jnp.asarray(mask)[row, column], depth, -jnp.inf)
        rays, depth = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (rays, depth))
        words, self._seen = self._words.reshape(-1), None
        for start in range(0, depth.size, _CHUNK):
            chosen = np.minimum(np.arange(start, start + _CHUNK), depth.size - 1)  # a single compiled shape
            part = jax.tree.map(lambda leaf, chosen=chosen: leaf[chosen], (rays, depth))
            cells, direction = map(np.asarray, self._list(self._variables[1], *part))
            ray, sample = (cells < words.size).nonzero()
            np.bitwise_or.at(words, cells[ray, sample], np.uint64(1) << direction[ray].astype(np.uint64))

    def score(self, views: Views, index: int) -> ViewScore:
        """Returns how familiar the view of a camera is."""
        height, width = (int(side) for side in views.size[index])
        rays = self._run.experiment.view_rays(views, index, _positions(height, width, _SIDE))
        behind = float(np.shape(views.pixels)[-1] == 4)
        score, opacity = map(float, self._render(self._variables, self.seen(), rays, behind))
        shown = score
        if behind:
            shown = 1 - (1 - score) / opacity if opacity > _LEAST_OPACITY else 1.0
        return ViewScore(score, min(max(shown, 0.0), 1.0))

    def seen(self) -> UInt32[Array, "X Y Z 2"]:
        """Returns the words that `familiarity_scene` takes."""
        if self._seen is None:
            words = _widened(self._words)
            halves = [(words >> np.uint64(shift)) & np.uint64(0xFFFFFFFF) for shift in (0, 32)]
            self._seen = jnp.asarray(np.stack(halves, axis=-1).astype(np.uint32))
        return self._seen

    def num_directions(self) -> Int[np.ndarray, "X Y Z"]:
        """Returns the number of the 64 directions from which each cell has been seen; -1 where it is empty."""
        counts = np.bitwise_count(_widened(self._words)).astype(np.int32)
        return np.where(self._occupied, counts, -1)

    def is_free(self, starts: Float[np.ndarray, "N 3"], ends: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
        """Returns which straight lines [N] pass no matter; starts and ends in the run's world, which has no NDC."""
        offset = np.float32(ends - starts)
        length = np.maximum(np.linalg.norm(offset, axis=-1), 1e-6)
        zeros, needs = jnp.zeros(len(length), jnp.float32), self._run.experiment.model.needs
        rays = Rays(
            origins=jnp.float32(starts),
            directions=jnp.asarray(offset / length[:, None]),
            viewdirs=jnp.asarray(offset / length[:, None]),
            near=zeros,
            far=jnp.float32(length),
            radius=zeros if "radius" in needs else None,
            image_index=zeros.astype(jnp.int32) if "image_index" in needs else None,
        )
        return np.asarray(self._run.render_image(self._variables, rays).opacity) < _BLOCKED

    def _cells_and_direction(self, grid, rays, depth):
        """Returns the flat indices [B, S] of the cells that rays see, past the last where none, and directions [B]."""
        samples = march_rays(None, grid, rays, **self._steps)
        cells = cells_along(grid, rays, samples)
        occupied = jnp.append(grid.occupied.reshape(-1), False)[cells]
        reached = samples.t - samples.delta / 2 <= depth[:, None]
        return jnp.where(occupied & reached, cells, grid.occupied.size), nearest_direction(rays.viewdirs)

    def _rendered(self, variables, seen, rays, behind):
        """Returns the mean familiarity and opacity of rays."""
        grid, options = variables[1], self._run.experiment.config.eval
        scene = familiarity_scene(self._run.experiment.model.scene(*variables), grid, seen)
        sizes = {"early_stop_eps": options.early_stop_eps, "max_samples": options.max_samples}
        found = render_with_grid(scene, grid, rays, background=jnp.stack([behind]), **self._steps, **sizes)
        return found.rgb.mean(), found.opacity.mean()


def choose_views(
    coverage: ViewCoverage, views: Views, scores: Mapping[int, ViewScore], count: int, *, least_angle: float = 0.0
) -> list[tuple[int, ViewScore]]:
    """Chooses the least familiar views one after another; each is added to the coverage before the next is chosen.

    Seeing more never makes a view less familiar. So a score that was computed earlier bounds the present one from
    below, and only the views whose bounds are lowest are scored again (lazy greedy search, Minoux 1978).

    Args:
        coverage: of the cameras that there are; it is changed.
        views: whose cameras are candidates.
        scores: by index of the views that are candidates, their present ones.
        count: number of views to choose.
        least_angle: degrees; a view that has been seen from less far aside is not chosen.

    Returns:
        (index, ViewScore at the time of the choice) of each, in the order of choice.
    """
    queue = [(found, index, 0) for index, found in scores.items()]
    heapq.heapify(queue)
    chosen = []
    while queue and len(chosen) < count:
        found, index, known = heapq.heappop(queue)
        if found.angle < least_angle:
            continue
        if known == len(chosen):
            coverage.add(views, index)
            chosen.append((index, found))
        else:
            heapq.heappush(queue, (coverage.score(views, index), index, len(chosen)))
    return chosen


def _widened(words):
    """Returns the words [X, Y, Z] of cells and of all cells that touch them."""
    for axis in range(3):
        first, rest = ((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
        wide = words.copy()
        wide[first] |= words[rest]
        wide[rest] |= words[first]
        words = wide
    return words


def _positions(height, width, side):
    """Returns the positions [side, side, 2] px in the middle of equal parts of an image."""
    steps = (np.arange(side) + 0.5) / side
    return np.stack(np.meshgrid(width * steps, height * steps), axis=-1).astype(np.float32)
