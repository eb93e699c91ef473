"""What tells the weights of a network from others, whatever file they are in."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import torch
from torch import Tensor

__all__ = ["weights_sha256"]


def weights_sha256(state: Mapping[str, Tensor]) -> str:
    """SHA-256 of the names and bytes of weights, in the order of their names.

    Neither device nor memory format count, nor which file they were read from.

    Args:
        state: Tensors by name, such as a ``state_dict``.

    Returns:
        64 hexadecimal digits.
    """
    digest = hashlib.sha256()
    for name in sorted(state):
        digest.update(name.encode())
        # As bytes: numpy knows no bfloat16.
        values = state[name].detach().cpu().contiguous().flatten().view(torch.uint8)
        digest.update(values.numpy().data)
    return digest.hexdigest()
