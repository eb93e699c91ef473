"""What one scan costs in the networks of FSVD, FPVD, FRID and FLD: time by part, and memory."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from statistics import median
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from r3dpa.bench.point_network import now
from r3dpa.metrics.protocol import PUBLISHED
from r3dpa.metrics.scene import EvaluationScene, through_sensor
from r3dpa.metrics.scene_features import (
    SceneFeatures,
    lip_loc_space,
    range_vit_space,
    voxel_space,
)
from r3dpa.nn.backbones.liploc import LIPLoc
from r3dpa.nn.backbones.minkowski import MinkowskiNet
from r3dpa.nn.backbones.rangevit import RangeViT
from r3dpa.nn.backbones.spvcnn import SPVCNN

__all__ = ["NETWORKS", "MetricNetworkCost", "Part", "metric_network_cost"]

#: Networks by name, full size; random weights cost as much as trained ones.
NETWORKS: dict[str, Callable[[], nn.Module]] = {
    "MinkowskiNet": MinkowskiNet,
    "SPVCNN": SPVCNN,
    "RangeViT": RangeViT,
    "LIP-Loc": LIPLoc,
}
_SMALL: dict[str, Callable[[], nn.Module]] = {
    "MinkowskiNet": lambda: MinkowskiNet((4,) * 9),
    "SPVCNN": lambda: SPVCNN((4,) * 9),
    "RangeViT": lambda: RangeViT(
        width=16, depth=1, num_heads=2, stem_channels=4, skip_channels=4, decoder_channels=4
    ),
    "LIP-Loc": lambda: LIPLoc(width=16, depth=1, num_heads=2),
}
# Parts by the name of the operation.
_PARTS = {
    **dict.fromkeys(("mm", "addmm", "matmul", "linear", "bmm"), "matmul"),
    **dict.fromkeys(("convolution", "conv2d", "mkldnn_convolution"), "convolution"),
    **{"index_select": "gather", "index_add_": "index_add"},
    **{"_native_batch_norm_legit_no_training": "norm", "native_batch_norm": "norm"},
    **{"batch_norm": "norm", "layer_norm": "norm", "native_layer_norm": "norm"},
    "embedding_bag": "interpolation",
    **dict.fromkeys(("gelu", "relu", "relu_", "leaky_relu"), "activation"),
    **{"_scaled_dot_product_flash_attention_for_cpu": "attention"},
    **{"_scaled_dot_product_attention_math": "attention"},
    "scaled_dot_product_attention": "attention",
}
_REST = "rest"


@dataclass(frozen=True)
class Part:
    """Time of one kind of operation in one pass.

    Args:
        seconds: Wall time.
        core_seconds: Processor time of all threads.
        calls: Operations.
    """

    seconds: float
    core_seconds: float
    calls: int


@dataclass(frozen=True)
class MetricNetworkCost:
    """What one scan costs from its points or range image to the feature.

    Args:
        dim: Numbers of the feature.
        parameters: Weights of the network.
        rounds: Passes after the first.
        seconds: Median wall time of them; with the smallest and the largest.
        core_seconds: Median processor time of all threads.
        first_seconds: Wall time of the first pass.
        peak_host_bytes: Largest resident memory of the process up to the end of the passes.
        before_host_bytes: The same before the first one: Python, libraries and weights.
        parts: Of one more pass, each operation timed: ``map`` is all work on indices, ``rest`` all
            other operations and the interpreter.
    """

    dim: int
    parameters: int
    rounds: int
    seconds: tuple[float, float, float]
    core_seconds: float
    first_seconds: float
    peak_host_bytes: int
    before_host_bytes: int
    parts: dict[str, Part]


def metric_network_cost(name: str, points: Tensor, rounds: int, small: bool) -> MetricNetworkCost:
    """Pass one scan through a network of :data:`NETWORKS`, in a process of its own.

    Args:
        name: Key of :data:`NETWORKS`.
        points: ``(P, 3)`` x, y, z in metres, or more columns, which do not count.
        rounds: Passes after the first.
        small: Take a tiny network in its place, only to try it.
    """
    # spawn: a forked process would share memory with this one.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        job = pool.submit(_measure, name, points.numpy(), rounds, small, torch.get_num_threads())
        return job.result()


class OperationClock(TorchDispatchMode):
    """Adds up the time of all operations by part while it is entered."""

    def __init__(self) -> None:
        super().__init__()
        self.parts: dict[str, Part] = defaultdict(lambda: Part(0.0, 0.0, 0))

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        """Runs an operation."""
        wall, core = now()
        result = func(*args, **(kwargs or {}))
        end_wall, end_core = now()
        part = _part(func.overloadpacket.__name__, result)
        last = self.parts[part]
        self.parts[part] = Part(
            last.seconds + end_wall - wall, last.core_seconds + end_core - core, last.calls + 1
        )
        return result


def _part(name: str, result: Any) -> str:
    """Part of an operation by its name; what yields indices belongs to the map."""
    first = result[0] if isinstance(result, tuple | list) and result else result
    if isinstance(first, Tensor) and not first.is_floating_point():
        return "map"
    return _PARTS.get(name, _REST)


@torch.inference_mode()
def _measure(name: str, values: Any, rounds: int, small: bool, threads: int) -> MetricNetworkCost:
    """Measures one network in this process."""
    from r3dpa.bench.training import _peak_host_bytes

    torch.set_num_threads(threads)
    torch.manual_seed(0)
    scene = through_sensor(
        EvaluationScene("scan", torch.from_numpy(values)[:, :3].float()), PUBLISHED
    )
    network = (_SMALL if small else NETWORKS)[name]().eval()
    space = _space(network)
    before = _peak_host_bytes()
    first, *passes = [_pass(space, scene) for _ in range(1 + rounds)]
    peak = _peak_host_bytes()
    clock = OperationClock()
    start, core_start = now()
    with clock:
        space.extract([scene])
    end, core_end = now()
    walls = [wall for wall, _ in passes]
    return MetricNetworkCost(
        space.dim,
        sum(weight.numel() for weight in network.parameters()),
        rounds,
        (median(walls), min(walls), max(walls)),
        median(core for _, core in passes),
        first[0],
        peak,
        before,
        _whole(clock.parts, end - start, core_end - core_start),
    )


def _whole(parts: Mapping[str, Part], wall: float, core: float) -> dict[str, Part]:
    """The parts, longest first; what they lack of the whole pass goes to the rest."""
    found = dict(parts)
    rest = found.setdefault(_REST, Part(0.0, 0.0, 0))
    missing = [
        total - sum(getattr(part, key) for part in found.values())
        for key, total in (("seconds", wall), ("core_seconds", core))
    ]
    found[_REST] = replace(
        rest, seconds=rest.seconds + missing[0], core_seconds=rest.core_seconds + missing[1]
    )
    return dict(sorted(found.items(), key=lambda item: -item[1].core_seconds))


def _space(network: nn.Module) -> SceneFeatures:
    if isinstance(network, RangeViT):
        return range_vit_space(network)
    if isinstance(network, LIPLoc):
        return lip_loc_space(network, PUBLISHED)
    assert isinstance(network, MinkowskiNet)
    return voxel_space(network, PUBLISHED)


def _pass(space: SceneFeatures, scene: EvaluationScene) -> tuple[float, float]:
    """Wall and core seconds of one pass."""
    start, core_start = now()
    space([scene])
    end, core_end = now()
    return end - start, core_end - core_start
