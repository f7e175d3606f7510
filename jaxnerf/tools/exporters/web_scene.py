"""A trained hash grid as textures and a fragment shader of WebGL 2."""

import importlib.resources
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxnerf.core.occupancy.grid import OccupancyGrid
from jaxnerf.fields.hash_grid import FEATURE_SCALE, GEOMETRY_FEATURES, HashGrid
from jaxnerf.fields.hash_interpolation import TableLevel

TABLE_WIDTH, WEIGHTS_WIDTH, BITS_WIDTH, COARSE = 4096, 256, 1024, 4  # texels; cells along a coarse cube
MAX_TEXTURE_SIDE = 4096  # of nearly all devices with WebGL 2
PRECISIONS = ("8 bits", "16 bits")  # of a feature; smaller first
_LARGEST_HALF = 65504.0
_LARGEST_EXPONENT = 15.0
_SLOT_SAMPLES, _HIGH_EPS = (4, 2), 0.01  # after which core/occupancy/packed.py tests whether a ray is opaque


class Layer(NamedTuple):
    """An affine layer whose sizes are padded to multiples of 4 by zeros.

    Attributes:
        kernel: [inputs, outputs] float32.
        bias: [outputs] float32.
    """

    kernel: np.ndarray
    bias: np.ndarray

    def texels(self) -> Float[np.ndarray, "texels 4"]:
        """Returns the bias, and then for each 4 outputs, for each 4 inputs, the columns of a matrix."""
        inputs, outputs = (size // 4 for size in self.kernel.shape)
        columns = self.kernel.reshape(inputs, 4, outputs, 4).transpose(2, 0, 1, 3)
        return np.concatenate([self.bias.reshape(-1, 4), columns.reshape(-1, 4)]).astype(np.float32)


class WebScene(NamedTuple):
    """What a browser needs to render a scene.

    Attributes:
        levels: of the table.
        precision: of PRECISIONS.
        scale, shift: [L] of each level: a feature is scale times the number in its texture, plus shift.
        table: [rows, 4 G] float16, or uint8, which a texture shows as numbers from 0 to 1; G texels for each row.
        layers: of the networks, by name: "hidden", "density", "ray" (the part of the first colour layer that depends
            on the direction alone; absent without one), and "view_0" ... "rgb".
        grid: the occupancy grid.
        step_size: world units.
        early_stop_eps: see `render_packed`.
        background: [3].
        ndc: whether positions are in normalised device coordinates.
    """

    levels: tuple[TableLevel, ...]
    precision: str
    scale: np.ndarray
    shift: np.ndarray
    table: np.ndarray
    layers: dict[str, Layer]
    grid: OccupancyGrid
    step_size: float
    early_stop_eps: float
    background: tuple[float, float, float]
    ndc: bool = False

    @property
    def groups(self) -> int:
        """The texels of a row of the table."""
        return self.table.shape[1] // 4

    def features(self, level: int) -> Float[np.ndarray, "rows features"]:
        """Returns the features of a level as the shader reads them."""
        rows = self.levels[level].rows
        stored = self.table[rows.start : rows.stop].astype(np.float32)
        stored = stored / np.float32(255) if self.table.dtype == np.uint8 else stored
        return stored * self.scale[level] + self.shift[level]

    def decoded(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """Returns the parameters of the field with the table that the textures hold."""
        count = np.shape(params["table"])[1]
        table = np.concatenate([self.features(index)[:, :count] for index in range(len(self.levels))])
        return {**params, "table": np.float32(table / FEATURE_SCALE)}


def pack(
    network: HashGrid,
    params: Mapping[str, Any],
    grid: OccupancyGrid,
    *,
    precision: str,
    step_size: float,
    early_stop_eps: float,
    background: tuple[float, float, float] | None,
    ndc: bool = False,
) -> WebScene:
    """Packs a hash grid for a browser.

    Args:
        network: the field's.
        params: of the network.
        grid: in whose occupied cells the field is evaluated.
        precision: of a feature, one of PRECISIONS. 8 bits divide the range of each level evenly.
        step_size, early_stop_eps, background: see `render_with_grid`.
        ndc: whether rays are in normalised device coordinates.

    Raises:
        ValueError: if a number is not finite, or a texture would be too large for browsers.
    """
    params = {name: _as_arrays(value) for name, value in params.items()}
    levels, table = network.levels(), params["table"]
    groups = -(-table.shape[1] // 4)
    if not all(np.isfinite(leaf).all() for value in params.values() for leaf in _leaves(value)):
        raise ValueError("web: a parameter of the field is not finite; train again")
    texels, most = len(table) * groups, TABLE_WIDTH * MAX_TEXTURE_SIDE
    if texels > most:
        raise ValueError(
            f"web: the hash grid has {texels:,} texels, and a browser's texture holds {most:,}; train with a smaller "
            "hash_grid.table_size"
        )
    stored = np.zeros((len(table), 4 * groups), np.uint8 if precision == "8 bits" else np.float16)
    scale, shift = np.zeros((2, len(levels)), np.float32)
    for index, level in enumerate(levels):
        rows = slice(level.rows.start, level.rows.stop)
        values = table[rows]
        if precision == "8 bits":
            low, extent = float(values.min()), max(float(np.ptp(values)), 1e-20)
            stored[rows, : table.shape[1]] = np.rint((values - low) * (255 / extent))
            scale[index], shift[index] = FEATURE_SCALE * extent, FEATURE_SCALE * low
        else:
            stored[rows, : table.shape[1]] = np.clip(values, -_LARGEST_HALF, _LARGEST_HALF)
            scale[index] = FEATURE_SCALE
    return WebScene(
        levels=levels,
        precision=precision,
        scale=scale,
        shift=shift,
        table=stored,
        layers=_layers(network, params, groups),
        grid=grid,
        step_size=float(step_size),
        early_stop_eps=float(early_stop_eps),
        background=tuple(map(float, background or (0, 0, 0))),
        ndc=ndc,
    )


def _as_arrays(value):
    return {k: np.asarray(v, np.float32) for k, v in value.items()} if isinstance(value, Mapping) else np.float32(value)


def _leaves(value):
    return value.values() if isinstance(value, Mapping) else [value]


def _layers(network, params, groups):
    """Returns the Layers; inputs are in the order in which the shader has them."""
    count, size = len(network.options.resolutions), network.options.features_per_level
    kernel = params["kernel"].reshape(count, size, -1)
    kernel = np.pad(kernel, ((0, 0), (0, 4 * groups - size), (0, 0))).reshape(4 * groups * count, -1)
    layers = {
        "hidden": _padded(kernel, params["bias"]),
        "density": _padded(params["density"]["kernel"], params["density"]["bias"]),
    }
    names = [f"view_{index}" for index in range(network.options.view_depth)] + ["rgb"]
    first = params[names[0]]
    # The colour network does not read the density, which is the first output of the layer before.
    kernel = np.concatenate([np.zeros((1, first["kernel"].shape[1]), np.float32), first["kernel"][:GEOMETRY_FEATURES]])
    layers[names[0]] = _padded(kernel, first["bias"])
    if network.options.use_viewdirs:
        layers["ray"] = _padded(first["kernel"][GEOMETRY_FEATURES:], np.zeros_like(first["bias"]))
    return layers | {name: _padded(params[name]["kernel"], params[name]["bias"]) for name in names[1:]}


def _padded(kernel, bias):
    more = [(0, -size % 4) for size in kernel.shape]
    return Layer(np.pad(kernel, more), np.pad(bias, more[1]))


def is_hashed(level: TableLevel) -> bool:
    """Returns whether vertices of a level share rows."""
    return len(level.rows) < math.prod(level.size)


def shader(scene: WebScene) -> str:
    """Returns the source of the fragment shader of a scene, GLSL ES 3.00."""
    source = importlib.resources.files("jaxnerf.tools.exporters").joinpath("web_page/march.frag").read_text()
    return source.replace("//@constants", _constants(scene)).replace("//@field", _field(scene))


def _constants(scene):
    grid, cells = scene.grid, scene.grid.occupied.shape
    lower, upper = np.asarray(grid.lower), np.asarray(grid.upper)
    if grid.contracted:
        most = 4 * float((upper - lower).max()) / 4 / scene.step_size + 33
    else:
        most = float(np.linalg.norm(upper - lower)) / scene.step_size + 33
    numbers = {"TABLE_WIDTH": TABLE_WIDTH, "WEIGHTS_WIDTH": WEIGHTS_WIDTH, "BITS_WIDTH": BITS_WIDTH, "COARSE": COARSE}
    numbers |= {"GROUPS": scene.groups, "MAX_SEGMENTS": int(most)}
    numbers |= {"GROUP": _SLOT_SAMPLES[scene.early_stop_eps >= _HIGH_EPS]}
    lines = [f"#define CONTRACTED {int(grid.contracted)}", f"#define NDC {int(scene.ndc)}"]
    lines += [f"const int {name} = {value};" for name, value in numbers.items()]
    lines += [f"const ivec3 CELLS = ivec3{tuple(cells)};", f"const ivec3 CUBES = ivec3{_cubes(cells)};"]
    lines += [f"const float STEP = {_number(scene.step_size)};"]
    lines += [f"const float EARLY_STOP_EPS = {_number(scene.early_stop_eps or 1e-30)};"]
    vectors = {"LOWER": lower, "UPPER": upper, "BACKGROUND": scene.background}
    lines += [f"const vec3 {name} = vec3({', '.join(map(_number, value))});" for name, value in vectors.items()]
    return "\n".join(lines)


def _number(value):
    text = repr(float(np.float32(value)))
    return text if set(text) & set(".e") else text + ".0"


def _cubes(cells):
    return tuple(-(-count // COARSE) for count in cells)


def _field(scene):
    """Returns prepare_ray and evaluate, and a function for each layer."""
    names = [name for name in scene.layers if name.startswith("view_")] + ["rgb"]
    starts = np.cumsum([0] + [len(layer.texels()) for layer in scene.layers.values()]).tolist()
    functions, count = [], len(scene.levels) * scene.groups
    for start, (name, layer) in zip(starts, scene.layers.items(), strict=False):
        relu = name == "hidden" or name.startswith("view_")
        functions.append(_layer(name, start, layer, relu, from_ray="ray" in scene.layers and name == names[0]))
    body = [f"  vec4 features[{count}];"]
    for index, level in enumerate(scene.levels):
        fixed = f"ivec3{level.size}, {level.rows.start}, {len(level.rows)}u, {str(is_hashed(level)).lower()}"
        for group in range(scene.groups):
            values = f"{group}, {_number(scene.scale[index])}, {_number(scene.shift[index])}"
            body.append(f"  features[{index * scene.groups + group}] = interpolated(place, {fixed}, {values});")
    previous = "features"
    for name in ("hidden", "density", *names):
        body.append(f"  vec4 {name}[{scene.layers[name].bias.size // 4}];\n  layer_{name}({previous}, {name});")
        previous = name
    middle = "contract((x - middle) / quarter) * quarter + middle" if scene.grid.contracted else "x"
    ray = f"vec4 ray_part[{scene.layers[names[0]].bias.size // 4}];\n" if "ray" in scene.layers else ""
    prepare = "  vec4 y[3];\n  harmonics(viewdir, y);\n  layer_ray(y, ray_part);\n" if ray else ""
    return "\n".join(
        [
            ray,
            *functions,
            f"void prepare_ray(vec3 viewdir) {{\n{prepare}}}\n",
            "void evaluate(vec3 x, out float density_out, out vec3 rgb_out) {",
            "  vec3 middle = 0.5 * (LOWER + UPPER), quarter = 0.25 * (UPPER - LOWER);",
            f"  vec3 place = ({middle} - LOWER) / (UPPER - LOWER);",
            *body,
            f"  density_out = exp(min(density[0].x, {_number(_LARGEST_EXPONENT)}));",
            "  rgb_out = 1.0 / (1.0 + exp(-rgb[0].xyz));",
            "}",
        ]
    )


def _layer(name, start, layer, relu, *, from_ray):
    inputs, outputs = (size // 4 for size in layer.kernel.shape)
    return f"""void layer_{name}(in vec4 x[{inputs}], out vec4 y[{outputs}]) {{
  for (int o = 0; o < {outputs}; ++o) {{
    vec4 sum = weight({start} + o){" + ray_part[o]" if from_ray else ""};
    for (int i = 0; i < {inputs}; ++i) {{
      int at = {start + outputs} + (o * {inputs} + i) * 4;
      sum += mat4(weight(at), weight(at + 1), weight(at + 2), weight(at + 3)) * x[i];
    }}
    y[o] = {"max(sum, 0.0)" if relu else "sum"};
  }}
}}
"""


def operations_per_sample(scene: WebScene) -> int:
    """Counts the floating-point operations of the shader's `evaluate`: two for each product and sum of its layers.

    For each level and group there are 8 vertices with 4 features each, scaled, shifted, weighted and added: 4
    operations a number. What comes once a ray, and the addresses of texels, are not counted.
    """
    layers = sum(2 * layer.kernel.size for name, layer in scene.layers.items() if name != "ray")
    return layers + len(scene.levels) * scene.groups * 8 * 4 * 4


# Textures


def textures(scene: WebScene) -> dict[str, np.ndarray]:
    """Returns the arrays of the shader's textures by name, [H, W, channels], or [H, W] for bits."""
    weights = np.concatenate([layer.texels() for layer in scene.layers.values()])
    occupied = np.asarray(scene.grid.occupied)
    cubes = _cubes(occupied.shape)
    wide = np.pad(occupied, [(0, COARSE * cube - cell) for cube, cell in zip(cubes, occupied.shape, strict=True)])
    coarse = wide.reshape(cubes[0], COARSE, cubes[1], COARSE, cubes[2], COARSE).any(axis=(1, 3, 5))
    return {
        "table": _in_rows(scene.table.reshape(-1, 4), TABLE_WIDTH),
        "weights": _in_rows(weights, WEIGHTS_WIDTH),
        "occupied": _in_rows(_words(occupied), BITS_WIDTH),
        "coarse": _in_rows(_words(coarse), BITS_WIDTH),
    }


def _words(cells):
    """Returns uint32 words with a bit for each cell, the first lowest."""
    bits = np.packbits(cells.reshape(-1), bitorder="little")
    return np.pad(bits, (0, -len(bits) % 4)).view("<u4")


def _in_rows(texels, width):
    padding = [(0, -len(texels) % width)] + [(0, 0)] * (texels.ndim - 1)
    return np.pad(texels, padding).reshape(-1, width, *texels.shape[1:])
