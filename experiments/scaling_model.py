"""What data-parallel training should take on many devices, on paper; and what its compiled step sends."""

import math
import re
from typing import NamedTuple

_BYTES = {"pred": 1, "bf16": 2, "f16": 2, "f32": 4, "s32": 4, "u32": 4, "f64": 8, "s64": 8, "u64": 8}
_SCALARS = 4  # loss, two errors and the rays that counted, which are summed with the gradient


class Machine(NamedTuple):
    """Devices and their links. Peaks and bandwidths are the makers'; share and latency are assumed."""

    name: str
    peak: float  # FLOP/s of a device, of the matrix unit's float32 mode
    share: float  # of the peak that a step reaches
    group: int  # devices that the fast link joins
    fast: float  # bytes/s, each way, of a device's fast link
    slow: float  # bytes/s, each way, of a device's share of the link between groups
    latency: float  # s of one message
    source: str


MACHINES = (
    Machine(
        name="A100 (NVLink, HDR)",
        peak=156e12,
        share=0.3,
        group=8,
        fast=300e9,
        slow=25e9,
        latency=5e-6,
        source="NVIDIA's data sheets: TF32 156 TFLOP/s, NVLink 600 GB/s both ways; HDR 200 Gb/s a GPU",
    ),
    Machine(
        name="H100 (NVLink, NDR)",
        peak=494.7e12,
        share=0.3,
        group=8,
        fast=450e9,
        slow=50e9,
        latency=5e-6,
        source="NVIDIA's data sheets: TF32 494.7 TFLOP/s without sparsity, NVLink 900 GB/s both ways; NDR "
        "400 Gb/s a GPU",
    ),
    Machine(
        name="TPU v3 core",
        peak=61.5e12,
        share=0.3,
        group=2048,
        fast=166e9,
        slow=166e9,
        latency=2e-6,
        source="Google's page of TPU v3: 123 TFLOP/s (bf16) a chip of 2 cores; all-reduce bandwidth 340 TB/s "
        "a pod of 1024 chips",
    ),
)


def step_flops(parameters, evaluations, rays):
    """Returns the FLOP of a step: two a parameter and evaluation forward, twice that backward.

    At most: a bottleneck, which the network multiplies with the next layer once for all samples, counts, too.

    Args:
        parameters: of each network.
        evaluations: a ray, of each network.
        rays: of the step.
    """
    return 6 * rays * sum(size * count for size, count in zip(parameters, evaluations, strict=True))


def all_reduce_seconds(machine, devices, size):
    """Returns the time of summing bytes over all devices: rings in each group, then between groups."""
    inside = min(devices, machine.group)
    groups = math.ceil(devices / inside)
    seconds = 2 * (inside - 1) / inside * size / machine.fast + 2 * (inside - 1) * machine.latency
    # Each device of a group carries its part of the sum to the other groups.
    return seconds + 2 * (groups - 1) / groups * size / inside / machine.slow + 2 * (groups - 1) * machine.latency


def predict(machine, devices, *, flops, size, grow=False):
    """Returns compute, sum and efficiency of a step; nothing is taken to overlap.

    Args:
        machine: Machine.
        devices: how many.
        flops: of the step, over all devices; with grow, of each.
        size: bytes of the gradient.
        grow: whether the batch grows with the devices (weak scaling).

    Returns:
        Seconds of arithmetic, seconds of the sum, and the rate a device, over that of one device alone.
    """
    alone = flops / (machine.peak * machine.share)
    compute = alone if grow else alone / devices
    summing = all_reduce_seconds(machine, devices, size)
    return compute, summing, compute / (compute + summing)


def gradient_bytes(parameters, value_bytes=4):
    """Returns what a step sums over the devices: a value a parameter, and the step's sums."""
    return value_bytes * (parameters + _SCALARS)


def collective_bytes(text):
    """Returns the bytes that the all-reduces of a compiled program give, by its text, and their number."""
    total = count = 0
    for line in text.splitlines():
        found = re.search(r"= (.*?) all-reduce(-start)?\(", line)
        if found:
            count += 1
            total += sum(_array_bytes(*shape) for shape in re.findall(r"(\w+)\[([\d,]*)\]", found[1]))
    return total, count


def _array_bytes(dtype, shape):
    return _BYTES[dtype] * math.prod(int(side) for side in shape.split(",") if side)
