"""One thread that renders for all browsers: small while a camera moves, larger and larger while it rests."""

import math
import threading
import time
import traceback
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import numpy as np

from jaxnerf.tools.viewer.frame_renderer import Frame, FrameCamera, FrameRenderer, SceneState

FRAMES_PER_SECOND = 10.0  # while the camera moves
_MIN_PIXELS = 32 * 32  # of a frame while the camera moves
_PATIENCE = 3.0  # times as long as planned, after which an outdated frame of a moving camera is abandoned, too
_MOVING = 0.5  # s after its last message in which a camera counts as moving
_SMOOTHING = 0.3  # weight of the newest frame in the measured speed
_FINAL_SECONDS = 1.0  # that the rays of a final frame may take beyond one a pixel, at the speed of moving frames
_FIRST_SPEED = 1e5  # px/s, before any frame has been measured


class Request(NamedTuple):
    """What a browser wants to see.

    Attributes:
        camera: FrameCamera of the full size.
        crop: [2, 3] corners in the run's world, or None.
        uncertain: whether to show uncertainty in place of colour.
    """

    camera: FrameCamera
    crop: np.ndarray | None = None
    uncertain: bool = False


class Delivery(NamedTuple):
    """A frame for a browser.

    Attributes:
        frame: the Frame.
        step: of training.
        final: whether it has the full size and the run's own quality.
        frames_per_second: while the camera moves; None when it rests.
        latency: s from the request to the end of rendering.
    """

    frame: Frame
    step: int
    final: bool
    frames_per_second: float | None
    latency: float


class _Client:
    """What the thread knows of a browser; guarded by the lock of the loop."""

    def __init__(self):
        self.request = None
        self.version = 0  # of the request
        self.requested = self.served = 0.0  # s
        self.scale = 0.0  # of the last frame's sides; 0: none since the camera moved; None: of full quality
        self.state = None  # the SceneState of the last frame
        self.delivered = []  # s, of frames while the camera moved

    def pending(self, state):
        """Returns whether there is something to render."""
        return self.request is not None and state is not None and (self.scale is not None or self.state is not state)


class RenderLoop:
    """Renders the latest request of each client in a thread, and delivers the frames.

    A frame is first rendered at a size that keeps FRAMES_PER_SECOND, then at twice that width and height, and so on up
    to the full size, and last with the run's own quality, and with several rays a pixel where a pixel covers more than
    those of training, as far as time allows. A newer request of the same client, or one of a client whose
    camera has just moved, abandons a larger frame between two chunks. The small frame of a moving camera is finished
    unless it takes far too long: if each message of a drag abandoned it, there would be no image before the drag ends.
    A new scene replaces finished frames at full quality.
    """

    def __init__(
        self,
        renderer: FrameRenderer,
        deliver: Callable[[Hashable, Delivery], Any],
        *,
        failed: Callable[[str], Any] = print,
        fraction: float = 1.0,
    ):
        """Starts the thread.

        Args:
            renderer: FrameRenderer.
            deliver: called with the client and a Delivery, in the thread.
            failed: called with a line about an error; the frame is not repeated until the next request.
            fraction: fraction of the time in which the thread renders; it sleeps between chunks for the rest.
        """
        self._renderer, self._deliver, self._failed, self._fraction = renderer, deliver, failed, fraction
        self._lock = threading.Condition()
        self._clients: dict[Hashable, _Client] = {}
        self._state: SceneState | None = None
        self._closed, self._speed = False, _FIRST_SPEED
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def submit(self, client: Hashable, request: Request) -> None:
        """Replaces the request of a client."""
        with self._lock:
            known = self._clients.setdefault(client, _Client())
            known.request, known.scale, known.requested = request, 0.0, time.perf_counter()
            known.version += 1
            self._lock.notify_all()

    def drop(self, client: Hashable) -> None:
        """Forgets a client; what is being rendered for it is abandoned."""
        with self._lock:
            self._clients.pop(client, None)

    def set_scene(self, state: SceneState) -> None:
        """Replaces what all clients see."""
        with self._lock:
            self._state = state
            self._lock.notify_all()

    def idle(self) -> bool:
        """Returns whether there is nothing to render."""
        with self._lock:
            return not any(client.pending(self._state) for client in self._clients.values())

    def close(self) -> None:
        """Ends the thread, within a chunk."""
        with self._lock:
            self._closed = True
            self._lock.notify_all()
        self._thread.join()

    def _run(self):
        while True:
            with self._lock:
                while not self._closed and (job := self._next()) is None:
                    self._lock.wait()
                if self._closed:
                    return
            try:
                self._serve(*job)
            except Exception as error:  # a thread that ends would leave every browser with its last frame
                traceback.print_exc()
                self._failed(f"{type(error).__name__}: {' '.join(str(error).split())[:300]}")
                with self._lock:
                    job[1].scale, job[1].state = None, job[4]

    def _next(self):
        """Returns the client to serve next, its request and version, the scene and its scale; None: all is rendered."""
        pending = [(key, client) for key, client in self._clients.items() if client.pending(self._state)]
        if not pending:
            return None
        last = math.inf  # a finished frame of an older scene comes after all unfinished ones
        key, client = min(pending, key=lambda item: (last if item[1].scale is None else item[1].scale, item[1].served))
        return key, client, client.request, client.version, self._state, client.scale

    def _serve(self, key, client, request, version, state, scale):
        started = waited = time.perf_counter()
        final = scale in (None, 1.0)
        moving, scale = scale == 0, 1.0 if final else self._next_scale(request.camera, scale)
        camera = _scaled(request.camera, scale)

        def abandoned():
            nonlocal waited
            if self._fraction < 1:
                time.sleep((time.perf_counter() - waited) * (1 / self._fraction - 1))
                waited = time.perf_counter()
            with self._lock:
                clients = self._clients.values()
                others = not moving and any(other.scale == 0 and other.pending(self._state) for other in clients)
                outdated = client.version != version and (not moving or late())
                return self._closed or self._clients.get(key) is not client or outdated or others

        def late():
            large = camera.width * camera.height > 2 * _MIN_PIXELS
            return large and time.perf_counter() - started > _PATIENCE / FRAMES_PER_SECOND

        side = 1
        if final:
            with self._lock:
                affordable = self._speed * _FINAL_SECONDS / (camera.width * camera.height)
            side = self._renderer.rays_per_side(camera, affordable)
        options = {"crop": request.crop, "uncertain": request.uncertain, "abandoned": abandoned, "side": side}
        frame = self._renderer.render(state, camera, fast=not final, **options)
        now = time.perf_counter()
        with self._lock:
            client.served = now
            if frame is None and moving and client.version != version:
                self._speed = 0.5 * min(self._speed, camera.width * camera.height / (now - started))
            if frame is None or self._clients.get(key) is not client:
                return
            if not final:
                speed = camera.width * camera.height / max(now - started, 1e-6)
                self._speed += _SMOOTHING * (speed - self._speed)
            rate = self._rate(client, now) if moving else None
            latency = now - client.requested if client.version == version else now - started
            if client.version == version:
                client.state = state
                client.scale = None if final else scale
        self._deliver(key, Delivery(frame, state.step, final, rate, latency))

    def _next_scale(self, camera, scale):
        """Returns the scale of the sides of the frame that follows one of a scale."""
        if scale:
            return min(2 * scale, 1.0)
        with self._lock:
            now = time.perf_counter()
            moving = sum(now - client.requested < _MOVING for client in self._clients.values())
        most = max(self._speed / FRAMES_PER_SECOND / max(moving, 1), _MIN_PIXELS)
        return min(math.sqrt(most / (camera.width * camera.height)), 1.0)

    def _rate(self, client, now):
        """Returns the frames per second of a client whose camera moves; None for its first frame."""
        client.delivered = [at for at in client.delivered if now - at < 1.0] + [now]
        if len(client.delivered) < 2:
            return None
        return (len(client.delivered) - 1) / (client.delivered[-1] - client.delivered[0])


def _scaled(camera, scale):
    """Returns the camera with its sides multiplied by a scale."""
    return camera.resized(*(max(round(side * scale), 1) for side in (camera.width, camera.height)))
