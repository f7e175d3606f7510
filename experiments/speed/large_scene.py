"""Writes a scene in the Blender format of any size, to measure what size alone costs in memory and time.

    python experiments/speed/large_scene.py --out=DIR [--views=1000] [--size=800] [--rendered=50]
    python experiments/speed/large_scene.py --out=DIR --workdir=RUN    # trains on that scene and measures

Cameras stand on the embedded scene's spiral, each with a pose of its own. Images are rendered at --rendered px and
enlarged, as the scene in closed form would take hours at full size; noise of a few levels makes them as hard to
compress like photos. There is no fine detail to learn, but everything else has the size of a real scene.
"""

import argparse
import json
import math
import os
import pathlib
import resource
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from jaxnerf.core.poses import look_at
from jaxnerf.core.types import Camera
from jaxnerf.data.synthetic import render_views

_DISTANCE = 4.0  # of every camera from the origin, world units
_FOCAL = 1.36  # times the width
_CHUNK = 20  # views rendered before they are written
_TEST = 8  # one view of the test split for so many of the training split


def main() -> None:
    """Writes the scene, or trains on it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", required=True, type=pathlib.Path, help="Folder of the scene.")
    parser.add_argument("--views", type=int, default=1000, help="Training views; the test split has 1 in 8 more.")
    parser.add_argument("--size", type=int, default=800, help="Height and width of the files, px.")
    parser.add_argument("--rendered", type=int, default=50, help="Height and width before they are enlarged, px.")
    parser.add_argument("--workdir", type=pathlib.Path, help="Train in this folder instead of writing the scene.")
    parser.add_argument("--steps", type=int, default=200, help="Training steps.")
    options = parser.parse_args()
    if options.workdir:
        print(measure(options.out, options.workdir, options.steps))
        return
    counts = {"train": options.views, "test": max(options.views // _TEST, 1)}
    for turn, (split, count) in enumerate(counts.items()):
        write_split(options.out, split, poses(count, turn), options.size, options.rendered)


def measure(folder: pathlib.Path, workdir: pathlib.Path, steps: int) -> str:
    """Returns a line with the time and memory of training configs/lego_fast.py at full size."""
    flags = (f"--data_dir={folder}", f"--workdir={workdir}", "--config.data.factor=1")
    flags += (f"--config.train.max_steps={steps}", "--config.train.log_every=1")
    rows, started = workdir / "metrics.jsonl", time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "jaxnerf.train", "--config=configs/lego_fast.py", *flags])
    while process.poll() is None and not (rows.is_file() and rows.stat().st_size):
        time.sleep(0.05)
    if process.poll():
        raise SystemExit(f"training failed with {process.returncode}")
    first = time.perf_counter() - started
    ticks = pathlib.Path(f"/proc/{process.pid}/stat").read_text().split()
    until = sum(map(int, ticks[13:15])) / os.sysconf("SC_CLK_TCK")
    if process.wait():
        raise SystemExit(f"training failed with {process.returncode}")
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    core_seconds, largest = used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e9
    compiling = json.loads(rows.read_text().splitlines()[0])["compile_seconds"]
    return (
        f"first step after {first:.1f} s and {until:.1f} core seconds ({compiling:.1f} s of compilation); "
        f"{core_seconds:.1f} core seconds in all; at most {largest:.2f} GB resident with mapped pixels; "
        f"1-minute load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    )


def poses(count: int, turn: float) -> np.ndarray:
    """Returns camera poses [V, 3, 4] on a golden spiral around the origin, from above and a little below."""
    steps = np.arange(count)
    height = -0.25 + 1.2 * (steps + 0.5) / count
    azimuth, around = math.pi * (3 - math.sqrt(5)) * steps + turn, np.sqrt(1 - height**2)
    eyes = _DISTANCE * np.stack([around * np.cos(azimuth), around * np.sin(azimuth), height], axis=-1)
    up = jnp.array([0.0, 0.0, 1.0])
    return np.asarray(jax.vmap(lambda eye: look_at(eye, jnp.zeros(3), up))(eyes))


def write_split(folder: pathlib.Path, split: str, to_world: np.ndarray, size: int, rendered: int) -> None:
    """Writes the images of a split and then transforms_<split>.json, so that a folder that has it is complete."""
    (folder / split).mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(2) as pool:
        for start in range(0, len(to_world), _CHUNK):
            part = to_world[start : start + _CHUNK]
            images = render_views(_stack(part, rendered)).reshape(len(part), rendered, rendered, 4)
            names = [folder / split / f"r_{index:04d}.png" for index in range(start, start + len(part))]
            list(pool.map(_write, names, images, [size] * len(part), range(start, start + len(part))))
            print(f"{split}: {start + len(part)} of {len(to_world)}", flush=True)
    frames = [
        {"file_path": f"./{split}/r_{index:04d}", "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]}
        for index, pose in enumerate(to_world)
    ]
    scene = {"camera_angle_x": 2 * math.atan(0.5 / _FOCAL), "frames": frames}
    (folder / f"transforms_{split}.json").write_text(json.dumps(scene))


def _stack(to_world, size):
    count = len(to_world)
    return Camera(
        to_world=to_world,
        focal=np.full((count, 2), _FOCAL * size, np.float32),
        center=np.full((count, 2), size / 2, np.float32),
        height=size,
        width=size,
    )


def _write(path, image, size, seed):
    """Writes 8-bit RGBA with straight alpha; premultiplied colours are enlarged, so that edges do not bleed."""
    values = np.float32(image) / 65535
    values[..., :3] *= values[..., 3:]
    planes = [
        np.asarray(Image.fromarray(values[..., channel]).resize((size, size), Image.BICUBIC)) for channel in range(4)
    ]
    alpha = np.clip(planes[3], 0, 1)
    straight = np.stack(planes[:3], axis=-1) / np.maximum(alpha, 1e-3)[..., None]
    noise = np.random.default_rng(seed).integers(-2, 3, straight.shape)
    rgb = np.clip(np.rint(straight * 255) + noise, 0, 255) * (alpha[..., None] > 0.5 / 255)
    pixels = np.concatenate([rgb, np.rint(alpha * 255)[..., None]], axis=-1).astype(np.uint8)
    Image.fromarray(pixels).save(path, compress_level=4)


if __name__ == "__main__":
    main()
