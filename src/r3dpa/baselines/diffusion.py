"""Targets, weights and errors of networks that predict noise, v, data or velocity.

Letters: B batch, ``...`` any further axes.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

Prediction = Literal["eps", "v", "x_0"]
Norm = Literal["l2", "l1", "huber", "pseudo_huber"]


def data_of(
    prediction: Tensor, kind: Prediction, x: Tensor, alpha: Tensor, sigma: Tensor
) -> Tensor:
    """Clean data that a network predicts as noise, as v or directly; all ``(B, ...)``."""
    if kind == "eps":
        return (x - sigma * prediction) / alpha
    return alpha * x - sigma * prediction if kind == "v" else prediction


def target_of(
    kind: Prediction, data: Tensor, noise: Tensor, alpha: Tensor, sigma: Tensor
) -> Tensor:
    """Training target of a network whose output :func:`data_of` converts to data."""
    return {"eps": noise, "v": alpha * noise - sigma * data, "x_0": data}[kind]


def loss_weight(log_snr: Tensor, kind: Prediction, gamma: float | None = 5.0) -> Tensor:
    """Weight of the squared error of a prediction, of the shape of ``log_snr``.

    Relative to the error of the data it is ``min(snr, gamma)``, or ``snr`` where gamma is None.

    Source: min-SNR (Hang et al. 2023).
    """
    snr = log_snr.exp()
    weight = snr if gamma is None else snr.clamp(max=gamma)
    return {"eps": weight / snr, "v": weight / (snr + 1), "x_0": weight}[kind]


def sample_errors(
    prediction: Tensor, target: Tensor, norm: Norm = "l2", mask: Tensor | None = None
) -> Tensor:
    """Mean error ``(B,)`` of each sample ``(B, ...)`` where a mask of the same shape is 1, float32.

    ``huber`` changes from squares to absolute errors at 1. ``pseudo_huber`` of d values a sample is
    ``sqrt(e^2 + c^2) - c`` with ``c = 0.00054 sqrt(d)`` (Lee et al. 2024).
    """
    prediction, target = prediction.float().flatten(1), target.float().flatten(1)
    if norm == "pseudo_huber":
        c = 0.00054 * math.sqrt(target.shape[1])
        error = torch.sqrt((prediction - target).square() + c**2) - c
    else:
        losses = {"l2": F.mse_loss, "l1": F.l1_loss, "huber": F.smooth_l1_loss}
        error = losses[norm](prediction, target, reduction="none")
    if mask is None:
        return error.mean(dim=1)
    mask = mask.flatten(1)
    return (error * mask).sum(dim=1) / (mask.sum(dim=1) + 1e-8)


def weighted_mean(errors: Tensor, weights: Tensor, official: bool = False) -> Tensor:
    """Mean of weighted errors, both ``(B,)``.

    The released code multiplies errors (B, 1) and weights (B, 1, 1, 1): ``official`` gives its
    result, the product of the two means, in which the weights only scale the loss of a batch.
    """
    return errors.mean() * weights.mean() if official else (errors * weights).mean()
