"""Training of a point network without labels: masked prediction of quantised geometry."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
import torch.nn.functional as F
from lightning import LightningModule
from torch import Tensor, nn

from r3dpa.data.scans import evenly
from r3dpa.features import PointCloudBatch, ScanGrid, WaffleIron, WaffleIronS, collate_scans
from r3dpa.features.scalr import save_weights
from r3dpa.features.voxels import NUM_TARGETS, MaskedScan, Masking
from r3dpa.modules.settings import OptimizerConfig

_SCANS_TO_QUANTISE = 16
_NUM_BINS = 8  # quantiles of each descriptor


class PointPretraining(LightningModule):
    """WaffleIron trained to predict the geometry of whole scans from parts of them.

    Blocks of rays are hidden; the hidden points are known by their cells alone. From the token of
    every point, hidden or not, a linear layer predicts in which of 8 quantiles each
    descriptor of the point lies, see :meth:`r3dpa.features.Masking.describe`; the loss is the
    mean cross-entropy.

    Source: masked prediction of quantised hand-made features, as in HuBERT (Hsu et al., 2021) and
    BEST-RQ (Chiu et al., 2022) for speech and MaskFeat (Wei et al., 2022) for images.

    Args:
        network: Network to train; its ``cells`` equal the scans' grid.
        lr: Peak learning rate; rises over ``warmup`` steps and falls to 0 as a cosine until
            ``max_steps`` of the trainer.
        weight_decay: Of AdamW, on matrices only.
        warmup: Steps.
    """

    #: Feature source that the weights are for, and whether they are written in half precision.
    source: type[WaffleIronS] = WaffleIronS
    writes_half = False
    geometry_weight = 1.0  #: of the loss of the masked geometry
    edges: Tensor

    def __init__(
        self,
        network: WaffleIron,
        lr: float = 2e-3,
        weight_decay: float = 0.03,
        warmup: int = 100,
    ) -> None:
        super().__init__()
        self.network = network
        self.optimizer_config = OptimizerConfig(
            lr=lr, weight_decay=weight_decay, warmup_steps=warmup, cosine=True
        )
        self.class_head: nn.Linear | None = None  # written with the weights
        self.hidden_token = nn.Parameter(torch.zeros(network.width))
        self.norm = nn.BatchNorm1d(network.width, affine=False)
        self.head = nn.Linear(network.width, NUM_TARGETS * _NUM_BINS)
        self.register_buffer("edges", torch.full((NUM_TARGETS, _NUM_BINS - 1), torch.nan))
        self.grid: ScanGrid | None = None

    def setup(self, stage: str) -> None:
        """Take the preparation of the scans from the data module, and check its cells."""
        masking = getattr(cast(Any, self.trainer).datamodule, "prepare", None)
        if not isinstance(masking, Masking):
            raise ValueError(
                "PointPretraining needs r3dpa.data.PointDataModule with prepare "
                f"r3dpa.features.Masking, got {masking!r}"
            )
        if masking.grid.cells != self.network.cells:
            raise ValueError(
                f"--model.init_args.network has cells {list(self.network.cells)}, but the grid of "
                f"--data.init_args.prepare has {list(masking.grid.cells)}: make them equal"
            )
        if self.geometry_weight and not masking.geometry:
            raise ValueError(
                f"geometry_weight {self.geometry_weight:g} needs the targets that "
                "--data.init_args.prepare leaves out with geometry false: set it to true, or give "
                "PointSegmentation geometry_weight 0"
            )
        self.grid = masking.grid

    def on_train_start(self) -> None:
        """Measure the quantiles of the descriptors in some training scans, unless resumed."""
        if self.geometry_weight and not self.edges.isfinite().all():
            scans = cast(Any, self.trainer).datamodule.train_set
            chosen = evenly(range(len(scans)), _SCANS_TO_QUANTISE)
            values = torch.cat([scans[index].targets for index in chosen]).numpy()
            levels = np.linspace(0, 1, self.edges.shape[1] + 2)[1:-1]
            self.edges.copy_(torch.from_numpy(np.quantile(values, levels, axis=0).T))

    def tokens(self, batch: PointCloudBatch, hidden: Tensor) -> Tensor:
        """Standardised tokens ``(N, F)`` of all points, without looking at the hidden ones."""
        visible = ~hidden
        index = torch.nonzero(visible)[:, 0]
        place = visible.cumsum(0) - 1
        neighbors = batch.neighbors[index]
        # A neighbour that is not seen is left out: the point itself in its place says nothing new.
        neighbors = torch.where(hidden[neighbors], index[:, None], neighbors)
        seen = self.network.embedding(batch.features[index], place[neighbors])
        start = self.hidden_token.to(seen.dtype).expand(len(hidden), -1).index_copy(0, index, seen)
        return self.norm(self.network.mix(start, batch, visible).float())

    def losses(self, scans: Sequence[MaskedScan]) -> dict[str, Tensor]:
        """Mean cross-entropy of all points, of the visible and of the hidden ones (0 if none)."""
        return self.geometry_losses(self.tokens_of(scans), scans)

    def tokens_of(self, scans: Sequence[MaskedScan]) -> Tensor:
        """Standardised tokens ``(N, F)`` of all points of masked scans."""
        batch = collate_scans([masked.scan for masked in scans]).to(self.device)
        return self.tokens(batch, torch.cat([masked.hidden for masked in scans]).to(self.device))

    def geometry_losses(self, tokens: Tensor, scans: Sequence[MaskedScan]) -> dict[str, Tensor]:
        """Losses of the masked geometry from tokens ``(N, F)``."""
        hidden = torch.cat([masked.hidden for masked in scans]).to(self.device)
        targets = torch.cat([masked.targets for masked in scans]).to(self.device)
        bins = torch.searchsorted(self.edges, targets.T.contiguous()).T
        # Bins before targets: over the last axis, the loss takes twice the time on a CPU.
        logits = self.head(tokens).unflatten(1, (NUM_TARGETS, -1)).transpose(1, 2)
        each = F.cross_entropy(logits, bins, reduction="none").mean(dim=1)
        return {
            "loss": each.mean(),
            "visible": each[~hidden].mean(),
            "hidden": each[hidden].sum() / hidden.sum().clamp_min(1),
        }

    def training_step(self, batch: Sequence[MaskedScan], batch_idx: int) -> Tensor:
        """Loss of one batch."""
        losses = self.losses(batch)
        for name, value in losses.items():
            self.log(f"train/{name}", value, prog_bar=name == "loss", batch_size=len(batch))
        return losses["loss"]

    def validation_step(self, batch: Sequence[MaskedScan], batch_idx: int) -> None:
        """Losses of held-out scans."""
        for name, value in self.losses(batch).items():
            self.log(f"val/{name}", value, batch_size=len(batch), sync_dist=True)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """AdamW, whose weight decay spares all but matrices."""
        matrices = [p for p in self.parameters() if p.ndim > 1]
        others = [p for p in self.parameters() if p.ndim <= 1]
        groups: list[dict[str, Any]] = [
            {"params": matrices},
            {"params": others, "weight_decay": 0.0},
        ]
        return torch.optim.AdamW(groups, **self.optimizer_config.adamw())

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Set the rate of the coming step."""
        rate = self.optimizer_config.rate(self.global_step, self.trainer.max_steps)
        for group in optimizer.param_groups:
            group["lr"] = rate

    def on_fit_end(self) -> None:
        """Write the weights of the feature source into the run's folder."""
        trial = cast(Any, self.trainer).fast_dev_run
        if self.trainer.is_global_zero and self.grid is not None and not trial:
            path = Path(self.trainer.default_root_dir) / self.source.shipped.name
            head, half = self.class_head, self.writes_half
            save_weights(path, self.network, self.norm, self.grid, half, head)
