"""Point features from the simulator's labels: an extractor that knows every class."""

from __future__ import annotations

import zlib
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from r3dpa.nn.backbones.geometric import CENTRES, SPREADS, GeometricFeatures
from r3dpa.nn.backbones.kernel import KernelFeatures

#: KITTI-360 ids of the classes that are told apart; all other ids are one class more.
CLASS_IDS = (7, 8, 11, 12, 13, 17, 20, 21, 22, 24, 25, 26, 27, 28, 33)
_NUM_CLASSES = len(CLASS_IDS) + 1
_HASH_WIDTH = 8
_HASH_FACTOR = 2654435761  # odd, near 2^32 over the golden ratio: neighbours differ in all bits
# Of `GeometricFeatures.descriptors`: planarity, the normal, height, logarithm of the range.
_GEOMETRY = (1, 3, 4, 5, 6, 7)
# Of the kernel features: a linear probe then finds every class, with 64 it misses the rare ones.
_WIDTH = 256
# Two points whose classes differ have a kernel of 0.01, two objects of one class 0.73, and two
# places of one object 0.7 on average.
_CLASS_SPREAD, _OBJECT_SPREAD, _GEOMETRY_SPREADS = 0.233, 0.9, 2.0


class OracleFeatures(KernelFeatures):
    """Frozen feature extractor that reads the labels of simulated scans.

    A point's values are its class (one of 16), its object (8 values of a hash of the instance) and
    six of the values of :class:`GeometricFeatures`: planarity, normal, height and range. Points of
    one class are near, of one object nearer, of other classes orthogonal. The material of a
    surface, which the labels do not tell, is left out.

    **It leaks labels**: for tests of the machinery and ablations. No number of a network that was
    trained with it may be compared with others; ``r3dpa validate`` and ``r3dpa test`` refuse.

    Args:
        dim: Width D of the features, even.
        seed: Seed of the lift and of the noise.
        noise: Standard deviation of the noise on every value of every point, in units of the
            value's own spread; drawn from the seed and the scan's points alone.

    Attributes:
        name: ``"oracle"``.
        needs_labels: The labels are a second argument.
        num_headings: Rotations by multiples of this part of a turn keep the features; 0 if noisy.
        mirror_invariant: Swapping left and right keeps the features; not if noisy.
        settings: What determines the features, see :class:`r3dpa.data.Extractor`.

    Raises:
        ValueError: If ``dim`` is odd or below 2, or ``noise`` is negative.
    """

    name = "oracle"
    needs_labels = True

    def __init__(self, dim: int = 768, seed: int = 0, noise: float = 0.0) -> None:
        centres = [0.0] * (_NUM_CLASSES + _HASH_WIDTH) + [CENTRES[i] for i in _GEOMETRY]
        spreads = [_CLASS_SPREAD] * _NUM_CLASSES + [_OBJECT_SPREAD] * _HASH_WIDTH
        spreads += [_GEOMETRY_SPREADS * SPREADS[i] for i in _GEOMETRY]
        super().__init__(dim, seed, centres, spreads, _WIDTH)
        if noise < 0:
            raise ValueError(f"noise must be 0 or greater, got {noise}.")
        self.settings: dict[str, Any] = {"seed": seed, "noise": noise, "version": 1}
        self.num_headings = 0 if noise else GeometricFeatures.num_headings
        self.mirror_invariant = GeometricFeatures.mirror_invariant and not noise
        self.prepare = partial(_prepare, spreads=tuple(spreads), seed=seed, noise=noise)


def _prepare(
    points: Tensor, labels: Tensor, spreads: tuple[float, ...], seed: int, noise: float
) -> Tensor:
    """Values ``(P, 30)`` of the points of one scan: class, object, geometry.

    Args:
        points: ``(P, 4)`` x, y, z in metres, intensity 0..1.
        labels: ``(P,)`` int64, KITTI-360 id in the lower 16 bits, instance in the upper; an
            instance of 0 is none.
        spreads: What the noise is a multiple of.
        seed: Seed of the noise.
        noise: Its standard deviation.

    Raises:
        ValueError: If there is not one label for each point.
    """
    if labels.shape != points.shape[:1]:
        raise ValueError(f"{len(points)} points need as many labels, got {tuple(labels.shape)}.")
    labels = labels.long()
    classes = labels.new_full((1 << 16,), _NUM_CLASSES - 1)
    classes[list(CLASS_IDS)] = torch.arange(len(CLASS_IDS), device=labels.device)
    one_hot = F.one_hot(classes[labels & 0xFFFF], _NUM_CLASSES)
    geometry = GeometricFeatures.descriptors(points)[:, list(_GEOMETRY)]
    values = torch.cat([one_hot.float(), _object_hash(labels >> 16), geometry], dim=1)
    if noise:
        key = zlib.crc32(points.detach().cpu().contiguous().numpy().tobytes(), seed & 0xFFFFFFFF)
        generator = torch.Generator().manual_seed(key)
        drawn = torch.randn(values.shape, generator=generator) * torch.tensor(spreads)
        values = values + noise * drawn.to(values.device)
    return values


def _object_hash(instance: Tensor) -> Tensor:
    """Vector ``(P, 8)`` of length 1 for each instance: signs by the bits of a hash; 0 for none."""
    bits = (instance * _HASH_FACTOR % (1 << 32)) >> (32 - _HASH_WIDTH)
    signs = (bits[:, None] >> torch.arange(_HASH_WIDTH, device=bits.device) & 1) * 2.0 - 1
    return signs * (instance > 0)[:, None] / _HASH_WIDTH**0.5
