"""Trains 8 runs in one program, and one after another: time and differences, for seeds and for scenes.

    python experiments/many_runs/many_runs.py --page=docs/results/many_runs.md

The scenes are balls of random place, size and colour, written as datasets in the format of transforms.json.
"""

import json
import pathlib
import tempfile
import time

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags
from PIL import Image

import jaxnerf
from experiments import common
from jaxnerf.configs import lego_fast, smoke
from jaxnerf.runtime import cli

_RUNS = flags.DEFINE_integer("runs", 8, "The number of runs.", lower_bound=2)
_STEPS = flags.DEFINE_integer("steps", 200, "The training steps of each run.", lower_bound=1)
_SIZE = flags.DEFINE_integer("size", 48, "The side of the images, px.", lower_bound=8)
HEADS = ["runs", "in one program", "one after another", "largest difference of a parameter"]
BOX = {"lower": (-1.2,) * 3, "upper": (1.2,) * 3, "contracted": False, "use_alpha": False, "min_views": 0}


def hash_grid():
    """Returns the config of a small hash grid with the occupancy sampler, for images of _SIZE."""
    config = lego_fast.get_config()
    config.update_from_flattened_dict({f"occupancy.{name}": value for name, value in BOX.items()})
    config.occupancy.resolution, config.occupancy.step_size = 48, 0.04
    config.hash_grid.update(resolutions=(8, 16, 32, 64), table_size=2**14, width=32, view_width=32)
    config.train.batch_size, config.data.format, config.data.size = 256, "synthetic", _SIZE.value
    return _short(config)


def paper():
    """Returns the config of small networks of the paper's kind."""
    config = smoke.get_config()
    config.data.size, config.train.batch_size = _SIZE.value, 256
    return _short(config)


def _short(config):
    config.eval.at_end, config.train.max_seconds = False, 0.0
    for name in ("max_steps", "lr_steps", "save_every", "log_every"):
        setattr(config.train, name, _STEPS.value)
    config.train.preview_every = 0.0
    return config


def write_balls(folder, key, num_views=20):
    """Writes a dataset of three random balls."""
    keys = jax.random.split(key, 3)
    center = jax.random.uniform(keys[0], (3, 3), minval=-0.6, maxval=0.6)
    radius = jax.random.uniform(keys[1], (3,), minval=0.25, maxval=0.45)
    color = jax.random.uniform(keys[2], (3, 3), minval=0.05, maxval=0.95)

    def scene(x, viewdirs):
        distance = jnp.linalg.norm(x[..., None, :] - center, axis=-1) - radius
        density = 20.0 * jax.nn.sigmoid(-distance / 0.03)
        mixed = ((density + 1e-6)[..., None] * color).sum(axis=-2)
        return density.sum(axis=-1), mixed / (density + 1e-6).sum(axis=-1, keepdims=True)

    size = _SIZE.value
    poses = jaxnerf.turntable(num_views, center=jnp.zeros(3), radius=3.0, elevation=0.6)
    focal = 1.2 * size
    camera = jaxnerf.Camera(to_world=poses, focal=jnp.full(2, focal), center=jnp.full(2, size / 2))
    rays = jaxnerf.rays_from_pixels(camera, jaxnerf.pixel_grid(size, size), near=1.5, far=4.5)
    images = jaxnerf.render_rays(None, scene, rays, num_samples=96, background=jnp.ones(3)).rgb
    (folder / "images").mkdir(parents=True)
    frames = []
    for index, image in enumerate(np.asarray(jaxnerf.round_to_8_bits(images) * 255, np.uint8)):
        Image.fromarray(image).save(folder / "images" / f"{index:03d}.png")
        matrix = np.concatenate([np.asarray(poses[index]), [[0, 0, 0, 1]]])
        frames.append({"file_path": f"images/{index:03d}.png", "transform_matrix": matrix.tolist()})
    intrinsics = {"fl_x": focal, "fl_y": focal, "cx": size / 2, "cy": size / 2, "w": size, "h": size}
    (folder / "transforms.json").write_text(json.dumps({**intrinsics, "frames": frames}))


def of_seeds(make):
    """Returns configs that differ in the seed."""
    return [common.changed(make(), {"seed": seed}) for seed in range(_RUNS.value)]


def of_scenes(folder):
    """Returns configs that differ in the dataset, which this writes."""
    configs = []
    for index in range(_RUNS.value):
        write_balls(folder / f"scene{index}", jax.random.key(index))
        data = {"format": "transforms", "dir": str(folder / f"scene{index}"), "world": "file", "near": 1.5, "far": 4.5}
        fields = {f"data.{name}": value for name, value in data.items()}
        configs.append(common.changed(hash_grid(), {**fields, "data.hold_out": 5, "eval.split": "held_out"}))
    return configs


def measure(configs, folder):
    """Returns the seconds in one program and one after another, and the largest difference of a parameter."""
    together, alone = ([folder / f"{kind}{index}" for index in range(len(configs))] for kind in ("run", "alone"))
    start = time.perf_counter()
    jaxnerf.train_many(configs, together)
    middle = time.perf_counter()
    for config, one in zip(configs, alone, strict=True):
        jaxnerf.train_and_evaluate(config, one)
    end = time.perf_counter()
    pairs = [[_params(one) for one in pair] for pair in zip(together, alone, strict=True)]
    apart = max(max(jax.tree.leaves(jax.tree.map(_apart, *pair))) for pair in pairs)
    return middle - start, end - middle, apart


def _params(folder):
    return jax.device_get(jaxnerf.restore_run(folder).variables(_STEPS.value)[0])


def _apart(a, b):
    return float(np.abs(a - b).max())


def main(argv):
    del argv
    rows = []
    with tempfile.TemporaryDirectory() as name:
        root = pathlib.Path(name)
        cases = {
            "hash grid, seeds": of_seeds(hash_grid),
            "hash grid, scenes": of_scenes(root / "data"),
            "paper's networks, seeds": of_seeds(paper),
        }
        for case, configs in cases.items():
            together, alone, apart = measure(configs, root / case.replace(" ", "_"))
            rows.append([case, f"{together:.1f} s", f"{alone:.1f} s", f"{apart:.1e}"])
    common.publish(common.markdown(HEADS, rows), "many_runs")


if __name__ == "__main__":
    cli.run(main, stopped="and changed nothing")
