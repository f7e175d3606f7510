"""The part "rendering" of speed_vs_error.py: seconds per frame against the error, setting by setting."""

import itertools
import statistics
from collections.abc import Callable
from typing import Any

import common
import jax.numpy as jnp
import numpy as np

from jaxnerf import pixel_grid, psnr
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.training import workdir
from jaxnerf.training.config import to_config_dict

MULTIPLIERS = (4.0, 2.0, 1.0, 0.7, 0.5, 0.35)
EARLY_STOPS = (0.0, 1e-3, 1e-2, 3e-2, 1e-1)
CHUNKS = (1024, 4096, 16384)
DTYPES = ("float32", "bfloat16")
SIDE = 800  # px, of the frame that is timed without scoring it
LONGEST = 60.0  # s; a frame of SIDE that is expected to take longer is not timed
_EVAL_KEYS = ("sample_multiplier", "early_stop_eps", "bake_occupancy")
_EXACT = {"sample_multiplier": 4.0, "early_stop_eps": 0.0, "chunk": 1024, "compute_dtype": "float32"}
_EXACT["bake_occupancy"] = False


def measure(kept: dict[str, Any], save: Callable[[dict], None], folder, num_views: int) -> None:
    """Renders some of the scored views with each setting; kept settings are not rendered again.

    Args:
        kept, save: see training.measure.
        folder: of a trained run.
        num_views: number of views.
    """
    config = to_config_dict(workdir.load_config(folder))
    run = restore_run(folder)
    step = newest_step(run, folder)
    name = {"workdir": str(folder), "step": step, "frames": num_views, "machine": common.describe_machine()}
    if any(kept.get(key) != value for key, value in name.items()):
        kept.clear()
        kept.update(name, rows=[], notes=[], gflops=[])
    tried, kept["notes"] = settings(config, run)
    done = [row["settings"] for row in kept["rows"]]
    missing = [setting for setting in tried if setting not in done]
    if not missing:
        return
    kept["gflops"].append(common.matrix_gflops())
    views = run.experiment.load_split(run.experiment.config.eval.split)
    chosen = np.unique(np.linspace(0, len(views.offset) - 1, num_views).astype(int))
    truths = [np.asarray(views.image(index)) for index in chosen]
    exact_frame = _renderer(folder, config, _EXACT, step, views)
    exact_frames = [exact_frame(index) for index in chosen]
    for setting in missing:
        frames, seconds, large = _timed(_renderer(folder, config, setting, step, views), chosen)
        kept["rows"].append(
            {"settings": setting, "seconds": seconds, "seconds_800": large, **_errors(frames, exact_frames)}
            | {"psnr": float(np.mean([psnr(*pair) for pair in zip(frames, truths, strict=True)]))}
        )
        save(kept)
        print(f"{setting}: {seconds:.3f} s, RMS error {kept['rows'][-1]['rms']:.5f}", flush=True)
    kept["gflops"].append(common.matrix_gflops())
    save(kept)


def settings(config, run) -> tuple[list[dict[str, Any]], list[str]]:
    """Returns the settings to try, and notes on those that are excluded.

    One setting at a time varies around the run's own, and sample_multiplier together with early_stop_eps. A run
    that was trained without a grid is rendered once without, and otherwise through a grid that is baked from it.
    """
    section, options = config[_section(config)], run.experiment.config.eval
    has_grid = run.experiment.model.grid_schedule is not None
    own = {
        "sample_multiplier": options.sample_multiplier,
        "early_stop_eps": options.early_stop_eps,
        "chunk": options.chunk,
        "compute_dtype": "float32" if config.field == "hash_grid" else section.get("compute_dtype", "float32"),
        "bake_occupancy": not has_grid,
    }
    tried, notes = [own], []
    if not has_grid:
        tried.insert(0, own | {"bake_occupancy": False})
    tried += [own | {"chunk": chunk} for chunk in CHUNKS]
    if "compute_dtype" in section and config.field != "hash_grid":
        tried += [own | {"compute_dtype": dtype} for dtype in DTYPES]
    else:
        notes.append(f"precision: excluded, as the {config.field} field has one only")
    tried += [
        own | {"sample_multiplier": multiplier, "early_stop_eps": early_stop}
        for multiplier, early_stop in itertools.product(MULTIPLIERS, EARLY_STOPS)
    ]
    return [setting for place, setting in enumerate(tried) if setting not in tried[:place]], notes


def _section(config):
    return "fine" if config.field == "mlp" else config.field


def _renderer(folder, config, setting, step, views):
    """Returns (index of a view, side in px or None for its own) -> frame [H, W, 3]."""
    config = common.changed(config, {f"{name}.compute_dtype": setting["compute_dtype"] for name in ("coarse", "fine")})
    run = restore_run(folder, config, settings={key: setting[key] for key in _EVAL_KEYS})
    variables = run.variables(step)

    def frame(index, side=None):
        size = np.asarray(views.size[index])
        pixels = pixel_grid(*([side] * 2 if side else size.tolist()), offset=run.experiment.config.data.pixel_offset)
        pixels = pixels * (size[::-1] / side if side else np.ones(2))[None, None]
        rays = run.experiment.view_rays(views, index, pixels.astype(jnp.float32))
        return np.asarray(run.render_image(variables, rays, chunk=setting["chunk"]).rgb)

    return frame


def _timed(frame, chosen):
    """Returns the frames, the median of their seconds, and the seconds of one of SIDE x SIDE, or None."""
    frames = [frame(index) for index in chosen]  # compiles
    median = statistics.median(common.seconds(lambda index=index: frame(index)) for index in (*chosen, *chosen))
    if median * SIDE**2 / frames[0][..., 0].size > LONGEST:
        return frames, median, None
    frame(chosen[0], SIDE)  # compiles, as ray culling has the size of the frame
    return frames, median, common.seconds(lambda: frame(chosen[0], SIDE))


def _errors(frames, truths):
    difference = np.concatenate([(a - b).ravel() for a, b in zip(frames, truths, strict=True)])
    return {"rms": float(np.sqrt(np.mean(difference**2))), "largest": float(np.abs(difference).max())}
