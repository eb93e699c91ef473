"""Pixels of several scenes: joined, interpolated where they are missing, pasted into a scan.

Letters: B scenes, H beams, W columns.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from r3dpa.editing.gaps import interpolate_gaps
from r3dpa.geometry import UNKNOWN_CLASS, Pixels
from r3dpa.scenes import map_pixels


def batch_of(pixels: Pixels) -> Pixels:
    """Pixels ``(H, W)`` of one scan as a batch ``(1, H, W)``."""
    return map_pixels(lambda values: values[None], pixels)


def concatenate(parts: Sequence[Pixels]) -> Pixels:
    """Pixels of several batches; values missing in one batch are dropped."""
    intensities = [part.intensity for part in parts if part.intensity is not None]
    classes = [part.classes for part in parts if part.classes is not None]
    return Pixels(
        torch.cat([part.range_m for part in parts]),
        torch.cat(intensities) if len(intensities) == len(parts) else None,
        torch.cat(classes) if len(classes) == len(parts) else None,
    )


def interpolated(pixels: Pixels, missing: Tensor) -> Pixels:
    """Pixels with interpolated ranges, and with the nearest intensities and classes."""
    range_m = interpolate_gaps(pixels.range_m, missing)
    intensity, classes = (
        None if values is None else interpolate_gaps(values.float(), missing, "nearest")
        for values in (pixels.intensity, pixels.classes)
    )
    return Pixels(range_m, intensity, None if classes is None else classes.long())


def paste(decoded: Pixels, scan: Pixels, mask: Tensor) -> Pixels:
    """Decoded pixels ``(B, H, W)`` inside a mask ``(H, W)``, pixels of the scan outside."""
    range_m = torch.where(mask, decoded.range_m, scan.range_m)
    intensity, classes = decoded.intensity, decoded.classes
    if intensity is not None:
        intensity = torch.where(range_m > 0, intensity, 0.0)
        if scan.intensity is not None:
            intensity = torch.where(mask, intensity, scan.intensity)
    if classes is not None:
        outside = torch.full_like(mask, UNKNOWN_CLASS, dtype=torch.long)
        classes = torch.where(range_m > 0, classes, UNKNOWN_CLASS)
        classes = torch.where(mask, classes, outside if scan.classes is None else scan.classes)
    return Pixels(range_m, intensity, classes)
