"""Measures the viewer: frames per second, latency, and what it costs a training.

latency.py --workdirs=runs/demo,runs/lego --train=quickstart prints the report.
"""

import functools
import gzip
import json
import os
import pathlib
import resource
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request

import msgspec
import numpy as np
import viser
import websockets.sync.client
from absl import flags
from viser._image_encoding import cv2_imencode_with_fallback

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.data.geometry import path_poses
from jaxnerf.evaluation.restore import newest_step, refined_views, restore_with_grid
from jaxnerf.runtime import cli
from jaxnerf.tools.viewer.frame_renderer import FrameCamera, FrameRenderer, frame_image
from jaxnerf.tools.viewer.render_loop import RenderLoop, Request
from jaxnerf.training import metric_log

_WORKDIRS = flags.DEFINE_list("workdirs", [], "The runs to view.")
_TRAIN = flags.DEFINE_string("train", None, "The config whose training is measured with and without the viewer.")
_STEPS = flags.DEFINE_integer("steps", 400, "The steps of each training without a browser; 0: none.")
_SECONDS = flags.DEFINE_float("seconds", 20.0, "The time with and without a browser in turn.")
_CLIENT = flags.DEFINE_integer("client", 0, "Internal: acts as a browser on this port that moves its camera.")
_IMAGES = flags.DEFINE_string("images", os.devnull, "Internal: the client adds a line for each image, its time.")
SIDES = (100, 200, 400)  # px
MESSAGES_PER_SECOND = 20.0  # of a camera that is dragged
_DRAG_SECONDS = 6.0
_FRAMES = 8
_LEAST_IMAGE = 1500  # bytes of a message; other messages are shorter
_BY_ITSELF = -1.0  # in place of the camera's speed: a page that renders by itself


def main(argv):
    del argv
    if _CLIENT.value:
        return _act_as_browser(_CLIENT.value)
    parts = ["\n".join([*common.provenance(), "", _ABOUT, ""])]
    parts += [_view(workdir) for workdir in _WORKDIRS.value]
    if _TRAIN.value:
        parts += [_idle_cost(_TRAIN.value)] if _STEPS.value else []
        parts += [_busy_cost(_TRAIN.value)]
    print("\n".join(parts))


_ABOUT = f"""The load average at the start was {os.getloadavg()[0]:.1f}. Above the number of cores, other programs
slowed the wall-clock times, and CPU times are the better guide.

Latency is the time from a camera message to the encoded image (JPEG), without network and browser, while a camera is
dragged (20 messages a second) in a window of this size. The viewer selects the size of its frames so that it keeps ten
a second."""


def _view(workdir):
    """Returns the table of a run."""
    run = restore_with_grid(workdir)
    step = newest_step(run, workdir)
    variables = run.variables(step)
    views = refined_views(run, run.experiment.load_split("train"), "train", variables[0])
    renderer = FrameRenderer(run, views)
    state = renderer.scene_state(step, variables)
    renderer.compile(state)
    poses = np.asarray(views.cameras.to_world)
    path = path_poses.make_poses(path_poses.default_kind(poses)[0], poses, 240)
    fov = 2 * np.arctan(0.5 * float(views.size[0, 0]) / float(views.cameras.focal[0, 1]))
    aspect = float(views.size[0, 1]) / float(views.size[0, 0])
    lines = [
        f"## {pathlib.Path(workdir).name}, step {step:,}\n",
        "| longer side | frames per second while moving, at this size (of CPU time) | full quality (CPU time) "
        "| latency, median (90 %) | frames per second and their size while dragged |",
        "|---|---|---|---|---|",
    ]
    for side in SIDES:
        width, height = (side, round(side / aspect)) if aspect >= 1 else (round(side * aspect), side)
        cameras = [FrameCamera(pose, float(fov), width, height) for pose in path]
        fast, own = (_seconds_per_frame(renderer, state, cameras, fast=fast) for fast in (True, False))
        latencies, rate, size = _dragged(renderer, state, cameras)
        middle, most = statistics.median(latencies), np.quantile(latencies, 0.9)
        cells = [
            f"{side} px",
            f"{1 / fast[0]:.1f} ({1 / fast[1]:.1f})",
            f"{own[0]:.2f} s ({own[1]:.2f} s)",
            f"{1000 * middle:.0f} ms ({1000 * most:.0f} ms)",
            f"{rate:.1f} at {size[0]} x {size[1]} px",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def _seconds_per_frame(renderer, state, cameras, *, fast):
    """Returns the median seconds of rendering and encoding a frame along the path, and those of CPU time."""
    chosen = cameras[:: len(cameras) // _FRAMES][:_FRAMES]
    call = functools.partial(_rendered, renderer, state, fast)
    call(chosen[0])
    seconds = []
    for camera in chosen:
        started = time.perf_counter(), time.process_time()
        call(camera)
        seconds.append((time.perf_counter() - started[0], time.process_time() - started[1]))
    return np.median(seconds, axis=0)


def _rendered(renderer, state, fast, camera):
    return _encoded(renderer.render(state, camera, fast=fast))


def _encoded(frame):
    return cv2_imencode_with_fallback("jpeg", frame_image(frame, "colour"), 80, "rgb")


def _dragged(renderer, state, cameras):
    """Returns latencies, frames per second, and the size of the last frame of a camera that is dragged."""
    latencies, sizes, times, lock = [], [], [], threading.Lock()

    def deliver(_, delivery):
        started = time.perf_counter()
        _encoded(delivery.frame)
        now = time.perf_counter()
        with lock:
            latencies.append(delivery.latency + now - started)
            sizes.append((delivery.frame.camera.width, delivery.frame.camera.height))
            times.append(now)

    loop = RenderLoop(renderer, deliver)
    loop.set_scene(state)
    started = time.perf_counter()
    for index in range(round(_DRAG_SECONDS * MESSAGES_PER_SECOND)):
        loop.submit("browser", Request(cameras[index % len(cameras)]))
        time.sleep(max(started + (index + 1) / MESSAGES_PER_SECOND - time.perf_counter(), 0))
    loop.close()
    half = [time for time in times if time > started + _DRAG_SECONDS / 2]  # the speed has been measured by then
    return latencies[-len(half) :], (len(half) - 1) / (half[-1] - half[0]), sizes[-1]


def _idle_cost(config):
    """Returns what --viewer costs a training to which no browser is connected."""
    spent = {False: [], True: []}
    for _ in range(2):
        for viewer in spent:
            with tempfile.TemporaryDirectory() as folder:
                flags = [
                    f"--config.train.max_steps={_STEPS.value}",
                    "--config.train.preview_every=0",
                    "--config.train.log_every=20",
                ]
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                process = _train(config, folder, *flags, *(["--viewer", "--viewer_port=0"] if viewer else []))
                process.communicate()
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
                rows = metric_log.read_rows(folder)
            rows = rows[len(rows) // 2 :]  # the viewer has been started by then
            cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            spent[viewer].append(
                (cpu, (rows[-1]["seconds"] - rows[0]["seconds"]) / (rows[-1]["step"] - rows[0]["step"]))
            )
    lines = [
        f"## A training without a browser\n\nTwo trainings each of `{config}`, {_STEPS.value} steps.\n",
        "| | CPU time of the program | time per step in the second half |",
        "|---|---|---|",
    ]
    for viewer, name in ((False, "without `--viewer`"), (True, "with `--viewer`, no browser")):
        cpu, step = zip(*spent[viewer], strict=True)
        lines.append(
            f"| {name} | {', '.join(f'{value:.1f} s' for value in cpu)} "
            f"| {', '.join(f'{1000 * value:.1f} ms' for value in step)} |"
        )
    return "\n".join([*lines, ""])


def _busy_cost(config):
    """Returns what a browser costs a training: steps per second with and without it, in turn."""
    browsers = {
        "no browser": None,
        "a browser that rests": 0.0,
        "a browser whose camera moves": 1.0,
        "a browser that renders by itself": _BY_ITSELF,
    }
    rates, gaps = {name: [] for name in browsers}, []
    with tempfile.TemporaryDirectory() as folder:
        flags = ["--config.train.max_steps=1000000", "--config.train.preview_every=0", "--config.train.log_every=5"]
        process = _train(config, folder, *flags, "--viewer", "--viewer_port=0")
        port = next(int(line.split(":")[2].split()[0]) for line in process.stderr if line.startswith("viewer"))
        threading.Thread(target=process.stderr.read, daemon=True).start()
        while len(metric_log.read_rows(folder)) < 60:
            time.sleep(1)
        with _browser(port, 0.0):  # the renderer is compiled
            time.sleep(_SECONDS.value)
        for _ in range(3):
            for name, moves in browsers.items():
                if moves is None:
                    rates[name].append(_steps_per_second(folder))
                else:
                    images = pathlib.Path(folder) / "images.txt"
                    with _browser(port, moves, images):
                        rates[name].append(_steps_per_second(folder))
                    if moves > 0:
                        gaps += np.diff([float(line) for line in images.read_text().split()][10:]).tolist()
                    images.unlink(missing_ok=True)
        process.terminate()
        process.communicate()
    base = statistics.median(rates["no browser"])
    lines = [
        f"## A training with a browser\n\n`{config}` for {_SECONDS.value:g} s with and without a browser in turn,\n"
        "three times; the browser's own work is not part of it.\n",
        "| | steps per second | of those without |",
        "|---|---|---|",
    ]
    for name, values in rates.items():
        shown = ", ".join(f"{value:.2f}" for value in values)
        lines.append(f"| {name} | {shown} | {statistics.median(values) / base:.0%} |")
    middle, most = 1000 * np.quantile(gaps, (0.5, 0.95))
    lines += [
        "",
        f"While the camera moves, an image comes {1 / np.mean(gaps):.1f} times a second; from one to the next",
    ]
    lines += [f"it takes {middle:.0f} ms in the median and {most:.0f} ms at the 95th percentile."]
    return "\n".join([*lines, ""])


def _steps_per_second(folder):
    time.sleep(2)  # after a change
    started, before = time.perf_counter(), metric_log.read_rows(folder)[-1]["step"]
    time.sleep(_SECONDS.value)
    return (metric_log.read_rows(folder)[-1]["step"] - before) / (time.perf_counter() - started)


class _browser:
    """A process that acts as a browser, while the context lasts."""

    def __init__(self, port, moves, images=os.devnull):
        self._command = [sys.executable, __file__, f"--client={port}", f"--seconds={moves}", f"--images={images}"]

    def __enter__(self):
        self._process = subprocess.Popen(self._command, stderr=subprocess.DEVNULL)  # it says that it was stopped

    def __exit__(self, *_):
        self._process.terminate()
        self._process.wait()


def _act_as_browser(port):
    """Sends a camera and reads what comes; with --seconds above 0 the camera moves, and below 0 see _BY_ITSELF."""
    if _SECONDS.value == _BY_ITSELF:
        return _receive_parameters(port)
    address, name = f"ws://127.0.0.1:{port}", f"viser-v{viser.__version__}"
    angle = 0.0
    options = {"subprotocols": [name], "max_size": None, "compression": None, "origin": f"http://127.0.0.1:{port}"}
    with websockets.sync.client.connect(address, **options) as socket, open(_IMAGES.value, "a", buffering=1) as images:
        while True:
            half = np.pi / 2 + 0.3  # looks down at the origin from above, turned about the vertical
            pose = {"wxyz": _product((np.cos(angle / 2), 0, 0, np.sin(angle / 2)), (np.cos(half), np.sin(half), 0, 0))}
            forward = np.array([np.sin(angle) * np.sin(2 * half), -np.cos(angle) * np.sin(2 * half), np.cos(2 * half)])
            fields = {"fov": 0.7, "near": 0.01, "far": 100.0, "image_width": 800, "image_height": 600}
            message = {"type": "ViewerCameraMessage", **pose, "position": tuple(map(float, -4 * forward)), **fields}
            message |= {"look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0)}
            if angle == 0 or _SECONDS.value:
                socket.send(msgspec.msgpack.encode(message))
                angle += 0.02
            end = time.perf_counter() + 1 / MESSAGES_PER_SECOND
            while (left := end - time.perf_counter()) > 0:
                try:
                    if len(socket.recv(timeout=left)) > _LEAST_IMAGE:
                        print(time.perf_counter(), file=images)
                except TimeoutError:
                    break


def _receive_parameters(port):
    """Asks for newer parameters every 2 s, as the page does; it does not render them."""
    step = ""
    while True:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/scene.bin?step={step}") as answer:
            if data := answer.read():
                raw = gzip.decompress(data)
                length = int(np.frombuffer(raw, "<u4", 1, 8)[0])
                step = json.loads(raw[12 : 12 + length])["step"]
        time.sleep(2)


def _product(a, b):
    """Returns the product of two quaternions, w first."""
    (w, *v), (x, *u) = a, b
    v, u = np.array(v), np.array(u)
    return tuple(map(float, (w * x - v @ u, *(w * u + x * v + np.cross(v, u)))))


def _train(config, folder, *flags):
    command = [sys.executable, "-m", "jaxnerf.train", f"--config={config}", f"--workdir={folder}", *flags]
    command.append("--config.train.max_seconds=0")
    return subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, cwd=common.ROOT)


if __name__ == "__main__":
    cli.run(main)
