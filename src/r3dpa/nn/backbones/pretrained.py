"""The project's own teacher, whose weights come with the package."""

from __future__ import annotations

import json
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any, Self

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from r3dpa.io import UNPICKLING_ERRORS, atomic_path, first_line
from r3dpa.nn.backbones.kernel import random_basis
from r3dpa.nn.backbones.tokens import TokenFeatures, sha256
from r3dpa.nn.backbones.voxels import PointCloudBatch, ScanGrid
from r3dpa.nn.backbones.waffleiron import WaffleIron

_SHIPPED = Path(str(files("r3dpa.nn.backbones"))) / "waffleiron_s.safetensors"
NORM_EPS = nn.BatchNorm1d(1).eps
_ABOUT = "waffleiron"  # key of the file's metadata: sizes of the network, grid


class WaffleIronS(TokenFeatures):
    """``waffleiron-s``: a small WaffleIron trained on simulated scans without labels.

    Tokens are standardised with the mean and deviation of their training; a fixed matrix with
    orthonormal columns lifts them to ``dim``, which keeps every angle. How it was trained, and what
    it can tell apart: ``README.md`` beside the weights; by ``r3dpa.modules.PointPretraining``.

    Args:
        weights: File written by that training; the one that comes with the package where None.
        dim: Width D of the features, at least that of the tokens (128 for those shipped).
        workers: Threads of the neighbour search, -1 for all cores.

    Raises:
        ValueError: If the file is missing, damaged or of something else, or ``dim`` too small.
    """

    mean: Tensor
    deviation: Tensor
    basis: Tensor

    name = "waffleiron-s"

    def __init__(self, weights: Path | None = None, dim: int = 768, workers: int = 1) -> None:
        state, network, grid = _read(Path(weights) if weights else _SHIPPED)
        super().__init__(network, grid, workers)
        if dim < network.width:
            raise ValueError(f"dim must be at least {network.width}, got {dim}.")
        self.dim = dim
        self.register_buffer("mean", state["norm.running_mean"])
        self.register_buffer("deviation", (state["norm.running_var"] + NORM_EPS).sqrt())
        basis = random_basis(dim, network.width, torch.Generator().manual_seed(0))
        self.register_buffer("basis", basis)
        self.settings = {"weights": sha256(self), "version": 1}

    @classmethod
    def untrained(cls, seed: int = 0, dim: int = 768) -> Self:
        """The same extractor with random weights, to compare with; its name is ``random``."""
        extractor = cls(dim=dim)
        network = extractor.network
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            fresh = WaffleIron(network.width, network.depth, network.cells)
        network.load_state_dict(fresh.state_dict())
        extractor.mean.zero_()
        extractor.deviation.fill_(1.0)
        extractor.name = "random"
        extractor.settings["weights"] = sha256(extractor)
        return extractor

    def tokens(self, batch: PointCloudBatch) -> Tensor:
        """Standardised tokens ``(N, F)`` float32."""
        return (super().tokens(batch) - self.mean) / self.deviation

    def forward(self, points: Tensor) -> Tensor:
        """Features ``(P, dim)`` of unit norm of the points ``(P, 4)``."""
        return self.lift(super().forward(points))

    def lift(self, values: Tensor) -> Tensor:
        """Linear, angle-preserving map ``(N, F)`` to ``(N, dim)``."""
        return values @ self.basis.T


def save_weights(path: Path, network: WaffleIron, norm: nn.BatchNorm1d, grid: ScanGrid) -> None:
    """Write the file that :class:`WaffleIronS` reads.

    Args:
        path: File to write, replaced only when it is complete.
        network: Trained network.
        norm: Statistics of its tokens.
        grid: How scans are prepared.
    """
    state = {f"network.{key}": value for key, value in network.state_dict().items()}
    state |= {f"norm.{key}": value for key, value in norm.state_dict().items()}
    state = {key: value.detach().cpu().contiguous() for key, value in state.items()}
    about = {"width": network.width, "depth": network.depth, "grid": asdict(grid)}
    with atomic_path(path) as temporary:
        save_file(state, temporary, metadata={_ABOUT: json.dumps(about)})


def _read(path: Path) -> tuple[dict[str, Tensor], WaffleIron, ScanGrid]:
    """State, loaded network and grid of a file of weights."""
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads(file.metadata()[_ABOUT])
            state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - no dict
        grid = ScanGrid(**{key: _tuple(value) for key, value in about["grid"].items()})
        network = WaffleIron(about["width"], about["depth"], grid.cells)
        prefix = "network."
        network.load_state_dict(
            {key.removeprefix(prefix): state[key] for key in state if key.startswith(prefix)}
        )
    except (*UNPICKLING_ERRORS, SafetensorError) as error:
        raise ValueError(
            f"{path} holds no weights of waffleiron-s ({first_line(error)}): give the "
            "waffleiron_s.safetensors that a training with PointPretraining wrote, or leave "
            "weights out for those of the package."
        ) from error
    return state, network, grid


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
