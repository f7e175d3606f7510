"""What the viewer answers to pages that render by themselves, without a browser."""

import gzip
import http.client
import json
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import ball_runs
from jaxnerf.core.occupancy.grid import create_grid
from jaxnerf.fields.hash_grid import hash_grid_field
from jaxnerf.tools.exporters.web import MAGIC
from jaxnerf.tools.viewer import client_rendering, server
from jaxnerf.training.config import RunConfig, changed

SMALL = {"resolutions": (5, 9), "table_size": 2**12, "width": 12, "view_width": 8}
LOWER, UPPER = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)


def hash_grid_run():
    """Returns the parts of a run of a small hash grid that a Viewer reads, its Views, and its variables."""
    run, views = ball_runs.solid_run()
    config, field = changed(RunConfig(), {"data.ndc": False}), hash_grid_field(**SMALL, lower=LOWER, upper=UPPER)
    schedule = SimpleNamespace(step_size=0.1)
    model = run.experiment.model._replace(grid_schedule=schedule, fields={"fine": field})
    experiment = SimpleNamespace(model=model, config=config, cameras=None, background=(1.0, 1.0, 1.0))
    fine = jax.jit(field.init)(jax.random.key(0))
    grid = create_grid(np.float32(LOWER), np.float32(UPPER), np.ones((4, 4, 4), bool), initial_density=1.0)
    return run._replace(experiment=experiment), views, ({"radius": np.float32(0.7), "fine": fine}, grid)


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    run, views, variables = hash_grid_run()
    made = server.Viewer(tmp_path_factory.mktemp("viewed"), run, views)
    made.port, made.variables = made.listen(port=0), variables
    yield made
    made.close()


def get(port, path, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    try:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def content_of(data):
    raw = gzip.decompress(data)
    assert raw.startswith(MAGIC)
    return json.loads(raw[12 : 12 + int(np.frombuffer(raw, "<u4", 1, 8)[0])])


def test_a_page_receives_each_new_step_once(viewer, monkeypatch):
    monkeypatch.setattr(viewer.renderer, "compile", lambda state: pytest.fail("no frame is rendered for such a page"))
    status, page = get(viewer.port, "/")
    assert status == 200 and b'data-kind="live"' in page and viewer.num_browsers == 1
    assert get(viewer.port, "/scene.bin?step=") == (204, b"")  # a training has made no state yet
    viewer.show(20, viewer.variables, "20 dB")
    status, data = get(viewer.port, "/scene.bin?step=")
    content = content_of(data)
    assert status == 200 and content["step"] == 20 and "20 steps" in content["how"] and "20 dB" in content["how"]
    assert get(viewer.port, "/scene.bin?step=20") == (204, b"")
    params, grid = viewer.variables
    table = 0.5 * params["fine"]["table"]
    viewer.show(30, ({**params, "fine": {**params["fine"], "table": table}}, grid))
    status, newer = get(viewer.port, "/scene.bin?step=20")
    assert status == 200 and content_of(newer)["step"] == 30 and newer != data
    assert content_of(newer)["shader"] == content["shader"], "it is compiled once"


def test_parameters_that_cannot_be_shown_are_named(viewer):
    params, grid = viewer.variables
    broken = {**params["fine"], "table": params["fine"]["table"] * np.nan}
    viewer.show(40, ({**params, "fine": broken}, grid))
    status, text = get(viewer.port, "/scene.bin?step=30")
    assert status == 503 and b"not finite" in text


def test_a_page_that_sends_no_more_requests_is_forgotten(viewer, monkeypatch):
    get(viewer.port, "/scene.bin")
    assert viewer.num_browsers == 1
    now = client_rendering.time.monotonic()
    monkeypatch.setattr(client_rendering, "time", SimpleNamespace(monotonic=lambda: now + 11))
    assert viewer.num_browsers == 0


def test_other_sites_and_names_of_the_machine_are_refused(viewer):
    assert get(viewer.port, "/scene.bin", Host="evil.example")[0] == 403
    assert get(viewer.port, "/", Origin="http://evil.example")[0] == 403
    assert get(viewer.port, "/scene.bin", Host=f"localhost:{viewer.port}")[0] in (200, 204, 503)


def test_the_page_with_frames_has_an_address_of_its_own(viewer):
    status, page = get(viewer.port, client_rendering.FRAMES)
    assert status == 200 and b"viser" in page.lower() and b"data-kind" not in page


def test_a_run_that_a_page_cannot_render_has_frames_only(tmp_path):
    made = server.Viewer(tmp_path, *ball_runs.solid_run())
    try:
        port = made.listen(port=0)
        assert "field is 'mlp'" in made.client_rendering.refused
        assert get(port, "/") == get(port, client_rendering.FRAMES)
        assert get(port, "/scene.bin")[0] == 404 and made.num_browsers == 0
    finally:
        made.close()
