"""Scenes that ask for more than positions and directions: values, messages, and nothing for those that do not ask."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen

import jaxnerf
from helpers import all_finite, assert_batch_is_vmap_is_jit, checked_grid, compiled, full_grid, rays_past_origin
from jaxnerf import Camera, Rays, Samples
from jaxnerf.core.cameras import pixel_radius
from jaxnerf.core.contraction import contract, length_scale
from jaxnerf.core.occupancy.from_scene import drop_thin_density, visible_grid, visible_samples
from jaxnerf.core.occupancy.grid import cell_inputs
from jaxnerf.core.occupancy.packed import render_placed
from jaxnerf.core.occupancy.ray_culling import render_selected
from jaxnerf.core.scene import NEEDS, needs_of
from jaxnerf.core.types import PlacedSamples
from jaxnerf.fields.base import Field, apply_network, contract_field, field_scene

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")

RAYS, SEGMENTS = 6, 20
FOUR = ("radius", "length", "time", "image_index")


def plain(x, viewdirs):
    return jnp.exp(-(x**2).sum(axis=-1)), jax.nn.sigmoid(x + viewdirs)


def needy(x, viewdirs, *, radius, length, time, image_index):
    """Fog whose density and colours depend on everything."""
    fog = jnp.exp(-(x**2).sum(axis=-1) / (1 + 10 * radius))
    rgb = [10 * radius + 0 * fog, length * (1 + time), 0.1 * image_index + time + 0 * fog]
    return fog * (1 + time), jnp.stack([value + 0 * fog for value in rgb], axis=-1)


def by_hand(rays, samples):
    """Renders `needy` by a loop over rays and samples: rgb [B, 3]."""
    result = np.zeros((len(rays.near), 3))
    for ray, rgb in enumerate(result):
        light, speed = 1.0, np.linalg.norm(rays.directions[ray])
        for t, delta in zip(samples.t[ray], samples.delta[ray], strict=True):
            x = rays.origins[ray] + t * rays.directions[ray]
            radius, length = rays.radius[ray] * t, delta * speed
            time, index = rays.time[ray], rays.image_index[ray]
            density = np.exp(-(x**2).sum() / (1 + 10 * radius)) * (1 + time)
            alpha = 1 - np.exp(-density * length)
            rgb += light * alpha * np.array([10 * radius, length * (1 + time), 0.1 * index + time])
            light *= 1 - alpha
    return result


@pytest.fixture(scope="module")
def rays():
    rng = np.random.default_rng(3)
    fields = {"radius": rng.uniform(0.01, 0.1, RAYS), "time": rng.uniform(0, 1, RAYS)}
    fields = {name: np.float32(value) for name, value in fields.items()}
    return dataclasses.replace(rays_past_origin(2, RAYS), **fields, image_index=np.arange(RAYS, dtype=np.int32))


@pytest.fixture(scope="module")
def samples(rays):
    edges = jaxnerf.uniform_edges(rays.near, rays.far, num_segments=SEGMENTS)
    return jax.tree.map(np.asarray, jaxnerf.samples_from_edges(jax.random.key(1), edges))


def placed(samples):
    """Returns the samples in a buffer with a few unused slots."""
    count, more = samples.t.size, 5
    ray_index = np.pad(np.repeat(np.arange(RAYS, dtype=np.int32), SEGMENTS), (0, more), mode="edge")
    t, delta = (jnp.pad(values.reshape(-1), (0, more)) for values in (samples.t, samples.delta))
    used, dropped = np.arange(count + more) < count, np.zeros(RAYS, np.int32)
    return PlacedSamples(t=t, delta=delta, ray_index=ray_index, used=used, num_dropped=dropped)


RENDERERS = {
    "render_samples": lambda scene, rays, samples: jaxnerf.render_samples(scene, rays, samples),
    "packed": lambda scene, rays, samples: jaxnerf.render_packed(scene, full_grid(), rays, samples, max_samples=200),
    "terminated": lambda scene, rays, samples: jaxnerf.render_packed(
        scene, full_grid(), rays, samples, max_samples=16, early_stop_eps=1e-9
    ),
    "placed": lambda scene, rays, samples: render_placed(scene, rays, placed(samples), longest=SEGMENTS),
    "masked": lambda scene, rays, samples: jaxnerf.render_samples(
        jaxnerf.mask_scene(scene, full_grid()), rays, samples
    ),
    "thinned": lambda scene, rays, samples: jaxnerf.render_samples(
        drop_thin_density(scene, full_grid(), 0.0), rays, samples
    ),
}


@pytest.mark.parametrize("renderer", RENDERERS)
def test_each_renderer_passes_what_a_loop_computes(renderer, rays, samples):
    got = compiled(functools.partial(RENDERERS[renderer], needy))(rays, samples)
    np.testing.assert_allclose(got.rgb, by_hand(rays, samples), rtol=2e-5)


ONE = {
    "radius": lambda x, viewdirs, *, radius: (plain(x, viewdirs)[0], in_color(radius, x)),
    "length": lambda x, viewdirs, *, length: (plain(x, viewdirs)[0], in_color(length, x)),
    "time": lambda x, viewdirs, *, time: (plain(x, viewdirs)[0], in_color(time, x)),
    "image_index": lambda x, viewdirs, *, image_index: (plain(x, viewdirs)[0], in_color(image_index, x)),
}


def in_color(value, x):
    return value[..., None] + 0 * x


@pytest.mark.parametrize("name", FOUR)
@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_scene_may_need_one_thing(name, renderer, rays, samples):
    """Its colour is the value, so a ray shows the weighted mean of the values along it."""
    alone = dataclasses.replace(rays, **{other: None for other in ("radius", "time", "image_index") if other != name})
    got = compiled(functools.partial(RENDERERS[renderer], ONE[name]))(alone, samples)
    speed = np.linalg.norm(rays.directions, axis=-1, keepdims=True)
    values = {"radius": rays.radius[:, None] * samples.t, "length": samples.delta * speed}
    values |= {"time": rays.time[:, None], "image_index": rays.image_index[:, None]}
    weights = compiled(functools.partial(jaxnerf.render_samples, plain))(rays, samples).weights
    np.testing.assert_allclose(got.rgb[:, 0], (weights * values[name]).sum(axis=-1), rtol=2e-5, atol=1e-6)


def test_render_rays_and_render_hierarchical_pass_them_on(rays):
    whole = compiled(lambda rays: jaxnerf.render_rays(None, needy, rays, num_samples=SEGMENTS))(rays)
    np.testing.assert_allclose(whole.rgb, by_hand(rays, whole.samples), rtol=2e-5)
    hierarchical = functools.partial(jaxnerf.render_hierarchical, None, plain, needy, num_coarse=8, num_fine=8)
    coarse, fine = compiled(hierarchical)(rays)
    np.testing.assert_allclose(fine.rgb, by_hand(rays, fine.samples), rtol=2e-5)
    assert all_finite(coarse)


def test_packed_rendering_equals_dense_rendering_in_a_checked_grid(rays, samples):
    grid = checked_grid()
    want = compiled(lambda rays: jaxnerf.render_samples(jaxnerf.mask_scene(needy, grid), rays, samples))(rays)
    for options in ({}, {"early_stop_eps": 1e-9}):
        run = functools.partial(jaxnerf.render_packed, needy, grid, max_samples=RAYS * SEGMENTS, **options)
        np.testing.assert_allclose(compiled(lambda rays, run=run: run(rays, samples))(rays).rgb, want.rgb, atol=1e-6)


def test_batch_is_vmap_is_jit_and_gradients_reach_the_rays(rays, samples):
    def rgb(rays, samples):
        return jaxnerf.render_samples(needy, rays, samples).rgb

    assert_batch_is_vmap_is_jit(rgb, rays, samples)

    def total(radius, time, render):
        return render(needy, dataclasses.replace(rays, radius=radius, time=time), samples).rgb.sum()

    gradients = [
        jax.jit(jax.grad(functools.partial(total, render=RENDERERS[name]), argnums=(0, 1)))(rays.radius, rays.time)
        for name in ("render_samples", "packed")
    ]
    for dense, packed in zip(*gradients, strict=True):
        assert (np.abs(dense) > 0).all()
        np.testing.assert_allclose(dense, packed, rtol=1e-4)


def test_samples_of_length_0_have_no_gradient_even_where_the_scene_has_none(rays):
    """The square root of a radius of 0 has an infinite derivative."""
    t = np.tile(np.linspace(1, 2, 4, dtype=np.float32), (RAYS, 1))
    samples = Samples(t=t, delta=np.float32([[0.1, 0.1, 0, 0]]).repeat(RAYS, axis=0))
    at_origin = dataclasses.replace(rays, near=np.zeros(RAYS, np.float32))

    def scene(x, viewdirs, *, radius):
        return jnp.sqrt(radius), x

    def total(radius, render):
        return render(scene, dataclasses.replace(at_origin, radius=radius), samples)

    for render in (jaxnerf.render_samples, RENDERERS["packed"]):
        gradient = jax.jit(jax.grad(lambda radius, render=render: total(radius, render).opacity.sum()))(rays.radius)
        assert np.isfinite(gradient).all() and (np.asarray(gradient) > 0).all()


# What a scene asks for.


def scene_with_default(x, viewdirs, *, time=0.25):
    return plain(x, viewdirs)[0] * (1 + time), x


def method(self, x, viewdirs, *, time):
    return plain(x, viewdirs)


@functools.wraps(needy)
def wrapper(x, viewdirs, **inputs):
    return needy(x, viewdirs, **inputs)


class Scene:
    """A scene that is an object."""

    def __call__(self, x, viewdirs, *, time, radius):
        return plain(x, viewdirs)


@pytest.mark.parametrize(
    "scene, names",
    [
        (plain, ()),
        (needy, FOUR),
        (wrapper, FOUR),
        (jax.jit(needy), FOUR),
        (jax.checkpoint(needy), FOUR),
        (jax.jit(functools.partial(needy, time=0.0)), ("radius", "length", "image_index")),
        (functools.partial(wrapper, time=0.0, radius=0.1), ("length", "image_index")),
        (functools.partial(jax.jit(needy), length=1.0), ("radius", "time", "image_index")),
        (functools.partial(functools.partial(method, None), time=0.5), ()),
        (functools.partial(method, None), ("time",)),
        (scene_with_default, ("time",)),
        (Scene(), ("radius", "time")),
        (lambda x, viewdirs, time: plain(x, viewdirs), ()),  # not keyword-only
        (lambda x, viewdirs, *, key=None: plain(x, viewdirs), ()),
        (lambda x, viewdirs, **options: plain(x, viewdirs), ()),
        (jaxnerf.mask_scene(needy, checked_grid()), FOUR),
        (jaxnerf.mask_scene(plain, checked_grid()), ()),
        (max, ()),
    ],
)
def test_needs_are_found(scene, names):
    assert needs_of(scene) == names
    assert set(names) <= set(NEEDS)


def test_a_parameter_with_a_default_keeps_it_where_rays_have_no_value(rays, samples):
    run = compiled(functools.partial(jaxnerf.render_samples, scene_with_default))
    without = run(dataclasses.replace(rays, time=None), samples)
    quarter = run(dataclasses.replace(rays, time=np.full(RAYS, 0.25, np.float32)), samples)
    np.testing.assert_array_equal(without.rgb, quarter.rgb)
    assert np.abs(run(rays, samples).rgb - without.rgb).max() > 1e-3


MESSAGES = {
    "time": r"the scene asks for time, and the rays have none; set Rays.time; .*functools.partial\(scene, time=0.0\)",
    "image_index": r"the scene asks for image_index.*set Rays.image_index, or bind it with .*image_index=0",
    "radius": r"the scene asks for radius, .*set Rays.radius, see cameras.pixel_radius \(rays in NDC have none",
    "progress": r"the scene asks for progress, .*functools.partial\(scene, progress=1.0\)",
}


@pytest.mark.parametrize("name", MESSAGES)
def test_what_is_missing_is_named(name, samples):
    scopes = {"plain": plain}
    exec(f"def scene(x, viewdirs, *, {name}): return plain(x, viewdirs)", scopes)
    rays = rays_past_origin(2, RAYS)
    with pytest.raises(ValueError, match="render_samples: " + MESSAGES[name]):
        jax.eval_shape(functools.partial(jaxnerf.render_samples, scopes["scene"]), rays, samples)
    with pytest.raises(ValueError, match="render_packed: " + MESSAGES[name]):
        jax.eval_shape(functools.partial(RENDERERS["packed"], scopes["scene"]), rays, samples)
    bound = functools.partial(scopes["scene"], **{name: 0})
    assert compiled(functools.partial(jaxnerf.render_samples, bound))(rays, samples).rgb.shape == (RAYS, 3)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_what_no_scene_can_ask_for_is_named(renderer, rays, samples):
    render = RENDERERS.get(renderer, jaxnerf.render_samples)
    with pytest.raises(
        ValueError, match="asks for sigma by a keyword.*expected one of radius, length, time, image_index"
    ):
        jax.eval_shape(functools.partial(render, lambda x, viewdirs, *, sigma: plain(x, viewdirs)), rays, samples)


def test_a_field_of_rays_has_the_shape_of_near(rays, samples):
    with pytest.raises(ValueError, match=r"render_samples: time has shape \(\), expected \[...\] beside near"):
        jax.eval_shape(
            functools.partial(jaxnerf.render_samples, needy), dataclasses.replace(rays, time=np.float32(0)), samples
        )


def test_ndc_rays_keep_time_and_image_and_have_no_radius(rays):
    camera = Camera(to_world=np.eye(3, 4), focal=np.ones(2), center=np.ones(2), height=2, width=2)
    ndc = jaxnerf.ndc_rays(rays, camera)
    assert ndc.radius is None
    np.testing.assert_array_equal(ndc.time, rays.time)
    np.testing.assert_array_equal(ndc.image_index, rays.image_index)


# What is not asked for is not computed.


def programs(scene, rays, samples):
    """Returns the jaxprs of the renderers and of a grid's update as text."""
    key, cells = jax.random.key(0), jnp.arange(9)
    functions = [functools.partial(render, scene) for render in RENDERERS.values()]
    texts = [str(jax.make_jaxpr(function)(rays, samples)) for function in functions]
    update = functools.partial(jaxnerf.update_grid, scene=scene, cells=cells, threshold=0.1)
    return [*texts, str(jax.make_jaxpr(update)(key, full_grid()))]


def test_a_scene_that_needs_nothing_has_the_same_program(rays, samples):
    """Rays may have the fields or not, and parameters of other names do not count."""
    bare = dataclasses.replace(rays, radius=None, time=None, image_index=None)

    def other(x, viewdirs, *, key=None, power=2):
        return jnp.exp(-(x**power).sum(axis=-1)), jax.nn.sigmoid(x + viewdirs)

    want = programs(plain, bare, samples)
    assert programs(other, bare, samples) == want
    bound = functools.partial(lambda x, viewdirs, *, time: plain(x, viewdirs), time=None)
    assert programs(bound, bare, samples) == want
    operations = [text.count(" = ") for text in want]
    assert [text.count(" = ") for text in programs(plain, rays, samples)][0] == operations[0]


def test_only_what_is_needed_is_computed(rays, samples):
    def at_time(x, viewdirs, *, time):
        return plain(x, viewdirs)

    base, more = (
        str(jax.make_jaxpr(functools.partial(jaxnerf.render_samples, each))(rays, samples)) for each in (plain, at_time)
    )
    assert more.count(" = ") <= base.count(" = ") + 1


# Rays keep their fields.


def test_chunks_of_images_keep_the_fields(rays, samples):
    image = jax.tree.map(lambda leaf: np.stack([leaf, leaf[::-1]]), rays)
    render = jax.jit(lambda rays: jaxnerf.render_rays(None, needy, rays, num_samples=SEGMENTS))
    want = render(image).rgb
    np.testing.assert_allclose(jaxnerf.render_image(render, image, chunk=5).rgb, want, rtol=1e-5, atol=1e-6)
    everything = np.ones(image.near.shape, bool)
    empty = jax.tree.map(jnp.zeros_like, jaxnerf.render_image(render, image, chunk=5))
    chosen = render_selected(render, image, everything, empty, chunk=5)
    np.testing.assert_allclose(chosen.rgb, want, rtol=1e-5, atol=1e-6)


def test_no_rays_and_no_gradient(rays, samples):
    none = jax.tree.map(lambda leaf: leaf[:0], (rays, samples))

    def total(power):
        def scene(x, viewdirs, *, time):
            return time**power + 0 * x[..., 0], x

        return jaxnerf.render_packed(scene, full_grid(), *none, max_samples=4).rgb.sum()

    assert jax.jit(jax.grad(total))(0.5) == 0


def test_visible_samples_pass_what_a_scene_needs(rays, samples):
    def wall(x, viewdirs, *, time, length):
        """Opaque at an even time, empty at an odd one."""
        return 1e4 * (time < 0.5) * (length > 0) + 0 * x[..., 0], 0.5 + 0 * x

    timed = dataclasses.replace(rays, time=np.float32(np.arange(RAYS) % 2))
    needed = jax.jit(
        lambda rays, samples: visible_samples(wall, full_grid(), rays, samples, error=1 / 512, max_samples=50)
    )(timed, samples)
    np.testing.assert_array_equal(np.asarray(needed).any(axis=-1), np.arange(RAYS) % 2 == 0)


# Cones.


@pytest.mark.parametrize("lens, distortion", [("pinhole", None), ("opencv", [0.1, -0.02, 0.01, 0.005])])
def test_the_radius_is_that_of_neighbouring_rays(lens, distortion):
    """As in arXiv:2103.13415: 2 / sqrt(12) times the side of the pixel, by finite differences."""
    options = {} if distortion is None else {"distortion": np.float32(distortion)}
    camera = Camera(
        to_world=np.eye(3, 4, dtype=np.float32),
        focal=np.float32([40, 50]),
        center=np.float32([16, 12]),
        lens=lens,
        **options,
    )
    pixels = np.asarray(jaxnerf.pixel_grid(24, 32))
    step = 0.25
    directions = jax.jit(lambda pixels: jaxnerf.rays_from_pixels(camera, pixels, near=1.0, far=2.0).directions)
    at = [directions(pixels + np.float32(shift)) for shift in ((step, 0), (-step, 0), (0, step), (0, -step))]
    right, down = (np.asarray(at[i] - at[i + 1]) / (2 * step) for i in (0, 2))
    area = np.linalg.norm(np.cross(right, down), axis=-1)
    radius = jax.jit(functools.partial(pixel_radius, camera))
    got = radius(pixels)
    np.testing.assert_allclose(got, 2 / np.sqrt(12) * np.sqrt(area), rtol=2e-3)
    one = radius(np.array([3, 4]))  # integers, and no leading axes
    assert one.shape == () and np.isfinite(jax.jit(jax.grad(radius))(np.float32([3, 4]))).all()


def test_contracted_lengths_have_the_scale_of_the_contraction():
    x = np.random.default_rng(0).normal(size=(200, 3)).astype(np.float32) * np.geomspace(0.3, 300, 200)[:, None]
    x = np.float32(x)
    determinant = np.abs(np.linalg.det(np.float64(jax.jit(jax.vmap(jax.jacfwd(contract)))(x))))
    scale = compiled(length_scale)
    np.testing.assert_allclose(scale(x), np.cbrt(determinant), rtol=2e-3)
    assert (scale(x)[np.abs(x).max(axis=-1) <= 1] == 1).all()
    far = np.float32([[np.inf, 0, 0], [1e30, -1e30, 0], [1e12, 0, 0]])
    assert np.isfinite(scale(far)).all() and all_finite(jax.jit(jax.vmap(jax.grad(length_scale)))(far[1:]))


def test_a_contracted_field_receives_contracted_lengths():
    def apply(params, x, viewdirs, *, radius, length, time):
        return radius + 0 * x[..., 0], jnp.stack([radius, length, time + 0 * radius], axis=-1)

    box = np.float32([-2, -4, -2]), np.float32([2, 4, 2])
    field = contract_field(Field(None, apply), *box)
    assert needs_of(field.apply) == ("radius", "length", "time")
    x = np.float32([[0.5, 0.5, 0.5], [30.0, 2.0, -4.0]])
    inputs = {"radius": np.float32([0.1, 0.1]), "length": np.float32([0.2, np.inf]), "time": np.float32([0.5])}
    density, rgb = field.apply({}, x, np.zeros((1, 3), np.float32), **inputs)
    scale = np.asarray(length_scale(x / np.float32([1, 2, 1])))
    np.testing.assert_allclose(density, 0.1 * scale, rtol=1e-6)
    np.testing.assert_allclose(rgb[0], [0.1, 0.2, 0.5])
    assert np.isfinite(rgb).all()


# Cells of a grid.


def test_cells_have_stated_values():
    grid = jaxnerf.create_grid(np.zeros(3), np.float32([8, 4, 2]), np.ones((8, 4, 2), bool), initial_density=1.0)
    x = np.random.default_rng(0).uniform(0, 2, (500, 3)).astype(np.float32)
    at = jax.jit(functools.partial(cell_inputs, "test", needy))(grid, x)
    assert [each.shape for each in at.values()] == [(500,)] * 4
    np.testing.assert_allclose(at["radius"], 0.5)
    np.testing.assert_allclose(at["length"], 1.0)
    assert not at["time"].any() and not at["image_index"].any() and at["image_index"].dtype == np.int32
    given = jax.jit(lambda grid, x: cell_inputs("test", needy, grid, x, length=np.full(500, 0.3), time=0.25))(grid, x)
    np.testing.assert_allclose(given["length"], 0.3)
    np.testing.assert_array_equal(given["time"], np.full(500, 0.25))


def test_contracted_cells_are_larger_far_away_and_a_contracted_field_undoes_it():
    grid = jaxnerf.create_grid(
        np.full(3, -2.0), np.full(3, 2.0), np.ones((8, 8, 8), bool), initial_density=1.0, contracted=True
    )
    x = np.float32([[0.1, 0.2, 0.3], [5.0, 1.0, 2.0], [1e4, 0, 0]])
    radius = cell_inputs("test", functools.partial(needy, time=0.0), grid, x)["radius"]
    np.testing.assert_allclose(radius * length_scale(x), 0.25, rtol=1e-5)


@pytest.mark.parametrize("contracted", [False, True])
def test_a_cell_is_occupied_if_matter_is_there_for_any_radius(contracted):
    """Matter that only cones of one size meet; far away, where space is contracted, cones are larger."""
    shape = (8, 8, 8)
    valid = np.ones(shape, bool)
    grid = jaxnerf.create_grid(np.full(3, -2.0), np.full(3, 2.0), valid, initial_density=0.0, contracted=contracted)
    cells, found = jnp.arange(512), []

    def density_at(low, high):
        def scene(x, viewdirs, *, radius):
            stretched = radius * (length_scale(x) if contracted else 1)
            return jnp.where((stretched > low) & (stretched < high), 10.0, 0.0), 0 * x

        key, radii = jax.random.key(0), jnp.float32([0.01, 0.16])
        return jaxnerf.update_grid(key, grid, scene, cells, threshold=0.1, radii=radii).density_max

    density_at = jax.jit(density_at)
    assert (density_at(0.0099, 0.1601) == 10).all()
    for low, high in ((0.01, 0.02), (0.02, 0.04), (0.04, 0.08), (0.08, 0.16)):
        found.append(float((density_at(low, high) > 0).mean()))
    np.testing.assert_allclose(found, 0.25, atol=0.06)  # uniform in the logarithm
    assert not (density_at(0.2, 0.3) > 0).any()


def test_a_cell_is_occupied_if_matter_is_there_at_any_time():
    """A wall stands at x < 0 in the first half of the time, and at x > 0 in the second."""

    def wall(x, viewdirs, *, time):
        return jnp.where((x[..., 0] < 0) == (time < 0.5), 10.0, 0.0), 0 * x

    corner, shape = np.ones(3), (4, 4, 4)
    grid = jaxnerf.grid_from_scene(jax.random.key(0), wall, -corner, corner, shape, threshold=1.0, num_updates=12)
    assert grid.occupied.all() and (np.asarray(grid.density_max) == 10).all()
    frozen = functools.partial(wall, time=0.0)
    grid = jaxnerf.grid_from_scene(jax.random.key(0), frozen, -corner, corner, shape, threshold=1.0)
    assert (np.asarray(grid.density_max)[:2] == 10).all() and not np.asarray(grid.density_max)[2:].any()


def test_needs_do_not_move_the_points_in_the_cells():
    def scene(x, viewdirs, *, time=None, length=None):
        return jnp.abs(x).sum(axis=-1), x

    cells, key = jnp.arange(64), jax.random.key(7)
    grid = jaxnerf.create_grid(-np.ones(3), np.ones(3), np.ones((4, 4, 4), bool), initial_density=0.0)
    update = functools.partial(jaxnerf.update_grid, key, cells=cells, threshold=0.1, spacing=0.2)
    both = [
        compiled(lambda grid, each=each: update(grid, scene=each).density_max)(grid)
        for each in (scene, lambda x, viewdirs: scene(x, viewdirs))
    ]
    np.testing.assert_array_equal(*both)


def test_the_visible_grid_of_a_moving_scene_holds_the_matter_of_all_times():
    def ball(x, viewdirs, *, time):
        center = jnp.stack([1.2 * time - 0.6, 0 * time, 0 * time], axis=-1)
        return 300.0 * (((x - center) ** 2).sum(axis=-1) < 0.1), 0 * x + 0.2

    rng = np.random.default_rng(0)
    count = 2**13
    target, eyes = rng.uniform(-0.9, 0.9, (count, 3)), rng.normal(size=(count, 3))
    eyes *= 4 / np.linalg.norm(eyes, axis=-1, keepdims=True)
    away = (target - eyes) / np.linalg.norm(target - eyes, axis=-1, keepdims=True)
    ends = {"near": np.full(count, 1.0, np.float32), "far": np.full(count, 7.0, np.float32)}
    times = np.float32(rng.integers(2, size=count))  # only the first and the last instant are seen
    rays = Rays(origins=np.float32(eyes), directions=np.float32(away), viewdirs=np.float32(away), time=times, **ends)
    box = {"lower": (-1.0,) * 3, "upper": (1.0,) * 3, "shape": (12, 12, 12), "step_size": 0.05}
    grid = visible_grid(ball, rays, **box, threshold=1.0, max_samples=2**14)
    occupied = np.asarray(grid.occupied)
    assert occupied[1:4, 6, 6].any() and occupied[8:11, 6, 6].any() and not occupied[:, :2].any()


# Fields.


def test_padding_for_the_cache_does_not_change_the_inputs_of_a_network():
    class Network(linen.Module):
        @linen.compact
        def __call__(self, x, viewdirs, radius, time, image_index, progress):
            scale = self.param("scale", linen.initializers.ones, ())
            rgb = jnp.stack([radius + 0 * time, time + 0 * radius, image_index + 0 * radius], axis=-1)
            return scale * progress * x[..., 0], rgb

    rng = np.random.default_rng(0)
    for shape in ((32, 16), (4, 128), (3, 5)):
        x, radius = np.float32(rng.normal(size=(*shape, 3))), np.float32(rng.normal(size=shape))
        time, index = np.float32(rng.normal(size=(shape[0], 1))), np.arange(shape[0], dtype=np.int32)[:, None]
        inputs = {"radius": radius, "time": time, "image_index": index, "progress": jnp.float32(0.5)}
        density, rgb = compiled(functools.partial(apply_network, Network()))({"scale": 1.0}, x, x[:, :1], **inputs)
        np.testing.assert_allclose(density, 0.5 * x[..., 0])
        want = [radius, np.broadcast_to(time, shape), np.broadcast_to(index, shape)]
        np.testing.assert_allclose(rgb, np.stack(want, axis=-1))


def test_the_progress_of_the_parameters_is_bound():
    def apply(params, x, viewdirs, *, progress, time):
        return params * progress + 0 * x[..., 0], 0 * x

    field = Field(None, apply)
    assert needs_of(field_scene(field, {"fine": 2.0})) == ("time", "progress")
    scene = field_scene(field, {"fine": 2.0, "progress": 0.25})
    assert needs_of(scene) == ("time",)
    assert scene(jnp.zeros((1, 3)), jnp.zeros((1, 3)), time=0)[0] == 0.5
    plain_field = Field(None, lambda params, x, viewdirs: plain(x, viewdirs))
    assert needs_of(field_scene(plain_field, {"fine": {}, "progress": 1.0})) == ()
