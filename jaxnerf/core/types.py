"""The data types every floor shares, and the shape checks of every public function."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp


def pytree(*, static=()):
    """Returns a decorator: a frozen, keyword-only dataclass that JAX can trace through."""

    def decorate(cls):
        cls = dataclasses.dataclass(frozen=True, kw_only=True)(cls)
        names = [field.name for field in dataclasses.fields(cls)]
        data = [name for name in names if name not in static]
        return jax.tree_util.register_dataclass(cls, data_fields=data, meta_fields=list(static))

    return decorate


# (x [..., S, 3], viewdirs [..., 1 or S, 3]) -> (density [..., S] in 1 / world unit, rgb [..., S, 3]).
SceneFn = Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]


@pytree()
class Rays:
    """Half lines x(t) = origins + t * directions, looked along from t = near to t = far."""

    origins: jax.Array  # [..., 3] world units
    directions: jax.Array  # [..., 3] world units per t, any length > 0
    viewdirs: jax.Array  # [..., 3] unit length, what a field sees as the direction
    near: jax.Array  # [...] in t
    far: jax.Array  # [...] in t; equal to near: the ray sees only the background


@pytree(static=("rule",))
class Samples:
    """Where a scene is asked along each ray, and how the answers are summed."""

    t: jax.Array  # [..., S] where the scene is asked, near to far
    delta: jax.Array  # [..., S] the length in t that each answer stands for, 0 = ignore
    rule: str = "segments"  # the quadrature: "segments", "gauss" (two a cell) or "points"


@pytree()
class PackedSamples:
    """The evaluated samples of many rays in one buffer of fixed size, ray after ray, near to far."""

    weights: jax.Array  # [K] compositing weights, 0 in unused slots
    t: jax.Array  # [K] in t of the sample's ray
    delta: jax.Array  # [K] length in t
    ray_index: jax.Array  # [K] int32, ascending
    used: jax.Array  # [K] bool, False for unused slots, which come last


@pytree()
class Rendering:
    """The result of rendering rays."""

    rgb: jax.Array  # [..., 3] in [0, 1] where the scene's colours and the background are
    opacity: jax.Array  # [...] in [0, 1], the share of light from behind that is stopped
    depth: jax.Array  # [...] in t, the expected stopping place; what passes through counts at far
    disparity: jax.Array  # [...] in 1 / t, 0 for an empty ray
    weights: jax.Array | None  # [..., S] compositing weight of each sample
    num_dropped: jax.Array  # [...] int32, samples that did not fit into the buffer: 0 unless packed
    samples: Samples | PackedSamples | None = None  # what was evaluated, for losses; None where it was dropped


def without_samples(rendering):
    """Returns the Rendering without weights and samples, which are most of its bytes and no image needs."""
    return dataclasses.replace(rendering, weights=None, samples=None)


@pytree(static=("lens", "height", "width"))
class Camera:
    """A pinhole, or a lens in front of one. Camera axes: x right, y up, looking along -z.

    A stack of cameras has leading axes on every array; its height and width are None where the
    sizes differ.
    """

    to_world: jax.Array  # [3, 4] rotation and position, camera -> world
    focal: jax.Array  # [2] px, (x, y)
    center: jax.Array  # [2] px, (x, y) from the image's top left corner
    distortion: jax.Array | None = None  # [K] coefficients of the lens, see cameras.undistort
    lens: str = "pinhole"  # "pinhole", "opencv" or "fisheye"
    height: int | None = None  # px
    width: int | None = None  # px


@pytree(static=("names", "background"))
class Views:
    """Posed photographs, all their pixels in one array."""

    pixels: jax.Array  # [P, C] uint8 or uint16; C = 4: straight alpha last, 3: opaque
    offset: jax.Array  # [V] int32, where each view's pixels begin
    size: jax.Array  # [V, 2] int32 (height, width) px
    cameras: Camera  # stacked, [V, ...]
    near: jax.Array  # [V] in t
    far: jax.Array  # [V] in t
    mask: jax.Array | None = None  # [P] bool, False = belongs to no batch and no score
    names: tuple[str, ...] = ()  # V file names without folder and extension
    background: tuple[float, float, float] | None = None  # what alpha is composited over
    box: jax.Array | None = None  # [2, 3] world units, lower and upper, outside which the file has nothing
    to_file: jax.Array | None = None  # [4, 4] this world -> the capture file's; None: the same


@pytree()
class Batch:
    """The rays of one training step and what they should show.

    The optional fields are None unless a loss needs them.
    """

    rays: Rays  # [B]
    rgb: jax.Array  # [B, 3] in [0, 1]
    image_index: jax.Array | None = None  # [B] int32
    pixel: jax.Array | None = None  # [B, 2] px, (x, y) from the image's top left corner
    alpha: jax.Array | None = None  # [B] in [0, 1]; 1 where the image has no alpha
    depth: jax.Array | None = None  # [B] in t
    depth_weight: jax.Array | None = None  # [B] confidence of the depth, 0 where it is not known


def check_shapes(function, **arrays):
    """Raises a ValueError unless the shapes fit their patterns.

    Args:
        function: name of the calling function, for the message.
        **arrays: name=(array, pattern). A pattern lists axes by name or number, as in
            "... S 3"; a name stands for one length throughout a call, and "..." for the same
            leading axes throughout a call.

    Raises:
        ValueError: at trace time; names the array, its shape and the shape it had to have.
    """
    known = {}
    for name, (array, pattern) in arrays.items():
        shape, axes = jnp.shape(array), pattern.split()
        tail = [axis for axis in axes if axis != "..."]
        leading = shape[: len(shape) - len(tail)]
        found = zip(tail, shape[len(leading) :], strict=False)
        fits = len(shape) >= len(tail) if "..." in axes else len(shape) == len(tail)
        fits = fits and ("..." not in axes or known.setdefault("...", leading) == leading)
        for axis, length in found:
            wanted = int(axis) if axis.isdigit() else known.setdefault(axis, length)
            fits = fits and length == wanted
        if not fits:
            wanted = ", ".join(
                f"{other} {tuple(jnp.shape(value))}" for other, (value, _) in arrays.items() if other != name
            )
            raise ValueError(
                f"{function}: {name} has shape {tuple(shape)}, wanted [{', '.join(axes)}]"
                + (f" beside {wanted}" if wanted else "")
                + "; nothing is broadcast here, so expand it first"
            )
