"""Uses every public name of jaxnerf the way a user's typed code does; test_types.py runs mypy on it."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from ml_collections import ConfigDict

import jaxnerf


def scene(x: Array, viewdirs: Array) -> tuple[Array, Array]:
    density = jnp.exp(-(x**2).sum(axis=-1))
    return density, 0.5 + 0.25 * jnp.sin(x + viewdirs)


def make_camera() -> jaxnerf.Camera:
    pose = jaxnerf.look_at((4.0, 0.0, 1.0), np.zeros(3), jnp.array([0.0, 0.0, 1.0]))
    path = jaxnerf.turntable(8, center=(0.0, 0.0, 0.0), radius=4.0, elevation=0.3)
    to_world = jnp.where(jnp.isfinite(pose), pose, path[0])
    focal, center = jnp.full(2, 20.0), jnp.full(2, 8.0)
    lens = jaxnerf.Camera(to_world=to_world, focal=focal, center=center, distortion=jnp.zeros(4), lens="opencv")
    points, converged = jaxnerf.undistort(lens, jaxnerf.pixel_grid(4, 4, offset=0.0))
    assert converged.all() and points.shape == (4, 4, 2)
    return jaxnerf.Camera(to_world=to_world, focal=focal, center=center, height=16, width=16)


def make_rays(camera: jaxnerf.Camera) -> jaxnerf.Rays:
    rays = jaxnerf.rays_from_pixels(camera, jaxnerf.pixel_grid(16, 16), near=2, far=np.float32(6.0))
    forward = jaxnerf.Rays(
        origins=rays.origins,
        directions=rays.directions,
        viewdirs=rays.viewdirs,
        near=rays.near,
        far=rays.far,
    )
    t: Array = jaxnerf.ndc_to_t(jaxnerf.ndc_rays(forward, camera).near, forward, near_plane=1.0)
    radius: Array = jaxnerf.pixel_radius(camera, jaxnerf.pixel_grid(16, 16))
    place, depth = jaxnerf.project(camera, forward.origins + forward.directions)
    motion: Array = jaxnerf.se3_exponential(jnp.zeros(6))
    assert t.shape == rays.near.shape == radius.shape == depth.shape and place.shape[-1] + motion.shape[0] == 5
    return rays


def find_pose(camera: jaxnerf.Camera) -> Array:
    image = jnp.zeros((16, 16, 3))
    found: jaxnerf.PoseEstimate = jaxnerf.estimate_pose(
        scene, image, camera, camera.to_world, near=2.0, far=6.0, num_pixels=64, with_gains=True
    )
    return found.covariance


def make_samples(key: Array, rays: jaxnerf.Rays) -> jaxnerf.Samples:
    edges = jaxnerf.uniform_edges(rays.near, rays.far, num_segments=8)
    steps = jaxnerf.stepped_edges(key, rays.near, rays.far, step_size=0.5, num_segments=8)
    coarse = jaxnerf.samples_from_edges(key, edges, rule="gauss")
    points = jaxnerf.samples_from_points(coarse.t, last_delta=1e10)
    weights = jaxnerf.weights_from_density(jnp.ones_like(points.t), points.delta)
    middle = jaxnerf.inverse_cdf(coarse.t, weights[..., 1:], jnp.full((16, 16, 1), 0.5))
    drawn = jaxnerf.importance_points(None, coarse.t, weights[..., 1:], num_points=4, padding=1e-5)
    merged = jaxnerf.merge_edges(jaxnerf.merge_edges(steps, middle), drawn)
    samples = jaxnerf.samples_from_edges(None, merged)
    return jaxnerf.Samples(t=samples.t, delta=samples.delta, rule=samples.rule)


def integrate(rays: jaxnerf.Rays, samples: jaxnerf.Samples) -> jaxnerf.Rendering:
    density, rgb = scene(jaxnerf.points_on_rays(rays, samples.t), rays.viewdirs[..., None, :])
    weights = jaxnerf.weights_from_density(density, samples.delta, rule="segments")
    transmittance = jaxnerf.transmittance(density, samples.delta)
    return jaxnerf.Rendering(
        rgb=jaxnerf.composite(weights, rgb, background=(1.0, 1.0, 1.0), transmittance=transmittance),
        opacity=1 - transmittance,
        depth=jaxnerf.expected_depth(weights, samples.t, transmittance, far=rays.far),
        disparity=jaxnerf.expected_disparity(weights, samples.t),
        weights=weights,
        num_dropped=jnp.zeros(transmittance.shape, jnp.int32),
        samples=samples,
        median_depth=jaxnerf.median_depth(density, samples.delta, samples.t, samples.delta, far=rays.far),
    )


def render(key: Array, rays: jaxnerf.Rays) -> jaxnerf.Rendering:
    function: jaxnerf.SceneFn = scene
    one = jaxnerf.render_samples(function, rays, make_samples(key, rays), background=np.ones(3))
    two = jaxnerf.render_rays(None, jaxnerf.still_life, rays, num_samples=8, in_disparity=True)
    coarse, fine = jaxnerf.render_hierarchical(
        key, function, function, rays, num_coarse=4, num_fine=4, importance_padding=1e-5
    )
    assert coarse.rgb.shape == one.rgb.shape == two.rgb.shape
    return jaxnerf.render_image(lambda part: jaxnerf.render_rays(None, scene, part, num_samples=4), rays, chunk=64)


def render_packed(key: Array, rays: jaxnerf.Rays, samples: jaxnerf.Samples) -> jaxnerf.Rendering:
    lower, upper = jnp.full(3, -1.5), jnp.full(3, 1.5)
    grid: jaxnerf.OccupancyGrid = jaxnerf.create_grid(lower, upper, jnp.ones((8, 8, 8), bool), initial_density=1.0)
    grid = jaxnerf.update_grid(key, grid, scene, jnp.arange(512), threshold=0.01)
    same = jaxnerf.OccupancyGrid(
        lower=grid.lower,
        upper=grid.upper,
        valid=grid.valid,
        density_max=grid.density_max,
        density_mean=grid.density_mean,
        occupied=grid.occupied,
        contracted=False,
    )
    found = jaxnerf.grid_from_scene(key, scene, lower, upper, (8, 8, 8), threshold=0.01)
    masked = jaxnerf.mask_scene(scene, found)
    return jaxnerf.render_packed(masked, same, rays, samples, max_samples=4096, early_stop_eps=1e-3)


def losses_and_metrics(rays: jaxnerf.Rays, rendering: jaxnerf.Rendering) -> Array:
    batch = jaxnerf.Batch(rays=rays, rgb=rendering.rgb)
    weights = jnp.ones(4)
    packed = jaxnerf.PackedSamples(
        weights=weights, t=weights, delta=weights, ray_index=jnp.arange(4), used=jnp.ones(4, bool)
    )
    assert packed.t.shape == (4,)
    loss = jaxnerf.distortion_loss([rendering], batch)
    image = jaxnerf.round_to_8_bits(rendering.rgb)
    scores = jaxnerf.mse(image, image) + jaxnerf.psnr(image, image) + jaxnerf.ssim(image, image)
    variance = jaxnerf.frustum_variance(rendering.rgb, rendering.depth, rendering.opacity)
    mean = jaxnerf.integrated_encoding(rendering.rgb, variance, num_freqs=4).mean()
    normals: Array = jaxnerf.density_normals(jaxnerf.still_life, rendering.rgb[None], rendering.rgb[None], spacing=0.01)
    lobes: Array = jaxnerf.integrated_directional_encoding(normals, normals[..., 0], degrees=(1, 2))
    encoded = jaxnerf.positional_encoding(rendering.rgb, num_freqs=4).mean() + lobes.mean() + mean
    return loss.mean() + scores + encoded


def fields_and_data(folder: str) -> jaxnerf.Views:
    for field in (jaxnerf.mlp_field(depth=2, width=16), jaxnerf.hash_grid_field(table_size=1024)):
        params = field.init(jax.random.key(0))
        density, rgb = field.apply(params, jnp.zeros((1, 1, 3)), jnp.zeros((1, 1, 3)))
        assert density.shape == rgb.shape[:-1]
    views = jaxnerf.load_dataset(folder, split="train")
    keys, batch = jaxnerf.draw_batch(0, 0, jnp.arange(8), views, batching="all_images")
    assert batch.rgb.shape == (*keys.shape, 3)
    return jaxnerf.Views(
        pixels=views.pixels,
        offset=views.offset,
        size=views.size,
        cameras=views.cameras,
        near=views.near,
        far=views.far,
        mask=None,
        names=("first",),
        background=(1.0, 1.0, 1.0),
        sparse=jaxnerf.SparsePoints(
            positions=jnp.zeros((1, 3)),
            view=jnp.zeros(1, jnp.int32),
            point=jnp.zeros(1, jnp.int32),
            pixel=jnp.zeros((1, 2)),
        ),
    )


def runs(config: ConfigDict, workdir: str, rays: jaxnerf.Rays) -> Array:
    finished: bool = jaxnerf.train_and_evaluate(config, workdir)
    finished = finished and jaxnerf.train_many([config], [workdir])
    run: jaxnerf.TrainedRun = jaxnerf.restore_run(workdir)
    loaded, render = jaxnerf.load_scene(workdir)
    density, _ = loaded(jnp.zeros((1, 1, 3)), jnp.zeros((1, 1, 3)))
    assert finished and run.render_image is not None
    return render(rays).rgb + density


def register() -> None:
    def total_weight(outputs: list[jaxnerf.Rendering], batch: jaxnerf.Batch) -> Array:
        return outputs[-1].opacity

    jaxnerf.register_field("mine", lambda options, box: jaxnerf.mlp_field(**options))
    jaxnerf.register_sampler("mine", lambda context: None)
    jaxnerf.register_loss("mine", total_weight, on="renderings", needs=("alpha",))
    jaxnerf.register_reader("mine", lambda folder: None, detect=lambda folder: False)
    jaxnerf.register_exporter("mine", lambda source, folder: None)
    jaxnerf.register_estimator("mine", lambda source: None)
