"""Missing parts of a range image: checked against the field of view, or interpolated.

Letters: H beams, W columns, P points.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from r3dpa.geometry.projection import Projection, in_range
from r3dpa.geometry.sensor import EMPTY_RANGE_M, angles_of

Gaps = Literal["inverse", "linear", "nearest"]
_LEAST_ROWS = 0.5  # of the field of view, that a scan of the same sensor fills
_LEAST_COLUMNS = 0.75
_LEAST_DENSE = 0.6  # of the returns have one right below: all beams 0.76 or more, half of them 0.52
_MOST_OUTSIDE = 0.2  # share of points beyond the vertical field of view
_MARGIN_DEG = 1.5  # that some lasers of a real sensor look further up or down than its limits
_NEAR_ROWS = 4  # how far known beams tell of missing ones
_ONE_SURFACE = 1.3  # ratio of ranges up to which two beams are taken to meet one surface


def check_view(
    points: Tensor, range_m: Tensor, projection: Projection, missing: Tensor | None = None
) -> None:
    """Refuse a scan that does not fill the field of view that a model was trained on.

    ``range_m`` ``(H, W)`` is the image of the points; pixels ``missing`` need not be filled.

    Raises:
        ValueError: If fewer than half of the rows or three quarters of the columns hold a return,
            fewer than three fifths of the returns have one in the pixel below, as with half of the
            beams, or more than a fifth of the points lie above or below the field of view.
    """
    sensor = projection.sensor
    expected = torch.ones_like(range_m, dtype=torch.bool) if missing is None else ~missing
    inclination = angles_of(points[in_range(points, sensor)])[0].rad2deg()
    lowest, highest = (v.rad2deg().item() for v in projection.ray_angles()[0].aminmax())
    outside = (inclination < lowest - _MARGIN_DEG) | (inclination > highest + _MARGIN_DEG)
    if outside.double().mean() > _MOST_OUTSIDE:
        low, high = inclination.quantile(torch.tensor([0.01, 0.99]).double()).tolist()
        raise ValueError(
            f"{outside.double().mean():.0%} of the points lie outside the field of view of the "
            f"checkpoint, {lowest:.1f} to {highest:.1f} degrees above the horizon: those of the "
            f"scan reach from {low:.1f} to {high:.1f}. It is of another sensor, or not in its "
            "frame (x forward, z up, metres)"
        )
    returns = (range_m > 0) & expected
    for name, axis, least in (("beams", 1, _LEAST_ROWS), ("columns", 0, _LEAST_COLUMNS)):
        required = expected.any(dim=axis)
        share = returns.any(dim=axis)[required].double().mean().item()
        if share < least:
            raise ValueError(
                f"the scan fills {share:.0%} of the {int(required.sum())} {name} that the "
                f"checkpoint was trained on ({sensor.beams} x {sensor.columns} pixels, "
                f"{lowest:.1f} to {highest:.1f} degrees above the horizon): it is of another "
                "sensor, a part of a scan, which `r3dpa edit complete` fills, or not in its own "
                "frame"
            )
    above = returns[:-1] & expected[1:]
    dense = returns[1:][above].double().mean().item()
    if dense < _LEAST_DENSE:  # not with NaN, where beams are missing between all others
        raise ValueError(
            f"only {dense:.0%} of the returns have another one right below them, not "
            f"{_LEAST_DENSE:.0%} or more as in scans of {sensor.beams} beams: it has fewer beams "
            "than the checkpoint was trained on, or was thinned out"
        )


def filled(range_m: Tensor, missing: Tensor, how: Gaps = "inverse") -> Tensor:
    """Range image ``(H, W)`` with interpolated gaps: between beams, else between columns.

    Args:
        range_m: ``(H, W)`` metres, -1 without a return.
        missing: ``(H, W)`` bool; all other pixels stay as they are.
        how: Between two returns ``inverse`` is linear in 1 / range, which is exact on planes up to
            the curvature of the angles; ``linear`` is linear in range. Where one neighbour has no
            return, and with ``nearest``, the nearest one, the upper or left one at a tie.
    """
    between, found = _neighbours(range_m.T, ~missing.T)
    range_m = torch.where(missing & found.T, between.mean(how).T, range_m)
    known = ~missing | found.T
    width = range_m.shape[1]
    between, _ = _neighbours(range_m.repeat(1, 3), known.repeat(1, 3))  # columns wrap around
    return torch.where(known, range_m, between.mean(how)[:, width : 2 * width])


def refined(made_m: Tensor, range_m: Tensor, missing: Tensor) -> Tensor:
    """Generated ranges corrected by the known beams around them.

    Between two known beams on one surface the range is interpolated, between two without a return
    there is none; elsewhere near a known beam the error at that beam is subtracted.

    Args:
        made_m: ``(H, W)`` metres, generated; not above 0 without a return.
        range_m: ``(H, W)`` metres, the scan.
        missing: ``(H, W)`` bool, pixels that the scan lacks.

    Returns:
        ``(H, W)``, -1 without a return; ``made_m`` far from known beams.
    """
    made = made_m > 0
    between, found = _neighbours(range_m.T, ~missing.T)
    low, high = torch.minimum(*between[:2]), torch.maximum(*between[:2])
    smooth = found & (low > 0) & (high < _ONE_SURFACE * low) & _near(~missing.T)
    made &= ~(found & (high <= 0) & _near(~missing.T)).T
    usable = ~missing & made & (range_m > 0)
    error = torch.where(usable, range_m - made_m, 0.0)
    errors, _ = _neighbours(error.T, usable.T)
    moved = made_m + errors.first.lerp(errors.second, errors.share).T
    # A correction must not carry a return behind the sensor.
    moved = torch.where(_near(usable.T).T & (moved > 0), moved, made_m)
    ranges = torch.where(smooth.T, between.mean("inverse").T, moved)
    return torch.where(made, ranges, EMPTY_RANGE_M)


def range_error_m(first_m: Tensor, second_m: Tensor, pixels: Tensor | None = None) -> float:
    """Mean absolute difference, metres, over the pixels with a return in both range images.

    ``pixels`` ``(H, W)`` bool restricts the mean; NaN if no pixel counts.
    """
    both = (first_m > 0) & (second_m > 0)
    if pixels is not None:
        both = both & pixels
    return (first_m.double() - second_m.double()).abs()[both].mean().item()


class _Neighbours(NamedTuple):
    """Nearest known values on both sides of a pixel and its position between them, in [0, 1]."""

    first: Tensor
    second: Tensor
    share: Tensor

    def mean(self, how: Gaps) -> Tensor:
        nearest = torch.where(self.share <= 0.5, self.first, self.second)
        if how == "nearest":
            return nearest
        power = 1 if how == "linear" else -1
        mean = self.first.pow(power).lerp(self.second.pow(power), self.share).pow(power)
        return torch.where((self.first > 0) & (self.second > 0), mean, nearest)


def _neighbours(values: Tensor, known: Tensor) -> tuple[_Neighbours, Tensor]:
    """Known neighbours along the last axis (at an end the same one twice), and where any exists."""
    length = values.shape[-1]
    place = torch.arange(length).expand(values.shape)
    before = torch.where(known, place, -1).cummax(dim=-1).values
    after = torch.where(known, place, length).flip(-1).cummin(dim=-1).values.flip(-1)
    found = (before >= 0) | (after < length)
    before = torch.where(before >= 0, before, after).clamp(max=length - 1)
    after = torch.where(after < length, after, before)
    share = ((place - before).to(values) / (after - before).clamp(min=1)).clamp(0, 1)
    return _Neighbours(values.gather(-1, before), values.gather(-1, after), share), found


def _near(known: Tensor) -> Tensor:
    """Pixels within ``_NEAR_ROWS`` of a known one along the last axis."""
    near = known.clone()
    for step in range(1, _NEAR_ROWS + 1):
        near[..., step:] |= known[..., :-step]
        near[..., :-step] |= known[..., step:]
    return near
