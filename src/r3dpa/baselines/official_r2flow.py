"""Released checkpoints of R2Flow: their keys, options and direction of time, translated.

Their time runs from 0 (noise) to 1 (data). A network of ours counts from the data and its velocity
points to the noise: in terms of the official ``v`` it is ``-v(x, 1 - t)``. All networks take the
time as cosines and sines, and those of ``w (1 - t)`` are sums of those of ``w t``: a reflection of
the columns of the first linear layer and the sign of the last layer translate the weights.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from r3dpa.nn.velocity_network import MAX_PERIOD

_OUTPUTS = [
    "detokenizer.1.weight",  # HDiT
    *("out_conv.2.weight", "out_conv.2.bias"),  # ADM U-Net
    *("out_conv.weight", "out_conv.bias"),  # efficient U-Net
]


def time_reversed(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights of the network whose time runs the other way; its own inverse.

    Gradients by the weights are translated alike, as the map is orthogonal.

    Args:
        weights: State dict of a HDiT, ADM U-Net or efficient U-Net.
    """
    turned = {key: -weights[key] for key in _OUTPUTS if key in weights}
    if (key := "timestep_pe.0.linear.weight") in weights:
        angles = 2 * math.pi * weights["timestep_pe.0.freqs"].double()
        turned[key] = _reflected(weights[key], angles)
    if (key := "time_embedding.1.weight") in weights:
        half = weights[key].shape[1] // 2
        exponents = torch.arange(half, dtype=torch.float64) / (half - 1)
        angles = torch.exp(-math.log(MAX_PERIOD) * exponents)
        sines_last = weights[key].roll(half, dims=1)
        turned[key] = _reflected(sines_last, angles).roll(half, dims=1)
    return dict(weights) | turned


def _reflected(weight: Tensor, angles: Tensor) -> Tensor:
    """Weight ``(E, 2K)`` for features of time t instead of 1 - t, cosines before sines.

    ``cos(w - w t) = cos(w) cos(w t) + sin(w) sin(w t)``, and with ``sin(w - w t)``
    ``= sin(w) cos(w t) - cos(w) sin(w t)``; ``angles`` are the ``(K,)`` frequencies w.
    """
    cosine, sine = angles.cos(), angles.sin()
    of_cosines, of_sines = weight.double().chunk(2, dim=1)
    mixed = of_cosines * cosine + of_sines * sine, of_cosines * sine - of_sines * cosine
    return torch.cat(mixed, dim=1).to(weight.dtype)
