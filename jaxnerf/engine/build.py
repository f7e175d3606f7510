"""From a configuration to the functions of a run. Nothing else reads the configuration."""

import dataclasses
import functools
import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxnerf.data import batches
from jaxnerf.engine.fit import OUTSIDE, SIZES
from jaxnerf.engine.models import Model, hierarchical_model
from jaxnerf.engine.optimizer import make_optimizer
from jaxnerf.engine.packed import packed_model, skip_empty_afterwards
from jaxnerf.engine.scenes import background_of, load_views, settle
from jaxnerf.engine.space import contracted_field, make_space
from jaxnerf.engine.step import TrainData
from jaxnerf.engine.survey import survey
from jaxnerf.fields.grid import grid_field
from jaxnerf.fields.mlp import mlp_field


class Experiment(NamedTuple):
    """All that the loops need of a configuration."""

    model: Model
    optimizer: optax.GradientTransformation
    schedule: Callable[[int], float]  # step -> learning rate
    load_views: Callable[[str], Any]  # split -> Views
    draw: Callable[..., tuple]  # (step, positions, TrainData) -> (keys, Batch)
    ids: Callable[..., Any]  # (step, positions, TrainData) -> ids [B] int32 of the pixels that draw takes
    view_rays: Callable[..., Any]  # (Views, index, pixels) -> Rays
    world_depth: Callable[..., Any]  # (Views, index, pixels, depth in t) -> distance in the file's units
    survey: Callable[..., tuple]  # Views -> possible cells, None of a model without a space; TrainData
    samples_per_ray: int  # of the network that has most
    seed: int
    pixel_offset: float
    train: SimpleNamespace  # the fields of the configuration's section
    eval: SimpleNamespace
    conventions: dict[str, Any]  # see conventions


def build(config):
    """Returns the Experiment that a configuration describes.

    Raises:
        ValueError: names the field that holds what cannot be built.
    """
    model = build_model(config)
    optimizer, schedule = make_optimizer(config.train)
    options = {"pixel_offset": config.data.pixel_offset, "ndc": config.data.ndc}
    batching = {"batching": config.train.batching}

    def draw(step, positions, data):
        return batches.draw_batch(data.seed, step, positions, data.views, data.live, **batching, **options)

    def ids(step, positions, data):
        return batches.draw_pixels(data.seed, step, positions, data.views, data.live, **batching)[1]

    if config.train.batching not in batches.BATCHINGS:
        raise ValueError(f"train.batching is {config.train.batching!r}, wanted one of {batches.BATCHINGS}")
    return Experiment(
        model=model,
        optimizer=optimizer,
        schedule=schedule,
        load_views=functools.partial(load_views, config.data),
        draw=draw,
        ids=ids,
        view_rays=functools.partial(batches.view_rays, ndc=config.data.ndc),
        world_depth=functools.partial(batches.world_depth, ndc=config.data.ndc),
        survey=functools.partial(_survey, config, model),
        samples_per_ray=_samples_per_ray(config),
        seed=config.seed,
        pixel_offset=config.data.pixel_offset,
        train=SimpleNamespace(**config.train),
        eval=SimpleNamespace(**config.eval),
        conventions=conventions(config.data),
    )


def photographs(config, split=None):
    """Returns the Views of a split, its name (None: eval.split) and its conventions; this builds no model."""
    data, split = settle(config.data)[0], split or config.eval.split
    return load_views(data, split), split, conventions(data)


def conventions(data):
    """Returns how the views of a data section are read, which a score's metric card repeats."""
    names = ("format", "background", "pixel_offset", "factor")
    return {name: data[name] for name in names} | {
        name: data.get(name, 0) for name in ("hold_out", "num_views")
    }


def identity(config):
    """Returns as text what renderings depend on: not on how it was trained, nor where the data lies."""
    plain = json.loads(config.to_json_best_effort())
    data = {name: value for name, value in plain["data"].items() if name != "dir"}
    rest = {name: value for name, value in plain.items() if name not in ("train", "eval", "data")}
    return json.dumps({**rest, "data": data}, sort_keys=True)


def build_model(config):
    """Returns the Model: the paper's two networks, or one field and where it is worth asking."""
    space = config.get("space")
    if space and space.skip_empty:
        return _packed_model(config)
    sampling, background = config.sampling, background_of(config.data)
    if sampling.rule not in ("segments", "gauss", "points"):
        raise ValueError(f"sampling.rule is {sampling.rule!r}, wanted 'segments', 'gauss' or 'points'")
    if config.get("field", "mlp") != "mlp":
        raise ValueError(
            f"field is {config.field!r} with space.skip_empty off, wanted 'mlp'; or set space.skip_empty"
        )
    names = ("coarse", "fine") if sampling.num_fine else ("fine",)
    for name in names:
        if not config[name].num_freqs:
            raise ValueError(
                f"{name}.num_freqs is 0, wanted at least 1; only space.skip_empty fits it to images"
            )
    fields = {name: mlp_field(**_network(config[name])) for name in names}
    view_samples = config.eval.get("samples", 1.0)
    return hierarchical_model(fields, background=background, view_samples=view_samples, **sampling)


def check_released(config, origin):
    """Raises a ValueError where a configuration's networks do what those of a released code do not."""
    space = config.get("space")
    if space and space.skip_empty:
        raise ValueError(f"space.skip_empty is True, wanted False: {origin} trains along whole rays")
    activations = ("relu", "softplus") if origin == "JaxNeRF" else ("relu",)
    for name in ("coarse", "fine"):
        if not config[name].get("encode", True):
            raise ValueError(f"{name}.encode is False, wanted True as in {origin}")
        if config[name].density_bias:
            raise ValueError(f"{name}.density_bias is {config[name].density_bias}, wanted 0 as in {origin}")
        if config[name].density_activation not in activations:
            raise ValueError(
                f"{name}.density_activation is {config[name].density_activation!r}, wanted "
                f"{' or '.join(map(repr, activations))} as in {origin}"
            )


def skipping_model(config, model, look):
    """Returns what skip_empty_afterwards does, for a configuration whose space section has no open sizes."""
    return skip_empty_afterwards(model, _space(config, None), look, **_view_options(config))


def _packed_model(config):
    space = config.space
    if config.sampling.density_noise:
        raise ValueError("sampling.density_noise has no effect with space.skip_empty; set one of them to 0")
    if not config.sampling.get("stratified", True):
        raise ValueError(
            "sampling.stratified is False with space.skip_empty, which draws; change one of them"
        )
    if config.field == "grid":
        field = grid_field(lower=space.lower, upper=space.upper, **config.features)
    elif config.field == "mlp":
        field = mlp_field(**_network(config.fine))
    else:
        raise ValueError(f"field is {config.field!r}, wanted 'mlp' or 'grid'")
    if space.get("outside") == "contracted":
        field = contracted_field(field, space.lower, space.upper)
    return packed_model(
        field,
        _space(config, field),
        samples_per_ray=space.samples_per_ray,
        fog_until=space.get("fog_until", 0),
        hide_beyond=space.hide_beyond,
        hide_from=space.hide_from,
        **_view_options(config),
    )


def _space(config, field):
    space = config.space
    open_sizes = [name for name in SIZES if not space.get(name, "nothing")]
    if open_sizes:
        raise ValueError(f"space.{open_sizes[0]} is open, wanted a number; engine.fit chooses it from views")
    outside = space.get("outside", "nothing")
    if outside not in OUTSIDE:
        raise ValueError(f"space.outside is {outside!r}, wanted one of {OUTSIDE}")
    names = ("resolution", "step", "threshold", "update_every", "look_at_once")
    options = {name: space[name] for name in names}
    options["contracted"] = outside == "contracted"
    return make_space(space.lower, space.upper, field=field, **options)


def samples_at_once(config):
    """Returns how many samples a picture's rounds ask where empty space is skipped."""
    # On a CPU activations stay in the cache; an accelerator is slow with little to do.
    return config.eval.samples_at_once or (2**10 if jax.default_backend() == "cpu" else 2**17)


def _view_options(config):
    return {
        "stop": config.eval.stop,
        "view_samples": config.eval.samples,
        "samples_at_once": samples_at_once(config),
        "background": background_of(config.data),
    }


def _network(section):
    options = dict(section)
    options["compute_dtype"] = jnp.dtype(options["compute_dtype"])
    return options


def _samples_per_ray(config):
    space = config.get("space")
    if space and space.skip_empty:
        return space.samples_per_ray
    return config.sampling.num_coarse + config.sampling.num_fine


def _survey(config, model, views):
    possible = cells = None
    if model.space is None:
        live = batches.live_pixels(views)
    else:
        possible, live, cells = survey(
            views,
            model.space,
            masks=config.space.masks and not config.data.ndc,
            ndc=config.data.ndc,
            pixel_offset=config.data.pixel_offset,
        )
    seed = np.uint32(config.seed % 2**32)
    return possible, TrainData(seed, dataclasses.replace(views, mask=None), live, cells)  # live has the mask
