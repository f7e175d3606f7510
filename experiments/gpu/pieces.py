"""The measurements of run.py: each returns a dict of numbers and of rows for the page."""

import collections
import functools
import math
import os
import pathlib
import re
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

sys.path.append(str(pathlib.Path(__file__).resolve().parents[1]))
import common
import profiles

from jaxnerf import pixel_grid
from jaxnerf.evaluation import evaluate, restore
from jaxnerf.models.occupancy import render_with_grid
from jaxnerf.training import auto_config, build, metric_log
from jaxnerf.training.checkpoint import Checkpoints
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step, repeat_step

# Types of the layers, precisions of products, and bounds of the relative error against float32 on a CPU. "default" is
# TF32 on a GPU with tensor cores, which keeps 10 bits, and bfloat16 keeps 7.
_PRECISIONS = (("float32", "highest", 1e-4), ("float32", "default", 1e-2), ("bfloat16", "default", 5e-2))


class Context(NamedTuple):
    """What pieces need.

    Attributes:
        folder: of the workdirs.
        tiny: whether sizes are tiny, as a test.
        left: () -> seconds until the time of this call is over.
    """

    folder: pathlib.Path
    tiny: bool
    left: Callable[[], float]

    def config(self, base: str, overrides: dict[str, Any]):
        """Returns a config at full or at tiny size."""
        return profiles.configuration(base, overrides, tiny=self.tiny)


def hard_cases(context: Context) -> dict[str, Any]:
    """Runs the hard cases of the tests on this device."""
    sys.path.append(str(common.ROOT / "tests"))
    from hard_cases import ALL

    cases = ALL[:: len(ALL) // 4] if context.tiny else ALL
    checks = [(case, check) for case in cases for check in case.run()]
    failed = [f"{case}: {check}" for case, check in checks if not check.passed]
    return {"checks": len(checks), "failed": len(failed), "failures": failed}


def agreement(context: Context) -> dict[str, Any]:
    """Compares renderings and gradients on this device with those of a CPU, by precision of matrix products."""
    rows = []
    for field in ("hash_grid",) if context.tiny else ("hash_grid", "mlp"):
        config = context.config("lego_fast", {"field": field, "data.factor": 8, "train.batch_size": 256})
        config, views, _ = auto_config.resolve(config, common.load_split(config, "train"), platform="cpu")
        section = "fine" if field == "mlp" else field
        inputs = _first_step(config, views)
        exact = _gradient(config, inputs, "highest", jax.devices("cpu")[0])
        for dtype, precision, bound in _PRECISIONS[1 if context.tiny else 0 :]:
            changed = common.changed(config, {f"{section}.compute_dtype": dtype})
            found = _gradient(changed, inputs, precision, jax.devices()[0])
            errors = {part: _relative(found[part], exact[part]) for part in exact}
            holds = all(error <= bound for error in errors.values())
            rows.append(
                {"field": field, "type": dtype, "products": precision, **errors, "bound": bound, "holds": holds}
            )
    return {"rows": rows, "failed": sum(not row["holds"] for row in rows)}


def _first_step(config, views):
    """Returns parameters, grid, keys and batch of the first step, made on a CPU: the same for every device."""
    experiment = build.build(auto_config.resolve_for_device(config, "cpu")[0])
    with jax.default_device(jax.devices("cpu")[0]):
        cells, data = experiment.prepare(views)
        state = create_state(experiment.model, experiment.optimizer, experiment.config.seed, cells)
        positions = jnp.arange(config.train.batch_size)
        return state.params, state.grid, *jax.jit(experiment.draw)(state.step, positions, data)


def _gradient(config, inputs, precision, device):
    """Returns colours, loss and gradient of the first step on a device, in numpy."""
    experiment = build.build(auto_config.resolve_for_device(config, "cpu")[0])

    def loss(params, grid, keys, batch):
        rgb = experiment.model.render(keys, params, grid, batch.rays, 0)[-1].rgb
        return jnp.mean((rgb - batch.rgb) ** 2), rgb

    with jax.default_matmul_precision(precision):
        arguments = jax.device_put(inputs, device)
        # The choice of the fastest kernels takes a GPU half a minute, and this runs once.
        options = {"xla_gpu_autotune_level": 0} if device.platform == "gpu" else None
        compiled = jax.jit(jax.value_and_grad(loss, has_aux=True), compiler_options=options)
        (value, rgb), grads = compiled(*arguments)
    gradient = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(jax.device_get(grads))])
    return {"colour": np.asarray(rgb), "loss": np.asarray(value), "gradient": gradient}


def _relative(found, exact):
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


def determinism(context: Context) -> dict[str, Any]:
    """Takes the same steps twice, as they are and with train.deterministic."""
    rows = []
    for deterministic in (False, True):
        config = context.config("lego_fast", profiles.FULL_SIZE | {"train.deterministic": deterministic})
        same, seconds = _twice(common.compile_step(config), 2 if context.tiny else 100)
        rows.append({"train.deterministic": deterministic, "same bits": same, "ms per step": 1e3 * seconds})
    return {"rows": rows}


def _twice(step, num_steps):
    """Returns whether two runs of some steps agree bit for bit, and the seconds of a step."""
    states = []
    for _ in range(2):
        state = jax.tree.map(jnp.copy, step.state)
        started = time.perf_counter()
        for _ in range(num_steps):
            state, _ = step.run(state, step.data, step.positions)
        jax.block_until_ready(state)
        seconds = (time.perf_counter() - started) / num_steps
        states.append(jax.device_get(state.params))
    same = all(np.array_equal(*pair) for pair in zip(*map(jax.tree.leaves, states), strict=True))
    return same, seconds


def ceilings(context: Context) -> dict[str, Any]:
    """Measures what this device reaches."""
    return profiles.measure_ceilings(context.tiny)


def step_parts(context: Context) -> dict[str, Any]:
    """Times the training step at full size, its parts, and several steps in a dispatch.

    FLOP are the compiler's count, in which the iterations of a loop count once unless it knows their number, and on a
    GPU possibly not the products that a library computes. The product is one in float32.
    """
    experiment, state, data, config = _built(context, profiles.FULL_SIZE)
    parts = experiment.model, experiment.optimizer, experiment.draw, experiment.losses
    step = make_train_step(*parts, pixel_rays=experiment.pixel_rays)
    positions = jnp.arange(config.train.batch_size).reshape(-1, config.train.microbatch_size)
    no_updates = data._replace(cells=data.cells[:0])
    keys, batch = jax.jit(experiment.draw)(state.step, positions.reshape(-1), data)
    model, optimizer = experiment.model, experiment.optimizer

    def render(params):
        return model.render(keys, params, state.grid, batch.rays, state.step)[-1].rgb

    def loss(params):
        return jnp.mean((render(params) - batch.rgb) ** 2)

    def update(state):
        young = config.occupancy.update_every - 1  # a step that updates the grid
        return model.grid_schedule.update(jax.random.key(0), jnp.int32(young), state.params, state.grid, data.cells)

    def descend(grads):
        return optimizer.update(grads, state.opt_state, state.params)

    timed = {
        "drawing the rays": (experiment.draw, state.step, positions.reshape(-1), data),
        "rendering": (render, state.params),
        "rendering and gradient": (jax.grad(loss), state.params),
        "optimizer": (descend, state.params),
        "update of the grid": (update, state),
        "step without an update": (step, state, no_updates, positions),
    }
    peak, rows = profiles.product_flops(context.tiny), []
    for name, (function, *arguments) in timed.items():
        compiled = jax.jit(function).lower(*arguments).compile()
        flops = (compiled.cost_analysis() or {}).get("flops", 0.0)
        seconds = profiles.repeated(compiled, *arguments, repeats=2 if context.tiny else 20)
        rows.append({"part": name, "ms": 1e3 * seconds, "GFLOP": flops / 1e9, "of a product": flops / seconds / peak})
    for count in (1, 2) if context.tiny else (1, 4, 16):
        run = jax.jit(repeat_step(step, count))
        seconds = profiles.repeated(run, state, data, positions, repeats=1 if context.tiny else max(64 // count, 1))
        rows.append({"part": f"step, {count} in a dispatch", "ms": 1e3 * seconds / count})
    return {"rays": config.train.batch_size, "float32 product, GFLOP/s": peak / 1e9, "rows": rows}


def _built(context, overrides):
    """Returns the Experiment, its first state, its data and the resolved config of lego_fast, on this device."""
    config = context.config("lego_fast", overrides)
    resolved, views, _ = auto_config.resolve(config, common.load_split(config, "train"))
    resolved, _ = auto_config.resolve_for_device(resolved)
    experiment = build.build(resolved)
    cells, data = experiment.prepare(views)
    state = create_state(experiment.model, experiment.optimizer, experiment.config.seed, cells)
    return experiment, state, jax.device_put(data), resolved


def kernels(context: Context) -> dict[str, Any]:
    """Traces training steps and adds up the time of each kernel; the source of a kernel is that of one of its parts."""
    config = context.config("lego_fast", profiles.FULL_SIZE)
    step = common.compile_step(config)
    state, count = step.state, 2 if context.tiny else 32
    for _ in range(2 if context.tiny else 512):  # until the grid knows what is empty
        state, _ = step.run(state, step.data, step.positions)
    jax.block_until_ready(state)
    folder = context.folder / "trace"
    with jax.profiler.trace(str(folder)):
        started = time.perf_counter()
        for _ in range(count):
            state, metrics = step.run(state, step.data, step.positions)
        jax.block_until_ready((state, metrics))
        wall = (time.perf_counter() - started) / count
    sources = dict(re.findall(r'(?m)^ *(?:ROOT )?%?([\w.-]+) = .*?op_name="([^"]*)"', step.run.as_text()))
    (path,) = folder.glob("**/*.xplane.pb")
    return {"ms per traced step": 1e3 * wall} | kernel_times(str(path), sources, count)


def kernel_times(path: str, sources: dict[str, str], num_steps: int) -> dict[str, Any]:
    """Returns the times of the kernels of a trace of so many steps; {operation of the compiled step: its source}."""
    sources = {name.replace(".", "_"): source for name, source in sources.items()}  # as kernels are called
    total, calls = collections.Counter(), collections.Counter()
    for event in _kernels(jax.profiler.ProfileData.from_file(path)):
        name = event.name.replace(".", "_")
        total[name] += event.duration_ns / 1e6 / num_steps
        calls[name] += 1 / num_steps
    rows = [
        {"kernel": name[:40], "source": "/".join(sources.get(name, "").split("/")[-3:]), "calls": calls[name], "ms": ms}
        for name, ms in total.most_common(25)
    ]
    return {"ms in kernels": sum(total.values()), "kernels per step": sum(calls.values()), "rows": rows}


def _kernels(profile):
    """Yields the events of the accelerator's streams; on a CPU those of the compiled operations."""
    planes = [plane for plane in profile.planes if plane.name.startswith("/device:")]
    for plane in planes or profile.planes:
        for line in plane.lines:
            if planes and not line.name.startswith("Stream"):
                continue
            yield from (event for event in line.events if planes or "hlo_op" in dict(event.stats))


def blender(context: Context, *, name: str = "lego", seconds: float) -> dict[str, Any]:
    """Trains a scene at 800 x 800 for so many seconds and scores its test views."""
    limit = min(seconds, 1.0) if context.tiny else seconds
    overrides = {"data.dir": name, "train.max_seconds": float(limit)}
    config = context.config("lego_fast", profiles.FULL_SIZE | profiles.TIMED | overrides)
    return _trained(config, context.folder / f"{name}-{seconds:g}")


_SMALL = {"hash_grid.width": 64, "hash_grid.view_width": 64, "hash_grid.table_size": 2**20}
_SIZES = {
    "5 samples per ray, networks 64 wide, 2^20 rows": _SMALL | {"occupancy.pool_samples_per_ray": 5.0},
    "8 samples per ray": _SMALL,
    "8 samples per ray, a level of 1,024 vertices": _SMALL | {"hash_grid.resolutions": (32, 64, 128, 256, 512, 1024)},
    "8 samples per ray, 2^22 rows": _SMALL | {"hash_grid.table_size": 2**22},
    "8 samples per ray, networks 128 wide": _SMALL | {"hash_grid.width": 128, "hash_grid.view_width": 128},
    "auto": {},
}


def sizes(context: Context) -> dict[str, Any]:
    """Trains lego at 800 x 800 with other sizes for as many steps, and scores views held out of training."""
    steps = 20 if context.tiny else 6000
    fixed = {"data.hold_out": 8, "train.max_steps": steps, "train.lr_steps": steps, "train.save_every": steps}
    rows = []
    for index, (name, changes) in enumerate(_SIZES.items()):
        config = context.config("lego_fast", profiles.FULL_SIZE | fixed | changes)
        rows.append({"sizes": name, **_trained(config, context.folder / f"sizes_{index}", split="held_out")})
    return {"rows": rows}


def scene(context: Context, *, name: str) -> dict[str, Any]:
    """Trains a real capture at its full size for two minutes and scores its test views."""
    limit = 1.0 if context.tiny else 120.0
    overrides = {"data.dir": name, "data.width": 10_000, "train.max_seconds": limit}
    return _trained(context.config("capture", profiles.TIMED | overrides), context.folder / name)


def _trained(config, folder, split=None):
    results = common.run(config, folder, split=split)
    if results is None:
        raise KeyboardInterrupt
    row = metric_log.read_rows(folder)[-1]
    names = ("psnr", "ssim", "views", "seconds_per_frame")
    return {name: results[name] for name in names if name in results} | {
        "training seconds": row["seconds"],
        "compile seconds": row["compile_seconds"],
        "steps": row["step"],
        "rays": row["rays"],
    }


def cpu_cores(context: Context) -> dict[str, Any]:
    """Trains and renders fox on this machine's CPU, with 1, 2, 4 and more of its cores, by the study of speed/cores.py.

    The measurements are processes of their own, as this one has JAX on the device.
    """
    usable = len(os.sched_getaffinity(0))
    counts = [count for count in (1, 2, 4, 8, 16) if count <= usable][: 2 if context.tiny else None]
    out = context.folder / "cpu_cores"
    command = [sys.executable, str(common.ROOT / "experiments" / "speed" / "cores.py"), f"--out={out}", "--parts="]
    command += [f"--cores={','.join(map(str, counts))}", "--runs=fox_200", "--rounds=1", "--gain=1"]
    command += [f"--seconds={1 if context.tiny else 10}", f"--tiny={context.tiny}"]
    done = subprocess.run(command, env={**os.environ, "JAX_PLATFORMS": "cpu"}, capture_output=True, text=True)
    if done.returncode:
        raise ValueError(f"{' '.join(command)}: {(done.stderr.splitlines() or ['no output'])[-1]}")
    found = {count: [out / f"fox_200-{kind}-{count}-0.json" for kind in ("run", "frame")] for count in counts}
    return {"rows": [{"cores": count, **common.read_json(a), **common.read_json(b)} for count, (a, b) in found.items()]}


def frame(context: Context) -> dict[str, Any]:
    """Times an 800 x 800 frame of the longest lego run that is there, by chunk and size of the sample buffer."""
    folders = [path for path in context.folder.glob("lego-*") if Checkpoints(path).steps()]
    if not folders:  # of an earlier machine, which kept nothing
        blender(context, seconds=30)
        folders = [context.folder / "lego-30"]
    folder = max(folders, key=lambda path: float(path.name.split("-")[1]))
    rows = []
    sizes = [(256, 2**10), (512, 2**10)] if context.tiny else [(2**16, 2**17), (2**18, 2**19), (2**20, 2**20)]
    for chunk, max_samples in sizes:
        run = restore.restore_run(folder, settings={"chunk": chunk, "max_samples": max_samples})
        variables = run.variables(restore.newest_step(run, folder))
        views = run.experiment.load_split(run.experiment.config.eval.split)
        rays = run.experiment.view_rays(
            views, 0, pixel_grid(*views.size[0].tolist(), offset=run.experiment.config.data.pixel_offset)
        )
        seconds = profiles.repeated(functools.partial(run.render_image, variables), rays, repeats=3)
        rows.append({"chunk": chunk, "max_samples": max_samples, "ms per frame": 1e3 * seconds})
    return {"workdir": folder.name, "rows": rows}


def paper_mlp(context: Context) -> dict[str, Any]:
    """Trains the paper's network with an occupancy grid; scores all test views at the end, two at each checkpoint."""
    limit = 1.0 if context.tiny else max(min(context.left() - 75, 420.0), 60.0)
    overrides = {"fine.depth": 8, "fine.width": 256, "fine.view_width": 128, "fine.num_freqs": 10}
    overrides |= {"fine.compute_dtype": "bfloat16", "train.max_to_keep": 20, "train.save_every": 4000}
    overrides |= profiles.FULL_SIZE | profiles.TIMED | {"train.max_seconds": limit}
    config, folder = context.config("lego_mlp_fast", overrides), context.folder / "paper_mlp"
    return {**_trained(config, folder), "rows": _scored(config, folder)}


def paper(context: Context) -> dict[str, Any]:
    """Trains the paper's own configuration as far as time goes; called again, it goes on."""
    folder, size = context.folder / "paper", 20 if context.tiny else 1000
    overrides = {"data.factor": 1, "train.save_every": size, "train.max_to_keep": 20, "train.log_every": size // 4}
    done = Checkpoints(folder).steps() if folder.exists() else []
    # The learning rate follows the steps, as the paper's does, so steps end this run and not seconds.
    more, goal = size, done[-1] if done else 0
    while more:
        goal += more
        config = context.config("blender_paper", overrides | {"train.max_steps": goal})
        started = time.perf_counter()
        if not evaluate.train_and_evaluate(config, folder, views=common.load_split(config, "train")):
            raise KeyboardInterrupt
        rate = more / (time.perf_counter() - started)
        more = 0 if context.tiny else int(max(context.left() - 120, 0) * rate / 2) // size * size
    return {"rows": _scored(config, folder)}


def _scored(config, folder):
    """Scores two test views at each checkpoint; returns rows."""
    run = restore.restore_run(folder)
    views = run.experiment.load_split(run.experiment.config.eval.split)
    logged = {row["step"]: row for row in metric_log.read_rows(folder)}
    rows = []
    for step in run.steps():
        psnr = _mean_psnr(run, run.variables(step), views, (0, len(views.names) // 2))
        row = logged[step]
        rows.append({"step": step, "seconds": row["seconds"], "rays": row["rays"], "PSNR of 2 views": psnr})
    rate = rows[-1]["rays"] / max(rows[-1]["seconds"], 1e-9)
    return [row | {"rays/s": rate} for row in rows]


def _mean_psnr(run, variables, views, indices):
    """Returns the mean PSNR, dB, of the views of these indices."""
    found = []
    for index in indices:
        pixels = pixel_grid(*views.size[index].tolist(), offset=run.experiment.config.data.pixel_offset)
        rgb = run.render_image(variables, run.experiment.view_rays(views, index, pixels)).rgb
        found.append(-10 * math.log10(float(np.mean((np.asarray(rgb) - views.image(index)) ** 2))))
    return float(np.mean(found))


def memory_use(context: Context) -> dict[str, Any]:
    """Measures memory and rays per second of a step by its batch, and memory of a frame by its chunk."""
    rows = []
    for rays in (32, 64) if context.tiny else (2**12, 2**14, 2**15, 2**16, 2**17):
        config = context.config("lego_fast", profiles.FULL_SIZE | {"occupancy.pool_samples_per_ray": 8.0})
        step = common.compile_step(common.changed(config, {"train.batch_size": rays, "train.microbatch_size": rays}))
        stats = step.run.memory_analysis()
        state = step.state

        def steps(state=state, step=step):
            for _ in range(10):
                state, metrics = step.run(jax.tree.map(jnp.copy, state), step.data, step.positions)
            return metrics

        seconds = profiles.repeated(steps, repeats=1) / 10
        rows.append(
            {"what": f"step of {rays} rays", "temporary MB": stats.temp_size_in_bytes / 1e6, "ms": 1e3 * seconds}
            | {"rays/s": rays / seconds}
        )
    experiment, state, _, config = _built(context, profiles.FULL_SIZE | {"data.factor": 4})
    schedule = experiment.model.grid_schedule
    scene = experiment.model.scene(state.params, state.grid)
    views = common.load_split(config, "train")
    for chunk in (256, 1024) if context.tiny else (2**14, 2**16, 2**18):
        options = {"step_size": schedule.step_size, "cell": schedule.cell, "early_stop_eps": 1e-3}
        render = jax.jit(
            functools.partial(render_with_grid, scene, state.grid, max_samples=config.eval.max_samples, **options)
        )
        rays = experiment.view_rays(views, 0, jnp.full((chunk, 2), 10.0))
        stats = render.lower(rays).compile().memory_analysis()
        rows.append({"what": f"chunk of {chunk} rays", "temporary MB": stats.temp_size_in_bytes / 1e6})
    return {"rows": rows}
