"""Hard cases of compositing: rays through a scene that returns given arrays, by render_samples, jitted."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from hard_cases import exact
from hard_cases.checks import TINY, Case, Check, absolute, count, not_finite, of_largest, relative
from hard_cases.rays import MASKED_NAN, RAYS
from jaxnerf import Rays, Samples, render_samples

COLOURS = ("red", "green", "blue")
OUTPUTS = (*COLOURS, "opacity", "depth", "disparity")
ARGUMENTS = ("density", "rgb", "t", "delta", "origins", "directions")


def cases(render=render_samples, outputs="float32", sizes=None):
    """Returns the cases; outputs is the type of the scene's outputs, sizes are the numbers of samples."""
    family = "compositing" if outputs == "float32" else f"compositing, {outputs}"
    return [
        Case(family, name, functools.partial(checks, name, render=render, outputs=outputs))
        for name, ray in RAYS.items()
        if sizes is None or len(ray["t"]) in sizes
    ]


def checks(name, *, render=render_samples, outputs="float32"):
    """Returns what one ray measures, against extended precision and closed formulas."""
    got, clean = _rendered(render, outputs, len(RAYS[name]["t"]))[name]
    ray = rounded(RAYS[name], outputs)
    want = exact.render(ray)
    color, want_color = got["values"][:3], [want[c] for c in COLOURS]
    seen = [got["values"][OUTPUTS.index(output)] for output in ("opacity", "depth", "disparity")]
    opacity, depth, disparity = seen
    weights, total = got["weights"], got["weights"].astype(np.float64).sum()
    expected = np.array([want[output] for output in OUTPUTS], np.float64)
    found = [
        Check("weights, beyond 1e-9", relative(weights, want["weights"], beyond=1e-9), 2e-5),
        Check("weights below 0", count(~(weights >= 0)), 0),
        Check("sum of weights above 1", float(np.maximum(total - 1, 0)), 1e-6),
        Check("opacity", relative(opacity, want["opacity"]), 2e-6),
        Check("opacity outside [0, 1]", count(not 0 <= opacity <= 1), 0),
        Check("colour", absolute(color, want_color), 2e-6),
        Check("weights + transmittance", absolute(got["whole"], 1), 1e-6),
        Check("depth", relative(depth, want["depth"]), 1e-5),
        Check("disparity", relative(disparity, want["disparity"]), 1e-5),
        Check("outputs not finite", not_finite(weights, got["values"][np.isfinite(expected)]), 0, "finite"),
    ]
    if name in MASKED_NAN:
        pairs = zip(jax.tree.leaves(got), jax.tree.leaves(clean), strict=True)
        changed = sum(count(a.view(np.uint32) != b.view(np.uint32)) for a, b in pairs)
        found.append(Check("bits that unseen samples change", changed, 0))
    return found + _slopes(got["slopes"], exact.gradients(ray), outputs)


def rounded(ray, outputs):
    """Returns the ray in float64 with the scene's outputs rounded to a type."""
    fields = {key: np.asarray(jnp.asarray(ray[key]).astype(outputs), np.float64) for key in ("density", "rgb")}
    return {key: np.asarray(value, np.float64) for key, value in ray.items()} | fields


def _slopes(got, want, outputs):
    # A slope that flows back through a bfloat16 is rounded to one: that is the field's, not the renderer's.
    own = 0 if outputs == "float32" else 2.0**-8
    groups = {"colour": COLOURS, "opacity": ("opacity",), "depth": ("depth",), "disparity": ("disparity",)}
    found = []
    for group, names in groups.items():
        rows = [OUTPUTS.index(name) for name in names]
        for argument in ARGUMENTS:
            slope, what = got[argument][rows], f"gradient of {group} by {argument}"
            found.append(Check(f"{what} not finite", not_finite(slope), 0, "finite"))
            if group in ("colour", "opacity"):
                expected = np.stack([want[name][argument][0] for name in names])
                allowed = own * np.stack([want[name][argument][1] for name in names]) + TINY
                found.append(Check(what, of_largest(slope, expected, beyond=allowed), 1e-5, "gradient"))
    return found


@functools.cache
def _rendered(render, outputs, size):
    """Returns for every ray of that many samples its results, and those with its unseen samples cleaned."""
    names = [name for name, ray in RAYS.items() if len(ray["t"]) == size]
    batch = {key: np.stack([RAYS[name][key] for name in names]) for key in RAYS[names[0]]}
    run = jax.jit(functools.partial(_measure, render, jnp.dtype(outputs)))
    # Rounded out here, as a compiler may leave out what it sees of a rounding.
    batch |= {key: batch[key].astype(outputs) for key in ("density", "rgb")}
    renderings = [run(batch), run({key: np.where(np.isnan(x), x.dtype.type(0), x) for key, x in batch.items()})]
    dirty, clean = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), renderings)
    return {name: tuple(_row(tree, i) for tree in (dirty, clean)) for i, name in enumerate(names)}


def _row(tree, i):
    return {
        "values": tree["values"][i],
        "weights": tree["weights"][i],
        "whole": tree["whole"][i],
        "slopes": {name: slope[:, i] for name, slope in tree["slopes"].items()},
    }


def _measure(render, dtype, batch):
    """Returns values [N, 6], weights, the colour of a white scene, and slopes [6, N, ...] by argument."""
    ones = jnp.ones_like(batch["background"])

    def outputs(arguments):
        given = batch | arguments
        rays = Rays(
            origins=given["origins"],
            directions=given["directions"],
            viewdirs=given["viewdirs"],
            near=given["near"],
            far=given["far"],
        )
        samples = Samples(t=given["t"], delta=given["delta"])

        def scene(x, viewdirs):
            moved = x - jax.lax.stop_gradient(x)
            density, rgb = (
                (given["slope"] * moved).sum(axis=-1),
                (given["rgb_slope"] * moved[..., None, :]).sum(axis=-1),
            )
            return given["density"] + density.astype(dtype), given["rgb"] + rgb.astype(dtype)

        def white(x, viewdirs):
            density, rgb = scene(x, viewdirs)
            return density, jnp.ones_like(rgb)

        seen = render(scene, rays, samples, background=given["background"])
        whole = render(white, rays, samples, background=ones).rgb[..., 0]
        values = jnp.concatenate([seen.rgb, jnp.stack([seen.opacity, seen.depth, seen.disparity], axis=-1)], axis=-1)
        return values, (seen.weights, whole)

    values, pull, (weights, whole) = jax.vjp(outputs, {name: batch[name] for name in ARGUMENTS}, has_aux=True)
    basis = jnp.broadcast_to(jnp.eye(len(OUTPUTS))[:, None], (len(OUTPUTS), *values.shape))
    (slopes,) = jax.vmap(pull)(basis)
    return {"values": values, "weights": weights, "whole": whole, "slopes": slopes}
