"""The rendering part of speed_vs_error.py: seconds a frame against the error, setting by setting."""

import itertools
import statistics
import time

import jax.numpy as jnp
import numpy as np
import speed_machine

from jaxnerf import pixel_grid, psnr
from jaxnerf.evaluation.evaluate import reference
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.training import workdir

SAMPLES = (4.0, 2.0, 1.0, 0.7, 0.5, 0.35)
STOPS = (0.0, 1e-3, 1e-2, 3e-2, 1e-1)
CHUNKS = (1024, 4096, 16384)
TYPES = ("float32", "bfloat16")
SIDE = 800  # px, of the frame that is timed for its time alone
LONGEST = 60.0  # s, that such a frame may be expected to take; else it is left out
KEYS = ("sample_multiplier", "early_stop_eps", "chunk", "compute_dtype", "bake_occupancy")


def measure(kept, save, folder, view_count):
    """Renders some of the scored views with each setting; what is kept is not rendered again.

    Args:
        kept, save: see speed_training.measure.
        folder: of a trained run.
        view_count: how many views.
    """
    config = workdir.read_config(folder)
    run = restore_run(folder, config)
    step = newest_step(run, folder)
    name = {"workdir": str(folder), "step": step, "frames": view_count, "machine": speed_machine.describe()}
    if any(kept.get(key) != value for key, value in name.items()):
        kept.clear()
        kept.update(name, rows=[], notes=[], gflops=[])
    wanted, kept["notes"] = settings(config, run.experiment.model.grid_schedule is not None)
    done = [row["settings"] for row in kept["rows"]]
    wanted = [setting for setting in wanted if setting not in done]
    if not wanted:
        return
    kept["gflops"].append(speed_machine.matrix_gflops())
    views = run.experiment.load_views(run.experiment.eval.split)
    chosen = np.unique(np.linspace(0, len(views.offset) - 1, view_count).astype(int))
    truths = [np.asarray(reference(views, index)) for index in chosen]
    exact = {
        "sample_multiplier": 4.0,
        "early_stop_eps": 0.0,
        "chunk": 1024,
        "compute_dtype": "float32",
        "bake_occupancy": False,
    }
    exact_frame = _renderer(folder, config, exact, step, views)
    exact_frames = [exact_frame(index) for index in chosen]
    for setting in wanted:
        frames, seconds, large = _timed(_renderer(folder, config, setting, step, views), chosen)
        kept["rows"].append(
            {"settings": setting, "seconds": seconds, "seconds_800": large, **_errors(frames, exact_frames)}
            | {"psnr": float(np.mean([psnr(*pair) for pair in zip(frames, truths, strict=True)]))}
        )
        save(kept)
        print(f"{setting}: {seconds:.3f} s, RMS error {kept['rows'][-1]['rms']:.5f}", flush=True)
    kept["gflops"].append(speed_machine.matrix_gflops())
    save(kept)


def settings(config, skips):
    """Returns the settings to try, and what is left out and why.

    One thing at a time around the configuration's own, and samples times stop.

    Args:
        config: of the run.
        skips: whether it was trained to skip empty space. One that was not is rendered in full once, and
            with what is empty left out otherwise.
    """
    learned = "features" if config.get("field") == "grid" else "fine"
    dtype = config[learned].get("compute_dtype", "float32")
    own = (config.eval.sample_multiplier, config.eval.early_stop_eps, config.eval.chunk, dtype, not skips)
    own = dict(zip(KEYS, own, strict=True))
    tried, notes = [own], []
    if not skips:
        tried.insert(0, own | {"bake_occupancy": False})
    tried += [own | {"chunk": chunk} for chunk in CHUNKS]
    if "compute_dtype" in config[learned]:
        tried += [own | {"compute_dtype": dtype} for dtype in TYPES]
    else:
        notes.append(f"precision: left out, as the {config.field} field has none to choose")
    tried += [
        own | {"sample_multiplier": samples, "early_stop_eps": stop}
        for samples, stop in itertools.product(SAMPLES, STOPS)
    ]
    return [setting for place, setting in enumerate(tried) if setting not in tried[:place]], notes


def _renderer(folder, config, setting, step, views):
    """Returns (index of a view, side in px or None for its own) -> frame [H, W, 3]."""
    config = config.copy_and_resolve_references()
    for name in ("coarse", "fine"):
        config[name].compute_dtype = setting["compute_dtype"]
    run = restore_run(
        folder,
        config,
        settings={key: setting[key] for key in ("sample_multiplier", "early_stop_eps", "bake_occupancy")},
    )
    weights = run.weights(step)

    def frame(index, side=None):
        size = np.asarray(views.size[index])
        pixels = pixel_grid(*([side] * 2 if side else size.tolist()), offset=run.experiment.pixel_offset)
        pixels = pixels * (size[::-1] / side if side else np.ones(2))[None, None]
        rays = run.experiment.view_rays(views, index, pixels.astype(jnp.float32))
        return np.asarray(run.image(weights, rays, chunk=setting["chunk"]).rgb)

    return frame


def _timed(frame, chosen):
    """Returns the frames, the median of their seconds, and the seconds of one of SIDE x SIDE, or None."""
    frame(chosen[0])  # compiles
    frames, seconds = [], []
    for index in (*chosen, *chosen):
        started = time.perf_counter()
        frames.append(frame(index))
        seconds.append(time.perf_counter() - started)
    frames = frames[: len(chosen)]
    median = statistics.median(seconds)
    if median * SIDE**2 / frames[0][..., 0].size > LONGEST:
        return frames, median, None
    frame(chosen[0], SIDE)  # compiles, as what looks for the rays to render has the frame's size
    started = time.perf_counter()
    frame(chosen[0], SIDE)
    return frames, median, time.perf_counter() - started


def _errors(frames, truths):
    difference = np.concatenate([(a - b).ravel() for a, b in zip(frames, truths, strict=True)])
    return {"rms": float(np.sqrt(np.mean(difference**2))), "largest": float(np.abs(difference).max())}
