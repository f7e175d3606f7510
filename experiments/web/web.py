"""Compares exported web pages, drawn by headless Chromium, with the renderer of jaxnerf-eval.

    python experiments/web/web.py [--runs=demo,lego,fox] [--workdirs=W1,W2] [--size=100]

Each of `--runs` is trained to runs/web/NAME unless it is there, by `jaxnerf-train` with the flags of RUNS. Each run is
exported with `--kind=web`. The first three test views, without their lens, are drawn at the same size by
the page, in SwiftShader, which runs WebGL 2 on the CPU, and by the function that jaxnerf-eval and the viewer use.
"equal to" is the lowest PSNR of the three between both, on 8-bit colours. "loss" is what the export prints: the PSNR of
the run on up to four test views of its dataset, minus that with the page's textures. Seconds are medians of the
three, with the process and the browser on the same core(s); those of the page include the waits for animation frames.
The GFLOP of a frame are an estimate from the generated shader: operations of a sample, see `operations_per_sample`,
times the samples that the run's grid and early termination leave of the first of these views.

It needs playwright, and Chromium, whose path the environment variable CHROMIUM replaces.
"""

import contextlib
import os
import pathlib
import re
import statistics
import subprocess
import sys
import time

import jax
import numpy as np
from absl import flags

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.core.cameras import ndc_rays, pixel_grid, rays_from_pixels
from jaxnerf.core.metrics import psnr, round_to_8_bits
from jaxnerf.core.types import Camera
from jaxnerf.evaluation.restore import newest_step, refined_views, restore_run
from jaxnerf.runtime import cli
from jaxnerf.tools.exporters.base import export_run

CHROMIUM = os.environ.get("CHROMIUM", "/usr/bin/chromium")
FLAGS = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
NUM_VIEWS, TIMEOUT = 3, 300_000  # ms
RUNS = {
    "demo": ["--config=quickstart"],
    "lego": ["--config=lego_fast", "--config.train.max_seconds=60"],
    "lego_200": ["--config=lego_fast", "--config.data.factor=4", "--config.train.max_seconds=60"],
    "lego_400": ["--config=lego_fast", "--config.data.factor=2", "--config.train.max_seconds=90"],
    "fox": ["--config=capture", "--data_dir=fox", "--config.train.max_seconds=120"],
    "can": ["--config=capture", "--data_dir=can", "--config.train.max_seconds=60"],
    "fern": ["--config=capture", "--data_dir=fern", "--config.train.max_seconds=60"],
}
FOLDER = pathlib.Path("runs/web")


def main(argv: list[str]) -> None:
    """Exports, draws and compares."""
    del argv
    rows = []
    chosen = common.chosen("--runs", _RUNS.value, RUNS)
    for name in chosen:
        train(name)
    with browser_page() as page:
        for workdir in [*(str(FOLDER / name) for name in chosen), *_WORKDIRS.value]:
            said = []
            started = time.perf_counter()
            folder = export_run(workdir, "web", name="study-web", overwrite=True, say=said.append)
            seconds = time.perf_counter() - started
            requests = []
            page.on("request", lambda request, found=requests: found.append(request.url))
            found = compare(page, folder / "index.html", workdir, _SIZE.value)
            lost = re.search(r"PSNR ([\d.]+) dB .* has ([\d.]+) dB; features of (\d+ bits)", said[-1])
            rows.append(
                [
                    pathlib.Path(workdir).name,
                    f"{(folder / 'index.html').stat().st_size / 1e6:.1f}",
                    lost[3],
                    f"{float(lost[2]):.2f}",
                    f"{float(lost[2]) - float(lost[1]):.2f}",
                    f"{min(found['psnr']):.1f}",
                    f"{statistics.median(found['page']):.1f}",
                    f"{statistics.median(found['eval']):.2f}",
                    f"{found['gflop']:.2f}",
                    f"{seconds:.0f}",
                    f"{len(requests) - 1}",
                ]
            )
    heads = ("scene", "MB", "features", "PSNR (dB)", "loss (dB)", "equal to (dB)")
    heads += ("s, page", "s, jaxnerf", "GFLOP", "s, export", "requests")
    print("\n".join([*common.provenance(), "", *common.markdown(heads, rows)]))


def train(name: str) -> None:
    """Trains a run of RUNS unless it has a checkpoint."""
    if not (FOLDER / name / "checkpoints").exists():
        command = [sys.executable, "-m", "jaxnerf.train", *RUNS[name], "--config.train.preview_every=0"]
        subprocess.run([*command, f"--workdir={FOLDER / name}"], check=True)


@contextlib.contextmanager
def browser_page(width=400, height=300):
    """Yields a page of a headless browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(TIMEOUT)
        yield page
        browser.close()


def open_page(page, path: pathlib.Path) -> None:
    """Opens an exported page from its folder and waits for the scene."""
    page.goto(path.resolve().as_uri())
    page.wait_for_function("() => window.jaxnerf !== undefined")


def draw(page, view: dict) -> np.ndarray:
    """Returns what the page draws of a view [H, W, 3] uint8; see `Renderer.begin` in renderer.js."""
    pixels = page.evaluate("async view => Array.from(await window.jaxnerf.render(view))", view)
    return np.uint8(pixels).reshape(view["height"], view["width"], 4)[..., :3]


def compare(page, path: pathlib.Path, workdir: str, size: int) -> dict:
    """Returns PSNR, seconds by renderer, and GFLOP, of the first test views."""
    run = restore_run(workdir)
    variables = run.variables(newest_step(run, workdir))
    split = run.experiment.config.eval.split
    views = refined_views(run, run.experiment.load_split(split), split, variables[0])
    open_page(page, path)
    found = {"psnr": [], "page": [], "eval": []}
    for index in range(min(NUM_VIEWS, len(views.size))):
        view, rays = view_of(views, index, size, ndc=run.experiment.config.data.ndc)
        run.render_image(variables, rays)  # compiles
        started = time.perf_counter()
        image = np.asarray(run.render_image(variables, rays).rgb)
        found["eval"].append(time.perf_counter() - started)
        started = time.perf_counter()
        drawn = draw(page, view)
        found["page"].append(time.perf_counter() - started)
        found["psnr"].append(float(psnr(drawn / 255.0, np.asarray(round_to_8_bits(np.clip(image, 0, 1))))))
        if index == 0:
            operations = page.evaluate("() => window.jaxnerf.content.operations")
            found["gflop"] = operations * num_samples(run, variables, rays) / 1e9
    return found


def view_of(views, index: int, size: int, *, ndc: bool = False):
    """Returns a view without its lens, for the page, and its Rays [H, W]."""
    camera = jax.tree.map(lambda leaf: np.asarray(leaf)[index], views.cameras)
    scale = size / max(views.size[index])
    height, width = (round(float(side) * scale) for side in views.size[index])
    pinhole = Camera(
        to_world=camera.to_world, focal=camera.focal * scale, center=camera.center * scale, height=height, width=width
    )
    near, far = float(views.near[index]), float(views.far[index])
    rays = rays_from_pixels(pinhole, pixel_grid(height, width), near=near, far=far)
    if ndc:  # which the view's own lens defines
        rays = ndc_rays(rays, views.camera(index))
    view = {"pose": pinhole.to_world.reshape(-1).tolist(), "width": width, "height": height, "near": near}
    return view | {"far": far, "focal": pinhole.focal.tolist(), "center": pinhole.center.tolist()}, rays


def num_samples(run, variables, rays) -> int:
    """Returns the samples that rays need until they are opaque."""
    from jaxnerf.core.occupancy.grid import is_occupied
    from jaxnerf.core.occupancy.ray_marching import march_rays
    from jaxnerf.core.rendering import points_on_rays, segment_lengths

    experiment, (params, grid) = run.experiment, variables
    view, schedule = experiment.config.eval, experiment.model.grid_schedule
    step = schedule.step_size / view.sample_multiplier

    @jax.jit
    def count(params, grid, rays):
        samples = march_rays(None, grid, rays, step_size=step, cell=schedule.cell)
        kept = is_occupied(grid, rays, samples.t) & (samples.delta > 0)
        density, _ = experiment.model.scene(params, grid)(points_on_rays(rays, samples.t), rays.viewdirs[..., None, :])
        depth = jax.numpy.where(kept, density * segment_lengths(samples.delta, rays), 0)
        before = jax.numpy.cumsum(depth, axis=-1) - depth
        return (kept & (jax.numpy.exp(-before) > view.early_stop_eps)).sum()

    rows = (jax.tree.map(lambda leaf, row=row: leaf[row], rays) for row in range(len(rays.near)))
    return sum(int(count(params, grid, each)) for each in rows)


if __name__ == "__main__":
    _WORKDIRS = flags.DEFINE_list("workdirs", [], "Folders of trained runs.")
    _RUNS = flags.DEFINE_list("runs", list(RUNS), "Of RUNS.")
    _SIZE = flags.DEFINE_integer("size", 100, "px, the longer side of what is drawn.")
    cli.run(main)
