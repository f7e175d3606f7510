"""The one place that knows about devices: the same step under jit, sharded jit and pmap.

With several processes (see hosts.cluster) the devices are those of all of them. Each process reads all
training views and keeps them on each of its devices. It cannot do with less: a ray may be of any pixel, and
of which follows from its position in the whole batch, so that batches are the same on any number of devices.
It draws, renders and differentiates the rays of its own devices only; gradients are summed over all devices.
The first process alone writes config.json, metrics.jsonl and what is printed; all take part in a checkpoint.
"""

import functools
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, SingleDeviceSharding
from jax.sharding import PartitionSpec as P

from jaxnerf.runtime import memory, processes

MODES = ("auto", "jit", "sharded", "pmap")
CPU_BLOCK_SAMPLES = 12_288


def compile_step(train_step, state, data, *, batch_size, microbatch_size=0, samples_per_ray=1, mode="auto"):
    """Returns the step compiled for the devices, and the state and data placed for it.

    Args:
        train_step: see step.make_train_step.
        state: TrainState, or a function that makes one, which then runs while the step compiles. That of
            the first process counts.
        data: what the step's draw takes; copied to every device. The same in all processes.
        batch_size: rays a step, over all devices of all processes.
        block_size: rays whose gradient is taken at once. 0: all that a device has, or on a CPU as
            many as its cache holds the activations of.
        samples_per_ray: of the largest network, for that choice.
        mode: "jit" (one device), "sharded" (jit over a mesh of all devices), "pmap", or "auto": jit
            where there is one device, else sharded.

    Returns:
        run, state, data: run(state, data) -> (state, metrics) consumes its state; run.compiled is what JAX
        compiled, with its memory_analysis() and as_text(), but for pmap in several processes.

    Raises:
        ValueError: if the batch does not split evenly, the processes' data differ, or on an unknown mode.
        memory.NoRoom: if the step would need more memory than there is.
    """
    devices = devices_of(mode)
    microbatch_size = microbatch_size or default_microbatch(
        batch_size // len(devices), samples_per_ray, devices[0].platform
    )
    positions = split_positions(batch_size, len(devices), microbatch_size)
    mesh = Mesh(np.array(devices), ("batch",))
    single = mode == "jit" or (mode == "auto" and len(devices) == 1)
    everywhere = SingleDeviceSharding(devices[0]) if single else NamedSharding(mesh, P())
    if single:
        jitted, positions = jax.jit(train_step, donate_argnums=0), jnp.asarray(positions[0])
    elif mode == "pmap":
        axes = {"in_axes": (None, None, 0), "out_axes": None}
        step = functools.partial(train_step, axis_name="batch")
        jitted = jax.pmap(step, "batch", devices=devices, donate_argnums=0, **axes)
        own = [index for index, device in enumerate(devices) if device.process_index == jax.process_index()]
        positions = positions[own]
    else:
        jitted = _sharded(train_step, mesh)
        positions = place(positions, NamedSharding(mesh, P("batch")))
    make = state if callable(state) else lambda: state
    shapes = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=everywhere), jax.eval_shape(make)
    )
    processes.check_same("data or configuration", data)
    data = place(data, everywhere)
    with ThreadPoolExecutor(1) as pool:
        made = pool.submit(_to_plain_code(state, devices[0]) if callable(state) else make)
        if mode == "pmap" and jax.process_count() > 1:  # whose pmap JAX compiles at its first call only
            compiled = _with_state_everywhere(jitted, everywhere)
        else:
            compiled = jitted.lower(shapes, data, positions).compile()
            memory.check(compiled)
        state = place(processes.from_first(made.result()), everywhere)

    def run(state, data):
        return compiled(state, data, positions)

    run.compiled = compiled
    return run, state, data


def _sharded(train_step, mesh):
    # With check_vma the gradient of replicated parameters would be summed once more.
    sharded = jax.shard_map(
        lambda state, data, positions: train_step(state, data, positions[0], axis_name="batch"),
        mesh=mesh,
        in_specs=(P(), P(), P("batch")),
        out_specs=P(),
        check_vma=False,
    )
    return jax.jit(sharded, donate_argnums=0)


def _to_plain_code(function, device):
    """Returns a jitted function that runs once: to make its code fast would take longer than to run it."""
    plain = {"xla_backend_optimization_level": 0} if device.platform == "cpu" else None
    return jax.jit(function, compiler_options=plain)


def _with_state_everywhere(run, everywhere):
    """Returns the pmapped step with a state of all processes, where pmap gives one of its own devices."""

    def whole(leaf):
        parts = [shard.data for shard in leaf.addressable_shards]
        return jax.make_array_from_single_device_arrays(leaf.shape, everywhere, parts)

    def compiled(state, data, positions):
        state, metrics = run(state, data, positions)
        return jax.tree.map(whole, state), metrics

    return compiled


def place(tree, sharding):
    """Returns arrays on the devices of a sharding; some may be other processes', which have the same tree."""
    if sharding.is_fully_addressable:
        return jax.device_put(tree, sharding)

    def put(leaf):
        whole = np.asarray(leaf)
        return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])

    return jax.tree.map(put, tree)


def devices_of(mode):
    """Returns the devices, of all processes, that a mode uses; ValueError if there is no such mode."""
    if mode not in MODES:
        raise ValueError(f"train.parallel is {mode!r}, wanted one of {MODES}")
    if mode == "jit" and jax.process_count() > 1:
        raise ValueError(f"train.parallel is 'jit' in {jax.process_count()} processes; set it to 'auto'")
    return jax.devices()[: 1 if mode == "jit" else None]


def default_microbatch(share, samples_per_ray, platform):
    """Returns how many of a device's share of rays to take the gradient of at once."""
    if platform != "cpu":
        return share
    # The best size in experiments/step_cost.py; the activations of a whole batch would leave the cache.
    fitting = max(CPU_BLOCK_SAMPLES // int(samples_per_ray), 1)
    return max(size for size in range(1, min(share, fitting) + 1) if share % size == 0) if share > 0 else 0


def microbatch_of(train, samples_per_ray):
    """Returns the microbatch size that the devices of a train section are fastest with."""
    devices = devices_of(train.parallel)
    share = train.batch_size // len(devices)
    return default_microbatch(share, samples_per_ray, devices[0].platform)


def split_positions(batch_size, num_devices, microbatch_size):
    """Returns [devices, blocks, rays] int32, every place in the batch once, in order."""
    share, uneven = divmod(batch_size, num_devices)
    microbatch_size = min(microbatch_size, share) or share
    if uneven or share < 1 or share % microbatch_size:
        raise ValueError(
            f"batch_size {batch_size} on {num_devices} device(s) in microbatches of {microbatch_size} rays does not "
            "come out even; change train.batch_size or train.microbatch_size"
        )
    return np.arange(batch_size, dtype=np.int32).reshape(num_devices, share // microbatch_size, microbatch_size)
