"""The thread that renders for all browsers: what it renders next, at which size, and when it stops."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from jaxnerf.tools.viewer.frame_renderer import Frame, FrameCamera
from jaxnerf.tools.viewer.render_loop import RenderLoop, Request

CHUNK = 1000  # px


class FakeRenderer:
    """Renders nothing at a given speed, and records what was asked for and what was abandoned."""

    def __init__(self, chunk_seconds=0.002):
        self.calls, self.seconds, self.hold = [], chunk_seconds, threading.Event()
        self.hold.set()

    def rays_per_side(self, camera, max_rays):
        return 3 if max_rays >= 9 else 1

    def render(self, state, camera, *, fast, crop, uncertain, abandoned, side):
        call = SimpleNamespace(state=state, camera=camera, fast=fast, side=side, crop=crop, chunks=0, abandoned=False)
        self.calls.append(call)
        for _ in range(-(-camera.width * camera.height // CHUNK)):
            assert self.hold.wait(10)
            if abandoned():
                call.abandoned = True
                return None
            call.chunks += 1
            time.sleep(self.seconds)
        if state == "bad":
            raise ValueError("no such state")
        empty = np.zeros((camera.height, camera.width))
        return Frame(camera, np.zeros((camera.height, camera.width, 3)), empty, empty)


class Watched:
    """A loop whose deliveries are recorded."""

    def __init__(self, **options):
        self.renderer, self.got, self.lines = FakeRenderer(), [], []
        self.loop = RenderLoop(
            self.renderer, lambda *delivery: self.got.append(delivery), failed=self.lines.append, **options
        )
        self.loop.set_scene(SimpleNamespace(step=1))

    def submit(self, client="a", x=0.0, width=400, height=200):
        pose = np.eye(3, 4)
        pose[0, 3] = x
        self.loop.submit(client, Request(FrameCamera(pose, 0.8, width, height)))

    def wait(self):
        end = time.monotonic() + 20
        while not self.loop.idle() or not self.got:
            assert time.monotonic() < end, "the loop does not come to rest"
            time.sleep(0.005)


@pytest.fixture
def watched():
    made = []

    def make(**options):
        made.append(Watched(**options))
        return made[-1]

    yield make
    for each in made:
        each.renderer.hold.set()
        each.loop.close()


def test_a_resting_camera_gets_larger_frames_and_last_full_quality(watched):
    it = watched()
    it.submit()
    it.wait()
    time.sleep(0.05)
    deliveries = [delivery for _, delivery in it.got]
    widths = [delivery.frame.camera.width for delivery in deliveries]
    assert widths == sorted(widths) and widths[0] < 400 and widths[-2:] == [400, 400]
    assert all(abs(delivery.frame.camera.width / delivery.frame.camera.height - 2) < 0.1 for delivery in deliveries)
    assert [delivery.final for delivery in deliveries] == [False] * (len(deliveries) - 1) + [True]
    assert [call.fast for call in it.renderer.calls] == [True] * (len(deliveries) - 1) + [False]
    assert it.loop.idle() and len(it.renderer.calls) == len(deliveries), "nothing is rendered twice"


def test_a_moving_camera_keeps_ten_frames_a_second(watched):
    it = watched()
    it.renderer.seconds = 0.02  # 50,000 px/s: 5,000 px in a tenth of a second
    for index in range(12):
        count = len(it.got)
        it.submit(x=index, width=800, height=400)
        while len(it.got) == count:
            time.sleep(0.002)
    moving = [delivery for _, delivery in it.got if delivery.frames_per_second is not None][-4:]
    sizes = [delivery.frame.camera.width * delivery.frame.camera.height for delivery in moving]
    assert all(1000 < size < 7000 for size in sizes), sizes
    assert all(4 < delivery.frames_per_second < 30 for delivery in moving)


def test_a_drag_shows_images_while_it_lasts(watched):
    """Although messages come faster than frames are rendered."""
    it = watched()
    it.renderer.seconds = 0.02
    end = time.monotonic() + 1.5
    while time.monotonic() < end:
        it.submit(x=time.monotonic(), width=800, height=400)
        time.sleep(0.01)
    assert len(it.got) >= 5
    late = time.monotonic() - it.got[-1][1].frame.camera.to_world[0, 3]
    assert late < 0.6, "the latest camera is shown, not one of a queue"


def test_an_outdated_frame_is_abandoned_within_a_chunk_and_the_latest_camera_wins(watched):
    it = watched()
    it.submit(x=1)
    it.wait()
    it.renderer.hold.clear()
    it.loop.set_scene(SimpleNamespace(step=2))
    time.sleep(0.05)  # the thread waits in the first chunk of a frame of full size
    it.submit(x=3)
    it.submit(x=4)
    it.renderer.hold.set()
    it.wait()
    found = [(call.camera.to_world[0, 3], call.abandoned, call.chunks) for call in it.renderer.calls]
    assert (1.0, True, 0) in found
    assert 3.0 not in [x for x, _, _ in found]
    assert it.got[-1][1].final and it.got[-1][1].frame.camera.to_world[0, 3] == 4


def test_a_frame_of_a_moving_camera_that_takes_far_too_long_is_abandoned(watched):
    it = watched()
    it.renderer.seconds = 0.05  # a fifth of the speed that is assumed at first
    it.submit(x=1)
    time.sleep(0.05)
    it.submit(x=2)
    while len(it.got) < 1:
        time.sleep(0.01)
    first, second = it.renderer.calls[:2]
    assert first.abandoned and first.chunks < 10
    assert second.camera.width < 0.7 * first.camera.width


def test_a_moving_camera_comes_before_the_refinement_of_another(watched):
    it = watched()
    it.submit("a", x=1)
    it.wait()
    it.renderer.hold.clear()
    it.loop.set_scene(SimpleNamespace(step=2))  # a renders again, at full size
    time.sleep(0.05)
    it.submit("b", x=2)
    it.renderer.hold.set()
    it.wait()
    calls = it.renderer.calls
    index = next(index for index, call in enumerate(calls) if call.camera.to_world[0, 3] == 2)
    assert calls[index - 1].abandoned and calls[index - 1].camera.to_world[0, 3] == 1
    finals = {client: delivery for client, delivery in it.got if delivery.final}
    assert {client: (each.step, each.frame.camera.to_world[0, 3]) for client, each in finals.items()} == {
        "a": (2, 1.0),
        "b": (2, 2.0),
    }


def test_a_new_scene_replaces_finished_frames_at_full_quality(watched):
    it = watched()
    it.submit()
    it.wait()
    count = len(it.got)
    it.loop.set_scene(SimpleNamespace(step=7))
    while len(it.got) == count:
        time.sleep(0.002)
    it.wait()
    assert [(each.step, each.final, each.frame.camera.width) for _, each in it.got[count:]] == [(7, True, 400)]


def test_a_client_that_leaves_stops_the_rendering(watched):
    it = watched()
    it.renderer.hold.clear()
    it.submit(width=2000, height=2000)
    time.sleep(0.05)
    it.loop.drop("a")
    it.renderer.hold.set()
    time.sleep(0.05)
    assert it.loop.idle() and not it.got and it.renderer.calls[-1].abandoned
    assert len(it.renderer.calls) == 1


def test_the_thread_survives_an_error_and_says_so(watched, capsys):
    it = watched()
    it.loop.set_scene("bad")
    it.submit()
    while not it.lines:
        time.sleep(0.005)
    assert it.lines == ["ValueError: no such state"] and "Traceback" in capsys.readouterr().err
    assert it.loop.idle()
    it.loop.set_scene(SimpleNamespace(step=3))
    it.submit()
    it.wait()
    assert it.got[-1][1].step == 3


def test_the_fraction_of_the_time_is_kept(watched):
    """Training has the rest."""
    it = watched(fraction=0.25)
    it.renderer.seconds = 0.01
    it.submit(width=200, height=100)
    started = time.perf_counter()
    it.wait()
    spent = sum(call.chunks for call in it.renderer.calls) * 0.01
    assert time.perf_counter() - started > 3 * spent


def test_only_a_final_frame_has_several_rays_a_pixel_as_far_as_time_allows():
    watched = Watched()
    watched.submit(width=60, height=40)
    watched.wait()
    *moving, last = watched.renderer.calls
    assert moving and all(call.side == 1 and call.fast for call in moving)
    assert last.side == 3 and not last.fast and last.camera.width == 60
    watched.submit(width=400, height=300)  # each ray takes at least 2 us, so nine a pixel would take over 2 s
    watched.wait()
    watched.loop.close()
    assert watched.renderer.calls[-1].side == 1 and not watched.renderer.calls[-1].fast
