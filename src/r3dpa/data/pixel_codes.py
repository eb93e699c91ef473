"""Range, intensity and class of each pixel of a scan in three bytes, for caches of many scans."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from r3dpa.geometry import EMPTY_RANGE_M, NUM_CLASSES, UNKNOWN_CLASS, Pixels

# 13 bits for the range, 4 for the class, 7 for the intensity.
_RANGES, _CLASSES, _INTENSITIES = 1 << 13, 1 << 4, 1 << 7
_HUNDREDTHS = 100  # the steps of the intensities of KITTI and of the simulator
assert NUM_CLASSES < _CLASSES


def encode_pixels(pixels: Pixels, range_max_m: float) -> Tensor:
    """Codes ``(3, H, W)`` uint8 of the pixels ``(H, W)`` of one scan, intensity and class given.

    Ranges are rounded in equal steps of ``log2(1 + range)``, 1 cm at 20 m for ``range_max_m`` 56;
    intensities to hundredths.
    """
    range_m, intensity, classes = pixels
    assert intensity is not None
    assert classes is not None
    largest = math.log2(1 + range_max_m)
    steps = (1 + range_m.double().clamp(min=0)).log2() / largest * (_RANGES - 2)
    ranges = torch.where(range_m > 0, 1 + steps.round(), 0).long()  # 0: no return
    hundredths = (intensity.clamp(0, 1) * _HUNDREDTHS).round().long()
    codes = (ranges * _CLASSES + classes.long() + 1) * _INTENSITIES + hundredths
    return torch.stack([codes >> 16, codes >> 8 & 0xFF, codes & 0xFF]).to(torch.uint8)


def decode_pixels(codes: Tensor, range_max_m: float) -> Pixels:
    """Inverse of :func:`encode_pixels`, to rounding."""
    high, middle, low = codes.int()
    codes = (high << 16) + (middle << 8) + low
    ranges = codes // (_CLASSES * _INTENSITIES)
    classes = codes // _INTENSITIES % _CLASSES + UNKNOWN_CLASS
    intensity = (codes % _INTENSITIES).float() / _HUNDREDTHS
    return Pixels(_range_table(range_max_m)[ranges], intensity, classes.long())


def _range_table(range_max_m: float) -> Tensor:
    """Metres, float32, by the code of a range."""
    steps = torch.arange(_RANGES - 1, dtype=torch.float64) / (_RANGES - 2)
    range_m = torch.exp2(steps * math.log2(1 + range_max_m)) - 1
    return torch.cat([torch.tensor([EMPTY_RANGE_M]), range_m.float()])
