"""Client-side rendering: the page of the web export, with the parameters that the viewer shows.

The page asks for newer parameters every few seconds and renders by itself, so the viewer renders nothing for it.
"""

import asyncio
import http
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple
from urllib.parse import parse_qs

from jaxnerf.tools.exporters import web
from jaxnerf.tools.exporters.base import ExportSource
from jaxnerf.tools.exporters.options import WebOptions
from jaxnerf.tools.viewer.frame_renderer import SceneState

FRAMES = "/frames/"  # the address of the page that shows frames of the server
_PRECISION = "16 bits"  # of features: 8 would have to be scored, as the export does
_COMPRESSION = 0  # of gzip: parameters are nearly noise, and compressing them takes longer than all else
_ABSENT = 10.0  # s without a request after which a page counts as closed; it sends one every 2 s


class Answer(NamedTuple):
    """An HTTP response: its status, the type of its body, and the body."""

    status: http.HTTPStatus
    kind: str
    body: bytes


class ClientRendering:
    """Answers the requests of pages that render by themselves."""

    def __init__(self, viewer: Any, changed: Callable[[], None]):
        """Prepares the answers; nothing is encoded before a page asks.

        Args:
            viewer: the Viewer.
            changed: called at each request for a scene.
        """
        self._viewer, self._changed, self._lock = viewer, changed, threading.Lock()
        self._encoded: tuple[SceneState | None, bytes] = None, b""
        self._requested = -_ABSENT
        try:
            web.network_of(viewer.run)
            self.refused = ""
        except ValueError as error:
            self.refused = str(error)

    @property
    def is_open(self) -> bool:
        """Whether a page has asked recently."""
        return time.monotonic() - self._requested < _ABSENT

    async def answer(self, path: str, query: str) -> Answer | None:
        """Returns the answer to a request of a browser; None: there is no such page."""
        if self.refused:
            return None
        if path == "/":
            self._note_request()
            return Answer(http.HTTPStatus.OK, "text/html; charset=utf-8", web.page(None, live=True).encode())
        if path == "/scene.bin":
            self._note_request()
            return await self._scene(parse_qs(query).get("step", [""])[0])
        return None

    def _note_request(self):
        self._requested = time.monotonic()
        self._changed()

    async def _scene(self, step):
        state = self._viewer.state
        if state is None or step == str(state.step):
            return Answer(http.HTTPStatus.NO_CONTENT, "application/octet-stream", b"")
        try:
            data = await asyncio.to_thread(self._encode, state)
        except ValueError as error:
            return Answer(http.HTTPStatus.SERVICE_UNAVAILABLE, "text/plain; charset=utf-8", str(error).encode())
        return Answer(http.HTTPStatus.OK, "application/octet-stream", data)

    def _encode(self, state):
        viewer = self._viewer
        with self._lock:  # several pages may ask at once
            if self._encoded[0] is not state:
                variables = state.params, state.grid
                scene = web.scene_of(viewer.run, variables, _PRECISION)
                source = ExportSource(viewer.run, state.step, variables, viewer.views, WebOptions(), print)
                self._encoded = state, web.encode(scene, web.about(source, scene, viewer.score), level=_COMPRESSION)
            return self._encoded[1]
