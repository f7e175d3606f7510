"""Fields that are "auto" are inferred from cameras, alpha and images; explicit values never change."""

import dataclasses
import itertools
import json
import sys

import jax
import numpy as np
import pytest
from absl import flags
from ml_collections import config_flags

import captures
from helpers import compiled
from jaxnerf import Camera, SparsePoints, Views
from jaxnerf.configs import default, lego_fast, lego_mlp_fast
from jaxnerf.data import synthetic
from jaxnerf.data.facts import footprint_radii, footprint_spread, mean_color
from jaxnerf.data.geometry import visual_hull
from jaxnerf.data.image_agreement import Agreement
from jaxnerf.data.ray_batches import view_rays
from jaxnerf.data.scene import SceneOptions
from jaxnerf.options import AUTO
from jaxnerf.registry import FIELDS, Part
from jaxnerf.tools.embedded_scene import still_life
from jaxnerf.training import camera_parameters, workdir
from jaxnerf.training.auto_config import device_fields, fill_from, resolve, resolve_for_device
from jaxnerf.training.build import build
from jaxnerf.training.compiled_step import steps_per_dispatch
from jaxnerf.training.config import RunConfig, auto_fields, changed, flatten, read_config
from jaxnerf.training.options import UNLIMITED_STEPS
from test_configs import fields

PIXEL = 4 / (1.36 * 24)  # the size of a pixel of the embedded scene at its centre, world units
# Every field of default.py that may be "auto", with the value that a flag or Python code sets it to.
AUTO_FIELDS = {
    "data.factor": 4,
    "data.ndc": True,
    "coarse.num_freqs": 7,
    "fine.num_freqs": 7,
    "coarse.prefilter": True,
    "fine.prefilter": True,
    "hash_grid.resolutions": (8, 16),
    "hash_grid.table_size": 2**12,
    "hash_grid.width": 32,
    "hash_grid.view_width": 32,
    "hash_grid.view_depth": 1,
    "hash_grid.prefilter": True,
    "occupancy.pool_samples_per_ray": 6.0,
    "scene.contracted": True,
    "scene.lower": (-1.0, -2.0, -3.0),
    "scene.upper": (1.0, 2.0, 3.5),
    "occupancy.step_size": 0.25,
    "occupancy.resolution": 32,
    "occupancy.min_views": 2,
    "data.near": 0.5,
    "scene.background": (0.5, 0.4, 0.3),
    "cameras.num_images": 60,
    "cameras.refine": True,
    "cameras.exposure": True,
    "train.batch_size": 512,
    "train.rays_per_side": 2,
    "train.microbatch_size": 128,
    "train.max_steps": 300,
    "train.lr_steps": 300,
    "eval.sample_multiplier": 3,
    "eval.chunk": 512,
    "eval.max_samples": 2048,
    "moving.motion_depth": 1,
}
AUTO_FIELDS |= {
    name.replace("hash_grid", "moving"): value for name, value in AUTO_FIELDS.items() if "hash_grid" in name
}


def auto_config(field="hash_grid", **options):
    """Returns the default config with the occupancy sampler, whose sizes are "auto", and options of it or the scene."""
    config = default.get_config()
    config.data.size, config.field, config.sampler = 24, field, "occupancy"
    for name, value in options.items():
        config["scene" if name in config.scene else "occupancy"][name] = value
    if field == "mlp":
        config.fine.num_freqs = AUTO
    return config


DEVICE_FIELDS = device_fields(RunConfig())


def as_json(config):
    return json.loads(read_config(config).to_json())


def unresolved(config):
    """Returns the "auto" fields that training never leaves."""
    return set(auto_fields(config)) - set(DEVICE_FIELDS)


def test_table_lists_every_auto_field():
    """They are declared with auto(type). Fields of text hold "auto" as any other text."""
    config = default.get_config()
    names = [name.split(".") for name in fields(read_config(config)) if "." in name]
    found = {f"{section}.{field}" for section, field in names if is_declared_auto(config[section], field)}
    assert found == set(AUTO_FIELDS)


def is_declared_auto(section, field):
    return section.get_type(field).__name__.startswith("auto_")


@pytest.mark.parametrize("name", AUTO_FIELDS)
def test_auto_field_is_set_by_python_and_set_back(name):
    config, (section, field) = default.get_config(), name.split(".")
    for value in (AUTO, AUTO_FIELDS[name], AUTO):
        config[section][field] = value
        assert config[section][field] == value
    with pytest.raises(TypeError):
        config[section][field] = "many"


@pytest.mark.parametrize("name", AUTO_FIELDS)
def test_auto_field_is_set_by_a_flag_and_set_back(name, monkeypatch, tmp_path):
    section, field = name.split(".")
    file = tmp_path / "config.py"
    for before in (AUTO, AUTO_FIELDS[name]):
        file.write_text(
            "from jaxnerf.configs import default\n\n\ndef get_config():\n    config = default.get_config()\n"
            f"    config.{name} = {before!r}\n    return config\n"
        )
        for value in (AUTO, AUTO_FIELDS[name]):
            config = parsed(monkeypatch, f"--config={file}", f"--config.{name}={value}")
            assert config[section][field] == value and type(config[section][field]) is type(value)


def parsed(monkeypatch, *arguments):
    """Returns the config that a command line gives."""
    monkeypatch.setattr(sys, "argv", ["program", *arguments])  # DEFINE_config_file reads it
    values = flags.FlagValues()
    config = config_flags.DEFINE_config_file("config", flag_values=values)
    values(sys.argv)
    return config.value


def test_flag_of_a_wrong_type_is_an_error(monkeypatch):
    path = sys.modules[default.__name__].__file__
    with pytest.raises(flags.IllegalFlagValueError, match="expected auto, or int"):
        parsed(monkeypatch, f"--config={path}", "--config.train.microbatch_size=many")


@pytest.fixture(scope="module", autouse=True)
def one_hull():
    """The bounds of the visual hull, most of the time of `resolve`, are found once for the same Views."""
    find, found = visual_hull.hull_bounds, {}

    def remembered(views, *box):
        key = id(views), *(float(each) for corner in box for each in corner)
        if key not in found:
            found[key] = find(views, *box), views  # as long as this keeps the Views, no others have their id
        return found[key][0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(visual_hull, "hull_bounds", remembered)
        yield


@pytest.fixture(scope="module")
def views():
    return synthetic.load_synthetic(size=24)


@pytest.fixture(scope="module")
def resolved(views):
    return resolve(auto_config(), views)


def test_every_auto_field_is_inferred_and_logged(resolved):
    config, _, lines = resolved
    occupancy, scene = config.occupancy, config.scene
    longest = max(np.subtract(scene.upper, scene.lower))
    assert len(scene.lower) == len(scene.upper) == 3 and 2.3 < longest < 3.5
    assert 0.3 * PIXEL < occupancy.step_size < PIXEL
    assert 0.3 * PIXEL < longest / occupancy.resolution < PIXEL
    sizes = config.hash_grid.resolutions
    assert list(sizes) == sorted(set(sizes)) and 0.3 * PIXEL < longest / sizes[-1] < PIXEL
    assert not unresolved(config)
    build(resolve_for_device(config)[0])
    for word in ("contraction", "box", "step size", "grid", "hash grid"):
        assert any(line.startswith(f"{word} ") for line in lines), word
    assert f"a pixel covers {PIXEL:.4g}" in "".join(lines)


def test_opacity_is_compared_with_alpha_where_images_have_times_and_alpha(views):
    config = changed(read_config(auto_config()), {"losses.opacity": AUTO})
    times = np.linspace(0, 1, len(views.names), dtype=np.float32)
    for channels, time, weight in ((4, times, 0.1), (3, times, 0.0), (4, None, 0.0)):
        pixels = np.ascontiguousarray(views.pixels[:, :channels])
        background = views.background if channels == 4 else None
        seen = dataclasses.replace(views, pixels=pixels, background=background, time=time)
        assert resolve(config, seen).config.losses["opacity"] == weight


@pytest.mark.parametrize("contracted, weight", [(False, 0.01), (True, 0.001)])
def test_distortion_weighs_less_where_nothing_bounds_the_scene(views, contracted, weight):
    config = changed(read_config(auto_config(contracted=contracted)), {"losses.distortion": AUTO})
    assert resolve(config, views).config.losses["distortion"] == weight


def test_config_of_the_paper_is_resolved_and_logs_nothing_about_a_box(views):
    """Baking a grid needs a box later, though the paper's sampler has none."""
    config = default.get_config()
    config.data.size = 24
    got, _, lines = resolve(config, views)
    assert not unresolved(got) and lines == []
    config.eval.bake_occupancy = True
    baked, _, lines = resolve(config, views)
    assert baked.occupancy == got.occupancy and any(line.startswith("box ") for line in lines)


@pytest.mark.extra
def test_rays_that_hit_nothing_have_the_mean_color_of_an_unbounded_capture(views):
    """Black behind a bright scene would be replaced by fog in front of the cameras."""
    given, rgb = auto_config(), np.random.default_rng(0).integers(0, 256, (*views.pixels.shape[:1], 3), np.uint8)
    given.data.background, given.scene.contracted, rgb[..., 0] = "none", True, 51
    masked = np.arange(len(rgb)) % 2 == 0
    rgb[~masked] = 255
    shown = dataclasses.replace(views, pixels=rgb, mask=masked)
    for value, expected in ((AUTO, rgb[masked].mean(axis=0) / 255), ((0.1, 0.2, 0.3), (0.1, 0.2, 0.3))):
        given.scene.background = value
        resolved = resolve(given, shown)
        np.testing.assert_allclose(resolved.config.scene.background, expected, atol=5e-4)
        assert ("mean colour" in "".join(resolved.lines)) == (value == AUTO)
        experiment = build(resolve_for_device(resolved.config)[0])
        rays = view_rays(shown, 0, np.float32([[1.5, 1.5]]))
        model, params = experiment.model, jax.jit(experiment.model.init)(jax.random.key(0))
        empty = model.grid_schedule.create(np.zeros(model.grid_schedule.shape, bool))
        training = model.render(jax.random.split(jax.random.key(1), 1), params, empty, rays, 0)["fine"]
        for image in (model.view(params, empty, rays), training, model.cull(empty, rays)[1]):
            np.testing.assert_allclose(image.rgb[0], experiment.background, atol=1e-6)
        np.testing.assert_allclose(experiment.background, expected, atol=5e-4)


@pytest.mark.parametrize(
    "background, contracted, sampler",
    [("none", False, "occupancy"), ("none", True, "hierarchical"), ("white", True, "occupancy")],
)
def test_otherwise_black_or_the_color_behind_alpha_is_behind_the_scene(views, background, contracted, sampler):
    given = auto_config(contracted=contracted)
    given.data.background, given.sampler = background, sampler
    config = resolve(given, dataclasses.replace(views, pixels=views.pixels[:, :3])).config
    expected = None if background == "none" else (1.0, 1.0, 1.0)
    assert config.scene.background == () and config.scene.color_behind(background) == expected
    given.scene.background = (0.1, 0.2, 0.3)
    if background == "none":
        assert resolve(given, views).config.scene.color_behind(background) == (0.1, 0.2, 0.3)
    else:
        with pytest.raises(ValueError, match="set data.background to 'none', or scene.background to"):
            resolve(given, views)


def test_one_color_around_an_object_bounds_its_scene(views):
    """As in images whose alpha was composited before they were written, with a sensor's noise."""
    color, given = np.float32([0.2, 0.4, 0.6]), auto_config()
    given.data.background, given.data.world = "none", "around"
    rgb, alpha = np.split(views.pixels / np.iinfo(views.pixels.dtype).max, [3], axis=-1)
    shown = alpha * rgb + (1 - alpha) * color + np.random.default_rng(0).normal(0, 0.02, rgb.shape)

    def resolved(pixels, **changes):
        pixels = np.uint8(np.rint(255 * np.clip(pixels, 0, 1)))
        return resolve(given, dataclasses.replace(views, pixels=pixels, **changes)).config.scene

    scene = resolved(shown)
    assert not scene.contracted
    np.testing.assert_allclose(scene.background, color, atol=0.01)
    circle = np.hypot(*(np.mgrid[:24, :24] - 11.5)) < 11
    lens = np.where(np.tile(circle.reshape(-1, 1), (len(views.size), 1)), shown * 0.5 + 0.5, 0)
    assert resolved(lens).contracted, "black at the same pixels of all images is the lens"
    assert resolved(shown, mask=np.ones(len(shown), bool)).contracted, "what a mask includes says nothing"
    assert resolved(np.full_like(shown, 0.5)).contracted, "nothing is in images of one colour"


def test_the_mean_color_of_many_pixels_is_that_of_all_that_the_mask_includes(views):
    """Even columns are dark and odd ones are bright, so that every second pixel would have the wrong mean."""
    bright = np.arange(2**21) % 2
    pixels = np.uint16(np.stack([65535 * bright, 65535 * (1 - bright), np.full_like(bright, 13107)], axis=-1))
    many = dataclasses.replace(views, pixels=pixels, mask=None)
    np.testing.assert_allclose(mean_color(many), [0.5, 0.5, 0.2], atol=1e-3)
    np.testing.assert_allclose(mean_color(dataclasses.replace(many, mask=bright == 1)), [1, 0, 0.2], atol=1e-6)
    nothing = dataclasses.replace(many, mask=np.zeros(len(bright), bool))
    assert mean_color(nothing) == mean_color(many)


def test_an_unresolved_background_color_is_an_error():
    with pytest.raises(ValueError, match="scene.background is 'auto'; resolve the config"):
        SceneOptions().color_behind("none")


@pytest.mark.parametrize("color", [(0.5, 0.5), (0.5, 1.5, 0.5), (0.5, "red", 0.5)])
def test_a_background_color_is_red_green_and_blue(views, color):
    config = auto_config()
    config.scene.background = color
    with pytest.raises(ValueError, match="scene.background is .*expected red, green and blue"):
        resolve(config, views)


def test_explicit_values_do_not_change(views):
    given = auto_config()
    before = as_json(given)
    config = resolve(given, views).config
    assert as_json(given) == before and unresolved(given)
    changed = {name for name, value in fields(config).items() if value != fields(given)[name]}
    expected = {f"occupancy.{name}" for name in ("step_size", "resolution", "min_views")}
    expected |= {f"scene.{name}" for name in ("contracted", "lower", "upper")}
    expected |= {"data.world", "hash_grid.resolutions"}
    expected |= {"data.near", "scene.background", "cameras.num_images", "losses.depth", "hash_grid.prefilter"}
    expected |= {f"moving.{name}" for name in ("resolutions", "prefilter", "motion_depth")}
    assert changed == expected


EXPLICIT = [
    {"lower": (-1.0, -1.1, -1.2), "upper": (1.3, 1.4, 1.5)},
    {"step_size": 0.123},
    {"resolution": 7},
    {"contracted": True},
    {"lower": (-2.0,) * 3, "upper": (2.0,) * 3, "step_size": 0.2, "resolution": 9},
    {"lower": (-1.0, -1.1, -1.2)},
]


@pytest.mark.parametrize("given", EXPLICIT, ids=lambda given: " ".join(given))
def test_explicit_sizes_do_not_change(views, given):
    config = auto_config(**given)
    config.hash_grid.resolutions = (5, 6)
    got, _, lines = resolve(config, views)
    assert {name: getattr(got.scene, name, getattr(got.occupancy, name, None)) for name in given} == given
    assert got.hash_grid.resolutions == (5, 6)
    assert not unresolved(got) and not any(line.startswith("hash grid") for line in lines)


def test_resolving_again_changes_nothing(resolved, views):
    config = resolved.config
    assert as_json(resolve(auto_config(), views).config) == as_json(config)
    assert as_json(resolve(config, views).config) == as_json(config)


def test_fill_from_a_resolved_config(resolved):
    given = auto_config()
    assert as_json(fill_from(given, resolved.config)) == as_json(resolved.config)
    given.occupancy.step_size = 0.5
    assert fill_from(given, resolved.config).occupancy.step_size == 0.5


def test_fields_that_nothing_infers_are_an_error(views, monkeypatch):
    config = auto_config()
    config.field, config.mine = "mine", {"size": AUTO}
    monkeypatch.setattr(FIELDS, "_parts", {**FIELDS._parts, "mine": Part(lambda options, box: None)})
    with pytest.raises(ValueError, match="mine.size is 'auto', which is not inferred"):
        resolve(config, views)


@pytest.mark.parametrize("backend, chunk, steps", [("cpu", 2**13, 1), ("gpu", 2**16, 10), ("tpu", 2**16, 10)])
def test_device_fields_are_resolved_at_every_start(resolved, monkeypatch, tmp_path, backend, chunk, steps):
    """They stay "auto" in config.json, so the same workdir continues on another device."""
    given = resolved.config
    assert set(auto_fields(given)) == set(DEVICE_FIELDS)
    workdir.save_config(tmp_path, given)
    read = workdir.load_config(tmp_path)
    assert set(auto_fields(read)) == set(DEVICE_FIELDS)
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    config, lines = resolve_for_device(read)
    used = [name for name in DEVICE_FIELDS if not name.startswith("moving.")]
    assert not auto_fields(config) and len(lines) == len(used)
    assert config.eval.chunk == chunk
    # 10 divides the numbers of steps between which rows are logged, checkpoints saved and dead networks sought.
    assert steps_per_dispatch(config.train, backend) == steps
    assert config.hash_grid.compute_dtype == ("float32" if backend == "cpu" else "bfloat16")
    assert config.train.batch_size % config.train.microbatch_size == 0
    explicit = {"eval.chunk": 5, "eval.max_samples": 6, "train.microbatch_size": 64}
    explicit |= {"hash_grid.compute_dtype": "float32"}
    config, lines = resolve_for_device(changed(read, explicit))
    assert {name: flatten(config.to_dict())[name] for name in explicit} == explicit and not lines


@pytest.mark.parametrize(
    "sampler, platform, rays",
    [("occupancy", "cpu", 300), ("occupancy", "gpu", 2**15), ("occupancy", "tpu", 2**15), ("hierarchical", "gpu", 300)],
)
def test_rays_per_step_depend_on_the_device(views, sampler, platform, rays):
    config = auto_config()
    config.sampler, config.train.cpu_batch_size, config.occupancy.pool_samples_per_ray = sampler, 300, 7
    config.train.batch_size = AUTO
    found, _, lines = resolve(config, views, platform=platform)
    assert found.train.batch_size == rays and any(line.startswith(f"batch         {rays:,} rays") for line in lines)
    assert resolve(found, views, platform="tpu").config.train.batch_size == rays  # a workdir's stays on other devices
    config.train.batch_size = 100
    assert resolve(config, views, platform=platform).config.train.batch_size == 100


@pytest.mark.parametrize(
    "platform, rays, expected",
    [("cpu", AUTO, 5.0), ("gpu", AUTO, 8.0), ("gpu", 2**16, 5.0), ("gpu", 2**10, 10.0)],  # a buffer of 2^18 samples
)
def test_an_accelerator_gets_as_many_samples_as_keep_it_busy(views, platform, rays, expected):
    config = auto_config()
    config.sampler, config.occupancy.cpu_pool_samples_per_ray = "occupancy", 5.0
    config.occupancy.pool_samples_per_ray, config.train.batch_size = AUTO, rays
    found, _, lines = resolve(config, views, platform=platform)
    assert found.occupancy.pool_samples_per_ray == expected
    assert any(line == f"batch         at most {expected:g} samples per ray on average" for line in lines)
    config.occupancy.pool_samples_per_ray = 7.0
    assert resolve(config, views, platform=platform).config.occupancy.pool_samples_per_ray == 7.0


def test_an_accelerator_gets_a_larger_hash_grid(views):
    config = auto_config()
    config.field = "hash_grid"
    section = config.hash_grid
    section.width = section.view_width = section.table_size = AUTO
    on_cpu, on_gpu = (resolve(config, views, platform=platform).config.hash_grid for platform in ("cpu", "gpu"))
    assert (on_cpu.width, on_cpu.view_width) == (64, 64) and (on_gpu.width, on_gpu.view_width) == (128, 128)
    assert on_gpu.table_size == 4 * on_cpu.table_size


def of_cameras(to_world, near=2.0, far=6.0):
    """Returns Views of 20 x 30 pixels with these cameras [V, 3, 4]."""
    count = len(to_world)
    return Views(
        pixels=np.zeros((count * 600, 3), np.uint8),
        offset=np.arange(count, dtype=np.int32) * 600,
        size=np.int32([[20, 30]] * count),
        cameras=Camera(
            to_world=np.float32(to_world),
            focal=np.full((count, 2), 25, np.float32),
            center=np.float32([[15, 10]] * count),
            height=20,
            width=30,
        ),
        near=np.full(count, near, np.float32),
        far=np.full(count, far, np.float32),
    )


def turned(angle):
    """Returns a camera at the origin that is turned around y."""
    sine, cosine = np.sin(angle), np.cos(angle)
    return [[cosine, 0, sine, 0], [0, 1, 0, 0], [-sine, 0, cosine, 0]]


IDENTITY = np.eye(3, 4)
ODD_CAMERAS = {
    "one view": [IDENTITY],
    "one view elsewhere": [IDENTITY + np.array([[0, 0, 0, 5], [0, 0, 0, -3], [0, 0, 0, 7]])],
    "parallel": [IDENTITY, IDENTITY + np.array([[0, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]])],
    "parallel and the same": [IDENTITY] * 3,
    "panorama": [turned(angle) for angle in (0.0, 1.0, 2.0, 4.0)],
    "opposite": [IDENTITY, turned(np.pi)],
}


@pytest.mark.parametrize("name", ODD_CAMERAS)
@pytest.mark.parametrize("sampler, field", [("hierarchical", "mlp"), ("occupancy", "hash_grid")])
def test_odd_cameras_are_resolved(name, sampler, field):
    """Where no point in front of the cameras is nearest to their axes, the depth range stands in."""
    config = auto_config(field)
    config.sampler = sampler
    got = resolve(config, of_cameras(ODD_CAMERAS[name])).config
    assert not unresolved(got)
    box = np.subtract(got.scene.upper, got.scene.lower)
    assert (0.5 < box).all() and (box < 20).all() and 1e-3 < got.occupancy.step_size < 1


@pytest.mark.parametrize(("outwards", "points"), [(False, True), (True, False), (True, True)])
def test_a_walk_is_recognised_and_points_are_missed(outwards, points):
    poses = np.array([turned(angle) for angle in np.linspace(0, 5, 8)])
    poses[:, :, 3] = (2 - 4 * outwards) * poses[:, :, 2]
    views, given = of_cameras(poses), auto_config(contracted=True)
    if points:
        index, count = np.arange(16, dtype=np.int32), 16
        positions, pixel = np.zeros((8, 3), np.float32), np.zeros((count, 2), np.float32)
        found = SparsePoints(positions=positions, view=index // 2, point=(index + index // 2) % 8, pixel=pixel)
        views = dataclasses.replace(views, sparse=found)
    resolved = resolve(given, views)
    lines = [line for line in resolved.lines if line.startswith("walk")]
    assert len(lines) == outwards and ("jaxnerf-cameras" in "".join(lines)) == (outwards and not points)


@pytest.mark.parametrize("near, far", [(2.0, np.inf), (0.0, np.inf), (0.01, 1e6)])
@pytest.mark.parametrize("name", ODD_CAMERAS)
def test_a_far_away_end_of_rays_is_resolved(name, near, far):
    got = resolve(auto_config("mlp"), of_cameras(ODD_CAMERAS[name], near, far)).config
    assert np.isfinite([*got.scene.lower, *got.scene.upper, got.occupancy.step_size]).all()


def test_octaves_are_inferred(views):
    config = resolve(auto_config("mlp"), views).config
    wave = 2 * np.pi / 2 ** (config.fine.num_freqs - 1)
    assert 2 * PIXEL < wave < 8 * PIXEL
    assert not unresolved(config)
    build(resolve_for_device(config)[0])


def test_larger_images_are_trained_on_longer(views):
    """16 times the pixels per side take 4 times the steps; lr_steps follows max_steps."""
    config = auto_config(lower=(-1.0,) * 3, upper=(1.0,) * 3)
    config.train.max_steps = config.train.lr_steps = AUTO
    config.train.cpu_batch_size = config.train.batch_size
    assert {"train.max_steps", "train.lr_steps"} <= unresolved(config)
    got, _, lines = resolve(config, views)
    large = resolve(config, dataclasses.replace(views, size=16 * views.size)).config
    assert large.train.max_steps == pytest.approx(4 * got.train.max_steps, abs=4)
    assert got.train.max_steps == got.train.lr_steps == round(1000 * 24**0.5) and not unresolved(got)
    assert any(line.startswith("training") and "4,899" in line for line in lines)
    assert as_json(fill_from(config, got)) == as_json(got)
    config.train.max_steps = 7
    got, _, lines = resolve(config, views)
    assert (got.train.max_steps, got.train.lr_steps) == (7, 7)
    assert not any(line.startswith("training") and "rays, for images" in line for line in lines)


@pytest.mark.parametrize("platform, auto_rays", [("cpu", 300), ("gpu", 2**14)])
def test_fewer_rays_per_step_take_more_steps(views, platform, auto_rays):
    config = auto_config(lower=(-1.0,) * 3, upper=(1.0,) * 3)
    train = config.train
    train.batch_size = train.max_steps = train.lr_steps = AUTO
    train.cpu_batch_size = 300
    inferred = resolve(config, views, platform=platform).config.train
    assert (inferred.batch_size, inferred.max_steps) == (auto_rays, 4899)
    train.batch_size = auto_rays // 4
    fewer = resolve(config, views, platform=platform).config.train
    assert fewer.max_steps * fewer.batch_size == pytest.approx(4899 * auto_rays, rel=1e-3)
    assert fewer.lr_steps == fewer.max_steps


def test_a_run_of_limited_time_takes_all_the_steps_that_it_can(views):
    config = auto_config(lower=(-1.0,) * 3, upper=(1.0,) * 3)
    config.train.max_steps, config.train.lr_steps, config.train.max_seconds = AUTO, AUTO, 60.0
    got, _, lines = resolve(config, views)
    assert got.train.max_steps == got.train.lr_steps == UNLIMITED_STEPS
    assert "training      ends after train.max_seconds = 60" in lines
    assert "training      learning rate decays until the end" in lines


def test_the_learning_rate_of_several_processes_depends_on_steps_in_a_run_of_limited_time(views, monkeypatch):
    config = auto_config(lower=(-1.0,) * 3, upper=(1.0,) * 3)
    config.train.max_steps, config.train.lr_steps, config.train.max_seconds = AUTO, AUTO, 60.0
    config.train.cpu_batch_size = config.train.batch_size
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    got, _, lines = resolve(config, views)
    assert (got.train.max_steps, got.train.lr_steps) == (UNLIMITED_STEPS, 4899)
    assert "training      learning rate decays until step 4,899" in lines


@pytest.mark.parametrize("factor, rows, rays", [(1, 2**17, 300), (8, 2**18, 300), (16, 2**19, 600), (99, 2**20, 600)])
def test_the_hash_grids_table_follows_the_images_and_a_large_one_gets_more_rays(views, factor, rows, rays):
    larger = dataclasses.replace(views, size=factor * views.size)
    config = auto_config(lower=(-1.0,) * 3, upper=(1.0,) * 3)
    config.hash_grid.table_size = config.train.batch_size = AUTO
    config.train.cpu_batch_size = 300
    got, _, lines = resolve(config, larger, platform="cpu")
    assert (got.hash_grid.table_size, got.train.batch_size) == (rows, rays)
    assert any(f"at most {rows:,} rows per level" in line for line in lines)
    config.field, config.fine.num_freqs = "mlp", 4  # has no table
    assert resolve(config, larger, platform="cpu").config.train.batch_size == 300


def test_images_get_more_samples_than_training(views):
    config = auto_config(lower=(-1.0,) * 3, upper=(1.0,) * 3)
    config.eval.sample_multiplier = AUTO
    got, _, lines = resolve(config, views)
    assert got.eval.sample_multiplier == 1.5 and "images        1.5 times the samples of training" in lines


def test_alpha_does_not_bound_the_box_of_a_scene_that_moves_or_whose_poses_are_refined(views):
    """Each image shows bodies where they are at one time, or where a wrong pose has them: an intersection cuts them.

    Alpha still shows that nothing is around them.
    """

    def box(views, refine=False, **options):
        config = auto_config(**options)
        config.cameras.refine = refine
        scene = resolve(config, views).config.scene
        assert not scene.contracted
        return scene.lower, scene.upper

    pixels = views.pixels.reshape(-1, 24, 24, 4).copy()
    pixels[:, :9], pixels[:, 15:], pixels[:, :, :9], pixels[:, :, 15:] = 0, 0, 0, 0
    views = dataclasses.replace(views, pixels=pixels.reshape(-1, 4))
    moving = dataclasses.replace(views, time=np.linspace(0, 1, len(views.size), dtype=np.float32))
    whole = box(views, use_alpha=False, contracted=False)
    assert box(moving) == whole != box(views)
    assert box(views, refine=True) == whole
    both = [resolve(auto_config(), each).lines for each in (views, moving)]
    still, line = ([each for each in lines if each.startswith("time  ")] for lines in both)
    assert not still and line[0].endswith("the scene is trained as if nothing moved; --config=moving uses it")


@pytest.mark.parametrize(
    "found, refine, exposure, words",
    [
        (Agreement(2500, 0.7, 0.05, 0.02), False, False, ["0.70 px beside", "5.1% in brightness, limit 6.0%"]),
        (Agreement(2500, 0.9, 0.05, 0.02), True, False, ["refined poses on: matched corners are 0.90 px"]),
        (Agreement(2500, 0.7, 0.2, 0.02), False, True, ["exposures     on: corners differ by 22.1% in brightness"]),
        (Agreement(2500, 0.7, 0.05, 0.1), False, True, ["10.5% in colour, limit 2.5%"]),
        (Agreement(1500, 5.0, 0.3, 0.2), False, False, ["off: only 1500 corners of images match"]),
    ],
)
def test_poses_and_exposures_are_trained_where_images_contradict_them(
    views, monkeypatch, found, refine, exposure, words
):
    monkeypatch.setattr(camera_parameters, "agreement", lambda views: found)
    config = auto_config()
    config.cameras.refine = config.cameras.exposure = AUTO
    got, _, lines = resolve(config, views)
    assert (got.cameras.refine, got.cameras.exposure) == (refine, exposure)
    assert all(any(word in line for line in lines) for word in words)
    config.cameras.refine = False
    assert not resolve(config, views).config.cameras.refine
    moving = dataclasses.replace(views, time=np.linspace(0, 1, len(views.size), dtype=np.float32))
    config.cameras.refine = AUTO
    assert not resolve(config, moving).config.cameras.any


def test_sizes_follow_the_images_up_to_a_limit_that_contraction_doubles(views):
    def sizes(contracted, factor):
        larger = dataclasses.replace(
            views,
            size=factor * views.size,
            cameras=dataclasses.replace(views.cameras, focal=factor * np.asarray(views.cameras.focal)),
        )
        config = auto_config(use_alpha=False, contracted=contracted)
        got = resolve(config, larger).config
        longest = max(np.subtract(got.scene.upper, got.scene.lower))
        return got.hash_grid.resolutions, got.occupancy.resolution, round(longest / got.occupancy.step_size)

    for contracted, finest in ((False, (34, 69, 256, 512)), (True, (181, 362, 512, 512))):
        for factor, vertices in zip((1, 2, 16, 32), finest, strict=True):
            resolutions, cells, steps = sizes(contracted, factor)
            assert len(resolutions) == 4 + (contracted or factor == 32)
            assert resolutions[-1] == pytest.approx(vertices, abs=1)
            assert all(2 * a in (b, b - 1) for a, b in itertools.pairwise(resolutions))
            assert cells == min(resolutions[-1], 128 if contracted else 96) and steps == min(resolutions[-1], 144)


@pytest.mark.parametrize(
    "zoom, use_alpha, alpha, cells, steps",
    [(8, True, 0, 128, 144), (12, True, 0, 140, 157.5), (16, True, 0, 186, 209.25), (32, True, 0, 256, 288)]
    + [(32, False, 0, 96, 144), (32, True, 1, 128, 144)],
)
def test_small_pixels_with_alpha_have_finer_cells_and_deeper_networks(views, zoom, use_alpha, alpha, cells, steps):
    opaque = np.iinfo(views.pixels.dtype).max
    larger = dataclasses.replace(
        views,
        cameras=dataclasses.replace(views.cameras, focal=zoom * np.asarray(views.cameras.focal)),
        pixels=np.concatenate([views.pixels[:, :3], np.full_like(views.pixels[:, :1], opaque * alpha)], axis=-1),
    )
    box = {"lower": (-1.0,) * 3, "upper": (1.0,) * 3}
    config = auto_config(use_alpha=use_alpha, contracted=False, **box)
    config.hash_grid.view_depth = AUTO
    on_cpu, on_gpu = (resolve(config, larger, platform=platform).config for platform in ("cpu", "gpu"))
    section = on_cpu.occupancy
    assert section.resolution == cells and 2 / section.step_size == pytest.approx(steps)
    assert on_cpu.hash_grid.view_depth == (3 if cells > 128 else 2) and on_gpu.hash_grid.view_depth == 2


@pytest.mark.parametrize("cells, steps", [(16, 32), (128, 128), (512, 576)])
def test_a_step_is_at_most_as_long_as_a_cell_of_any_size(views, cells, steps):
    config = auto_config(use_alpha=False, contracted=False, lower=(-1.0,) * 3, upper=(1.0,) * 3)
    config.occupancy.resolution = cells
    assert 2 / resolve(config, views).config.occupancy.step_size == pytest.approx(steps)


@pytest.mark.parametrize("zoom, expected", [(1.0, "cameras"), (4.0, "three times"), (0.2, "images")])
def test_space_is_not_contracted_around_the_cameras(views, zoom, expected):
    cameras = dataclasses.replace(views.cameras, focal=np.float32(zoom * np.asarray(views.cameras.focal)))
    views = dataclasses.replace(views, cameras=cameras)
    section = resolve(auto_config(use_alpha=False, contracted=True), views).config.scene
    lower, upper = np.float64(section.lower), np.float64(section.upper)
    inner = (upper - lower) / 4  # half the side of the part that is not contracted
    eyes, middle = np.asarray(cameras.to_world)[:, :, 3], (lower + upper) / 2
    inside = (np.abs(eyes - middle) <= inner * (1 + 1e-4)).all(axis=-1).mean()
    distance = np.median(np.linalg.norm(eyes - middle, axis=-1))
    seen = distance * np.min(views.size[0]) / 2 / cameras.focal[0, 0]
    if expected == "cameras":
        assert 0.8 < inside < 1 and seen < inner[0] < 3 * seen
    elif expected == "images":
        assert inside == 1 and inner == pytest.approx(seen, rel=0.1)
    else:
        assert inside < 0.5 and inner == pytest.approx(3 * seen, rel=0.1)


def test_box_holds_all_matter_of_the_embedded_scene(resolved):
    lower, upper = (np.float32(bound) for bound in (resolved.config.scene.lower, resolved.config.scene.upper))
    x = np.random.default_rng(0).uniform(-2, 2, (1, 300_000, 3)).astype(np.float32)
    density, _ = compiled(still_life.still_life)(x, x)
    outside = ((x < lower) | (x > upper)).any(-1)
    assert (density > 0.1).mean() > 0.01 and not density[outside].max() > 0.1


def test_without_alpha_the_box_is_what_all_cameras_see(resolved, views):
    config, _, lines = resolve(auto_config(use_alpha=False), views)
    opaque = dataclasses.replace(views, pixels=views.pixels[:, :3])
    assert resolve(auto_config(), opaque).config.scene.lower == config.scene.lower
    assert any("as large as the images" in line for line in lines)
    # The cameras are 4 units from the origin, look at it, and have a focal length of 1.36 images.
    np.testing.assert_allclose(config.scene.upper, 3 * [4 / 1.36 / 2], atol=1e-3)
    np.testing.assert_allclose(config.scene.lower, 3 * [-4 / 1.36 / 2], atol=1e-3)
    assert (np.float64(resolved.config.scene.lower) >= np.float64(config.scene.lower) - 1e-4).all()


def test_box_is_in_the_units_of_the_scene(resolved, views):
    """A scene of a thousandth of the size has a thousandth of the box, to the same digits."""
    poses = views.cameras.to_world.copy()
    poses[:, :, 3] *= 1e-3
    small = dataclasses.replace(views, cameras=dataclasses.replace(views.cameras, to_world=poses))
    got = resolve(auto_config(), small).config
    for section, name in (("scene", "lower"), ("scene", "upper"), ("occupancy", "step_size")):
        found, expected = (np.float64(getattr(getattr(each, section), name)) for each in (got, resolved.config))
        np.testing.assert_allclose(1e3 * found, expected, rtol=2e-3)
    assert got.occupancy.resolution == resolved.config.occupancy.resolution


def test_ndc_box_holds_all_rays():
    shift = np.zeros((2, 3, 4), np.float32) + np.eye(3, 4, dtype=np.float32)
    shift[:, :2, 3] = [[0.3, -0.1], [-0.2, 0.2]]
    views = of_cameras(shift, near=0.0, far=1.0)
    config = auto_config()
    config.data.ndc, config.data.world = True, "forward"
    got = resolve(config, views).config
    pixels = np.random.default_rng(1).uniform(0, 1, (200, 2)).astype(np.float32) * [30, 20]
    for index in range(2):
        rays = compiled(view_rays, "ndc")(views, index, np.float32(pixels), ndc=True)
        for t in (rays.near, rays.far):
            x = rays.origins + t[:, None] * rays.directions
            assert (x >= np.float64(got.scene.lower) - 2e-4).all()
            assert (x <= np.float64(got.scene.upper) + 2e-4).all()


def test_workdir_gives_the_same_model(resolved, views, tmp_path):
    config = resolved.config
    workdir.save_config(tmp_path, config)
    workdir.save_config(tmp_path, resolve(auto_config(), views).config)  # the same command resumes
    read = workdir.load_config(tmp_path)
    assert as_json(read) == as_json(config)
    assert as_json(resolve(read, views).config) == as_json(config)
    mine, theirs = (build(resolve_for_device(each)[0]).model for each in (config, read))
    for part in ("lower", "upper", "shape", "step_size"):
        expected = np.ravel(getattr(theirs.grid_schedule, part))
        assert tuple(np.ravel(getattr(mine.grid_schedule, part))) == tuple(expected)
    shapes = [jax.eval_shape(model.init, jax.random.key(0)) for model in (mine, theirs)]
    assert jax.tree.structure(shapes[0]) == jax.tree.structure(shapes[1])
    assert jax.tree.leaves(shapes[0]) == jax.tree.leaves(shapes[1])
    other = changed(config, {"occupancy.step_size": 2 * config.occupancy.step_size})
    with pytest.raises(ValueError, match="belongs to a run with another config .occupancy.step_size"):
        workdir.save_config(tmp_path, other)


@pytest.mark.scenes("lego")
def test_sizes_of_lego(scenes_dir):
    lego = captures.load_blender(scenes_dir / "lego", split="train", factor=8)  # with fewer views the box is larger
    config = resolve(lego_fast.get_config(), lego).config
    occupancy, scene = config.occupancy, config.scene
    assert (np.abs([scene.lower, scene.upper]) < 1.3).all()
    assert 0.015 < occupancy.step_size < 0.025
    assert 64 <= occupancy.resolution <= 128 and 64 <= config.hash_grid.resolutions[-1] <= 256
    build(resolve_for_device(config)[0])
    slow = resolve(lego_mlp_fast.get_config(), lego).config
    assert slow.scene.lower == scene.lower and slow.occupancy.step_size == occupancy.step_size
    assert config.train.max_steps == config.train.lr_steps == 10000
    build(resolve_for_device(slow)[0])


@pytest.mark.parametrize(("spread", "expected"), [(1.7, "off"), (6, "on")])
def test_features_are_damped_where_footprints_differ(views, spread, expected):
    away = np.linspace(1, spread, len(views.size))[:, None]
    focal = np.asarray(views.cameras.focal) / away
    views = dataclasses.replace(views, cameras=dataclasses.replace(views.cameras, focal=focal.astype(np.float32)))
    config = auto_config()
    config.fine.prefilter, config.coarse.prefilter = "auto", "auto"
    config.coarse.encode = False
    resolved = resolve(config, views)
    assert resolved.config.hash_grid.prefilter is resolved.config.fine.prefilter is (expected == "on")
    assert resolved.config.coarse.prefilter is False
    (line,) = (line for line in resolved.lines if line.startswith("prefilter"))
    assert line.startswith(f"prefilter     {expected}: the footprints of pixels differ by a factor of")


def test_footprints_are_those_of_the_points_that_views_show(views):
    """Half of the views see points twice as far away as the others; one that shows none counts by what all look at."""
    count = len(views.size)
    pose = np.asarray(views.cameras.to_world)
    depth = np.where(np.arange(count) % 2, 6.0, 3.0).astype(np.float32)
    positions = pose[:, :, 3] - depth[:, None] * pose[:, :, 2]
    index = np.arange(count, dtype=np.int32)
    sparse = SparsePoints(positions=positions, view=index, point=index, pixel=np.zeros((count, 2), np.float32))
    assert footprint_spread(views) == pytest.approx(1, abs=0.2)
    found = dataclasses.replace(views, sparse=sparse)
    assert footprint_spread(found) == pytest.approx(2, rel=1e-5)
    focal = float(views.cameras.focal[0, 0])
    assert footprint_radii(found) == pytest.approx(np.array([3, 6]) / focal / 3**0.5, rel=1e-5)
    behind = dataclasses.replace(sparse, positions=pose[:, :, 3] + pose[:, :, 2])  # as wrong matches are: not counted
    assert footprint_radii(dataclasses.replace(views, sparse=behind)) == footprint_radii(views)
