"""The options of a training run and of its evaluation that belong to no other part."""

import dataclasses
import math

import jax

from jaxnerf.data.ray_batches import BATCHINGS
from jaxnerf.models.base import ViewOptions
from jaxnerf.options import Changes, Device, Facts, at_least, infer, is_auto, option
from jaxnerf.runtime import devices, processes
from jaxnerf.training.dead_networks import CHECK_EVERY
from jaxnerf.training.optimizer import OptimizerOptions

UNLIMITED_STEPS = 10**7  # max_steps of a run that max_seconds ends
_STEPS_PER_ROOT_PIXEL = 1000  # training steps are proportional to the root of an image's side in pixels
_MAX_STEPS_PER_DISPATCH = 16  # on an accelerator, where a dispatch costs as much as a small step


@dataclasses.dataclass(frozen=True)
class TrainOptions(OptimizerOptions):
    """The options of training: the optimizer's, and those of batches, length and records of a run."""

    batch_size: int = option(
        1024,
        "Rays per step, over all devices. auto: `cpu_batch_size` on a CPU, twice as many for a large hash grid, and "
        "`cpu_batch_size` with the sampler `hierarchical`; on an accelerator with the sampler `occupancy` as many as "
        "keep it busy, in the same number of steps.",
        range=at_least(1),
        auto=True,
    )
    cpu_batch_size: int = option(1024, "see `batch_size`", range=at_least(1), changes=Changes.NOTHING)
    microbatch_size: int = option(
        "auto", "rays per gradient accumulation", range=at_least(1), auto=True, changes=Changes.SPEED
    )
    steps_per_dispatch: int = option(
        "auto",
        "training steps between which the host does nothing",
        range=at_least(1),
        auto=True,
        changes=Changes.SPEED,
    )
    batching: str = option(
        "all_images", "where a step draws its rays; `single_image`: from one view", choices=BATCHINGS
    )
    parallel: str = option(
        "auto",
        "how the step runs on several devices; `auto`: `jit` on one device, otherwise `sharded`",
        choices=devices.MODES,
        changes=Changes.SPEED,
    )
    deterministic: bool = option(
        False,
        "whether sums on an accelerator have a fixed order, so that a run repeated on the same device gives the same "
        "bits; a step of the hash grid then takes a quarter longer. On a CPU they always have.",
        changes=Changes.SPEED,
    )
    max_steps: int = option(
        200_000,
        "steps after which the run ends; auto: by the size of the images and `batch_size`, without limit if time is "
        "limited",
        range=at_least(1),
        auto=True,
        changes=Changes.NOTHING,
    )
    max_seconds: float = option(
        0.0,
        "time of training, without compilation, after which the run ends; 0: no limit. The learning rate then reaches "
        "its end when the time does, so that the run depends on the clock.",
        unit="s",
        range=at_least(0),
        changes=Changes.NOTHING,
    )
    log_every: int = option(
        100, "interval of rows of metrics", unit="steps", range=at_least(1), changes=Changes.NOTHING
    )
    save_every: int = option(5000, "interval of checkpoints", unit="steps", range=at_least(1), changes=Changes.NOTHING)
    preview_every: float = option(
        60.0,
        "time of training between previews, images of a held-out view in previews/; 0: none. It increases to a tenth "
        "of the time that has passed, and to ten times that which a preview takes.",
        unit="s",
        range=at_least(0),
        changes=Changes.NOTHING,
    )
    max_to_keep: int = option(3, "checkpoints that are kept", range=at_least(1), changes=Changes.NOTHING)
    max_nonfinite: int = option(
        20,
        "consecutive steps without a finite gradient, after which the run fails",
        range=at_least(1),
        changes=Changes.NOTHING,
    )
    max_reinits: int = option(
        10,
        "reinitializations of dead networks before the run fails; 0: no check",
        range=at_least(0),
        changes=Changes.NOTHING,
    )

    def resolve(self, facts: Facts, device: Device) -> tuple["TrainOptions", list[str]]:
        """Infers the numbers of rays per step and of steps.

        A run is planned as a number of rays: steps of fewer rays than would be inferred are more steps. An
        accelerator takes more rays in the same number of steps.
        """
        rays, why = self.cpu_batch_size, "train.cpu_batch_size"
        if facts.sampler == "occupancy" and facts.large_field:
            rays, why = 2 * rays, "twice train.cpu_batch_size, as the hash grid's table is large"
        if facts.busy_rays is not None:
            rays, why = facts.busy_rays, "they keep this device busy"
        options, lines = infer(self, batch_size=(rays, f"batch         {rays:,} rays per step: {why}"))
        batch, side = options.batch_size, facts.side
        planned = steps = max(round(_STEPS_PER_ROOT_PIXEL * side**0.5 * rays / batch), 1)
        why = f"{planned:,} steps of {batch:,} rays, for images of {side:.0f} x {side:.0f} px"
        if self.max_seconds:
            steps, why = UNLIMITED_STEPS, f"ends after train.max_seconds = {self.max_seconds:g}"
        options, more = infer(options, max_steps=(steps, f"training      {why}"))
        decay, end = options.max_steps, f"step {options.max_steps:,}"
        if decay >= UNLIMITED_STEPS and device.num_processes == 1:
            end = "the end"
        elif decay >= UNLIMITED_STEPS:  # several processes have no common clock
            decay, end = planned, f"step {planned:,}"
        options, last = infer(options, lr_steps=(decay, f"training      learning rate decays until {end}"))
        return options, lines + more + last

    def resolve_for_device(self, device: Device) -> tuple["TrainOptions", list[str]]:
        """Infers how the rays of a step, and the steps, are grouped."""
        used = devices.devices_of(self.parallel)
        size = 0
        if is_auto(self.microbatch_size):
            if is_auto(self.batch_size):
                raise ValueError("train.batch_size is 'auto'; resolve the config against a dataset, or set a number")
            size = devices.default_microbatch(self.batch_size // len(used), device.samples_per_ray, device.platform)
        most = 1 if device.is_cpu else _MAX_STEPS_PER_DISPATCH
        whole = math.gcd(*host_intervals(self))
        steps = max(count for count in range(1, most + 1) if whole % count == 0)
        return infer(
            self,
            microbatch_size=(size, f"microbatch    {size} rays, for this device"),
            steps_per_dispatch=(steps, f"dispatch      {steps} training steps at a time, for this device"),
        )

    def check(self) -> None:
        for name in ("max_steps", "lr_steps"):
            value = getattr(self, name)
            if not is_auto(value) and value >= UNLIMITED_STEPS and not self.max_seconds:
                raise ValueError(
                    f"{name} is {value:,}, which means that --config.train.max_seconds ends the run, and that is 0; "
                    "set a time, or start another run with a number of steps"
                )

    def bytes_needed(self) -> dict[str, float]:
        """Returns those of the rays and colours of a step, at least."""
        return {} if is_auto(self.batch_size) else {"batch_size": 64 * self.batch_size}


def host_intervals(train: TrainOptions) -> tuple[int, ...]:
    """Returns the numbers of steps at whose multiples training logs, saves or decides on the host."""
    intervals = (train.log_every, train.save_every)
    if train.max_reinits:
        intervals += (CHECK_EVERY,)
    return intervals + ((processes.AGREE_EVERY,) if jax.process_count() > 1 else ())


@dataclasses.dataclass(frozen=True)
class EvalOptions(ViewOptions):
    """The options of evaluation: those of images, and which of them are scored when."""

    split: str = option("test", "the split that is scored", changes=Changes.NOTHING)
    at_end: bool = option(False, "whether the split is scored when training ends", changes=Changes.NOTHING)
    summary_seconds: float = option(
        5.0,
        "time for scoring some training and some held-out views each when training ends; 0: none",
        unit="s",
        range=at_least(0),
        changes=Changes.NOTHING,
    )
