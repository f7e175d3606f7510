"""The exports of a closed-form ball, in the units and axes of the dataset's files; the files are read back."""

import json

import imageio.v3 as iio
import numpy as np
import pytest
import trimesh
from PIL import Image

from export_sources import CENTER, RADIUS, SIZE, source_of
from jaxnerf.core.types import Camera
from jaxnerf.fields.base import Field
from jaxnerf.runtime import stages
from jaxnerf.tools.exporters import base, gaussians, surfaces
from jaxnerf.tools.exporters.base import export_run
from jaxnerf.tools.exporters.depth import export_depth
from jaxnerf.tools.exporters.mesh import export_mesh, fuse, keep_large_pieces, level_set, solid_field, write_glb
from jaxnerf.tools.exporters.points import export_points, thinned
from jaxnerf.tools.exporters.registration import Exporter
from jaxnerf.tools.exporters.splats import export_splats, score
from runs import run_forked

IN_FILE = 2 * RADIUS  # the ball's radius there
VOXEL = 2 * IN_FILE / 32


@pytest.fixture(scope="module", autouse=True)
def images():
    """The depth images, rendered once."""
    rendered = surfaces.render_depth_images(source_of(), SIZE)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("mesh", "points", "splats", "depth"):
            module = __import__(f"jaxnerf.tools.exporters.{name}", fromlist=["render_depth_images"])
            patch.setattr(module, "render_depth_images", lambda source, size, **options: rendered)
        yield rendered


def radii(points):
    return np.linalg.norm(points - CENTER, axis=-1)


def test_depth_images_lie_on_the_surface(images, tmp_path):
    export_depth(source_of(), tmp_path)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert len(content["frames"]) == 14 and content["w"] == content["h"] == SIZE
    for frame, image in zip(content["frames"], images, strict=True):
        depth = iio.imread(tmp_path / frame["depth_file_path"])
        assert depth.dtype == np.float32 and 0.1 < (depth > 0).mean() < 0.9
        assert iio.imread(tmp_path / frame["file_path"]).shape == (SIZE, SIZE, 3)
        y, x = np.nonzero(depth)
        local = np.stack([x + 0.5 - content["cx"], content["cy"] - y - 0.5, -content["fl_x"] + 0 * x]) / content["fl_x"]
        matrix = np.array(frame["transform_matrix"])
        points = (matrix[:3, :3] @ (local * depth[y, x])).T + matrix[:3, 3]
        assert np.median(np.abs(radii(points) - IN_FILE)) < 0.02
        assert np.isinf(image.depth[0, 0])  # empty space


def test_depth_images_without_colors_are_at_the_same_depth(images):
    """Their renderer ends rays behind their median depth, and evaluates no colours."""
    source, settings = source_of(), []
    model_with = source.run.model_with

    def spied(given, wrap):
        settings.append(given)
        field = wrap(Field(init=lambda key: {}, apply=lambda params, x, viewdirs: (x[..., 0], x)))
        assert not field.apply(None, np.ones((2, 3)), None)[1].any()
        return model_with(given, wrap)

    source = source._replace(run=source.run._replace(model_with=spied))
    for image, other in zip(surfaces.render_depth_images(source, SIZE, colors=False), images, strict=True):
        assert image.rgb is None
        np.testing.assert_allclose(image.depth, other.depth, rtol=1e-6)
    assert settings == [{"early_stop_eps": pytest.approx(0.4), "sample_multiplier": 1.0}]


def test_depth_images_of_equal_names_in_several_folders_are_kept(images, tmp_path, monkeypatch):
    named = [image._replace(name=f"{index}/view") for index, image in enumerate(images)]
    monkeypatch.setattr("jaxnerf.tools.exporters.depth.render_depth_images", lambda *_: named)
    export_depth(source_of(), tmp_path)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert len({frame["depth_file_path"] for frame in frames}) == len(list((tmp_path / "depth").iterdir())) == 14


def test_the_box_crops_depth_images(tmp_path):
    export_depth(source_of(box=(*CENTER, *(CENTER + 2))), tmp_path)
    seen = [(iio.imread(path) > 0).sum() for path in sorted((tmp_path / "depth").iterdir())]
    whole = [np.isfinite(image.depth) & (image.depth > 0) for image in surfaces_of(tmp_path)]
    assert 0 < sum(seen) < 0.5 * sum(mask.sum() for mask in whole)


def surfaces_of(tmp_path):
    from jaxnerf.tools.exporters import depth

    return depth.render_depth_images(None, None)


@pytest.mark.parametrize("suffix", ["ply", "obj"])
def test_a_mesh_is_a_closed_ball_of_two_colors(tmp_path, suffix):
    lines = []
    export_mesh(source_of(format=suffix, say=lines.append), tmp_path)
    mesh = trimesh.load(tmp_path / f"mesh.{suffix}", force="mesh")
    assert np.abs(radii(mesh.vertices) - IN_FILE).mean() < 0.2 * VOXEL
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * IN_FILE**3, rel=0.05)  # positive: faces look outwards
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3]
    red = mesh.vertices[:, 1] > CENTER[1]  # the file's y is the run's x
    away = np.abs(mesh.vertices[:, 1] - CENTER[1]) > 0.1
    assert (colors[red & away, 0] > 200).all() and (colors[~red & away, 1] > 200).all()
    assert "triangles" in lines[0]


def test_a_glb_has_linear_colors_and_normals_and_stands_on_its_feet(tmp_path):
    """Dark grey, 60 of 255 in sRGB, is 0.045 in linear light; the dataset's z is up."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=2.0)
    ball.apply_translation(CENTER)
    mesh = trimesh.Trimesh(ball.vertices, ball.faces, vertex_colors=np.tile([60, 60, 60, 255], (len(ball.vertices), 1)))
    write_glb(mesh, tmp_path / "mesh.glb", up=np.array([0.0, 0.0, 1.0]))
    content = (tmp_path / "mesh.glb").read_bytes()
    length = int.from_bytes(content[12:16], "little")
    tree, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    (primitive,) = tree["meshes"][0]["primitives"]

    def read(name):
        accessor = tree["accessors"][primitive["attributes"][name]]
        view = tree["bufferViews"][accessor["bufferView"]]
        assert accessor["componentType"] == 5126  # float32
        start, count = view.get("byteOffset", 0) + accessor.get("byteOffset", 0), int(accessor["type"][-1])
        return np.frombuffer(binary, "<f4", accessor["count"] * count, start).reshape(-1, count)

    np.testing.assert_allclose(read("COLOR_0")[:, :3], ((60 / 255 + 0.055) / 1.055) ** 2.4, rtol=1e-5)
    vertices, normals = read("POSITION"), read("NORMAL")
    np.testing.assert_allclose(vertices, mesh.vertices, rtol=1e-6)  # in the units and axes of the files
    np.testing.assert_allclose(normals, (vertices - CENTER) / 2, atol=0.02)
    material = tree["materials"][primitive["material"]]
    assert "KHR_materials_unlit" in material["extensions"] and "KHR_materials_unlit" in tree["extensionsUsed"]
    assert material["pbrMetallicRoughness"] == {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    turned = trimesh.load(tmp_path / "mesh.glb", force="mesh").vertices
    np.testing.assert_allclose(turned, vertices[:, [0, 2, 1]] * [1, 1, -1], atol=1e-5)  # y is up
    export_mesh(source_of(format="glb"), tmp_path)
    assert len(trimesh.load(tmp_path / "mesh.glb", force="mesh").faces) > 5000


def test_a_glb_has_the_up_that_is_given(tmp_path):
    vertices = []
    for name, up in (("plus", "+z"), ("minus", "-z")):
        (tmp_path / name).mkdir()
        export_mesh(source_of(format="glb", up=up), tmp_path / name)
        vertices.append(trimesh.load(tmp_path / name / "mesh.glb", force="mesh").vertices)
    assert vertices[0][:, 1].mean() == pytest.approx(CENTER[2], abs=0.05)
    assert vertices[1][:, 1].mean() == pytest.approx(-CENTER[2], abs=0.05)


def test_a_mesh_is_decimated_on_request(tmp_path):
    export_mesh(source_of(max_faces=500), tmp_path)
    mesh = trimesh.load(tmp_path / "mesh.ply")
    assert 400 < len(mesh.faces) <= 500 and np.abs(radii(mesh.vertices) - IN_FILE).mean() < VOXEL
    assert np.ptp(np.asarray(mesh.visual.vertex_colors)[:, 0]) > 200


def test_files_have_the_texture(tmp_path):
    lines = []
    for suffix in ("glb", "obj"):
        export_mesh(source_of(format=suffix, texture=256, max_faces=1000, up="+z", say=lines.append), tmp_path)
    assert "a texture of 256 x 256" in lines[0]
    content = (tmp_path / "mesh.glb").read_bytes()
    tree = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    assert tree["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}
    assert tree["extensionsUsed"] == ["KHR_materials_unlit"]
    assert {path.name for path in tmp_path.iterdir()} == {"mesh.glb", "mesh.obj", "mesh.mtl", "mesh.png"}
    assert "Kd 1.0" in (tmp_path / "mesh.mtl").read_text()
    assert Image.open(tmp_path / "mesh.png").size == (256, 256)
    for suffix, y in (("glb", lambda x: -x[:, 2]), ("obj", lambda x: x[:, 1])):  # the run's x; z is up in the files
        mesh = trimesh.load(tmp_path / f"mesh.{suffix}", force="mesh", process=False)
        assert len(mesh.faces) <= 1000
        rgb = np.asarray(mesh.visual.to_color().vertex_colors)[:, :3]
        side = y(mesh.vertices) - CENTER[1]
        assert (rgb[side > 0.1, 0] > 200).all() and (rgb[side < -0.1, 1] > 200).all()


def test_surfaces_that_no_view_sees_are_absent(images):
    """From one side, there is half a ball."""
    front = [image for image in images if image.camera.to_world[2, 3] > CENTER[2] + 2]
    box = np.stack([CENTER - 1.2, CENTER + 1.2])
    vertices, faces = level_set(fuse(front, box, 32))
    assert len(faces) and vertices[:, 2].min() > CENTER[2] - 0.8
    fused = fuse(front, box, 32)
    closed = trimesh.Trimesh(*level_set(fused, solid_field(front, fused)))
    assert closed.is_watertight and closed.volume > 4 / 3 * np.pi * IN_FILE**3  # with what the ball hides


def test_pieces_and_an_empty_box(tmp_path):
    faces = np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4], [5, 6, 7]])
    assert keep_large_pieces(faces, 0.5).tolist() == [True] * 3 + [False]
    with pytest.raises(ValueError, match="no surface is in the box.*--box"):
        export_mesh(source_of(box=(0, 0, 0, 0.1, 0.1, 0.1)), tmp_path)
    with pytest.raises(ValueError, match="needs about .* smaller --resolution"):
        base.check_memory(1e12, 1e9, "give a smaller --resolution")


def test_points_have_normals_and_colors(tmp_path):
    export_points(source_of(num_points=300), tmp_path)
    cloud = trimesh.load(tmp_path / "points.ply")
    assert 200 < len(cloud.vertices) <= 300
    assert np.abs(radii(cloud.vertices) - IN_FILE).max() < 0.05
    data = cloud.metadata["_ply_raw"]["vertex"]["data"]
    normals = np.stack([data[name] for name in ("nx", "ny", "nz")], axis=-1).reshape(-1, 3)
    outwards = (cloud.vertices - CENTER) / radii(cloud.vertices)[:, None]
    assert (normals * outwards).sum(axis=-1).min() > 0.9
    assert np.asarray(cloud.visual.vertex_colors)[:, 2].max() < 10


def test_thinned_keeps_at_most_so_many():
    points = np.random.default_rng(0).normal(size=(1000, 3))
    assert len(thinned(points, 1000)) == 1000
    assert 80 < len(thinned(points, 100)) <= 100 and len(thinned(0 * points, 5)) == 1


def test_splats_look_like_the_scene(images, tmp_path, monkeypatch):
    lines, said, stage = [], [], stages.stage
    monkeypatch.setattr(stages, "stage", lambda text: said.append(text) or stage(text))
    export_splats(source_of(num_points=3000, fit_steps=0, say=lines.append), tmp_path)
    data = trimesh.load(tmp_path / "splats.ply").metadata["_ply_raw"]["vertex"]["data"]
    assert data.dtype.names == (
        *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(24)),  # readers find degree 2 by this number
        *("opacity", "scale_0", "scale_1", "scale_2"),
        *(f"rot_{i}" for i in range(4)),
    )
    assert "PSNR" in lines[0]
    scored = [f"scoring the {each}, by images" for each in ("splats", "splats", "run")]
    assert said == ["selecting points", "evaluating colours from all directions", *scored]
    read = splats_of(data)
    image = images[3]
    drawn = gaussians.rasterize(read, image.camera)
    error = np.mean((np.clip(drawn, 0, 1) - image.rgb / 255.0) ** 2)
    assert -10 * np.log10(error) > 18


def test_splats_are_scored_over_the_color_behind_the_scene():
    """The views are black, and far away Gaussians cover none of them."""
    none = gaussians.Gaussians(
        np.full((1, 3), 1e4), np.float64([[1, 0, 0, 0]]), np.full((1, 3), 1e-3), np.ones(1), np.zeros((1, 9, 3))
    )
    value, _ = score(source_of(background=(0.1, 0.1, 0.1)), none)
    np.testing.assert_allclose(value, 20, atol=1e-3)


def splats_of(data):
    """Returns the Gaussians that a file holds, of harmonics of degree 0."""
    columns = {name: np.asarray(data[name], np.float64).reshape(-1) for name in data.dtype.names}

    def stack(*names):
        return np.stack([columns[name] for name in names], axis=-1)

    harmonics = np.zeros((len(data), 9, 3))
    harmonics[:, 0] = stack("f_dc_0", "f_dc_1", "f_dc_2")
    return gaussians.Gaussians(
        stack("x", "y", "z"),
        stack("rot_0", "rot_1", "rot_2", "rot_3"),
        np.exp(stack("scale_0", "scale_1", "scale_2")),
        1 / (1 + np.exp(-columns["opacity"])),
        harmonics,
    )


def test_the_rasterizer_composites_by_depth():
    """Two Gaussians one behind the other: the colour of the middle pixel follows from both opacities."""
    camera = Camera(
        to_world=np.eye(3, 4), focal=np.float32([50, 50]), center=np.float32([8.5, 8.5]), height=17, width=17
    )
    harmonics = np.zeros((2, 9, 3))
    harmonics[:, 0] = (np.array([[1, 0, 0], [0, 1, 0]]) - 0.5) / 0.28209479
    pair = gaussians.Gaussians(
        mean=np.array([[0, 0, -4.0], [0, 0, -2.0]]),
        rotation=np.tile([1.0, 0, 0, 0], (2, 1)),
        scale=np.full((2, 3), 0.1),
        opacity=np.array([0.8, 0.5]),
        harmonics=harmonics,
    )
    image = gaussians.rasterize(pair, camera, np.array([0, 0, 1.0]))
    np.testing.assert_allclose(image[8, 8], [0.5 * 0.8, 0.5, 0.5 * 0.2], atol=1e-6)
    np.testing.assert_allclose(image[0, 0], [0, 0, 1], atol=0.02)
    variance = (50 * 0.1 / 2) ** 2 + 0.3  # of the near one, px^2
    np.testing.assert_allclose(image[8, 10, 1], 0.5 * np.exp(-(2**2) / 2 / variance), atol=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"resolution": 4096}, "--resolution is 4096, expected from 16 to 1,024"),
        ({"up": "z"}, "--up is 'z', expected one of .*; correct it"),
        ({"texture": 256}, "texture is 256 and format is 'ply', expected 'glb' or 'obj'"),
        ({"texture": 9000, "format": "glb"}, "--texture is 9000, expected from 64 to 8,192, or 0; correct it"),
        ({"split": True}, "--split is no field, expected one of"),
        ({"min_piece": 2.0}, "min_piece is 2.0"),
        ({"size": 5}, "size is 5"),
        ({"format": "stl"}, "format is 'stl', expected one of .*'glb', 'obj'"),
        ({"box": (0, 0, 0, 1, 1)}, r"box is \(0, 0, 0, 1, 1\), expected six numbers"),
        ({"box": (0, 0, 0, 1, 1, 0)}, "each lower one below"),
    ],
)
def test_settings_out_of_range_are_named(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        export_run(tmp_path, "mesh", **change)


@pytest.fixture
def workdir(monkeypatch, tmp_path):
    """A workdir whose run is that of the sources; `registered` exports of the kind "test" are called."""
    source = source_of()
    source.run.experiment.model.grid_schedule = ()
    monkeypatch.setattr(base, "restore_run", lambda workdir, **options: source.run)
    return tmp_path


def test_an_export_is_whole_or_absent(workdir, monkeypatch):
    content, fail = ["first"], [True]

    def export(source, folder):
        (folder / "file.txt").write_text(content[0])
        if fail[0]:
            raise OSError(28, "No space left on device")

    monkeypatch.setitem(base.EXPORTERS._parts, "test", Exporter(export))
    with pytest.raises(OSError, match="No space"):
        export_run(workdir, "test")
    assert list((workdir / "exports").iterdir()) == []
    fail[0] = False
    assert export_run(workdir, "test") == workdir / "exports" / "test-7"
    content[0] = "second"
    with pytest.raises(ValueError, match="test-7: exists already; give --overwrite"):
        export_run(workdir, "test")
    fail[0] = True
    with pytest.raises(OSError, match="No space"):
        export_run(workdir, "test", overwrite=True)
    assert (workdir / "exports" / "test-7" / "file.txt").read_text() == "first"
    fail[0] = False
    export_run(workdir, "test", overwrite=True)
    assert (workdir / "exports" / "test-7" / "file.txt").read_text() == "second"
    assert [path.name for path in (workdir / "exports").iterdir()] == ["test-7"]
    with pytest.raises(ValueError, match="expected a plain file name"):
        export_run(workdir, "test", name="../out")


def test_a_run_that_cannot_be_exported_is_refused_before_its_grid_is_extracted(monkeypatch, tmp_path):
    source, calls = source_of(), []

    def restore(workdir, **options):
        calls.append(options.get("settings"))
        return source.run

    def check(run):
        assert run is source.run
        raise ValueError("has no colours")

    monkeypatch.setattr(base, "restore_run", restore)
    source.run.experiment.model.grid_schedule = None
    monkeypatch.setitem(base.EXPORTERS._parts, "test", Exporter(lambda source, folder: None, check))
    with pytest.raises(ValueError, match="has no colours"):
        export_run(tmp_path, "test")
    assert calls == [None] and not list(tmp_path.iterdir())
    assert base.EXPORTERS.get("web").check is not None


@pytest.mark.parametrize(
    "kind, flag, kinds", [("points", "--format=obj", "mesh"), ("depth", "--num_points=5", "points or --kind=splats")]
)
def test_flags_of_other_kinds_are_refused(tmp_path, kind, flag, kinds):
    code, _, err = run_forked("export", f"--workdir={tmp_path}", f"--kind={kind}", flag)
    expected = f"error: {flag.partition('=')[0]} is given and --kind={kind}, expected --kind={kinds}; drop it"
    assert code == 1 and err.startswith(expected)
