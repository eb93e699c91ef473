"""Frozen point features: tokens of a WaffleIron (ScaLR, ``waffleiron-s``), and sources by name."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from r3dpa.feature_names import OWN_WEIGHTS, SOURCES
from r3dpa.features.geometric import GeometricFeatures, random_basis
from r3dpa.features.official import (
    FrozenNetwork,
    key_renamer,
    load_strictly,
    naming,
    read_released,
)
from r3dpa.features.voxels import (
    PointCloudBatch,
    PreparedScan,
    ScanGrid,
    collate_scans,
    prepare_scan,
)
from r3dpa.features.waffleiron import WaffleIron
from r3dpa.geometry import UNKNOWN_CLASS
from r3dpa.io import UNPICKLING_ERRORS, atomic_path, first_line, weights_sha256

_RELEASED = "ckpt_last.pth of WI_768-DINOv2_ViT_L_14-NS_KI_PD"
# Entries with the weights in files of the distillation script and of its successor.
_MODEL_KEYS = ("model_points", "model_point")
# Beginning of our names -> of the official ones; {} is the layer.
_OFFICIAL_NAMES = {
    r"embedding\.norm": "embed.norm",
    r"embedding\.point": "embed.conv1",
    r"embedding\.offset\.(\d)": "embed.conv2.{}",
    r"embedding\.neighbor": "embed.conv2.4",
    r"embedding\.merge": "embed.final",
    r"spatial\.(\d+)\.norm": "waffleiron.spatial_mix.{}.norm",
    r"spatial\.(\d+)\.convs": "waffleiron.spatial_mix.{}.ffn",
    r"spatial\.(\d+)\.scale": "waffleiron.spatial_mix.{}.scale.weight",
    r"channel\.(\d+)\.norm": "waffleiron.channel_mix.{}.norm",
    r"channel\.(\d+)\.mlp": "waffleiron.channel_mix.{}.mlp",
    r"channel\.(\d+)\.scale": "waffleiron.channel_mix.{}.scale.weight",
    r"head": "classif",
}
_CPU_POINTS = 16384  # in one pass
_FOLDER = Path(str(files("r3dpa.features")))
_ABOUT = "waffleiron"  # metadata key of that file: sizes of the network, grid
_CLASSES = "classes."  # in front of the weights of a layer that gives logits of classes


class TokenFeatures(FrozenNetwork):
    """Frozen feature extractor: tokens of a WaffleIron on the points of a scan, of unit norm.

    A point has the token of the nearest point that the network saw, so points beyond the field of
    view have features too. Always in evaluation mode. Computes in float32; the official code of
    ScaLR runs under ``torch.autocast``.

    Args:
        network: Trained network; its head is removed.
        grid: Preparation of scans, as in its training. Default: as in the release of ScaLR.
    """

    name: str

    def __init__(self, network: WaffleIron, grid: ScanGrid | None = None) -> None:
        super().__init__()
        grid = grid or ScanGrid()
        if network.cells != grid.cells:
            raise ValueError(
                f"network has cells {network.cells}, but grid has {grid.cells}; give both the same"
            )
        network.head = nn.Identity()
        self.network = network.requires_grad_(False)
        self.grid = grid
        self.prepare = partial(prepare_scan, grid=grid)
        self.dim = network.width
        self.settings: dict[str, Any] = {"weights": sha256(network), "version": 1}
        self.eval()

    def forward(self, points: Tensor) -> Tensor:
        """Features ``(P, dim)`` of unit norm of points ``(P, 4)``, finite."""
        return self.point_features([self.prepare(points)])[0]

    def point_features(self, prepared: Sequence[PreparedScan]) -> list[Tensor]:
        """Features ``(P_i, F)`` of unit norm of prepared scans.

        They are on the device of the network; zeros where no point of a scan lies in the field of
        view. A GPU computes all scans in one pass, a CPU as many as its caches hold: the tokens of
        eight scans at once take twice as long.
        """
        device = self.network.embedding.merge.weight.device
        counts = [len(scan.features) for scan in prepared]
        if device.type == "cpu" and len(prepared) > 1 and sum(counts) > _CPU_POINTS:
            half = len(prepared) // 2
            return [*self.point_features(prepared[:half]), *self.point_features(prepared[half:])]
        tokens = torch.zeros(0, self.network.width, device=device)
        if any(counts):
            tokens = F.normalize(self.tokens(collate_scans(prepared).to(device)), dim=1)
        return [
            features[scan.upsample.to(device)]
            if len(features)
            else features.new_zeros(len(scan.upsample), self.network.width)
            for scan, features in zip(prepared, tokens.split(counts), strict=True)
        ]

    def tokens(self, batch: PointCloudBatch) -> Tensor:
        """Tokens ``(N, F)`` float32 whose direction is the feature."""
        return self.network(batch).float()


class ScaLR(TokenFeatures):
    """ScaLR: features distilled from images; D is the width of the network.

    Source: Puy et al., "Three Pillars Improving Vision Foundation Model Distillation for Lidar"
    (CVPR 2024); as used by R3DPA.
    """

    name = "scalr"

    @classmethod
    def from_checkpoint(cls, path: str | Path, grid: ScanGrid | None = None) -> ScaLR:
        """Extractor with the weights of ``ckpt_last.pth``, which determine width and depth."""
        grid = grid or ScanGrid()
        with naming(path):
            weights = _scalr_weights(read_released(Path(path), _RELEASED))
            network = _network_like(weights, grid)
            load_strictly(network, weights, official_name)
        return cls(network, grid)


official_name = key_renamer(_OFFICIAL_NAMES)


def _network_like(weights: Mapping[str, Tensor], grid: ScanGrid) -> WaffleIron:
    try:
        head_dim, width = weights["classif.weight"].shape[:2]
    except KeyError as error:
        raise ValueError(
            f"holds no WaffleIron with a head (no {error}); give {_RELEASED}"
        ) from error
    layers = [re.match(r"waffleiron\.\w+\.(\d+)\.", key) for key in weights]
    depth = max((int(layer[1]) + 1 for layer in layers if layer), default=1)
    return WaffleIron(width, depth, grid.cells, head_dim)


def _scalr_weights(content: Any) -> dict[str, Tensor]:
    name = next((key for key in _MODEL_KEYS if isinstance(content, dict) and key in content), None)
    if name is None or not isinstance(content[name], Mapping):
        raise ValueError(f"has neither {' nor '.join(_MODEL_KEYS)}; give {_RELEASED}")
    # "module." comes from DistributedDataParallel.
    return {key.removeprefix("module."): value for key, value in content[name].items()}


class WaffleIronS(TokenFeatures):
    """``waffleiron-s``: a small WaffleIron trained on simulated scans without labels.

    Tokens are standardised with the mean and deviation of their training; a fixed matrix with
    orthonormal columns lifts them to ``dim``, which preserves all angles. Training and evaluation
    are described in ``README.md`` beside the weights; see :class:`r3dpa.modules.PointPretraining`.

    Args:
        weights: File written by this training. Default: the file shipped with the package.
        dim: Width D of the features, at least the tokens' width (128 for the shipped weights).
    """

    mean: Tensor
    deviation: Tensor
    basis: Tensor

    name = "waffleiron-s"
    shipped = _FOLDER / "waffleiron_s.safetensors"

    def __init__(self, weights: Path | None = None, dim: int = 768) -> None:
        state, network, grid = read_weights(Path(weights) if weights else self.shipped)
        super().__init__(network, grid)
        if dim < network.width:
            raise ValueError(f"dim must be at least {network.width}, got {dim}")
        self.dim = dim
        eps = nn.BatchNorm1d(1).eps
        self.register_buffer("mean", state["norm.running_mean"])
        self.register_buffer("deviation", (state["norm.running_var"] + eps).sqrt())
        basis = random_basis(dim, network.width, torch.Generator().manual_seed(0))
        self.register_buffer("basis", basis)
        self.settings = {"weights": sha256(self), "version": 1}
        self.class_head: nn.Linear | None = None  # no part of the features
        if _CLASSES + "weight" in state:
            num_classes = len(state[_CLASSES + "bias"])
            self.class_head = nn.Linear(network.width, num_classes).requires_grad_(False)
            head = {key: state[_CLASSES + key] for key in ("weight", "bias")}
            self.class_head.load_state_dict(head)

    def tokens(self, batch: PointCloudBatch) -> Tensor:
        """Standardised tokens ``(N, F)`` float32."""
        return (super().tokens(batch) - self.mean) / self.deviation

    @torch.no_grad()
    def classes(self, points: Tensor) -> Tensor:
        """Likeliest class ``(P,)`` of points ``(P, 4)``: places in ``geometry.SEMANTIC_CLASSES``.

        Raises:
            ValueError: If the weights hold no classes; ``waffleiron-s`` has none.
        """
        if self.class_head is None:
            raise ValueError(f"these weights of {self.name} know no classes: take waffleiron-s-2")
        prepared = self.prepare(points)
        if not len(prepared.features):
            return torch.full((len(points),), UNKNOWN_CLASS)
        tokens = self.tokens(collate_scans([prepared]).to(self.mean.device))
        return self.class_head(tokens).argmax(dim=1).cpu()[prepared.upsample]

    def forward(self, points: Tensor) -> Tensor:
        """Features ``(P, dim)`` of unit norm of the points ``(P, 4)``."""
        return self.lift(super().forward(points))

    def lift(self, values: Tensor) -> Tensor:
        """Linear, angle-preserving map ``(N, F)`` to ``(N, dim)``."""
        return values @ self.basis.T


class WaffleIronS2(WaffleIronS):
    """``waffleiron-s-2``: a coarser network, trained anew on the classes of simulated points.

    It shares no weights with ``waffleiron-s``, the network behind FWID, so that FWID may judge a
    generator that was aligned with this one. See :class:`r3dpa.modules.PointSegmentation`.
    """

    name = "waffleiron-s-2"
    shipped = _FOLDER / "waffleiron_s_2.safetensors"


class WaffleIronJudge(WaffleIronS):
    """``waffleiron-judge``: the network behind FWID_JUDGE, which teaches no generator.

    Of another shape than ``waffleiron-s``, and trained on other streets.
    """

    name = "waffleiron-judge"
    shipped = _FOLDER / "waffleiron_judge.safetensors"


def save_weights(
    path: Path,
    network: WaffleIron,
    norm: nn.BatchNorm1d,
    grid: ScanGrid,
    half: bool = False,
    class_head: nn.Linear | None = None,
) -> None:
    """Write what :class:`WaffleIronS` reads; ``norm`` has the statistics of the tokens.

    ``half`` stores floating-point values as float16, in half the bytes. ``class_head`` gives logits
    of classes from standardised tokens.
    """
    state = {f"network.{key}": value for key, value in network.state_dict().items()}
    state |= {f"norm.{key}": value for key, value in norm.state_dict().items()}
    if class_head is not None:
        state |= {f"{_CLASSES}{key}": value for key, value in class_head.state_dict().items()}
    if half:
        state = {k: v.half() if v.is_floating_point() else v for k, v in state.items()}
    state = {key: value.detach().cpu().contiguous() for key, value in state.items()}
    about = {"width": network.width, "depth": network.depth, "grid": asdict(grid)}
    with atomic_path(path) as temporary:
        save_file(state, temporary, metadata={_ABOUT: json.dumps(about)})


def read_weights(path: Path) -> tuple[dict[str, Tensor], WaffleIron, ScanGrid]:
    """Content of a file of :func:`save_weights` in float32, its network rebuilt, and its grid."""
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads(file.metadata()[_ABOUT])
            state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - no dict
        state = {k: v.float() if v.is_floating_point() else v for k, v in state.items()}
        lists = about["grid"]
        settings: dict[str, Any] = {
            key: tuple(lists[key]) if isinstance(lists[key], list) else lists[key] for key in lists
        }
        grid = ScanGrid(**settings)
        network = WaffleIron(about["width"], about["depth"], grid.cells)
        keys = [key for key in state if key.startswith("network.")]
        network.load_state_dict({key.removeprefix("network."): state[key] for key in keys})
    except (*UNPICKLING_ERRORS, SafetensorError) as error:
        raise ValueError(
            f"{path} holds no weights of waffleiron-s ({first_line(error)}): give the "
            "waffleiron_s.safetensors that a training with PointPretraining wrote, or leave "
            "weights out to use the file shipped with the package"
        ) from error
    return state, network, grid


def feature_source(name: str, ckpt: str | Path | None = None, dim: int = 768) -> nn.Module:
    """Frozen feature extractor by name, see :class:`r3dpa.data.Extractor`.

    Args:
        name: ``"scalr"``: distilled from images, needs the released checkpoint;
            ``"waffleiron-s"``: trained on simulated scans, ``"waffleiron-s-2"`` on their classes;
            ``"geometric"``: local shape, without training.
        ckpt: Weights of ``"scalr"``, or of a ``"waffleiron-s"`` in place of the shipped ones.
        dim: Width D of the features; for ``"scalr"``, the width of its checkpoint.
    """
    if name not in SOURCES:
        raise ValueError(f"unknown feature source {name!r}; choose from {', '.join(SOURCES)}")
    if name == "scalr":
        if ckpt is None:
            raise ValueError(
                "feature source scalr needs ckpt, the released ckpt_last.pth; without it, choose "
                f"from {', '.join(OWN_WEIGHTS)}"
            )
        scalr = ScaLR.from_checkpoint(ckpt)
        if scalr.dim != dim:
            raise ValueError(f"{ckpt} has features of width {scalr.dim}, but dim is {dim}")
        return scalr
    if name.startswith("waffleiron-s"):
        kind = WaffleIronS2 if name == WaffleIronS2.name else WaffleIronS
        return kind(None if ckpt is None else Path(ckpt), dim=dim)
    if ckpt is not None:
        raise ValueError(f"feature source {name} has no weights: leave ckpt ({ckpt}) out")
    return GeometricFeatures(dim)


def sha256(network: nn.Module) -> str:
    """Hash of all weights and buffers, in the order of the network."""
    return weights_sha256(network.state_dict(), ordered=False)
