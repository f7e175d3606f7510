"""The COLMAP reader: equal results of binary and text, pycolmap's numbers, every lens, and errors of files."""

import struct
import tracemalloc
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import compiled
from jaxnerf.core.cameras import project
from jaxnerf.data.readers import base as readers
from jaxnerf.data.readers import colmap
from jaxnerf.data.readers.validation import check_inside

NAMES = ("side/c 1.jpg", "b.png", "a.jpg")
BROWN = (0.05, -0.02, 0.003, -0.004)
ANGLES = (0.04, 0.03, 0.02, 0.01)
LENSES = [  # COLMAP's number and name, parameters after its centre, lens and distortion of Camera
    (0, "SIMPLE_PINHOLE", (), "pinhole", None),
    (1, "PINHOLE", (), "pinhole", None),
    (2, "SIMPLE_RADIAL", BROWN[:1], "opencv", (0.05, 0, 0, 0)),
    (3, "RADIAL", BROWN[:2], "opencv", (0.05, -0.02, 0, 0)),
    (4, "OPENCV", BROWN, "opencv", BROWN),
    (5, "OPENCV_FISHEYE", ANGLES, "fisheye", ANGLES),
    (6, "FULL_OPENCV", (*BROWN, 0.01, 0, 0, 0), "opencv", (*BROWN, 0.01)),
    (8, "SIMPLE_RADIAL_FISHEYE", ANGLES[:1], "fisheye", (0.04, 0, 0, 0)),
    (9, "RADIAL_FISHEYE", ANGLES[:2], "fisheye", (0.04, 0.03, 0, 0)),
    (14, "SIMPLE_FISHEYE", (), "fisheye", (0, 0, 0, 0)),
    (15, "FISHEYE", (), "fisheye", (0, 0, 0, 0)),
]


def model():
    """Returns cameras, images and points, their ids unordered; -1 is an observation without a point."""
    rng = np.random.default_rng(0)
    cameras = [
        (7, 1, "PINHOLE", 64, 48, (90.5, 91.25, 32.0, 24.0)),
        (3, 2, "SIMPLE_RADIAL", 48, 64, (80.0, 24.0, 32.0, 0.01)),
    ]
    images, ids = [], ((12, -1, 5), (), (900, 5, 5, -1))
    for index, name in enumerate(NAMES):
        turn = rng.normal(size=4)
        motion = (*turn / np.linalg.norm(turn), *rng.normal(size=3))
        seen = [(*rng.uniform(0, 48, 2), id) for id in ids[index]]
        images.append((10 - index, motion, (7, 3, 7)[index], name, seen))
    tracks = {900: (8, 0), 5: (10, 2, 8, 1, 8, 2), 12: (10, 0)}
    points = [(id, rng.normal(size=3), (1, 2, 3), 0.5, track) for id, track in tracks.items()]
    return cameras, images, points


def binary(cameras, images, points):
    """Returns the contents of the three binary files."""
    first, second, third = (struct.pack("<Q", len(entries)) for entries in (cameras, images, points))
    for key, number, _, width, height, params in cameras:
        first += struct.pack(f"<IiQQ{len(params)}d", key, number, width, height, *params)
    for key, motion, camera, name, seen in images:
        second += struct.pack("<I7dI", key, *motion, camera) + name.encode() + b"\0"
        second += struct.pack("<Q", len(seen)) + b"".join(struct.pack("<ddq", *row) for row in seen)
    for key, place, color, error, track in points:
        third += struct.pack("<Q3d3BdQ", key, *place, *color, error, len(track) // 2)
        third += struct.pack(f"<{len(track)}I", *track)
    return {"cameras.bin": first, "images.bin": second, "points3D.bin": third}


def text(cameras, images, points):
    """Returns the contents of the three text files."""

    def line(*values):
        words = (value if isinstance(value, str | int) else repr(float(value)) for value in values)
        return " ".join(map(str, words)) + "\n"

    first, second, third = ("# a comment\n#   X, Y\n\n" for _ in range(3))
    for key, _, name, width, height, params in cameras:
        first += line(key, name, width, height, *params)
    for key, motion, camera, name, seen in images:
        second += line(key, *motion, camera, name) + line(*(value for row in seen for value in row))
    for key, place, color, error, track in points:
        third += line(key, *place, *color, error, *track)
    return {"cameras.txt": first.encode(), "images.txt": second.encode(), "points3D.txt": third.encode()}


def put(folder, contents, *, base="sparse/0", images=NAMES):
    (folder / base).mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        (folder / base / name).write_bytes(content)
    for name in images:
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "images" / name).touch()
    return folder


def to_world(motion):
    """Returns camera -> world [3, 4] in the axes of Camera, computed differently than by the reader."""
    (w, *axis), to_camera = motion[:4], np.eye(4)
    axis = np.array(axis)
    across = np.cross(axis, np.eye(3)).T  # across @ x = axis x x
    to_camera[:3, :3] += 2 * w * across + 2 * across @ across
    to_camera[:3, 3] = motion[4:]
    return (np.linalg.inv(to_camera) @ np.diag([1, -1, -1, 1]))[:3]


def assert_same(got, want):
    np.testing.assert_array_equal(got.points, want.points)
    for a, b in zip(got.frames, want.frames, strict=True):
        assert (a.name, a.image, a.camera.lens) == (b.name, b.image, b.camera.lens)
        jax.tree.map(np.testing.assert_array_equal, (a.camera, a.seen, a.seen_at), (b.camera, b.seen, b.seen_at))


@pytest.mark.parametrize("write", [binary, text])
def test_a_small_model_is_read_as_it_was_written(tmp_path, write):
    cameras, images, points = model()
    capture = colmap.read_capture(put(tmp_path, write(cameras, images, points)))
    assert (capture.format, capture.source) == ("colmap", tmp_path / "sparse" / "0")
    assert (capture.splits, capture.box, capture.notes) == (None, None, ())
    assert [frame.name for frame in capture.frames] == ["a", "b", "side/c 1"]
    places = {key: place for key, place, *_ in points}
    np.testing.assert_array_equal(capture.points, [places[key] for key in (5, 12, 900)])
    for frame, (_, motion, camera, name, seen) in zip(capture.frames, images[::-1], strict=True):
        assert frame.image == tmp_path / "images" / name
        assert (frame.mask, frame.bounds) == (None, None)
        assert frame.camera.to_world.dtype == np.float64
        np.testing.assert_allclose(frame.camera.to_world, to_world(motion), atol=1e-14)
        assert (frame.camera.height, frame.camera.width) == ((48, 64) if camera == 7 else (64, 48))
        kept = [(*places[row[2]], *row[:2]) for row in seen if row[2] != -1]
        found = np.concatenate([capture.points[frame.seen], frame.seen_at], axis=-1)
        np.testing.assert_array_equal(found, np.reshape(kept, (-1, 5)))


@pytest.fixture
def pycolmap():
    """The library, imported here because its handlers of fatal signals would hide in which test another one crashes."""
    import pycolmap

    return pycolmap


def test_binary_text_and_pycolmaps_text_agree(tmp_path, pycolmap):
    want = colmap.read_capture(put(tmp_path, binary(*model())))
    pycolmap.Reconstruction(str(want.source)).write_text(str(want.source))
    for file in want.source.glob("*.bin"):
        file.unlink()
    from_pycolmap = colmap.read_capture(tmp_path)
    assert {file.name for file in want.source.iterdir()} > {"rigs.txt", "frames.txt"}  # ignored
    assert_same(from_pycolmap, want)
    assert_same(colmap.read_capture(put(tmp_path, text(*model()))), want)
    put(tmp_path, {name: b"garbage" for name in text(*model())})
    assert_same(colmap.read_capture(put(tmp_path, binary(*model()))), want)  # binary files take precedence


@pytest.mark.parametrize("number, name, rest, lens, distortion", LENSES, ids=[row[1] for row in LENSES])
def test_every_lens_agrees_with_colmap(tmp_path, pycolmap, number, name, rest, lens, distortion):
    """Projections are COLMAP's, including the position of pixel centres."""
    known = pycolmap.Camera.create_from_model_name(1, name, 90.0, 64, 48)
    count = len(known.params) - len(rest) - 2
    known.params = [*(90.0, 95.0)[:count], 31.0, 25.0, *rest]
    _, images, points = model()
    images = [(*image[:2], 1, *image[3:]) for image in images]
    contents = binary([(1, number, name, 64, 48, known.params)], images, points)
    camera = colmap.read_capture(put(tmp_path, contents)).frames[0].camera
    assert camera.lens == lens and (camera.distortion is None) == (distortion is None)
    np.testing.assert_array_equal(camera.focal, [90, 95 if count == 2 else 90])
    np.testing.assert_array_equal(camera.center, [31, 25])
    if distortion is not None:
        np.testing.assert_array_equal(camera.distortion, distortion)
    local = np.random.default_rng(1).uniform([-0.4, -0.3, 1], [0.4, 0.3, 1], (50, 3))
    world = local * [1, -1, -1] @ camera.to_world[:, :3].T + camera.to_world[:, 3]
    pixels, depth = compiled(project)(camera, world)
    np.testing.assert_allclose(pixels, known.img_from_cam(local), atol=1e-4)  # of float32
    np.testing.assert_allclose(depth, 1, atol=1e-5)


@pytest.mark.parametrize(
    "number, params, message",
    [
        (6, (90, 95, 31, 25, *BROWN, 0.01, 0, 0.1, 0), r"FULL_OPENCV has k4, k5, k6 = .*image_undistorter"),
        (7, (90, 95, 31, 25, 0.1), "FOV is not supported.*image_undistorter"),
        (10, (90, 95, 31, 25, *[0.1] * 8), "THIN_PRISM_FISHEYE is not supported.*image_undistorter"),
        (17, (64, 48), "EQUIRECTANGULAR is not supported.*; panoramas are not read: .*panorama_sfm.py"),
        (99, (), "model number 99, expected 0 to 17.*image_undistorter"),
        (1, (0, 95, 31, 25), "focal length"),
        (1, (90, np.nan, 31, 25), "focal length"),
        (1, (90, 95, np.inf, 25), "finite"),
    ],
)
def test_unsupported_cameras_are_errors(tmp_path, number, params, message):
    cameras, images, points = model()
    cameras[0] = (7, number, "", 64, 48, params)
    with pytest.raises(ValueError, match=f"cameras.bin, camera 7: .*{message}"):
        colmap.read_capture(put(tmp_path, binary(cameras, images, points)))


@pytest.mark.parametrize(
    "name, todo", [("EQUIRECTANGULAR", "panorama"), ("SPHERICAL", "panorama"), ("NEW", "undistort")]
)
def test_the_advice_for_a_camera_model_leads_somewhere(tmp_path, name, todo):
    """COLMAP's undistorter copies panoramas and keeps their camera model."""
    folder = put(tmp_path, text(*model()))
    path = folder / "sparse/0/cameras.txt"
    others = [line for line in path.read_text().splitlines() if not line.startswith("7 ")]
    path.write_text("\n".join([f"7 {name} 64 48 64 48", *others]))
    with pytest.raises(ValueError, match=f"cameras.txt, line 1, camera 7: .*{name}") as error:
        colmap.read_capture(folder)
    assert todo in str(error.value) and ("image_undistorter" in str(error.value)) == (todo == "undistort")


@pytest.mark.parametrize("base", ["sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "."])
def test_the_model_is_found(tmp_path, base):
    assert not colmap.models_in(tmp_path)
    put(tmp_path, binary(*model()), base=base)
    assert colmap.read_capture(tmp_path).source == tmp_path / base


def test_images_may_be_in_the_folder_itself(tmp_path):
    put(tmp_path, text(*model()))
    for file in (tmp_path / "images").iterdir():
        file.rename(tmp_path / file.name)
    (tmp_path / "images").rmdir()
    assert colmap.read_capture(tmp_path).frames[2].image == tmp_path / "side" / "c 1.jpg"


@pytest.mark.parametrize("write", [binary, text])
def test_of_several_models_the_one_with_most_images_is_read_and_noted(tmp_path, write):
    cameras, images, points = model()
    put(tmp_path, write(cameras, images[:2], points))
    put(tmp_path, write(cameras, images, points), base="sparse/1")
    put(tmp_path, write(cameras, images[:1], points), base="sparse/10")
    capture = colmap.read_capture(tmp_path)
    assert capture.source == tmp_path / "sparse" / "1"
    assert len(capture.frames) == 3
    assert len(capture.notes) == 1 and capture.notes[0].endswith("other models skipped: 0, 10")


def test_missing_images_are_skipped_and_noted(tmp_path):
    cameras, images, points = model()
    images = [(index, *images[0][1:3], f"{index:02}.jpg", images[0][4]) for index in range(12)]
    contents = binary(cameras, images, points)
    capture = colmap.read_capture(put(tmp_path, contents, images=[f"{k:02}.jpg" for k in range(6)]))
    assert [frame.name for frame in capture.frames] == [f"{k:02}" for k in range(6)]
    names = "'06.jpg', '07.jpg', '08.jpg', '09.jpg', '10.jpg', ..."
    assert len(capture.notes) == 1 and f"lacks 6 of 12 images of {tmp_path}" in capture.notes[0]
    assert names in capture.notes[0]
    (tmp_path / "images" / "00.jpg").unlink()
    with pytest.raises(ValueError, match="images: lacks 7 of 12 images .* expected at least half"):
        colmap.read_capture(tmp_path)


def test_points_may_be_deleted_but_not_another_models(tmp_path):
    cameras, images, points = model()
    capture = colmap.read_capture(put(tmp_path, binary(cameras, images, points[:1])))
    assert [len(frame.seen) for frame in capture.frames] == [1, 0, 0] and len(capture.points) == 1
    assert len(capture.notes) == 1 and "lacks the points of 4 observations" in capture.notes[0]
    with pytest.raises(ValueError, match="points3D.bin: has none of the points that images.bin refers to"):
        colmap.read_capture(put(tmp_path, binary(cameras, images, [(4, *points[0][1:])])))
    images = [(*image[:4], []) for image in images]
    put(tmp_path, binary(cameras, images, []) | {"points3D.bin": struct.pack("<Q", 0)})
    unknown = colmap.read_capture(tmp_path)
    assert unknown.points is None and unknown.notes == ()
    assert all(frame.seen is None and frame.seen_at is None for frame in unknown.frames)


@pytest.mark.parametrize("write", [binary, text])
@pytest.mark.parametrize("beside", [None, "points3D.ply"])
def test_a_model_without_points_is_read_with_a_note(tmp_path, write, beside):
    """The observations of points that are not there are dropped, as if the file of points were empty."""
    put(tmp_path, write(*model()))
    expected = colmap.read_capture(tmp_path).frames
    next((tmp_path / "sparse" / "0").glob("points3D*")).unlink()
    if beside:
        (tmp_path / "sparse" / "0" / beside).touch()
    capture = colmap.read_capture(tmp_path)
    assert capture.points is None and all(frame.seen is None for frame in capture.frames)
    jax.tree.map(np.testing.assert_array_equal, [f.camera for f in capture.frames], [f.camera for f in expected])
    assert len(capture.notes) == 1 and "no such file" in capture.notes[0]
    assert (f"{beside} is not read" in capture.notes[0]) == (beside is not None)


def test_points_may_be_of_the_other_kind(tmp_path):
    put(tmp_path, text(*model()))
    expected = colmap.read_capture(tmp_path)
    (tmp_path / "sparse" / "0" / "points3D.txt").unlink()
    (tmp_path / "sparse" / "0" / "points3D.bin").write_bytes(binary(*model())["points3D.bin"])
    assert_same(colmap.read_capture(tmp_path), expected)


@pytest.mark.parametrize("names", [NAMES, ("1", "2 3 4", "5.5"), ("4.jpg", "a 1 2", "7 8 b")])
@pytest.mark.parametrize("kept", [(), (0,), (1,), (0, 2)])
def test_lines_of_observations_may_be_absent(tmp_path, names, kept):
    """Images of the lines in `kept` have observations, the others neither these nor an empty line."""
    cameras, images, points = model()
    seen = [(1.5, 2.0, 5), (3.0, 4.0, 900), (7.0, 8.0, 12)]
    images = [
        (*image[:3], name, seen if index in kept else [])
        for index, (image, name) in enumerate(zip(images, names, strict=True))
    ]
    if names[1] == "2 3 4":
        images[1] = (*images[1][:3], "2 3 x", images[1][4])  # three numbers in its place would be observations
    contents = text(cameras, images, points)
    files = [image[3] for image in images]
    expected = colmap.read_capture(put(tmp_path / "whole", contents, images=files))
    contents["images.txt"] = contents["images.txt"].replace(b"\n\n", b"\n")
    assert_same(colmap.read_capture(put(tmp_path / "short", contents, images=files)), _moved(expected, tmp_path))
    assert colmap.count_images(tmp_path / "short" / "sparse" / "0") == 3


def _moved(capture, folder):
    """Returns a Capture of whole/ as if it were of short/."""
    frames = [
        frame._replace(image=folder / "short" / frame.image.relative_to(folder / "whole")) for frame in capture.frames
    ]
    return capture._replace(frames=tuple(frames))


@pytest.mark.parametrize("base", ["dense/0/sparse", "dense/sparse", "dense/1/sparse"])
def test_the_undistorters_models_have_images_of_their_own(tmp_path, base):
    put(tmp_path, text(*model()), base=base)  # originals in images/
    own = (tmp_path / base).parent / "images"
    for name in NAMES:
        (own / name).parent.mkdir(parents=True, exist_ok=True)
        (own / name).touch()
    capture = readers.read_capture(tmp_path)
    assert capture.format == "colmap" and capture.source == tmp_path / base
    assert [frame.image for frame in capture.frames] == [own / name for name in sorted(NAMES)]
    put(tmp_path, text(*model()))
    assert colmap.read_capture(tmp_path).source == tmp_path / "sparse" / "0"


def test_of_several_undistorted_models_the_largest_is_read(tmp_path):
    cameras, images, points = model()
    for number, count in enumerate((2, 3, 1)):
        put(tmp_path, text(cameras, images[:count], points), base=f"dense/{number}/sparse")
    (tmp_path / "dense" / "1" / "images").symlink_to(tmp_path / "images")
    capture = colmap.read_capture(tmp_path)
    assert capture.source == tmp_path / "dense" / "1" / "sparse" and len(capture.frames) == 3
    assert capture.notes[0].endswith("other models skipped: 0/sparse, 2/sparse")


def test_names_may_begin_with_images_or_differ_in_case(tmp_path):
    cameras, images, points = model()
    put(tmp_path, text(cameras, images, points))
    expected = colmap.read_capture(tmp_path)
    for change, notes in ((lambda name: f"images/{name}", 0), (lambda name: name.swapcase(), 1)):
        stated = [(*image[:3], change(image[3]), image[4]) for image in images]
        capture = colmap.read_capture(put(tmp_path, text(cameras, stated, points)))
        assert_same(capture, expected)
        assert len(capture.notes) == notes and not notes or "3 paths differ from the files" in capture.notes[0]


def test_converted_images_are_named(tmp_path):
    put(tmp_path, text(*model()), images=["a.png", "b.webp"])
    with pytest.raises(ValueError, match=r"lacks 3 of 3 images .*images/a.png nearly fits 'a.jpg': rename it"):
        colmap.read_capture(tmp_path)


@pytest.mark.parametrize("name", ["/etc/passwd", "../a.jpg", "side/../../a.jpg", ".."])
def test_a_name_that_leaves_the_folder_is_an_error(tmp_path, name):
    cameras, images, points = model()
    images[1] = (*images[1][:3], name, [])
    with pytest.raises(ValueError, match=r"images.bin, image 9: its name .* leaves the folder"):
        colmap.read_capture(put(tmp_path, binary(cameras, images, points)))
    assert check_inside("./side/../a.jpg", key="", source="") == "a.jpg"


def entry(kind, index, field, value):
    """Returns a model with one field of one entry changed; kind 0 is a camera, 1 an image, 2 a point."""
    parts = model()
    row = list(parts[kind][index])
    row[field] = value
    parts[kind][index] = tuple(row)
    return parts


@pytest.mark.parametrize(
    "parts, message",
    [
        (entry(0, 1, 0, 7), "cameras.*camera 7: occurs twice"),
        (entry(0, 0, 3, 0), "cameras.*camera 7: is 0 x 48"),
        (entry(0, 0, 4, 2**40), "cameras.*camera 7: is 64 x 1099511627776"),
        (entry(1, 0, 1, (0.5,) * 3 + (0.6,) + (0,) * 3), "images.*image 10, 'side/c 1.jpg': .*length 1.054"),
        (entry(1, 0, 1, (0,) * 7), "images.*image 10.*length 0,"),
        (entry(1, 0, 1, (np.nan,) * 7), "images.*image 10: quaternion is not finite"),
        (entry(1, 0, 1, (1, 0, 0, 0, 0, np.inf, 0)), "images.*image 10: translation is not finite"),
        (entry(1, 0, 2, 4), "images.*image 10: has camera 4, which cameras.... lacks"),
        (entry(1, 0, 3, "a.jpg"), "images.*image 8: 'a.jpg' occurs twice"),
        (entry(1, 0, 4, [(np.nan, 1.0, 5)]), "images.*image 10: seen_at is not finite"),
        (entry(2, 0, 0, 5), "points3D.*an id twice"),
        (entry(2, 0, 1, (0, np.inf, 0)), "points3D.*point 900 is not finite"),
        ((model()[0], [], model()[2]), "images.*holds no image"),
    ],
)
def test_errors_of_the_numbers(tmp_path, parts, message):
    for write in (text, binary):
        with pytest.raises(ValueError, match=message) as caught:
            colmap.read_capture(put(tmp_path, write(*parts)))
        assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("cameras.txt", b"7 PINHOLE 64", "line 1: is '7 PINHOLE 64', expected CAMERA_ID"),
        ("cameras.txt", b"# x\n7 FISH 64 48 1", "line 2, camera 7: model 'FISH'"),
        ("cameras.txt", b"7 PINHOLE 64 48 90 90 32", "line 1: is '90 90 32', expected 4 PARAMS of PINHOLE"),
        (
            "cameras.txt",
            b"7 PINHOLE 64 48 90 90 32 24 1",
            "line 1: is '1', expected 4 PARAMS of PINHOLE and no",
        ),
        ("cameras.txt", b"", "has camera 7, which cameras.txt lacks"),
        ("images.txt", b"\xff\xfe", "is no UTF-8 text"),
        ("images.txt", b"", "holds no image"),
        ("images.txt", b"1 1 0 0 0 0 0 0 7\n", "line 1: .* expected IMAGE_ID .* NAME"),
        ("images.txt", b"1 1 0 0 0 0 0 0 7 a.jpg\n1 2", "line 1: .* in threes on the next line"),
        ("images.txt", b"1 1 0 0 0 0 0 0 7 a.jpg\n1 2 x", "line 1: .* in threes on the next line"),
        ("images.txt", b"1 1 0 0 0 0 0 0 7 a.jpg\n1 2 " + b"9" * 20, "line 1: .* in threes"),
        ("points3D.txt", b"5 1 2 3 4 5 6", "line 1: is '5 1 2 3 4 5 6', expected POINT3D_ID"),
        ("points3D.txt", b"9" * 20 + b" 1 2 3 4 5 6 7", "line 1: is '9"),
        ("points3D.txt", b"-5 1 2 3 4 5 6 7", "negative id"),
        ("points3D.txt", b"", "has none of the points that images.txt refers to"),
    ],
)
def test_errors_of_a_text_file(tmp_path, name, content, message):
    put(tmp_path, text(*model()))
    path = tmp_path / "sparse" / "0" / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        colmap.read_capture(tmp_path)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_a_folder_without_a_model_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="expected a COLMAP model; correct the folder"):
        colmap.read_capture(tmp_path)


@pytest.mark.parametrize("base", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_an_incomplete_model_is_reported(tmp_path, base):
    put(tmp_path, {name: content for name, content in binary(*model()).items() if name != "images.bin"}, base=base)
    message = r"has cameras.bin and points3D.bin but no images.bin, expected all files of a COLMAP model"
    for format in ("auto", "colmap"):
        with pytest.raises(ValueError, match=message) as caught:
            readers.read_capture(tmp_path, format)
        assert str(caught.value).startswith(str(tmp_path / base))


def read_damaged(folder, name, content):
    """Returns whether a model with one changed file is read; checks that an error is one line with the file's name."""
    path = folder / "sparse" / "0" / name
    whole = path.read_bytes()
    try:
        path.write_bytes(content)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            colmap.read_capture(folder)
        return True
    except ValueError as error:
        assert name in str(error) and len(str(error).splitlines()) == 1, str(error)
        return False
    finally:
        path.write_bytes(whole)


WHOLE = binary(*model()) | text(*model())


@pytest.fixture(scope="module", params=[".bin", ".txt"])
def damaged(request, tmp_path_factory):
    """Returns (folder, extension) of a model whose files a test may damage one after the other."""
    contents = {name: content for name, content in WHOLE.items() if name.endswith(request.param)}
    return put(tmp_path_factory.mktemp("damaged"), contents), request.param


def test_a_file_that_ends_early_or_late_is_an_error(damaged):
    """A text file that ends after a complete line is not detected."""
    folder, extension = damaged
    for name, whole in WHOLE.items():
        if name.endswith(extension):
            sizes = range(0, len(whole), 1 if extension == ".bin" else 7)
            reads = [read_damaged(folder, name, whole[:size]) for size in sizes]
            assert not any(reads) or extension == ".txt"
            assert read_damaged(folder, name, whole)
            assert not read_damaged(folder, name, whole + b"\0")


@settings(deadline=None, max_examples=150)
@given(data=st.data())
def test_changed_bytes_are_read_or_an_error(damaged, data):
    folder, extension = damaged
    name = data.draw(st.sampled_from([name for name in WHOLE if name.endswith(extension)]))
    content = bytearray(WHOLE[name])
    places = st.integers(0, len(content) - 1)
    for place, value in data.draw(st.lists(st.tuples(places, st.integers(0, 255)), min_size=1, max_size=6)):
        content[place] = value
    read_damaged(folder, name, bytes(content))


@settings(deadline=None, max_examples=100)
@given(data=st.data(), garbage=st.binary(max_size=200))
def test_garbage_is_an_error_or_empty(damaged, data, garbage):
    folder, extension = damaged
    name = data.draw(st.sampled_from([name for name in WHOLE if name.endswith(extension)]))
    read_damaged(folder, name, garbage)


def counts():
    """Yields (file, byte) of every count in the binary files."""
    yield from ((name, 0) for name in ("cameras.bin", "images.bin", "points3D.bin"))
    images, at = model()[1], 8
    for image in images:
        at += 64 + len(image[3]) + 1
        yield "images.bin", at
        at += 8 + 24 * len(image[4])
    yield from (("points3D.bin", at) for at in (8 + 43, 67 + 43, 142 + 43))


@pytest.mark.parametrize("count", [2**64 - 1, 2**63, 2**40, 10**6])
def test_a_wrong_count_is_an_error_and_allocates_nothing(tmp_path, count):
    folder = put(tmp_path, binary(*model()))
    for name, at in counts():
        content = WHOLE[name][:at] + struct.pack("<Q", count) + WHOLE[name][at + 8 :]
        assert struct.unpack_from("<Q", WHOLE[name], at)[0] < 5, "this is no count"
        tracemalloc.start()
        assert not read_damaged(folder, name, content)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 1e6


@pytest.fixture
def real_can(scenes_dir, pycolmap):
    """The reader's and pycolmap's model of the real can."""
    folder = scenes_dir / "can"
    return colmap.read_capture(folder), pycolmap.Reconstruction(str(folder / "sparse" / "0"))


@pytest.mark.scenes("can")
def test_the_real_can_agrees_with_pycolmap_to_1e_9(real_can):
    capture, known = real_can
    assert len(capture.frames) == 71 and capture.notes == ()
    ids = sorted(known.points3D)
    np.testing.assert_array_equal(capture.points, [known.points3D[key].xyz for key in ids])
    images = {image.name: image for image in known.images.values()}
    assert {frame.image.name for frame in capture.frames} == set(images)
    for frame in capture.frames:
        image = images[frame.image.name]
        lens = known.cameras[image.camera_id]
        assert lens.model.name == "SIMPLE_RADIAL" and (lens.height, lens.width) == (1280, 720)
        assert (frame.camera.height, frame.camera.width) == (1280, 720)
        params = [frame.camera.focal[0], *frame.camera.center, frame.camera.distortion[0]]
        np.testing.assert_array_equal(params, lens.params)
        np.testing.assert_array_equal(frame.camera.distortion[1:], 0)
        moved = image.cam_from_world().inverse().matrix()  # in 4.2 a method, a property before
        np.testing.assert_allclose(frame.camera.to_world, moved * [1, -1, -1, 1], rtol=0, atol=1e-9)
        seen = [point for point in image.points2D if point.has_point3D()]
        np.testing.assert_array_equal(frame.seen, np.searchsorted(ids, [p.point3D_id for p in seen]))
        np.testing.assert_array_equal(frame.seen_at, [p.xy for p in seen])


@pytest.mark.scenes("can")
def test_the_real_cans_points_project_to_their_observations(real_can):
    """A mistake in poses, lens, axes or pixel centres moves the projections by half a pixel or more."""
    capture, known = real_can
    see = jax.jit(jax.vmap(project, in_axes=(0, None)))
    cameras = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(frame.camera for frame in capture.frames))
    pixels, depth = jax.tree.map(np.asarray, see(cameras, capture.points))
    frames = list(enumerate(capture.frames))
    off = np.concatenate([pixels[index, frame.seen] - frame.seen_at for index, frame in frames])
    assert all((depth[index, frame.seen] > 0).all() for index, frame in frames)
    assert np.median(np.linalg.norm(off, axis=-1)) < 1
    assert np.abs(np.median(off, axis=0)).max() < 0.1
    # COLMAP's figure is the mean over points of the mean over the images that show one.
    points = np.concatenate([frame.seen for frame in capture.frames])
    sums = np.bincount(points, np.linalg.norm(off, axis=-1))
    assert (sums / np.bincount(points)).mean() == pytest.approx(known.compute_mean_reprojection_error(), 1e-3)
