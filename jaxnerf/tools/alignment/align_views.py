"""Scores of views after their poses or exposures are aligned to the trained scene: jaxnerf-eval --align=pose.

Where a run has refined its cameras, or images differ in exposure, the views that are scored fit a scene that is a
little different: their scores measure that difference. As in BARF (arXiv:2104.06405), each scored view's pose is
fitted to its image with the scene fixed; its exposure likewise, as in NeRF in the wild (arXiv:2008.02268), also with
the gains of the left half of an image, scored on the right half.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.metrics import mse, psnr
from jaxnerf.core.pose_estimation import FitOptions, Target, fit_camera
from jaxnerf.core.views import Views
from jaxnerf.evaluation.metrics import image_metrics, pixel_mask
from jaxnerf.evaluation.restore import TrainedRun
from jaxnerf.evaluation.supersampling import render_pixels
from jaxnerf.runtime import stages

PARTS = ("pose", "exposure")
NONE = "none"
_METRICS = ("psnr", "ssim", "lpips")
_NUM_PIXELS, _MAX_ITERATIONS = 4096, 12
_TOLERANCE = 1e-4  # fraction of the squared error that a further step may remove: 0.0004 dB
_CHUNK = 8  # derivatives need so many times the memory of colours


class Aligner(NamedTuple):
    """Aligns views to a trained run.

    Attributes:
        parts: some of PARTS, in their order.
    """

    parts: tuple[str, ...]

    @property
    def identity(self) -> str:
        """Text that is equal for aligners that do the same, the middle of the names of their metrics."""
        return "_".join(self.parts)

    def scored(
        self, run: TrainedRun, variables: Any, views: Views, index: int, rgb: Float[ArrayLike, "H W 3"], *, side: int
    ) -> dict[str, Any]:
        """Aligns a view, and returns its figures after that.

        Args:
            run, variables: of the scene.
            views: that are scored.
            index: of the view.
            rgb: [H, W, 3] its rendering before.
            side: see `render_pixels`.

        Returns:
            psnr, ssim and lpips, if installed, by names such as psnr_pose_aligned; for a pose the rotation in degrees
            and the translation in units of the dataset's files, for an exposure the gains, and the PSNR of the right
            half with the gains of the left half.
        """
        truth, mask, behind = views.image(index), pixel_mask(views, index), _behind(views, index)
        aligned, row = self._exposed(rgb, truth, mask, behind)
        if "pose" in self.parts:
            with stages.stage("aligning a pose"):
                moved, of_pose = _fitted(run, variables, views, index, Target(truth, mask, behind), self.parts)
                pixels = pixel_grid(*truth.shape[:2], offset=run.experiment.config.data.pixel_offset)
                rgb = render_pixels(run, variables, moved, index, pixels, side=side)[0].rgb
            candidate = self._exposed(rgb, truth, mask, behind)
            if mse(candidate[0], truth, mask=mask) <= mse(aligned, truth, mask=mask):
                (aligned, row), of_pose = candidate, {**of_pose, "pose_kept": False}
            else:  # another minimum, or one of the pixels that were compared: the pose stays
                of_pose = {"rotation_degrees": 0.0, "translation": 0.0, "pose_kept": True}
            row = row | of_pose
        found = image_metrics(aligned, truth, mask)
        return row | {f"{name}_{self.identity}_aligned": found[name] for name in _METRICS if name in found}

    def summary(self, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Returns what results.json holds about the figures of its images: means, of the gains geometric ones."""
        names = [name for name in rows[0] if "aligned" in name and self.identity in name or name in _OF_POSE]
        names += [name for name in rows[0] if name.endswith("_exposure_half")]
        found = {
            name: float(np.mean([row[name] for row in rows])) for name in names if all(name in row for row in rows)
        }
        return {"aligned": self.identity, **found}

    def _exposed(self, rgb, truth, mask, behind):
        """Returns a rendering with the exposure of the image, if it is aligned; and the figures of that."""
        if "exposure" not in self.parts:
            return rgb, {}
        kept = np.ones(truth.shape[:2], bool) if mask is None else np.asarray(mask)
        left, right = kept.copy(), kept.copy()
        left[:, truth.shape[1] // 2 :] = right[:, : truth.shape[1] // 2] = False
        gains, of_left = (_gains(rgb - behind, truth - behind, each) for each in (kept, left))
        half = jnp.clip(behind + of_left[None, None] * (rgb - behind), 0, 1)
        row = {"gains": np.asarray(gains).tolist()}
        if left.any() and right.any():
            row[f"psnr_{self.identity}_half"] = float(psnr(half, truth, mask=jnp.asarray(right)))
        return jnp.clip(behind + gains[None, None] * (rgb - behind), 0, 1), row


_OF_POSE = ("rotation_degrees", "translation", "pose_kept")


def requested(text: str | None) -> Callable[[TrainedRun], Aligner | None]:
    """Returns the function that makes the Aligner of a run that --align asks for, None for no alignment.

    Args:
        text: some of PARTS with commas, or "none"; None: what the run has trained of its own images.

    Raises:
        ValueError: on another text.
    """
    if text is None:
        return _of_run
    names = [name.strip() for name in text.split(",")]
    if names != [NONE] and (not set(names) <= set(PARTS) or len(set(names)) < len(names)):
        raise ValueError(f"--align is {text!r}, expected {', '.join(PARTS)}, {','.join(PARTS)} or {NONE}; correct it")
    aligner = None if names == [NONE] else Aligner(tuple(part for part in PARTS if part in names))
    return lambda run: aligner


def _of_run(run):
    cameras = run.experiment.cameras
    trained = {} if cameras is None else {"pose": cameras.refine, "exposure": cameras.exposure}
    parts = tuple(part for part in PARTS if trained.get(part))
    return Aligner(parts) if parts else None


def line(results: Mapping[str, Any]) -> str | None:
    """Returns the line that sums up the aligned figures of results.json; None without any."""
    kind = results.get("aligned")
    if kind is None:
        return None
    text = f"{kind.replace('_', ' and ')} aligned: PSNR {results[f'psnr_{kind}_aligned']:.2f} dB"
    text += f", SSIM {results[f'ssim_{kind}_aligned']:.4f}"
    if f"lpips_{kind}_aligned" in results:
        text += f", LPIPS {results[f'lpips_{kind}_aligned']:.4f}"
    if f"psnr_{kind}_half" in results:
        text += f"; {results[f'psnr_{kind}_half']:.2f} dB on the right halves with the gains of the left halves"
    if "rotation_degrees" in results:
        text += (
            f"; poses turned by {results['rotation_degrees']:.3g} degrees and moved by {results['translation']:.3g} "
        )
        text += "in the dataset's units (means)"
    return text


class _Colors(NamedTuple):
    """The colours of a run at pixels of one view."""

    render: Callable[..., Any]
    view_rays: Callable[..., Any]

    def __call__(self, context, camera, pixels):
        variables, view = context
        cameras = dataclasses.replace(view.cameras, to_world=camera.to_world[None], focal=camera.focal[None])
        return self.render(variables, self.view_rays(dataclasses.replace(view, cameras=cameras), 0, pixels)).rgb


def _fitted(run, variables, views, index, target, parts):
    """Returns Views in which one has the pose that fits its image, and how far it has moved."""
    number = 3 * min(_NUM_PIXELS, target.rgb.shape[0] * target.rgb.shape[1])
    options = FitOptions(
        num_pixels=_NUM_PIXELS,
        with_gains="exposure" in parts,
        max_iterations=_MAX_ITERATIONS,
        chunk=max(run.experiment.config.eval.chunk // _CHUNK, 1),
        pixel_offset=run.experiment.config.data.pixel_offset,
        tolerance=_TOLERANCE * number,
    )
    colors = _Colors(run.render, run.experiment.view_rays)
    before = views.camera(index)
    found = fit_camera(colors, (variables, _one(views, index)), target, before, options, key=jax.random.key(index))
    poses = np.array(views.cameras.to_world)
    poses[index] = found.pose
    scale = 1.0 if views.to_file is None else float(np.linalg.norm(np.asarray(views.to_file)[:3, 0]))
    turned = np.linalg.norm(np.float64(found.pose - before.to_world)[:, :3]) / math.sqrt(8)
    row = {
        "rotation_degrees": float(np.degrees(2 * np.arcsin(min(turned, 1.0)))),
        "translation": scale * float(jnp.linalg.norm(found.pose[:, 3] - before.to_world[:, 3])),
    }
    return dataclasses.replace(views, cameras=dataclasses.replace(views.cameras, to_world=poses)), row


def _one(views, index):
    """Returns the Views of one of them, without what no ray needs."""
    chosen = functools.partial(jax.tree.map, lambda leaf: np.asarray(leaf)[index : index + 1])
    image_index = np.int32([index]) if views.image_index is None else chosen(views.image_index)
    return Views(
        pixels=np.zeros((0, views.pixels.shape[1]), views.pixels.dtype),
        offset=np.zeros(1, np.int32),
        size=chosen(views.size),
        cameras=chosen(views.cameras),
        near=chosen(views.near),
        far=chosen(views.far),
        time=chosen(views.time),
        image_index=image_index,
    )


def _behind(views, index):
    """Returns [H, W, 3], the part of a view's colours that is the background's, which gains leave as it is."""
    (height, width), first = (int(side) for side in views.size[index]), int(views.offset[index])
    if views.background is None or views.pixels.shape[1] < 4:
        return jnp.zeros((height, width, 3))
    alpha = np.float32(views.pixels[first : first + height * width, 3]) / np.iinfo(views.pixels.dtype).max
    return jnp.asarray(((1 - alpha)[:, None] * np.float32(views.background)[None]).reshape(height, width, 3))


def _gains(light, target, kept):
    """Returns [3], by least squares over the pixels that are kept; 1 where there is no light."""
    light = jnp.where(jnp.asarray(kept)[..., None], light, 0)
    squares = (light**2).sum(axis=(0, 1))
    return jnp.where(squares == 0, 1, (light * target).sum(axis=(0, 1)) / jnp.where(squares == 0, 1, squares))
