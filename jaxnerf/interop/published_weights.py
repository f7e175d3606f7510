"""The networks in checkpoints of other codes, with layers, rows and columns in the order of fields/mlp.py.

An octave's sine comes before its cosine in all of them but JaxNeRF since 2021, which has all sines before all
cosines. Where the encoded position joins again it comes before the features; in JaxNeRF, after them.
"""

import re
from typing import NamedTuple

import numpy as np

from jaxnerf.interop.checkpoint_files import floats, load_flax, load_torch
from jaxnerf.interop.pickles import read_array_list

_HEADS = ("bottleneck", "view", "rgb", "density")
_TORCH = {"feature_linear": "bottleneck", "views_linears.0": "view", "rgb_linear": "rgb"}
_TORCH.update({"alpha_linear": "density", "output_linear": "output"})


class Weights(NamedTuple):
    """What was read."""

    origin: str  # the code, in words
    step: int  # of its training; 0 if neither the file nor its name says
    networks: list  # of {layer: (kernel [in, out], bias [out])}, float32, coarse first


def read_weights(paths, *, legacy_posenc_order=False):
    """Returns the Weights in a checkpoint of the original code, nerf-pytorch or JaxNeRF, by its first bytes.

    Args:
        paths: one Path; or two of the original code, the coarse network's and the fine one's.
        legacy_posenc_order: JaxNeRF's flag when it trained: its encoding was as the original's, as it was
            before there was such a flag.

    Raises:
        ValueError: if a file is missing, damaged or of another kind; names it.
    """
    readers = [_reader(path) for path in paths]
    if legacy_posenc_order and readers != [_read_jaxnerf]:
        raise ValueError(f"{paths[0]}: is not of JaxNeRF, whose flag legacy_posenc_order is; leave it out")
    if len(paths) != 1 and readers != [_read_original] * 2:
        raise ValueError(f"{len(paths)} files of weights, wanted one, or two .npy of the original code")
    if len(paths) == 2 and "fine" in paths[0].name and "fine" not in paths[1].name:
        raise ValueError(f"{paths[0]}: is by its name the fine network, wanted the coarse one first; swap them")
    try:
        return readers[0](*paths, **({"order": np.arange} if legacy_posenc_order else {}))
    except (KeyError, IndexError, TypeError, AttributeError) as error:  # of a tree without its parts
        raise ValueError(
            f"{paths[0]}: lacks a part of a checkpoint of its kind ({type(error).__name__}: {error}); "
            "give one of the original code, nerf-pytorch or JaxNeRF"
        ) from None


def _reader(path):
    try:
        with path.open("rb") as file:
            head = file.read(6)
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}, wanted a checkpoint; correct --weights") from None
    if head == b"\x93NUMPY":
        return _read_original
    if head[:2] in (b"PK", b"\x80\x02"):
        return _read_torch
    if head and (0x81 <= head[0] <= 0x8F or head[0] in (0xDE, 0xDF)):  # a map that is not empty
        return _read_jaxnerf
    raise ValueError(
        f"{path}: begins with {head!r}, wanted a .npy of the original code, a .tar of nerf-pytorch or a "
        "checkpoint of JaxNeRF (flax msgpack)"
    )


def _read_original(*paths):
    """Kernels and biases in the order of Keras: the trunk's, then heads by their distance from the output."""
    networks = []
    for path in paths:
        arrays = read_array_list(path, "the list of weights of a network of the original code")
        if not arrays or len(arrays) % 2:
            raise ValueError(f"{path}: holds {len(arrays)} arrays, wanted a kernel and a bias a layer")
        pairs = [floats(path, f"layer {i // 2}", *arrays[i : i + 2]) for i in range(0, len(arrays), 2)]
        heads = _HEADS if pairs[-1][0].shape[1] == 1 else ("output",)
        names = [f"trunk_{layer}" for layer in range(len(pairs) - len(heads))] + list(heads)
        networks.append(_with_split_output(dict(zip(names, pairs, strict=False))))
    return Weights("the original code", _step(paths[0], None), networks)


def _read_torch(path):
    """A dictionary of layers a network, kernels [out, in]."""
    content = load_torch(path, "a .tar of nerf-pytorch")
    networks = []
    for arrays in (content["network_fn_state_dict"], content.get("network_fine_state_dict")):
        layers = {}
        for name in sorted({key.rpartition(".")[0] for key in arrays or ()}):
            ours = _TORCH.get(name) or re.sub(r"^pts_linears\.", "trunk_", name)
            layers[ours] = floats(path, name, arrays[f"{name}.weight"].T, arrays[f"{name}.bias"])
        if "output" in layers:
            layers.pop("view", None)  # which is there, and not used
        networks += [_with_split_output(layers)] if layers else []
    return Weights("nerf-pytorch", _step(path, content.get("global_step")), networks)


def _read_jaxnerf(path, order=None):
    """Layers by number, as the code makes them: trunk, density, bottleneck and view if there are any, rgb."""
    content = load_flax(path, "a checkpoint of JaxNeRF")
    target = content["optimizer"]["target"]
    tree = target.get("params", target)
    networks = []
    for name in [key for key in ("MLP_0", "MLP_1") if key in tree] or ["MLP_0"]:
        numbered = [f"Dense_{layer}" for layer in range(len(tree[name]))]
        layers = ((f"{name} {key}", tree[name][key]) for key in numbered)
        pairs = [floats(path, key, layer["kernel"], layer["bias"]) for key, layer in layers]
        depth = next((layer for layer, (kernel, _) in enumerate(pairs) if kernel.shape[1] == 1), len(pairs))
        heads = ("density", "rgb") if len(pairs) == depth + 2 else ("density", "bottleneck", "view", "rgb")
        names = [f"trunk_{layer}" for layer in range(depth)] + [*heads, *numbered[depth + 4 :]]
        networks.append(_reordered(dict(zip(names, pairs, strict=False)), order or _sines_first))
    step = content.get("step", content["optimizer"].get("state", {}).get("step"))
    return Weights("JaxNeRF", _step(path, step), networks)


def _reordered(layers, order):
    """Returns JaxNeRF's layers with what is encoded in our order and, in the trunk, before the features."""
    result, features = {}, 0
    for name, (kernel, bias) in layers.items():
        own, encoded = kernel[:features], kernel[features:]
        if name.startswith("trunk_"):
            kernel = np.concatenate([encoded[order(len(encoded))], own])
        elif name == "view":
            kernel = np.concatenate([own, encoded[order(len(encoded))]])
        result[name] = kernel, bias
        features = features if name == "density" else len(bias)
    return result


def _sines_first(size):
    """Returns where x, then each octave's sine and cosine, stand in x, all sines, all cosines."""
    count = (size - 3) // 6
    if size != 3 + 6 * count:  # something else, which its shape will tell
        return np.arange(size)
    waves = 3 + np.arange(6 * count).reshape(2, count, 3).swapaxes(0, 1)
    return np.concatenate([np.arange(3), waves.reshape(-1)])


def _with_split_output(layers):
    """Returns layers whose one output, of networks without view directions, is two as in ours."""
    layers = dict(layers)
    if "output" in layers:
        kernel, bias = layers.pop("output")  # columns past the fourth are not used
        layers.update(rgb=(kernel[:, :3], bias[:3]), density=(kernel[:, 3:4], bias[3:4]))
    return layers


def _step(path, value):
    """Returns the step that a file names, or else its name, or else 0."""
    if value is None:
        value = ([0] + re.findall(r"\d+", path.stem))[-1]
    try:
        step = int(value)
    except (TypeError, ValueError):
        step = -1
    if not 0 <= step < 2**31:
        raise ValueError(f"{path}: is of step {value!r}, wanted 0 to 2**31 - 1; rename or fetch it again")
    return step
