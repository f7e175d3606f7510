"""The paper's equations (arXiv:2003.08934) in float64 numpy: slow, obvious, and independent of jaxnerf.

Everything takes one ray, one pixel or one image; the tests loop over batches.
"""

import math

import numpy as np


def positional_encoding(x, num_freqs):
    parts = [x]
    for k in range(num_freqs):
        parts += [np.sin(2.0**k * x), np.cos(2.0**k * x)]  # Eq. 4 as released: without pi
    return np.concatenate(parts)


def pinhole_ray(to_world, focal, center, pixel):
    """Returns the origin and the direction, which is not normalised."""
    direction = np.array([(pixel[0] - center[0]) / focal[0], -(pixel[1] - center[1]) / focal[1], -1.0])
    return to_world[:, 3], to_world[:, :3] @ direction


def ndc_ray(origin, direction, focal, height, width, near):
    """Returns origin and direction in normalised device coordinates, the origin on the near plane."""
    t_near = -(near + origin[2]) / direction[2]
    ox, oy, oz = origin + t_near * direction
    dx, dy, dz = direction
    ax, ay = -focal[0] / (width / 2), -focal[1] / (height / 2)
    new_origin = np.array([ax * ox / oz, ay * oy / oz, 1 + 2 * near / oz])  # Eq. 25
    new_direction = np.array([ax * (dx / dz - ox / oz), ay * (dy / dz - oy / oz), -2 * near / oz])  # Eq. 26
    return new_origin, new_direction


def uniform_edges(near, far, num_segments, in_disparity=False):
    edges = []
    for i in range(num_segments + 1):
        s = i / num_segments
        edges.append(1 / ((1 - s) / near + s / far) if in_disparity else (1 - s) * near + s * far)
    return np.array(edges)


def uniform_points(near, far, num_points):
    return np.array([near + (far - near) * i / (num_points - 1) for i in range(num_points)])


def stratified_bins(near, far, num_points):
    """Returns each point's lower and upper bound as released in 2020: midpoints, and the ends (Eq. 2)."""
    t = uniform_points(near, far, num_points)
    middle = [(a + b) / 2 for a, b in zip(t[:-1], t[1:], strict=True)]
    return np.array([t[0], *middle]), np.array([*middle, t[-1]])


def deltas(t, last_delta=1e10):
    return np.array([t[i + 1] - t[i] for i in range(len(t) - 1)] + [last_delta])  # below Eq. 3


def weights(density, length):
    """Returns the weights and the transmittance of the whole ray."""
    transmittance, result = 1.0, []
    for sigma, segment in zip(density, length, strict=True):
        alpha = -math.expm1(-sigma * segment)
        result.append(transmittance * alpha)  # Eq. 3, Eq. 5
        transmittance *= 1.0 - alpha
    return np.array(result), transmittance


def render(density, rgb, t, length, far, background=None):
    """Returns rgb, opacity, depth, disparity and weights."""
    weight, transmittance = weights(density, length)
    color = np.zeros(3)
    for w, c in zip(weight, rgb, strict=True):
        color = color + w * c  # Eq. 3
    if background is not None:
        color = color + transmittance * background
    depth = sum(w * z for w, z in zip(weight, t, strict=True)) + (transmittance * far if transmittance > 0 else 0.0)
    disparity = sum(w / z for w, z in zip(weight, t, strict=True))
    return {"rgb": color, "opacity": sum(weight), "depth": depth, "disparity": disparity, "weights": weight}


def inverse_cdf(edges, weight, u):
    """Returns where the piecewise-constant density of `weight` reaches the fraction u of its sum (Sec. 5.2)."""
    total = sum(weight)
    fraction = [w / total for w in weight] if total > 0 else [1 / len(weight)] * len(weight)
    points = []
    for target in u:
        i, below = 0, 0.0
        while i < len(fraction) - 1 and below + fraction[i] <= target:
            below += fraction[i]
            i += 1
        points.append(edges[i] + (edges[i + 1] - edges[i]) * min(1.0, (target - below) / fraction[i]))
    return np.array(points)


def middle_u(num_points):
    return [(i + 0.5) / num_points for i in range(num_points)]


def middles(edges):
    return np.array([(a + b) / 2 for a, b in zip(edges[:-1], edges[1:], strict=True)])


def evaluate(scene, origin, direction, t, delta, far, background):
    norm = math.sqrt(sum(direction**2))
    density, rgb = scene(np.array([origin + z * direction for z in t]), (direction / norm)[None])
    return render(density, rgb, t, delta * norm, far, background)


def hierarchy(coarse, fine, origin, direction, near, far, num_coarse, num_fine, rule, background=None):
    """Returns both renderings of Sec. 5.2 without randomness; "points" is the paper."""
    if rule == "points":
        t = uniform_points(near, far, num_coarse)
        first = evaluate(coarse, origin, direction, t, deltas(t), far, background)
        more = inverse_cdf(middles(t), first["weights"][1:-1], middle_u(num_fine))
        t = np.array(sorted([*t, *more]))
        return first, evaluate(fine, origin, direction, t, deltas(t), far, background)
    edges = uniform_edges(near, far, num_coarse)
    first = evaluate(coarse, origin, direction, middles(edges), np.diff(edges), far, background)
    more = inverse_cdf(edges, first["weights"], middle_u(num_fine))
    edges = np.array(sorted([*edges, *more]))
    return first, evaluate(fine, origin, direction, middles(edges), np.diff(edges), far, background)


def psnr(a, b):
    return -10 * math.log10(np.mean((a - b) ** 2))


def ssim(a, b, size=11, sigma=1.5, k1=0.01, k2=0.03):
    """Returns the mean over the windows that fit and over channels (Wang et al. 2004)."""
    line = np.array([math.exp(-((i - size // 2) ** 2) / (2 * sigma**2)) for i in range(size)])
    window = np.outer(line, line) / np.sum(line) ** 2
    values = []
    for channel in range(a.shape[2]):
        for y in range(a.shape[0] - size + 1):
            for x in range(a.shape[1] - size + 1):
                p = a[y : y + size, x : x + size, channel]
                q = b[y : y + size, x : x + size, channel]
                mp, mq = np.sum(window * p), np.sum(window * q)
                vp, vq = np.sum(window * (p - mp) ** 2), np.sum(window * (q - mq) ** 2)
                cov = np.sum(window * (p - mp) * (q - mq))
                values.append((2 * mp * mq + k1**2) * (2 * cov + k2**2) / ((mp**2 + mq**2 + k1**2) * (vp + vq + k2**2)))
    return np.mean(values)
