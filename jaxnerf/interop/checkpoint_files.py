"""Checkpoint files of other frameworks as dictionaries of numpy arrays; no code in them is ever run."""

import numpy as np
from flax.serialization import msgpack_restore


def load_torch(path, wanted):
    """Returns the dictionary in a file of torch.save, its tensors as arrays.

    Args:
        path: Path of the file.
        wanted: what it should hold, for the message.

    Raises:
        ValueError: if torch is not here or old, or the file damaged or of more than tensors; names the file.
    """
    try:
        import torch
    except ImportError:
        raise ValueError(f"{path}: is read by torch, found none; pip install 'jaxnerf[convert]'") from None
    if torch.__version__ < (2, 6):  # before, weights_only let some files run code (CVE-2025-32434)
        raise ValueError(f"{path}: torch here is {torch.__version__}, wanted 2.6; update it to read the file")
    size = path.stat().st_size

    def arrays(value):
        if isinstance(value, dict):
            return {key: arrays(part) for key, part in value.items()}
        if not isinstance(value, torch.Tensor):
            return value
        if value.numel() * value.element_size() > size:  # a stride of 0 repeats without end
            raise ValueError(f"a tensor of {list(value.shape)} in {size} bytes")
        return value.detach().numpy()

    try:
        return arrays(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # torch raises many kinds
        raise _unreadable(path, error, wanted) from None


def load_flax(path, wanted):
    """Returns the dictionary in a file of flax.serialization.msgpack_serialize. See load_torch."""
    try:
        return msgpack_restore(path.read_bytes())
    except Exception as error:  # msgpack and numpy raise many kinds
        raise _unreadable(path, error, wanted) from None


def floats(path, name, kernel, bias):
    """Returns an affine layer's kernel [in, out] and bias [out] in float32.

    Raises:
        ValueError: if they are no such arrays or not finite; names the file and the layer.
    """
    kernel, bias = np.asarray(kernel), np.asarray(bias)
    if kernel.ndim != 2 or bias.shape != kernel.shape[1:] or {kernel.dtype.kind, bias.dtype.kind} != {"f"}:
        raise ValueError(
            f"{path}: {name} is {kernel.dtype}{list(kernel.shape)} with {bias.dtype}{list(bias.shape)}, "
            "wanted a layer's floating kernel of two axes and a bias for each output; fetch it again"
        )
    with np.errstate(over="ignore"):
        kernel, bias = (array.astype(np.float32, copy=False) for array in (kernel, bias))
    if not (np.isfinite(kernel).all() and np.isfinite(bias).all()):
        raise ValueError(f"{path}: {name} has weights that are not finite; fetch it again")
    return kernel, bias


def _unreadable(path, error, wanted):
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return ValueError(f"{path}: unreadable ({reason}), wanted {wanted}; fetch it again")
