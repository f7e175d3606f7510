"""A browser's part of the viewer's protocol (that of viser), without a browser."""

import contextlib
import socket
import time

import imageio.v3 as iio
import msgspec
import numpy as np
import viser
import websockets.sync.client
import zstandard

# Of a camera 4 world units above the origin that looks down.
DOWN = {"wxyz": (0.0, 1.0, 0.0, 0.0), "position": (0.0, 0.0, 4.0), "fov": 0.8, "look_at": (0.0, 0.0, 0.0)}


class FakeBrowser:
    """A page that is open. It keeps the controls and the last image that the server has sent."""

    def __init__(self, port, *, origin=None, host=None):
        address, sock = f"ws://{host or f'127.0.0.1:{port}'}", socket.create_connection(("127.0.0.1", port))
        origin = f"http://127.0.0.1:{port}" if origin is None else origin
        self.socket = websockets.sync.client.connect(
            address,
            sock=sock,
            subprotocols=[f"viser-v{viser.__version__}"],
            origin=origin,
            max_size=None,
            compression=None,
        )
        self.controls, self.image, self.notes, self.num_images = {}, None, [], 0

    def send(self, type, **fields):
        """Sends a message."""
        self.socket.send(msgspec.msgpack.encode({"type": type, **fields}))

    def open(self, **camera):
        """Does what a page does first: it sends a camera, which the server replaces. Then moves the camera."""
        self.move()
        self.wait_for_quality()
        self.move(**camera)

    def move(self, *, width=64, height=48, **camera):
        """Sends a camera."""
        fields = {**DOWN, "near": 0.01, "far": 100.0, "image_width": width, "image_height": height}
        self.image = None
        self.controls.get("status", {})["markdown"] = ""
        self.send("ViewerCameraMessage", up_direction=(0.0, 1.0, 0.0), **{**fields, **camera})

    def use(self, label, value=True):
        """Uses the control with a label."""
        self.send("GuiUpdateMessage", uuid=self.controls[label]["uuid"], updates={"value": value})

    def wait(self, condition, seconds=30):
        """Receives until a condition holds."""
        end = time.monotonic() + seconds
        while not condition():
            left = end - time.monotonic()
            assert left > 0, f"nothing happened in {seconds} s; {self.status!r}, {self.notes}"
            self.receive(min(left, 0.2))

    def receive(self, seconds):
        """Receives a message if one comes in time."""
        with contextlib.suppress(TimeoutError):
            self._read(self.socket.recv(timeout=seconds))

    @property
    def status(self):
        """The text above the controls."""
        return self.controls.get("status", {}).get("markdown", "")

    def wait_for_quality(self):
        """Receives until the image has its full quality; returns it."""
        self.wait(lambda: "full quality" in self.status and self.image is not None)
        return iio.imread(self.image)

    def close(self):
        """Closes the page."""
        self.socket.close()

    def _read(self, raw):
        compressed = int.from_bytes(raw[8:16], "little")
        start = 16 + compressed
        content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16:start]))
        buffers = []
        for length in content["binaryBufferLengths"]:
            start += -start % 8
            buffers.append(raw[start : start + length])
            start += length
        for message in content["messages"]:
            self._handle(message, buffers)

    def _handle(self, message, buffers):
        kind = message["type"]
        if kind == "BackgroundImageMessage":
            data = message["rgb_data"]
            self.image = buffers[data["__binary_index"]] if isinstance(data, dict) else data
            self.num_images += 1
        elif kind == "NotificationShowMessage":
            self.notes.append(f"{message['props']['title']}: {message['props']['body']}")
        elif kind == "GuiUpdateMessage":
            for control in self.controls.values():
                if control["uuid"] == message["uuid"]:
                    control.update({key.removeprefix("_"): value for key, value in message["updates"].items()})
        elif kind.startswith("Gui") and "props" in message:
            props = message["props"]
            label = props.get("label") or ("status" if kind == "GuiMarkdownMessage" else kind)
            while label in self.controls:
                label += "'"
            self.controls[label] = {"uuid": message["uuid"], "kind": kind, "value": message.get("value"), **props}


def difference(a, b):
    """Returns the mean absolute difference of two images of one size."""
    return np.abs(a.astype(float) - b.astype(float)).mean()
