"""The pose of an image in a known scene: least squares on the colours, with exact derivatives and a covariance."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Key, Num

from jaxnerf.core.cameras import rays_from_pixels
from jaxnerf.core.poses import se3_exponential
from jaxnerf.core.rendering import render_rays
from jaxnerf.core.types import Background, Camera, Rays, Rendering, SceneFn, check_shapes, pytree

_SIDE = 32  # rows and columns of the coarse grid of pixels
_BLURS = (4.0, 1.5)  # standard deviations in its cells
_COARSE_TOLERANCE = 1e-2  # fraction of the squared residuals that a further step may remove
_DAMPINGS = (1e-3, 1e-4, 20.0)  # the first and the smallest; beyond the last no step helps, as colours are rough
_SINGULAR = 1e-6  # of eigenvalues of a matrix whose diagonal is 1: its sums in float32 are no more exact
_ROUNDING = 1e-4  # of colours: residuals below do not make a pose more certain


@pytree()
class PoseEstimate:
    """The pose of an image, see `estimate_pose`.

    Attributes:
        pose: [3, 4] camera to world.
        focal: [2] px; that of the given camera unless it is estimated.
        gains: [3] the factors of the scene's colours; 1 unless they are estimated.
        covariance: [6, 6] of the twist from the true pose to this one: a rotation vector about the camera's position
            in radians, then a translation in world units, both along the axes of the world. All of it is inf where
            the image leaves a direction open.
        converged: whether the step that remains is within the standard deviations, and the image determines the pose.
        residual: RMS difference of the colours.
        iterations: number of renderings of the pixels, over all stages.
    """

    pose: Float[Array, "3 4"]
    focal: Float[Array, "2"]
    gains: Float[Array, "3"]
    covariance: Float[Array, "6 6"]
    converged: Bool[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]


def estimate_pose(
    scene: SceneFn,
    image: Num[ArrayLike, "H W 3"],
    camera: Camera,
    start: Num[ArrayLike, "3 4"],
    *,
    near: Num[ArrayLike, ""],
    far: Num[ArrayLike, ""],
    num_samples: int = 128,
    background: Background | None = None,
    render: Callable[[SceneFn, Rays], Rendering] | None = None,
    key: Key[Array, ""] | None = None,
    pixels: Int[ArrayLike, "N 2"] | None = None,
    num_pixels: int = 8192,
    with_focal: bool = False,
    with_gains: bool = False,
    max_iterations: int = 30,
    chunk: int = 1024,
) -> PoseEstimate:
    """Estimates the pose from which a known scene looks like an image (after iNeRF, arXiv:2012.05877).

    Minimises the squared differences of the colours over rigid motions of the camera by the method of Levenberg (1944)
    and Marquardt (1963), with the exact derivatives J of the rendered colours in forward mode. Pixels of a coarse grid
    are compared first, blurred, which finds the pose from farther away; then random pixels, not blurred. The covariance
    is that of Gauss and Newton, (J^T J)^-1 times the variance of the residuals. It holds if these are independent, as
    noise is; where the scene itself is inexact, the errors of neighbouring pixels are alike, and it is too small.

    Args:
        scene: see `render_rays`.
        image: [H, W, 3] in [0, 1].
        camera: of the image, with its focal length, center and lens; its own pose does not count.
        start: [3, 4] a pose near the true one, camera to world.
        near: see `rays_from_pixels`.
        far: see `rays_from_pixels`.
        num_samples: see `render_rays`.
        background: see `render_rays`.
        render: (scene, rays [N]) -> Rendering [N], which has derivatives in forward mode, in place of render_rays; of a
            run: lambda _, rays: render(rays), with the function that `load_scene` returns.
        key: of the choice of pixels; None: a fixed one.
        pixels: [N, 2] columns and rows of the pixels that are compared, without a coarse grid; None: random ones.
        num_pixels: the largest number of random pixels.
        with_focal: whether a factor of the focal length is estimated, too.
        with_gains: whether a gain per colour channel is estimated, too, such as a change of exposure.
        max_iterations: the largest number of steps of each stage.
        chunk: rays rendered at once.

    Returns:
        PoseEstimate. An image without texture gives converged = False and a covariance of inf or of large numbers. A
        start that is too far away may lead to another minimum, whose residual is larger.

    Raises:
        ValueError: if an array has another shape.
    """
    start = jnp.asarray(start, jnp.float32)
    check_shapes("estimate_pose", image=(image, "H W 3"), start=(start, "3 4"))
    options = FitOptions(num_pixels, with_focal, with_gains, max_iterations, chunk)
    camera = dataclasses.replace(camera, to_world=start, height=None, width=None)
    key = jax.random.key(0) if key is None else key
    colors, context = _SceneColors(scene, render, num_samples), (near, far, background)
    return fit_camera(colors, context, Target(image), camera, options, key=key, pixels=pixels)


class FitOptions(NamedTuple):
    """How a camera is fitted to an image, see `estimate_pose`.

    Attributes:
        num_pixels, with_focal, with_gains, max_iterations, chunk: see there.
        pixel_offset: see `pixel_grid`.
        tolerance: the square of the step that may remain, in standard deviations.
    """

    num_pixels: int = 8192
    with_focal: bool = False
    with_gains: bool = False
    max_iterations: int = 30
    chunk: int = 1024
    pixel_offset: float = 0.5
    tolerance: float = 0.02


class Target(NamedTuple):
    """An image to which a camera is fitted.

    Attributes:
        rgb: [H, W, 3].
        mask: [H, W] False for pixels that do not count; None: all do.
        behind: [H, W, 3] the part of the colours that gains leave as it is; None: 0.
    """

    rgb: Num[ArrayLike, "H W 3"]
    mask: Bool[ArrayLike, "H W"] | None = None
    behind: Num[ArrayLike, "H W 3"] | None = None


class _SceneColors(NamedTuple):
    """The colours of a scene at pixels; equal for the same functions, so that they are compiled once."""

    scene: SceneFn
    render: Callable[[SceneFn, Rays], Rendering] | None
    num_samples: int

    def __call__(self, context, camera, pixels):
        near, far, background = context
        rays = rays_from_pixels(camera, pixels, near=near, far=far)
        if self.render is not None:
            return self.render(self.scene, rays).rgb
        return render_rays(None, self.scene, rays, num_samples=self.num_samples, background=background).rgb


class _Observed(NamedTuple):
    """Pixels [N, 2] px, their colours [N, 3], the part [N, 3] of these that gains leave as it is, and which count."""

    pixels: Array
    rgb: Array
    behind: Array
    weight: Array


class _Fit(NamedTuple):
    """A camera and gains; the residuals [M] there; their slopes [M, P] near it, or at it if fresh."""

    camera: Camera
    log_gains: Array
    residuals: Array
    slopes: Array
    fresh: Array
    renew: Array
    damping: Array
    iterations: Array
    done: Array


def fit_camera(
    colors: Callable[..., Float[Array, "N 3"]],
    context: Any,
    target: Target,
    camera: Camera,
    options: FitOptions,
    *,
    key: Key[Array, ""],
    pixels: Int[ArrayLike, "N 2"] | None = None,
) -> PoseEstimate:
    """Does what `estimate_pose` does for any function that renders pixels.

    Args:
        colors: (context, camera, pixels [N, 2]) -> [N, 3], hashable.
        context: a pytree.
        target: the image.
        camera: at the starting pose.
        options: of the fit.
        key, pixels: see estimate_pose.
    """
    image, (height, width) = jnp.asarray(target.rgb, jnp.float32), jnp.shape(target.rgb)[:2]
    behind = jnp.zeros_like(image) if target.behind is None else jnp.asarray(target.behind, jnp.float32)
    mask = jnp.ones((height, width), bool) if target.mask is None else jnp.asarray(target.mask)

    def observed(rows, columns):
        at = jnp.stack([columns, rows], axis=-1).astype(jnp.float32) + options.pixel_offset
        return _Observed(at, image[rows, columns], behind[rows, columns], mask[rows, columns].astype(jnp.float32))

    camera = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), camera)
    log_gains, iterations = jnp.zeros(3), 0
    if pixels is None:
        sides = min(_SIDE, height), min(_SIDE, width)
        rows = jnp.repeat((2 * jnp.arange(sides[0]) + 1) * height // (2 * sides[0]), sides[1])
        columns = jnp.tile((2 * jnp.arange(sides[1]) + 1) * width // (2 * sides[1]), sides[0])
        coarse = observed(rows, columns)
        for deviation in _BLURS:
            blur = tuple(_blur(side, deviation) for side in sides)
            enough = _COARSE_TOLERANCE * 3 * sides[0] * sides[1]
            found, _ = _fit(colors, context, (camera, log_gains), coarse, blur, enough, options=options)
            camera, log_gains, iterations = found.camera, found.log_gains, iterations + found.iterations
        order = jnp.argsort(jax.random.uniform(key, (height * width,)) + ~mask.reshape(-1))
        chosen = order[: min(options.num_pixels, height * width)]
        rows, columns = chosen // width, chosen % width
    else:
        check_shapes("estimate_pose", pixels=(pixels, "N 2"))
        columns, rows = jnp.asarray(pixels).T
    final = (camera, log_gains), observed(rows, columns), None, options.tolerance
    found, (covariance, converged) = _fit(colors, context, *final, options=options)
    return PoseEstimate(
        pose=found.camera.to_world,
        focal=found.camera.focal,
        gains=jnp.exp(found.log_gains),
        covariance=covariance[:6, :6],
        converged=converged,
        residual=jnp.sqrt((found.residuals**2).sum() / (3 * mask[rows, columns].sum())),
        iterations=iterations + found.iterations,
    )


@functools.partial(jax.jit, static_argnames=("colors", "options"))
def _fit(colors, context, start, observed, blur, tolerance, *, options):
    """Minimises the squared residuals; returns the _Fit, and the covariance [P, P] and whether it has converged."""
    problem = _Problem(colors, context, observed, blur, tolerance, options)
    found = _Fit(
        *start,
        problem.residuals(*start),
        slopes=jnp.zeros((observed.rgb.size, problem.count + 3 * options.with_gains)),
        fresh=jnp.bool_(False),
        renew=jnp.bool_(True),
        damping=jnp.float32(_DAMPINGS[0]),
        iterations=jnp.int32(1),
        done=jnp.bool_(False),
    )
    goes_on = lambda fit: ~fit.done & (fit.iterations < options.max_iterations)  # noqa: E731
    found = jax.lax.while_loop(goes_on, functools.partial(_advance, problem), found)
    _, _, (values, axes, squares) = _solve(problem, found)
    regular = (values[0] > _SINGULAR) & (squares < jnp.inf)  # not where NaN
    freedom = jnp.maximum(problem.number - len(values), 1)
    covariance = (axes / jnp.where(regular, values, 1)[None]) @ axes.T * squares / freedom
    converged = found.done & regular & (jnp.diagonal(covariance)[:3] < 1).all()
    return found, (jnp.where(regular, covariance, jnp.inf), converged)


class _Problem(NamedTuple):
    """What `_fit` minimises, by the names of its arguments."""

    colors: Callable[..., Array]
    context: Any
    observed: _Observed
    blur: tuple[Array, Array] | None
    tolerance: Array
    options: FitOptions

    @property
    def count(self):
        """The number of unknowns of the camera."""
        return 6 + self.options.with_focal

    @property
    def number(self):
        """The number of colours that are compared."""
        return 3 * self.observed.weight.sum()

    def residuals(self, camera, log_gains):
        """Returns [M]."""
        rgb = self._by_chunk(lambda pixels: self.colors(self.context, camera, pixels))
        light = jnp.exp(log_gains)[None] * (rgb - self.observed.behind)
        return self._weighted((light + self.observed.behind - self.observed.rgb)[..., None])[:, 0]

    def slopes(self, camera, log_gains):
        """Returns the derivatives [M, P] of the residuals."""

        def at(change, pixels):
            rgb = self.colors(self.context, moved(camera, change), pixels)
            return rgb, rgb

        def of_chunk(pixels):
            slopes, rgb = jax.jacfwd(at, has_aux=True)(jnp.zeros(self.count), pixels)
            return jnp.concatenate([slopes, rgb[..., None]], axis=-1)

        found, gains = self._by_chunk(of_chunk), jnp.exp(log_gains)[None, :, None]
        slopes = gains * found[..., :-1]
        if self.options.with_gains:
            light = gains * (found[..., -1:] - self.observed.behind[..., None])
            slopes = jnp.concatenate([slopes, light * jnp.eye(3)[None]], axis=-1)
        return self._weighted(slopes)

    def _by_chunk(self, render):
        count = len(self.observed.pixels)
        size = min(self.options.chunk, count)
        index = jnp.minimum(jnp.arange(-(-count // size) * size), count - 1)
        parts = jax.lax.map(render, self.observed.pixels[index].reshape(-1, size, 2))
        return parts.reshape(-1, *parts.shape[2:])[:count]

    def _weighted(self, values):
        """Returns [M, P] of [N, 3, P]: weighted, and blurred on the grid."""
        values = values * self.observed.weight[:, None, None]
        if self.blur is not None:
            values = values.reshape(*map(len, self.blur), -1)
            values = jnp.einsum("ri,ijk,cj->rck", self.blur[0], values, self.blur[1], precision="highest")
        return values.reshape(self.observed.rgb.size, -1)


def _solve(problem, fit, damping=0.0):
    """Returns the step, the fraction of the squares that one without damping removes, and the decomposed matrix."""
    gradient, matrix = (jnp.matmul(fit.slopes.T, of, precision="highest") for of in (fit.residuals, fit.slopes))
    scale = jnp.sqrt(jnp.diagonal(matrix))
    scale = jnp.where(scale > 0, scale, 1)
    values, axes = jnp.linalg.eigh(matrix / scale[:, None] / scale[None])
    along = (axes * (gradient / scale)[:, None]).sum(axis=0)
    step = -(axes * (along / (jnp.maximum(values, _SINGULAR) + damping))[None]).sum(axis=1) / scale
    squares = jnp.maximum((fit.residuals**2).sum(), jnp.maximum(problem.number, 1) * _ROUNDING**2)
    removed = (along**2 / jnp.maximum(values, _SINGULAR)).sum() / squares
    return step, removed, (values, axes / scale[:, None], squares)


def _advance(problem, fit):
    """Takes a step if it reduces the squared residuals, with the exact derivatives or those of an earlier step."""
    # Derivatives cost as much as ten renderings, so they are kept as long as steps with them do what they should.
    slopes = jax.lax.cond(fit.renew, lambda: problem.slopes(fit.camera, fit.log_gains), lambda: fit.slopes)
    fit = fit._replace(slopes=slopes, fresh=fit.fresh | fit.renew, renew=jnp.bool_(False))
    step, removed, (_, _, squares) = _solve(problem, fit, fit.damping)
    number, count, tolerance = problem.number, problem.count, problem.tolerance
    done = fit.fresh & (removed * number < tolerance)
    log_gains = fit.log_gains + step[count:] if problem.options.with_gains else fit.log_gains
    trial = fit._replace(camera=moved(fit.camera, step[:count]), log_gains=log_gains, fresh=jnp.bool_(False))
    trial = trial._replace(residuals=problem.residuals(trial.camera, log_gains))
    gain = (fit.residuals**2).sum() - (trial.residuals**2).sum()
    better = (gain > 0) & ~done
    found = jax.tree.map(lambda new, old: jnp.where(better, new, old), trial, fit)
    # The fraction of what the slopes predict: where colours are rough, they promise too much.
    kept = gain / jnp.maximum(removed * squares, 1e-30)
    renew = ~found.fresh & ~((kept > 0.5) & (kept < 2) & (_solve(problem, found)[1] * number > tolerance))
    factor = jnp.where(kept > 0.5, 0.1, jnp.where(kept > 0.2, 1, jnp.where(kept > 0, 3, 10)))
    damping = jnp.maximum(fit.damping * jnp.where(better | fit.fresh, factor, 1), _DAMPINGS[1])
    done |= (damping > _DAMPINGS[2]) | (better & fit.fresh & (gain * number < tolerance * squares))
    return found._replace(renew=renew, damping=damping, iterations=fit.iterations + 1, done=done)


def moved(camera: Camera, change: Float[ArrayLike, " P"]) -> Camera:
    """Moves a camera by a twist about its own position along the axes of the world, and zooms it.

    Args:
        camera: one Camera.
        change: [6] see `se3_exponential`, or [7] with the logarithm of a factor of the focal length.
    """
    motion, pose = se3_exponential(change[:6]), jnp.asarray(camera.to_world)
    # Sums of products instead of a matmul, which may round the camera to ten bits.
    axes = (motion[:, :3, None] * pose[None, :, :3]).sum(axis=1)
    pose = jnp.concatenate([axes, (pose[:, 3] + motion[:, 3])[:, None]], axis=1)
    return dataclasses.replace(camera, to_world=pose, focal=jnp.asarray(camera.focal) * jnp.exp(change[6:].sum()))


def _blur(side, deviation):
    """Returns [side, side], the matrix of a Gaussian blur along an axis."""
    offsets = jnp.arange(side)[:, None] - jnp.arange(side)[None]
    window = jnp.exp(-((offsets / deviation) ** 2) / 2)
    return window / window.sum(axis=1, keepdims=True)
