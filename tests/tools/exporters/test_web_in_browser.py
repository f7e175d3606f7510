"""A page of a small scene in headless Chromium: its images, a broken file, and what resizing and closing leave.

Skipped without playwright or Chromium. experiments/web/web.py compares trained runs.
"""

import os
import pathlib
import sys

import jax
import numpy as np
import pytest
from test_web import FIELDS, packed

from jaxnerf import Camera, look_at, pixel_grid, psnr, rays_from_pixels, round_to_8_bits
from jaxnerf.models.occupancy import render_with_grid
from jaxnerf.tools.exporters import web
from runs import ROOT

sys.path.append(str(ROOT / "experiments" / "web"))

SIZE, NEAR, FAR = 24, 1.0, 6.0
STEP, EPS = 0.02, 0.01  # of `packed`


@pytest.fixture(scope="module")
def browser():
    pytest.importorskip("playwright")
    import web as comparison  # experiments/web/web.py

    if not os.path.exists(comparison.CHROMIUM):
        pytest.skip(f"{comparison.CHROMIUM}: there is no browser")
    with comparison.browser_page(200, 160) as page:
        yield comparison, page


def camera():
    pose = look_at(np.float32([2.5, 2.0, 2.0]), np.float32([0.0, -0.2, 0.5]), np.float32([0.0, 0.0, 1.0]))
    return Camera(to_world=pose, focal=np.full(2, 1.4 * SIZE), center=np.full(2, SIZE / 2), height=SIZE, width=SIZE)


def view():
    found = camera()
    lens = {"focal": found.focal.tolist(), "center": found.center.tolist(), "width": SIZE, "height": SIZE}
    return {"pose": np.asarray(found.to_world).reshape(-1).tolist(), "near": NEAR, "far": FAR, **lens}


def written(scene, folder):
    """Returns the page of a scene, in a folder."""
    seen = {"name": "view", **view()}
    pose = seen["pose"]
    text = {"name": "noise", "how": "", "cameras": [seen], "tour": [pose, pose], "target": [0, 0, 0], "up": [0, 0, 1]}
    path = pathlib.Path(folder) / "index.html"
    path.write_text(web.page(web.encode(scene, {**text, "near": NEAR, "far": FAR})))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("contracted", [False, True])
def test_the_browser_draws_what_jaxnerf_renders(browser, tmp_path, contracted):
    comparison, page = browser
    field, scene = packed(FIELDS["hashed"], contracted=contracted, as_scene=True)
    requests = []
    page.on("request", lambda request: requests.append(request.url))
    comparison.open_page(page, written(scene, tmp_path))
    drawn = comparison.draw(page, view())
    assert len(requests) == 1  # the page itself
    rays = rays_from_pixels(camera(), pixel_grid(SIZE, SIZE), near=NEAR, far=FAR)
    sides = np.asarray(scene.grid.upper) - np.asarray(scene.grid.lower)
    options = {"step_size": STEP, "cell": tuple((sides / scene.grid.occupied.shape).tolist()), "early_stop_eps": EPS}
    image = jax.jit(lambda rays: render_with_grid(field, scene.grid, rays, max_samples=4096, **options))(rays)
    assert np.ptp(np.asarray(image.rgb)) > 0.3
    assert psnr(drawn / 255.0, round_to_8_bits(image.rgb)) > 40


@pytest.mark.slow
def test_a_broken_file_says_so(browser, tmp_path):
    _, page = browser
    path = written(packed(FIELDS["dense"])[1], tmp_path)
    text = path.read_text()
    place = text.index('data-kind="embedded">') + 2000
    path.write_text(text[:place] + ("A" if text[place] != "A" else "B") + text[place + 1 :])
    page.goto(path.as_uri())
    page.wait_for_function("() => document.getElementById('message').textContent.includes('damaged')")


@pytest.mark.slow
def test_resizing_and_closing_leave_nothing_on_the_gpu(browser, tmp_path):
    comparison, page = browser
    path = written(packed(FIELDS["dense"])[1], tmp_path)
    counter = """<script>
      window.alive = 0;
      for (const kind of ["Texture", "Framebuffer", "Program", "VertexArray"]) {
        const made = WebGL2RenderingContext.prototype["create" + kind];
        const freed = WebGL2RenderingContext.prototype["delete" + kind];
        WebGL2RenderingContext.prototype["create" + kind] = function () { window.alive++; return made.call(this); };
        const remove = function (it) { window.alive--; return freed.call(this, it); };
        WebGL2RenderingContext.prototype["delete" + kind] = remove;
      }</script>"""
    path.write_text(path.read_text().replace("<style>", counter + "<style>", 1))
    comparison.open_page(page, path)
    counts = []
    for size in (8, 16, 12):
        comparison.draw(page, {**view(), "width": size, "height": size})
        counts.append(page.evaluate("() => window.alive"))
    assert counts[0] == counts[1] == counts[2] > 0
    assert page.evaluate("() => { window.jaxnerf.close(); return window.alive; }") == 0
