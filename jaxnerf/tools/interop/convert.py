"""Converts published weights into a workdir, which can be scored, rendered and trained further."""

import dataclasses
import json
import os
import pathlib
import shutil
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import optax

from jaxnerf.data import dataset
from jaxnerf.fields.mlp import MlpOptions
from jaxnerf.models.hierarchical import HierarchicalOptions
from jaxnerf.options import is_auto
from jaxnerf.registry import FIELDS, SAMPLERS, needs_folder
from jaxnerf.runtime import atomic_files
from jaxnerf.runtime.fingerprint import file_sha256
from jaxnerf.tools.interop.published_weights import Network, read_weights
from jaxnerf.training import auto_config, build, workdir
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.config import Config, RunConfig, changed, read_config
from jaxnerf.training.state import create_state

# The fields of a network's section that set the rows and the columns of a layer.
_FIELDS = {
    "trunk_0": ("num_freqs", "width"),
    "trunk": ("skip_layer", "width"),
    "view": ("num_view_freqs", "view_width"),
}
_HEADS = ("bottleneck", "view", "density", "rgb")


def convert(
    files: Sequence[str | os.PathLike],
    config: Config,
    workdir: str | os.PathLike,
    *,
    legacy_posenc_order: bool = False,
) -> str:
    """Writes a workdir with one checkpoint that holds the networks in files of another code.

    Further training starts with new Adam moments and the learning rate of the checkpoint's step. It is
    possible only if the dataset exists now, because "auto" fields of the config are resolved against it here.

    Args:
        files: see `read_weights`.
        config: describes the networks and the dataset.
        workdir: a folder that does not exist or is empty.
        legacy_posenc_order: see `read_weights`.

    Returns:
        A line about what was read and written.

    Raises:
        ValueError: if the files do not match the config, or if the folder is not empty.
    """
    folder, paths = pathlib.Path(workdir), [pathlib.Path(name) for name in files]
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise ValueError(f"{folder}: exists and is not an empty folder; give a new --workdir")
    published = read_weights(paths, legacy_posenc_order=legacy_posenc_order)
    config = read_config(config)
    _check_released(config, published.origin)
    config = _resolved(config)
    experiment = build.build(config)
    # Only shapes count: drawing initial parameters would take longer than everything else.
    like = jax.eval_shape(lambda: create_state(experiment.model, experiment.optimizer, config.seed))
    params = _params(published.networks, like.params, ", ".join(map(str, paths)))
    origin = {
        "origin": published.origin,
        "step": published.step,
        "legacy_posenc_order": legacy_posenc_order,
        "sha256": {str(path): file_sha256(path) for path in paths},
    }
    _write(folder, config, _state(like, experiment.optimizer, published.step, params), origin)
    names = " and ".join(params)
    return f"{published.origin}, step {published.step}: {names} network, written to {folder}"


def _resolved(config: RunConfig) -> RunConfig:
    """Returns the config resolved against its dataset, or as far as possible if there is no dataset."""
    try:
        if needs_folder(config.data.format):
            dataset.dataset_folder(config.data.dir)
    except ValueError:
        if is_auto(config.scene.background):  # as it is inferred for all models without an occupancy grid
            return changed(config, {"scene.background": ()})
        return config
    return auto_config.resolve(config).config


def _params(networks: Sequence[Network], template: dict, files: str) -> dict:
    """Returns the networks as parameters with the template's structure; ValueError if they differ."""
    if len(networks) != len(template):
        raise ValueError(
            f"{files}: {len(networks)} network(s), expected {' and '.join(template)}; give as many, or change "
            "sampling.num_fine: 0 means a single network"
        )
    params = {}
    for (name, expected), layers in zip(template.items(), networks, strict=True):
        _check(name, expected, layers, files)
        params[name] = {
            layer: {"kernel": jnp.asarray(kernel), "bias": jnp.asarray(bias)}
            for layer, (kernel, bias) in layers.items()
        }
    return params


def _check(name, expected, layers, files):
    """Raises a ValueError if a network does not have the expected layers."""
    if ("view" in layers) != ("view" in expected):
        found = "uses" if "view" in layers else "does not use"
        raise ValueError(f"{files}: the {name} network {found} view directions; change {name}.use_viewdirs")
    depth, expected_depth = (sum(layer.startswith("trunk_") for layer in part) for part in (layers, expected))
    if depth != expected_depth:
        raise ValueError(
            f"{files}: the {name} network has {depth} layers before density, expected {expected_depth}; "
            f"change {name}.depth"
        )
    if layers.keys() != expected.keys():
        raise ValueError(
            f"{files}: the {name} network has layers {sorted(layers)}, expected {sorted(expected)}; no field "
            "of the config changes that"
        )
    # A wrong size in one layer shows in the layers after it, so the heads come last, in the order of _HEADS.
    for layer in sorted(expected, key=lambda layer: _HEADS.index(layer) if layer in _HEADS else -1):
        found, shape = layers[layer][0].shape, expected[layer]["kernel"].shape
        if found != shape:
            axis = 0 if found[1] == shape[1] else 1
            fields = _FIELDS.get(layer) or _FIELDS.get(layer.partition("_")[0])
            remedy = f"change {name}.{fields[axis]}" if fields else "no field of the config changes that"
            raise ValueError(
                f"{files}: {layer} of the {name} network is {list(found)}, expected {list(shape)}; {remedy}"
            )


def _state(like, optimizer, step, params):
    """Returns a state at a step, with its learning rate and without gradient moments."""

    def is_schedule(part):
        return isinstance(part, optax.ScaleByScheduleState)

    count = jnp.int32(step)
    opt_state = jax.tree.map(
        lambda part: part._replace(count=count) if is_schedule(part) else part,
        optimizer.init(params),
        is_leaf=is_schedule,
    )
    counters = {name: jnp.zeros(counter.shape, counter.dtype) for name, counter in like.counters.items()}
    return dataclasses.replace(like, step=count, params=params, opt_state=opt_state, counters=counters)


def _write(folder, config, state, origin):
    try:
        workdir.save_config(folder, config)
        atomic_files.write_text(folder / "converted.json", json.dumps(origin, indent=2) + "\n")
        checkpoints = Checkpoints(folder)
        checkpoints.save(state)
        checkpoints.close()
    except BaseException:  # a full disk or Ctrl-C: the same command must work afterwards
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _check_released(config, origin):
    """Raises a ValueError if a config's networks differ from those of a released code."""
    parts = config.options_of(SAMPLERS), config.options_of(FIELDS)
    if not isinstance(parts[0], HierarchicalOptions) or not isinstance(parts[1], MlpOptions):
        raise ValueError(
            f"sampler is {config.sampler!r} and field {config.field!r}, expected 'hierarchical' and 'mlp' as in "
            f"{origin}"
        )
    activations = ("relu", "softplus") if origin == "JaxNeRF" else ("relu",)
    for name, network in (("coarse", config.coarse), ("fine", config.fine)):
        if not network.encode:
            raise ValueError(f"{name}.encode is False, expected True as in {origin}")
        if network.density_bias:
            raise ValueError(f"{name}.density_bias is {network.density_bias}, expected 0 as in {origin}")
        if network.density_activation not in activations:
            raise ValueError(
                f"{name}.density_activation is {network.density_activation!r}, expected "
                f"{' or '.join(map(repr, activations))} as in {origin}"
            )
