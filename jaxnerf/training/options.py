"""The options of a training run and of its evaluation that belong to no other part."""

import dataclasses

import jax

from jaxnerf.data.ray_batches import BATCHINGS
from jaxnerf.models.base import ViewOptions
from jaxnerf.options import Ablation, Box, Changes, Device, Facts, at_least, between, infer, is_auto, option
from jaxnerf.runtime import devices
from jaxnerf.training.optimizer import OptimizerOptions

UNLIMITED_STEPS = 10**7  # max_steps of a run that max_seconds ends
_STEPS_PER_ROOT_PIXEL = 1000  # training steps are proportional to the root of an image's side in pixels
_FACTOR_OF_SEVERAL_RAYS = 8  # at which a pixel of an image averages so much that one ray blurs the field
_SHORT_SECONDS, _SHORT_STEPS = 30.0, 2000  # a shorter run is better with more pixels than with sharper ones


@dataclasses.dataclass(frozen=True)
class TrainOptions(OptimizerOptions):
    """The options of training: the optimizer's, and those of batches, length and records of a run."""

    batch_size: int = option(
        1024,
        "Rays per step, over all devices. auto: as many as the sampler says, of which `cpu_batch_size` is the usual "
        "number; the sampler `occupancy` takes twice as many for a large hash grid, and on an accelerator as many as "
        "keep it busy, in the same number of steps.",
        range=at_least(1),
        auto=True,
    )
    cpu_batch_size: int = option(1024, "see `batch_size`", range=at_least(1), changes=Changes.NOTHING)
    microbatch_size: int = option(
        "auto", "rays per gradient accumulation", range=at_least(1), auto=True, changes=Changes.SPEED
    )
    batching: str = option(
        "all_images", "where a step draws its rays; `single_image`: from one view", choices=BATCHINGS
    )
    rays_per_side: int = option(
        1,
        "Rays along each side of a pixel in the last part of training and in images: their mean is the pixel's colour. "
        "A step then takes as many rays, and fewer pixels. auto: 2 where alpha bounds the scene and `data.factor` is 8 "
        "or more, as one ray blurs the field then, in runs of at least 30 s or 2,000 steps; otherwise 1.",
        range=at_least(1),
        auto=True,
        changes=Changes.MODEL,
        ablations=(
            Ablation(
                "several rays a pixel", 1, more=lambda n, options, facts: None if facts.trains_cameras else max(n, 2)
            ),
        ),
    )
    one_ray_fraction: float = option(
        0.6, "fraction of training before which a pixel has one ray, see `rays_per_side`", range=between(0, 1)
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
        rays = facts.rays_per_step
        options, lines = infer(self, batch_size=(rays, f"batch         {rays:,} rays per step: {facts.rays_reason}"))
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
        options, rays_of_pixel = infer(options, rays_per_side=options._rays_per_side(facts))
        return options, lines + more + last + rays_of_pixel

    def _rays_per_side(self, facts):
        """Returns the rays along a pixel's side, and the line that reports them."""
        reasons = {
            "alpha does not bound the scene": not facts.has_alpha,
            f"data.factor is {facts.factor}": facts.factor < _FACTOR_OF_SEVERAL_RAYS,
            "cameras are trained": facts.trains_cameras,
            f"train.max_seconds is {self.max_seconds:g}": 0 < self.max_seconds < _SHORT_SECONDS,
            f"train.max_steps is {self.max_steps}": self.max_steps < _SHORT_STEPS,
            f"train.batch_size is {self.batch_size}": self.batch_size % 4,
            f"train.microbatch_size is {self.microbatch_size}": not is_auto(size := self.microbatch_size) and size % 4,
        }
        for reason, holds in reasons.items():
            if holds:
                return 1, f"pixels        1 ray each, as {reason}"
        start = 100 * self.one_ray_fraction
        return 2, f"pixels        4 rays each after {start:g} % of training, as data.factor is {facts.factor}"

    def resolve_for_device(self, device: Device) -> tuple["TrainOptions", list[str]]:
        """Infers how the rays of a step are grouped."""
        size = 0
        if is_auto(self.microbatch_size):
            if is_auto(self.batch_size):
                raise ValueError("train.batch_size is 'auto'; resolve the config against a dataset, or set a number")
            together = self._rays_per_pixel
            size = together * devices.default_microbatch(
                self.batch_size // jax.device_count() // together, together * device.samples_per_ray, device.platform
            )
        return infer(self, microbatch_size=(size, f"microbatch    {size} rays, for this device"))

    @property
    def _rays_per_pixel(self):
        return 1 if is_auto(self.rays_per_side) else self.rays_per_side**2

    def check(self, box: Box | None = None) -> None:
        for name in ("batch_size", "microbatch_size"):
            value = getattr(self, name)
            if not is_auto(value) and value % self._rays_per_pixel:
                raise ValueError(
                    f"{name} is {value} and rays_per_side {self.rays_per_side}, expected a multiple of "
                    f"{self._rays_per_pixel}, the rays of a pixel; change one of them"
                )
        for name in ("max_steps", "lr_steps"):
            value = getattr(self, name)
            if not is_auto(value) and value >= UNLIMITED_STEPS and not self.max_seconds:
                raise ValueError(
                    f"{name} is {value:,}, which means that --config.train.max_seconds ends the run, and that is 0; "
                    "set a time, or start another run with a number of steps"
                )

    def bytes_needed(self, box: Box | None) -> dict[str, float]:
        """Returns those of the rays and colours of a step, at least."""
        return {} if is_auto(self.batch_size) else {"batch_size": 64 * self.batch_size}


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
