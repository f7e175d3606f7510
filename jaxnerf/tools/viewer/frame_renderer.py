"""Renders the frames of a free camera: chunks of one size, so that nothing is compiled twice.

Neither the size of a window, nor the camera, nor a new checkpoint changes the shape of anything that is compiled.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from jaxnerf.core.cameras import ndc_rays, ndc_to_t, rays_from_pixels
from jaxnerf.core.occupancy.from_scene import crop_grid
from jaxnerf.core.occupancy.grid import clip_rays
from jaxnerf.core.safe_math import norm
from jaxnerf.core.types import Camera
from jaxnerf.core.views import Views
from jaxnerf.data.ray_batches import with_needs
from jaxnerf.evaluation import output_images
from jaxnerf.evaluation.restore import TrainedRun
from jaxnerf.evaluation.supersampling import MAX_RAYS, trained_footprint
from jaxnerf.tools.uncertainty.base import with_field_input

UNCERTAINTY = "uncertainty"
MODES = ("colour", "depth", "opacity", "normals", UNCERTAINTY)
MAX_SIDE = 4096  # px
_CHUNK = {"cpu": 4096}  # rays; more take longer to abandon, fewer use the device worse
_CHUNK_ELSEWHERE = 2**15
_FAST_SAMPLES, _FAST_STOP = 0.5, 0.1  # of frames while the camera moves: factor of the samples, early_stop_eps
_FARTHEST = 1e10  # in t; at infinity, the length of a ray would be NaN
_SEEN = 0.5  # opacity from which a pixel has a depth and a normal


class FrameCamera(NamedTuple):
    """A pinhole camera with square pixels and the principal point in the middle, of any size.

    Attributes:
        to_world: [3, 4] camera to the run's world, x right, y up, looking along -z.
        fov: radians, vertical.
        width, height: px.
        time: in [0, 1], of a scene that moves.
    """

    to_world: np.ndarray
    fov: float
    width: int
    height: int
    time: float = 0.0

    @property
    def focal(self) -> float:
        """The focal length, px."""
        return 0.5 * self.height / np.tan(0.5 * self.fov)

    def resized(self, width: int, height: int) -> "FrameCamera":
        """Returns the camera with another size and the same field of view."""
        return self._replace(width=width, height=height)


class SceneState(NamedTuple):
    """What a frame shows: the parameters of one step.

    Attributes:
        step: of training.
        params: of the model.
        grid: OccupancyGrid; None where the model has none.
        box: [2, 3] corners of the box that holds all matter, world units; in NDC where the rays are.
        uncertainty_at: see `Estimate`, a pytree; None where the run has no estimate.
    """

    step: int
    params: Any
    grid: Any
    box: np.ndarray
    uncertainty_at: Any = None


class Frame(NamedTuple):
    """A rendered frame.

    Attributes:
        camera: FrameCamera.
        rgb: [H, W, 3] in [0, 1].
        opacity: [H, W].
        distance: [H, W] along the ray to what is seen, in the run's world units; infinite where nothing is.
        uncertain: whether rgb is, in grey, the mean uncertainty of what is seen, 0 where nothing is.
    """

    camera: FrameCamera
    rgb: Float[np.ndarray, "H W 3"]
    opacity: Float[np.ndarray, "H W"]
    distance: Float[np.ndarray, "H W"]
    uncertain: bool = False


class FrameRenderer:
    """Renders frames of a run at two qualities: the run's own, and a faster one for cameras that move."""

    def __init__(self, run: TrainedRun, views: Views, *, chunk: int | None = None):
        """Makes the renderer; nothing is compiled yet.

        Args:
            run: see `restore_with_grid`.
            views: of the split "train", for NDC and, where space is contracted, for near and far.
            chunk: rays rendered at once; None: as many as suit the device.
        """
        options = run.experiment.config.eval
        fast = {
            "sample_multiplier": options.sample_multiplier * _FAST_SAMPLES,
            "early_stop_eps": max(options.early_stop_eps, _FAST_STOP),
        }
        models = {False: run.model_with({}), True: run.model_with(fast)}
        self._uncertain = functools.cache(lambda quick: run.model_with(fast if quick else {}, _with_uncertainty))
        self._background = np.float32([run.experiment.background or (0.0, 0.0, 0.0)])
        self._baked, self._cull = models[False].grid_schedule is None, models[False].cull
        self._chunk = chunk or _CHUNK.get(jax.default_backend(), _CHUNK_ELSEWHERE)
        self._ndc, self._offset = run.experiment.config.data.ndc, run.experiment.config.data.pixel_offset
        self._needs = run.experiment.model.needs
        self._footprint = trained_footprint(run, views)
        self._middle = np.asarray(views.cameras.to_world)[:, :, 3].mean(axis=0)
        self._bounds = float(np.min(views.near)), float(np.max(views.far))
        height, width = (int(side) for side in views.size[0])
        first = jax.tree.map(lambda leaf: np.asarray(leaf)[0], views.cameras)
        self._lens = Camera(to_world=first.to_world, focal=first.focal, center=first.center, height=height, width=width)
        self._may_hit = jax.jit(self._culled)
        self._parts = {fast: jax.jit(functools.partial(self._planes, model.view)) for fast, model in models.items()}
        self._uncertain_parts = {fast: jax.jit(functools.partial(self._grey_planes, fast)) for fast in models}

    @property
    def num_compiled(self) -> int:
        """How many programs have been compiled: at most three, and two more once uncertainty is shown."""
        functions = (self._may_hit, *self._parts.values(), *self._uncertain_parts.values())
        return sum(function._cache_size() for function in functions)

    def scene_state(self, step: int, variables: tuple, uncertainty_at: Any = None) -> SceneState:
        """Returns the SceneState of variables (params, grid) of a step, and of its estimate, see `SceneState`."""
        # Where an array lies is part of what is compiled.
        (params, grid), uncertainty_at = jax.device_put((variables, uncertainty_at), jax.local_devices()[0])
        box = np.float32([[-np.inf] * 3, [np.inf] * 3])
        if grid is not None and not grid.contracted:
            tight = crop_grid(grid) if self._baked else grid
            box = np.stack([np.asarray(tight.lower), np.asarray(tight.upper)])
        return SceneState(step, params, grid, box, uncertainty_at)

    def rays_per_side(self, camera: FrameCamera, max_rays: float = MAX_RAYS) -> int:
        """Returns how many rays along a pixel's side are as dense as those of training.

        Args:
            camera: FrameCamera.
            max_rays: per pixel, at most MAX_RAYS count; fewer than 1 count as 1.
        """
        most = int(np.clip(max_rays, 1, MAX_RAYS))
        focal = np.full((1, 2), camera.focal)
        side = int(self._footprint.rays_per_side(camera.to_world[None], focal, max_rays=most)[0])
        return max(min(side, MAX_SIDE // max(camera.width, camera.height, 1)), 1)

    def compile(self, state: SceneState) -> None:
        """Compiles both qualities, so that the first frame does not wait for it."""
        camera = FrameCamera(np.eye(3, 4, dtype=np.float32), 1.0, 1, 1)
        for fast in (True, False):
            arrays, ids = self._arrays(camera, state, None), self._padded(np.zeros(1, np.int32))
            jax.block_until_ready(self._parts[fast](state.params, state.grid, arrays, ids))
            jax.block_until_ready(self._may_hit(state.grid, arrays, ids))

    def render(
        self,
        state: SceneState,
        camera: FrameCamera,
        *,
        fast: bool = False,
        crop: np.ndarray | None = None,
        uncertain: bool = False,
        abandoned: Callable[[], bool] = lambda: False,
        side: int = 1,
    ) -> Frame | None:
        """Renders a frame.

        Rays begin at the camera and end where the box of the scene does, whatever near and far the training views
        have; where space is contracted, they end as far away as those views may see. A scene that asks for time gets
        that of the camera, one that asks for image_index 0.

        Args:
            state: what to render.
            camera: FrameCamera.
            fast: whether to render with fewer samples.
            crop: [2, 3] corners in the run's world; what is outside is not shown.
            uncertain: whether uncertainty takes the place of colour, where the state has an estimate.
            abandoned: called between chunks; where it returns True, the frame is not finished.
            side: each pixel is the mean over side x side rays; its distance is that of one in the middle.

        Returns:
            The Frame; None if it was abandoned.

        Raises:
            ValueError: if the camera is larger than MAX_SIDE or has no pixel.
        """
        if not (0 < camera.width <= MAX_SIDE and 0 < camera.height <= MAX_SIDE):
            raise ValueError(f"a frame has {camera.width} x {camera.height} px, expected sides of 1 to {MAX_SIDE}")
        if side > 1:
            fine = camera.resized(side * camera.width, side * camera.height)
            frame = self.render(state, fine, fast=fast, crop=crop, uncertain=uncertain, abandoned=abandoned)
            return frame and _averaged(frame, camera, side)
        count = camera.width * camera.height
        uncertain = uncertain and state.uncertainty_at is not None
        parts = self._uncertain_parts if uncertain else self._parts
        params = (state.params, state.uncertainty_at) if uncertain else state.params
        arrays = self._arrays(camera, state, crop)
        hits, pixels = [], np.arange(count, dtype=np.int32)
        for start in range(0, count, self._chunk):
            if abandoned():
                return None
            ids = pixels[start : start + self._chunk]
            hits.append(np.asarray(self._may_hit(state.grid, arrays, self._padded(ids)))[: len(ids)])
        hit, planes = np.flatnonzero(np.concatenate(hits)).astype(np.int32), None
        for start in range(0, max(len(hit), 1), self._chunk):
            if abandoned():
                return None
            ids = hit[start : start + self._chunk]
            part = np.asarray(parts[fast](params, state.grid, arrays, self._padded(ids)))
            if planes is None:  # the row after the chunk's is that of a ray that hits nothing
                planes = np.repeat(part[-1:], count, axis=0)
            planes[ids] = part[: len(ids)]
        planes = planes.reshape(camera.height, camera.width, 5)
        return Frame(camera, planes[..., :3], planes[..., 3], planes[..., 4], uncertain)

    def _padded(self, ids):
        """Returns ids [chunk + 1]; -1, a ray of length 0, where there are none."""
        return np.pad(ids, (0, self._chunk + 1 - len(ids)), constant_values=-1)

    def _arrays(self, camera, state, crop):
        """Returns what a frame's rays depend on, as arrays."""
        near, far = 0.0, _FARTHEST
        if not (self._ndc or np.isfinite(state.box).all()):
            near, far = self._bounds
            far += float(np.linalg.norm(camera.to_world[:, 3] - self._middle))
        everything = np.float32([[-np.inf] * 3, [np.inf] * 3])
        return {
            "to_world": np.asarray(camera.to_world, np.float32),
            "focal": np.float32([camera.focal, camera.focal]),
            "center": np.float32([camera.width / 2, camera.height / 2]),
            "width": np.int32(camera.width),
            "time": np.float32(camera.time),
            "bounds": np.float32([near, far]),
            "crop": everything if crop is None else np.float32(crop),
            "box": state.box,
        }

    def _rays(self, arrays, ids):
        """Returns the rays [N] of pixels in the world, and those that the model renders; of length 0 for ids < 0."""
        pixels = jnp.stack([ids % arrays["width"], ids // arrays["width"]], axis=-1) + self._offset
        camera = Camera(**{name: arrays[name] for name in ("to_world", "focal", "center")})
        near, far = arrays["bounds"]
        world = rays_from_pixels(camera, pixels, near=near, far=far)
        world = with_needs(world, camera, pixels, self._needs, time=arrays["time"])
        world = rays = clip_rays(world, *arrays["crop"])
        if self._ndc:
            rays = ndc_rays(world, self._lens)
            near, far = (_t_in_ndc(world, t) for t in (world.near, world.far))
            near = jnp.clip(near, rays.near, rays.far)
            rays = dataclasses.replace(rays, near=near, far=jnp.clip(far, near, rays.far))
        rays = clip_rays(rays, *arrays["box"])
        return world, dataclasses.replace(rays, far=jnp.where(ids < 0, rays.near, rays.far))

    def _culled(self, grid, arrays, ids):
        """Returns [N] bool, which pixels to render."""
        rays = self._rays(arrays, ids)[1]
        return (rays.far > rays.near) if self._cull is None else self._cull(grid, rays)[0]

    def _planes(self, view, params, grid, arrays, ids):
        """Returns [N, 5], the colour, the opacity and the distance of pixels."""
        world, rays = self._rays(arrays, ids)
        image = view(params, grid, rays)
        seen = image.opacity >= _SEEN
        beyond = jnp.where(image.opacity < 1, (1 - image.opacity) * rays.far, 0)  # of the light that is left
        t = (image.depth - beyond) / jnp.where(seen, image.opacity, 1)
        t = ndc_to_t(t, world) if self._ndc else t
        distance = jnp.where(seen, t * norm(world.directions), jnp.inf)
        return jnp.concatenate([image.rgb, image.opacity[:, None], distance[:, None]], axis=-1)

    def _grey_planes(self, fast, params, grid, arrays, ids):
        """Returns _planes with the mean uncertainty of what is seen in place of colour."""
        params, uncertainty_at = params
        params = with_field_input(params, uncertainty_at)
        planes = self._planes(self._uncertain(fast).view, params, grid, arrays, ids)
        opacity = planes[:, 3:4]
        mean = (planes[:, :3] - (1 - opacity) * self._background) / jnp.maximum(opacity, _SEEN)
        return planes.at[:, :3].set(jnp.where(opacity >= _SEEN, mean, 0))


def _with_uncertainty(field):
    """Returns a field whose colour is an uncertainty in grey; its params are a pair, with the function of positions."""

    @functools.wraps(field.apply)
    def apply(params, x, viewdirs, **inputs):
        params, uncertainty_at = params
        density, rgb = field.apply(params, x, viewdirs, **inputs)
        return density, jnp.broadcast_to(uncertainty_at(x)[..., None], rgb.shape)

    return field._replace(apply=apply)


def _averaged(frame, camera, side):
    """Returns the Frame of a camera from one with side times its width and height."""
    shape = (camera.height, side, camera.width, side)
    middle = frame.distance[side // 2 :: side, side // 2 :: side]
    rgb, opacity = frame.rgb.reshape(*shape, 3).mean((1, 3)), frame.opacity.reshape(shape).mean((1, 3))
    return Frame(camera, rgb, opacity, middle, frame.uncertain)


def _t_in_ndc(rays, t):
    """Returns t of the NDC rays at the points t of world rays, the inverse of `ndc_to_t`; the near plane is at 1."""
    return 1 - 1 / jnp.maximum(-rays.origins[..., 2] - t * rays.directions[..., 2], 1)


def frame_image(frame: Frame, mode: str) -> UInt8[np.ndarray, "H W 3"]:
    """Returns an image of a frame: its colour, depth (near is white), opacity, normals or uncertainty (1 is white).

    Only a frame that was rendered with uncertainty has it; others show their colour. Normals are those of the surface
    through the points that neighbouring pixels see, in the world's axes: red, green and blue are x, y and z from -1 to
    1. What is not opaque is black.

    Raises:
        ValueError: on another mode.
    """
    if mode in ("colour", UNCERTAINTY):
        return output_images.to_8_bits(frame.rgb)
    if mode == "normals":
        return output_images.to_8_bits(np.where(np.isfinite(frame.distance)[..., None], (_normals(frame) + 1) / 2, 0))
    if mode == "depth":
        plane = output_images.depth_image(frame.distance, *output_images.depth_range([frame.distance]))
    elif mode == "opacity":
        plane = output_images.to_8_bits(frame.opacity)
    else:
        raise ValueError(f"mode is {mode!r}, expected one of {', '.join(MODES)}")
    return np.repeat(plane[..., None], 3, axis=-1)


def view_image(views: Views, index: int, longest: int) -> UInt8[np.ndarray, "H W 3"]:
    """Returns a training image over its background, uint8, subsampled to at most so many px."""
    image = np.asarray(views.image(index))
    every = -(-max(image.shape[:2]) // longest)
    return output_images.to_8_bits(image[::every, ::every])


def _normals(frame):
    """Returns unit normals [H, W, 3] in the world that face the camera; 0 where they are not defined."""
    camera, (height, width) = frame.camera, frame.distance.shape
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    local = np.stack([x, -y, np.full_like(x, -camera.focal)], axis=-1)
    away = local / np.linalg.norm(local, axis=-1, keepdims=True) @ np.asarray(camera.to_world)[:, :3].T
    points = np.where(np.isfinite(frame.distance)[..., None], frame.distance[..., None] * away, 0)
    if min(height, width) < 2:
        return np.zeros_like(points)
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = normals / np.where(length > 0, length, 1)
    return normals * -np.sign((normals * away).sum(axis=-1, keepdims=True))
