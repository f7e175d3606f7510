"""Data types of the whole package, and the shape check of the public functions."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple, TypeAlias, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Key, Num, UInt32

_T = TypeVar("_T")


@dataclass_transform(frozen_default=True, kw_only_default=True)
def pytree(*, static: Iterable[str] = ()) -> Callable[[type[_T]], type[_T]]:
    """Makes a decorator that turns a class into a frozen, keyword-only dataclass and a JAX pytree.

    JAX rebuilds pytrees with None, PartitionSpecs or ShapeDtypeStructs in their fields, so the constructor checks
    nothing: the annotations of the fields describe what functions take and return.

    Args:
        static: names of fields that are part of the tree's structure, not arrays.
    """
    static = list(static)

    def decorate(cls):
        cls = dataclasses.dataclass(frozen=True, kw_only=True)(cls)
        names = [field.name for field in dataclasses.fields(cls)]
        data = [name for name in names if name not in static]
        return jax.tree_util.register_dataclass(cls, data_fields=data, meta_fields=static)

    return decorate


# (x [..., S, 3], viewdirs [..., 1 or S, 3]) -> (density [..., S] in 1 / world unit, rgb [..., S, 3]). A scene that
# needs more asks for it by keyword-only parameters: radius, length, time, image_index, progress, see core.scene.NEEDS.
SceneFn: TypeAlias = Callable[..., tuple[Float[Array, "*batch samples"], Float[Array, "*batch samples channels"]]]

# One key or an array of keys, typed or raw; functions say whether they take one key per ray.
Keys: TypeAlias = Key[Array, "..."] | UInt32[ArrayLike, "... 2"]

Vector: TypeAlias = Num[ArrayLike, "3"] | Sequence[float]

# One colour, or one per ray.
Background: TypeAlias = Num[ArrayLike, "*#batch channels"] | Sequence[float]


@pytree()
class Rays:
    """Rays x(t) = origins + t * directions between t = near and t = far.

    Attributes:
        origins: [..., 3] world units.
        directions: [..., 3] world units per t, of any length > 0.
        viewdirs: [..., 3] unit length, the direction that a field receives.
        near: [...] in t.
        far: [...] in t. A ray whose far equals its near shows only the background.
        radius: [...] world units per t, that of the cone around the ray at t = 1, see cameras.pixel_radius.
        time: [...] in [0, 1], of the image.
        image_index: [...] int32, of the training image.

    The last three are for scenes that ask for them, and None otherwise.
    """

    origins: Float[Array, "*batch 3"]
    directions: Float[Array, "*batch 3"]
    viewdirs: Float[Array, "*batch 3"]
    near: Float[Array, "*batch"]
    far: Float[Array, "*batch"]
    radius: Float[Array, "*batch"] | None = None
    time: Float[Array, "*batch"] | None = None
    image_index: Int[Array, "*batch"] | None = None


@pytree(static=("rule",))
class Samples:
    """Positions along each ray at which a scene is evaluated, and the quadrature that sums the values.

    Attributes:
        t: [..., S] in t, near to far.
        delta: [..., S] length in t that each sample represents; samples of length 0 are ignored.
        rule: the quadrature: "segments", "gauss" (two samples per segment) or "points".
    """

    t: Float[Array, "*batch samples"]
    delta: Float[Array, "*batch samples"]
    rule: str = "segments"


class PlacedSamples(NamedTuple):
    """Samples of many rays in one buffer of fixed size, ray after ray, near to far, before the scene is evaluated.

    Attributes:
        t: [K] in t of the sample's ray.
        delta: [K] length in t.
        ray_index: [K] int32, index of the sample's ray, ascending.
        used: [K] bool, False for unused slots, which come last.
        num_dropped: [B] int32, the number of a ray's samples that did not fit.
    """

    t: Float[Array, " K"]
    delta: Float[Array, " K"]
    ray_index: Int[Array, " K"]
    used: Bool[Array, " K"]
    num_dropped: Int[Array, " B"]


@pytree(static=("rule",))
class PackedSamples:
    """The evaluated samples of many rays in one buffer of fixed size, ray after ray, near to far.

    Attributes:
        weights: [K] compositing weights, 0 in unused slots.
        t: [K] in t of the sample's ray.
        delta: [K] length in t.
        ray_index: [K] index of the sample's ray, ascending.
        used: [K] False for unused slots, which come last.
        rule: the quadrature, see Samples.
    """

    weights: Float[Array, " K"]
    t: Float[Array, " K"]
    delta: Float[Array, " K"]
    ray_index: Int[Array, " K"]
    used: Bool[Array, " K"]
    rule: str = "segments"


@pytree()
class Rendering:
    """The result of rendering rays.

    Attributes:
        rgb: [..., 3] in [0, 1] if the scene's colours and the background are.
        opacity: [...] in [0, 1], 1 - transmittance of the whole ray.
        depth: [...] in t, the expected depth; the transmitted fraction contributes far.
        disparity: [...] in 1 / t, the expected inverse depth; 0 for an empty ray.
        weights: [..., S] compositing weight of each sample; None where dropped.
        num_dropped: [...] number of samples that did not fit into the packed buffer; 0 unless packed.
        samples: the evaluated samples, for losses; None where dropped.
        median_depth: [...] in t, where the transmittance falls to one half, far where it does not; None unless the
            renderer is called with median_depth=True.
    """

    rgb: Float[Array, "*batch 3"]
    opacity: Float[Array, "*batch"]
    depth: Float[Array, "*batch"]
    disparity: Float[Array, "*batch"]
    weights: Float[Array, "*batch samples"] | None
    num_dropped: Int[Array, "*batch"]
    samples: Samples | PackedSamples | None = None
    median_depth: Float[Array, "*batch"] | None = None


@jax.tree_util.register_pytree_node_class
class Renderings(tuple[Rendering, ...]):
    """The renderings of a training step.

    As a tuple it holds those whose colours are compared with the batch, that of images last. `outputs["name"]` is the
    rendering of any network, such as one that only proposes samples. It is a JAX pytree.
    """

    def __new__(cls, by_network: Mapping[str, Rendering], compared: Sequence[str]) -> "Renderings":
        """Makes the tuple from the renderings by network, and the names of those that are compared."""
        if not isinstance(by_network, Mapping):
            raise ValueError(f"the sampler returned {type(by_network).__name__}, expected a Rendering of each network")
        renderings = super().__new__(cls, (_rendering_of(by_network, name) for name in compared))
        renderings._by_network, renderings._compared = dict(by_network), tuple(compared)
        return renderings

    def __getitem__(self, key):
        return _rendering_of(self._by_network, key) if isinstance(key, str) else super().__getitem__(key)

    def tree_flatten(self) -> tuple[tuple[Rendering, ...], tuple]:
        """Returns the renderings of all networks, and the names."""
        return tuple(self._by_network.values()), (tuple(self._by_network), self._compared)

    @classmethod
    def tree_unflatten(cls, names: tuple, renderings: Sequence[Rendering]) -> "Renderings":
        """Makes the tuple from what `tree_flatten` returns."""
        return cls(dict(zip(names[0], renderings, strict=True)), names[1])


def _rendering_of(by_network, name):
    if name not in by_network:
        raise ValueError(
            f"there is no rendering of the network {name!r}, the sampler has {', '.join(map(repr, by_network))}; "
            "correct the name, or Model.image_networks"
        )
    return by_network[name]


def without_samples(rendering: Rendering) -> Rendering:
    """Drops the weights and samples of a Rendering: most of its bytes, which no image needs."""
    return dataclasses.replace(rendering, weights=None, samples=None)


@pytree(static=("lens", "height", "width"))
class Camera:
    """A pinhole camera, or one with a lens. Camera axes: x right, y up, looking along -z.

    A stack of cameras has leading axes on every array; its height and width are None where the
    sizes differ.

    Attributes:
        to_world: [3, 4] rotation and position, camera to world, position in world units.
        focal: [2] px, (x, y).
        center: [2] px, (x, y) from the image's top left corner.
        distortion: [K] coefficients of the lens, see `undistort`; None for a pinhole.
        lens: "pinhole", "opencv" or "fisheye".
        height: px.
        width: px.
    """

    to_world: Float[Array, "*views 3 4"]
    focal: Float[Array, "*views 2"]
    center: Float[Array, "*views 2"]
    distortion: Float[Array, "*views K"] | None = None
    lens: str = "pinhole"
    height: int | None = None
    width: int | None = None


@pytree()
class SparsePoints:
    """Points on surfaces, as structure from motion finds them, and their observations: where the views show them.

    Attributes:
        positions: [N, 3] world units.
        view: [M] index of an observation's view, ascending.
        point: [M] index of its point.
        pixel: [M, 2] px, (x, y) from the image's top left corner; inside the image.
        confidence: [M] in [0, 1]; None: not known, see `confident_observations`.
        interpolated: [V, H, W, 2] inverse depth and its confidence between the observations, at every fourth pixel of
            each view, see `interpolated_depths`; None: not computed.
    """

    positions: Float[Array, "N 3"]
    view: Int[Array, " M"]
    point: Int[Array, " M"]
    pixel: Float[Array, "M 2"]
    confidence: Float[Array, " M"] | None = None
    interpolated: Float[Array, "V H W 2"] | None = None


@pytree()
class Batch:
    """The rays of one training step and the colours they should have.

    The optional fields are None unless a loss needs them.

    Attributes:
        rays: Rays [B].
        rgb: [B, 3] in [0, 1].
        image_index: [B] index of the view.
        pixel: [B, 2] px, (x, y) from the image's top left corner.
        alpha: [B] in [0, 1]; 1 where the image has no alpha.
        depth: [B] in t.
        depth_weight: [B] confidence of the depth, 0 where it is unknown.
    """

    rays: Rays
    rgb: Float[Array, "B 3"]
    image_index: Int[Array, " B"] | None = None
    pixel: Float[Array, "B 2"] | None = None
    alpha: Float[Array, " B"] | None = None
    depth: Float[Array, " B"] | None = None
    depth_weight: Float[Array, " B"] | None = None


def is_known(condition: object) -> bool:
    """Returns whether a condition is known to hold at trace time."""
    return not isinstance(condition, jax.core.Tracer) and bool(condition)


def has_nan(rays: Rays) -> Bool[Array, "*batch"]:
    """Returns whether the origin, the direction, near or far of each ray is NaN."""
    return jnp.isnan(rays.origins.sum(axis=-1) + rays.directions.sum(axis=-1) + rays.near + rays.far)


def check_order(function: str, **bounds: Num[Array, "..."]) -> None:
    """Raises a ValueError if the first of two arrays of bounds, by name, is known to be above the second somewhere."""
    (low, lows), (high, highs) = bounds.items()
    if is_known((wrong := lows > highs).any()):
        values = [each.reshape(-1)[jnp.argmax(wrong)] for each in (lows, highs)]
        raise ValueError(f"{function}: {low} is {values[0]:g} and {high} {values[1]:g}, expected {low} <= {high}")


def broadcast(function: str, shape: tuple[int, ...], **arrays: Num[ArrayLike, "..."]) -> list[Num[Array, "..."]]:
    """Broadcasts arrays, by their names, to a shape; ValueError, with the name of the calling function, on others."""
    found = []
    for name, value in arrays.items():
        try:
            found.append(jnp.broadcast_to(value, shape))
        except ValueError:
            raise ValueError(f"{function}: {name} has shape {jnp.shape(value)}, which does not fit {shape}") from None
    return found


def check_shapes(function: str, **arrays: tuple[object, str]) -> None:
    """Raises a ValueError unless the shapes fit their patterns.

    Args:
        function: name of the calling function, for the message.
        **arrays: name=(array, pattern). A pattern lists axes by name or number, as in
            "... S 3"; a name stands for one length throughout a call, and "..." for the same
            leading axes throughout a call.

    Raises:
        ValueError: at trace time; names the array, its shape and the expected shape.
    """
    known: dict[str, object] = {}
    for name, (array, pattern) in arrays.items():
        shape, axes = jnp.shape(array), pattern.split()
        tail = [axis for axis in axes if axis != "..."]
        leading = shape[: len(shape) - len(tail)]
        found = zip(tail, shape[len(leading) :], strict=False)
        fits = len(shape) >= len(tail) if "..." in axes else len(shape) == len(tail)
        fits = fits and ("..." not in axes or known.setdefault("...", leading) == leading)
        for axis, length in found:
            expected = int(axis) if axis.isdecimal() else known.setdefault(axis, length)
            fits = fits and length == expected
        if not fits:
            others = ", ".join(
                f"{other} {tuple(jnp.shape(value))}" for other, (value, _) in arrays.items() if other != name
            )
            raise ValueError(
                f"{function}: {name} has shape {tuple(shape)}, expected [{', '.join(axes)}]"
                + (f" beside {others}" if others else "")
                + "; these arrays are not broadcast, so expand it first"
            )
