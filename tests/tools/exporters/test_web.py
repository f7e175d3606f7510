"""The export "web": what its textures hold is what the field computes, and what the page cannot render is refused.

test_web_in_browser.py and experiments/web/web.py draw pages in a browser.
"""

import dataclasses
import gzip
import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from export_sources import source_of
from jaxnerf.core.contraction import contract
from jaxnerf.core.occupancy.grid import create_grid
from jaxnerf.evaluation.paths import camera_path
from jaxnerf.evaluation.restore import TrainedRun
from jaxnerf.fields.base import Field, contract_field
from jaxnerf.fields.hash_grid import HashGrid, harmonics, hash_grid_field
from jaxnerf.tools.exporters import web, web_scene
from jaxnerf.training.config import changed

BOX = {"lower": (-1.0, -1.5, -0.5), "upper": (1.0, 1.0, 1.5)}
SMALL = {"resolutions": (5, 9), "table_size": 2**12, "width": 12, "view_width": 8, **BOX}
FIELDS = {
    "dense": SMALL,
    "hashed": {**SMALL, "resolutions": (7, 20, 33), "table_size": 1000},
    "two features": {**SMALL, "features_per_level": 2},
    "six features": {**SMALL, "features_per_level": 6},
    "no directions": {**SMALL, "use_viewdirs": False},
    "no hidden colour layer": {**SMALL, "view_depth": 0},
    "three hidden colour layers": {**SMALL, "view_depth": 3},
}


def packed(options, precision="16 bits", contracted=False, as_scene=False, ndc=False):
    """Returns the function that evaluates a field with random parameters, and its WebScene; as_scene: it is a scene."""
    field = hash_grid_field(**options)
    params = jax.jit(field.init)(jax.random.key(1))
    leaves, tree = jax.tree.flatten(params)
    rng = np.random.default_rng(2)
    leaves = [np.float32(leaf + 0.3 * rng.standard_normal(leaf.shape)) for leaf in leaves]
    params = jax.tree.unflatten(tree, leaves)
    occupied = rng.uniform(size=(9, 11, 10)) < 0.3
    lower, upper = (np.float32(options[name]) for name in ("lower", "upper"))
    grid = create_grid(lower, upper, occupied, initial_density=1.0, contracted=contracted)
    march = {"step_size": 0.02, "early_stop_eps": 0.01, "background": None}
    scene = web_scene.pack(field.network, params, grid, precision=precision, ndc=ndc, **march)
    field = contract_field(field, lower, upper) if contracted else field
    decoded = scene.decoded(params)

    if as_scene:
        return lambda x, viewdirs: field.apply(decoded, x, viewdirs), scene

    def evaluate(x, viewdirs):
        density, rgb = jax.jit(field.apply)(decoded, np.float32(x)[None], np.float32(viewdirs)[None])
        return np.asarray(density[0]), np.asarray(rgb[0])

    return evaluate, scene


def shaded(scene, x, viewdirs):
    """Evaluates a WebScene as the shader does, from the same textures: density [N] and rgb [N, 3]."""
    lower, upper = np.float32(scene.grid.lower), np.float32(scene.grid.upper)
    if scene.grid.contracted:
        middle, quarter = (lower + upper) / 2, (upper - lower) / 4
        x = middle + quarter * np.asarray(contract((x - middle) / quarter))
    place = np.clip((x - lower) / (upper - lower), 0, 1)

    def layer(name, values):
        return values @ scene.layers[name].kernel + scene.layers[name].bias

    features = np.concatenate([interpolated(scene, level, place) for level in range(len(scene.levels))], axis=-1)
    hidden = layer("density", np.maximum(layer("hidden", features), 0))
    density = np.exp(np.minimum(hidden[:, 0], 15.0))
    names = [name for name in scene.layers if name.startswith("view_")] + ["rgb"]
    for name in names:
        found = layer(name, hidden)
        if name == names[0] and "ray" in scene.layers:
            found += layer("ray", np.pad(np.asarray(harmonics(viewdirs)), ((0, 0), (0, 3))))
        hidden = found if name == "rgb" else np.maximum(found, 0)
    return density, 1 / (1 + np.exp(-hidden[:, :3]))


def interpolated(scene, index, place):
    level, features = scene.levels[index], scene.features(index)
    size = np.int32(level.size)
    spread = place * np.float32(size - 1)
    low = np.minimum(spread.astype(np.int32), size - 2)
    fraction, total = spread - low, 0.0
    for offset in np.ndindex(2, 2, 2):
        vertex = low + np.int32(offset)
        row = (vertex[:, 0] * size[1] + vertex[:, 1]) * size[2] + vertex[:, 2]
        if web_scene.is_hashed(level):
            hashes = vertex.astype(np.uint32) * np.uint32([1, 2654435761, 805459861])
            row = np.bitwise_xor.reduce(hashes, axis=-1) % np.uint32(len(level.rows))
        total = total + np.where(offset, fraction, 1 - fraction).prod(axis=-1, keepdims=True) * features[row]
    return total


def places(count=400, reach=1.2):
    rng = np.random.default_rng(3)
    directions = rng.standard_normal((count, 3))
    x = np.float32([0, -0.25, 0.5]) + reach * np.float32([1, 1.25, 1]) * rng.uniform(-1, 1, (count, 3))
    return np.float32(x), np.float32(directions / np.linalg.norm(directions, axis=1, keepdims=True))


@pytest.mark.parametrize("name, precision", [*((name, "16 bits") for name in FIELDS), ("hashed", "8 bits")])
def test_the_twin_of_the_shader_is_the_field(name, precision):
    field, scene = packed(FIELDS[name], precision)
    for found, expected in zip(shaded(scene, *places()), field(*places()), strict=True):
        np.testing.assert_allclose(found, expected, rtol=3e-4, atol=3e-5)


def test_the_twin_contracts_as_the_field_does():
    field, scene = packed(FIELDS["hashed"], contracted=True)
    for found, expected in zip(shaded(scene, *places(reach=30)), field(*places(reach=30)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)
    assert "#define CONTRACTED 1" in web_scene.shader(scene) and "#define NDC 0" in web_scene.shader(scene)


def test_features_have_the_precision_that_is_stated():
    table = {}
    for precision in web_scene.PRECISIONS:
        scene = packed(FIELDS["dense"], precision)[1]
        table[precision] = scene.features(1)
    step = packed(FIELDS["dense"], "8 bits")[1].scale[1] / 255
    error = np.abs(table["8 bits"] - table["16 bits"])
    assert 0.2 * step < error.max() <= 0.53 * step  # half precision rounds, too


def test_bits_are_those_of_the_occupied_cells_and_of_their_cubes():
    _, scene = packed(FIELDS["dense"])
    arrays, occupied = web_scene.textures(scene), np.asarray(scene.grid.occupied)

    def bit(name, place, shape):
        flat = np.ravel_multi_index(place, shape)
        return bool(arrays[name].reshape(-1)[flat >> 5] >> np.uint32(flat & 31) & 1)

    assert all(bit("occupied", place, occupied.shape) == occupied[place] for place in np.ndindex(occupied.shape))
    for cube in np.ndindex(3, 3, 3):
        cells = tuple(slice(4 * start, 4 * start + 4) for start in cube)
        assert bit("coarse", cube, (3, 3, 3)) == occupied[cells].any()


def test_layers_are_in_the_order_in_which_the_shader_reads_them():
    kernel = np.arange(32, dtype=np.float32).reshape(4, 8)
    texels = web_scene.Layer(kernel, -np.arange(8, dtype=np.float32)).texels()
    assert texels[1].tolist() == [-4, -5, -6, -7]
    assert texels[2].tolist() == [0, 1, 2, 3] and texels[3].tolist() == [8, 9, 10, 11]  # of the first two inputs
    assert texels[6].tolist() == [4, 5, 6, 7]


def test_the_shader_is_generated_for_the_field():
    _, scene = packed(FIELDS["hashed"])
    text = web_scene.shader(scene)
    assert "//@" not in text.split("out vec4 color")[1] and text.count("= interpolated(place") == 3
    assert "ivec3(13, 16, 13), 210, 1000u, true" in text or "1000u, true" in text
    assert "layer_ray" in text and "layer_ray" not in web_scene.shader(packed(FIELDS["no directions"])[1])


def test_operations_are_counted_from_the_layers():
    _, scene = packed({**SMALL, "width": 8})
    # Inputs and outputs in multiples of 4: 8 x 8, 8 x 16, 16 x 8, 8 x 8, 8 x 4.
    layers = 2 * (8 * 8 + 8 * 16 + 16 * 8 + 8 * 8 + 8 * 4)
    assert web_scene.operations_per_sample(scene) == layers + 2 * 8 * 4 * 4


def test_the_binary_can_be_read_as_the_page_reads_it():
    _, scene = packed(FIELDS["dense"])
    raw = gzip.decompress(web.encode(scene, {"name": "ball"}))
    assert raw[:8] == web.MAGIC
    length = int(np.frombuffer(raw, "<u4", 1, 8)[0])
    content = json.loads(raw[12 : 12 + length])
    assert (12 + length) % 4 == 0 and len(raw) == 12 + length + content["bytes"] and content["name"] == "ball"
    (table,) = (array for array in content["arrays"] if array["name"] == "table")
    found = np.frombuffer(raw, np.float16, table["width"] * table["height"] * 4, 12 + length + table["start"])
    np.testing.assert_array_equal(found[: scene.table.size].reshape(scene.table.shape), scene.table)


def test_the_page_holds_everything_and_loads_nothing():
    text = web.page(b"data")
    assert "@@" not in text and "ZGF0YQ==" in text and "default-src 'none'" in text
    assert not [word for word in ("http://", "https://", "<script src", '<link rel="style') if word in text]
    assert "scene.bin" in web.page(None)


def test_the_page_tours_as_the_run_does_and_turns_little_where_cameras_look_one_way():
    source = source_of()
    described = web.about(source, packed(FIELDS["dense"])[1], "")
    path = camera_path.make_path("turntable", source.views, num_frames=len(described["tour"]))
    np.testing.assert_allclose(described["tour"], path.poses.reshape(-1, 12), atol=1e-6)
    assert described["swing"] is None and described["up"] == [0, 0, 1]
    upright = source_of()
    upright.run.experiment.config = changed(upright.run.experiment.config, {"data.up": "+x"})
    found = web.about(upright, packed(FIELDS["dense"])[1], "")  # x of the files is -y of the run
    np.testing.assert_allclose(found["up"], [0, -1, 0], atol=1e-6)
    poses = np.tile(np.eye(3, 4, dtype=np.float32), (14, 1, 1))
    poses[:, :2, 3] = np.random.default_rng(0).uniform(-0.3, 0.3, (14, 2))
    ahead = dataclasses.replace(source.views.cameras, to_world=poses)
    forward = source._replace(views=dataclasses.replace(source.views, cameras=ahead))
    described = web.about(forward, packed(FIELDS["dense"], ndc=True)[1], "")
    assert 0 < described["swing"] <= 0.6 and described["target"][2] < -0.5
    np.testing.assert_allclose(described["ndc_scale"], [4.4, 4.4], rtol=1e-6)
    alone = dataclasses.replace(ahead, to_world=np.tile(poses[:1], (14, 1, 1)))  # defines no path
    alone = source._replace(views=dataclasses.replace(source.views, cameras=alone))
    assert len(web.about(alone, packed(FIELDS["dense"])[1], "")["tour"]) == 1


def test_a_table_that_no_texture_holds_is_refused(monkeypatch):
    monkeypatch.setattr(web_scene, "MAX_TEXTURE_SIDE", 0)
    with pytest.raises(ValueError, match="a browser's texture holds 0; train with a smaller hash_grid.table_size"):
        packed(FIELDS["dense"])


def test_parameters_that_are_not_finite_are_refused():
    field = hash_grid_field(**FIELDS["dense"])
    params = jax.jit(field.init)(jax.random.key(0))
    params = {**params, "bias": params["bias"].at[0].set(jnp.nan)}
    with pytest.raises(ValueError, match="not finite"):
        web_scene.pack(field.network, params, None, precision="8 bits", step_size=1, early_stop_eps=0, background=None)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"fields": {"fine": Field(None, None)}}, "web: field is 'other', expected a hash grid"),
        ({"grid_schedule": None}, "web: sampler is 'other', expected one that trains with an occupancy grid"),
        ({"needs": ("time",)}, "web: the field asks for time, expected position and direction"),
    ],
)
def test_a_run_that_the_page_cannot_render_is_refused(change, message):
    model = {"fields": {"fine": hash_grid_field(**SMALL)}, "image_networks": ("fine",)}
    model |= {"grid_schedule": (), "needs": ()}

    def run_of(**change):
        config = SimpleNamespace(field="other", sampler="other")
        experiment = SimpleNamespace(config=config, model=SimpleNamespace(**{**model, **change}))
        return TrainedRun(*[None] * len(TrainedRun._fields))._replace(experiment=experiment)

    assert isinstance(web.network_of(run_of()), HashGrid)
    with pytest.raises(ValueError, match=message):
        web.network_of(run_of(**change))
