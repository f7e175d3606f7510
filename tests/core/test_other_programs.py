"""What other programs pass to the public functions: rays in place of images, stacks of cameras, features, old keys."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnerf
from jaxnerf.core.rendering import render_samples

make_rays = jax.jit(jaxnerf.rays_from_pixels)


def camera(**options):
    pose = jaxnerf.look_at((0.2, -4.0, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    return jaxnerf.Camera(to_world=pose, focal=jnp.full(2, 6.0), center=jnp.full(2, 3.0), **options)


@functools.cache
def rays():
    return make_rays(camera(), jaxnerf.pixel_grid(6, 6), near=1.0, far=6.0)


def features(x, viewdirs, channels=8):
    """Is a soft ball whose channels are different functions of the position."""
    density = 3 * jnp.exp(-4 * (x**2).sum(axis=-1))
    return density, jnp.stack([jnp.sin(index + x[..., 0]) for index in range(channels)], axis=-1)


def test_metrics_take_batches_of_rays():
    a, b = (jax.random.uniform(jax.random.key(seed), (64, 3)) for seed in range(2))
    mask = jnp.arange(64) < 20
    np.testing.assert_allclose(jaxnerf.mse(a, b), ((a - b) ** 2).mean(), rtol=1e-6)
    np.testing.assert_allclose(jaxnerf.mse(a, b, mask=mask), jaxnerf.mse(a[:20], b[:20]), rtol=1e-6)
    image = (each.reshape(8, 8, 3) for each in (a, b))
    np.testing.assert_allclose(jaxnerf.psnr(a, b), jaxnerf.psnr(*image), rtol=1e-6)
    with pytest.raises(ValueError, match="psnr: b has shape"):
        jaxnerf.psnr(a, b[:32])


@pytest.mark.parametrize("metric", [jaxnerf.mse, jaxnerf.psnr, jaxnerf.ssim])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int32, bool])
def test_metrics_refuse_integers(metric, kind):
    image = np.ones((16, 16, 3), kind)
    with pytest.raises(ValueError, match=f"{metric.__name__}: a has type .*, expected floats in .*divide 8 bit images"):
        metric(image, image)


def test_rounding_refuses_bytes():
    """Clipped to [0, 1], all but 0 would be white."""
    with pytest.raises(ValueError, match="round_to_8_bits: image has type uint8, expected floats in .*divide 8 bit"):
        jaxnerf.round_to_8_bits(np.full((2, 2, 3), 200, np.uint8))


@pytest.mark.parametrize("lens", [None, "opencv", "fisheye"])
def test_a_stack_of_cameras_has_the_rays_of_each(lens):
    poses = jnp.stack([jaxnerf.look_at((x, -4.0, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)) for x in (0.0, 1.0, 2.0)])
    options = {"lens": lens, "distortion": jnp.array([0.1, 0.02, 0.001, 0.002])} if lens else {}
    one, pixels = camera(**options), jaxnerf.pixel_grid(6, 5)
    near = jnp.linspace(1, 2, 30).reshape(6, 5)
    stack = make_rays(dataclasses.replace(one, to_world=poses), pixels, near=near, far=6.0)
    focal = jnp.stack([one.focal] * 3)
    whole = make_rays(dataclasses.replace(one, to_world=poses, focal=focal), pixels, near=near, far=6.0)
    for index, pose in enumerate(poses):
        alone = make_rays(dataclasses.replace(one, to_world=pose), pixels, near=near, far=6.0)
        for several in (stack, whole):
            jax.tree.map(lambda a, b, i=index: np.testing.assert_allclose(a[i], b, atol=1e-6), several, alone)


def test_a_stack_of_cameras_has_any_leading_axes_and_a_near_of_each():
    poses = jnp.stack([jaxnerf.look_at((x, -4.0, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)) for x in range(6)])
    one, pixels = camera(), jaxnerf.pixel_grid(5, 6)  # as many columns as cameras
    near = jnp.linspace(1, 2, 6)
    flat = make_rays(dataclasses.replace(one, to_world=poses), pixels, near=near, far=9.0)
    np.testing.assert_array_equal(flat.near, jnp.broadcast_to(near[:, None, None], (6, 5, 6)))
    nested = dataclasses.replace(one, to_world=poses.reshape(2, 3, 3, 4), center=jnp.full((2, 3, 2), 3.0))
    nested = make_rays(nested, pixels, near=near.reshape(2, 3), far=9.0)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a.reshape(b.shape), b, atol=1e-6), nested, flat)
    with pytest.raises(ValueError, match=r"focal has shape \(2, 2\), which does not fit \(6, 2\)"):
        wrong = dataclasses.replace(one, to_world=poses, focal=jnp.ones((2, 2)))
        jaxnerf.rays_from_pixels(wrong, pixels, near=near, far=9.0)


def test_what_takes_one_camera_says_how_several_are_computed():
    """Runs the advice of the message."""
    poses = jnp.stack([jaxnerf.look_at((x, -4.0, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)) for x in range(3)])
    pixels, one = jaxnerf.pixel_grid(6, 6), camera(height=6, width=6)
    cameras = dataclasses.replace(one, to_world=poses, focal=jnp.full((3, 2), 6.0), center=jnp.full((3, 2), 3.0))
    rays = make_rays(cameras, pixels, near=1.0, far=6.0)
    for function, values in {
        jaxnerf.project: jnp.zeros((5, 3)),
        jaxnerf.undistort: pixels,
        jaxnerf.pixel_radius: pixels,
        jaxnerf.ndc_rays: None,
    }.items():
        arguments = (cameras, values) if values is not None else (rays, cameras)
        with pytest.raises(
            ValueError, match=f"^{function.__name__}: the camera's .* has shape .*, of one camera"
        ) as raised:
            function(*arguments)
        advice = str(raised.value).partition("; for several, each array of which has a leading axis, call ")[2]
        names = {"jax": jax, function.__name__: function, "cameras": cameras, "rays": rays, "values": values}
        found = jax.jit(lambda advice=advice, names=names: eval(advice.replace("...", "values"), names))()
        assert all(len(leaf) == 3 for leaf in jax.tree.leaves(found))
    with pytest.raises(ValueError, match=r"to_world has shape \(4, 4\), expected \(3, 4\)"):
        jaxnerf.rays_from_pixels(dataclasses.replace(one, to_world=jnp.eye(4)), pixels, near=1.0, far=6.0)


@pytest.mark.parametrize("channels", [1, 8])
def test_scenes_of_any_number_of_channels(channels):
    """All renderers agree with three channels at a time, over a background of as many channels."""

    def scene(x, viewdirs):
        return features(x, viewdirs, channels)

    behind = jnp.linspace(0, 1, channels)
    edges = np.linspace(rays().near, rays().far, 25, axis=-1)
    samples = jax.jit(functools.partial(jaxnerf.samples_from_edges, None))(edges)
    whole = jax.jit(lambda: render_samples(scene, rays(), samples, background=behind, median_depth=True))()
    assert whole.rgb.shape == (6, 6, channels)
    for index in {0, channels - 1}:

        def grey(x, viewdirs, index=index):
            density, values = scene(x, viewdirs)
            return density, values[..., index, None] * jnp.ones((1,) * (x.ndim - 1) + (3,))

        alone = jax.jit(
            lambda grey=grey, color=behind[index]: render_samples(grey, rays(), samples, background=jnp.full(3, color))
        )()
        np.testing.assert_allclose(whole.rgb[..., index], alone.rgb[..., 0], atol=1e-6)
    bounds = jnp.full(3, -2.0), jnp.full(3, 2.0)
    grid = jaxnerf.create_grid(*bounds, jnp.ones((4, 4, 4), bool), initial_density=1.0)
    options = {"max_samples": 36 * 24, "background": behind}
    packed = jax.jit(lambda: jaxnerf.render_packed(scene, grid, rays(), samples, **options))()
    np.testing.assert_allclose(packed.rgb, whole.rgb, atol=1e-3)
    options |= {"early_stop_eps": 1e-6, "median_depth": True}
    early = jax.jit(lambda: jaxnerf.render_packed(scene, None, rays(), samples, **options))()
    np.testing.assert_allclose(early.rgb, whole.rgb, atol=1e-5)
    np.testing.assert_allclose(early.median_depth, whole.median_depth, rtol=1e-5)
    shapes = (channels,), (1,), (6, 6, 1), (6, 6, channels)
    for render in (
        lambda behind: render_samples(scene, rays(), samples, background=behind),
        lambda behind: jaxnerf.render_packed(scene, grid, rays(), samples, max_samples=36 * 24, background=behind),
    ):
        want, *found = jax.jit(lambda render=render: [render(jnp.ones(shape)).rgb for shape in shapes])()
        for rgb in found:
            np.testing.assert_array_equal(rgb, want)
    for wrong in (jnp.ones(channels + 1), jnp.ones((5, channels)), jnp.ones(())):
        for render in (render_samples, jaxnerf.render_packed):
            more = {"max_samples": 864} if render is jaxnerf.render_packed else {}
            arguments = (None,) if more else ()
            with pytest.raises(ValueError, match="background has shape"):
                jax.eval_shape(functools.partial(render, scene, *arguments, background=wrong, **more), rays(), samples)


def test_wrong_outputs_and_errors_of_a_scene_name_the_shapes():
    def flat(x, viewdirs):
        return x[..., 0], x[..., 0]

    def glued(x, viewdirs):
        return x[..., 0], jnp.concatenate([x, viewdirs], axis=-1)[..., :3]

    with pytest.raises(ValueError, match=r"returned density \(6, 6, 8\) and rgb \(6, 6, 8\)"):
        jax.eval_shape(lambda: jaxnerf.render_rays(None, flat, rays(), num_samples=8))
    with pytest.raises(TypeError) as caught:
        jax.eval_shape(lambda: jaxnerf.render_rays(None, glued, rays(), num_samples=8))
    assert "x (6, 6, 8, 3) and viewdirs (6, 6, 1, 3), which broadcast" in " ".join(caught.value.__notes__)


@pytest.mark.parametrize("key", [0, 1.5, np.zeros((), np.uint32), "seed"])
def test_what_is_no_key_is_refused(key):
    with pytest.raises(ValueError, match=r"expected a key such as jax.random.key\(0\)"):
        jaxnerf.render_rays(key, features, rays(), num_samples=4)


@pytest.mark.parametrize("key", [0, None, np.int64(3)])
def test_what_needs_one_key_refuses_all_else(key):
    bounds = jnp.full(3, -1.0), jnp.ones(3)
    grid = jaxnerf.create_grid(*bounds, jnp.ones((2, 2, 2), bool), initial_density=1.0)
    for call in (
        lambda: jaxnerf.update_grid(key, grid, features, jnp.arange(8), threshold=0.1),
        lambda: jaxnerf.grid_from_scene(key, features, *bounds, (2, 2, 2), threshold=0.1),
        lambda: jaxnerf.mlp_field(depth=2, width=8).init(key),
        lambda: jaxnerf.hash_grid_field(lower=(0, 0, 0), upper=(1, 1, 1)).init(key),
    ):
        with pytest.raises(ValueError, match=r"key is .*, expected a key such as jax.random.key\(0\)(;|$)"):
            call()


@pytest.mark.parametrize("metric", [jaxnerf.mse, jaxnerf.psnr])
@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_metrics_refuse_masks_of_numbers(metric, kind):
    """Their sum would be taken for the number of pixels."""
    image = np.ones((16, 16, 3), np.float32)
    with pytest.raises(ValueError, match="mask has type .*, expected bool; compare it with a threshold"):
        metric(image, image / 2, mask=np.full((16, 16), 255, kind))


def test_old_keys_are_accepted():
    scene = jaxnerf.still_life
    render = jax.jit(lambda key: jaxnerf.render_rays(key, scene, rays(), num_samples=4))
    new, old = (render(key(3)) for key in (jax.random.key, jax.random.PRNGKey))
    np.testing.assert_array_equal(new.rgb, old.rgb)


def test_cells_that_are_no_bools_are_refused():
    bounds, cells = (jnp.zeros(3), jnp.ones(3)), jnp.ones((2, 2, 2))
    with pytest.raises(ValueError, match="create_grid: valid has type float32, expected bool"):
        jaxnerf.create_grid(*bounds, cells, initial_density=1.0)
    grid = jaxnerf.create_grid(*bounds, cells > 0, initial_density=1.0)
    grid = dataclasses.replace(grid, occupied=cells)
    with pytest.raises(ValueError, match="mask_scene: occupied has type float32, expected bool"):
        jaxnerf.mask_scene(features, grid)
    samples = jaxnerf.samples_from_points(jnp.broadcast_to(jnp.linspace(2, 6, 8), (6, 6, 8)))
    with pytest.raises(ValueError, match="OccupancyGrid: occupied has type float32, expected bool"):
        jaxnerf.render_packed(features, grid, rays(), samples, max_samples=64)


def test_errors_name_the_function_that_was_called():
    with pytest.raises(TypeError, match=r"hash_grid_field\(\) missing 2 required .*'lower' and 'upper'"):
        jaxnerf.hash_grid_field()
    with pytest.raises(TypeError, match=r"hash_grid_field\(\) got an unexpected keyword argument 'levels'"):
        jaxnerf.hash_grid_field(lower=(0, 0, 0), upper=(1, 1, 1), levels=3)
    with pytest.raises(TypeError, match=r"mlp_field\(\) got an unexpected keyword argument 'layers'"):
        jaxnerf.mlp_field(layers=3)


@pytest.mark.extra
def test_a_pose_is_refined_by_public_functions():
    """Finds the pose of an image by gradient descent from one that is 3 degrees and 0.05 units off."""
    view, pixels = camera(), jaxnerf.pixel_grid(6, 6)
    truth = jaxnerf.render_rays(None, jaxnerf.still_life, rays(), num_samples=32).rgb
    wrong = jaxnerf.se3_exponential(jnp.array([0.03, -0.04, 0.02, 0.03, 0.0, -0.04]))
    start = jnp.concatenate([wrong[:, :3] @ view.to_world[:, :3], view.to_world[:, 3:] + wrong[:, 3:]], axis=-1)

    def error(twist):
        motion = jaxnerf.se3_exponential(twist)
        pose = jnp.concatenate([motion[:, :3] @ start[:, :3], start[:, 3:] + motion[:, 3:]], axis=-1)
        turned = jaxnerf.rays_from_pixels(dataclasses.replace(view, to_world=pose), pixels, near=1.0, far=6.0)
        return jaxnerf.mse(jaxnerf.render_rays(None, jaxnerf.still_life, turned, num_samples=32).rgb, truth)

    descend, twist = jax.jit(jax.value_and_grad(error)), jnp.zeros(6)
    first = error(twist)
    for _ in range(40):
        twist = twist - 0.05 * descend(twist)[1]
    assert error(twist) < 0.5 * first
