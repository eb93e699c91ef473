"""What one scan costs in a WaffleIron: time by part, memory, and how near to the machine's limits.

Core seconds are processor time, of all threads together: what else runs on the machine prolongs
them far less than wall time, so that rates and floors are told in them.
Letters: N points that the network sees, K neighbours, F width of the tokens.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import torch
from torch import Tensor, nn

from r3dpa.nn.backbones import ScaLR, WaffleIron
from r3dpa.nn.backbones.sources import feature_source
from r3dpa.nn.backbones.voxels import NUM_FEATURES
from r3dpa.nn.backbones.waffleiron import ChannelMixing, Embedding, SpatialMixing

__all__ = ["NETWORKS", "NetworkCost", "PartCost", "network_cost"]

#: Extractors by name; random weights cost as much as trained ones.
NETWORKS: dict[str, Callable[[], nn.Module]] = {
    "waffleiron-s": lambda: feature_source("waffleiron-s"),
    "wi48-768": lambda: ScaLR(WaffleIron()),
    "wi3-24": lambda: ScaLR(WaffleIron(24, 3)),
}

_FLOAT_BYTES = 4
_RATE_REPEATS = 5
_RATE_FLOATS = 2**26
_SEEN = (Embedding, SpatialMixing, ChannelMixing)


@dataclass(frozen=True)
class PartCost:
    """What one part of the pass took, and the least it could take.

    Args:
        seconds: Wall time.
        core_seconds: Processor time.
        flop: Floating-point operations of matrix products and convolutions, 2 per multiply-add.
        num_bytes: Memory traffic if every operation reads its inputs and writes its results once.
        floor_core_seconds: The larger of ``flop`` at the rate of a matrix product of the network's
            own size, and of ``num_bytes`` at the rate of reading memory.
    """

    seconds: float
    core_seconds: float
    flop: float
    num_bytes: float
    floor_core_seconds: float


@dataclass(frozen=True)
class NetworkCost:
    """What one scan costs in one network.

    Args:
        points: Points of the scan, and points that the network sees.
        seconds: Wall time of the whole, from points to the features of all of them.
        core_seconds: Processor time of it.
        peak_host_bytes: Largest resident memory of the process up to its end.
        gflop_s: Rate of the matrix product of one channel mixing per core second, measured after
            the pass.
        read_gb_s: Rate of reading memory per core second, the same.
        parts: In their order; ``planes`` is counting the points of each cell.
    """

    points: tuple[int, int]
    seconds: float
    core_seconds: float
    peak_host_bytes: int
    gflop_s: float
    read_gb_s: float
    parts: dict[str, PartCost]


def network_cost(name: str, points: Tensor) -> NetworkCost:
    """Pass one scan through a network of :data:`NETWORKS` once, in a process of its own.

    Args:
        name: Key of :data:`NETWORKS`.
        points: ``(P, 4)`` x, y, z in metres, intensity 0..1.
    """
    # spawn: a forked process would share memory with this one.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_measure, name, points.numpy(), torch.get_num_threads()).result()


class _PartClock:
    """Gives all wall and core seconds since it was made to parts, each up to a mark."""

    def __init__(self) -> None:
        self.seconds: dict[str, tuple[float, float]] = {}
        self._last = now()

    def mark(self, part: str) -> None:
        """The time since the last mark belongs to ``part``."""
        wall, core = now()
        before, (last_wall, last_core) = self.seconds.get(part, (0.0, 0.0)), self._last
        self.seconds[part] = before[0] + wall - last_wall, before[1] + core - last_core
        self._last = wall, core

    def watch(self, network: nn.Module) -> None:
        """Mark when the layers of a network begin and end."""
        before = {Embedding: "collation", SpatialMixing: "planes", ChannelMixing: "planes"}
        after = {
            Embedding: "embedding",
            SpatialMixing: "spatial mixing",
            ChannelMixing: "channel mixing",
        }
        for layer in network.modules():
            if isinstance(layer, _SEEN):
                kind = type(layer)
                layer.register_forward_pre_hook(lambda *_, part=before[kind]: self.mark(part))
                layer.register_forward_hook(lambda *_, part=after[kind]: self.mark(part))


@torch.inference_mode()
def _measure(name: str, values: Any, threads: int) -> NetworkCost:
    """Measures one network in this process."""
    from r3dpa.bench.training import _peak_host_bytes

    torch.set_num_threads(threads)
    torch.manual_seed(0)
    points = torch.from_numpy(values)
    extractor: Any = NETWORKS[name]()
    network = next(part for part in extractor.modules() if isinstance(part, WaffleIron))
    start, core_start = now()
    clock = _PartClock()
    clock.watch(extractor)
    prepared = extractor.prepare(points)
    clock.mark("preparation")
    (features,) = extractor.point_features([prepared])
    clock.mark("upsampling")
    end, core_end = now()
    peak = _peak_host_bytes()

    num_points, num_neighbors = prepared.neighbors.shape
    needed = _needed(network, num_points, num_neighbors)
    needed["upsampling"] = (0, features.nbytes + num_points * network.width * _FLOAT_BYTES)
    del features
    flop_s, bytes_s = _product_rate(num_points, network.width), _read_rate()
    parts = {}
    for part, taken in clock.seconds.items():
        flop, num_bytes = needed.get(part, (0, 0))
        parts[part] = PartCost(*taken, flop, num_bytes, max(flop / flop_s, num_bytes / bytes_s))
    seen = (len(points), num_points)
    spent = (end - start, core_end - core_start)
    return NetworkCost(seen, *spent, peak, flop_s / 1e9, bytes_s / 1e9, parts)


def now() -> tuple[float, float]:
    """Wall seconds, and seconds of all cores together."""
    return time.perf_counter(), time.process_time()


def _needed(
    network: WaffleIron, num_points: int, num_neighbors: int
) -> dict[str, tuple[float, float]]:
    """FLOP and bytes of each part of a WaffleIron, see :class:`PartCost`."""
    width, depth, tokens = network.width, network.depth, num_points * network.width
    sizes = [rows * columns for rows, columns in network.plane_sizes]
    cells = sum(sizes[layer % len(sizes)] for layer in range(depth)) * width
    pairs = num_points * num_neighbors
    return {
        # A pair: 5 -> F -> F; a point: 5 -> F, then 2 F -> F.
        "embedding": (
            2 * pairs * (NUM_FEATURES * width + width**2)
            + 2 * num_points * (NUM_FEATURES * width + 2 * width**2),
            _FLOAT_BYTES * (4 * pairs * width + 5 * tokens),
        ),
        # Two 3 x 3 depthwise convolutions; tokens are read twice and written once, the image is
        # written and read by the mean, each convolution and the way back.
        "spatial mixing": (2 * 2 * 9 * cells, _FLOAT_BYTES * (3 * depth * tokens + 6 * cells)),
        "channel mixing": (
            4 * depth * tokens * width,
            _FLOAT_BYTES * depth * (6 * tokens + 2 * width**2),
        ),
    }


def _product_rate(num_points: int, width: int) -> float:
    """FLOP per core second of the linear layer of a channel mixing, the best of some runs."""
    tokens, layer = torch.randn(num_points, width), nn.Linear(width, width)
    return 2 * num_points * width**2 / _best(lambda: layer(tokens))


def _read_rate() -> float:
    """Bytes per core second of a sum over memory larger than any cache."""
    values = torch.ones(_RATE_FLOATS)
    return values.nbytes / _best(values.sum)


def _best(function: Callable[[], object]) -> float:
    """Fewest core seconds of some runs."""
    times = []
    for _ in range(_RATE_REPEATS):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)
