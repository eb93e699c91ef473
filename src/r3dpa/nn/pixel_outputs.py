"""What a decoder says about each pixel: a mixture for its range, and what images are made of it.

Letters: B batch, H x W image size.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from r3dpa.geometry import NUM_CLASSES, SEMANTIC_CLASSES
from r3dpa.nn.layers import at_least_float32

_FLYING_GAP = 0.01  # from both neighbours, encoded: 2 % of the range in log2, 0.28 m in linear
_RIPPLE = 0.02  # neighbours that much nearer or farther have 1 / e of the weight; 4 % in log2
_RIPPLE_COLUMNS = 12  # on both sides
_WALLS = [n for n, known in enumerate(SEMANTIC_CLASSES) if known.name in ("building", "wall")]


class PixelOutputs(NamedTuple):
    """Parts of the outputs of a decoder, each ``(B, ..., H, W)``; None where it has no such part.

    ``ranges`` are encoded ranges, or the parameters of a :class:`RangeMixture`; ``returns`` the
    logit of a return; ``intensity`` encoded; ``classes`` the logits of the classes.
    """

    ranges: Tensor
    returns: Tensor | None
    intensity: Tensor | None
    classes: Tensor | None


class RangeMixture:
    """Two Laplacians for the encoded range of each pixel, near and far at an edge.

    Below the least scale the loss is linear instead of logarithmic, which keeps small errors from
    dominating and bounds the likelihood of a flat wall.

    Source: Tosi et al., "SMD-Nets: stereo mixture density networks" (CVPR 2021).

    Args:
        outputs: ``(B, 5 or more, H, W)`` of a decoder: two centres, two logarithms of scales, and
            the logit of the first centre.
        least_scale: Positive, in units of the encoded range.
    """

    num_outputs = 5

    def __init__(self, outputs: Tensor, least_scale: float) -> None:
        outputs = at_least_float32(outputs)
        least = math.log(least_scale)
        self.centres = outputs[:, :2]
        self.log_scales = F.softplus(outputs[:, 2:4] - least) + least
        logit = outputs[:, 4:5]
        self.log_weights = torch.cat([F.logsigmoid(logit), F.logsigmoid(-logit)], dim=1)

    def mode(self) -> Tensor:
        """Centre ``(B, 1, H, W)`` where the density is higher."""
        first = (self.log_weights - self.log_scales).diff(dim=1) <= 0
        return torch.where(first, self.centres[:, :1], self.centres[:, 1:])

    def nll(self, image: Tensor) -> Tensor:
        """Negative log-likelihood ``(B, 1, H, W)`` in nats of encoded ranges ``(B, 1, H, W)``."""
        distance = (image - self.centres).abs() * torch.exp(-self.log_scales)
        density = self.log_weights - self.log_scales - math.log(2.0) - distance
        return -density.logsumexp(dim=1, keepdim=True)


def clean_image(image: Tensor, classes: Tensor | None = None) -> Tensor:
    """Images without flying pixels and ripples, the latter twice where a decoder sees walls.

    Leaves and ground, which one pass leaves about as rough as in scans, are not smoothed further.
    No gradient reaches the classes.

    Args:
        image: As of :func:`without_flying_pixels`.
        classes: ``(B, num_classes, H, W)`` logits of the classes of
            :data:`r3dpa.geometry.SEMANTIC_CLASSES`; without, or of others, no wall is known.
    """
    image = without_ripples(without_flying_pixels(image))
    if classes is None or classes.shape[1] != NUM_CLASSES:
        return image
    walls = classes.detach().softmax(dim=1)[:, _WALLS].sum(dim=1, keepdim=True)
    return torch.lerp(image, without_ripples(image), walls)


def without_flying_pixels(image: Tensor) -> Tensor:
    """Images with the flying pixels on the nearer of the surfaces that they lie between.

    A pixel flies if its left and right neighbours have a return, are on two surfaces, and are both
    farther from it than the flatter surface is inclined there. A second pass moves what is left
    of wider ramps. Thin poles stay, since there is one surface behind them, and so do walls at a
    grazing angle but for their last pixels.

    Args:
        image: ``(B, 2, H, W)`` encoded ranges, and logits of a return, above 0 with one. Columns
            wrap around.
    """
    ranges, logit = image[:, :1], image[:, 1:]
    between = (logit.roll(1, -1) > 0) & (logit.roll(-1, -1) > 0)
    for _ in range(2):
        left, right = ranges.roll(1, -1), ranges.roll(-1, -1)
        to_left = (ranges - left).abs()
        to_right = to_left.roll(-1, -1)
        inclination = torch.minimum(to_left.roll(1, -1), to_right.roll(-1, -1))
        flying = torch.minimum(to_left, to_right) > _FLYING_GAP + inclination
        flying &= between & ((left - right).abs() > 2 * _FLYING_GAP)
        ranges = torch.where(flying, torch.where(to_left < to_right, left, right), ranges)
    return torch.cat([ranges, logit], dim=1)


def without_ripples(image: Tensor) -> Tensor:
    """Images whose ranges are smoothed along rings, but not over edges.

    A decoder errs from pixel to pixel by about 1 % of the range, a sensor by a few centimetres.
    Each range becomes a mean of the returns of its ring, 12 columns to both sides, weighted by how
    close they are in range; so outlines and thin poles stay.

    Source: Tomasi and Manduchi, "Bilateral filtering for gray and color images" (ICCV 1998), here
    with equal weights for all columns.

    Args:
        image: ``(B, 2, H, W)`` encoded ranges, and logits of a return, above 0 with one. Columns
            wrap around.
    """
    ranges, logit = image[:, :1], image[:, 1:]
    total, weights = ranges, torch.ones_like(ranges)
    returns = logit > 0
    for shift in range(1, _RIPPLE_COLUMNS + 1):
        for columns in (shift, -shift):
            other = ranges.roll(columns, -1)
            weight = torch.exp(-((other - ranges) / _RIPPLE).square())
            weight = weight * returns.roll(columns, -1)
            total, weights = total + weight * other, weights + weight
    return torch.cat([torch.where(returns, total / weights, ranges), logit], dim=1)
