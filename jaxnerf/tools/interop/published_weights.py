"""Reads the networks in checkpoints of other codes, with layers, rows and columns in the order of fields/mlp.py.

In the positional encoding, the sine of an octave comes before its cosine, except in JaxNeRF since 2021, where
all sines come before all cosines. At the skip connection, the encoded position comes before the activations,
except in JaxNeRF, where it comes after them. No code in a file is ever run.
"""

import re
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from flax.serialization import msgpack_restore

from jaxnerf.runtime.atomic_files import open_regular, read_bytes
from jaxnerf.tools.interop.pickles import read_array_list

_HEADS = ("bottleneck", "view", "rgb", "density")
_TORCH = {"feature_linear": "bottleneck", "views_linears.0": "view", "rgb_linear": "rgb"}
_TORCH.update({"alpha_linear": "density", "output_linear": "output"})


Network = dict[str, tuple[np.ndarray, np.ndarray]]  # layer -> (kernel [in, out], bias [out]), float32


class PublishedWeights(NamedTuple):
    """The networks of a checkpoint of another code.

    Attributes:
        origin: the name of the code.
        step: the number of training steps; 0 if neither the file nor its name states it.
        networks: the coarse one first.
    """

    origin: str
    step: int
    networks: list[Network]


def read_weights(paths: Sequence[Path], *, legacy_posenc_order: bool = False) -> PublishedWeights:
    """Reads a checkpoint of the original code, nerf-pytorch or JaxNeRF, recognised by its first bytes.

    Args:
        paths: one file; or two of the original code, the coarse network's and the fine one's.
        legacy_posenc_order: whether JaxNeRF trained with its flag of this name, or before the flag existed.
            Its encoding then has the order of the original code.

    Raises:
        ValueError: if a file is missing, damaged or of another kind; names the file.
    """
    readers = [_reader(path) for path in paths]
    if legacy_posenc_order and readers != [_read_jaxnerf]:
        raise ValueError(f"{paths[0]}: is not a checkpoint of JaxNeRF; remove --legacy_posenc_order, a flag of JaxNeRF")
    if len(paths) != 1 and readers != [_read_original] * 2:
        raise ValueError(f"found {len(paths)} files, expected one, or two .npy of the original code; correct --weights")
    if len(paths) == 2 and "fine" in paths[0].name and "fine" not in paths[1].name:
        raise ValueError(f"{paths[0]}: has the name of a fine network, expected the coarse one first; swap the files")
    try:
        return readers[0](*paths, **({"order": np.arange} if legacy_posenc_order else {}))
    except (KeyError, IndexError, TypeError, AttributeError) as error:  # an incomplete tree
        raise ValueError(
            f"{paths[0]}: lacks a part of a checkpoint of its kind ({type(error).__name__}: {error}); "
            "give a checkpoint of the original code, nerf-pytorch or JaxNeRF"
        ) from None


def load_torch(path: Path, expected: str) -> dict:
    """Returns the dictionary in a file of torch.save, with arrays in place of tensors.

    Args:
        expected: the content, for the message.

    Raises:
        ValueError: if torch is missing or old, or if the file is damaged or holds more than tensors; names the
            file.
    """
    try:
        import torch
    except ImportError:
        raise ValueError(f"{path}: needs torch, which is not installed; install it with `pip install torch`") from None
    if torch.__version__ < (2, 6):  # before, weights_only let some files run code (CVE-2025-32434)
        raise ValueError(f"{path}: torch is {torch.__version__}, expected at least 2.6; update torch")
    size = left = path.stat().st_size

    def arrays(value):
        nonlocal left
        if isinstance(value, dict):
            return {key: arrays(part) for key, part in value.items()}
        if not isinstance(value, torch.Tensor):
            return value
        left -= value.numel() * value.element_size()
        if left < 0:  # a stride of 0 repeats without end, and tensors may share their numbers
            raise ValueError(f"a tensor of {list(value.shape)} is more than the rest of {size} bytes")
        return value.detach().numpy()

    try:
        if zipfile.is_zipfile(path):  # torch stores without compression
            with zipfile.ZipFile(path) as archive:
                if sum(info.file_size for info in archive.infolist()) > size:
                    raise ValueError(f"an archive of more than its {size} bytes")
        return arrays(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # torch raises almost any exception on a damaged file
        raise _unreadable(path, error, expected) from None


def load_flax(path: Path, expected: str) -> dict:
    """Returns the dictionary in a file of flax.serialization.msgpack_serialize. See `load_torch`."""
    try:
        return msgpack_restore(read_bytes(path))
    except Exception as error:  # msgpack and numpy raise almost any exception on a damaged file
        raise _unreadable(path, error, expected) from None


def _reader(path: Path) -> Callable[..., PublishedWeights]:
    try:
        with open_regular(path, "rb") as file:
            head = file.read(6)
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}, expected a checkpoint; correct --weights") from None
    if head == b"\x93NUMPY":
        return _read_original
    if head[:2] in (b"PK", b"\x80\x02"):
        return _read_torch
    if head and (0x81 <= head[0] <= 0x8F or head[0] in (0xDE, 0xDF)):  # a non-empty map
        return _read_jaxnerf
    raise ValueError(
        f"{path}: begins with {head!r}, expected a .npy of the original code, a .tar of nerf-pytorch or a "
        "checkpoint of JaxNeRF (flax msgpack); give one of these"
    )


def _read_original(*paths):
    """Reads kernels and biases in the order of Keras: the trunk, then heads by their distance from the output."""
    networks = []
    for path in paths:
        arrays = read_array_list(path, "the list of arrays of a network of the original code")
        if not arrays or len(arrays) % 2:
            raise ValueError(
                f"{path}: holds {len(arrays)} arrays, expected a kernel and a bias for each layer; fetch it again"
            )
        pairs = [_layer(path, f"layer {i // 2}", *arrays[i : i + 2]) for i in range(0, len(arrays), 2)]
        heads = _HEADS if pairs[-1][0].shape[1] == 1 else ("output",)
        names = [f"trunk_{layer}" for layer in range(len(pairs) - len(heads))] + list(heads)
        networks.append(_with_split_output(dict(zip(names, pairs, strict=False))))
    return PublishedWeights("the original code", _step(paths[0], None), networks)


def _read_torch(path):
    """Reads one dictionary of layers for each network, with kernels [out, in]."""
    content = load_torch(path, "a .tar of nerf-pytorch")
    networks = []
    for arrays in (content["network_fn_state_dict"], content.get("network_fine_state_dict")):
        layers = {}
        for name in sorted({key.rpartition(".")[0] for key in arrays or ()}):
            ours = _TORCH.get(name) or re.sub(r"^pts_linears\.", "trunk_", name)
            layers[ours] = _layer(path, name, arrays[f"{name}.weight"].T, arrays[f"{name}.bias"])
        if "output" in layers:
            layers.pop("view", None)  # it exists, but is not used
        networks += [_with_split_output(layers)] if layers else []
    return PublishedWeights("nerf-pytorch", _step(path, content.get("global_step")), networks)


def _read_jaxnerf(path, order=None):
    """Reads numbered layers: the trunk, density, bottleneck and view (if they exist), rgb."""
    content = load_flax(path, "a checkpoint of JaxNeRF")
    target = content["optimizer"]["target"]
    tree = target.get("params", target)
    networks = []
    for name in [key for key in ("MLP_0", "MLP_1") if key in tree] or ["MLP_0"]:
        numbered = [f"Dense_{layer}" for layer in range(len(tree[name]))]
        layers = ((f"{name} {key}", tree[name][key]) for key in numbered)
        pairs = [_layer(path, key, layer["kernel"], layer["bias"]) for key, layer in layers]
        depth = next((layer for layer, (kernel, _) in enumerate(pairs) if kernel.shape[1] == 1), len(pairs))
        heads = ("density", "rgb") if len(pairs) == depth + 2 else ("density", "bottleneck", "view", "rgb")
        names = [f"trunk_{layer}" for layer in range(depth)] + [*heads, *numbered[depth + 4 :]]
        networks.append(_reordered(dict(zip(names, pairs, strict=False)), order or _sines_first))
    step = content.get("step", content["optimizer"].get("state", {}).get("step"))
    return PublishedWeights("JaxNeRF", _step(path, step), networks)


def _reordered(layers, order):
    """Returns JaxNeRF's layers with encoded inputs in our order and, in the trunk, before the activations."""
    result, width = {}, 0
    for name, (kernel, bias) in layers.items():
        hidden, encoded = kernel[:width], kernel[width:]
        if name.startswith("trunk_"):
            kernel = np.concatenate([encoded[order(len(encoded))], hidden])
        elif name == "view":
            kernel = np.concatenate([hidden, encoded[order(len(encoded))]])
        result[name] = kernel, bias
        width = width if name == "density" else len(bias)
    return result


def _sines_first(size):
    """Returns the indices of (x, sine and cosine of each octave) in (x, all sines, all cosines)."""
    count = (size - 3) // 6
    if size != 3 + 6 * count:  # not an encoding; the check of its shape fails later
        return np.arange(size)
    waves = 3 + np.arange(6 * count).reshape(2, count, 3).swapaxes(0, 1)
    return np.concatenate([np.arange(3), waves.reshape(-1)])


def _with_split_output(layers):
    """Returns layers with the single output of networks without view directions split into rgb and density."""
    layers = dict(layers)
    if "output" in layers:
        kernel, bias = layers.pop("output")  # columns past the fourth are not used
        layers.update(rgb=(kernel[:, :3], bias[:3]), density=(kernel[:, 3:4], bias[3:4]))
    return layers


def _step(path, value):
    """Returns the step in a file, otherwise the last number in its name, otherwise 0."""
    if value is None:
        value = ([0] + re.findall(r"\d+", path.stem))[-1]
    try:
        step = int(value)
    except (TypeError, ValueError):
        step = -1
    if not 0 <= step < 2**31:
        raise ValueError(f"{path}: has step {value!r}, expected 0 to 2**31 - 1; rename or fetch it again")
    return step


def _layer(path, name, kernel, bias):
    """Returns a layer's kernel [in, out] and bias [out] in float32; ValueError if they are not finite floats."""
    kernel, bias = np.asarray(kernel), np.asarray(bias)
    if kernel.ndim != 2 or bias.shape != kernel.shape[1:] or {kernel.dtype.kind, bias.dtype.kind} != {"f"}:
        raise ValueError(
            f"{path}: {name} is {kernel.dtype}{list(kernel.shape)} with {bias.dtype}{list(bias.shape)}, "
            "expected a floating-point kernel of two axes and one bias for each output; fetch it again"
        )
    with np.errstate(over="ignore"):
        kernel, bias = (array.astype(np.float32, copy=False) for array in (kernel, bias))
    if not (np.isfinite(kernel).all() and np.isfinite(bias).all()):
        raise ValueError(f"{path}: {name} has values that are not finite in float32; fetch it again")
    return kernel, bias


def _unreadable(path, error, expected):
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return ValueError(f"{path}: unreadable ({reason}), expected {expected}; fetch it again")
