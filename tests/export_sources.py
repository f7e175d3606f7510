"""A run of a closed-form scene for tests of exporters: nothing is trained or read."""

import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from jaxnerf import Camera, Views, create_grid, look_at, mask_scene, render_rays
from jaxnerf.data import ray_batches
from jaxnerf.evaluation.restore import TrainedRun
from jaxnerf.fields.base import Field
from jaxnerf.tools.exporters.base import ExportSource
from jaxnerf.tools.exporters.options import MeshOptions, SplatsOptions, WebOptions
from jaxnerf.training.config import RunConfig, changed

RADIUS, SIZE = 0.5, 48
# A rotation by 90 degrees about z, twice the size, moved: the world of the dataset's files.
TO_FILE = np.float32([[0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]])
CENTER = TO_FILE[:3, 3]


@dataclasses.dataclass(frozen=True)
class AllOptions(MeshOptions, SplatsOptions, WebOptions):
    """The options of all exporters."""


def ball(x, viewdirs):
    """A dense ball, red where x > 0 and green elsewhere, in a world of its own."""
    inside = jax.nn.sigmoid((RADIUS - jnp.linalg.norm(x, axis=-1)) / 0.005)
    red = jax.nn.sigmoid(x[..., 0] / 0.01)
    return 200 * inside, jnp.stack([red, 1 - red, jnp.zeros_like(red)], axis=-1)


def orbit(count=14):
    """Returns Views of black pixels from all around the origin."""
    steps = np.arange(count) + 0.5
    height, angle = 1 - 2 * steps / count, np.pi * (1 + np.sqrt(5)) * steps
    around = np.sqrt(1 - height**2)
    eyes = 3 * np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=-1)
    poses = jax.jit(jax.vmap(lambda eye: look_at(eye, jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]))))(jnp.float32(eyes))
    return Views(
        pixels=np.zeros((count * SIZE**2, 3), np.uint8),
        offset=np.arange(count, dtype=np.int32) * SIZE**2,
        size=np.full((count, 2), SIZE, np.int32),
        cameras=Camera(
            to_world=np.asarray(poses),
            focal=np.full((count, 2), 2.2 * SIZE, np.float32),
            center=np.full((count, 2), SIZE / 2, np.float32),
            height=SIZE,
            width=SIZE,
        ),
        near=np.full(count, 1.5, np.float32),
        far=np.full(count, 4.5, np.float32),
        names=tuple(f"view_{index}" for index in range(count)),
        to_file=TO_FILE,
    )


def source_of(scene=ball, *, say=lambda line: None, background=None, count=14, num_samples=96, **settings):
    """Returns the ExportSource of a scene over a background colour, with a number of views and of samples per ray."""
    views = orbit(count)
    render = functools.partial(render_rays, None, num_samples=num_samples, median_depth=True)
    compiled = jax.jit(lambda rays: render(scene, rays))

    def model_with(settings, wrap):
        field = wrap(Field(init=lambda key: {}, apply=lambda params, x, viewdirs: scene(x, viewdirs)))
        density = functools.partial(field.apply, None)
        return SimpleNamespace(view=lambda params, grid, rays, median_depth: render(density, rays), cull=None)

    experiment = SimpleNamespace(
        view_rays=functools.partial(ray_batches.view_rays, ndc=False),
        world_depth=ray_batches.world_depth,
        config=changed(RunConfig(), {"eval.chunk": SIZE**2, "eval.sample_multiplier": 1.0}),
        background=background,
        model=SimpleNamespace(scene=lambda params, grid: mask_scene(scene, grid), needs=()),
        load_split=lambda split, **options: views,
        cameras=None,
    )
    grid = create_grid(np.full(3, -1.0), np.full(3, 1.0), np.ones((2, 2, 2), bool), initial_density=1.0)
    run = TrainedRun(
        experiment=experiment,
        steps=lambda: [7],
        variables=lambda step: ({}, grid),
        render=None,
        identity="",
        render_image=lambda variables, rays, median_depth=False: compiled(rays),
        variables_of=None,
        model_with=model_with,
    )
    settings = {"resolution": 32, "size": SIZE, **settings}
    return ExportSource(run, 7, (None, grid), views, AllOptions(**settings), say)
