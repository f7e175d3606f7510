"""Draws an exported splats.spz with Spark, a web viewer, and compares it with the rasterizer that scores exports.

    npm install --prefix OUT @sparkjsdev/spark
    python experiments/exports/splats_in_spark.py --workdir=W --splats=W/exports/splats-3000/splats.spz --out=OUT

z is up in the dataset's files. Each row is a test view, over the run's background: the PSNR of Spark's drawing with
that of the rasterizer, and that of both with the dataset's image. OUT receives the file, and a picture of the first
view: the image, the rasterizer's, and Spark's. It needs what tests/slow/viewer_in_browser.py needs.
"""

import pathlib
import shutil
import sys

import imageio.v3 as iio
import numpy as np
from absl import flags

sys.path.extend(
    str(pathlib.Path(__file__).resolve().parents[2] / name) for name in ("experiments", "tests", "tests/slow")
)
import common
from mesh_in_browser import draw, serve
from viewer_in_browser import chromium

from jaxnerf.core.metrics import psnr
from jaxnerf.core.types import Camera
from jaxnerf.data.geometry.world import poses_in_file
from jaxnerf.evaluation.restore import newest_step, refined_views, restore_run
from jaxnerf.runtime import cli
from jaxnerf.tools.exporters.gaussians import rasterize, read_spz

_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of a run.", required=True)
_SPLATS = flags.DEFINE_string("splats", None, "The .spz file.", required=True)
_OUT = flags.DEFINE_string("out", None, "Folder with node_modules, for the page and the picture.", required=True)
_NUM_VIEWS = flags.DEFINE_integer("num_views", 3, "The first test views.")
_FRAMES, _WAIT = 20, 100  # Spark sorts between frames; ms
PAGE = """<!doctype html><script type="importmap">
{"imports": {"three": "./node_modules/three/build/three.module.js",
             "three/addons/": "./node_modules/three/examples/jsm/",
             "spark": "./node_modules/@sparkjsdev/spark/dist/spark.module.js"}}
</script><script type="module">
import * as THREE from "three";
import {SparkRenderer, SplatMesh} from "spark";
window.draw = async (file, width, height, projection, pose) => {
  const renderer = new THREE.WebGLRenderer({alpha: true, antialias: false, preserveDrawingBuffer: true});
  renderer.setSize(width, height);
  const [scene, mesh, camera] = [new THREE.Scene(), new SplatMesh({url: file}), new THREE.PerspectiveCamera()];
  scene.background = new THREE.Color(...BACKGROUND).convertSRGBToLinear();
  mesh.rotation.x = -Math.PI / 2;  // as a GLB is turned
  scene.add(new SparkRenderer({renderer}), mesh);
  await mesh.initialized;
  camera.projectionMatrix.set(...projection);  // matrices are given by rows
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  camera.matrixAutoUpdate = false;
  camera.matrix.set(...pose);
  camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
  for (let frame = 0; frame < FRAMES; frame++) {
    renderer.render(scene, camera);
    await new Promise(resolve => setTimeout(resolve, WAIT));
  }
  const image = renderer.domElement.toDataURL("image/png");
  renderer.dispose();
  return image;
};
</script>"""


def main(argv: list[str]) -> None:
    """Draws and compares."""
    del argv
    out = pathlib.Path(_OUT.value)
    run = restore_run(_WORKDIR.value)
    split = run.experiment.config.eval.split
    variables = run.variables(newest_step(run, _WORKDIR.value))
    views = refined_views(run, run.experiment.load_split(split), split, variables[0])
    poses = poses_in_file(np.asarray(views.cameras.to_world), views.to_file)
    background = np.zeros(3) if run.experiment.background is None else np.asarray(run.experiment.background)
    gaussians, rows = read_spz(_SPLATS.value), []
    shutil.copy(_SPLATS.value, out / "splats.spz")
    page_text = PAGE.replace("BACKGROUND", str(background.tolist())).replace("FRAMES", str(_FRAMES))
    (out / "index.html").write_text(page_text.replace("WAIT", str(_WAIT)))
    with serve(out) as port, chromium() as browser:
        page = browser.new_page()
        page.set_default_timeout(300_000)
        page.goto(f"http://127.0.0.1:{port}/index.html")
        page.wait_for_function("() => window.draw !== undefined")
        for index in range(min(_NUM_VIEWS.value, len(views.size))):
            height, width = (int(side) for side in views.size[index])
            focal, center = (np.asarray(each)[index] for each in (views.cameras.focal, views.cameras.center))
            camera = Camera(to_world=poses[index], focal=focal, center=center, height=height, width=width)
            ours = np.float32(np.clip(rasterize(gaussians, camera, background), 0, 1))
            spark = np.float32(draw(page, "splats.spz", (poses[index], focal, center, height, width))[..., :3])
            truth = np.asarray(views.image(index))
            found = psnr(spark, ours), psnr(spark, truth), psnr(ours, truth)
            rows.append([str(index), *(f"{value:.2f}" for value in found)])
            if index == 0:
                iio.imwrite(out / "splats.png", np.uint8(np.rint(255 * np.concatenate([truth, ours, spark], axis=1))))
    heads = ("view", "Spark and rasterizer (dB)", "Spark and image (dB)", "rasterizer and image (dB)")
    print("\n".join(common.markdown(heads, rows)))


if __name__ == "__main__":
    cli.run(main)
