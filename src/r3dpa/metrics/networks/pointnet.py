"""PointNet, whose features FPD of R2DM and R2Flow compares. Letters: B batch, P points."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa.features.official import FrozenNetwork, load_strictly, naming, read_released

#: Metres that the network reads as 1.
POINTS_SCALE_M = 80.0
_AT_ONCE = 8192  # points whose 1024 values are held at once


class _PointLayers(nn.Module):
    """Three layers on each point and the maximum over all."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv1d(3, 64, 1), nn.BatchNorm1d(64)
        self.conv2, self.bn2 = nn.Conv1d(64, 128, 1), nn.BatchNorm1d(128)
        self.conv3, self.bn3 = nn.Conv1d(128, 1024, 1), nn.BatchNorm1d(1024)

    def pooled(self, points: Tensor) -> Tensor:
        """``(B, 1024)`` of points ``(B, 3, P)``, before the last activation."""
        parts = []
        for part in points.split(_AT_ONCE, dim=2):
            part = F.relu(self.bn1(self.conv1(part)))
            part = F.relu(self.bn2(self.conv2(part)))
            parts.append(self.bn3(self.conv3(part)).amax(dim=2))
        return torch.stack(parts).amax(dim=0)


class _Transform(_PointLayers):
    """Matrix ``(B, 3, 3)`` that turns a cloud."""

    def __init__(self) -> None:
        super().__init__()
        self.fc1, self.fc2, self.fc3 = nn.Linear(1024, 512), nn.Linear(512, 256), nn.Linear(256, 9)
        self.bn4, self.bn5 = nn.BatchNorm1d(512), nn.BatchNorm1d(256)

    def forward(self, points: Tensor) -> Tensor:
        hidden = F.relu(self.bn4(self.fc1(F.relu(self.pooled(points)))))
        hidden = F.relu(self.bn5(self.fc2(hidden)))
        return self.fc3(hidden).view(-1, 3, 3) + torch.eye(3, device=points.device)


class _Features(_PointLayers):
    def __init__(self) -> None:
        super().__init__()
        self.stn = _Transform()

    def forward(self, points: Tensor) -> Tensor:
        return self.pooled(self.stn(points).transpose(1, 2) @ points)


class PointNet(FrozenNetwork):
    """PointNet for ShapeNet; always in evaluation mode.

    Source: Qi et al. (CVPR 2017), with the weights of SpareNet that LiDARGen and R2DM use.

    Args:
        num_classes: Classes of the head.
    """

    def __init__(self, num_classes: int = 16) -> None:
        super().__init__()
        self.feat = _Features()
        self.fc1, self.fc2 = nn.Linear(1024, 512), nn.Linear(512, 256)
        self.fc3 = nn.Linear(256, num_classes)
        self.bn1, self.bn2 = nn.BatchNorm1d(512), nn.BatchNorm1d(256)
        self.dim = 1024 + 512 + 256 + num_classes
        self.requires_grad_(False).eval()

    @classmethod
    def from_checkpoint(cls, path: str | Path) -> Self:
        """Load SpareNet's ``cls_model_39.pth``.

        Raises:
            ValueError: If the file does not fit; names it.
        """
        network = cls()
        with naming(path):
            load_strictly(network, read_released(Path(path), "cls_model_39.pth"), lambda key: key)
        return network

    def forward(self, points: Tensor) -> Tensor:
        """All four last layers ``(B, dim)`` of points ``(B, 3, P)`` in units of 80 m.

        A pixel without a return is a point at the origin: their number does not matter, but
        whether there is one does.
        """
        pooled = self.feat(points)
        hidden = F.relu(self.bn1(self.fc1(pooled)))
        last = F.relu(self.bn2(self.fc2(hidden)))
        return torch.cat([pooled, hidden, last, self.fc3(last)], dim=1)
