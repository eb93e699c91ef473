"""Random numbers that depend on a seed alone."""

import torch


def drawn(seed, *shape):
    """Standard normal numbers of float32."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))
