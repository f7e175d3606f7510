"""Devices: the same training step under jit on one device, and under sharded jit on several.

With several processes (see `processes.cluster`) the devices are those of all processes. Each process reads all
training views and copies them to each of its devices, because any ray may come from any pixel. The pixel depends
only on the ray's position in the whole batch, so batches are the same on any number of devices. A process draws,
renders and differentiates the rays of its own devices; gradients are summed over all devices. Only the first
process writes config.json and metrics.jsonl and prints; all take part in a checkpoint.
"""

import contextlib
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, SingleDeviceSharding
from jax.sharding import PartitionSpec as P

from jaxnerf.runtime import cores, memory, processes
from jaxnerf.runtime.fingerprint import fingerprint

CPU_MICROBATCH_SAMPLES = 12_288  # the fastest in experiments/speed: activations stay in the cache
_MAX_THREADS = 8  # of a step on a CPU
_IN_ONE_PROGRAM = 2  # parts of the rays: of more, XLA runs few at once
_MAX_SHARED = 4  # a run compiles at most two: of one step, and of several in a dispatch
_shared: dict[Any, Any] | None = None  # compiled steps, by what they were compiled from; None: they are not shared


@contextlib.contextmanager
def shared_steps() -> Iterator[None]:
    """Lets runs that train one after the other share compiled steps.

    Inside, `compile_step` compiles equal programs once. Runs have equal programs if they differ in what is data only:
    the seed, images and cameras of the same shapes, the number of steps.
    """
    global _shared
    _shared = {}
    try:
        yield
    finally:
        _shared = None


def compile_step(
    train_step: Callable[..., tuple],
    state: Any,
    data: Any,
    *,
    batch_size: int,
    microbatch_size: int | None = None,
    devices: Sequence[jax.Device] | None = None,
    num_threads: int = 1,
) -> tuple[Callable[..., tuple], Any, Any]:
    """Compiles a training step for the devices, and places its state and data there.

    Args:
        train_step: see `make_train_step`.
        state: TrainState, or a function that makes one, see `unoptimized`. It runs while the step compiles; on a CPU
            afterwards, so that less memory is needed at once. With several processes the state of the first one is
            used.
        data: what the step draws from; copied to every device. The same in all processes.
        batch_size: rays per step, over all devices of all processes.
        microbatch_size: rays whose gradient is computed at once; None, or more than a device has: all of them.
        devices: of all processes; None: all. On several the step is jitted over a mesh of them.
        num_threads: that compute the gradient of an equal part of the rays each, on one device, see `threads_of_step`:
            two in one program, more by threads of the host. For more than one the step must be a `TrainStep`.

    Returns:
        step, state, data: step(state, data) -> (state, metrics) consumes its state; step.compiled is what JAX
        compiled, with its memory_analysis() and as_text().

    Raises:
        ValueError: if the batch does not split evenly, or the processes' data differ.
        memory.OutOfMemory: if the step needs more memory than is free.
    """
    devices = jax.devices() if devices is None else devices
    if num_threads > 1:  # a part of the rays may be no multiple of a microbatch
        microbatch_size = math.gcd(microbatch_size or batch_size, batch_size // num_threads)
    positions = split_positions(batch_size, max(len(devices), num_threads), microbatch_size)
    mesh = Mesh(np.array(devices), ("batch",))
    single = len(devices) == 1
    everywhere = SingleDeviceSharding(devices[0]) if single else NamedSharding(mesh, P())
    if single:
        positions = place(positions if num_threads > 1 else positions[0], everywhere)
        jitted = jax.jit(train_step, donate_argnums=0)
    else:
        jitted, positions = _sharded(train_step, mesh), place(positions, NamedSharding(mesh, P("batch")))
    make = state if callable(state) else lambda: state
    shapes = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=everywhere), jax.eval_shape(make)
    )
    processes.check_same("data or configuration", data)
    data = place(data, everywhere)
    create = unoptimized(state, devices[0]) if callable(state) else make
    with ThreadPoolExecutor(1) as pool:
        made = None if devices[0].platform == "cpu" else pool.submit(create)
        if num_threads > _IN_ONE_PROGRAM:
            positions = list(positions)
            compiled = _compile_on_threads(train_step, shapes, data, positions, devices)
        else:
            compiled = _compiled(jitted.lower(shapes, data, positions), devices)
        memory.check(compiled)
        memory.release()
        state = place(processes.broadcast(made.result() if made else create()), everywhere)
    memory.release()

    def step(state, data):
        return compiled(state, data, positions)

    step.compiled = compiled
    return step, state, data


def _compiled(lowered, devices):
    """Returns a lowered step compiled, or the one that has been compiled from the same program for the same devices."""
    if _shared is None:
        return lowered.compile()
    key = fingerprint(lowered.as_text()), lowered.in_tree, lowered.out_tree, tuple(devices)
    if key not in _shared:
        if len(_shared) == _MAX_SHARED:
            _shared.clear()
        _shared[key] = lowered.compile()
    return _shared[key]


class _StepOnThreads(NamedTuple):
    """A compiled step of which each thread computes the gradient of a part of the rays.

    On a CPU a program keeps several cores busy in a part of its operations only, and programs that one thread starts
    run one after the other.
    """

    gradient: Any
    finish: Any
    pool: ThreadPoolExecutor
    num_threads: int

    def __call__(self, state, data, positions):
        totals = self.pool.map(lambda part: self.gradient(state, data, part), positions)
        return self.finish(state, data, *totals)

    def memory_analysis(self):
        programs = [each.memory_analysis() for each in [self.finish] + [self.gradient] * self.num_threads]
        names = ("temp_size_in_bytes", "output_size_in_bytes", "alias_size_in_bytes")
        return SimpleNamespace(**{name: sum(getattr(each, name) for each in programs) for name in names})


def _compile_on_threads(train_step, state, data, positions, devices):
    """Returns the _StepOnThreads of a TrainStep, with one thread for each of the positions [N, B]."""
    gradient, count = jax.jit(train_step.gradient).lower(state, data, positions[0]), len(positions)
    finish = jax.jit(train_step.finish, donate_argnums=0).lower(state, data, *[gradient.out_info] * count)
    with ThreadPoolExecutor(2) as pool:
        compiled = pool.map(lambda lowered: _compiled(lowered, devices), (gradient, finish))
    return _StepOnThreads(*compiled, ThreadPoolExecutor(count), count)


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


def unoptimized(function, device):
    """Jits a function without arguments that runs once: optimizing its code takes longer than running it.

    Arrays that a jax.tree_util.Partial binds are arguments of the program. Those that a function refers to would be
    constants, of which the compiler makes many copies.
    """
    options = {"xla_backend_optimization_level": 0} if device.platform == "cpu" else None
    bound = function if isinstance(function, jax.tree_util.Partial) else jax.tree_util.Partial(function)
    return functools.partial(jax.jit(lambda bound: bound(), compiler_options=options), bound)


def place(tree: Any, sharding: jax.sharding.Sharding) -> Any:
    """Places arrays on the devices of a sharding; other processes that own some of them have the same tree."""
    if sharding.is_fully_addressable:
        return jax.device_put(tree, sharding)

    def put(leaf):
        whole = np.asarray(leaf)
        return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])

    return jax.tree.map(put, tree)


def default_microbatch(rays: int, samples_per_ray: float, platform: str) -> int:
    """Returns the microbatch size that is fastest on a device.

    Args:
        rays: of a step on this device.
        samples_per_ray: of the largest network.
        platform: of the device.
    """
    if platform != "cpu":
        return rays
    fitting = max(CPU_MICROBATCH_SAMPLES // max(int(samples_per_ray), 1), 1)
    return _largest_divisor(rays, fitting) if rays > 0 else 0


def threads_of_step(num_pixels: int) -> int:
    """Returns how many threads compute the gradient of a step: on a single CPU, one for each core that may be used.

    At most _MAX_THREADS, as each adds a gradient of the whole table, and so many that the step's pixels split evenly.
    """
    return 1 if jax.device_count() > 1 else _largest_divisor(num_pixels, min(cores.num_at_once(), _MAX_THREADS))


def _largest_divisor(number, most):
    return max(part for part in range(1, min(number, most) + 1) if number % part == 0)


def split_positions(batch_size: int, num_devices: int, microbatch_size: int | None = None) -> np.ndarray:
    """Returns [devices, microbatches, rays] int32, every position in the batch once, in order.

    Raises:
        ValueError: if the batch does not split evenly.
    """
    rays, uneven = divmod(batch_size, num_devices)
    size = rays if microbatch_size is None else min(microbatch_size, rays)
    if uneven or size < 1 or rays % size:
        raise ValueError(
            f"train.batch_size {batch_size} does not split evenly over {num_devices} device(s) in microbatches of "
            f"{size} rays; change train.batch_size or train.microbatch_size"
        )
    return np.arange(batch_size, dtype=np.int32).reshape(num_devices, rays // size, size)
