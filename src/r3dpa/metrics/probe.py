"""Logistic regression of point features, for the control bench."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

_MAX_ITERATIONS = 200


def logistic_regression(
    features: Tensor, targets: Tensor, num_classes: int, ridge: float = 1e-4
) -> tuple[Tensor, Tensor]:
    """Weights of a multinomial logistic regression on standardised principal components.

    With the covariance S of the features, L-BFGS from zero (nothing is drawn at random) minimises::

        mean cross-entropy + ridge / 2 * trace(weight^T S weight)

    The penalty is the variance of the logits, so that no invertible linear map of the features
    changes the predictions. Standardised one by one, features that are nearly copies of each
    other, as those of an untrained network, would leave the solver far from the minimum and look
    worse than they are. A class without a point is never predicted.

    Args:
        features: ``(P, F)``; float64 stays, every other type is taken as float32.
        targets: ``(P,)`` int64 class indices in ``[0, num_classes)``.
        num_classes: C.
        ridge: At least 0.

    Returns:
        ``weight`` ``(F, C)`` and ``bias`` ``(C,)``: the logits are ``features @ weight + bias``.

    Raises:
        ValueError: If there is no point, or a feature is not finite.
    """
    if not len(features):
        raise ValueError("no labelled point to fit a linear probe on; give scans with labels")
    features = features.detach()
    features = features if features.dtype == torch.float64 else features.float()
    if not features.isfinite().all():
        raise ValueError("features hold NaN or infinite values; no probe can be fitted on them")
    centre = features.mean(dim=0)
    centred = features - centre
    variances, axes = torch.linalg.eigh((centred.T @ centred).double() / len(features))
    # Along the other axes there is nothing but the rounding of float32.
    kept = variances > (1e-6 * features.abs().max()).square()
    whitening = (axes[:, kept] / variances[kept].sqrt()).to(features)
    standardised = centred @ whitening
    present, dense = targets.unique(return_inverse=True)

    weight = standardised.new_zeros(standardised.shape[1], len(present), requires_grad=True)
    bias = standardised.new_zeros(len(present), requires_grad=True)
    optimizer = torch.optim.LBFGS(
        [weight, bias],
        max_iter=_MAX_ITERATIONS,
        tolerance_grad=1e-6,
        tolerance_change=1e-9,
        history_size=20,
        line_search_fn="strong_wolfe",
    )

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = F.cross_entropy(standardised @ weight + bias, dense)
        loss = loss + ridge / 2 * weight.square().sum()
        loss.backward()
        return loss

    with torch.enable_grad():
        optimizer.step(closure)
    folded = whitening @ weight.detach()
    all_weights = folded.new_zeros(features.shape[1], num_classes)
    all_weights[:, present] = folded
    all_biases = folded.new_full((num_classes,), -torch.inf)
    all_biases[present] = bias.detach() - centre @ folded
    return all_weights, all_biases
