"""The networks of three other codes in float64 numpy, written from their descriptions, and their files.

Independent of jaxnerf: a network is a list of (kernel [in, out], bias) in the order of its own code, and its
forward pass follows that code.
"""

import pickle
import struct

import numpy as np

DEPTH, WIDTH, SKIP, VIEW_WIDTH = 8, 256, 4, 128


def octaves(x, count):
    """Encodes as the original code and nerf-pytorch: x, then sine and cosine of each octave."""
    parts = [x]
    for k in range(count):
        parts += [np.sin(2.0**k * x), np.cos(2.0**k * x)]
    return np.concatenate(parts, axis=-1)


def sines_then_cosines(x, count):
    """Encodes as JaxNeRF: x, the sines of all octaves, then the same shifted by pi / 2."""
    angles = np.concatenate([2.0**k * x for k in range(count)], axis=-1)
    return np.concatenate([x, np.sin(np.concatenate([angles, angles + np.pi / 2], axis=-1))], axis=-1)


def relu(x):
    return np.maximum(x, 0)


def dense(x, layer):
    return x @ layer[0].astype(np.float64) + layer[1].astype(np.float64)


def activated(density, rgb):
    return relu(density[..., 0]), 1 / (1 + np.exp(-rgb))


def original(layers, x, viewdirs, num_freqs=10, num_view_freqs=4, skip=SKIP):
    """Evaluates layers in the order of Keras' get_weights: trunk, bottleneck, view, rgb, alpha; or trunk, output."""
    heads = 4 if layers[-1][0].shape[1] == 1 else 1
    inputs = octaves(x, num_freqs)
    h = inputs
    for i, layer in enumerate(layers[:-heads]):
        h = relu(dense(h, layer))
        if i == skip:
            h = np.concatenate([inputs, h], axis=-1)
    if heads == 1:
        output = dense(h, layers[-1])
        return activated(output[..., 3:4], output[..., :3])
    bottleneck, view, rgb, alpha = layers[-4:]
    v = np.concatenate([dense(h, bottleneck), octaves(viewdirs, num_view_freqs)], axis=-1)
    return activated(dense(h, alpha), dense(relu(dense(v, view)), rgb))


def torch_linear(x, weight, bias):
    return np.einsum("oi,...i->...o", weight.astype(np.float64), x) + bias.astype(np.float64)


def nerf_pytorch(state, x, viewdirs, num_freqs=10, num_view_freqs=4, skip=SKIP):
    """Evaluates the arrays of a state dict, whose kernels are [out, in]."""

    def linear(name, value):
        return torch_linear(value, state[f"{name}.weight"], state[f"{name}.bias"])

    points, views = octaves(x, num_freqs), octaves(viewdirs, num_view_freqs)
    h, i = points, 0
    while f"pts_linears.{i}.weight" in state:
        h = relu(linear(f"pts_linears.{i}", h))
        if i == skip:
            h = np.concatenate([points, h], axis=-1)
        i += 1
    if "output_linear.weight" in state:
        output = linear("output_linear", h)
        return activated(output[..., 3:4], output[..., :3])
    alpha, feature = linear("alpha_linear", h), linear("feature_linear", h)
    h = relu(linear("views_linears.0", np.concatenate([feature, views], axis=-1)))
    return activated(alpha, linear("rgb_linear", h))


def jaxnerf_2020(tree, x, viewdirs, num_freqs=10, num_view_freqs=4, skip=SKIP, encode=sines_then_cosines):
    """Evaluates a tree {"Dense_0": {"kernel", "bias"}, ...}, numbered in the order in which the code uses layers."""
    made = iter(range(len(tree)))

    def layer(value):
        part = tree[f"Dense_{next(made)}"]
        return dense(value, (part["kernel"], part["bias"]))

    inputs = encode(x, num_freqs)
    h = inputs
    for i in range(len(tree) - (4 if viewdirs is not None else 2)):
        h = relu(layer(h))
        if i % skip == 0 and i > 0:
            h = np.concatenate([h, inputs], axis=-1)
    sigma = layer(h)
    if viewdirs is not None:
        h = np.concatenate([layer(h), encode(viewdirs, num_view_freqs)], axis=-1)
        h = relu(layer(h))
    return activated(sigma, layer(h))


def random_layer(rng, rows, columns, shift=0.0):
    """Draws a float32 layer of mean 0 and He's deviation, with which activations of deep layers keep their scale."""
    kernel = rng.normal(size=(rows, columns)) * np.sqrt(2 / rows)
    kernel -= kernel.mean(axis=0)
    return kernel.astype(np.float32), (shift + 0.1 * rng.normal(size=columns)).astype(np.float32)


def random_layers(seed, *, depth=DEPTH, width=WIDTH, skip=SKIP, view_width=VIEW_WIDTH, freqs=(10, 4), views=True):
    """Returns layers in Keras' order: trunk, bottleneck, view, rgb, alpha; or trunk, output of 5."""
    rng = np.random.default_rng(seed)
    points, directions = (3 + 6 * count for count in freqs)
    rows = [points] + [width + points * (i == skip) for i in range(depth - 1)]
    trunk = [random_layer(rng, count, width) for count in rows]
    if not views:
        return [*trunk, random_layer(rng, width, 5, shift=0.5)]
    view = random_layer(rng, width + directions, view_width)
    heads = [random_layer(rng, width, width), view, random_layer(rng, view_width, 3)]
    return [*trunk, *heads, random_layer(rng, width, 1, shift=0.5)]


def as_state_dict(layers):
    """Returns random layers under nerf-pytorch's names, transposed."""
    trunk, heads = (layers[:-4], layers[-4:]) if layers[-1][0].shape[1] == 1 else (layers[:-1], layers[-1:])
    names = ["feature_linear", "views_linears.0", "rgb_linear", "alpha_linear"]
    names = [f"pts_linears.{i}" for i in range(len(trunk))] + (names if len(heads) == 4 else ["output_linear"])
    state = {}
    for name, (kernel, bias) in zip(names, layers, strict=True):
        state[f"{name}.weight"], state[f"{name}.bias"] = np.ascontiguousarray(kernel.T), bias
    if len(heads) == 1:  # exists and is never used
        width = trunk[-1][0].shape[1]
        state["views_linears.0.weight"] = np.ones((width // 2, width), np.float32)
        state["views_linears.0.bias"] = np.ones(width // 2, np.float32)
    return state


def as_flax(layers):
    """Returns random layers as a tree of Dense_i in JaxNeRF's order: trunk, sigma, bottleneck, view, rgb."""
    if layers[-1][0].shape[1] == 1:
        layers = [*layers[:-4], layers[-1], *layers[-4:-1]]
    else:
        kernel, bias = layers[-1]
        layers = [*layers[:-1], (kernel[:, 3:4], bias[3:4]), (kernel[:, :3], bias[:3])]
    return {f"Dense_{i}": {"kernel": kernel, "bias": bias} for i, (kernel, bias) in enumerate(layers)}


def flax_content(trees, step):
    """Returns the content of a checkpoint of JaxNeRF."""
    params = {f"MLP_{i}": tree for i, tree in enumerate(trees)}
    moments = {"MLP_0": {"Dense_0": {"kernel": {"grad_ema": np.zeros(2, np.float32)}}}}
    state = {"step": np.int32(step), "param_states": {"params": moments}}
    return {"optimizer": {"target": {"params": params}, "state": state}}


def write_npy(path, arrays, *, protocol=None, numpy_1=False):
    """Writes a list of arrays as numpy.save does, with any pickle protocol, and with the module names of numpy 1."""
    array = np.empty(len(arrays), object)
    for i, part in enumerate(arrays):
        array[i] = part
    if protocol is None:
        np.save(path, array, allow_pickle=True)
        return path
    content = pickle.dumps(array, protocol=protocol)
    if numpy_1:
        assert protocol < 4  # later ones store the length of names
        content = content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    return write_pickle(path, content, len(arrays))


def write_pickle(path, content, count):
    """Writes a .npy file of objects with the given pickle."""
    header = f"{{'descr': '|O', 'fortran_order': False, 'shape': ({count},), }}"
    header = header.ljust(117).encode() + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content)
    return path
