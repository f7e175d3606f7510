"""Draws exported meshes of a run with three.js, and compares them with the images of its test views.

    python experiments/exports/mesh_views.py --workdir=W --out=OUT [--meshes=vertices,texture_1024]

z is up in the dataset's files. The meshes are MESHES; each is exported as .glb. Views are drawn at three times their
size, and averaged. Pixels count where the run has an opacity above 0.99 and the mesh covers the whole pixel: soft edges
and fog have no surface. "dB, dataset" is the PSNR with the images of the test views over these pixels of all views,
"dB, run" that with what the run renders, and "covered" the fraction of the opaque pixels that the mesh covers. OUT
receives three.js, as in tests/slow/mesh_in_browser.py, which says what it needs, and a picture: the image of the first
view, what the run renders, and each mesh.
"""

import pathlib
import sys
import time

import imageio.v3 as iio
import numpy as np
from absl import flags

sys.path.extend(
    str(pathlib.Path(__file__).resolve().parents[2] / name) for name in ("experiments", "tests", "tests/slow")
)
import common
from mesh_in_browser import PAGE, draw, fetch_three, serve
from viewer_in_browser import chromium

from jaxnerf.core.cameras import pixel_grid
from jaxnerf.core.metrics import psnr
from jaxnerf.data.geometry.world import poses_in_file
from jaxnerf.evaluation.restore import newest_step, refined_views, restore_run
from jaxnerf.runtime import cli
from jaxnerf.tools.exporters.base import export_run

_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of a run.", required=True)
_OUT = flags.DEFINE_string("out", None, "Folder for three.js and the picture.", required=True)
_NUM_VIEWS = flags.DEFINE_integer("num_views", 8, "The first test views.")
MESHES = {
    "vertices": {},
    "vertices_30k": {"max_faces": 30_000},
    "texture_1024": {"texture": 1024},
    "texture_2048": {"texture": 2048},
}
_MESHES = flags.DEFINE_list("meshes", list(MESHES), "Of MESHES.")
_FINER, _OPAQUE = 3, 0.99


def main(argv: list[str]) -> None:
    """Exports, draws and compares."""
    del argv
    out = pathlib.Path(_OUT.value)
    out.mkdir(parents=True, exist_ok=True)
    fetch_three(out / "three")
    (out / "index.html").write_text(PAGE)
    images, rendered, opaque, cameras = views_of(_WORKDIR.value)
    rows, shown = [], [images[0], rendered[0]]
    with serve(out) as port, chromium() as browser:
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{port}/index.html")
        page.wait_for_function("() => window.draw !== undefined")
        for name in common.chosen("--meshes", _MESHES.value, MESHES):
            said, started, cpu = [], time.perf_counter(), time.process_time()
            options = {"name": f"views-{name}", "overwrite": True, "say": said.append}
            folder = export_run(_WORKDIR.value, "mesh", **options, format="glb", up="+z", **MESHES[name])
            seconds = time.perf_counter() - started, time.process_time() - cpu
            content = (folder / "mesh.glb").read_bytes()
            (out / f"{name}.glb").write_bytes(content)
            drawn = np.stack([averaged(draw(page, f"{name}.glb", camera)) for camera in cameras])
            shown.append(drawn[0, ..., :3] + 1 - drawn[0, ..., 3:])
            both = opaque & (drawn[..., 3] == 1)
            found = [float(psnr(drawn[both][:, :3], truth[both])) for truth in (images, rendered)]
            rows.append(
                [
                    name,
                    *(f"{value:.2f}" for value in found),
                    f"{both.sum() / opaque.sum():.1%}",
                    f"{len(content) / 1e6:.1f}",
                    *(f"{each:.0f}" for each in seconds),
                    said[-1],
                ]
            )
    heads = ("mesh", "dB, dataset", "dB, run", "covered", "MB", "seconds", "CPU seconds", "what the program says")
    print("\n".join(common.markdown(heads, rows)))
    iio.imwrite(out / "meshes.png", np.uint8(np.rint(255 * np.clip(np.concatenate(shown, axis=1), 0, 1))))


def views_of(workdir: str):
    """Returns, by test view, its image, what the run renders, where that is opaque, and the camera to draw it with."""
    run = restore_run(workdir)
    variables = run.variables(newest_step(run, workdir))
    split = run.experiment.config.eval.split
    views = refined_views(run, run.experiment.load_split(split), split, variables[0])
    poses = poses_in_file(np.asarray(views.cameras.to_world), views.to_file)
    images, rendered, opaque, cameras = [], [], [], []
    for index in range(min(_NUM_VIEWS.value, len(views.size))):
        height, width = (int(side) for side in views.size[index])
        images.append(np.asarray(views.image(index)))
        image = run.render_image(variables, run.experiment.view_rays(views, index, pixel_grid(height, width)))
        rendered.append(np.clip(image.rgb, 0, 1))
        opaque.append(np.asarray(image.opacity) > _OPAQUE)
        focal, center = (_FINER * np.asarray(each)[index] for each in (views.cameras.focal, views.cameras.center))
        cameras.append((poses[index], focal, center, _FINER * height, _FINER * width))
    return np.stack(images), np.stack(rendered), np.stack(opaque), cameras


def averaged(drawn: np.ndarray) -> np.ndarray:
    """Returns a drawing [H, W, 4], with colours times alpha, at a third of its size."""
    rgba = np.concatenate([drawn[..., :3] * drawn[..., 3:], drawn[..., 3:]], axis=-1)
    height, width = (side // _FINER for side in drawn.shape[:2])
    return rgba.reshape(height, _FINER, width, _FINER, 4).mean(axis=(1, 3)).astype(np.float32)


if __name__ == "__main__":
    cli.run(main)
