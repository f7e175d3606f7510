"""One process of a row of scaling.py: compiles a run's step, takes some, and prints what it saw as JSON."""

import importlib.util
import json
import statistics
import sys
import time

import jax
import scaling_model

from jaxnerf.runtime import devices
from jaxnerf.runtime import processes as processes_module
from jaxnerf.training import auto_config, build
from jaxnerf.training.state import create_state
from jaxnerf.training.step import make_train_step


def main(file, steps, port, processes, index):
    """Arguments as scaling.measure gives them."""
    processes = int(processes)
    options = {"coordinator": f"127.0.0.1:{port}", "num_processes": processes, "process_id": int(index)}
    with processes_module.cluster(**(options if processes > 1 else {"multihost": False})):
        row = _measure(file, int(steps))
        if processes_module.is_first():
            print(json.dumps(row), flush=True)


def _measure(file, steps):
    spec = importlib.util.spec_from_file_location("config", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    config, _ = auto_config.resolve_data(module.get_config())
    views = build.load_views(config.data, "train")
    config, _ = auto_config.resolve_sizes(config, views)
    experiment = build.build(config)
    valid, data = experiment.survey(views)
    state = create_state(experiment.model, experiment.optimizer, experiment.seed, valid)
    step = make_train_step(experiment.model, experiment.optimizer, experiment.draw)
    parameters = sum(leaf.size for leaf in jax.tree.leaves(state.params))
    rays, started = experiment.train.batch_size, time.perf_counter()
    run, state, data = devices.compile_step(
        step,
        state,
        data,
        batch_size=rays,
        samples_per_ray=experiment.samples_per_ray,
        mode="sharded",
    )
    compile_seconds, taken = time.perf_counter() - started, []
    for _ in range(steps):
        started = time.perf_counter()
        state, metrics = run(state, data)
        jax.block_until_ready(metrics)
        taken.append(time.perf_counter() - started)
    memory = run.compiled.memory_analysis()
    held = memory.argument_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes
    size, count = scaling_model.collective_bytes(run.compiled.as_text())
    return {
        "rays": rays,
        "parameters": parameters,
        "rays_per_second": rays / statistics.median(taken[1:]),
        "device_bytes": held + memory.temp_size_in_bytes,
        "collective_bytes": size,
        "collectives": count,
        "compile_seconds": compile_seconds,
    }


if __name__ == "__main__":
    main(*sys.argv[1:])
