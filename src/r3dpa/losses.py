"""Training losses as pure functions; weights and logging live in the modules.

Letters: B batch, N tokens, D feature width, C channels, H x W image size, h x w latent size.
"""

from __future__ import annotations

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = [
    "alignment_loss",
    "balanced_generator_loss",
    "centred_features",
    "class_errors",
    "discriminator_loss",
    "flow_matching_loss",
    "generator_loss",
    "masked_mean",
    "pixel_error",
    "reconstruction_errors",
    "reconstruction_loss",
    "return_loss",
    "unit_vectors",
]


def reconstruction_loss(
    reconstruction: Tensor, image: Tensor, kind: Literal["l1", "l2"] = "l1"
) -> Tensor:
    """Mean absolute (``l1``) or squared (``l2``) error between two images.

    Source: R3DPA writes a squared error, its code trains with the absolute one; the default
    follows the code.

    Args:
        reconstruction: ``(B, C, H, W)`` decoder output, encoded range.
        image: ``(B, C, H, W)`` encoded range in [-1, 1].
        kind: Norm of the error.

    Returns:
        Scalar mean over all elements, float32.

    Raises:
        ValueError: If ``kind`` is neither ``l1`` nor ``l2``.
    """
    return pixel_error(reconstruction, image, kind).mean()


def reconstruction_errors(
    reconstruction: Tensor, image: Tensor, kind: Literal["l1", "l2"] = "l1"
) -> Tensor:
    """:func:`reconstruction_loss` ``(B,)`` of each image."""
    return pixel_error(reconstruction, image, kind).flatten(1).mean(dim=1)


def pixel_error(prediction: Tensor, image: Tensor, kind: Literal["l1", "l2"] = "l1") -> Tensor:
    """Absolute (``l1``) or squared (``l2``) error of each pixel, float32.

    Raises:
        ValueError: If ``kind`` is neither ``l1`` nor ``l2``.
    """
    error = prediction.float() - image.float()
    if kind == "l1":
        return error.abs()
    if kind == "l2":
        return error.square()
    raise ValueError(f"reconstruction loss must be 'l1' or 'l2', got {kind!r}")


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean ``(B,)`` of values ``(B, ...)`` where the mask is True; 0 where it is nowhere."""
    total = torch.where(mask, values, 0.0).flatten(1).sum(dim=1)
    return total / mask.flatten(1).sum(dim=1).clamp(min=1)


def return_loss(logits: Tensor, returns: Tensor) -> Tensor:
    """Cross-entropy ``(B,)`` of return logits, both ``(B, 1, H, W)``, in nats per pixel."""
    each = F.binary_cross_entropy_with_logits(logits.float(), returns.float(), reduction="none")
    return each.flatten(1).mean(dim=1)


def class_errors(logits: Tensor, classes: Tensor) -> Tensor:
    """Cross-entropy ``(B, 1, H, W)`` in nats of logits ``(B, K, H, W)`` of K classes.

    ``classes`` ``(B, 1, H, W)`` are numbers of classes; where they are negative, the error is 0.
    """
    numbers = classes[:, 0].long()
    each = F.cross_entropy(logits.float(), numbers.clamp(min=-1), ignore_index=-1, reduction="none")
    return each.unsqueeze(1)


def generator_loss(fake_logits: Tensor) -> Tensor:
    """Adversarial loss of the decoder: minus the mean logit of its images.

    Args:
        fake_logits: Patch logits of reconstructions, any shape.

    Returns:
        Scalar, float32.
    """
    return -fake_logits.float().mean()


def balanced_generator_loss(fake_logits: Tensor, image: Tensor, ratio: float) -> Tensor:
    """Value of :func:`generator_loss`, with a gradient of a given length.

    The gradient of each sample has ``ratio`` times the length of the gradient of an L1 loss. With a
    fixed adversarial weight it would be hundredths of the reconstruction gradient, or swamp it,
    depending on the discriminator.

    Source: as the adaptive weight of Esser et al., "Taming transformers" (CVPR 2021), per sample
    and at the image, so that results do not depend on how processes split a batch.

    Args:
        fake_logits: Patch logits of the images, any shape.
        image: ``(B, C, H, W)`` decoded images.
        ratio: Length relative to the gradient of the mean absolute error, ``1 / (B sqrt(C H W))``.
    """
    loss = generator_loss(fake_logits)
    if not image.requires_grad:
        return loss
    # Of the sum, since parts of a mean may be too small for half precision.
    (gradient,) = torch.autograd.grad(-fake_logits.float().sum(), image)
    norms = gradient.flatten(1).norm(dim=1).clamp(min=1e-30)
    length = ratio / (len(image) * image[0].numel() ** 0.5)
    pull = (image * gradient * (length / norms)[:, None, None, None]).sum()
    return loss.detach() + (pull - pull.detach())


def discriminator_loss(real_logits: Tensor, fake_logits: Tensor) -> Tensor:
    """Hinge loss of the discriminator, half from real and half from reconstructed patches.

    Formula: ``0.5 * (mean(relu(1 - real)) + mean(relu(1 + fake)))``.

    Args:
        real_logits: Patch logits of scans, any shape.
        fake_logits: Patch logits of reconstructions, any shape.

    Returns:
        Scalar, float32, at least zero.
    """
    real = F.relu(1.0 - real_logits.float()).mean()
    fake = F.relu(1.0 + fake_logits.float()).mean()
    return 0.5 * (real + fake)


def flow_matching_loss(velocity: Tensor, target: Tensor) -> Tensor:
    """Mean squared error of the predicted velocity, one value per sample.

    Args:
        velocity: ``(B, C, h, w)`` predicted d x_t / d t.
        target: ``(B, C, h, w)`` velocity of the interpolant.

    Returns:
        ``(B,)``, float32.
    """
    return (velocity.float() - target.float()).square().flatten(1).mean(dim=1)


def alignment_loss(
    projected: Tensor, feature_grid: Tensor, *, skip_empty_cells: bool = False
) -> Tensor:
    """Minus the mean cosine between projected tokens and pooled 3D features, per sample.

    Empty cells of the grid are zero vectors. They have cosine 0 and by default still count in the
    mean, as in R3DPA (ICRA 2026), eq. 2 and its code; with ``skip_empty_cells`` the mean runs over
    the other cells only. Computed in float32 with ``x * rsqrt(sum(x^2) + eps^2)``, eps = 1e-6,
    whose gradient stays finite at zero.

    Args:
        projected: ``(B, N, D)`` tokens after the projection head.
        feature_grid: ``(B, N, D)`` target features, any length per vector.
        skip_empty_cells: Leave cells without points out of the mean.

    Returns:
        ``(B,)`` in [-1, 1], float32; 0 for a sample whose cells are all empty.
    """
    feature_grid = feature_grid.float()
    cosine = (unit_vectors(projected.float()) * unit_vectors(feature_grid)).sum(dim=-1)
    if not skip_empty_cells:
        return -cosine.mean(dim=1)
    occupied = feature_grid.abs().amax(dim=-1) > 0
    return -(cosine * occupied).sum(dim=1) / occupied.sum(dim=1).clamp(min=1)


def centred_features(feature_grid: Tensor) -> Tensor:
    """Feature grids ``(B, N, D)`` minus their mean over the occupied cells; empty cells stay 0."""
    feature_grid = feature_grid.float()
    occupied = (feature_grid.abs().amax(dim=-1, keepdim=True) > 0).float()
    mean = feature_grid.sum(dim=1, keepdim=True) / occupied.sum(dim=1, keepdim=True).clamp(min=1)
    return (feature_grid - mean) * occupied


def unit_vectors(vectors: Tensor, eps: float = 1e-6) -> Tensor:
    """Unit vectors along the last axis; unlike ``normalize`` the gradient is finite at zero."""
    # Beyond 2^64 the squares are infinite and the cosine would be 0.
    scale = vectors.detach().abs().amax(dim=-1, keepdim=True).clamp(min=1)
    vectors = vectors / scale
    return vectors * torch.rsqrt(vectors.square().sum(dim=-1, keepdim=True) + eps**2)
