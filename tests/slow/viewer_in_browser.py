"""Drives the viewer in a real browser and prints what was seen: viewer_in_browser.py OUT.

It needs Chromium (CHROMIUM, by default /usr/bin/chromium; Debian: apt-get install chromium) and the package playwright.
OUT receives a run of the embedded scene, unless it holds one already, and screenshots.
"""

import contextlib
import io
import os
import pathlib
import subprocess
import sys
import tempfile
import threading
import time

import imageio.v3 as iio
import numpy as np
from playwright.sync_api import sync_playwright

from runs import ROOT, free_port, module_of

CHROMIUM = os.environ.get("CHROMIUM", "/usr/bin/chromium")
FLAGS = [
    *("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--ignore-gpu-blocklist", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
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
