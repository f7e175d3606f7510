"""The types, ranges and sizes of a config's values, checked before anything is read, compiled or written."""

import math
from collections.abc import Iterator
from typing import Any

import jax
from ml_collections import ConfigDict

from jaxnerf.configs import default
from jaxnerf.data.readers.validation import MAX_FLOAT32, short_repr
from jaxnerf.runtime import memory
from jaxnerf.runtime.config_fields import AUTO, UNLIMITED_STEPS, is_auto

_MAX_LAYERS = 64  # JAX compiles each layer on its own; hundreds of them take hours
_MAX_OCTAVES = 64  # of encoding.positional_encoding
_MAX_STEPS_PER_SIDE = 2**16  # of ray marching, through the box
_MAX_INT, _MAX_SEED = 2**31 - 1, 2**63 - 1  # int32, in which JAX counts, and what jax.random.key takes

# By range: (its text, whether a number is in it, the fields). What depends on the dataset is checked with it.
_RANGES = (
    (
        "at least 1",
        lambda value: value >= 1,
        (
            "coarse.width coarse.view_width fine.width fine.view_width "
            "data.factor data.width data.size sampling.num_coarse hash_grid.features_per_level hash_grid.table_size "
            "hash_grid.width hash_grid.view_width occupancy.resolution occupancy.update_every "
            "occupancy.cells_per_update occupancy.update_chunk train.batch_size train.cpu_batch_size "
            "train.microbatch_size train.steps_per_dispatch train.max_steps train.lr_steps train.log_every "
            "train.save_every train.max_to_keep train.max_nonfinite eval.chunk eval.max_samples"
        ),
    ),
    (f"from 1 to {_MAX_LAYERS}", lambda value: 1 <= value <= _MAX_LAYERS, "coarse.depth fine.depth"),
    (f"from 0 to {_MAX_LAYERS}", lambda value: 0 <= value <= _MAX_LAYERS, "hash_grid.view_depth"),
    (
        f"from 0 to {_MAX_OCTAVES}",
        lambda value: 0 <= value <= _MAX_OCTAVES,
        "coarse.num_freqs coarse.num_view_freqs fine.num_freqs fine.num_view_freqs",
    ),
    (
        "at least 0",
        lambda value: value >= 0,
        (
            "coarse.skip_layer fine.skip_layer "
            "data.near data.far data.hold_out data.num_views sampling.num_fine sampling.importance_padding "
            "sampling.density_noise hash_grid.geometry_features occupancy.threshold "
            "occupancy.min_views occupancy.max_optical_depth occupancy.occlusion_start_step train.max_seconds "
            "train.warmup_steps train.muon train.averaging_power train.max_reinits train.preview_every "
            "cameras.refine_start_step eval.summary_seconds"
        ),
    ),
    (
        "more than 0",
        lambda value: value > 0,
        (
            "hash_grid.feature_scale occupancy.step_size train.lr_init train.lr_final train.lr_decay_power "
            "train.epsilon cameras.exposure_lr cameras.refine_lr eval.sample_multiplier"
        ),
    ),
    (
        "from 0.01 to 100,000",
        lambda value: 0.01 <= value <= 100_000,
        "occupancy.pool_samples_per_ray occupancy.cpu_pool_samples_per_ray",
    ),
    ("more than 0 and at most 1", lambda value: 0 < value <= 1, "occupancy.uniform_fraction"),
    ("at least 0 and below 1", lambda value: 0 <= value < 1, "train.beta1 train.beta2 eval.early_stop_eps"),
)

_DTYPES = ("float32", "bfloat16", "float16", "float64")
_CHOICES = {
    "coarse.compute_dtype fine.compute_dtype": _DTYPES,
    "hash_grid.compute_dtype": ("float32", "bfloat16", AUTO),
    "coarse.density_activation fine.density_activation": ("relu", "softplus"),
    "sampling.rule": ("segments", "gauss", "points"),
}

# Configs of older versions may lack these: they have a value where they are missing, or only training reads them, for
# which `workdir.config_to_resume` has added the defaults.
_OPTIONAL = (
    "cameras occupancy.uniform_fraction occupancy.min_views train.preview_every "
    "train.max_to_keep train.max_nonfinite train.max_seconds eval.at_end eval.summary_seconds occupancy.update_chunk "
    "hash_grid.compute_dtype train.steps_per_dispatch train.cpu_batch_size train.lr_decay_power "
    "data.background_color occupancy.cpu_pool_samples_per_ray"
).split()

# Sections that become the arguments of one function, which takes no others.
_ARGUMENTS = ("coarse", "fine", "hash_grid")


def check_ranges(config: ConfigDict) -> None:
    """Checks that each value of a config has its field's type, is in its range, and fits into memory.

    Fields that are "auto" are skipped, and so are fields that configs of older versions lack, and sections of
    registered fields and samplers.

    Raises:
        ValueError: names the flag, the value and what is expected.
    """
    fields = dict(_checked_fields(config))
    for expected, holds, names in _RANGES:
        for name in names.split():
            value = fields.get(name)
            if isinstance(value, int | float) and not holds(value):
                raise ValueError(f"--config.{name} is {value}, expected {expected}; correct it")
    for names, choices in _CHOICES.items():
        for name in names.split():
            if name in fields and fields[name] not in choices:
                raise ValueError(
                    f"--config.{name} is {short_repr(fields[name])}, expected one of {choices}; correct it"
                )
            if fields.get(name) == "float64" and not jax.config.jax_enable_x64:
                raise ValueError(f"--config.{name} is 'float64', which requires the environment's JAX_ENABLE_X64=1")
    for name in ("train.max_steps", "train.lr_steps"):
        if not is_auto(fields[name]) and fields[name] >= UNLIMITED_STEPS and not fields.get("train.max_seconds"):
            raise ValueError(
                f"--config.{name} is {fields[name]:,}, which means that --config.train.max_seconds ends the run, "
                "and that is 0; set a time, or start another run with a number of steps"
            )
    _check_lists(fields)
    _check_steps(fields)
    _check_memory(fields)


def _checked_fields(config) -> Iterator[tuple[str, Any]]:
    """Yields "section.field" and its value for all fields of configs/default.py, whose types it checks."""
    known = default.get_config()
    for section, values in known.items():
        if not isinstance(values, ConfigDict):
            yield from _typed(known, config, section, section)
            continue
        if not isinstance(config.get(section, {}), ConfigDict | dict):
            raise ValueError(f"--config.{section} is {short_repr(config[section])}, expected a section; correct it")
        if section not in config:
            if section in _OPTIONAL:
                continue
            raise ValueError(f"--config.{section} is missing; restore the config")
        for field in values:
            yield from _typed(values, config[section], field, f"{section}.{field}")
        unknown = set(config[section]) - set(values)
        if unknown and section in _ARGUMENTS:
            raise ValueError(f"--config.{section}.{min(unknown)} is no field, expected one of {sorted(values)}")


def _typed(known, section, field, name):
    """Yields the name and the value of one field; its type is that of the default."""
    if field not in section:
        if name in _OPTIONAL or name.startswith(("losses.", "cameras.")):
            return
        raise ValueError(f"--config.{name} is missing; restore the config, or set it")
    value, expected = section[field], known.get_type(field)
    accepts = {float: int | float, tuple: tuple | list}.get(expected, expected)
    if not isinstance(value, accepts) or (isinstance(value, bool) and expected in (int, float)):
        kind = expected.__name__.replace("_", " or ")
        raise ValueError(f"--config.{name} is {short_repr(value)}, expected {kind}; correct it")
    limit = (
        _MAX_SEED if name == "seed" else _MAX_INT if isinstance(value, int) and expected is not float else MAX_FLOAT32
    )
    if not all(abs(number) <= limit for number in _numbers(value)):
        raise ValueError(
            f"--config.{name} is {short_repr(value)}, expected a finite number of at most {limit:g}; correct it"
        )
    yield name, value


def _numbers(value):
    """Yields the numbers of a value, which may be a list of lists, as a schedule is."""
    for each in value if isinstance(value, tuple | list) else [value]:
        if isinstance(each, tuple | list):
            yield from _numbers(each)
        elif isinstance(each, int | float):
            yield each


def _check_lists(fields):
    """Checks the colour behind the scene, the box and the levels."""
    color = fields.get("data.background_color", ())
    if not is_auto(color) and not (
        len(color) in (0, 3) and all(isinstance(each, int | float) and 0 <= each <= 1 for each in color)
    ):
        raise ValueError(
            f"--config.data.background_color is {short_repr(color)}, expected red, green and blue in [0, 1], or () for "
            "black; correct it"
        )
    for name in ("occupancy.lower", "occupancy.upper"):
        if not (is_auto(fields[name]) or (len(fields[name]) == 3 and len([*_numbers(fields[name])]) == 3)):
            found = short_repr(fields[name])
            raise ValueError(f"--config.{name} is {found}, expected 3 finite numbers; correct it")
    levels = fields["hash_grid.resolutions"]
    if not is_auto(levels) and not (
        0 < len(levels) <= _MAX_LAYERS and all(isinstance(each, int) and 2 <= each <= 2**20 for each in levels)
    ):
        raise ValueError(
            f"--config.hash_grid.resolutions is {short_repr(levels)}, expected 1 to {_MAX_LAYERS} whole numbers, each "
            "from 2 to 2^20; correct it"
        )


def _check_steps(fields):
    """Checks that the box of ray marching has a limited number of steps."""
    lower, upper, step_size = (fields[f"occupancy.{name}"] for name in ("lower", "upper", "step_size"))
    if fields["sampler"] != "occupancy" or is_auto(lower) or is_auto(upper) or is_auto(step_size):
        return
    longest = max(high - low for low, high in zip(lower, upper, strict=True))
    if longest > _MAX_STEPS_PER_SIDE * step_size:
        raise ValueError(
            f"--config.occupancy.step_size is {step_size}, expected at least {longest / _MAX_STEPS_PER_SIDE:.3g}: the "
            f"longest side of the box, {longest:.3g}, in at most {_MAX_STEPS_PER_SIDE:,} steps; correct it"
        )


def _check_memory(fields):
    """Checks that what a run keeps, its parameters and its grid, fits into memory, by the fields that determine it."""
    free = memory.available()
    if free is None:
        return
    number = lambda name: fields[name] if isinstance(fields[name], int) else 1  # noqa: E731
    needed = {"train.batch_size": 64 * number("train.batch_size")}  # the rays and colours of a step, at least
    for section in ("coarse", "fine"):
        if (
            section == "fine"
            and fields["field"] != "mlp"
            or section == "coarse"
            and fields["sampler"] != "hierarchical"
        ):
            continue
        width = number(f"{section}.width")
        needed[f"{section}.width"] = 16 * width * (width * number(f"{section}.depth") + number(f"{section}.view_width"))
    if fields["field"] == "hash_grid":
        levels = fields["hash_grid.resolutions"]
        each = number("hash_grid.table_size")
        rows = each if is_auto(levels) else sum(min(each, level**3) for level in levels)
        needed["hash_grid.table_size"] = 16 * rows * number("hash_grid.features_per_level")
        inputs = number("hash_grid.features_per_level") * (1 if is_auto(levels) else len(levels))
        outputs = 1 + number("hash_grid.geometry_features")
        needed["hash_grid.width"] = 16 * number("hash_grid.width") * (inputs + outputs)
        width = number("hash_grid.view_width")
        needed["hash_grid.view_width"] = 16 * width * width * max(number("hash_grid.view_depth") - 1, 0)
    if fields["sampler"] == "occupancy":
        sides = [1.0, 1.0, 1.0]
        if not (is_auto(fields["occupancy.lower"]) or is_auto(fields["occupancy.upper"])):
            sides = [high - low for low, high in zip(fields["occupancy.lower"], fields["occupancy.upper"], strict=True)]
        if min(sides) > 0:
            needed["occupancy.resolution"] = (
                10 * number("occupancy.resolution") ** 3 * math.prod(sides) / max(sides) ** 3
            )
    for name, size in needed.items():
        if size > free:
            raise ValueError(
                f"--config.{name} is {fields[name]}, which needs {size / 1e9:,.1f} GB for parameters, gradients and "
                f"the optimizer, the grid or rays, and {free / 1e9:,.1f} GB are free; reduce it"
            )
