"""The estimator "laplace": how far the training images let the scene be deformed (after arXiv:2309.03185).

The trained scene is a function of position. It is composed with a deformation, x + d(x), where d is linear between
the vertices of a grid, and the trained scene has d = 0. Around that point the rendered colours are linear in d, so that
the posterior of d is a normal distribution. Of its precision only the diagonal is kept:

    precision = sum over training rays of J^2 / noise + 1 / prior,

with J the derivative of a ray's colour with respect to a displacement. The predicted variance of any other ray's colour
is J' diag(1 / precision) J. Both are estimated by random signs, from products of the Jacobian with vectors alone: a
vjp for the first, a jvp for the second. Nothing needs to be known of the field or the sampler.
"""

import dataclasses
import functools
import os
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike, Float, Int

from jaxnerf.core import contraction
from jaxnerf.core.types import Rays, Vector
from jaxnerf.core.views import check_pixels
from jaxnerf.data.ray_batches import draw_batch
from jaxnerf.evaluation.image_renderer import image_renderer
from jaxnerf.evaluation.restore import TrainedRun
from jaxnerf.fields.base import Field
from jaxnerf.runtime import atomic_files, stages
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.tools.uncertainty.base import Estimate, UncertaintySource, fingerprint_of, folder_of, with_field_input

RESOLUTION = 64  # cells of the deformation along each axis of the box
# Each adds one random product: the precision then has a relative error of sqrt(2 / 32), and the standard deviation half
# of it. AUSE on held-out views of lego and the embedded scene is no smaller with 128.
NUM_BATCHES = 32
BATCH_SIZE = 1024  # rays
NUM_PROBES = 8  # deformations that a predicted variance is the mean of
_FILE = "laplace.npz"
_SMALLEST_SCALE = 1e-6  # of a contraction: at infinity it is 0
_LEAST_NOISE = 1 / (12 * 255**2)  # the variance of rounding to 8 bits


class Deformation(NamedTuple):
    """The posterior of the displacements of a run.

    Attributes:
        std: [R, R, R, 3] in (0, 1], in cells; 1, that of the prior, where no training ray says anything.
        noise: mean squared error of the training rays, the variance that is left of a known scene.
    """

    std: Float[Array, "R R R 3"]
    noise: Float[Array, ""]


def estimate_laplace(source: UncertaintySource) -> Estimate:
    """Makes the estimate of a run from one pass over rays of its training views.

    The score is the root of the predicted variance of the colour, mean over the channels, and the training
    rays' mean squared error.

    Raises:
        ValueError: if the run has no box.
    """
    posterior = load_deformation(source)
    render = image_renderer(_scored_rendering(source), source.run.experiment.config.eval.chunk, _cull(source))

    def score(rays: Rays):
        return render((source.variables, posterior), rays).rgb[..., 0]

    identity = f"laplace, {RESOLUTION} cells, {NUM_BATCHES} x {BATCH_SIZE} rays, {NUM_PROBES} probes"
    config = source.run.experiment.config
    return Estimate(score, identity, std_at(posterior, *_box_of(config), config.scene.contracted))


def std_at(posterior: Deformation, lower: Vector, upper: Vector, contracted: bool) -> Partial:
    """Makes the function x [..., 3] -> [...], the standard deviation of the displacement at positions, in cells.

    It is the RMS over the axes, in (0, 1]: 1, that of the prior, where the training rays do not fix the displacement,
    as in free space and inside of what is opaque, but also within surfaces of one colour.

    Args:
        posterior: see `Deformation`.
        lower, upper, contracted: see `deform`.

    Returns:
        The function. It is a pytree, so that it may be an argument of a jitted function.
    """
    return Partial(_contracted_std if contracted else _boxed_std, posterior.std, jnp.asarray(lower), jnp.asarray(upper))


def stored_uncertainty(run: TrainedRun, workdir: str | os.PathLike, step: int, params: Any) -> Partial | None:
    """Returns `std_at` of a checkpoint whose posterior has been computed before; None where it has not."""
    path = folder_of(workdir, step) / _FILE
    posterior = _stored(path, _key_of(fingerprint_of(run, params)))
    config = run.experiment.config
    return None if posterior is None else std_at(posterior, *_box_of(config), config.scene.contracted)


def _contracted_std(std, lower, upper, x):
    return _std_there(std, _place_in_box(x, lower, upper, True)[0])


def _boxed_std(std, lower, upper, x):
    return _std_there(std, _place_in_box(x, lower, upper, False)[0])


def _std_there(std, place):
    return jnp.sqrt((interpolate(std, (place + 2) * ((std.shape[0] - 1) / 4)) ** 2).mean(axis=-1))


def load_deformation(source: UncertaintySource) -> Deformation:
    """Returns the posterior of a checkpoint: from its file, or else computed and written there."""
    path, key = source.folder / _FILE, _key_of(source.fingerprint)
    posterior = _stored(path, key, source.say)
    if posterior is None:
        posterior = fit_deformation(source)
        source.folder.mkdir(parents=True, exist_ok=True)
        with atomic_files.partial_file(path, ".tmp.npz") as partial:
            np.savez(partial, key=key, **{name: np.asarray(value) for name, value in posterior._asdict().items()})
    return posterior


def _key_of(checkpoint):
    return fingerprint(checkpoint, RESOLUTION, NUM_BATCHES, BATCH_SIZE)


def _stored(path, key, say=lambda line: None):
    """Returns the posterior in a file; None if there is none, it is damaged, or it has another key."""
    if path.is_file():
        try:
            with np.load(path, allow_pickle=False) as stored:
                if str(stored["key"]) == key:
                    return _checked(stored["std"], stored["noise"])
        except Exception:  # a damaged zip file raises almost any exception
            say(f"{path}: is damaged, and computed again")
    return None


def _checked(std, noise):
    """Returns the posterior of two arrays of a file; ValueError if they cannot be one."""
    shapes = std.shape == (RESOLUTION + 1,) * 3 + (3,) and noise.shape == ()
    if not (shapes and std.dtype.kind == noise.dtype.kind == "f"):
        raise ValueError("other arrays")
    if not (std.min() >= 0 and std.max() <= 1 and 0 < noise < np.inf):  # not NaN either
        raise ValueError("other numbers")
    return Deformation(jnp.asarray(std, jnp.float32), jnp.asarray(noise, jnp.float32))


def fit_deformation(source: UncertaintySource) -> Deformation:
    """Computes the posterior in one pass over NUM_BATCHES batches of random training rays."""
    check_pixels(source.views, "the uncertainty 'laplace', which is computed once for each checkpoint,")
    experiment = source.run.experiment
    model = source.run.model_with({}, deform(*_box_of(experiment.config), experiment.config.scene.contracted))
    params, grid = source.variables
    views = dataclasses.replace(source.views, mask=None, sparse=None)
    given, step = experiment.config.data, jnp.int32(2**30)
    options = {"pixel_offset": given.pixel_offset, "ndc": given.ndc, "needs": model.needs}
    still = jnp.zeros((RESOLUTION + 1,) * 3 + (3,))

    @jax.jit
    def product(index, params, grid, views):
        keys, batch = draw_batch(np.uint32(0), index, jnp.arange(BATCH_SIZE), views, **options)

        def colors(displacement):
            rendered = model.render(keys, with_field_input(params, displacement), grid, batch.rays, step)
            return rendered[model.image_networks[-1]].rgb

        rgb, transpose = jax.vjp(colors, still)
        signs = jax.random.rademacher(jax.random.fold_in(keys[0], 1), rgb.shape, rgb.dtype)
        return transpose(signs)[0] ** 2, ((rgb - batch.rgb) ** 2).mean()

    squares, error = jnp.zeros_like(still), 0.0
    with stages.stage("estimating the uncertainty") as stage:
        for index in range(NUM_BATCHES):
            stage.update(index, NUM_BATCHES)
            more, mean = product(index, params, grid, views)
            squares, error = squares + more, error + mean / NUM_BATCHES
    noise = jnp.maximum(error, _LEAST_NOISE)
    rays = np.prod(np.asarray(views.size, np.int64), axis=1).sum()
    information = squares * (rays / (NUM_BATCHES * BATCH_SIZE)) / noise
    return Deformation(1 / jnp.sqrt(1 + information), noise)


def deform(lower: Vector, upper: Vector, contracted: bool):
    """Makes the function Field -> Field whose params are a pair: those of the field, and displacements.

    Args:
        lower, upper: [3] world units, corners of the box of the displacements.
        contracted: whether the box holds all of space, see `contract_field`. Cells grow there as it contracts them.

    Returns:
        The function. The displacements are [R + 1, R + 1, R + 1, 3], at the vertices, in cells of the box; outside
        a box that is not contracted they are those of its faces.
    """

    def wrap(field: Field) -> Field:
        @functools.wraps(field.apply)
        def apply(params, x, viewdirs, **inputs):
            params, displacement = params
            cells = displacement.shape[0] - 1
            place, unit = _place_in_box(x, lower, upper, contracted)
            moved = interpolate(displacement, (place + 2) * (cells / 4)) * (4 / cells * unit)
            return field.apply(params, x + moved, viewdirs, **inputs)

        return field._replace(apply=apply)

    return wrap


def _place_in_box(x, lower, upper, contracted):
    """Returns where positions [..., 3] are in a box that reaches from -2 to 2, and its unit there in world units."""
    lower, upper = (jnp.asarray(corner).reshape((1,) * (x.ndim - 1) + (3,)) for corner in (lower, upper))
    unit = (upper - lower) / 4
    place = (x - (lower + upper) / 2) / unit
    if not contracted:
        return place, unit
    scale = jnp.maximum(contraction.length_scale(place), _SMALLEST_SCALE)[..., None]
    return contraction.contract(place), unit / scale


def interpolate(values: Float[ArrayLike, "X Y Z C"], place: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch C"]:
    """Interpolates values at vertices linearly along each axis.

    Args:
        values: [X, Y, Z, C], each axis with at least two vertices.
        place: [..., 3] in cells, vertex (0, 0, 0) at 0; clipped to the grid. The result is NaN where it is.
    """
    most = jnp.asarray(values.shape[:3]).reshape((1,) * (jnp.ndim(place) - 1) + (3,)) - 1
    place = jnp.clip(place, 0, most)
    first = jnp.minimum(place.astype(jnp.int32), most - 1)
    part = place - first

    def corner(offset: Int[ArrayLike, "3"]):
        offset = offset.reshape(most.shape)
        index = first + offset
        weight = jnp.where(offset, part, 1 - part).prod(axis=-1)
        return weight[..., None] * values[index[..., 0], index[..., 1], index[..., 2]]

    return sum(corner(np.array(offset)) for offset in np.ndindex(2, 2, 2))


def _scored_rendering(source):
    """Returns the function ((variables, posterior), Rays [N]) -> Rendering [N] with the score in place of rgb."""
    experiment = source.run.experiment
    model = source.run.model_with({}, deform(*_box_of(experiment.config), experiment.config.scene.contracted))

    @jax.jit
    def render(variables, rays):
        (params, grid), posterior = variables
        keys = jax.random.split(jax.random.key(0), NUM_PROBES)
        still = jnp.zeros_like(posterior.std)

        def view(displacement):
            return model.view(with_field_input(params, displacement), grid, rays)

        def change(key):
            probe = posterior.std * jax.random.rademacher(key, still.shape, still.dtype)
            return jax.jvp(lambda displacement: view(displacement).rgb, (still,), (probe,))[1]

        variance = (jax.vmap(change)(keys) ** 2).mean(axis=(0, -1))
        return _with_score(view(still), jnp.sqrt(variance + posterior.noise))

    return render


def _cull(source):
    """Returns the function that `image_renderer` takes; None where the model has none."""
    model = source.run.model_with({})
    if model.cull is None:
        return None

    def cull(variables, rays):
        (_, grid), posterior = variables
        hits, empty = model.cull(grid, rays)
        return hits, _with_score(empty, jnp.broadcast_to(jnp.sqrt(posterior.noise), empty.opacity.shape))

    return jax.jit(cull)


def _with_score(rendering, score):
    return dataclasses.replace(rendering, rgb=jnp.broadcast_to(score[..., None], (*score.shape, 3)))


def _box_of(config):
    if config.scene.box is None:
        raise ValueError("scene.lower or scene.upper is 'auto', expected the box of the scene; set both")
    return config.scene.box
