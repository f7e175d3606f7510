"""Attacks on the viewer's port without a browser: what a foreign page or program may ask and send, and what it gets.

tests/slow/viewer_in_browser.py tries the same with Chromium.
"""

import contextlib
import http
import socket
import threading
import time

import pytest
import viser
import websockets.exceptions
from websockets.datastructures import Headers

import ball_runs
from jaxnerf.tools.viewer import connections, server
from jaxnerf.tools.viewer.client_rendering import Answer
from viewer_client import DOWN, FakeBrowser

VISER = f"viser-v{viser.__version__}"
UPGRADE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Protocol": VISER,
}
MEGABYTE = 2**20


async def answer(path, query):
    """Answers for a large scene."""
    if path == "/scene.bin":
        return Answer(http.HTTPStatus.OK, "application/octet-stream", bytes(16 * MEGABYTE))


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    """A Viewer of the solid ball; viser's page is at / and /frames/."""
    made = server.Viewer(tmp_path_factory.mktemp("viewed"), *ball_runs.solid_run())
    made.client_rendering.answer = answer
    made.show(20, ({"radius": 0.7}, None), "20 dB")
    made.port = made.listen(port=0)
    yield made
    made.close()


def request(port, target="/", headers=()):
    """Sends a request as it is given, and returns the socket."""
    fields = {"Host": f"127.0.0.1:{port}", **dict(headers)}
    fields = {name: value.replace("PORT", str(port)) for name, value in fields.items() if value is not None}
    lines = [f"GET {target} HTTP/1.1", *(f"{name}: {value}" for name, value in fields.items())]
    connection = socket.create_connection(("127.0.0.1", port), timeout=20)
    connection.sendall("\r\n".join([*lines, "", ""]).encode("latin1"))
    return connection


def ask(port, target="/", headers=()):
    """Sends a request and returns the status, the headers and the start of the body."""
    with request(port, target, headers) as connection:
        received = b""
        with contextlib.suppress(ConnectionResetError):
            while b"\r\n\r\n" not in received or len(received) < 3000 and b"101 Switching" not in received:
                if not (part := connection.recv(2**16)):
                    break
                received += part
    head, _, body = received.partition(b"\r\n\r\n")
    status, *rest = head.decode("latin1").split("\r\n")
    return int(status.split()[1]), dict(line.split(": ", 1) for line in rest), body


EVIL = {"Origin": "http://evil.example"}
CROSS = {"Sec-Fetch-Site": "cross-site"}
LINK = {**CROSS, "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}
# name: (request target, headers, status, words of the answer or where it redirects)
REQUESTS = {
    "foreign websocket": ("/", {**UPGRADE, **EVIL}, 403, "another site"),
    "foreign websocket, WebSocket spelled otherwise": ("/", {**UPGRADE, **EVIL, "Upgrade": "WebSocket"}, 403, "site"),
    "foreign websocket of another port": ("/", {**UPGRADE, "Origin": "http://127.0.0.1:1"}, 403, "another site"),
    "foreign websocket of a longer name": ("/", {**UPGRADE, "Origin": "http://127.0.0.1:PORT.evil"}, 403, "site"),
    "websocket of a sandboxed page": ("/", {**UPGRADE, "Origin": "null"}, 403, "another site"),
    "websocket of another protocol": ("/", {**UPGRADE, "Sec-WebSocket-Protocol": "[red]x"}, 400, "load the page again"),
    "rebound name": ("/", {"Host": "evil.example:PORT"}, 403, "open http://localhost:"),
    "rebound name, websocket": ("/", {**UPGRADE, "Host": "evil.example"}, 403, "open http://localhost:"),
    "rebound name with its own origin": ("/", {**UPGRADE, **EVIL, "Host": "evil.example"}, 403, "another name"),
    "name that begins with localhost": ("/", {"Host": "localhost.evil.example"}, 403, "another name"),
    "user in the host": ("/", {"Host": "localhost@evil.example"}, 403, "another name"),
    "no host": ("/", {"Host": None}, 403, "another name"),
    "broken host": ("/", {"Host": "[::1"}, 403, "another name"),
    "0.0.0.0": ("/", {"Host": "0.0.0.0:PORT"}, 403, "another name"),
    "frame": ("/frames/", {**LINK, "Sec-Fetch-Dest": "iframe"}, 403, "a tab of its own"),
    "frame of a page of this machine": (
        "/frames/",
        {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "iframe"},
        403,
        "a tab of its own",
    ),
    "object": ("/", {**LINK, "Sec-Fetch-Dest": "object"}, 403, "a tab of its own"),
    "image": ("/scene.bin", {**CROSS, "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"}, 403, "another site"),
    "script": ("/scene.bin", {**CROSS, "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "script"}, 403, "another site"),
    "fetch": ("/scene.bin", {**CROSS, **EVIL, "Sec-Fetch-Mode": "cors", "Sec-Fetch-Dest": "empty"}, 403, "site"),
    "form": ("/", {**LINK, **EVIL}, 403, "another site"),
    "link": ("/frames/?websocket=ws://evil.example", LINK, 303, "/frames/"),
    "link to a recording": ("/frames/?playbackPath=http://evil.example/x.viser", LINK, 303, "/frames/"),
    "link, the parameter encoded": ("/frames/?%77ebsocket=ws://evil.example", LINK, 303, "/frames/"),
    "link, two questions": ("/frames/??websocket=ws://evil.example", LINK, 303, "/frames/"),
    "link without a slash": ("/frames?websocket=ws://evil.example", LINK, 303, "/frames/"),
    "link to /": ("/?websocket=ws://evil.example", LINK, 303, "/"),
    "link to index.html": ("/index.html?websocket=ws://evil.example", LINK, 404, "no such page"),
    "link to /frames/index.html": ("/frames/index.html?websocket=ws://evil.example", LINK, 404, "no such page"),
    "link with two slashes": ("//frames/?websocket=ws://evil.example", LINK, 404, "no such page"),
    "link to //": ("//?websocket=ws://evil.example", LINK, 404, "no such page"),
    "link to another host": ("//evil.example/frames/?websocket=ws://evil.example", LINK, 404, "no such page"),
    "link with an encoded path": ("/%66rames/?websocket=ws://evil.example", LINK, 404, "no such page"),
    "link with a dot": ("/./?websocket=ws://evil.example", LINK, 404, "no such page"),
    "link with an encoded dot": ("/%2e/?websocket=ws://evil.example", LINK, 404, "no such page"),
    "link with a backslash": ("/\\?websocket=ws://evil.example", LINK, 404, "no such page"),
    "whole address": ("http://127.0.0.1/frames/?websocket=ws://evil.example", LINK, 404, "no such page"),
    "folder above": ("/../../etc/passwd", {}, 404, "no such page"),
    "folder above, encoded": ("/frames/%2e%2e/%2e%2e/etc/passwd", {}, 404, "no such page"),
    "bytes in the path": ("/\xff\x00", {}, 404, "no such page"),
    "upgrade to something else": ("/", {**UPGRADE, "Upgrade": "h2c"}, 200, ""),
    "broken websocket": ("/", {**UPGRADE, "Sec-WebSocket-Key": "x"}, 400, "Sec-WebSocket-Key"),
}


@pytest.mark.parametrize("name", REQUESTS)
def test_a_request_that_a_foreign_page_can_cause_is_refused(viewer, name):
    target, headers, status, expected = REQUESTS[name]
    found, answered, body = ask(viewer.port, target, headers)
    assert found == status
    assert expected in (answered["Location"] if status == 303 else body.decode("latin1"))
    if status == 303:
        assert answered["Location"] == expected
    assert "\x1b" not in body.decode("latin1") or status == 200
    check_headers(answered)


@pytest.mark.parametrize("headers", [{}, LINK, {"Sec-Fetch-Site": "none"}, {"Host": "localhost:PORT"}])
def test_the_page_is_served_with_headers_that_keep_others_out(viewer, headers):
    for target in ("/", "/frames/"):
        status, answered, body = ask(viewer.port, target, headers)
        assert status == 200 and b"<!doctype html>" in body.lower()
        check_headers(answered)
    status, answered, _ = ask(viewer.port, "/", {**UPGRADE, "Origin": "http://127.0.0.1:PORT"})
    assert status == 101
    check_headers(answered)


def check_headers(answered):
    policy = answered["Content-Security-Policy"].split("; ")
    assert {"default-src 'none'", "connect-src 'self' data:", "frame-ancestors 'none'"} <= set(policy)
    assert answered["X-Content-Type-Options"] == "nosniff"
    assert answered["Cross-Origin-Resource-Policy"] == "same-origin"


@pytest.mark.parametrize(
    "host, refused",
    {
        "evil.example:8080": True,
        "myhost.evil.example:8080": True,
        "localhost.evil.example": True,
        "10.0.0.7.evil.example": True,
        "0x7f000001": True,
        "myhost:8080": False,
        "MyHost": False,
        "myhost.local:8080": False,
        "gpu.here:8080": False,
        "localhost:8080": False,
        "10.0.0.7:8080": False,
        "[fe80::1]:8080": False,
    }.items(),
)
def test_on_a_network_a_name_has_to_be_that_of_the_machine(monkeypatch, host, refused):
    monkeypatch.setattr(connections.socket, "gethostname", lambda: "myhost")
    monkeypatch.setattr(connections.socket, "getfqdn", lambda: "myhost")
    guards = [connections.Guard(name, None, page_at_root=True) for name in ("0.0.0.0", "gpu.here")]
    for guard in guards if host != "gpu.here:8080" else guards[1:]:
        why = guard.refusal(Headers({"Host": host, "Origin": f"http://{host}"}), ("10.0.0.7", 8080))
        expected = (
            f"'{host}' is not known as a name of this machine; open http://10.0.0.7:8080/, or start with --host=NAME"
        )
        assert why == (expected if refused else None)
        assert guard.refusal(Headers({"Host": host, "Origin": "http://evil.example"}), ("10.0.0.7", 8080))


# Messages that viser would pass on to all pages, keep, or act on. UUID is that of a control.
TRANSFER = {"source_component_uuid": "UUID", "transfer_uuid": "1"}
START = {**TRANSFER, "filename": "a", "mime_type": "", "part_count": 9, "size_bytes": 9}
UNWANTED = [
    ("GuiFormDirtyMessage", {"uuid": "x" * 1000}),
    ("GuiFormSubmitMessage", {"uuid": "UUID"}),
    ("FileTransferStartUpload", START),
    ("FileTransferPart", {**TRANSFER, "part_index": 0, "content": b"x" * 1000}),
    ("ShareUrlRequest", {}),
    ("ShareUrlDisconnect", {}),
    ("CommandTriggerMessage", {"uuid": "x"}),
    ("RunJavascriptMessage", {"source": "alert(1)"}),
    ("NotificationShowMessage", {"uuid": "x", "props": {"title": "x", "body": "x"}}),
    ("GuiUpdateMessage", {"uuid": "UUID", "updates": {"update_cb": ["x"]}}),
    ("GuiUpdateMessage", {"uuid": "UUID", "updates": {"value": "400", "visible": False}}),
    ("GuiUpdateMessage", {"uuid": "UUID", "updates": {"value": "x" * 2000}}),
    ("GuiUpdateMessage", {"uuid": "UUID", "updates": {"value": [[[1]]]}}),
    ("GuiUpdateMessage", {"uuid": "UUID", "updates": {"value": None}}),
    ("ViewerCameraMessage", {**DOWN, "position": (0.0, 0.0), "up_direction": (0.0, 1.0, 0.0)}),
]


@pytest.fixture
def pages(viewer):
    """Opens pages, and closes them."""
    with contextlib.ExitStack() as stack:

        def open_page():
            page = FakeBrowser(viewer.port)
            stack.callback(page.close)
            return page

        yield open_page
    wait_for(lambda: not open_pages(viewer))


def wait_for(condition, seconds=20):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def open_pages(viewer):
    return viewer._server._websock_server._live_connections


def test_nothing_that_a_page_sends_reaches_another_or_is_kept(viewer, pages, capfd):
    page, other = pages(), pages()
    for each in (page, other):
        each.open()
        each.wait_for_quality()
    kept = dict(viewer._server._websock_server._broadcast_buffer.message_from_id)
    for kind, fields in UNWANTED:
        uuid = page.controls["Show"]["uuid"]
        page.send(kind, **{key: uuid if value == "UUID" else value for key, value in fields.items()})
    page.move()
    page.wait_for_quality()
    with pytest.raises(TimeoutError):
        other.socket.recv(timeout=0.3)
    assert viewer._server._websock_server._broadcast_buffer.message_from_id == kept
    interfaces = [viewer._server.gui, *(client.gui for client in viewer._server.get_clients().values())]
    assert not any(each._current_file_upload_states for each in interfaces)
    assert viewer._server._share_tunnel is None
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("megabytes", [1, 10, 60])
def test_a_large_message_closes_the_page(pages, megabytes):
    page = pages()
    started = time.monotonic()
    with pytest.raises(websockets.exceptions.ConnectionClosedError) as caught:
        for _ in range(40):
            page.socket.send(bytes(megabytes * MEGABYTE))
        page.wait(lambda: False, seconds=10)
    assert caught.value.rcvd is None or caught.value.rcvd.code == 1009
    assert time.monotonic() - started < 5


def test_a_large_message_in_parts_closes_the_page(pages):
    page = pages()
    with pytest.raises(websockets.exceptions.ConnectionClosedError):
        page.socket.send(bytes(2**14) for _ in range(1000))
        page.wait(lambda: False, seconds=10)


@pytest.mark.parametrize(
    "message",
    [
        b"\x82\xa4type\xb0GuiUpdateMessage\xa7updates\x81\xa5value" + b"\x91" * 60_000 + b"\xc0",
        b"\x82\xa4type\xa1x\xa1y" + b"\x91" * 60_000 + b"\xc0",
        b"\x81\xa4type\x91\xc0",
        b"\x91" * 100,
        b"\xdd\xff\xff\xff\xff",
        b"",
        "text",
    ],
)
def test_what_is_no_message_closes_the_page(pages, capfd, message):
    page = pages()
    page.socket.send(message)
    with pytest.raises(websockets.exceptions.ConnectionClosedError) as caught:
        page.wait(lambda: False, seconds=10)
    assert caught.value.rcvd.code == 1007
    assert capfd.readouterr().err == ""


def test_a_flood_of_messages_is_read_slowly_and_stops_nobody(viewer, pages):
    page, other = pages(), pages()
    for each in (page, other):
        each.open()
        each.wait_for_quality()
    ended = threading.Event()

    def flood():
        with contextlib.suppress(websockets.exceptions.ConnectionClosed):
            while not ended.is_set():
                page.use("Add keyframe")

    thread = threading.Thread(target=flood, daemon=True)
    thread.start()
    time.sleep(0.5)
    count, started = other.num_images, time.monotonic()
    other.move(position=(0.5, 0.0, 4.0))
    other.wait(lambda: other.num_images > count)
    assert time.monotonic() - started < 3
    made = next(each for each in viewer._pages.values() if each._keyframes)
    assert len(made._keyframes) < connections._BURST + 4 * connections._MESSAGES_PER_SECOND
    ended.set()
    page.socket.socket.shutdown(socket.SHUT_RDWR)
    thread.join(10)


def test_answers_to_pings_that_nobody_reads_do_not_pile_up(viewer):
    connection = request(viewer.port, headers=UPGRADE)
    with connection:
        assert b" 101 " in connection.recv(2**12)
        ping, sent = b"\x89\xfd\0\0\0\0" + bytes(125), 0
        connection.settimeout(1)
        with pytest.raises(TimeoutError):
            while sent < 200 * MEGABYTE:
                sent += connection.send(ping * 1000)
        (served,) = open_pages(viewer).values()
        assert served.transport.get_write_buffer_size() < 2 * connections._MAX_UNREAD
        received = 0  # a page that reads again goes on
        while received < sent // 2:
            received += len(connection.recv(2**16))


def test_the_17th_page_is_refused_in_words(viewer, pages):
    first, *_ = [pages() for _ in range(connections.MAX_BROWSERS)]
    for target, headers in (("/frames/", {}), ("/", {}), ("/", UPGRADE)):
        status, answered, body = ask(viewer.port, target, headers)
        assert status == 503 and b"16 pages of this viewer are open" in body
        check_headers(answered)
    with pytest.raises(websockets.exceptions.InvalidStatus):
        pages()
    first.close()
    wait_for(lambda: len(open_pages(viewer)) < connections.MAX_BROWSERS)
    assert ask(viewer.port, "/frames/")[0] == 200
    pages()


@pytest.mark.parametrize("start", [b"", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-", b"\x16\x03\x01"])
def test_connections_without_a_request_are_closed_and_stop_nobody(viewer, monkeypatch, start):
    monkeypatch.setattr(connections, "_REQUEST_SECONDS", 1.0)
    with contextlib.ExitStack() as stack:
        opened = []
        for _ in range(2 * connections._MAX_CONNECTIONS):
            connection = stack.enter_context(socket.create_connection(("127.0.0.1", viewer.port), timeout=10))
            opened.append(connection)
            connection.sendall(start)
        assert ask(viewer.port)[0] == 200
        started = time.monotonic()
        for connection in opened:
            with contextlib.suppress(ConnectionResetError):
                assert connection.recv(1) == b""
        assert time.monotonic() - started < 5
    assert ask(viewer.port)[0] == 200


def test_a_slow_transfer_goes_on_and_few_are_under_way_at_once(viewer, monkeypatch):
    monkeypatch.setattr(connections, "_REQUEST_SECONDS", 0.2)
    with contextlib.ExitStack() as stack:
        readers = [stack.enter_context(request(viewer.port, "/scene.bin")) for _ in range(8)]
        time.sleep(0.5)
        began = {}

        def have_begun():
            for reader in set(readers) - set(began):
                reader.settimeout(0.1)
                with contextlib.suppress(TimeoutError):
                    began[reader] = len(reader.recv(2**10))
            return len(began)

        wait_for(lambda: have_begun() >= connections._MAX_TRANSFERS)
        assert have_begun() == connections._MAX_TRANSFERS
        assert ask(viewer.port)[0] == 200
        slow, received = next(iter(began.items()))
        slow.settimeout(10)
        while part := slow.recv(MEGABYTE):
            received += len(part)
            time.sleep(0.05)
        assert received > 16 * MEGABYTE
        for reader in set(began) - {slow}:  # pages that close make room, too
            reader.close()
        for reader in set(readers) - set(began):
            reader.settimeout(10)
            assert reader.recv(12) == b"HTTP/1.1 200"
