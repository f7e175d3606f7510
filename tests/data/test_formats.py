"""Datasets from the folder to the rays: the scene, rendered along the rays of the Views, has the pixels' colours.

The scene is a closed form in the file's world, so this checks formats, conventions, lenses, sizes, masks and worlds
at once.
"""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import captures
from jaxnerf import Rays, render_rays
from jaxnerf.configs import capture
from jaxnerf.core.views import pixel_colors
from jaxnerf.data import dataset
from jaxnerf.data.active_pixels import unmasked_pixels
from jaxnerf.data.dataset import DataOptions
from jaxnerf.data.ray_batches import view_rays
from jaxnerf.options import replaced, values_of
from jaxnerf.tools.embedded_scene import still_life
from jaxnerf.training import workdir
from jaxnerf.training.config import read_config

RAYS = 64  # per view


def a_data(folder, **changes):
    """Returns the data section of configs/capture.py for a folder, at full size."""
    return replaced(read_config(capture.get_config()).data, **{"dir": str(folder), "factor": 1, **changes})


@functools.cache
def compiled_rays():
    return jax.jit(view_rays)


@jax.jit
def rendered(rays):
    return render_rays(None, still_life.still_life, rays, num_samples=512, background=jnp.ones(3))


def errors(views, *, sky=False):
    """Returns |colour of the pixel - colour of the scene along its ray| [N, 3] at random unmasked pixels."""
    rng, found = np.random.default_rng(0), []
    active = unmasked_pixels(views)
    active = np.arange(len(views.pixels)) if active is None else active.ids(np.arange(active.size))
    back = np.asarray(views.to_file, np.float64)
    unit = np.cbrt(np.linalg.det(back[:3, :3]))
    for index, (height, width) in enumerate(views.size):
        first = views.offset[index]
        own = active[(active >= first) & (active < first + height * width)]
        ids = rng.choice(own, RAYS)
        place = ids - first
        pixels = np.stack([place % width, place // width], axis=-1) + 0.5
        rays = compiled_rays()(views, index, np.float32(pixels))
        kept = np.asarray(rays.far > rays.near)
        origins = np.asarray(rays.origins) @ back[:3, :3].T + back[:3, 3]
        viewdirs = np.asarray(rays.viewdirs) @ (back[:3, :3] / unit).T
        # The scene is within 1.4 of the origin, the cameras are 4 away from it.
        nearest = -(origins * viewdirs).sum(axis=-1)
        world = Rays(
            origins=jnp.float32(origins),
            directions=jnp.float32(viewdirs),
            viewdirs=jnp.float32(viewdirs),
            near=jnp.float32(nearest - 1.7),
            far=jnp.float32(nearest + 1.7),
        )
        image = jax.tree.map(np.asarray, rendered(world))
        behind = captures.sky_color(origins, viewdirs) if sky else np.ones(3)
        color = image.rgb + (1 - image.opacity)[:, None] * (behind - 1)
        truth = np.asarray(pixel_colors(jnp.asarray(views.pixels[ids]), views.background))
        found.append(np.abs(color - truth)[kept])
    return np.concatenate(found)


def assert_shows_the_scene(views, tolerance=0.012, **options):
    """Checks that errors are below 0.01 except on edges; quantisation and quadrature errors are smaller."""
    off = errors(views, **options)
    assert np.quantile(off, 0.97) < tolerance and np.mean(off) < tolerance / 3


FEATURES = {
    "pinhole": ({}, {}, 0.012),
    "opencv": ({"lens": "opencv"}, {}, 0.012),
    "fisheye": ({"lens": "fisheye"}, {}, 0.012),
    "16 bit": ({}, {"bits": 16}, 0.012),
    "JPEG": ({}, {"kind": "jpg"}, 0.05),
    "WebP": ({}, {"kind": "webp"}, 0.012),
    "turned": ({}, {"orientation": 6}, 0.012),
    "masks": ({}, {"masks": True}, 0.012),
    "off centre": ({"center": (13.0, 14.5), "focal": (30.0, 34.0)}, {}, 0.012),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FEATURES)
def test_transforms(tmp_path, name):
    cameras, images, tolerance = FEATURES[name]
    shots = captures.shoot(captures.orbit(8, **cameras))
    captures.write_transforms(tmp_path, shots, **images)
    data, lines, _ = dataset.resolve(a_data(tmp_path))
    assert data.format == "transforms" and data.world == "around" and data.ndc is False
    assert any(line.startswith("format        transforms") for line in lines)
    views = dataset.load_split(data, "train")
    assert len(views.offset) == 7 and views.names[0] == "001"
    assert (views.mask is not None) == (name == "masks")
    assert views.pixels.dtype == (np.uint16 if name == "16 bit" else np.uint8)
    assert_shows_the_scene(views, tolerance)
    assert_shows_the_scene(dataset.load_split(data, "test"), tolerance)


def test_without_its_masks_the_dataset_fails_the_check(tmp_path):
    captures.write_transforms(tmp_path, captures.shoot(captures.orbit(8)), masks=True)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for frame in content["frames"]:
        del frame["mask_path"]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert_shows_the_scene(dataset.load_split(a_data(tmp_path), "train"))  # they are found beside the images
    (tmp_path / "masks").rename(tmp_path / "other")
    assert np.quantile(errors(dataset.load_split(a_data(tmp_path), "train")), 0.97) > 0.1


def test_cameras_and_sizes_may_differ(tmp_path):
    stacks = captures.orbit(4), captures.orbit(4, height=30, width=20, first=4, lens="opencv")
    captures.write_transforms(tmp_path, captures.shoot(*stacks))
    views = dataset.load_split(a_data(tmp_path), "train")
    assert {tuple(size) for size in views.size.tolist()} == {(24, 32), (30, 20)}
    assert views.cameras.height is None
    assert_shows_the_scene(views)


def test_alpha_is_composited_over_the_background(tmp_path):
    captures.write_transforms(tmp_path, captures.shoot(captures.orbit(8)), rgba=True)
    views = dataset.load_split(a_data(tmp_path, background="white"), "train")
    assert views.pixels.shape[-1] == 4
    assert_shows_the_scene(views)


def test_splits_of_the_file_are_used(tmp_path):
    splits = {"train": [0, 1, 2, 3], "val": [4], "test": [5, 6, 7]}
    captures.write_transforms(tmp_path, captures.shoot(captures.orbit(8)), splits=splits)
    data, *_ = dataset.resolve(a_data(tmp_path))
    for split, indices in splits.items():
        assert dataset.load_split(data, split).names == tuple(f"{index:03d}" for index in indices)


@pytest.mark.parametrize("lens", ["pinhole", "opencv", "fisheye"])
def test_colmap(tmp_path, lens):
    shots = captures.shoot(captures.orbit(8, lens=lens))
    points = captures.write_colmap(tmp_path, shots)
    data, *_ = dataset.resolve(a_data(tmp_path))
    assert data.format == "colmap" and data.world == "around"
    views = dataset.load_split(data, "train")
    assert_shows_the_scene(views)
    scale = np.cbrt(np.linalg.det(np.asarray(views.to_file, np.float64)[:3, :3]))
    for near, far, row, seen in zip(views.near, views.far, points.depth[1:], points.seen[1:], strict=True):
        assert near * scale < row[seen].min() * 1.02 and far * scale > row[seen].max() * 0.98
        assert near * scale > 1.5 and far * scale < 9


def test_points_bound_the_free_space_unless_cameras_travel(tmp_path, monkeypatch):
    """On a walk they are far behind railings that have none."""
    captures.write_colmap(tmp_path, captures.shoot(captures.orbit(8)))
    data, *_ = dataset.resolve(a_data(tmp_path))
    views = dataset.load_split(data, "train")
    np.testing.assert_array_equal(views.free_depth, views.near)
    monkeypatch.setattr(dataset, "travel", lambda poses: True)
    assert dataset.load_split(data, "train").free_depth is None


def test_colmap_precedes_llff_and_format_overrides(tmp_path):
    shots = captures.shoot(captures.front(8))
    points = captures.write_colmap(tmp_path, shots)
    captures.write_llff(tmp_path, shots, points=points)
    data, lines, _ = dataset.resolve(a_data(tmp_path))
    assert data.format == "colmap" and "colmap, llff" in lines[0]
    data, lines, _ = dataset.resolve(a_data(tmp_path, format="llff"))
    assert data.format == "llff" and not any(line.startswith("format") for line in lines)


def test_without_any_depth_forward_facing_datasets_are_trained_around(tmp_path):
    """In NDC nothing is in front of near, which would be a guess."""
    captures.write_transforms(tmp_path, captures.noise(captures.front(9)))
    data, lines, _ = dataset.resolve(a_data(tmp_path))
    assert (data.world, data.ndc) == ("around", False) and "nothing tells how far" in "".join(lines)


@pytest.mark.parametrize("write", [captures.write_llff, captures.write_colmap])
def test_forward_facing_datasets(tmp_path, write):
    shots = captures.shoot(captures.front(9))
    write(tmp_path, shots)
    data, *_ = dataset.resolve(a_data(tmp_path))
    assert data.world == "forward" and data.ndc is True
    views = dataset.load_split(data, "train")
    assert_shows_the_scene(views)
    assert np.abs(views.cameras.to_world[:, :, :3] - np.eye(3)).max() < 0.3
    assert 1 / 0.75 - 1e-3 < views.near.min() < 2


def test_llff_all_around(tmp_path):
    captures.write_llff(tmp_path, captures.shoot(captures.orbit(8)))
    data, *_ = dataset.resolve(a_data(tmp_path))
    assert data.format == "llff" and data.world == "around" and data.ndc is False
    assert_shows_the_scene(dataset.load_split(data, "train"))


@pytest.mark.parametrize("world", ["file", "around", "forward"])
def test_every_world_shows_the_same_scene(tmp_path, world):
    shots = captures.shoot(captures.front(8))
    captures.write_colmap(tmp_path, shots)
    views = dataset.load_split(a_data(tmp_path, world=world, ndc=False), "train")
    assert_shows_the_scene(views)
    if world == "file":
        np.testing.assert_array_equal(views.to_file, np.eye(4))
        given = [shot.camera.to_world for shot in shots[1:]]
        np.testing.assert_allclose(views.cameras.to_world, given, atol=1e-5)
    if world == "around":
        eyes = views.cameras.to_world[:, :, 3]
        assert 0.5 < np.median(np.linalg.norm(eyes, axis=-1)) < 1.5


def test_an_unbounded_dataset_with_a_declared_box(tmp_path):
    shots = captures.shoot(captures.orbit(8), sky=True)
    captures.write_transforms(tmp_path, shots, extra={"aabb_scale": 4})
    views = dataset.load_split(a_data(tmp_path), "train")
    assert_shows_the_scene(views, sky=True)
    scale = np.cbrt(np.linalg.det(np.asarray(views.to_file, np.float64)[:3, :3]))
    # The cube has side 4 / 0.33 around the file's origin; its bounding box in a rotated world is larger.
    sides = (views.box[1] - views.box[0]) * scale
    assert (sides > 4 / 0.33 - 1e-3).all() and (sides < 4 / 0.33 * 1.8).all()


def test_the_factor_is_inferred_from_the_width(tmp_path):
    captures.write_transforms(tmp_path, captures.shoot(captures.orbit(8)))
    data, lines, _ = dataset.resolve(a_data(tmp_path, factor="auto", width=15))
    assert data.factor == 2 and any(line.startswith("factor        2") for line in lines)
    assert dataset.load_split(data, "train").size.tolist() == [[12, 16]] * 7


def test_resolving_again_changes_nothing(tmp_path):
    captures.write_transforms(tmp_path, captures.noise(captures.orbit(8)))
    data, *_ = dataset.resolve(a_data(tmp_path))
    again, lines, _ = dataset.resolve(data)
    assert again == data and not lines
    synthetic, lines, _ = dataset.resolve(DataOptions())
    for resolved in (again, synthetic):  # the rest depends on the sampler and on the images
        left = {name for name, value in values_of(resolved).items() if value == "auto"}
        assert not lines and left == {"near"}


def test_a_missing_folder_is_an_error():
    with pytest.raises(ValueError, match="data.dir is 'nowhere': no such folder"):
        dataset.resolve(a_data("nowhere"))


def test_a_dataset_that_changed_since_training_is_an_error(tmp_path):
    captures.write_transforms(tmp_path, captures.noise(captures.orbit(8)))
    data, _, read = dataset.resolve(a_data(tmp_path))
    fingerprint = dataset.fingerprint(data, read)
    assert fingerprint.startswith("8 images, ") and fingerprint == dataset.fingerprint(data)
    assert len(dataset.load_split(data, "train", fingerprint=fingerprint).offset) == 7
    file = tmp_path / "transforms.json"
    whole = json.loads(file.read_text())
    moved = json.loads(file.read_text())
    moved["frames"][3]["transform_matrix"][0][3] += 0.01
    for content, found in (({**whole, "frames": whole["frames"][1:]}, "7"), (moved, "8")):
        file.write_text(json.dumps(content))
        for split in ("train", "test"):
            with pytest.raises(ValueError, match=f"holds {found} images, .* expected 8 images"):
                dataset.load_split(data, split, fingerprint=fingerprint)
        workdir.save_config(tmp_path / "run", to_config(data, fingerprint))
        with pytest.raises(ValueError, match=f"the dataset holds {found} images, .*, expected 8 images, .* trained on"):
            workdir.save_config(tmp_path / "run", to_config(data, dataset.fingerprint(data)))


def to_config(data, fingerprint):
    return replaced(read_config(capture.get_config()), data=data, fingerprint=fingerprint)


def test_ndc_require_cameras_that_look_in_one_direction(tmp_path):
    captures.write_llff(tmp_path, captures.shoot(captures.orbit(8)))
    with pytest.raises(ValueError, match="the cameras look in all directions"):
        dataset.load_split(a_data(tmp_path, ndc=True), "train")
    with pytest.raises(ValueError, match="data.ndc is True in the world 'around'"):
        dataset.load_split(a_data(tmp_path, ndc=True, world="around"), "train")


def test_the_background_is_inferred_from_alpha(tmp_path):
    for name, rgba, expected in (("a", True, "white"), ("b", False, "none")):
        captures.write_transforms(tmp_path / name, captures.noise(captures.orbit(8)), rgba=rgba)
        data, lines, _ = dataset.resolve(a_data(tmp_path / name))
        assert data.background == expected and f"background    {expected}" in lines
        assert (dataset.load_split(data, "train").background is None) == (not rgba)


def test_near_and_far_are_in_the_files_units(tmp_path):
    captures.write_transforms(tmp_path, captures.noise(captures.orbit(8)))
    views = dataset.load_split(a_data(tmp_path, near=2.5, far=5.5), "train")
    scale = np.cbrt(np.linalg.det(np.asarray(views.to_file, np.float64)[:3, :3]))
    np.testing.assert_allclose(views.near * scale, 2.5, rtol=1e-5)
    np.testing.assert_allclose(views.far * scale, 5.5, rtol=1e-5)
    with pytest.raises(ValueError, match="near 7 and far 5, expected near < far"):
        dataset.load_split(a_data(tmp_path, near=7.0, far=5.0), "train")


def test_errors_of_the_data_section(tmp_path):
    with pytest.raises(ValueError, match="holds no dataset, expected transforms_train.json"):
        dataset.resolve(a_data(tmp_path))
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "IMG_1.JPG").touch()
    with pytest.raises(ValueError, match=r"images without cameras.*jaxnerf-cameras --images=\S+/images --out="):
        dataset.resolve(a_data(tmp_path))
    captures.write_transforms(tmp_path, captures.noise(captures.orbit(8)))
    with pytest.raises(ValueError, match="there is no dataset format 'dslr'"):
        dataset.load_split(a_data(tmp_path, format="dslr"), "train")
    with pytest.raises(ValueError, match="data.world is 'flat'"):
        dataset.load_split(a_data(tmp_path, world="flat"), "train")
    with pytest.raises(ValueError, match="split is 'all'"):
        dataset.load_split(a_data(tmp_path), "all")


@pytest.mark.scenes("fern", "fox", "can", "lego")
@pytest.mark.parametrize(
    "name, format, world, ndc",
    [
        ("fern", "llff", "forward", True),
        ("fox", "transforms", "around", False),
        ("can", "colmap", "around", False),
        ("lego", "blender", "file", False),
    ],
)
def test_the_real_datasets(scenes_dir, name, format, world, ndc):
    data, lines, _ = dataset.resolve(a_data(scenes_dir / name, factor="auto", width=200))
    assert (data.format, data.world, data.ndc) == (format, world, ndc)
    assert data.factor == {"fern": 20, "fox": 5, "can": 4, "lego": 4}[name]
    skipped = [line for line in lines if line.startswith("note")]
    assert len(skipped) == (1 if name == "fox" else 0)


def test_of_several_formats_the_one_that_can_be_read_is_named(tmp_path):
    """A COLMAP model beside a transforms.json with the paths of another machine."""
    shots = captures.noise(captures.orbit(8))
    captures.write_colmap(tmp_path, shots)
    content = captures.write_transforms(tmp_path, shots)
    for frame in content["frames"]:
        frame["file_path"] = "/home/other/capture/" + frame["file_path"].replace("0", "frame_0")
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match="leaves the folder.*; --format=colmap reads this folder"):
        dataset.load_dataset(tmp_path, split="train")
    assert len(dataset.load_dataset(tmp_path, split="train", format="colmap").size) == 7
    (tmp_path / "sparse" / "0" / "images.txt").write_text("")
    with pytest.raises(ValueError, match="leaves the folder") as error:
        dataset.load_dataset(tmp_path, split="train")
    assert "--format" not in str(error.value)
