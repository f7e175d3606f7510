"""Draws an exported GLB with three.js and compares it with the field: mesh_in_browser.py OUT.

It needs what viewer_in_browser.py needs, and npm, which fetches three.js. OUT receives three.js, unless it holds it
already, the files, and a picture of each: the field on the left, the mesh on the right.

The mesh is that of a scene in closed form, so that its surfaces are known to be where the field is opaque; a field that
was trained for a minute can have a dent under a highlight. The export does not use the camera that is compared. z is up
in the dataset's files, and must have become the y of glTF. Pixels count where the field and the mesh are opaque.

A correct file gave a PSNR of 25.6 dB with vertex colours and 25.7 dB with a texture on a fifth of the triangles, a mean
difference of at most 0.010 of any channel, and covered 99.2 % of the pixels (three.js r187, SwiftShader); outlines,
soft in the field and sharp in a mesh, are most of the error. The bars leave room for other versions. Each file that is
wrong in one way must miss one: colours that are not converted to linear light, a missing turn, faces whose fronts are
inside, and a material that waits for lamps.
"""

import base64
import contextlib
import functools
import http.server
import io
import json
import pathlib
import shutil
import subprocess
import sys
import tarfile
import threading

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
from viewer_in_browser import check, chromium

from export_sources import TO_FILE, source_of
from jaxnerf import Camera, look_at, pixel_grid, psnr, rays_from_pixels, render_image, render_rays
from jaxnerf.data.geometry.world import poses_in_file
from jaxnerf.tools.embedded_scene import still_life
from jaxnerf.tools.exporters.mesh import export_mesh

THREE = "three@0.187.0"
SETTINGS = {"resolution": 128, "size": 200}  # of the export
NUM_VIEWS, NUM_SAMPLES = 24, 256
BODIES = [body for body in still_life.BODIES if body.peak >= 10]  # glass has no surface, and no mesh shows it
DENSER = 5.0  # so that the outlines are crisp
EYE, SIZE, FOCAL = np.float32([1.4, -2.3, 1.1]), 300, 640.0  # of the camera that is compared; px
Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)  # z of the files to y of glTF
OPAQUE = 0.99  # opacity of the field
MIN_PSNR = 23.0  # dB
MAX_BIAS = 0.02  # |mean difference| of a colour channel, in [0, 1]
MIN_COVERED = 0.97  # of the field's opaque pixels
PAGE = """<!doctype html><script type="importmap">
{"imports": {"three": "./three/package/build/three.module.js",
             "loader": "./three/package/examples/jsm/loaders/GLTFLoader.js"}}
</script><script type="module">
import * as THREE from "three";
import {GLTFLoader} from "loader";
window.draw = async (file, width, height, projection, pose) => {
  const renderer = new THREE.WebGLRenderer({alpha: true, antialias: false, preserveDrawingBuffer: true});
  renderer.setSize(width, height);
  const scene = (await new GLTFLoader().loadAsync(file)).scene;
  const camera = new THREE.Camera();  // matrices are given by rows
  camera.projectionMatrix.set(...projection);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  camera.matrixAutoUpdate = false;
  camera.matrix.set(...pose);
  camera.updateMatrixWorld(true);
  renderer.render(scene, camera);
  const image = renderer.domElement.toDataURL("image/png");
  renderer.dispose();
  return image;
};
</script>"""


def main(out):
    out.mkdir(parents=True, exist_ok=True)
    fetch_three(out / "three")
    field, opacity, camera = render_field()
    glb = export(out)
    files = {"exported": glb, **{name: change(glb) for name, change in WRONG.items()}}
    files["textured"] = export(out, texture=1024, max_faces=30_000)
    (out / "index.html").write_text(PAGE)
    with serve(out) as port, chromium() as browser:
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{port}/index.html")
        page.wait_for_function("() => window.draw !== undefined")
        for name, content in files.items():
            path = out / f"{name.replace(' ', '_')}.glb"
            path.write_bytes(content)
            drawn = draw(page, path.name, camera)
            iio.imwrite(path.with_suffix(".png"), side_by_side(field + 1 - opacity[..., None], drawn))
            passed, what = compare(field, opacity, drawn)
            if name in ("exported", "textured"):
                check(passed, f"three.js draws the {name} mesh as the field is rendered: {what}")
            else:
                check(not passed, f"a mesh with {name} is noticed: {what}")


def compare(field, opacity, drawn):
    """Returns whether a drawing passes, and its figures."""
    solid, covered = opacity > OPAQUE, drawn[..., 3] == 1
    both = solid & covered
    part = both.sum() / solid.sum()
    if not both.any():
        return False, "no pixel is covered"
    score = float(psnr(field[both], drawn[both][:, :3]))
    bias = (drawn[both][:, :3] - field[both]).mean(axis=0)
    passed = score >= MIN_PSNR and np.abs(bias).max() <= MAX_BIAS and part >= MIN_COVERED
    bias = ", ".join(f"{value:+.3f}" for value in bias)
    return passed, f"PSNR {score:.1f} dB, mean difference of R, G, B {bias}, {part:.1%} of the pixels covered"


def scene(x, viewdirs):
    """The opaque bodies of the embedded scene, without highlights, at half their size, which TO_FILE doubles."""
    del viewdirs
    place = tuple(jnp.moveaxis(2 * x, -1, 0))
    density = jnp.stack([body.density(body.distance(*place)) for body in BODIES], axis=-1)
    rgb = jnp.stack([jnp.stack(body.color(*place, None), axis=-1) for body in BODIES], axis=-2)
    total = density.sum(axis=-1)
    return DENSER * total, (density[..., None] * rgb).sum(axis=-2) / (total[..., None] + 1e-12)


def export(folder, **settings):
    """Returns the bytes of the GLB."""
    settings = {"format": "glb", "up": "+z", **SETTINGS, **settings}
    source = source_of(scene, say=print, count=NUM_VIEWS, num_samples=NUM_SAMPLES, **settings)
    export_mesh(source, folder)
    return (folder / "mesh.glb").read_bytes()


def render_field():
    """Returns rgb [SIZE, SIZE, 3] and opacity of the view, and its camera in the axes of the files."""
    pose = look_at(EYE, np.zeros(3), np.float32([0, 0, 1]))
    focal, center = np.full(2, FOCAL), np.full(2, SIZE / 2)
    camera = Camera(to_world=pose, focal=focal, center=center, height=SIZE, width=SIZE)
    rays = rays_from_pixels(camera, pixel_grid(SIZE, SIZE), near=1.5, far=4.5)
    render = jax.jit(functools.partial(render_rays, None, scene, num_samples=NUM_SAMPLES))
    image = jax.tree.map(np.asarray, render_image(render, rays, chunk=4096))
    pose = poses_in_file(np.asarray(pose)[None], TO_FILE)[0]
    return image.rgb, image.opacity, (pose, camera.focal, camera.center, SIZE, SIZE)


def draw(page, name, camera):
    """Returns the picture [H, W, 4], in [0, 1], that three.js draws of a file."""
    pose, focal, center, height, width = camera
    near, far = 0.01, 100.0
    projection = np.zeros((4, 4))
    projection[0, [0, 2]] = 2 * focal[0] / width, 1 - 2 * center[0] / width
    projection[1, [1, 2]] = 2 * focal[1] / height, 2 * center[1] / height - 1
    projection[2, 2:] = -(far + near) / (far - near), -2 * far * near / (far - near)
    projection[3, 2] = -1
    pose = Y_UP @ np.concatenate([pose, [[0, 0, 0, 1]]])
    arguments = [name, width, height, projection.reshape(-1).tolist(), pose.reshape(-1).tolist()]
    url = page.evaluate("arguments => window.draw(...arguments)", arguments)
    return iio.imread(io.BytesIO(base64.b64decode(url.partition(",")[2]))) / 255.0


def side_by_side(field, drawn):
    over_white = drawn[..., :3] * drawn[..., 3:] + 1 - drawn[..., 3:]
    return np.uint8(np.rint(255 * np.clip(np.concatenate([field, over_white], axis=1), 0, 1)))


# Files that are wrong in one way


def with_srgb_numbers(glb):
    """The colours as most programs store them in 8 bits, where glTF expects linear light."""
    tree, binary = parts(glb)
    colors = accessor(tree, binary, "COLOR_0", "<f4", 4)
    linear = colors[:, :3].copy()
    colors[:, :3] = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return assembled(tree, binary)


def with_z_up(glb):
    tree, binary = parts(glb)
    for node in tree["nodes"]:
        node.pop("matrix", None)
    return assembled(tree, binary)


def with_faces_inwards(glb):
    tree, binary = parts(glb)
    primitive = tree["meshes"][0]["primitives"][0]
    faces = accessor(tree, binary, primitive["indices"], "<u4", 3)
    faces[:] = faces[:, ::-1].copy()
    return assembled(tree, binary)


def with_a_lit_material(glb):
    tree, binary = parts(glb)
    del tree["materials"][0]["extensions"], tree["extensionsUsed"]
    return assembled(tree, binary)


WRONG = {
    "sRGB numbers as linear light": with_srgb_numbers,
    "z up": with_z_up,
    "faces inwards": with_faces_inwards,
    "a lit material": with_a_lit_material,
}


def parts(glb):
    length = int.from_bytes(glb[12:16], "little")
    return json.loads(glb[20 : 20 + length]), bytearray(glb[28 + length :])


def accessor(tree, binary, name, dtype, columns):
    """Returns a view of an attribute's numbers, by its name, or of an accessor's, by its index."""
    if isinstance(name, str):
        name = tree["meshes"][0]["primitives"][0]["attributes"][name]
    found = tree["accessors"][name]
    assert found["componentType"] == {"<f4": 5126, "<u4": 5125}[dtype]
    start = tree["bufferViews"][found["bufferView"]].get("byteOffset", 0) + found.get("byteOffset", 0)
    scalars = found["count"] * {"SCALAR": 1, "VEC4": 4}[found["type"]]
    return np.frombuffer(binary, dtype, scalars, start).reshape(-1, columns)


def assembled(tree, binary):
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = [(text, b"JSON"), (bytes(binary), b"BIN\0")]
    body = b"".join(len(data).to_bytes(4, "little") + kind + data for data, kind in chunks)
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body


# Processes


def fetch_three(folder):
    if folder.exists():
        return
    partial = folder.with_name("three.tmp")
    partial.mkdir(exist_ok=True)
    command = ["npm", "pack", "--silent", THREE]
    if shutil.which("npm") is None:
        sys.exit("npm: there is no such program; install it (Debian: apt-get install npm)")
    name = subprocess.run(command, cwd=partial, check=True, capture_output=True, text=True).stdout.split()[-1]
    with tarfile.open(partial / name) as archive:
        archive.extractall(partial, filter="data")
    partial.rename(folder)


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@contextlib.contextmanager
def serve(folder):
    """Serves a folder, and yields the port."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield server.server_port
    finally:
        server.shutdown()
        server.server_close()


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
