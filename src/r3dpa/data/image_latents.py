"""Statistics of the latents of images, from the posteriors that a cache holds.

Letters: C latent channels, h x w latent size.
"""

from __future__ import annotations

import json

import torch
from torch import Tensor

from r3dpa.data.images import ImageEntry
from r3dpa.data.scans import evenly
from r3dpa.data.tensor_cache import CachedTensors

__all__ = ["latent_statistics"]

_IMAGES_TO_MEASURE = 10_000


def latent_statistics(posteriors: CachedTensors[ImageEntry]) -> tuple[Tensor, Tensor]:
    """Mean and variance ``(C,)`` of the raw latents, samples of the posteriors.

    They are written to ``statistics.json`` of the cache, too.

    Args:
        posteriors: Moments ``(2C, h, w)``; at most 10 000 of them, spread evenly, are read.

    Raises:
        TensorCacheError: If an image was replaced since it was encoded, or the cache cannot be
            written.
    """
    chosen = evenly(posteriors.items, _IMAGES_TO_MEASURE)
    channels, rows, columns = posteriors.cache.shape
    sums = torch.zeros(3, channels // 2, dtype=torch.float64)
    for entry in chosen:
        mean, logvar = posteriors.read(entry).double().flatten(1).chunk(2)
        sums += torch.stack([mean.sum(1), mean.square().sum(1), logvar.exp().sum(1)])
    mean, square, noise = sums / (len(chosen) * rows * columns)
    variance = square - mean.square() + noise
    about = {"images": len(chosen), "mean": mean.tolist(), "variance": variance.tolist()}
    posteriors.cache.write("statistics.json", json.dumps(about, indent=1))
    return mean.float(), variance.float()
