"""Serves a scene to browsers: which of them are connected, and what they see."""

import contextlib
import io
import logging
import os
import pathlib
import socket
import sys
import threading
import time
import warnings
from collections.abc import Callable
from typing import Any

from jaxnerf.core.views import Views
from jaxnerf.evaluation.restore import TrainedRun
from jaxnerf.runtime import stages
from jaxnerf.tools.viewer.client_rendering import ClientRendering
from jaxnerf.tools.viewer.frame_renderer import FrameRenderer
from jaxnerf.tools.viewer.page import Page
from jaxnerf.tools.viewer.render_loop import RenderLoop

HOST, PORT = "127.0.0.1", 8080
_REPORT_SECONDS = 10.0  # between messages about what browsers send


def check_port(host: str, port: int) -> None:
    """Raises a ValueError if nothing can listen on a port of a host; names both."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server does
            trial.bind(address)
    except (OSError, OverflowError) as error:
        why = getattr(error, "strerror", None) or error
        raise ValueError(f"port {port} of {host}: the viewer cannot listen there ({why}); give another one") from None


def import_viser():
    """Returns the library viser; raises a ValueError that says how to install it."""
    try:
        import viser
    except ImportError as error:
        raise ValueError(f"the viewer needs viser ({error}); pip install 'jaxnerf[viewer]'") from None
    return viser


class Viewer:
    """Serves one run. `show` sets the scene, and `listen` opens the port; pages may wait for the scene."""

    def __init__(
        self,
        workdir: str | os.PathLike,
        run: TrainedRun,
        views: Views,
        *,
        data_dir: str | None = None,
        fraction: float = 1.0,
        changed: Callable[[], None] = lambda: None,
    ):
        """Makes the viewer; nothing is compiled yet.

        Args:
            workdir: of the run.
            run: see `restore_with_grid`.
            views: of the split "train", with refined cameras.
            data_dir: the dataset's folder in place of the config's, for videos.
            fraction: see `RenderLoop`.
            changed: called when a browser connects or disconnects.
        """
        self.workdir, self.run, self.views, self.data_dir = pathlib.Path(workdir), run, views, data_dir
        self.renderer, self.state, self.score = FrameRenderer(run, views), None, ""
        self.rendering_video = threading.Lock()  # held while a video is rendered; there is one at a time
        self._changed, self._lock, self._pages = changed, threading.Lock(), {}
        self._server = None
        self.client_rendering = ClientRendering(self, changed)
        self.loop = RenderLoop(self.renderer, self._deliver, failed=self._failed, fraction=fraction)

    def listen(self, host: str = HOST, port: int = PORT) -> int:
        """Opens a port to browsers and returns it.

        Args:
            host: the address to listen on; other machines can connect unless it is a loopback address.
            port: 0: any that is free.

        Raises:
            ValueError: if viser is not installed, or something else listens on the port.
        """
        viser = import_viser()
        check_port(host, port)
        from jaxnerf.tools.viewer.connections import Guard, guarding  # which imports what viser needs

        guard = Guard(host, self.client_rendering.answer, page_at_root=bool(self.client_rendering.refused))
        with guarding(guard):
            self._server = _listen(viser, host, port)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)
        return self._server.get_port()

    @property
    def num_browsers(self) -> int:
        """The number of pages that are open; those that render by themselves count as one."""
        return len(self._pages) + self.client_rendering.is_open

    def show(self, step: int, variables: tuple, score: str = "", *, uncertainty_at: Any = None) -> None:
        """Replaces the scene.

        Args:
            step: of training.
            variables: (params, grid), see `TrainedRun.variables`.
            score: what is known of its quality, for the page.
            uncertainty_at: see `SceneState`.
        """
        first, state = self.state is None, self.renderer.scene_state(step, variables, uncertainty_at)
        self.score, self.state = score, state
        if first and (self._pages or self._server is None):  # pages that render by themselves need no frames
            self._each(lambda page: page.report("compiling the renderer"))
            with stages.stage("compiling the renderer"):
                self.renderer.compile(state)
        self.loop.set_scene(state)
        self._each(lambda page: page.scene_changed())

    def close(self) -> None:
        """Disconnects all browsers and ends all threads."""
        self.loop.close()
        if self._server is not None:
            with contextlib.redirect_stdout(io.StringIO()):  # viser reports that it stops
                self._server.stop()

    def _connected(self, client):
        page = Page(self, client)
        with self._lock:
            self._pages[client.client_id] = page
        page.open()
        self._changed()

    def _disconnected(self, client):
        with self._lock:
            page = self._pages.pop(client.client_id, None)
        if page is not None:
            page.close()
        self.loop.drop(client.client_id)
        self._changed()

    def _deliver(self, client_id, delivery):
        page = self._pages.get(client_id)
        if page is not None:
            page.show(delivery)

    def _failed(self, line):
        print(f"viewer: {line}", file=sys.stderr)
        self._each(lambda page: page.report(line))

    def _each(self, call):
        with self._lock:
            pages = list(self._pages.values())
        for page in pages:
            call(page)


def _listen(viser, host, port):
    """Starts a viser server that prints nothing, on exactly this port."""

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> None:
            """Does nothing: any browser could otherwise open a tunnel to this server from the internet."""

    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # it would print a traceback for bad input
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # a page may close while it is drawn
    with contextlib.redirect_stdout(io.StringIO()):
        server = Server(host=host, port=port, label="jaxnerf", verbose=False)
    if port and server.get_port() != port:  # viser takes the next one that is free
        server.stop()
        raise ValueError(f"port {port} of {host}: something else listens there; give another one")

    reported = -_REPORT_SECONDS

    def report(loop, context):
        nonlocal reported
        error, now = context.get("exception"), time.monotonic()
        if error is None or now - reported < _REPORT_SECONDS:
            return
        reported = now
        print(f"viewer: ignored a message from a browser ({type(error).__name__}: {error})"[:300], file=sys.stderr)

    server.get_event_loop().call_soon_threadsafe(server.get_event_loop().set_exception_handler, report)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server
