"""What the viewer's server does for browsers, and what it refuses, without a browser."""

import json
import math
import socket

import numpy as np
import pytest
import websockets.exceptions

import ball_runs
from jaxnerf.tools.viewer import server
from jaxnerf.tools.viewer.frame_renderer import FrameCamera, frame_image
from viewer_client import FakeBrowser, difference


def variables(radius=0.7):
    return {"radius": np.float32(radius)}, None


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    """A Viewer of the solid ball."""
    made = server.Viewer(tmp_path_factory.mktemp("viewed"), *ball_runs.solid_run())
    made.show(20, variables(), "20 dB")
    made.port = made.listen(port=0)
    yield made
    made.close()


@pytest.fixture
def browser(viewer):
    """Opens pages and closes them."""
    opened = []

    def open_page(**options):
        opened.append(FakeBrowser(viewer.port, **options))
        return opened[-1]

    yield open_page
    for page in opened:
        page.close()


def test_the_resting_image_is_the_frame_of_the_camera(viewer, browser):
    page = browser()
    page.open()
    found = page.wait_for_quality()
    down = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4]])  # x right, y up, looking along -z
    expected = frame_image(viewer.renderer.render(viewer.state, FrameCamera(down, 0.8, 64, 48)), "colour")
    assert found.shape == (48, 64, 3) and difference(found, expected) < 3  # of 255, as JPEG is lossy
    assert "**step 20** · 20 dB" in page.status and "64 × 48 px" in page.status


def test_a_moved_camera_changes_the_image_and_a_resting_one_nothing(browser):
    page = browser()
    page.open()
    before = page.wait_for_quality()
    count = page.num_images
    page.wait(lambda: True)
    with pytest.raises(AssertionError, match="nothing happened in 0.5 s"):
        page.wait(lambda: page.num_images > count, seconds=0.5)
    page.move(position=(0.5, 0.0, 4.0))
    page.wait(lambda: page.num_images > count)
    assert difference(page.wait_for_quality(), before) > 3


def test_each_page_has_its_own_camera_and_mode(browser):
    first, second = browser(), browser()
    first.open()
    second.open(position=(0.0, 0.0, 6.0), width=40)
    color = first.wait_for_quality()
    assert second.wait_for_quality().shape == (48, 40, 3) and color.shape == (48, 64, 3)
    count = second.num_images
    second.use("Show", "depth")
    second.wait(lambda: second.num_images > count)
    grey = np.ptp(second.wait_for_quality().astype(int), axis=-1).max()
    assert grey < 8 and np.ptp(color.astype(int), axis=-1).max() > 50


def test_new_parameters_replace_the_image_by_themselves(viewer, browser):
    page = browser()
    page.open()
    before = page.wait_for_quality()
    viewer.show(40, variables(0.3), "30 dB")
    page.wait(lambda: "**step 40** · 30 dB" in page.status)
    after = page.wait_for_quality()
    viewer.show(20, variables(), "20 dB")
    assert (after < 200).any(axis=-1).sum() < 0.5 * (before < 200).any(axis=-1).sum(), "the ball is smaller"


def test_a_page_that_closes_is_forgotten(viewer, browser):
    page = browser()
    page.open()
    page.wait_for_quality()
    count = viewer.num_browsers
    page.close()
    other = browser()
    other.open()
    other.wait_for_quality()
    assert viewer.num_browsers == count and viewer.loop.idle()


def test_a_path_is_saved_in_the_workdir_only(viewer, browser):
    page = browser()
    page.open()
    page.wait_for_quality()
    page.use("Add keyframe")
    page.wait(lambda: "1 keyframe" in page.controls["status'"]["markdown"])
    page.use("Save")
    page.wait(lambda: page.notes)
    assert page.notes.pop() == "Not done: the path has 1 keyframes, expected 2 to 500; add or remove some"
    page.move(position=(1.0, 0.0, 4.0))
    page.use("Add keyframe")
    page.wait(lambda: "2 keyframes" in page.controls["status'"]["markdown"])
    page.use("Name", "../../out")
    page.use("Save")
    page.wait(lambda: page.notes)
    assert "the name is '../../out', expected up to 64 letters" in page.notes.pop()
    page.use("Name", "mine")
    page.use("Save")
    page.wait(lambda: "saved" in page.controls["status'"]["markdown"])
    (file,) = viewer.workdir.rglob("*.json")
    assert file == viewer.workdir / "camera_paths" / "mine.json"
    content = json.loads(file.read_text())
    assert len(content["frames"]) == 96 and (content["w"], content["h"]) == (533, 400)
    assert content["frames"][-1]["transform_matrix"][0][3] == pytest.approx(1, abs=1e-5)
    page.use("Remove last keyframe")
    page.wait(lambda: "1 keyframe" in page.controls["status'"]["markdown"])
    page.use("Open as keyframes")
    page.wait(lambda: "96 keyframes" in page.controls["status'"]["markdown"])
    page.use("Height (px)", 1e9)
    page.use("Save")
    page.wait(lambda: page.notes)
    assert "the height is '1000000000', expected a number from 1 to 4096" in page.notes.pop()
    page.use("Height (px)", 400)
    page.use("Frames per second", -5)
    page.use("Save")
    page.wait(lambda: page.notes)
    assert "expected a number from 0.1 to 240" in page.notes.pop()


NONSENSE = [
    {"image_width": -5},
    {"image_width": 10**9},
    {"fov": float("inf")},
    {"fov": -1.0},
    {"wxyz": (0.0, 0.0, 0.0, 0.0)},
    {"wxyz": (float("nan"),) * 4},
    {"position": (1e300, 0.0, 0.0)},
    {"position": (0.0, 0.0)},
]


def test_nonsense_from_a_browser_harms_nobody(viewer, browser, capfd):
    other = browser()
    other.open()
    other.wait_for_quality()
    page = browser()
    page.open()
    before = page.wait_for_quality()
    for wrong in NONSENSE:
        page.move(**wrong)
    page.send("GuiUpdateMessage", uuid=page.controls["Show"]["uuid"], updates={"value": 5})
    page.send("GuiUpdateMessage", uuid=page.controls["Crop"]["uuid"], updates={"no_such_field": 5})
    page.send("GuiUpdateMessage", uuid=page.controls["Resolution (px)"]["uuid"], updates={"value": "99999999"})
    page.send("ShareUrlRequest")
    page.move()
    page.send("GuiUpdateMessage", uuid=page.controls["Resolution (px)"]["uuid"], updates={"value": "400"})
    assert difference(page.wait_for_quality(), before) == 0
    for raw in (b"\xff\x00nonsense", b"", "text", {"position": None}, {"image_height": math.nan}, {"fov": "wide"}):
        bad = browser()
        bad.move(**raw) if isinstance(raw, dict) else bad.socket.send(raw)
        with pytest.raises(websockets.exceptions.ConnectionClosed):
            bad.wait(lambda: False, seconds=10)
    with pytest.raises(AssertionError, match="nothing happened"):
        other.wait(lambda: other.image is None, seconds=0.3)
    count = other.num_images
    other.move(position=(0.5, 0.0, 4.0))
    other.wait(lambda: other.num_images > count)
    other.wait_for_quality()
    assert viewer._server._share_tunnel is None, "nobody else can open this server to the internet"
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize(
    "headers", [{"origin": "http://evil.example"}, {"origin": "http://evil.example:80", "host": "evil.example:80"}]
)
def test_the_page_of_another_site_cannot_connect(browser, headers):
    """Nor can one whose name has been made to lead to this machine."""
    try:
        page = browser(**headers)
        page.move()
        with pytest.raises(websockets.exceptions.ConnectionClosed):
            page.wait(lambda: page.image is not None, seconds=10)
        assert page.image is None
    except websockets.exceptions.InvalidHandshake:
        pass


def test_a_taken_port_and_a_foreign_address_are_refused(viewer):
    with pytest.raises(ValueError, match=rf"^port {viewer.port} of 127.0.0.1: the viewer cannot listen there"):
        server.check_port("127.0.0.1", viewer.port)
    with pytest.raises(ValueError, match="^port 80 of no.such.host.invalid: the viewer cannot listen there"):
        server.check_port("no.such.host.invalid", 80)


def test_only_this_machine_can_connect(viewer):
    """The server listens on 127.0.0.1 unless another address is given."""
    with socket.socket() as other:
        other.settimeout(1)
        with pytest.raises(OSError):
            other.connect(("127.0.0.2", viewer.port))
