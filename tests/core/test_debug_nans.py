"""Under jax_debug_nans, op by op and jitted, no public function raises on inputs whose result holds no NaN.

JAX then checks the result of every operation, so that a NaN in the branch of a `where` that is not selected raises,
too. Someone who looks for a NaN of their own must not be stopped here.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import pytest

import jaxnerf

KEY = jax.random.key(0)
LENS = {"opencv": jnp.array([0.1, -0.02, 0.001, 0.002]), "fisheye": jnp.array([0.01, 0.002, 0.0, 0.0])}


def scene(x, viewdirs):
    density = 3 * jnp.exp(-4 * (x**2).sum(axis=-1))
    return density, 0.5 + 0.25 * jnp.sin(x + viewdirs)


def empty_scene(x, viewdirs):
    return 0 * x[..., 0], 0 * x


def solid_scene(x, viewdirs):
    """Has infinite density in the right half of space."""
    return jnp.where(x[..., 0] > 0, jnp.inf, 0), 0.5 + 0.25 * jnp.sin(x + viewdirs)


SCENES = {"soft": scene, "empty": empty_scene, "solid": solid_scene, "still_life": jaxnerf.still_life}


def made_once(make):
    """Makes each result of a function once, and in one program, though parts of it are results of such functions."""

    @functools.cache
    def call(*args, **options):
        with jax.ensure_compile_time_eval():
            return jax.jit(functools.partial(make, *args, **options))()

    return call


@made_once
def camera(lens="pinhole"):
    pose = jaxnerf.look_at((0.1, -4.0, 0.2), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    options = {"distortion": LENS[lens], "lens": lens} if lens in LENS else {}
    return jaxnerf.Camera(to_world=pose, focal=jnp.full(2, 6.0), center=jnp.full(2, 3.0), height=6, width=6, **options)


@made_once
def rays(near=1.0, far=6.0):
    made = jaxnerf.rays_from_pixels(camera(), jaxnerf.pixel_grid(6, 6), near=near, far=far)
    return jax.tree.map(lambda leaf: leaf[2:4].reshape(12, *leaf.shape[2:]), made)


@made_once
def forward_rays():
    pose = jnp.eye(4)[:3]
    view = jaxnerf.Camera(to_world=pose, focal=jnp.full(2, 6.0), center=jnp.full(2, 3.0), height=6, width=6)
    made = jaxnerf.rays_from_pixels(view, jaxnerf.pixel_grid(6, 6), near=0.0, far=1.0)
    # The last ray runs across, along the near plane.
    directions = made.directions.at[-1, -1].set(jnp.array([1.0, 0.0, 0.0]))
    return view, jaxnerf.Rays(
        origins=made.origins, directions=directions, viewdirs=directions, near=made.near, far=made.far
    )


@made_once
def plain_samples(rule="segments", *, far=6.0, skipped=False):
    if rule == "points":
        points = jaxnerf.uniform_edges(rays().near, rays().far, num_segments=7)
        samples = jaxnerf.samples_from_points(points)
    else:
        edges = jaxnerf.uniform_edges(rays().near, rays(far=far).far, num_segments=8, in_disparity=far == jnp.inf)
        samples = jaxnerf.samples_from_edges(None, edges, rule=rule)
    if skipped:
        delta = samples.delta.at[:, 2].set(0)
        samples = jaxnerf.Samples(t=samples.t.at[:, 2].set(0), delta=delta, rule=samples.rule)
    return samples


@made_once
def grid(contracted=False):
    lower, upper = jnp.full(3, -1.5), jnp.full(3, 1.5)
    options = {"initial_density": 1.0, "contracted": contracted}
    return jaxnerf.create_grid(lower, upper, jnp.ones((4, 4, 4), bool).at[:2, 0].set(False), **options)


def numbers(shape, seed=1):
    return jax.random.uniform(jax.random.key(seed), shape)


def render(function, kind, **options):
    """Makes a case that renders a scene with a scale, which the gradient is taken of."""

    def of(scale):
        def scaled(x, viewdirs):
            density, rgb = SCENES[kind](x, viewdirs)
            solid = jnp.isinf(density)
            return jnp.where(solid, density, jnp.where(solid, 1, density) * scale), rgb * scale

        return function(scaled, **options)

    return of, (jnp.float32(1.0),)


def of_rays(function, kind, make, **options):
    """Makes a case that renders rays, which the gradient is taken of."""

    def of(origins, directions, near, far):
        made = jaxnerf.Rays(origins=origins, directions=directions, viewdirs=directions, near=near, far=far)
        return function(SCENES[kind], rays=made, **options)

    return of, (make.origins, make.directions, make.near, make.far)


def rays_with(function, **fixed):
    return lambda scene, rays: function(scene, rays, **fixed)


def render_in_chunks(scene, *, rays):
    return jaxnerf.render_image(lambda part: jaxnerf.render_rays(None, scene, part, num_samples=4), rays, chunk=8)


def hierarchical(scene, *, rays, **options):
    return jaxnerf.render_hierarchical(KEY, scene, scene, rays, num_coarse=4, num_fine=4, **options)


def evenly(scene, *, rays, **options):
    return jaxnerf.render_rays(KEY, scene, rays, num_samples=8, **options)


def at_samples(scene, *, rays, samples, **options):
    return jaxnerf.render_samples(scene, rays, samples, **options)


def packed(scene, *, rays, samples, grid=None, **options):
    return jaxnerf.render_packed(scene, grid, rays, samples, **options)


def distortion(weights, t, delta, near, far, *, rule="segments"):
    made = rays()
    made = jaxnerf.Rays(origins=made.origins, directions=made.directions, viewdirs=made.viewdirs, near=near, far=far)
    rendering = jaxnerf.Rendering(
        rgb=made.origins, opacity=near, depth=near, disparity=near, weights=weights, num_dropped=near.astype(int),
        samples=jaxnerf.Samples(t=t, delta=delta, rule=rule),
    )  # fmt: skip
    return jaxnerf.distortion_loss([rendering], jaxnerf.Batch(rays=made, rgb=made.origins))


def packed_distortion(weights, t, delta, near, far):
    made = rays()
    made = jaxnerf.Rays(origins=made.origins, directions=made.directions, viewdirs=made.viewdirs, near=near, far=far)
    samples = jaxnerf.PackedSamples(
        weights=weights, t=t, delta=delta, ray_index=jnp.repeat(jnp.arange(12), 2), used=jnp.arange(24) < 17
    )
    rendering = jaxnerf.Rendering(
        rgb=made.origins, opacity=near, depth=near, disparity=near, weights=None, num_dropped=near.astype(int),
        samples=samples,
    )  # fmt: skip
    return jaxnerf.distortion_loss([rendering], jaxnerf.Batch(rays=made, rgb=made.origins))


def updated(scale, *, contracted=False, density=1.0):
    def scaled(x, viewdirs):
        values, rgb = scene(x, viewdirs)
        return density * scale * values, rgb

    return jaxnerf.update_grid(KEY, grid(contracted), scaled, jnp.arange(64), threshold=0.0)


def from_scene(scale, *, contracted=False):
    def scaled(x, viewdirs):
        density, rgb = scene(x, viewdirs)
        return density * scale, rgb

    bounds = jnp.full(3, -1.5), jnp.full(3, 1.5)
    return jaxnerf.grid_from_scene(KEY, scaled, *bounds, (4, 4, 4), threshold=0.01, contracted=contracted)


def masked(x, *, contracted=False):
    return jaxnerf.mask_scene(scene, grid(contracted))(x, x)


def made_rays(pose, focal, center, pixels, near, far, *, lens="pinhole"):
    options = {"distortion": LENS[lens], "lens": lens} if lens in LENS else {}
    view = jaxnerf.Camera(to_world=pose, focal=focal, center=center, **options)
    return jaxnerf.rays_from_pixels(view, pixels, near=near, far=far)


def undistorted(focal, center, pixels, *, lens):
    view = jaxnerf.Camera(to_world=camera().to_world, focal=focal, center=center, lens=lens, distortion=LENS.get(lens))
    return jaxnerf.undistort(view, pixels)


def radius_of(focal, center, pixels, *, lens):
    view = dataclasses.replace(camera(lens), focal=focal, center=center)
    return jaxnerf.pixel_radius(view, pixels)


def projected(pose, places, *, lens):
    return jaxnerf.project(dataclasses.replace(camera(lens), to_world=pose), places)


def in_ndc(origins, directions, *, camera):
    made = jaxnerf.Rays(
        origins=origins, directions=directions, viewdirs=directions, near=origins[..., 0], far=origins[..., 0]
    )
    return jaxnerf.ndc_rays(made, camera)


def to_world_t(t):
    made = rays()
    return jaxnerf.ndc_to_t(t, made)


def normals_of(scene, x, **options):
    return jaxnerf.density_normals(scene, x, jnp.ones((2, 1, 3)) / 3**0.5, **options)


def field(make, **options):
    made = make(**options)
    params = jax.jit(made.init)(KEY)
    x = jnp.stack([jnp.zeros(3), jnp.ones(3), jnp.full(3, -0.3), jnp.full(3, 1e4)])[None]
    return (lambda params: made.apply(params, x, jnp.ones((1, 1, 3)) / 3**0.5)), (params,)


def cases():
    """Returns {name: (function, arguments)}; the first word of a name is the public function."""
    pixels, small = jaxnerf.pixel_grid(6, 6), numbers((2, 5, 3))
    image, other = numbers((12, 12, 3)), numbers((12, 12, 3), 2)
    edges = jaxnerf.uniform_edges(jnp.ones(3), jnp.full(3, 4.0), num_segments=5)
    infinite = jaxnerf.uniform_edges(jnp.ones(3), jnp.full(3, jnp.inf), num_segments=5, in_disparity=True)
    weights = numbers((3, 5)) / 5
    nothing = jnp.zeros((3, 5))
    density = numbers((3, 5)).at[0].set(0).at[1, 2].set(jnp.inf).at[1, 3].set(0)
    delta = jnp.ones((3, 5)).at[:, 1].set(0).at[:, 4].set(jnp.inf)
    t = jnp.arange(5.0)[None] + jnp.zeros((3, 1))
    found = {
        "pixel_grid": (lambda: jaxnerf.pixel_grid(3, 4), ()),
        "look_at": (jaxnerf.look_at, (jnp.array([1.0, 2.0, 3.0]), jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]))),
        "look_at along up": (jaxnerf.look_at, (jnp.array([0.0, 0.0, 3.0]), jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]))),
        "look_at itself": (jax.jit(jaxnerf.look_at), (jnp.ones(3), jnp.ones(3), jnp.array([0.0, 0.0, 1.0]))),
        "turntable": (lambda center: jaxnerf.turntable(5, center=center, radius=2.0, elevation=0.3), (jnp.zeros(3),)),
        "ndc_to_t": (to_world_t, (jnp.linspace(0, 0.9, 12),)),
        "ndc_to_t at infinity": (to_world_t, (jnp.ones(12),)),
        "ndc_rays": (functools.partial(in_ndc, camera=forward_rays()[0]), (
            forward_rays()[1].origins, forward_rays()[1].directions)),
        "se3_exponential": (jaxnerf.se3_exponential, (jnp.stack([jnp.zeros(6), jnp.full(6, 1e-20), jnp.ones(6)]),)),
        "uniform_edges": (functools.partial(jaxnerf.uniform_edges, num_segments=4), (jnp.zeros(2), jnp.ones(2))),
        "uniform_edges disparity": (
            functools.partial(jaxnerf.uniform_edges, num_segments=4, in_disparity=True),
            (jnp.ones(2), jnp.array([2.0, jnp.inf])),
        ),
        "uniform_edges empty": (functools.partial(jaxnerf.uniform_edges, num_segments=4), (jnp.ones(2), jnp.ones(2))),
        "stepped_edges": (
            lambda near, far: jaxnerf.stepped_edges(KEY, near, far, step_size=0.3, num_segments=4),
            (jnp.zeros(2), jnp.ones(2)),
        ),
        "samples_from_points": (jaxnerf.samples_from_points, (t,)),
        "samples_from_points infinite": (functools.partial(jaxnerf.samples_from_points, last_delta=jnp.inf), (t,)),
        "merge_edges": (jaxnerf.merge_edges, (infinite, t)),
        "points_on_rays": (lambda t: jaxnerf.points_on_rays(rays(), t), (jnp.ones((12, 3)),)),
        "weights_from_density": (jaxnerf.weights_from_density, (density, delta)),
        "weights_from_density gauss": (
            functools.partial(jaxnerf.weights_from_density, rule="gauss"), (density[:, :4], delta[:, 1:])),
        "transmittance": (jaxnerf.transmittance, (density, delta)),
        "composite": (
            lambda w, v, behind: jaxnerf.composite(w, v, background=behind),
            (weights, numbers((3, 5, 3)), jnp.ones(3))),
        "expected_depth": (
            lambda w, t, rest, far: jaxnerf.expected_depth(w, t, rest, far=far),
            (weights, t.at[0].set(jnp.inf), jnp.array([0.0, 1.0, 0.5]), jnp.array([jnp.inf, 2.0, jnp.inf])),
        ),
        "expected_disparity": (jaxnerf.expected_disparity, (weights.at[0].set(0), t)),
        "expected_disparity empty": (jaxnerf.expected_disparity, (nothing, nothing)),
        "expected_disparity at infinity": (jaxnerf.expected_disparity, (weights, t.at[:, 4].set(jnp.inf))),
        "median_depth": (
            lambda *of: jaxnerf.median_depth(*of[:4], far=of[4]), (density, delta, t, delta, jnp.full(3, jnp.inf))),
        "median_depth points": (
            lambda *of: jaxnerf.median_depth(*of[:4], far=of[4], rule="points"),
            (density, delta, t, delta, jnp.full(3, jnp.inf))),
        "positional_encoding": (functools.partial(jaxnerf.positional_encoding, num_freqs=4), (small,)),
        "integrated_directional_encoding": (
            jaxnerf.integrated_directional_encoding, (small, jnp.zeros((2, 5)).at[0].set(jnp.inf))),
        "density_normals": (functools.partial(normals_of, scene), (small,)),
        "density_normals differences": (functools.partial(normals_of, solid_scene, spacing=0.1), (small,)),
        "density_normals empty": (functools.partial(normals_of, empty_scene, spacing=0.1), (small,)),
        "positional_encoding at 0": (functools.partial(jaxnerf.positional_encoding, num_freqs=20), (small * 0,)),
        "integrated_encoding": (functools.partial(jaxnerf.integrated_encoding, num_freqs=4), (small, small**2)),
        "integrated_encoding over all": (
            functools.partial(jaxnerf.integrated_encoding, num_freqs=20), (small, jnp.full(small.shape, jnp.inf))),
        "frustum_variance": (jaxnerf.frustum_variance, (small, jnp.zeros((2, 5)), jnp.full((2, 5), jnp.inf))),
        "mse": (jaxnerf.mse, (image, other)),
        "mse masked": (lambda a, b: jaxnerf.mse(a, b, mask=image[..., 0] > 0.5), (image, other)),
        "psnr": (jaxnerf.psnr, (image, other)),
        "psnr identical": (jaxnerf.psnr, (image, image)),
        "psnr masked": (lambda a, b: jaxnerf.psnr(a, b, mask=image[..., 0] > 0.5), (image, other)),
        "ssim": (jaxnerf.ssim, (image, other)),
        "ssim constant": (jaxnerf.ssim, (image * 0, image * 0)),
        "round_to_8_bits": (jaxnerf.round_to_8_bits, (image,)),
        "still_life": (jaxnerf.still_life, (small, small)),
        "still_life far": (jaxnerf.still_life, (1e4 * small, small)),
        "mlp_field": field(jaxnerf.mlp_field, depth=2, width=16),
        "hash_grid_field": field(
            jaxnerf.hash_grid_field, lower=(-1, -1, -1), upper=(1, 1, 1), table_size=1024, resolutions=(4, 16)),
        "create_grid": (lambda density: jaxnerf.create_grid(
            jnp.zeros(3), jnp.ones(3), jnp.ones((2, 2, 2), bool), initial_density=density), (numbers((2, 2, 2)),)),
        "render_image": of_rays(render_in_chunks, "soft", rays()),
    }  # fmt: skip
    for lens in ("pinhole", *LENS):
        view = camera(lens)
        arguments = (view.to_world, view.focal, view.center, pixels, jnp.zeros(()), jnp.full((), jnp.inf))
        found[f"rays_from_pixels {lens}"] = functools.partial(made_rays, lens=lens), arguments
        wide = pixels.at[0, 0].set(1e3)
        found[f"rays_from_pixels {lens} outside"] = (
            functools.partial(made_rays, lens=lens),
            (*arguments[:3], wide, *arguments[4:]),
        )  # noqa: E501
        at = pixels.at[0, 0].set(view.center)
        found[f"pixel_radius {lens}"] = functools.partial(radius_of, lens=lens), (view.focal, view.center, wide)
        # In front, at the position of the camera, behind it, and far beside its axis.
        places = jnp.array([[0.0, 0.0, 0.0], [0.1, -4.0, 0.2], [0.0, -9.0, 0.0], [1e4, -3.9, 0.0]])
        found[f"project {lens}"] = functools.partial(projected, lens=lens), (view.to_world, places)
        found[f"undistort {lens}"] = functools.partial(undistorted, lens=lens), (view.focal, view.center, at)
    for rule in ("segments", "gauss"):
        for name, key in (("", None), (" drawn", KEY)):
            for kind, ends in (("", edges), (" infinite", infinite), (" empty", 0 * edges + 1)):
                function = functools.partial(jaxnerf.samples_from_edges, key, rule=rule)
                found[f"samples_from_edges {rule}{name}{kind}"] = function, (ends,)
    twice = jnp.array([[1.0, 3.0, jnp.inf, jnp.inf]])
    found["samples_from_edges twice infinite"] = functools.partial(jaxnerf.samples_from_edges, None), (twice,)
    found["samples_from_edges drawn twice infinite"] = functools.partial(jaxnerf.samples_from_edges, KEY), (twice,)
    for name, key in (("", None), (" drawn", KEY)):
        for kind, ends in (("", edges), (" infinite", infinite), (" empty", 0 * edges + 1)):
            for what, values in (("", weights), (" dark", nothing), (" sparse", weights.at[:, 1:3].set(0))):
                points = lambda e, w, key=key: jaxnerf.importance_points(key, e, w, num_points=4)  # noqa: E731
                found[f"importance_points{name}{kind}{what}"] = points, (ends, values)
                u = jnp.array([[0.0, 0.3, 1.0]]) + jnp.zeros((3, 1))
                found[f"inverse_cdf{name}{kind}{what}"] = jaxnerf.inverse_cdf, (ends, values, u)
    white = jnp.ones(3)
    for kind in SCENES:
        for rule in ("segments", "gauss", "points"):
            for extra in ({}, {"skipped": True}, *([{"far": jnp.inf}] if rule != "points" else [])):
                options = {"samples": plain_samples(rule, **extra), "background": white, "median_depth": True}
                far = extra.get("far", 6.0)
                name = f"render_samples {kind} {rule} {' '.join(map(str, extra))}"
                found[name] = render(functools.partial(at_samples, rays=rays(far=far)), kind, **options)
                found[f"{name} by rays"] = of_rays(at_samples, kind, rays(far=far), **options)
                if rule == "gauss":
                    continue
                more = {"max_samples": 200, **options}
                for where, box in (("", None), (" grid", grid())):
                    name = f"render_packed {kind} {rule} {' '.join(map(str, extra))}{where}"
                    use = functools.partial(packed, rays=rays(far=far), grid=box)
                    found[name] = render(use, kind, **more)
                    found[f"{name} by rays"] = of_rays(functools.partial(packed, grid=box), kind, rays(far=far), **more)
                    found[f"{name} early (forward)"] = render(use, kind, **more, early_stop_eps=0.01)
            found[f"render_rays {kind} {rule}"] = of_rays(evenly, kind, rays(), rule=rule, median_depth=True)
            found[f"render_hierarchical {kind} {rule}"] = of_rays(hierarchical, kind, rays(), rule=rule)
        options = {"in_disparity": True, "median_depth": True}
        found[f"render_rays {kind} disparity"] = of_rays(evenly, kind, rays(far=jnp.inf), **options)
        found[f"render_hierarchical {kind} disparity"] = of_rays(hierarchical, kind, rays(far=jnp.inf), **options)
        found[f"render_rays {kind} empty rays"] = of_rays(evenly, kind, rays(near=1.0, far=1.0))
        found[f"render_rays {kind} from 0"] = of_rays(evenly, kind, rays(near=0.0), median_depth=True)
    found["render_packed few slots"] = of_rays(packed, "soft", rays(), samples=plain_samples(), max_samples=8)
    for contracted in (False, True):
        word = " contracted" * contracted
        options = {"contracted": contracted}
        found[f"update_grid{word} (forward)"] = functools.partial(updated, **options), (jnp.float32(1.0),)
        found[f"update_grid{word} solid (forward)"] = (
            functools.partial(updated, density=1e30, **options), (jnp.float32(1.0),))  # fmt: skip
        found[f"grid_from_scene{word} (forward)"] = functools.partial(from_scene, **options), (jnp.float32(1.0),)
        found[f"mask_scene{word}"] = functools.partial(masked, **options), (2 * small,)
    t = jnp.sort(5 * numbers((12, 4)), axis=-1)
    arrays = (numbers((12, 4), 3) / 4, t, jnp.full((12, 4), 0.4).at[:, 1].set(0))
    flat = (numbers(24) / 2, 5 * jnp.sort(numbers((12, 2)), axis=-1).reshape(-1), jnp.full(24, 0.4))
    bounds = {"": (0.5, 6.0), " infinite": (0.5, jnp.inf), " from 0": (0.0, jnp.inf), " empty": (1.0, 1.0)}
    for name, (near, far) in bounds.items():
        ends = jnp.full(12, near), jnp.full(12, far)
        for rule in ("segments", "points"):
            found[f"distortion_loss {rule}{name}"] = functools.partial(distortion, rule=rule), (*arrays, *ends)
        found[f"distortion_loss packed{name}"] = packed_distortion, (*flat, *ends)
        if far == jnp.inf:
            last = (arrays[0], arrays[1], arrays[2].at[:, 3].set(jnp.inf))
            found[f"distortion_loss open{name}"] = distortion, (*last, *ends)
    return found


READS_FILES = {"load_dataset", "draw_batch", "load_scene", "restore_run", "train_and_evaluate", "train_many"}
MINIMIZES = {"estimate_pose"}  # an argument of the smallest value, which has no gradient of use


@pytest.fixture(scope="module", name="found")
def all_cases():
    """Returns the cases, which take seconds to make and so are not made where tests are only collected."""
    return cases()


def test_every_public_function_has_a_case(found):
    functions = {name for name in jaxnerf.__all__ if name[0].islower() and not name.startswith("register_")}
    assert {name.split()[0] for name in found} == functions - READS_FILES - MINIMIZES


def total(function, arguments):
    """Computes the sum of all finite values of a result, and so keeps infinite ones out of the gradient."""
    leaves = [leaf for leaf in jax.tree.leaves(function(*arguments)) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return sum(jnp.where(jnp.isfinite(leaf), leaf, 0).sum() for leaf in leaves)


# `make test` has these of the cases that draw nothing, which are short: what divides by lengths, weights and densities
# that may be 0. `make test-extra` has all.
SHORT = (
    "weights_",
    "transmittance",
    "composite",
    "expected_",
    "median_",
    "samples_",
    "merge_",
    "importance_",
    "inverse_",
)


def with_gradient(name, function, arguments):
    """Returns the function of a case, or its gradient where it has one, and the arguments."""
    if not arguments or name.endswith("(forward)"):
        return function, arguments
    return jax.grad(lambda arguments: total(function, arguments)), (arguments,)


def raised(functions, arguments):
    """Returns what a function raises under jax_debug_nans, or None."""
    try:
        with jax.debug_nans(True):
            for function in functions:
                function(*arguments)
    except FloatingPointError as error:
        return error
    return None


def test_no_branch_makes_a_nan(found):
    errors = {}
    for name in found:
        if name.startswith(SHORT) and "drawn" not in name:
            function, arguments = with_gradient(name, *found[name])
            errors[name] = raised([function], arguments)
    assert len(errors) > 20 and {name: error for name, error in errors.items() if error} == {}


@pytest.mark.extra
def test_no_branch_makes_a_nan_compiled_or_not(found):
    errors = {}
    for name, case in found.items():
        for function, arguments in (case, with_gradient(name, *case)):
            errors[name] = errors.get(name) or raised([function, jax.jit(function)], arguments)
    assert {name: error for name, error in errors.items() if error} == {}


def test_a_nan_in_a_branch_that_is_not_selected_is_noticed():
    """The tests above can fail."""
    assert raised([lambda x: jnp.where(x > 0, 0.0, jnp.log(x))], (jnp.float32(-1.0),)) is not None
    assert raised([jnp.abs], (jnp.float32(-1.0),)) is None
