"""Parameters of the training images that are trained with the networks: exposure, and corrections of the cameras.

They are in the entry "cameras" of the parameters. All start at values that change nothing. What the images leave
open, the common exposure and the position, orientation and scale of the world, is fixed by means over all images:
the scene keeps the colours of an average image, and the cameras of other splits still fit.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxnerf.core.poses import se3_exponential
from jaxnerf.core.safe_math import norm
from jaxnerf.core.types import Batch, Camera, Rays, Rendering
from jaxnerf.core.views import Views
from jaxnerf.data.image_agreement import agreement
from jaxnerf.models.base import Model
from jaxnerf.options import POSITIVE, Ablation, Changes, Device, Facts, Options, at_least, infer, is_auto, option
from jaxnerf.runtime.processes import Detail

_LEAST_ANGLE = 1e-3  # squared radians between axes, below which the point that they look at is undefined
_MIN_MATCHES = 2000  # of two images; fewer may be highlights and outlines of smooth bodies, which fit no cameras
_OFF = 0.8  # px; 0.2 to 0.5 with good cameras, 1.2 to 3.7 where they are off by 0.3 degrees
_BRIGHTNESS, _TINT = 0.06, 0.025  # 0.02 and 0.013 in captures of one exposure, 0.08 and 0.03 where it varies
CAMERAS = "cameras"  # the entry of the parameters; all other entries are networks


@dataclasses.dataclass(frozen=True)
class CameraOptions(Options):
    """The options of parameters of the training images, which are trained with the networks."""

    changes = Changes.TRAINING

    exposure: bool = option(
        False,
        "Whether each image has a gain per colour channel; renderings show the scene without it. Auto: where images "
        "show the same corners at different brightness or in other colours.",
        auto=True,
        ablations=(Ablation("exposures", without=False, more=True, aligned="colors"),),
    )
    exposure_lr: float = option(1e-2, "initial learning rate; it decays as that of the networks", range=POSITIVE)
    refine: bool = option(
        False,
        "Whether each pose is corrected, by turns and moves about what the cameras look at. Alpha then does not bound "
        "the scene, as outlines seen from wrong poses cut matter away. Auto: where images do not fit their cameras.",
        auto=True,
        ablations=(Ablation("refined poses", without=False, more=True, aligned="pose"),),
    )
    refine_focal: bool = option(False, "with `refine`: whether the focal length, common to all images, is, too")
    refine_lr: float = option(
        1e-3,
        "Initial learning rate of the corrections; it decays exponentially, to a hundredth. That of the focal length "
        "is a tenth. Poses that are off by ten degrees need 4e-3 from step 50 on, with which exact ones drift.",
        unit="radians, fractions of the distance of the cameras from what they look at and of the focal length",
        range=POSITIVE,
    )
    refine_start_step: int = option(
        200, "training step before which cameras do not move, as images fit no scene yet", range=at_least(0)
    )
    num_images: int = option("auto", "images of the split `train`; do not set it", auto=True, changes=Changes.NOTHING)

    def resolve(self, facts: Facts, device: Device) -> tuple["CameraOptions", list[str]]:
        """Infers the number of images."""
        return infer(self, num_images=(facts.num_views, ""))

    @property
    def any(self) -> bool:
        """Whether there are such parameters."""
        return self.exposure or self.refine


def resolve_cameras(options: CameraOptions, views: Views) -> tuple[CameraOptions, list[str]]:
    """Infers whether poses and exposures are trained, from corners that several images of the split "train" show.

    Returns:
        The options without "auto" in `refine` and `exposure`, and one line per inferred value with its reason.
    """
    if not (is_auto(options.refine) or is_auto(options.exposure)):
        return options, []
    found = agreement(views)
    poses = found.off > _OFF, f"matched corners are {found.off:.2f} px beside each other's epipolar lines, limit {_OFF}"
    brightness, tint = math.expm1(found.brightness), math.expm1(found.tint)
    gains = (
        brightness > _BRIGHTNESS or tint > _TINT,
        (
            f"corners differ by {brightness:.1%} in brightness, limit {_BRIGHTNESS:.1%}, and {tint:.1%} in colour, "
            f"limit {_TINT:.1%}"
        ),
    )
    if found.count < _MIN_MATCHES:
        poses = gains = False, f"only {found.count} corners of images match, which is too little to tell"
    elif views.time is not None:
        poses = gains = False, "images of a scene that moves do not tell"

    def inferred(name, is_on, why):
        line = f"{name:13} {'on' if is_on else 'off'}: {why}"
        return is_on, line if is_on else Detail(line)

    return infer(options, refine=inferred("refined poses", *poses), exposure=inferred("exposures", *gains))


class CameraParameters(NamedTuple):
    """The parameters that a run trains per image.

    Attributes:
        num_images: V of the split "train".
        exposure: whether each image has a gain per colour channel.
        refine: whether poses are corrected.
        view_rays: (Views, index, pixels) -> Rays.
        background: [3] the colour behind alpha, which exposure leaves as it is; None: black.
        refine_focal: whether the focal length is corrected where poses are.
    """

    num_images: int
    exposure: bool
    refine: bool
    view_rays: Callable[..., Rays]
    background: Sequence[float] | None = None
    refine_focal: bool = False

    @property
    def needs(self) -> tuple[str, ...]:
        """The optional fields of Batch that are read."""
        return ("image_index", *(["alpha"] if self.exposure else []), *(["pixel"] if self.refine else []))

    def init(self) -> dict[str, jax.Array]:
        """Returns the parameters before training: no exposure, no correction."""
        exposure = {"log_gains": jnp.zeros((self.num_images, 3))} if self.exposure else {}
        poses = {"twists": jnp.zeros((self.num_images, 6))} if self.refine else {}
        focal = {"log_focal": jnp.zeros(())} if self.refine and self.refine_focal else {}
        return exposure | poses | focal

    def added_to(self, model: Model) -> Model:
        """Returns a Model whose parameters have the entry "cameras"."""
        return model._replace(init=lambda key: {**model.init(key), CAMERAS: self.init()})

    def refined_batch(self, params: Mapping[str, Any], batch: Batch, views: Views) -> Batch:
        """Returns the batch with rays that depend on the parameters; as it is unless cameras are refined."""
        if not self.refine:
            return batch
        views = self.refined_views(params, views, "train")
        rays = jax.vmap(lambda index, pixel: self.view_rays(views, index, pixel))(batch.image_index, batch.pixel)
        return dataclasses.replace(batch, rays=rays)

    def exposed(
        self, params: Mapping[str, Any], renderings: Mapping[str, Rendering], batch: Batch
    ) -> Mapping[str, Rendering]:
        """Returns the renderings, by network, with the exposure of their images; as they are unless it is trained."""
        if not self.exposure:
            return renderings
        gains = exposure_gains(params[CAMERAS]["log_gains"])[batch.image_index]
        behind = 0.0
        if self.background is not None:
            behind = (1 - batch.alpha[:, None]) * jnp.asarray(self.background, gains.dtype)[None]

        def seen(rgb):
            rgb = behind + gains * (rgb - behind)
            # A saturated colour says that there was at least so much light.
            return jnp.where(batch.rgb >= 1, jnp.minimum(rgb, 1), rgb)

        return {name: dataclasses.replace(each, rgb=seen(each.rgb)) for name, each in renderings.items()}

    def refined_views(self, params: Mapping[str, Any], views: Views, split: str) -> Views:
        """Returns Views with the refined cameras.

        The focal length is a property of the camera, so its correction applies to all splits. Poses of other splits
        than "train" have no correction.
        """
        if not self.refine:
            return views
        cameras, found = views.cameras, params[CAMERAS]
        if split == "train":
            if len(cameras.to_world) != self.num_images:
                raise ValueError(
                    f"the run has refined the cameras of {self.num_images} training images, and the dataset has "
                    f"{len(cameras.to_world)}, expected those that it was trained on; give its own --data_dir"
                )
            cameras = corrected_cameras(cameras, found["twists"])
        if self.refine_focal:
            cameras = dataclasses.replace(cameras, focal=jnp.asarray(cameras.focal) * jnp.exp(found["log_focal"]))
        return dataclasses.replace(views, cameras=cameras)

    def summary(self, params: Mapping[str, Any], views: Views) -> list[str]:
        """Returns lines that say how far exposures and cameras of the split "train" are from their start."""
        lines = []
        if self.exposure:
            gains = exposure_gains(params[CAMERAS]["log_gains"])
            lines.append(f"exposure      images have {gains.min():.3f} to {gains.max():.3f} times the mean exposure")
        if self.refine:
            refined = self.refined_views(params, views, "train")
            before, after = (jnp.asarray(each.cameras.to_world) for each in (views, refined))
            turned = norm((after - before)[:, :, :3].reshape(-1, 9)) / math.sqrt(8)
            angle = jnp.degrees(2 * jnp.arcsin(jnp.median(turned)))
            moved = jnp.median(norm((after - before)[:, :, 3]))
            zoom = jnp.exp(params[CAMERAS].get("log_focal", 0.0))
            lines.append(
                f"cameras       refined by {angle:.2g} degrees and {moved:.2g} world units (medians)"
                + f"; focal length times {zoom:.4f}" * self.refine_focal
            )
        return lines


def networks(params: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the entries of parameters, or of their gradients, that are networks."""
    return {name: part for name, part in params.items() if name != CAMERAS}


def exposure_gains(log_gains: Float[ArrayLike, "V 3"]) -> Float[Array, "V 3"]:
    """Computes the gain of each image and colour channel; its geometric mean over the images is 1.

    A change of exposure or white balance multiplies linear light by a factor per channel. After a tone curve that is
    a power, as sRGB nearly is, it still is a factor.
    """
    return jnp.exp(log_gains - log_gains.mean(axis=0, keepdims=True))


def corrected_cameras(cameras: Camera, twists: Float[ArrayLike, "V 6"]) -> Camera:
    """Returns cameras that are moved by rigid motions about what they look at, along the axes of the world.

    The point is the one nearest to all cameras' axes. Turns about it show the scene from another side, moves shift it
    in the image: their gradients are hardly correlated, whereas turns and moves of a camera about its own position
    both shift the image. A common rotation, translation or scaling of all cameras is removed: the mean rotation vector
    and the mean translation are 0, and so is the component of the translations along the cameras' offsets from their
    mean.

    Args:
        cameras: stacked, [V].
        twists: [V, 6] see `se3_exponential`; in radians, and in units of the RMS distance of the cameras from the
            point. Without such a distance, as in a panorama, there is no translation.
    """
    to_world, twists = jnp.asarray(cameras.to_world), jnp.asarray(twists)
    center, middle = nearest_to_axes(to_world), to_world[:, :, 3].mean(axis=0)
    offsets, spread = (to_world[:, :, 3] - each[None] for each in (center, middle))
    twists = twists - twists.mean(axis=0, keepdims=True)
    turns, moves = twists[:, :3], twists[:, 3:]
    squares = (spread**2).sum()
    scaling = (moves * spread).sum() / jnp.where(squares > 0, squares, 1)
    moves = (moves - scaling * spread) * jnp.sqrt((offsets**2).sum() / len(offsets))
    motions = se3_exponential(jnp.concatenate([turns, moves], axis=-1))
    # Sums of products instead of a matmul, which may round the camera to ten bits.
    at_center = jnp.concatenate([to_world[:, :, :3], offsets[:, :, None]], axis=-1)
    moved = (motions[:, :, :3, None] * at_center[:, None, :, :]).sum(axis=2)
    return dataclasses.replace(cameras, to_world=moved.at[:, :, 3].add(motions[:, :, 3] + center[None]))


def nearest_to_axes(to_world: Float[ArrayLike, "V 3 4"]) -> Float[Array, "3"]:
    """Computes the point with the least mean squared distance from the cameras' axes, near them if it is undefined."""
    to_world = jnp.asarray(to_world)
    eyes, axes = to_world[:, :, 3], to_world[:, :, 2]
    middle = eyes.mean(axis=0)
    across = jnp.eye(3)[None] - axes[:, :, None] * axes[:, None, :]
    away = (across * (eyes - middle[None])[:, None, :]).sum(axis=2).mean(axis=0)
    # Of parallel axes no point is nearest.
    return middle + jnp.linalg.solve(across.mean(axis=0) + _LEAST_ANGLE * jnp.eye(3), away)
