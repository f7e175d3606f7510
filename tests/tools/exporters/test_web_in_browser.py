"""A page of a small scene in headless Chromium: its images, a broken file, and what resizing and closing leave.

Skipped without playwright or Chromium. experiments/web/web.py compares trained runs.
"""

import dataclasses
import os
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_web import FIELDS, packed

from jaxnerf import Camera, look_at, ndc_rays, pixel_grid, psnr, rays_from_pixels, round_to_8_bits
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


def camera(ndc=False, z=0.15):
    pose = look_at(np.float32([2.5, 2.0, 2.0]), np.float32([0.0, -0.2, 0.5]), np.float32([0.0, 0.0, 1.0]))
    if ndc:
        pose = look_at(np.float32([0.1, -0.2, z]), np.float32([0.2, 0.1, -3.0]), np.float32([0.0, 1.0, 0.0]))
    return Camera(to_world=pose, focal=np.full(2, 1.4 * SIZE), center=np.full(2, SIZE / 2), height=SIZE, width=SIZE)


def view(*place):
    found = camera(*place)
    lens = {"focal": found.focal.tolist(), "center": found.center.tolist(), "width": SIZE, "height": SIZE}
    return {"pose": np.asarray(found.to_world).reshape(-1).tolist(), "near": NEAR, "far": FAR, **lens}


def written(scene, folder, **more):
    """Returns the page of a scene, in a folder; more: of its description."""
    seen = {"name": "view", **view(scene.ndc)}
    pose = seen["pose"]
    text = {"name": "noise", "how": "", "cameras": [seen], "tour": [pose, pose], "target": [0, 0, 0], "up": [0, 0, 1]}
    text["ndc_scale"] = [2 * focal / SIZE for focal in seen["focal"]]
    text |= more
    path = pathlib.Path(folder) / "index.html"
    path.write_text(web.page(web.encode(scene, {**text, "near": NEAR, "far": FAR})))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("space, z", [("box", 0.0), ("contracted", 0.0), ("ndc", 0.15), ("ndc", -1.25)])
def test_the_browser_draws_what_jaxnerf_renders(browser, tmp_path, space, z):
    comparison, page = browser
    ndc = space == "ndc"
    field, scene = packed(FIELDS["hashed"], contracted=space == "contracted", ndc=ndc, as_scene=True)
    requests = []
    page.on("request", lambda request: requests.append(request.url))
    comparison.open_page(page, written(scene, tmp_path))
    drawn = comparison.draw(page, view(ndc, z))
    assert len(requests) == 1  # the page itself
    rays = rays_from_pixels(camera(ndc, z), pixel_grid(SIZE, SIZE), near=NEAR, far=FAR)
    if ndc:  # from the eye on, where that is beyond the near plane
        begin = max(0.0, 1 + 1 / min(z, -1.0))
        rays = dataclasses.replace(ndc_rays(rays, camera()), near=jnp.full_like(rays.near, begin))
    sides = np.asarray(scene.grid.upper) - np.asarray(scene.grid.lower)
    options = {"step_size": STEP, "cell": tuple((sides / scene.grid.occupied.shape).tolist()), "early_stop_eps": EPS}
    image = jax.jit(lambda rays: render_with_grid(field, scene.grid, rays, max_samples=4096, **options))(rays)
    assert np.ptp(np.asarray(image.rgb)) > 0.3
    assert psnr(drawn / 255.0, round_to_8_bits(image.rgb)) > 40


@pytest.mark.slow
def test_the_page_opens_at_the_start_of_the_tour_and_shows_whole_images(browser, tmp_path):
    comparison, page = browser
    start = np.asarray(look_at(np.float32([0, -3, 0]), np.zeros(3, np.float32), np.float32([0, 0, 1])))
    tour, seen = [start.reshape(-1).tolist()] * 2, {"name": "view", **view(), "focal": [30, 20], "center": [20, 9]}
    comparison.open_page(page, written(packed(FIELDS["dense"])[1], tmp_path, cameras=[seen], tour=tour, swing=0.2))
    shown = page.evaluate("() => [window.jaxnerf.view(1), window.jaxnerf.canvas.width, window.jaxnerf.canvas.height]")
    np.testing.assert_allclose(shown[0]["pose"], tour[0], atol=1e-6)
    ratio = min(shown[1:]) / SIZE
    np.testing.assert_allclose(shown[0]["focal"], ratio * np.array([30, 20]))
    np.testing.assert_allclose(shown[0]["center"], np.array(shown[1:]) / 2 + ratio * (np.array([20, 9]) - SIZE / 2))
    page.select_option("#camera", "0")
    np.testing.assert_allclose(page.evaluate("() => window.jaxnerf.view(1).pose"), seen["pose"], atol=1e-6)
    page.evaluate("pose => window.jaxnerf.camera.set(pose, [0, 0, 0])", tour[0])
    many = "for (let i = 0; i < 100; ++i) window.jaxnerf.camera.orbit(0.1, 0);"
    page.evaluate("() => { " + many + " }")
    turned = np.degrees(np.arccos(np.dot(page.evaluate("() => window.jaxnerf.camera.back"), start[:, 2])))
    assert 9 < turned <= np.degrees(0.2) + 0.01  # a scene that is seen from one side stays in front


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
