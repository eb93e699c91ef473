"""What a device can do at most, and how much work a function is: the limits that times meet."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from r3dpa.bench.timing import Spent

__all__ = ["Peak", "control_kernel", "flop_of", "peak_memory", "peak_of", "synchronise"]

Format = Literal["bf16", "tf32", "fp32"]

#: FLOP per second of dense matrix products, by part of the device's name; the SXM variants.
#: Source: data sheets of NVIDIA A100, H100 and H200 (figures "with sparsity" halved).
PEAKS: dict[str, dict[Format, float]] = {
    "H200": {"bf16": 989e12, "tf32": 495e12, "fp32": 67e12},
    "H100": {"bf16": 989e12, "tf32": 495e12, "fp32": 67e12},
    "A100": {"bf16": 312e12, "tf32": 156e12, "fp32": 19.5e12},
}
_PRODUCT_SIZE = 1024  # of the matrices that tell the peak of a device without a row above
_PRODUCT_RUNS = 7
_FACTOR_SIZE, _PRODUCTS = 2048, 50  # of the control of a GPU
_SIGNAL_SIZE = 2**17  # of the control of a CPU


@dataclass(frozen=True)
class Peak:
    """The most a device can compute.

    Args:
        flop_s: FLOP per second, 2 for each multiply-add.
        source: ``data sheet``, or ``measured`` with a matrix product on this machine.
    """

    flop_s: float
    source: Literal["data sheet", "measured"]


def peak_of(device: torch.device, number_format: Format) -> Peak:
    """Peak of a device in a number format, by its name or else by a matrix product.

    Args:
        device: Where it is computed.
        number_format: Of the factors; sums are float32.
    """
    if device.type == "cuda":
        name = torch.cuda.get_device_name(device)
        for part, rates in PEAKS.items():
            if part in name:
                return Peak(rates[number_format], "data sheet")
    dtype = torch.bfloat16 if number_format == "bf16" else torch.float32
    size = _PRODUCT_SIZE * (8 if device.type == "cuda" else 1)
    factor = torch.randn(size, size, device=device).to(dtype)
    best = min(_taken(lambda: factor @ factor, device) for _ in range(_PRODUCT_RUNS))
    return Peak(2 * size**3 / best, "measured")


def _taken(function: Callable[[], object], device: torch.device) -> float:
    synchronise(device)
    start, core = time.perf_counter(), time.process_time()
    function()
    synchronise(device)
    core_seconds = time.process_time() - core if device.type == "cpu" else None
    spent = time.perf_counter() - start
    return Spent(spent, spent, core_seconds).judged(torch.get_num_threads())


def control_kernel(device: torch.device) -> Callable[[], Spent]:
    """Fixed work of some milliseconds: matrix products on a GPU, Fourier transforms on a CPU."""
    generator = torch.Generator().manual_seed(0)
    if device.type == "cuda":
        factor = torch.randn(_FACTOR_SIZE, _FACTOR_SIZE, generator=generator)
        factor = factor.to(device, torch.bfloat16)
    signal = torch.randn(4, _SIGNAL_SIZE, generator=generator)

    def run() -> Spent:
        synchronise(device)
        start, core = time.perf_counter(), time.process_time()
        if device.type == "cuda":
            for _ in range(_PRODUCTS):
                torch.mm(factor, factor)
        else:
            torch.fft.rfft(signal)
        synchronise(device)
        wall, core = time.perf_counter() - start, time.process_time() - core
        return Spent(wall, wall, None if device.type == "cuda" else core)

    return run


def flop_of(function: Callable[[], object]) -> int:
    """FLOP of the matrix products, convolutions and attention of one call.

    Attention is computed as matrix products meanwhile, since the counter does not know the fused
    kernels of every device. Compiled code is not seen: give the function as it is written.
    """
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        function()
    return counter.get_total_flops()


def peak_memory(function: Callable[[], object], device: torch.device) -> int | None:
    """Largest memory of tensors on a GPU during a call, bytes; None on a CPU."""
    if device.type != "cuda":
        return None
    torch.cuda.reset_peak_memory_stats(device)
    function()
    synchronise(device)
    return torch.cuda.max_memory_allocated(device)


def synchronise(device: torch.device) -> None:
    """Wait until a GPU has done all work; nothing on a CPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
