"""Which requests of browsers are answered, and what a page may send: all of it is checked before viser sees it.

A page of another site can reach a server on this machine through the user's browser: by a link, a frame, an image, a
websocket, or a name of its own that leads here. None of these may see the scene, run a script in the viewer's page or
take memory. This module imports what viser needs, so import it after `server.import_viser`.
"""

import asyncio
import contextlib
import http
import ipaddress
import re
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import viser
from websockets import datastructures, http11
from websockets.asyncio import server
from websockets.protocol import State

from jaxnerf.tools.viewer.client_rendering import FRAMES

MAX_BROWSERS = 16
LOOPBACK = ("127.0.0.1", "localhost", "::1")
# Scripts, styles and files of viser's page are in its text, its decoder is WebAssembly, and its connection a worker.
# 'self' in connect-src includes the websocket of this host and port. Only viser's splats would need 'unsafe-eval'.
_POLICY = {
    "default-src": "'none'",
    "connect-src": "'self' data:",
    "frame-ancestors": "'none'",
    "script-src": "'unsafe-inline' 'wasm-unsafe-eval'",
    "style-src": "'unsafe-inline'",
    "worker-src": "data: blob:",
    "img-src": "'self' data: blob:",
    "font-src": "data:",
    "base-uri": "'none'",
    "form-action": "'none'",
}
HEADERS = {
    "Content-Security-Policy": "; ".join(f"{name} {value}" for name, value in _POLICY.items()),
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_MAX_CONNECTIONS = 128  # of all kinds; file descriptors are scarce
_LARGE, _MAX_TRANSFERS = 2**20, 4  # bytes; answers of more that are sent at the same time, each a copy in memory
_REQUEST_SECONDS = 5.0  # in which a browser has to send its request
_TRANSFER_SECONDS = 120.0  # in which a scene has to reach the browser
_CLOSE_SECONDS = 5.0  # that a browser may take to close a connection
_MAX_MESSAGE = 2**16  # bytes; a camera takes about 400
_MAX_UNREAD = 2**22  # bytes waiting to be sent, above which nothing more is read: answers to pings would pile up
_MESSAGES_PER_SECOND, _BURST = 100.0, 100.0  # of a page; viser's sends at most 70 a second
_MAX_LENGTH = 1000  # letters or numbers of a control's value


class _Camera(msgspec.Struct):
    """What a page sends of its camera."""

    wxyz: list[float]
    position: list[float]
    look_at: list[float]
    up_direction: list[float]

    def is_wanted(self):
        """Returns whether the lengths are right."""
        vectors = self.wxyz, self.position, self.look_at, self.up_direction
        return [len(vector) for vector in vectors] == [4, 3, 3, 3]


class _Update(msgspec.Struct):
    """What a page sends when a control is used: its value. No other property changes on a page."""

    updates: dict[str, Any]

    def is_wanted(self):
        """Returns whether it is a value that a control may have."""
        value = self.updates.get("value")
        parts = value if isinstance(value, list) else [value]
        types = (float, int) if isinstance(value, list) else (float, int, str)
        length = len(value) if isinstance(value, list | str) else 1
        return len(self.updates) == 1 and length <= _MAX_LENGTH and all(isinstance(part, types) for part in parts)


class _Click(msgspec.Struct):
    """What a page sends when a training camera is clicked."""

    ray_origin: list[float]
    ray_direction: list[float]
    screen_pos: list[float]

    def is_wanted(self):
        """Returns whether the lengths are right."""
        return [len(vector) for vector in (self.ray_origin, self.ray_direction, self.screen_pos)] == [3, 3, 2]


class _Kind(msgspec.Struct):
    type: str


_KIND = msgspec.msgpack.Decoder(_Kind)
_MESSAGES = {
    "ViewerCameraMessage": msgspec.msgpack.Decoder(_Camera),
    "GuiUpdateMessage": msgspec.msgpack.Decoder(_Update),
    "SceneNodeClickMessage": msgspec.msgpack.Decoder(_Click),
}


def is_wanted(message: bytes | str) -> bool:
    """Returns whether the viewer uses a message of a page; others are ignored, where viser may keep or pass them on.

    Raises:
        ValueError: if it is not what viser's page sends.
    """
    try:
        decoder = _MESSAGES.get(_KIND.decode(message).type)
        return decoder is not None and decoder.decode(message).is_wanted()
    except (TypeError, RecursionError, msgspec.MsgspecError) as error:
        raise ValueError(f"not a message of this page ({error})") from None


class Guard:
    """Decides about requests. One object serves one port."""

    def __init__(self, host: str, answer: Callable[[str, str], Any], *, page_at_root: bool):
        """Notes the names of this machine.

        Args:
            host: the address that the server listens on.
            answer: see `ClientRendering.answer`.
            page_at_root: whether viser's page is at "/", too.
        """
        self._answer, self._pages = answer, (FRAMES, "/") if page_at_root else (FRAMES,)
        self._transfers = asyncio.Semaphore(_MAX_TRANSFERS)
        self._only_local, self._names = host in LOOPBACK, {"localhost", *filter(None, [host.lower()])}
        if not self._only_local:
            name = socket.gethostname().lower()
            self._names |= {name, f"{name}.local"}
            find = threading.Thread(target=lambda: self._names.add(socket.getfqdn().lower()), daemon=True)
            find.start()  # it may ask a name server that does not answer

    def refusal(self, headers: Any, address: tuple) -> str | None:
        """Returns why a request is refused; None: it is not.

        Args:
            headers: of the request.
            address: (ip, port, ...) that the request has reached.
        """
        origin, host = (" ".join(headers.get_all(name)) for name in ("Origin", "Host"))
        name = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[\w.-]+)(:\d+)?", host, re.ASCII)
        name = name[1].strip("[]").lower() if name else ""
        ip, port = address[:2]
        if self._only_local and name not in LOOPBACK:
            return f"{host[:60]!r} is another name of this machine than localhost; open http://localhost:{port}/"
        if name not in self._names and not _is_ip(name):  # a name may be made to lead here, an IP address may not
            here = f"http://{f'[{ip}]' if ':' in ip else ip}:{port}/"
            return f"{host[:60]!r} is not known as a name of this machine; open {here}, or start with --host=NAME"
        if origin and not re.fullmatch(f"https?://{re.escape(host)}", origin, re.IGNORECASE):
            return "the page of another site"
        # Browsers send no Origin with a link, a frame, an image or a script, but say who asks for what.
        site, mode, goal = (" ".join(headers.get_all(f"Sec-Fetch-{part}")) for part in ("Site", "Mode", "Dest"))
        if goal in ("iframe", "frame", "embed", "object"):
            return "the viewer is not shown inside of another page; open it in a tab of its own"
        if site not in ("", "none", "same-origin") and (mode, goal) != ("navigate", "document"):
            return "the page of another site"
        return None

    async def process(self, connection: server.ServerConnection, request: Any, serve_page: Callable) -> Any:
        """Returns the response to a request, or None, which opens a websocket.

        Args:
            connection: that of the request.
            request: its path and headers.
            serve_page: viser's function for requests.
        """
        upgrade = " ".join(request.headers.get_all("Upgrade")).lower() == "websocket"
        if why := self.refusal(request.headers, connection.local_address):
            return _text(http.HTTPStatus.FORBIDDEN, why)
        path, _, query = request.path.partition("?")
        full = len(connection.server.connections) >= MAX_BROWSERS
        if full and (upgrade or path in self._pages):
            why = f"{MAX_BROWSERS} pages of this viewer are open, the most it serves; close one, and load this again"
            return _text(http.HTTPStatus.SERVICE_UNAVAILABLE, why)
        if upgrade:
            expected = [f"viser-v{viser.__version__}"]
            if request.headers.get_all("Sec-WebSocket-Protocol") != expected:
                return _text(http.HTTPStatus.BAD_REQUEST, f"expected the protocol {expected[0]}; load the page again")
            connection.close_timeout = _CLOSE_SECONDS
            return None
        if path == FRAMES.rstrip("/"):
            return _response(http.HTTPStatus.SEE_OTHER, Location=FRAMES)
        if path not in self._pages:
            return await self._send(connection, await self._answer(path, query))
        if query:  # viser's page obeys it: `websocket` and `playbackPath` lead to servers that send scripts
            return _response(http.HTTPStatus.SEE_OTHER, Location=path)
        request.path = "/"  # where viser has its page
        return serve_page(connection, request)

    async def _send(self, connection, answer):
        if answer is None:
            return _text(http.HTTPStatus.NOT_FOUND, f"there is no such page; open / or {FRAMES}")
        if len(answer.body) > _LARGE:
            await self._transfers.acquire()
            connection.when_sent = self._transfers.release
        return _response(answer.status, answer.body, **{"Content-Type": answer.kind})


class _Connection(server.ServerConnection):
    """A connection with limits: of time until the request, and of what a page may send."""

    def __init__(self, open_connections: dict, protocol: Any, *arguments: Any, **options: Any):
        """Makes it; open_connections: all of the port, the oldest first."""
        super().__init__(protocol, *arguments, **options)
        self._open, self._next_message, self.when_sent = open_connections, 0.0, lambda: None
        send = protocol.send_response

        def send_response(response):
            """Sends a response, whoever made it, with the headers of the viewer."""
            for name, value in HEADERS.items():
                response.headers.pop(name, None)
                response.headers[name] = value
            send(response)
            if response.status_code != http.HTTPStatus.SWITCHING_PROTOCOLS:
                self.loop.call_soon(self._end)

        protocol.send_response = send_response

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Begins; if there are too many, the oldest that has no request makes room, or else that which has no page."""
        super().connection_made(transport)
        self.recv_messages.resume = self._resume_reading
        self._open[self] = None
        self.loop.call_later(_REQUEST_SECONDS, self._expect_request)
        if len(self._open) > _MAX_CONNECTIONS:
            others = [each for each in self._open if each is not self and not each.transport.is_closing()]
            oldest = [each for each in others if each.state is not State.OPEN]
            min(oldest, key=lambda each: each.request is not None, default=self).transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Ends."""
        super().connection_lost(exc)
        self._open.pop(self, None)

    def _expect_request(self):
        if self.request is None:
            self.transport.abort()

    def _end(self):
        """Closes the connection soon after the response has been sent, if the browser does not."""
        if self.transport.get_write_buffer_size():
            self.loop.call_later(0.1, self._end)
            return
        self.when_sent()
        self.loop.call_later(_CLOSE_SECONDS, self.transport.abort)

    def data_received(self, data: bytes) -> None:
        """Reads nothing more while too much waits to be sent."""
        super().data_received(data)
        if self._is_behind():
            self.transport.pause_reading()

    def resume_writing(self) -> None:
        """Reads again once what waited has been sent."""
        super().resume_writing()
        if not self.recv_messages.paused:
            self.transport.resume_reading()

    def _resume_reading(self):
        if not self._is_behind():
            self.transport.resume_reading()

    def _is_behind(self):
        return self.transport.get_write_buffer_size() > _MAX_UNREAD

    async def recv(self, decode: bool | None = None) -> Any:
        """Returns the next message that the viewer uses, as many in a second as a page sends; a wrong one closes."""
        while True:
            now = self.loop.time()
            self._next_message = max(self._next_message, now - _BURST / _MESSAGES_PER_SECOND)
            self._next_message += 1 / _MESSAGES_PER_SECOND
            if self._next_message > now:  # meanwhile nothing is read, so the page's messages wait on its side
                await asyncio.sleep(self._next_message - now)
            message = await super().recv(decode)
            try:
                if is_wanted(message):
                    return message
            except ValueError as error:
                await self.close(1007, str(error)[:100])
                await super().recv(decode)  # raises ConnectionClosed


@contextlib.contextmanager
def guarding(guard: Guard) -> Iterator[None]:
    """Lets a viser server that is made in this context ask a guard first.

    viser takes no function for this, so the one that it gives to websockets is wrapped.
    """
    serve, open_connections = server.serve, {}

    def wrapped(*args, process_request, **options):
        limits = {
            "open_timeout": _TRANSFER_SECONDS,
            "close_timeout": _TRANSFER_SECONDS,
            "max_size": _MAX_MESSAGE,
            "create_connection": lambda *parts, **settings: _Connection(open_connections, *parts, **settings),
            "process_request": lambda connection, request: guard.process(connection, request, process_request),
        }
        return serve(*args, **{**options, **limits})

    server.serve = wrapped
    try:
        yield
    finally:
        server.serve = serve


def _response(status, body=b"", **headers):
    headers = datastructures.Headers({"Content-Length": str(len(body)), **headers})
    return http11.Response(status, status.phrase, headers, body)


def _text(status, text):
    kind = "text/plain; charset=utf-8"
    return _response(status, f"{text}\n".encode(errors="backslashreplace"), **{"Content-Type": kind})


def _is_ip(name):
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return False
