"""From a configuration to the functions of a run. Nothing else reads the configuration."""

import functools
import os
import pathlib
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxnerf.core.rendering import render_hierarchical, render_rays
from jaxnerf.core.sampling import split_key
from jaxnerf.data import batches, blender, llff, synthetic
from jaxnerf.fields.mlp import mlp_field

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "none": None}


class Model(NamedTuple):
    """What is learned, and how rays are rendered through it."""

    init: Callable[[jax.Array], Any]  # key -> params
    render: Callable[..., tuple]  # (keys [B] or None, params, Rays [B]) -> Renderings, the last counts
    scene: Callable[[Any], Callable]  # params -> the scene that counts


class Experiment(NamedTuple):
    """All that the loops need of a configuration."""

    model: Model
    optimizer: optax.GradientTransformation
    schedule: Callable[[int], float]  # step -> learning rate
    load_views: Callable[[str], Any]  # split -> Views
    draw: Callable[..., tuple]  # (step, positions, (Views, live)) -> (keys, Batch)
    view_rays: Callable[..., Any]  # (Views, index, pixels) -> Rays
    world_depth: Callable[..., Any]  # (Views, index, pixels, depth in t) -> distance in world units
    samples_per_ray: int  # of the network that has most
    seed: int
    pixel_offset: float
    train: SimpleNamespace  # the fields of the configuration's section
    eval: SimpleNamespace
    conventions: dict[str, Any]  # what makes a score comparable


def build(config):
    """Returns the Experiment that a configuration describes.

    Raises:
        ValueError: names the field that holds what cannot be built.
    """
    model = build_model(config)
    schedule = _schedule(config.train)
    options = {"pixel_offset": config.data.pixel_offset, "ndc": config.data.ndc}

    def draw(step, positions, data):
        views, live = data
        batching = config.train.batching
        return batches.draw_batch(config.seed, step, positions, views, live, batching=batching, **options)

    if config.train.batching not in batches.BATCHINGS:
        raise ValueError(f"train.batching is {config.train.batching!r}, wanted one of {batches.BATCHINGS}")
    return Experiment(
        model=model,
        optimizer=optax.adam(schedule, config.train.beta1, config.train.beta2, config.train.epsilon),
        schedule=schedule,
        load_views=functools.partial(load_views, config.data),
        draw=draw,
        view_rays=functools.partial(batches.view_rays, ndc=config.data.ndc),
        world_depth=functools.partial(batches.world_depth, ndc=config.data.ndc),
        samples_per_ray=config.sampling.num_coarse + config.sampling.num_fine,
        seed=config.seed,
        pixel_offset=config.data.pixel_offset,
        train=SimpleNamespace(**config.train),
        eval=SimpleNamespace(**config.eval),
        conventions={
            "background": config.data.background,
            "pixel_offset": config.data.pixel_offset,
            "factor": config.data.factor,
            "rounding": "8 bits, to nearest, both images",
            "ssim": "11 x 11 Gaussian window, deviation 1.5, valid",
            "mean": "of the images' PSNRs",
        },
    )


def build_model(config):
    """Returns the Model: coarse and fine networks, or one network when sampling.num_fine is 0."""
    sampling, background = config.sampling, _background(config.data)
    if sampling.rule not in ("segments", "gauss", "points"):
        raise ValueError(f"sampling.rule is {sampling.rule!r}, wanted 'segments', 'gauss' or 'points'")
    names = ("coarse", "fine") if sampling.num_fine else ("fine",)
    fields = {name: mlp_field(**_network(config[name])) for name in names}
    options = {"rule": sampling.rule, "in_disparity": sampling.in_disparity, "background": background}

    def init(key):
        keys = jax.random.split(key, len(names))
        return {name: fields[name].init(key) for name, key in zip(names, keys, strict=True)}

    def render(keys, params, rays):
        noise = sampling.density_noise if keys is not None else 0.0
        keys, *noise_keys = split_key(keys, 1 + len(names)) if noise else (keys, *[None] * len(names))
        scenes = [
            functools.partial(fields[name].apply, params[name], key=noise_key, density_noise=noise)
            for name, noise_key in zip(names, noise_keys, strict=True)
        ]
        if len(scenes) == 1:
            return (render_rays(keys, *scenes, rays, num_samples=sampling.num_coarse, **options),)
        return render_hierarchical(
            keys,
            *scenes,
            rays,
            num_coarse=sampling.num_coarse,
            num_fine=sampling.num_fine,
            importance_floor=sampling.importance_floor,
            **options,
        )

    return Model(init, render, lambda params: functools.partial(fields["fine"].apply, params["fine"]))


def load_views(data, split):
    """Returns the Views of a split, as the data section of a configuration describes them."""
    if data.format == "synthetic":
        return synthetic.load_views(split=split, size=data.size)
    folder = _scene_folder(data.dir)
    if data.format == "blender":
        return blender.load_views(
            folder,
            split=split,
            factor=data.factor,
            near=data.near,
            far=data.far,
            background=_background(data),
        )
    if data.format == "llff":
        return llff.load_views(folder, split=split, factor=data.factor)
    raise ValueError(f"data.format is {data.format!r}, wanted 'synthetic', 'blender' or 'llff'")


def _scene_folder(name):
    """Returns the folder of that name here, or else under $JAXNERF_SCENES."""
    scenes = os.environ.get("JAXNERF_SCENES")
    places = [pathlib.Path(name)] + ([pathlib.Path(scenes, name)] if scenes else [])
    found = [place for place in places if name and place.is_dir()]
    if not found:
        looked = " or ".join(str(place.absolute()) for place in places) if name else "no name"
        raise ValueError(
            f"data.dir is {name!r}, looked at {looked}: no such folder; give one with --data_dir"
        )
    return found[0]


def _background(data):
    if data.background not in BACKGROUNDS:
        raise ValueError(f"data.background is {data.background!r}, wanted one of {sorted(BACKGROUNDS)}")
    return BACKGROUNDS[data.background]


def _network(section):
    options = dict(section)
    options["compute_dtype"] = jnp.dtype(options["compute_dtype"])
    return options


def _schedule(train):
    ratio = train.lr_final / train.lr_init
    decay = optax.exponential_decay(train.lr_init, train.lr_steps, ratio, end_value=train.lr_final)
    if not train.warmup_steps:
        return decay
    return lambda step: decay(step) * jnp.minimum(1.0, (step + 1) / train.warmup_steps)
