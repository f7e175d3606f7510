"""python -m jaxnerf.render: the files that it writes, their content, and how it resumes."""

import importlib.util
import json
import os
import shutil
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest

from jaxnerf import Camera, load_scene, rays_from_pixels, render_image
from jaxnerf.core.cameras import pixel_grid
from jaxnerf.evaluation import image_renderer, output_images
from jaxnerf.evaluation.paths import render_path as render_path_module
from runs import render_path, run_forked

pytest_plugins = ["run_fixtures"]
pytestmark = pytest.mark.usefixtures("unoptimized")

POSE = np.array([[1, 0, 0, 0.1], [0, 0, -1, -4.0], [0, 1, 0, 0.2], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def run(trained, tmp_path_factory):
    """A copy of the trained workdir with room for its renders."""
    return shutil.copytree(trained, tmp_path_factory.mktemp("render") / "run")


@pytest.fixture(scope="module")
def path_file(tmp_path_factory):
    """A path file: two frames of 25 x 17 px with another lens than the views'."""
    content = {"frames": [{"transform_matrix": POSE.tolist()}] * 2, "w": 25, "h": 17, "fl_x": 30}
    file = tmp_path_factory.mktemp("path") / "mine.json"
    file.write_text(json.dumps(content))
    return file


@pytest.fixture(scope="module")
def rendered(run, path_file):
    """What a call wrote: colour, depth and RGBA."""
    return render_path(run, path=str(path_file), rgba=True, depth=True, video="gif", settings={"chunk": 100})


def test_frames_videos_and_the_path_are_written_where_the_docstring_says(rendered, run):
    folder, *videos = rendered
    assert folder == run / "renders" / "mine-20"
    assert [file.name for file in videos] == ["mine-20.gif", "mine-20-depth.gif"]
    found = sorted(str(file.relative_to(folder)) for file in folder.rglob("*.*"))
    assert found == [
        *("color/0000.png", "color/0001.png", "depth/0000.png", "depth/0000.tiff"),
        *("depth/0001.png", "depth/0001.tiff", "path.json", "rgba/0000.png", "rgba/0001.png"),
    ]
    for file in videos:
        assert iio.imread(file, index=...).shape[-3:] == (17, 25, 3)


def test_predicted_errors_are_written_with_one_range_for_the_path(run, path_file):
    """A frame without its error is rendered again, and other errors are those of another provenance."""

    def predictor(restored):
        return SimpleNamespace(identity="fixed", error=lambda rays: 0.1 * np.abs(np.asarray(rays.viewdirs)[..., 0]))

    options = {"path": str(path_file), "name": "errors", "video": "gif", "settings": {"chunk": 100}}
    folder, *videos = render_path(run, predictor=predictor, **options)
    assert [file.name for file in videos] == ["errors-20.gif", "errors-20-uncertainty.gif"]
    errors, shown = (
        [iio.imread(folder / "uncertainty" / f"{i}.{end}") for i in ("0000", "0001")] for end in ("tiff", "png")
    )
    assert errors[0].dtype == np.float32 and errors[0].shape == (17, 25) and np.ptp(errors[0]) > 0.01
    largest = np.quantile(np.concatenate([np.ravel(error)[::17] for error in errors]), 0.99)
    np.testing.assert_allclose(shown[1] / 255, np.minimum(errors[1] / largest, 1), atol=0.003)
    (folder / "uncertainty" / "0000.tiff").write_bytes(b"damaged")
    render_path(run, predictor=predictor, **options)
    np.testing.assert_array_equal(iio.imread(folder / "uncertainty" / "0000.tiff"), errors[0])
    with pytest.raises(ValueError, match="uncertainty 'fixed', not None"):
        render_path(run, **options)


def test_frames_show_the_model_and_its_depth_through_the_lens_of_the_path_file(rendered, run):
    camera = Camera(to_world=np.float32(POSE[:3]), focal=np.float32([30, 30]), center=np.float32([12.5, 8.5]))
    rays = rays_from_pixels(camera, pixel_grid(17, 25), near=2.6, far=5.4)
    image = render_image(load_scene(run)[1], rays, chunk=100)
    color = iio.imread(rendered[0] / "color" / "0001.png")
    assert color.shape == (17, 25, 3)
    assert np.abs(color - 255 * np.asarray(image.rgb)).max() <= 0.5 + 1e-2
    depth = iio.imread(rendered[0] / "depth" / "0001.tiff")
    assert depth.dtype == np.float32
    expected = np.asarray(image.depth) * np.linalg.norm(rays.directions, axis=-1)
    np.testing.assert_allclose(depth, expected, rtol=1e-4)
    shades = iio.imread(rendered[0] / "depth" / "0001.png")
    assert shades.dtype == np.uint8 and shades.shape == (17, 25)
    assert (np.diff(shades.ravel()[np.argsort(depth.ravel())].astype(int)) <= 0).all(), "near is bright"


def test_the_time_left_is_estimated_after_the_first_frame(run, path_file, capsys):
    render_path(run, path=str(path_file), name="timed", video="none", settings={"chunk": 100})
    first, second = (line for line in capsys.readouterr().err.splitlines() if "frames of" in line)
    assert first.startswith("1/2") and " left" not in first
    assert second.startswith("2/2") and second.endswith("timed-20, 0:00 left")


def test_rgba_over_the_background_is_the_color(rendered):
    color = iio.imread(rendered[0] / "color" / "0000.png") / 255
    rgba = iio.imread(rendered[0] / "rgba" / "0000.png") / 255
    alpha = rgba[..., 3:]
    assert 0.05 < np.ptp(alpha), "not the same everywhere"
    np.testing.assert_allclose(rgba[..., :3] * alpha + (1 - alpha), color, atol=1.01 / 255)


def test_rgba_over_the_background_color_is_the_color(trained, path_file, tmp_path):
    run = shutil.copytree(trained, tmp_path / "run")
    content = json.loads((run / "config.json").read_text())
    content["data"]["background"], content["scene"]["background"] = "none", [0.2, 0.5, 1.0]
    (run / "config.json").write_text(json.dumps(content))
    (folder,) = render_path(run, path=str(path_file), rgba=True, video="none", settings={"chunk": 100})
    color, rgba = (iio.imread(folder / name / "0000.png") / 255 for name in ("color", "rgba"))
    behind = (1 - rgba[..., 3:]) * [0.2, 0.5, 1.0]
    assert behind.max() > 0.1, "some rays are transparent"
    np.testing.assert_allclose(rgba[..., :3] * rgba[..., 3:] + behind, color, atol=1.01 / 255)


def test_only_missing_frames_are_rendered(rendered, run, path_file, monkeypatch, capsys):
    folder = rendered[0]
    before = {file: file.stat().st_mtime_ns for file in folder.rglob("*") if "depth" not in str(file)}
    pixels = (folder / "color" / "0001.png").read_bytes()
    os.remove(folder / "color" / "0001.png")
    (folder / "color" / "0001.png.tmp").write_bytes(pixels[:40])  # as a kill leaves it
    calls = []
    render_image = image_renderer.render_image
    monkeypatch.setattr(image_renderer, "render_image", lambda *a, **k: calls.append(1) or render_image(*a, **k))
    options = {"path": str(path_file), "rgba": True, "video": "none", "settings": {"chunk": 100}}
    assert render_path(run, **options) == [folder]
    assert len(calls) == 1 and (folder / "color" / "0001.png").read_bytes() == pixels
    assert not list(folder.rglob("*.tmp"))
    for name in ("color/0000.png", "rgba/0000.png"):
        assert (folder / name).stat().st_mtime_ns == before[folder / name]
    render_path(run, **options)
    assert len(calls) == 1, "all frames exist"
    assert " left" not in capsys.readouterr().err, "one frame compiles, so it says nothing about others"
    os.truncate(folder / "depth" / "0001.tiff", 40)
    render_path(run, **options)
    assert len(calls) == 2 and f"{folder / 'depth' / '0001.tiff'}: is damaged" in capsys.readouterr().err


@pytest.mark.slow
def test_frames_of_other_settings_are_not_mixed(rendered, run, path_file, tmp_path):
    kept = (rendered[0] / "color" / "0000.png").read_bytes()
    with pytest.raises(ValueError, match="mine-20: holds frames rendered with width 25, not 50; give --over"):
        render_path(run, path=str(path_file), width=50, height=17, video="none")
    other = tmp_path / "mine.json"
    other.write_text(path_file.read_text() + "\n")
    with pytest.raises(ValueError, match="rendered with path '.*, or another --name"):
        render_path(run, path=str(other), video="none")
    assert (rendered[0] / "color" / "0000.png").read_bytes() == kept
    options = {"path": str(other), "name": "other", "video": "none", "settings": {"chunk": 100}}
    (folder,) = render_path(run, width=6, height=4, **options)
    assert folder.name == "other-20" and iio.imread(folder / "color" / "0000.png").shape == (4, 6, 3)
    (folder,) = render_path(run, width=4, height=6, overwrite=True, **options)
    assert iio.imread(folder / "color" / "0001.png").shape == (6, 4, 3)
    provenance = json.loads((folder / "path.json").read_text())
    (folder / "path.json").write_text(json.dumps(provenance | {"parameters": "of a run that was trained again"}))
    with pytest.raises(ValueError, match="rendered with parameters"):
        render_path(run, width=4, height=6, **options)
    (folder / "path.json").write_text("{")
    with pytest.raises(ValueError, match="path.json: cannot be read"):
        render_path(run, width=4, height=6, **options)


def test_wrong_arguments_are_errors(run, monkeypatch):
    for name in ("a/b", "..", ".x", "/x"):
        with pytest.raises(ValueError, match="expected a plain file name"):
            render_path(run, name=name)
    with pytest.raises(ValueError, match="video is 'avi', expected one of auto, mp4"):
        render_path(run, video="avi")
    monkeypatch.setattr(render_path_module.importlib.util, "find_spec", lambda name: None)
    assert render_path_module.video_suffix("auto") == ".gif"
    with pytest.raises(ValueError, match="no ffmpeg; pip install imageio-ffmpeg"):
        render_path_module.video_suffix("mp4")


@pytest.mark.filterwarnings("ignore:os.fork")  # of reading it again
@pytest.mark.skipif(not importlib.util.find_spec("imageio_ffmpeg"), reason="needs imageio-ffmpeg")
def test_an_mp4_of_odd_sides_is_cropped_by_one_row_and_column(tmp_path):
    for index in range(4):
        frame = np.full((17, 25, 3), 60 * index, np.uint8)
        frame[-1], frame[:, -1] = 255, 255
        output_images.write_image(tmp_path / f"{index}.png", frame)
    target = tmp_path / "a.b.mp4"
    render_path_module.write_video(target, sorted(tmp_path.glob("*.png")), 10)
    found = iio.imread(target)
    assert found.shape == (4, 16, 24, 3)
    np.testing.assert_allclose(found.mean(axis=(1, 2, 3)), [0, 60, 120, 180], atol=4)
    assert not list(tmp_path.glob("*.tmp*"))


@pytest.mark.slow
def test_the_program_selects_a_path_and_reports_it(run):
    """As `make demo` calls it, with fewer frames and a GIF."""
    flags = (
        f"--workdir={run}",
        "--overwrite",
        "--frames=2",
        "--video=gif",
        "--width=10",
        "--fps=5",
        "--chunk=100",
    )
    code, out, err = run_forked("render", *flags)
    assert code == 0, err
    target = run / "renders" / "turntable-20"
    assert out.split() == [str(target), f"{target}.gif"]
    assert "path: turntable, as the cameras surround what they look at, with gaps of at most" in err
    assert iio.imread(f"{target}.gif", index=...).shape == (2, 10, 10, 3)
