"""Published weights as a run of ours: a workdir that evaluates, renders and trains on."""

import dataclasses
import hashlib
import json
import pathlib
import shutil

import jax
import jax.numpy as jnp
import optax

from jaxnerf.interop.published_weights import read_weights
from jaxnerf.training import auto_config, build, workdir
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.state import create_state

# Which field of a network's section sets a layer's rows and its columns.
_FIELDS = {
    "trunk_0": ("num_freqs", "width"),
    "trunk": ("skip_layer", "width"),
    "view": ("num_view_freqs", "view_width"),
}
_HEADS = ("bottleneck", "view", "density", "rgb")


def convert(files, config, folder, *, legacy_posenc_order=False):
    """Writes a workdir with one checkpoint, of the weights in files of another code.

    If the run is trained on, Adam begins anew, at the learning rate of the checkpoint's step. That takes
    a capture which is there: what a configuration leaves to it is settled now, and may not change later.

    Args:
        files: names; see read_weights, also for legacy_posenc_order.
        config: ConfigDict of such a network.
        folder: the workdir, which must not be there, or be empty.

    Returns:
        A line that says what was read and written.

    Raises:
        ValueError: if the files are not as the configuration says, or the folder holds something.
    """
    folder, paths = pathlib.Path(folder), [pathlib.Path(name) for name in files]
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise ValueError(f"{folder}: is there already; give a new --workdir")
    weights = read_weights(paths, legacy_posenc_order=legacy_posenc_order)
    build.check_released(config, weights.origin)
    config, _ = auto_config.resolve_data(config, missing_ok=True)
    experiment = build.build(config)
    # Shapes alone: to draw weights that are replaced would take longer than all the rest.
    like = jax.eval_shape(lambda: create_state(experiment.model, experiment.optimizer, experiment.seed))
    params = _params(weights.networks, like.params, ", ".join(map(str, paths)))
    origin = {
        "origin": weights.origin,
        "step": weights.step,
        "legacy_posenc_order": legacy_posenc_order,
        "sha256": {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths},
    }
    _write(folder, config, _state(like, experiment.optimizer, weights.step, params), origin)
    names = " and ".join(params)
    return f"{weights.origin}, step {weights.step}: {names} network, written to {folder}"


def _params(networks, template, files):
    """Returns the networks as parameters like the template's; ValueError where they differ."""
    if len(networks) != len(template):
        raise ValueError(
            f"{files}: {len(networks)} network(s), wanted {' and '.join(template)}; give as many, or change "
            "sampling.num_fine, which at 0 makes one"
        )
    params = {}
    for (name, wanted), layers in zip(template.items(), networks, strict=True):
        _check(name, wanted, layers, files)
        params[name] = {
            layer: {"kernel": jnp.asarray(kernel), "bias": jnp.asarray(bias)}
            for layer, (kernel, bias) in layers.items()
        }
    return params


def _check(name, wanted, layers, files):
    """Raises a ValueError unless a network's layers are those wanted."""
    if ("view" in layers) != ("view" in wanted):
        found = "sees" if "view" in layers else "does not see"
        raise ValueError(f"{files}: the {name} network {found} view directions; change {name}.use_viewdirs")
    depth, wanted_depth = (sum(layer.startswith("trunk_") for layer in part) for part in (layers, wanted))
    if depth != wanted_depth:
        raise ValueError(
            f"{files}: the {name} network has {depth} layers before density, wanted {wanted_depth}; change {name}.depth"
        )
    if layers.keys() != wanted.keys():
        raise ValueError(
            f"{files}: the {name} network has layers {sorted(layers)}, wanted {sorted(wanted)}; no field "
            "of a configuration makes such a network"
        )
    # What is wrong in one layer shows in those after it.
    for layer in sorted(wanted, key=lambda layer: _HEADS.index(layer) if layer in _HEADS else -1):
        found, shape = layers[layer][0].shape, wanted[layer]["kernel"].shape
        if found != shape:
            axis = 0 if found[1] == shape[1] else 1
            fields = _FIELDS.get(layer) or _FIELDS.get(layer.partition("_")[0])
            remedy = f"change {name}.{fields[axis]}" if fields else "no field of a configuration does that"
            raise ValueError(f"{files}: {layer} of the {name} network is {list(found)}, wanted {list(shape)}; {remedy}")


def _state(like, optimizer, step, params):
    """Returns the state of a run that is at a step, has its learning rate, and no gradient in mind."""

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
        workdir.claim(folder, config)
        workdir.write_text(folder / "converted.json", json.dumps(origin, indent=2) + "\n")
        checkpoints = Checkpoints(folder)
        checkpoints.save(state)
        checkpoints.close()
    except BaseException:  # a full disk, Ctrl-C: nothing stays that would stand in the next try's way
        shutil.rmtree(folder, ignore_errors=True)
        raise
