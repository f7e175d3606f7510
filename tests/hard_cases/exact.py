"""Compositing of one ray in extended precision, and its gradients by closed formulas.

With tau_i = sigma_i delta_i |d|, T_i = exp(-sum_{j<i} tau_j) and w_i = T_i (1 - exp(-tau_i)), every output is

    Y = sum_i w_i v_i + T v_behind,

v being the colour, 1, t or 1 / t, and v_behind the background, 0, far or 0. As w_i = T_i - T_{i+1},

    dY / dtau_i = sum_{k >= i} T_{k+1} (v_k - v_{k+1}),    v_S = v_behind,

which subtracts values before it sums, so that fog of one colour loses no digits. What is infinite (far
where T > 0, 1 / t at t = 0) has gradient 0 by convention. A sample whose delta is not positive is
absent.
"""

import numpy as np

OPAQUE = 1e4  # exp(-1e4) is 0 in float64 too: nothing comes from behind, nor does a gradient
INVISIBLE = 1e-46  # a transmittance that is 0 in float32, which hides even an infinitely far background


def render(ray):
    """Returns the outputs of a ray, a dict of arrays in any precision: see compositing.ray."""
    transmittance, weights = _transmittance(ray)
    outputs = {"weights": weights, "opacity": -np.expm1(-_depths(ray)[1].sum())}
    for name, (values, behind) in _values(ray).items():
        beyond = 0 if transmittance[-1] < INVISIBLE else transmittance[-1] * behind
        seen = np.where(weights > 0, values, 0)
        outputs[name] = (weights * seen).sum() + beyond
    return outputs


def gradients(ray):
    """Returns {output: {argument: (gradient, what of it flows through the scene's outputs in absolute sum)}}.

    Outputs are red, green, blue, opacity, depth and disparity; arguments density, rgb, t, delta,
    origins and directions. The scene's density is density + slope . (x - x0) at x0 = x, likewise its rgb.
    """
    transmittance, weights = _transmittance(ray)
    size, optical = _depths(ray)
    kept = ray["delta"] > 0
    result = {}
    for index, (name, (values, behind)) in enumerate(_values(ray).items()):
        values = np.append(np.where(np.isinf(values) | ~kept, 0, values), 0 if np.isinf(behind) else behind)
        following = _next_kept(values, kept)
        steps = np.where(kept, transmittance[1:] * (values[:-1] - following), 0)
        by_depth = np.where(kept & (optical < OPAQUE), np.cumsum(steps[::-1])[::-1], 0)
        some = (by_depth != 0) & (size > 0)
        density, delta = (np.where(some, ray[key], 0) for key in ("density", "delta"))
        by_rgb = np.zeros((len(kept), 3), np.longdouble)
        if index < 3:
            by_rgb[:, index] = np.where(kept, weights, 0)
        by_density = by_depth * delta * size
        slope, rgb_slope = (
            np.where(kept.reshape(-1, *[1] * (ray[key].ndim - 1)), ray[key], 0) for key in ("slope", "rgb_slope")
        )
        by_x = by_density[:, None] * slope + (by_rgb[:, :, None] * rgb_slope).sum(axis=1)
        through = abs(by_density[:, None] * slope) + abs(by_rgb[:, :, None] * rgb_slope).sum(axis=1)
        t = np.where(kept, ray["t"], 0)
        along = ray["directions"] / size if size > 0 else np.zeros(3)
        by_t = np.zeros(len(kept), np.longdouble)
        if name == "depth":
            by_t = np.where(kept, weights, 0)
        if name == "disparity":
            by_t = np.where(kept & (t > 0), -weights / np.where(t > 0, t, 1) ** 2, 0)
        none = np.zeros_like(by_t)
        result[name] = {
            "density": (by_density, abs(by_density)),
            "rgb": (by_rgb, abs(by_rgb)),
            "t": (by_t + by_x @ ray["directions"], through @ abs(ray["directions"])),
            "delta": (by_depth * density * size, none),
            "origins": (by_x.sum(axis=0), through.sum(axis=0)),
            "directions": (
                (by_depth * density * delta).sum() * along + (t[:, None] * by_x).sum(axis=0),
                (abs(t)[:, None] * through).sum(axis=0),
            ),
        }
    return result


def _depths(ray):
    """Returns |d| and the optical depths: 0 where there is no length, infinite in a wall."""
    direction = np.asarray(ray["directions"], np.longdouble)
    size = np.sqrt((direction**2).sum())
    kept = (ray["delta"] > 0) & (ray["density"] != 0) & (size > 0)
    return size, np.where(kept, ray["density"], 0) * np.where(kept, ray["delta"], 0) * size


def _transmittance(ray):
    """Returns T_i [S + 1] and the weights [S]."""
    optical = _depths(ray)[1]
    transmittance = np.exp(-np.concatenate([[0], np.cumsum(optical)]))
    return transmittance, transmittance[:-1] * -np.expm1(-optical)


def _values(ray):
    with np.errstate(divide="ignore"):
        disparity = 1 / np.asarray(ray["t"], np.longdouble)
    colors = {name: (ray["rgb"][:, i], ray["background"][i]) for i, name in enumerate(("red", "green", "blue"))}
    ones = np.ones_like(ray["t"])
    return colors | {"opacity": (ones, 0), "depth": (ray["t"], ray["far"]), "disparity": (disparity, 0)}


def _next_kept(values, kept):
    """Returns [S], the value of the next sample that is present, or what lies behind the last."""
    places = np.append(np.where(kept, np.arange(len(kept)), len(kept)), len(kept))
    return values[np.minimum.accumulate(places[::-1])[::-1][1:]]
