"""Neural radiance fields as pure functions: rays, samples, weights, images, for any scene.

A scene is any function (x [..., S, 3], viewdirs [..., 1 or S, 3]) -> (density [..., S], rgb [..., S, 3]).
Importing this needs jax only; load_scene brings in the rest when it is called.
"""

from jaxnerf.core.cameras import ndc_rays, ndc_to_t, pixel_grid, rays_from_pixels, undistort
from jaxnerf.core.compositing import (
    composite,
    expected_depth,
    expected_disparity,
    transmittance,
    weights_from_density,
)
from jaxnerf.core.encoding import positional_encoding
from jaxnerf.core.metrics import mse, psnr, round_to_8_bits, ssim
from jaxnerf.core.occupancy import Grid, create_grid, grid_of_scene, restrict_scene, update_grid
from jaxnerf.core.packing import render_packed
from jaxnerf.core.paths import look_at, turntable
from jaxnerf.core.rendering import positions, render_hierarchical, render_image, render_rays, render_samples
from jaxnerf.core.sampling import (
    importance_points,
    inverse_cdf,
    merge_edges,
    samples_from_edges,
    samples_from_points,
    stepped_edges,
    uniform_edges,
)
from jaxnerf.core.structs import Batch, Camera, Rays, Rendering, Samples, SceneFn, Views

__version__ = "0.1.0"


def load_scene(workdir):
    """Returns a trained model for other code.

    Args:
        workdir: the folder that jaxnerf.train wrote.

    Returns:
        scene, the trained field as a function (x, viewdirs) -> (density, rgb); and render, a jitted
        function Rays [...] -> Rendering [...] with the sampling and background it was trained for.

    Raises:
        ValueError: if the folder holds no finished checkpoint; names it.
    """
    from jaxnerf.engine.load import load_scene

    return load_scene(workdir)


__all__ = [
    # cameras and rays
    "Camera", "Rays", "pixel_grid", "undistort", "rays_from_pixels", "ndc_rays", "ndc_to_t", "look_at",
    "turntable",
    # samples along rays
    "Samples", "uniform_edges", "stepped_edges", "samples_from_edges", "samples_from_points", "inverse_cdf",
    "importance_points", "merge_edges", "positions",
    # from densities to colour
    "Rendering", "weights_from_density", "transmittance", "composite", "expected_depth", "expected_disparity",
    # whole renderers
    "SceneFn", "render_samples", "render_rays", "render_hierarchical", "render_image",
    # only where there is something
    "Grid", "create_grid", "update_grid", "grid_of_scene", "restrict_scene", "render_packed",
    # encodings, metrics, data
    "positional_encoding", "mse", "psnr", "ssim", "round_to_8_bits", "Views", "Batch",
    # trained models
    "load_scene",
]  # fmt: skip
