"""Training of a point network on semantic classes, beside masked prediction of geometry."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa.features import WaffleIron, WaffleIronS2
from r3dpa.features.scalr import read_weights
from r3dpa.features.voxels import MaskedScan
from r3dpa.geometry.semantics import NUM_CLASSES, UNKNOWN_CLASS
from r3dpa.modules.point_pretraining import PointPretraining


class PointSegmentation(PointPretraining):
    """WaffleIron trained to predict the class and the geometry of the points of masked scans.

    The loss is the cross-entropy of the classes, see :func:`class_loss`, plus ``geometry_weight``
    times the loss of :class:`PointPretraining`; both read the same tokens by a linear layer. Scans
    without labels add to the second term alone.

    Args:
        network: Network to train, with the ``cells`` of the scans' grid.
        start: Weights file of ``WaffleIronS`` to start from, of the same sizes as ``network``.
        geometry_weight: Weight of the loss of the masked geometry. With 0 its targets are not
            needed: give :class:`~r3dpa.features.Masking` ``geometry`` false.
        kwargs: Further arguments of :class:`PointPretraining`.
    """

    source = WaffleIronS2
    writes_half = True

    def __init__(
        self,
        network: WaffleIron,
        start: Path | None = None,
        geometry_weight: float = 1.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(network, **kwargs)
        self.geometry_weight = geometry_weight
        self.head.requires_grad_(geometry_weight > 0)  # DDP wants a gradient of every parameter
        if not geometry_weight:
            self.edges.zero_()  # never measured; a buffer of NaN stops a run
        self.class_head: nn.Linear = nn.Linear(network.width, NUM_CLASSES)
        if start is not None:
            state, trained, _ = read_weights(start)
            network.load_state_dict(trained.state_dict())
            norm = {key: state[f"norm.{key}"] for key in self.norm.state_dict()}
            self.norm.load_state_dict(norm)

    def losses(self, scans: Sequence[MaskedScan]) -> dict[str, Tensor]:
        """Weighted sum, cross-entropy of the classes, losses of the geometry where it counts."""
        tokens = self.tokens_of(scans)
        classes = torch.cat([_classes(masked) for masked in scans]).to(self.device)
        of_classes = class_loss(self.class_head(tokens), classes)
        if not self.geometry_weight:
            return {"loss": of_classes, "classes": of_classes}
        geometry = self.geometry_losses(tokens, scans)
        total = of_classes + self.geometry_weight * geometry["loss"]
        return geometry | {"loss": total, "classes": of_classes}


def class_loss(logits: Tensor, classes: Tensor) -> Tensor:
    """Cross-entropy of classes ``(N,)`` from logits ``(N, num_classes)``; 0 if all are unknown.

    A class counts as the square root of its number of points in the batch, so that rare classes
    are not lost among roads and facades.
    """
    counts = torch.bincount(classes[classes != UNKNOWN_CLASS], minlength=logits.shape[1])
    weight = counts.clamp_min(1).to(logits.dtype).rsqrt()
    total = F.cross_entropy(
        logits, classes, weight=weight, ignore_index=UNKNOWN_CLASS, reduction="sum"
    )
    return total / (counts * weight).sum().clamp_min(1)


def _classes(masked: MaskedScan) -> Tensor:
    if masked.classes is None:
        raise ValueError(
            "PointSegmentation needs scans with classes: use r3dpa.data.LabelledPointDataModule"
        )
    return masked.classes
