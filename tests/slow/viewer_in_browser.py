"""Drives the viewer in a real browser and prints what was seen: viewer_in_browser.py OUT.

It needs Chromium (CHROMIUM, by default /usr/bin/chromium; Debian: apt-get install chromium) and the package playwright.
OUT receives a run of the embedded scene, unless it holds one already, and screenshots.
"""

import contextlib
import functools
import http.server
import io
import os
import pathlib
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time

import imageio.v3 as iio
import numpy as np
from playwright.sync_api import Error, sync_playwright

from runs import ROOT, free_port, module_of
from viewer_client import FakeBrowser

CHROMIUM = os.environ.get("CHROMIUM", "/usr/bin/chromium")
FLAGS = [
    *("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--ignore-gpu-blocklist", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
    "--host-resolver-rules=MAP evil.example 127.0.0.1",  # the name of another site, which its owner makes lead here
]
TRAIN = (
    "--config=quickstart",
    *(f"--config.train.{setting}" for setting in ("save_every=200", "preview_every=0", "max_seconds=0")),
)
STEPS, MORE_STEPS = 400, 200  # of the first training, and of that which continues it
SECONDS = 180  # that anything may take on a busy core
RESOLUTION = "200"  # px
MIDDLE = {"x": 150, "y": 190, "width": 480, "height": 400}  # px of the page, beside the controls


def main(out):
    out.mkdir(parents=True, exist_ok=True)
    run = out / "run"
    if not run.exists():
        call("train", *TRAIN, f"--config.train.max_steps={STEPS}", f"--workdir={run}")
    with server("view", f"--workdir={run}") as (process, port), chromium() as browser:
        refusals(run, port)
        page = open_page(browser, port)
        first = the_image_arrives_and_follows_the_mouse(page, out)
        modes_and_controls(page, first, out)
        name = a_path_is_saved_and_rendered(page, run, out)
        the_video_is_rendered_from_the_page(page, run, name)
        two_pages_have_their_own_cameras(browser, page, port)
        a_new_checkpoint_replaces_the_image(page, run, out)
        a_reload_recovers(page)
        closing_all_pages_stops_the_rendering(page, process)
        a_page_renders_by_itself(browser, port, out)
        other_sites_get_nothing(browser, port, out)
        large_messages_take_no_memory(browser, process, port)
        the_17th_page_and_half_open_connections(browser, port, out)
    signals_end_it(run)
    with server("train", *TRAIN, f"--workdir={out / 'live'}", "--viewer", flag="viewer_port") as (process, port):
        with chromium() as browser:
            a_training_is_shown_while_it_runs(browser, port, out)
    print("all passed")


def refusals(run, port):
    """A taken port, a run that is none, a port that is none: one line each."""
    for flags, words in (
        ([f"--workdir={run}", f"--port={port}"], f"port {port} of 127.0.0.1"),
        ([f"--workdir={run}-none"], "no such file"),
        ([f"--workdir={run}", "--port=99999"], "99999"),
    ):
        done = subprocess.run(
            [sys.executable, "-m", module_of("view"), *flags], capture_output=True, text=True, cwd=ROOT
        )
        lines = done.stderr.strip().splitlines()
        check(done.returncode and len(lines) == 1 and words in lines[0], f"refused in one line: {lines[-1]}")


def the_image_arrives_and_follows_the_mouse(page, out):
    rest(page)
    first = middle(page, out / "first.png")
    check(np.ptp(first) > 100, f"the image arrives; its values span {np.ptp(first)}")
    time.sleep(2)
    check(difference(middle(page), first) == 0, "without a drag nothing changes")
    drag(page, 120, 30)
    rest(page)
    moved = middle(page, out / "dragged.png")
    check(difference(moved, first) > 3, f"a drag changes the image by {difference(moved, first):.1f} of 255")
    return moved


def modes_and_controls(page, color, out):
    for mode in ("depth", "opacity", "normals"):
        select(page, "Show", mode)
        page.wait_for_timeout(500)
        image = middle(page, out / f"{mode}.png")
        check(difference(image, color) > 3, f"{mode} differs from color by {difference(image, color):.1f} of 255")
    select(page, "Show", "colour")
    page.mouse.move(300, 300)
    page.mouse.wheel(0, 400)  # away, so that many cameras are in view
    rest(page)
    for box in ("Training cameras", "Occupancy grid"):
        before = middle(page)
        page.get_by_label(box, exact=True).first.click()
        changed = wait_until_changed(page, before)
        page.screenshot(path=out / f"{box.replace(' ', '_').lower()}.png")
        check(changed, f"{box} are drawn over the scene")
        after = middle(page)
        page.get_by_label(box, exact=True).first.click()
        check(wait_until_changed(page, after), f"{box} disappear")
    whole = middle(page)
    page.get_by_label("Crop", exact=True).first.click()
    thumb = page.locator(".multi-slider-thumb").nth(1).bounding_box()  # the upper end of x
    at = thumb["x"] + thumb["width"] / 2, thumb["y"] + thumb["height"] / 2
    page.mouse.move(*at)
    page.mouse.down()
    page.mouse.move(at[0] - 90, at[1], steps=4)  # to the middle
    page.mouse.up()
    wait_until_changed(page, whole)
    check(difference(middle(page, out / "crop.png"), whole) > 1, "the crop box hides a part of the scene")
    page.get_by_label("Crop", exact=True).first.click()
    page.get_by_role("button", name="Reset view").click()
    rest(page)


def a_path_is_saved_and_rendered(page, run, out):
    page.get_by_text("Camera path").click()
    for _ in range(2):
        page.get_by_role("button", name="Add keyframe").click()
        drag(page, 80, 0)
        rest(page)
    page.get_by_text("2 keyframes").wait_for(timeout=SECONDS * 1000)
    number(page, "Seconds", "0.5")
    number(page, "Frames per second", "8")
    number(page, "Height (px)", "60")
    page.locator('input[value="path"]').fill("../escape")
    page.get_by_role("button", name="Save", exact=True).click()
    page.get_by_text("expected up to 64 letters").wait_for(timeout=SECONDS * 1000)
    check(not list(run.parent.rglob("escape*")), "a name that leads out of the workdir is refused")
    page.locator('input[value="../escape"]').fill("mine")
    page.get_by_role("button", name="Save", exact=True).click()
    page.get_by_text("frames saved to").wait_for(timeout=SECONDS * 1000)
    page.screenshot(path=out / "path.png")
    call("render", f"--workdir={run}", f"--path={run / 'camera_paths' / 'mine.json'}", "--name=byhand", "--video=none")
    frames = sorted((run / "renders").glob("byhand-*/color/*.png"))
    sizes = {iio.imread(frame).shape for frame in frames}
    check(len(frames) == 4 and len(sizes) == 1, f"jaxnerf-render reads the path: {len(frames)} frames of {sizes}")
    return "mine"


def the_video_is_rendered_from_the_page(page, run, name):
    page.get_by_role("button", name="Save and render video").click()
    page.get_by_text("video: ").wait_for(timeout=SECONDS * 1000)
    found = [path.name for path in (run / "renders").glob(f"{name}-*.*")]
    check(len(found) == 1, f"the page rendered {found}")


def two_pages_have_their_own_cameras(browser, page, port):
    before = middle(page)
    other = open_page(browser, port)
    rest(other)
    drag(other, -150, 40)
    rest(other)
    apart = difference(middle(other), before)
    check(apart > 3, f"two pages differ by {apart:.1f} of 255")
    check(difference(middle(page), before) == 0, "the first page does not change")
    other.close()


def a_new_checkpoint_replaces_the_image(page, run, out):
    before, step = middle(page), shown_step(page)
    call("train", f"--workdir={run}", f"--config.train.max_steps={step + MORE_STEPS}")
    wait_for(page, f"step {step + MORE_STEPS:,}")
    rest(page)
    apart = difference(middle(page, out / "checkpoint.png"), before)
    check(apart > 0.1, f"the image of step {step + MORE_STEPS} differs from that of step {step} by {apart:.1f} of 255")


def a_reload_recovers(page):
    page.reload()
    prepare(page)
    rest(page)
    check(np.ptp(middle(page)) > 100, "a reload recovers")


def closing_all_pages_stops_the_rendering(page, process):
    drag(page, 60, 0)
    page.close()
    time.sleep(3)
    spent = -cpu_seconds(process)
    time.sleep(5)
    spent += cpu_seconds(process)
    check(spent < 1.0, f"without a page the server takes {spent:.2f} s of CPU in 5 s")


def a_page_renders_by_itself(browser, port, out):
    page = browser.new_page()
    page.set_viewport_size({"width": 420, "height": 400})
    page.set_default_timeout(SECONDS * 1000)
    page.goto(f"http://127.0.0.1:{port}/")
    page.wait_for_url("**/frames/")
    check(True, "a browser without a graphics device leaves for the frames of the server")
    page.goto(f"http://127.0.0.1:{port}/?here")
    page.wait_for_function("() => window.jaxnerf && !document.getElementById('message').textContent")
    check(f"{STEPS + MORE_STEPS} steps" in page.inner_text("#how"), f"the page says {page.inner_text('#how')!r}")
    page.screenshot(path=out / "by_itself.png")
    page.close()


# What a link, a frame or a script of another site may ask for; TRAP is a server of that site.
ADDRESSES = (
    "/frames/?websocket=ws://127.0.0.1:TRAP",
    "/frames/?playbackPath=http://127.0.0.1:TRAP/scene.viser",
    "/frames/?x=1&%77ebsocket=ws://127.0.0.1:TRAP#websocket=ws://127.0.0.1:TRAP",
    "/frames?websocket=ws://127.0.0.1:TRAP",
    "//frames/?websocket=ws://127.0.0.1:TRAP",
    "/frames/index.html?websocket=ws://127.0.0.1:TRAP",
    "/index.html?websocket=ws://127.0.0.1:TRAP",
    "/%66rames/?websocket=ws://127.0.0.1:TRAP",
    "/?websocket=ws://127.0.0.1:TRAP",
)
SCRIPT = """async (viewer) => {
  const found = [];
  const socket = await new Promise((resolve) => {
    const socket = new WebSocket(viewer.replace("http", "ws"), ["viser-v%s"]);
    socket.onopen = () => resolve("open");
    socket.onerror = () => resolve("refused");
  });
  found.push(["websocket", socket]);
  for (const mode of ["cors", "no-cors"]) {
    const answer = await fetch(viewer + "scene.bin", {mode}).catch(() => null);
    found.push([mode, answer === null ? "refused" : String(answer.status)]);
  }
  for (const kind of ["img", "script", "iframe", "embed"]) {
    const element = document.createElement(kind);
    const loaded = new Promise((resolve) => {
      element.onload = () => resolve("loaded");
      element.onerror = () => resolve("refused");
      setTimeout(() => resolve("nothing"), 3000);
    });
    element.src = viewer + (kind === "script" ? "scene.bin" : "");
    document.body.append(element);
    found.push([kind, await loaded]);
  }
  return found;
}"""


def other_sites_get_nothing(browser, port, out):
    """A page of another site, of another port of this machine, and of a name that leads to the viewer."""
    import viser

    tried, add = 0, "([tag, values]) => document.body.append(Object.assign(document.createElement(tag), values))"
    with foreign_site() as (site, trap):
        for origin in (f"http://evil.example:{site}", f"http://127.0.0.1:{site}"):
            page = browser.new_page()
            page.set_default_timeout(SECONDS * 1000)
            page.goto(origin)
            for name, got in page.evaluate(SCRIPT % viser.__version__, f"http://127.0.0.1:{port}/"):
                # The browser says of a frame that it is loaded, where it shows its own page about the refusal.
                hidden = name in ("iframe", "embed") and all(shows_nothing(frame) for frame in page.frames[1:])
                check(hidden or got in ("refused", "nothing"), f"{origin} gets nothing by {name}: {got}")
                tried += 1
            for address in ADDRESSES:
                address = f"http://127.0.0.1:{port}" + address.replace("TRAP", str(trap.port))
                page.goto(origin)
                page.evaluate(add, ["iframe", {"src": address}])
                page.wait_for_timeout(1000)
                check(all(shows_nothing(frame) for frame in page.frames[1:]), f"a frame shows nothing: {address}")
                page.goto(origin)
                page.evaluate(add, ["a", {"href": address, "textContent": "look", "id": "link"}])
                page.click("#link")
                page.wait_for_timeout(3000)
                led = f":{trap.port}" in page.url.partition("#")[0] and not shows_nothing(page.main_frame)
                check(not led and trap.count == 0, f"a link leads to {page.url}")
                tried += 2
            page.screenshot(path=out / "link.png")
            page.close()
        page = open_page(browser, port)
        connect = """(target) => new Promise((resolve) => {
          const socket = new WebSocket(target);
          socket.onopen = socket.onerror = (event) => resolve(event.type);
        })"""
        for target in (f"ws://127.0.0.1:{trap.port}", f"ws://evil.example:{trap.port}"):
            check(page.evaluate(connect, target) == "error", "the viewer's page connects to nobody else")
            tried += 1
        page.close()
        check(trap.count == 0, f"the server of the other site was asked {trap.count} times")
    rebound = browser.new_page()
    for path in ("", "frames/", "scene.bin"):
        answer = rebound.goto(f"http://evil.example:{port}/{path}")
        check(answer.status == 403, f"a name that leads here is refused: {rebound.inner_text('body')!r}")
        tried += 1
    rebound.close()
    print(f"      {tried} attacks of other sites tried, all held")


def shows_nothing(frame):
    """Returns whether a frame shows nothing of the viewer."""
    try:
        text = frame.evaluate("() => document.body ? document.body.innerText + document.title : ''")
    except Error:
        return True  # a page of the browser
    return "viser" not in text.lower() and "jaxnerf" not in text.lower() and "More controls" not in text


def large_messages_take_no_memory(browser, process, port):
    """From the viewer's own page, which its own scripts could send."""
    import viser

    page = open_page(browser, port)
    rest(page)
    before = megabytes(process)
    for count, size in ((40, 10), (1, 60), (400, 1)):
        closed = page.evaluate(
            """async ([address, protocol, count, size]) => {
              let closed = 0;
              for (let each = 0; each < count; ++each) {
                const socket = new WebSocket(address, [protocol]);
                await new Promise((resolve) => { socket.onopen = socket.onerror = resolve; });
                const end = new Promise((resolve) => {
                  socket.onclose = () => resolve(true);
                  setTimeout(resolve, 20000);
                });
                socket.send(new Uint8Array(size * 2 ** 20));
                closed += await end ? 1 : 0;
              }
              return closed;
            }""",
            [f"ws://127.0.0.1:{port}/frames", f"viser-v{viser.__version__}", count, size],
        )
        check(closed == count, f"{closed} of {count} messages of {size} MB close their connection")
    taken = megabytes(process) - before
    check(taken < 50, f"memory grows by {taken:.0f} MB")
    drag(page, 60, 20)
    rest(page)
    page.close()


def the_17th_page_and_half_open_connections(browser, port, out):
    with contextlib.ExitStack() as stack:
        pages = [FakeBrowser(port) for _ in range(16)]
        for each in pages:
            stack.callback(each.close)
        page = browser.new_page()
        answer = page.goto(f"http://127.0.0.1:{port}/frames/")
        text = page.inner_text("body")
        page.screenshot(path=out / "17th.png")
        check(answer.status == 503 and "16 pages of this viewer are open" in text, f"the 17th page says {text!r}")
        pages[0].close()
        page.wait_for_timeout(1000)
        check(page.reload().status == 200, "once a page is closed, it is served")
        page.close()
    with contextlib.ExitStack() as stack:
        for _ in range(500):
            stack.enter_context(socket.create_connection(("127.0.0.1", port)))
        page = open_page(browser, port)
        rest(page)
        check(True, "500 connections without a request stop nobody")
        page.close()


def signals_end_it(run):
    """While it starts, while it serves a page, and twice; without a traceback."""
    slow = 0.0
    for number in (signal.SIGINT, signal.SIGTERM):
        for delay, times in ((0.3, 1), (1.0, 1), (2.0, 2), (3.0, 1), (4.0, 1), (5.0, 2), (None, 1), (None, 2)):
            port = free_port()
            command = [sys.executable, "-m", module_of("view"), f"--workdir={run}", f"--port={port}"]
            process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            page = None
            if delay is None:
                page = wait_for_port(port)
                page.move()
                page.wait(lambda page=page: page.image is not None, seconds=SECONDS)
            else:
                time.sleep(delay)
            started = time.monotonic()
            for _ in range(times):
                process.send_signal(number)
                time.sleep(0.05)
            out, err = process.communicate(timeout=SECONDS)
            slow = max(slow, time.monotonic() - started)
            # Before the program has set its handlers, Python ends as it does: by the signal, or with its traceback.
            early = delay is not None and delay < 1.5
            lines = [line for line in err.splitlines() if not line.startswith("viewer  ")]
            ended = process.returncode in (128 + number, -number) or early
            good = ended and ("Traceback" not in err or early) and (len(lines) <= 1 or early)
            check(good, f"{number.name} after {delay} s, {times} times: {process.returncode}, {err.strip()[-300:]!r}")
    check(slow < 5, f"it ends within {slow:.1f} s")


def wait_for_port(port):
    """Returns a page once the viewer listens."""
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        with contextlib.suppress(OSError):
            return FakeBrowser(port)
        time.sleep(0.2)
    sys.exit("the viewer did not serve")


class Trap:
    """Counts the connections to a port, which nobody should make."""

    def __init__(self):
        self.listener, self.count = socket.create_server(("127.0.0.1", 0)), 0
        self.port = self.listener.getsockname()[1]
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self):
        with contextlib.suppress(OSError):
            while True:
                self.listener.accept()[0].close()
                self.count += 1


@contextlib.contextmanager
def foreign_site():
    """Yields the port of a web server with an empty page, and a Trap."""
    with tempfile.TemporaryDirectory() as folder:
        (pathlib.Path(folder) / "index.html").write_text("<!doctype html><title>other</title><body></body>")

        class Quiet(http.server.SimpleHTTPRequestHandler):
            def log_message(self, *arguments):
                """Prints nothing."""

        handler = functools.partial(Quiet, directory=folder)
        site, trap = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler), Trap()
        threading.Thread(target=site.serve_forever, daemon=True).start()
        yield site.server_port, trap
        site.shutdown()
        trap.listener.close()


def megabytes(process):
    """Returns the memory that a process occupies."""
    lines = pathlib.Path(f"/proc/{process.pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024


def a_training_is_shown_while_it_runs(browser, port, out):
    page = open_page(browser, port)
    rest(page)
    first = shown_step(page)
    end = time.monotonic() + SECONDS
    while (step := shown_step(page)) <= first and time.monotonic() < end:
        page.wait_for_timeout(200)
    page.screenshot(path=out / "live.png")
    check(step > first, f"the training advances on the page from step {first} to {step}: {status(page)!r}")


# The browser


@contextlib.contextmanager
def chromium():
    """Yields a browser with an empty profile."""
    if not os.path.exists(CHROMIUM):
        sys.exit(f"{CHROMIUM}: there is no browser; install Chromium, or set CHROMIUM to its path")
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as profile:
        context = playwright.chromium.launch_persistent_context(
            profile, executable_path=CHROMIUM, headless=True, args=FLAGS, viewport={"width": 1000, "height": 700}
        )
        yield context
        context.close()


def open_page(browser, port):
    page = browser.new_page()
    page.set_default_timeout(SECONDS * 1000)
    page.goto(f"http://127.0.0.1:{port}/frames/")
    prepare(page)
    return page


def prepare(page):
    """Closes a notice, and selects a size that one core renders in a few seconds."""
    close_notice(page)
    select(page, "Resolution (px)", RESOLUTION)
    page.get_by_text(f"{RESOLUTION} ×").first.wait_for(timeout=SECONDS * 1000)


def close_notice(page):
    """Closes what viser says about software rendering."""
    with contextlib.suppress(Exception):
        page.locator("[class*=Notification] button").first.click(timeout=5000)


def status(page):
    return page.locator("text=/step [0-9,]+/").first.locator("xpath=ancestor::*[2]").inner_text(timeout=SECONDS * 1000)


def shown_step(page):
    return int(status(page).split()[1].replace(",", ""))


def wait_for(page, text):
    page.wait_for_timeout(400)  # a camera message may be on its way
    page.get_by_text(text).first.wait_for(timeout=SECONDS * 1000)
    page.wait_for_timeout(400)  # until the browser has drawn it


def rest(page):
    """Waits until the image has its full quality and has not changed for two seconds."""
    wait_for(page, "full quality")
    before, since, end = middle(page), time.monotonic(), time.monotonic() + SECONDS
    while time.monotonic() < since + 2:
        if time.monotonic() > end:
            check(False, "the image comes to rest")
        page.wait_for_timeout(300)
        now = middle(page)
        if difference(now, before) or "full quality" not in status(page):
            before, since = now, time.monotonic()


def middle(page, path=None):
    data = page.screenshot(clip=MIDDLE)
    if path is not None:
        page.screenshot(path=path)
    return iio.imread(io.BytesIO(data))[..., :3].astype(float)


def difference(a, b):
    return float(np.abs(a - b).mean())


def wait_until_changed(page, before):
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        if difference(middle(page), before) > 0.2:
            page.wait_for_timeout(1500)  # more may follow
            return True
        page.wait_for_timeout(300)
    return False


def drag(page, x, y):
    page.mouse.move(300, 300)
    page.mouse.down()
    for part in range(1, 7):
        page.mouse.move(300 + x * part / 6, 300 + y * part / 6)
        page.wait_for_timeout(60)
    page.mouse.up()


def select(page, label, value):
    page.get_by_label(label, exact=True).first.click()
    page.get_by_role("option", name=value, exact=True).click()


def number(page, label, value):
    field = page.get_by_label(label, exact=True)
    field.fill(value)
    field.press("Enter")
    page.wait_for_timeout(300)  # viser drops changes that follow each other faster than a hand can make them


# Processes


@contextlib.contextmanager
def server(program, *flags, flag="port"):
    """Yields a program that serves on a free port, and the port."""
    port = free_port()
    command = [sys.executable, "-m", module_of(program), *flags, f"--{flag}={port}"]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    try:
        for line in process.stderr:
            print("   ", line.rstrip())
            if line.startswith("viewer"):
                break
        else:
            sys.exit(f"{program} did not serve")
        threading.Thread(target=process.stderr.read, daemon=True).start()  # a full pipe would block the program
        yield process, port
    finally:
        process.terminate()
        process.wait()


def call(program, *flags):
    subprocess.run([sys.executable, "-m", module_of(program), *map(str, flags)], cwd=ROOT, check=True)


def cpu_seconds(process):
    fields = pathlib.Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def check(passed, what):
    print(f"{'ok  ' if passed else 'FAIL'}  {what}", flush=True)
    if not passed:
        sys.exit(1)


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
