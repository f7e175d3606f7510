"""Measures the exports of a run on the embedded scene against its closed form.

    python experiments/exports/exports.py --workdir=W [--resolution=256]

The run was trained on the embedded scene. The chamfer distance of a mesh to the surfaces of the opaque bodies is the
sum of two means in world units: from points of the mesh to the bodies, in closed form, and from points of the bodies
to the mesh. Points of the mesh that are nearer to the glass (the brick, and that of the lamp) than to an opaque body
have no counterpart among these and are excluded; "with glass" includes them. All of the bodies' surfaces count, also
the underside of the plinth, a fifth of their area, which no training view sees: only the closed mesh has a surface
there. Seconds include compilation. The CPU seconds of a mesh are those of the functions of the exporter. The PSNR of
splats is that of the test views.
"""

import functools
import pathlib
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from absl import flags
from scipy.spatial import cKDTree

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common

from jaxnerf.runtime import cli
from jaxnerf.tools.embedded_scene.still_life import BODIES
from jaxnerf.tools.exporters import mesh as mesh_exporter
from jaxnerf.tools.exporters.base import export_run

_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of a run on the embedded scene.", required=True)
_RESOLUTION = flags.DEFINE_integer("resolution", 256, "Voxels along the longest side.")
_NUM_POINTS = flags.DEFINE_integer("num_points", None, "Points or Gaussians; None: the exporter's own.")
_EXPORTS = flags.DEFINE_list("exports", ["mesh", "closed", "points", "splats"], "Of mesh, closed, points, splats.")
_KINDS = {
    "mesh": ("mesh", {}),
    "closed": ("mesh", {"closed": True}),
    "points": ("points", {}),
    "splats": ("splats", {}),
}
_STAGES = {  # functions of the exporter of meshes
    "depth images": "render_depth_images",
    "fusion": "fuse",
    "free space": "solid_field",
    "level set": "level_set",
    "colours": "surface_colors",
}
_SAMPLES = 150_000  # points on each surface
_EXTENT = 1.2  # half the side of the box that holds the scene

_DENSE = 10.0  # 1 / world unit; bodies of a higher density are opaque, the brick and the lamp's glass are not


@functools.partial(jax.jit, static_argnames="opaque")
def distance_to(x: jax.Array, *, opaque: bool) -> jax.Array:
    """Returns the signed distance [...] of x [..., 3] from the nearest opaque or transparent body, negative inside.

    It is exact near the surface of an opaque body. That from the brick is approximate, and 0 where it should be.
    """
    bodies = [body for body in BODIES if (body.peak >= _DENSE) == opaque]
    return jnp.min(jnp.stack([body.distance(x[..., 0], x[..., 1], x[..., 2]) for body in bodies]), axis=0)


_opaque, _glass = functools.partial(distance_to, opaque=True), functools.partial(distance_to, opaque=False)


def main(argv: list[str]) -> None:
    """Exports and measures."""
    del argv
    rows, measured, profiles, spent = [], [], [], timed_stages()
    for name in common.chosen("--exports", _EXPORTS.value, _KINDS):
        kind, settings = _KINDS[name]
        if _NUM_POINTS.value and kind != "mesh":
            settings = {**settings, "num_points": _NUM_POINTS.value}
        said, started, cpu = [], time.perf_counter(), time.process_time()
        folder = export_run(
            _WORKDIR.value,
            kind,
            name=f"study-{name}",
            overwrite=True,
            say=said.append,
            resolution=_RESOLUTION.value,
            **settings,
        )
        size = sum(path.stat().st_size for path in folder.rglob("*.*")) / 1e6
        seconds = time.perf_counter() - started, time.process_time() - cpu
        rows.append([name, *(f"{each:.0f}" for each in seconds), f"{size:.1f}", said[-1]])
        if kind == "mesh":
            found = chamfer(trimesh.load(folder / "mesh.ply"))
            both = found["accuracy"] + found["completeness"]
            numbers = (found["accuracy"], found["completeness"], both, both + found["glass"])
            measured.append([name, *(f"{number:.4f}" for number in numbers), f"{found['within']:.0%}"])
            profiles.append([name, *(f"{spent.pop(stage, 0):.1f}" for stage in _STAGES), f"{seconds[1]:.1f}"])
    heads = ("mesh to bodies", "bodies to mesh", "chamfer distance", "with glass", "of the bodies within 0.02")
    lines = [*common.markdown(("mesh", *heads), measured), ""] if measured else []
    lines += [*common.markdown(("CPU seconds", *_STAGES, "all"), profiles), ""] if profiles else []
    lines += common.markdown(("export", "seconds", "CPU seconds", "MB", "what the program says"), rows)
    print("\n".join([*common.provenance(), "", *lines]))


def timed_stages() -> dict[str, float]:
    """Returns CPU seconds by stage, to which each call of the exporter's functions adds its own."""
    spent: dict[str, float] = {}

    def timed(stage, function):
        def call(*args, **options):
            started = time.process_time()
            result = function(*args, **options)
            spent[stage] = spent.get(stage, 0) + time.process_time() - started
            return result

        return call

    for stage, name in _STAGES.items():
        if hasattr(mesh_exporter, name):
            setattr(mesh_exporter, name, timed(stage, getattr(mesh_exporter, name)))
    return spent


def chamfer(mesh: trimesh.Trimesh) -> dict[str, float]:
    """Returns mean distances between a mesh and the opaque bodies, in world units; see the module's docstring."""
    points = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)[0].astype(np.float32)
    distance = np.abs(np.asarray(_opaque(points)))
    on_glass = np.abs(np.asarray(_glass(points))) < distance
    bodies = body_points(np.random.default_rng(0))
    missed = cKDTree(points).query(bodies)[0]
    return {
        "accuracy": float(distance[~on_glass].mean()),
        "glass": float(distance.mean() - distance[~on_glass].mean()),
        "completeness": float(missed.mean()),
        "within": float((missed < 0.02).mean()),
    }


def body_points(rng: np.random.Generator) -> np.ndarray:
    """Returns points [N, 3] on the surfaces of the opaque bodies, evenly by area."""
    found, width = [], 0.01  # a shell around the surfaces, of even thickness
    while sum(map(len, found)) < _SAMPLES:
        x = rng.uniform(-_EXTENT, _EXTENT, (1_000_000, 3)).astype(np.float32)
        near = np.abs(np.asarray(_opaque(x))) < width
        x = np.asarray(_on_surface(x))
        found.append(x[near & (np.abs(np.asarray(_opaque(x))) < 1e-4)])
    return np.concatenate(found)[:_SAMPLES]


@jax.jit
def _on_surface(x):
    for _ in range(3):
        x = x - _opaque(x)[:, None] * jax.vmap(jax.grad(_opaque))(x)
    return x


if __name__ == "__main__":
    cli.run(main)
