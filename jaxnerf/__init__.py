"""Neural radiance fields as pure functions: rays, samples, weights and images of any scene.

A scene is any function (x [..., S, 3], viewdirs [..., 1 or S, 3]) -> (density [..., S], rgb [..., S, 3]).
Its functions raise a ValueError on arguments of other kinds or shapes than they document, also where they are traced.
Importing it needs jax and jaxtyping only; the functions that read datasets or runs are imported when first used.
"""

import jaxnerf.runtime.quiet_start as _quiet_start  # noqa: F401

# isort: split
import importlib as _importlib
import inspect as _inspect
import typing as _typing

from jaxnerf.core.arguments import checked as _checked
from jaxnerf.core.cameras import ndc_rays, ndc_to_t, pixel_grid, pixel_radius, project, rays_from_pixels, undistort
from jaxnerf.core.encoding import (
    frustum_variance,
    integrated_directional_encoding,
    integrated_encoding,
    positional_encoding,
)
from jaxnerf.core.losses import distortion_loss
from jaxnerf.core.metrics import mse, psnr, round_to_8_bits, ssim
from jaxnerf.core.normals import density_normals
from jaxnerf.core.occupancy.grid import OccupancyGrid, create_grid, grid_from_scene, mask_scene, update_grid
from jaxnerf.core.occupancy.packed import render_packed
from jaxnerf.core.pose_estimation import PoseEstimate, estimate_pose
from jaxnerf.core.poses import look_at, se3_exponential, turntable
from jaxnerf.core.rendering import points_on_rays, render_hierarchical, render_image, render_rays, render_samples
from jaxnerf.core.sampling import (
    importance_points,
    inverse_cdf,
    merge_edges,
    samples_from_edges,
    samples_from_points,
    stepped_edges,
    uniform_edges,
)
from jaxnerf.core.types import Batch, Camera, PackedSamples, Rays, Rendering, Samples, SceneFn, SparsePoints
from jaxnerf.core.views import Views
from jaxnerf.core.volume_rendering import (
    composite,
    expected_depth,
    expected_disparity,
    median_depth,
    transmittance,
    weights_from_density,
)
from jaxnerf.registry import register_field, register_loss, register_reader, register_sampler

if _typing.TYPE_CHECKING:
    from jaxnerf.data.dataset import load_dataset
    from jaxnerf.data.ray_batches import draw_batch
    from jaxnerf.evaluation.evaluate import train_and_evaluate, train_many
    from jaxnerf.evaluation.restore import TrainedRun, load_scene, restore_run
    from jaxnerf.fields.hash_grid import hash_grid_field
    from jaxnerf.fields.mlp import mlp_field
    from jaxnerf.tools.embedded_scene.still_life import still_life
    from jaxnerf.tools.exporters.registration import register_exporter
    from jaxnerf.tools.uncertainty.registration import register_estimator

__version__ = "0.1.0"

_ON_DEMAND = {
    "load_dataset": "jaxnerf.data.dataset",
    "draw_batch": "jaxnerf.data.ray_batches",
    "mlp_field": "jaxnerf.fields.mlp",
    "hash_grid_field": "jaxnerf.fields.hash_grid",
    "still_life": "jaxnerf.tools.embedded_scene.still_life",
    "load_scene": "jaxnerf.evaluation.restore",
    "restore_run": "jaxnerf.evaluation.restore",
    "TrainedRun": "jaxnerf.evaluation.restore",
    "train_and_evaluate": "jaxnerf.evaluation.evaluate",
    "train_many": "jaxnerf.evaluation.evaluate",
    "register_exporter": "jaxnerf.tools.exporters.registration",
    "register_estimator": "jaxnerf.tools.uncertainty.registration",
}

if not _typing.TYPE_CHECKING:  # a type checker would accept every name

    def __getattr__(name):
        if name not in _ON_DEMAND:
            raise AttributeError(f"module 'jaxnerf' has no attribute {name!r}")
        found = getattr(_importlib.import_module(_ON_DEMAND[name]), name)
        return globals().setdefault(name, found if isinstance(found, type) else _checked(found))


def __dir__():
    return sorted([*globals(), *_ON_DEMAND])


__all__ = [
    # cameras and rays
    "Camera", "Rays", "pixel_grid", "undistort", "rays_from_pixels", "pixel_radius", "project", "ndc_rays", "ndc_to_t",
    "look_at", "turntable", "se3_exponential", "PoseEstimate", "estimate_pose",
    # samples along rays
    "Samples", "uniform_edges", "stepped_edges", "samples_from_edges", "samples_from_points", "inverse_cdf",
    "importance_points", "merge_edges", "points_on_rays",
    # from densities to colour
    "Rendering", "weights_from_density", "transmittance", "composite", "expected_depth", "expected_disparity",
    "median_depth",
    # renderers
    "SceneFn", "render_samples", "render_rays", "render_hierarchical", "render_image", "density_normals",
    # occupancy
    "OccupancyGrid", "PackedSamples", "create_grid", "update_grid", "grid_from_scene", "mask_scene",
    "render_packed",
    # encodings, metrics, losses
    "positional_encoding", "integrated_encoding", "frustum_variance", "integrated_directional_encoding",
    "mse", "psnr", "ssim", "round_to_8_bits",
    "distortion_loss",
    # data and fields
    "Views", "SparsePoints", "Batch", "load_dataset", "draw_batch", "mlp_field", "hash_grid_field", "still_life",
    # runs
    "load_scene", "restore_run", "TrainedRun", "train_and_evaluate", "train_many",
    # registration
    "register_field", "register_sampler", "register_loss", "register_reader", "register_exporter",
    "register_estimator",
]  # fmt: skip

for _name, _value in list(globals().items()):
    if _name in __all__ and _inspect.isfunction(_value):
        globals()[_name] = _checked(_value)
