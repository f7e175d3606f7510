"""The training step: draw rays, render them, and descend on the weighted sum of the losses."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, ArrayLike, Float, Int

from jaxnerf.core.losses import squared_error
from jaxnerf.core.types import Rendering, Renderings
from jaxnerf.core.views import Views
from jaxnerf.data import ray_batches
from jaxnerf.data.active_pixels import PixelRuns
from jaxnerf.models.base import Model
from jaxnerf.training.camera_parameters import CameraParameters, networks
from jaxnerf.training.dead_networks import count_dead_steps
from jaxnerf.training.state import PROGRESS, TrainState


class ProgressData(NamedTuple):
    """What the progress of training depends on beside the step; data, so that it is no constant of a compiled step.

    Attributes:
        steps: float32 [], at which the progress is 1.
        time_fraction: float32 [], the fraction that has passed of a limited time; 0 where it is not limited.
    """

    steps: Any
    time_fraction: Any

    def at(self, step: jax.typing.ArrayLike) -> jax.Array:
        """Returns the progress in [0, 1] when a number of steps are done: by steps or by time, which is larger."""
        by_steps = jnp.asarray(step, jnp.float32) / self.steps
        return jnp.clip(jnp.maximum(by_steps, self.time_fraction), 0, 1)


class TrainData(NamedTuple):
    """What training steps read; no step writes it.

    Attributes:
        seed: uint32 []. It is data, not a constant, so that runs with different seeds share a compiled step.
        views: of the split "train".
        active_pixels: the pixels to draw from; None: all.
        cells: [M] int32, the cells of the grid that are updated; None without a grid.
        radii: [2] float32 world units, smallest and largest radius of a pixel's cone, see `update_grid`; None where
            the model does not ask for the radius, or has no grid.
        decay: DecayData of the learning rate; None: as the optimizer's options say.
        progress: ProgressData; None where neither the model nor the number of rays of a pixel depends on the progress.
    """

    seed: Any
    views: Views
    active_pixels: PixelRuns | None
    cells: Any
    decay: Any = None
    progress: Any = None
    radii: Any = None


class StepLoss(NamedTuple):
    """A loss of the training step.

    Attributes:
        name: of the loss, see `register_loss`.
        function, on, needs: see `register_loss`.
        weight: step -> number.
    """

    name: str
    function: Callable[..., Any]
    on: str
    weight: Callable[[Any], Any]
    needs: tuple[str, ...] = ()


class PixelRays(NamedTuple):
    """The rays of a pixel on a regular grid, each in its cell's middle, from some progress of training on.

    A pixel of an image that was shrunk by area is a mean over what it covers. A field that is trained to show it along
    one ray blurs what is finer than a pixel; the mean over several rays leaves that sharp.

    Both parts of training are one program: the rays of a step are as many, and a second one would have to be compiled.

    Attributes:
        side: rays along a side of a pixel in the last part; at least 2.
        start: the progress at which that part begins; before it, a pixel has one ray.
    """

    side: int
    start: float

    def side_at(self, progress: Float[ArrayLike, ""]) -> Int[Array, ""]:
        """Returns the rays along a side of a pixel at a progress of training."""
        return jnp.where(progress >= self.start, self.side, 1)

    def averaged(self, rendering: Rendering, rays_per_side: Int[ArrayLike, ""]) -> Rendering:
        """Returns a Rendering [B] in which each ray has what its pixel shows, the mean over the pixel's rays.

        A ray whose pixel has a ray with dropped samples has them, too. Weights and samples stay those of each ray.

        Args:
            rendering: of rays of which each side^2 are of one pixel.
            rays_per_side: `side` or 1; for 1 the Rendering stays as it is.

        Raises:
            ValueError: if the rays are not those of whole pixels.
        """
        count = self.side**2
        if rendering.num_dropped.size % count:
            raise ValueError(
                f"{rendering.num_dropped.size} rays of a microbatch on a device, expected a multiple of {count}, the "
                "rays of a pixel; change train.batch_size, train.microbatch_size or train.rays_per_side"
            )

        def of_pixels(values: jax.Array, reduce=jnp.mean) -> jax.Array:
            rays = values.reshape(-1, count, *values.shape[1:])
            return jnp.where(rays_per_side > 1, reduce(rays, axis=1, keepdims=True), rays).reshape(values.shape)

        means = {name: of_pixels(getattr(rendering, name)) for name in ("rgb", "opacity", "depth", "disparity")}
        return dataclasses.replace(rendering, num_dropped=of_pixels(rendering.num_dropped, jnp.sum), **means)


@dataclasses.dataclass(frozen=True)
class TrainStep:
    """The pure training step: train_step(state, data, positions, *, axis_name=None) -> (state, metrics).

    Its two halves may be programs of their own, so that each of several threads computes the gradient of a part of the
    rays.

    Attributes:
        gradient: (state, data, positions) -> total: sums over the rays at some positions, and their gradient.
        finish: (state, data, *totals, axis_name=None) -> (state, metrics), from the totals of parts of the batch.
    """

    gradient: Callable[..., tuple]
    finish: Callable[..., tuple]

    def __call__(self, state: TrainState, data: Any, positions: jax.Array, *, axis_name: str | None = None) -> tuple:
        """Takes a step; see `make_train_step`."""
        return self.finish(state, data, self.gradient(state, data, positions), axis_name=axis_name)


def make_train_step(
    model: Model,
    optimizer: optax.GradientTransformation,
    draw: Callable[..., tuple],
    losses: Sequence[StepLoss],
    cameras: CameraParameters | None = None,
    pixel_rays: PixelRays | None = None,
) -> TrainStep:
    """Makes the pure training step.

    Args:
        model: see `Model`.
        optimizer: an optax gradient transformation.
        draw: (step, positions [B], data) -> (keys [B], Batch [B]); see `draw_batch`.
        losses: at least one must be a loss of the renderings.
        cameras: the parameters of the training images; None: none.
        pixel_rays: the several rays of a pixel that `draw` then draws; None: each ray is a pixel.

    Returns:
        train_step(state, data, positions, *, axis_name=None) -> (state, metrics).

        `data` is TrainData; for a model without a grid it may be anything that `draw` accepts. `positions` is
        [N, B] int32, the positions of this device's rays in the whole batch, in N microbatches. These run one
        after the other and their gradients are summed, so the activations of only B rays must fit into the
        cache or memory. With [P, N, B], P such parts run at once, as far as the device does so. With an
        `axis_name` all sums also run over that axis of devices, as under `jax.pmap` or `jax.shard_map`.

        `metrics` are scalars: "loss", "mse_<name>" of each network that renders images, "loss_<name>" of
        each loss (unweighted) if there are several, "grad_norm", the number of "rays" that were not dropped,
        and the counters. These are "nonfinite", the steps whose loss or gradient was not finite, which leave
        parameters and optimizer unchanged; "nonfinite_in_a_row"; "dead_<name>" of each such network, see
        `count_dead_steps`; "num_reinits", which only reinitialization changes; with a grid "rays_dropped",
        the rays that were ignored because some of their samples did not fit into the sample buffer; and "progress"
        if the model asks for it.
    """
    ray_losses = [loss for loss in losses if loss.on == "renderings"]
    regularizers = [loss for loss in losses if loss.on != "renderings"]

    def loss_of_rays(params, state, data, positions):
        """Returns the weighted sum of the losses of the rays at some positions; and sums of what is logged."""
        keys, batch = draw(state.step, positions, data)
        if cameras is not None:
            batch = cameras.refined_batch(params, batch, data.views)
        given = {**params, **_progress_at(state.step, model, data)}
        renderings = model.render(keys, given, state.grid, batch.rays, state.step)
        if cameras is not None:
            renderings = cameras.exposed(params, renderings, batch)
        if pixel_rays is not None:
            side = pixel_rays.side_at(data.progress.at(state.step))
            renderings = {name: pixel_rays.averaged(each, side) for name, each in renderings.items()}
        renderings = Renderings(renderings, model.image_networks)
        complete = renderings[-1].num_dropped == 0

        def total(values):
            return jnp.where(complete, values, 0).sum()

        parts = {loss.name: total(_value(loss, complete.shape, renderings, batch)) for loss in ray_losses}
        weighted = sum(loss.weight(state.step) * parts[loss.name] for loss in ray_losses)
        errors = zip(model.image_networks, renderings, strict=True)
        sums = {f"mse_{name}": total(squared_error(rendering, batch)) for name, rendering in errors}
        sums |= {"rays": complete.sum(dtype=jnp.int32), "dropped": (~complete).sum(dtype=jnp.int32)}
        if len(losses) > 1:
            sums |= {f"loss_{name}": part for name, part in parts.items()}
        return weighted, sums

    def sums_and_gradient(state, data, positions):
        differentiated = jax.value_and_grad(loss_of_rays, has_aux=True)
        (loss, sums), grads = differentiated(state.params, state, data, positions)
        return {"loss": loss, **sums}, grads

    def gradient(state, data, positions):
        # XLA adds the gradient of the second part to the hash grid's table of the first.
        parts = positions if positions.ndim == 3 else [positions]
        return _sum([_sum_over_microbatches(lambda each: sums_and_gradient(state, data, each), part) for part in parts])

    def finish(state, data, *totals, axis_name=None):
        total = _sum(totals)
        if axis_name is not None:
            total = jax.lax.psum(total, axis_name)
        sums, grads = total
        rays, dropped = sums.pop("rays"), sums.pop("dropped")
        scale = 1 / jnp.maximum(rays, 1)
        metrics = jax.tree.map(lambda leaf: leaf * scale, sums)
        errors = {name: metrics[f"mse_{name}"] for name in model.image_networks}
        dead = count_dead_steps(state.counters, networks(grads), errors, model.fields, scale)
        if regularizers:
            grads, scale = jax.tree.map(lambda leaf: leaf * scale, grads), 1.0
            metrics, grads = _regularized(regularizers, state, metrics, grads)
        metrics["grad_norm"] = scale * optax.tree.norm(grads)
        finite = jnp.isfinite(metrics["loss"]) & jnp.isfinite(metrics["grad_norm"])
        params, opt_state = _descend_if(finite, optimizer, state, grads, scale, getattr(data, "decay", None))
        missed = (~finite).astype(jnp.int32)
        counters = {
            **dead,
            "num_reinits": state.counters["num_reinits"],
            "nonfinite": state.counters["nonfinite"] + missed,
            "nonfinite_in_a_row": (state.counters["nonfinite_in_a_row"] + 1) * missed,
        }
        grid = state.grid
        if model.grid_schedule is not None:
            counters["rays_dropped"] = state.counters["rays_dropped"] + dropped
            # No ray has this position in the batch, so the key is unused otherwise.
            key = jax.random.fold_in(ray_batches.step_key(data.seed, state.step), 2**32 - 2)
            now = {**params, **_progress_at(state.step, model, data)}
            grid = model.grid_schedule.update(key, state.step, now, grid, data.cells, getattr(data, "radii", None))
        counters |= _progress_at(state.step + 1, model, data)
        state = TrainState(step=state.step + 1, params=params, opt_state=opt_state, grid=grid, counters=counters)
        return state, {**metrics, "rays": rays, **counters}

    return TrainStep(gradient, finish)


def repeat_step(train_step: Callable[..., tuple], num_steps: int) -> Callable[..., tuple]:
    """Makes a function that takes several training steps in one dispatch: the host waits for the device less often.

    Args:
        train_step: see `make_train_step`.
        num_steps: at least 1.

    Returns:
        The function with the arguments of train_step. Its metrics are arrays [num_steps]; for one step they are those
        of train_step, and so is the function. The state is the same, bit for bit in float32 on a CPU.
    """
    if num_steps == 1:
        return train_step

    def repeated(state, data, positions, **options):
        return jax.lax.scan(lambda state, _: train_step(state, data, positions, **options), state, length=num_steps)

    return repeated


def _progress_at(step, model, data):
    """Returns the entry "progress" of the parameters at a step; none if the model does not ask for it."""
    return {PROGRESS: data.progress.at(step)} if PROGRESS in model.needs else {}


def _sum(trees):
    return functools.reduce(functools.partial(jax.tree.map, jnp.add), trees)


def _sum_over_microbatches(function, positions):
    if positions.shape[0] == 1:
        return function(positions[0])

    def add(total, part):
        return jax.tree.map(jnp.add, total, function(part)), None

    zeros = jax.tree.map(jnp.zeros_like, jax.eval_shape(function, positions[0]))
    return jax.lax.scan(add, zeros, positions)[0]


def _value(loss, shape, *arguments):
    """Returns what a loss returns for its arguments, one value per ray or of the parameters; ValueError on all else."""
    value = loss.function(*arguments)
    found = () if isinstance(value, int | float) else getattr(value, "shape", type(value).__name__)
    if found != shape:
        raise ValueError(f"losses.{loss.name}: the function returned {found}, expected the shape {shape}")
    return value


def _regularized(regularizers, state, metrics, grads):
    """Adds the regularizers' values to the metrics and to the loss, and their gradients."""
    for loss in regularizers:
        value, gradient = jax.value_and_grad(lambda params, loss=loss: _value(loss, (), params))(networks(state.params))
        weight = loss.weight(state.step)
        metrics[f"loss_{loss.name}"] = value
        metrics["loss"] += weight * value
        grads |= jax.tree.map(lambda a, b, weight=weight: a + weight * b, networks(grads), gradient)
    return metrics, grads


def _descend_if(finite, optimizer, state, grads, scale, decay):
    """Returns the parameters and the optimizer's state after an update by scale * grads; if not finite, unchanged."""
    options = {} if decay is None else {"decay": decay}

    def descend():
        # The optimizer's own passes over the gradient scale it: a pass more would take long for a large table.
        mean = jax.tree.map(lambda leaf: leaf * scale, grads)
        updates, opt_state = optimizer.update(mean, state.opt_state, state.params, **options)
        return optax.apply_updates(state.params, updates), opt_state

    def selected():
        return jax.tree.map(lambda new, old: jnp.where(finite, new, old), descend(), (state.params, state.opt_state))

    # On a CPU a branch: the selection would take about as long as the update itself. On an accelerator it is part
    # of the update's kernels, and a branch would make the host wait for its condition.
    branch = functools.partial(jax.lax.cond, finite, descend, lambda: (state.params, state.opt_state))
    return jax.lax.platform_dependent(cpu=branch, default=selected)
