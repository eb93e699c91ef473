"""Missing parts of a range image: found, checked against the field of view, interpolated.

Letters: H beams, W columns, P points.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from r3dpa.geometry import (
    EMPTY_RANGE_M,
    Pixels,
    Projection,
    in_range,
    share_outside_view,
    view_limits_deg,
)
from r3dpa.geometry.sensor import angles_of
from r3dpa.scenes import MOST_OUTSIDE_VIEW

Interpolation = Literal["inverse", "linear", "nearest"]
# Shares of the field of view that a scan of the same sensor fills.
_LEAST_ROWS, _LEAST_COLUMNS = 0.5, 0.75
# Share of the returns with one right below: 0.76 or more of all beams, 0.52 of half of them.
_LEAST_DENSE = 0.6
_MOST_OUTSIDE_OF_ANOTHER = 0.6  # as MOST_OUTSIDE_VIEW, of scans of another sensor
_WIDEST_GAP_ROWS = 8  # between two beams of a sensor that has fewer
_ONE_SURFACE = 1.3  # ratio of ranges up to which two beams are taken to meet one surface


def check_view(
    points: Tensor, range_m: Tensor, projection: Projection, missing: Tensor | None = None
) -> None:
    """Refuse a scan that does not fill the field of view that a model was trained on.

    Args:
        points: ``(P, 3)`` metres.
        range_m: ``(H, W)`` range image of the points.
        projection: Projection of the model.
        missing: ``(H, W)`` bool, pixels that need not be filled. The scan may then be of another
            sensor, with three fifths of the points beyond the field of view.

    Raises:
        ValueError: If fewer than half of the rows or three quarters of the columns hold a return,
            fewer than three fifths of the returns have one in the pixel below, as with half of the
            beams, or more than a fifth of the points lie above or below the field of view.
    """
    sensor = projection.sensor
    lowest, highest = view_limits_deg(projection)
    view = f"{lowest:.1f} to {highest:.1f} degrees above the horizon"
    outside = share_outside_view(points, projection)
    if outside > (MOST_OUTSIDE_VIEW if missing is None else _MOST_OUTSIDE_OF_ANOTHER):
        inclination = angles_of(points[in_range(points, sensor)])[0].rad2deg()
        low, high = inclination.quantile(torch.tensor([0.01, 0.99]).double()).tolist()
        raise ValueError(
            f"{outside:.0%} of the points lie outside the field of view of the checkpoint, {view}: "
            f"the scan reaches from {low:.1f} to {high:.1f}. It is of another sensor, or not in "
            "its frame (x forward, z up, metres)"
        )
    expected = torch.ones_like(range_m, dtype=torch.bool) if missing is None else ~missing
    returns = (range_m > 0) & expected
    for name, axis, least in (("beams", 1, _LEAST_ROWS), ("columns", 0, _LEAST_COLUMNS)):
        required = expected.any(dim=axis)
        share = returns.any(dim=axis)[required].double().mean().item()
        if share < least:
            raise ValueError(
                f"the scan fills {share:.0%} of the {int(required.sum())} {name} that the "
                f"checkpoint was trained on ({sensor.beams} x {sensor.columns} pixels, {view}): it "
                "is of another sensor, a part of a scan, which `r3dpa edit complete` fills, or not "
                "in its own frame"
            )
    above = returns[:-1] & expected[1:]
    dense = returns[1:][above].double().mean().item()
    # Where beams are missing between the others, hardly any pixel below a return is expected.
    if above.sum() > returns.sum() / 2 and dense < _LEAST_DENSE:
        raise ValueError(
            f"only {dense:.0%} of the returns have another one right below them, not "
            f"{_LEAST_DENSE:.0%} or more as in scans of {sensor.beams} beams: it has fewer beams "
            "than the checkpoint was trained on, which `r3dpa edit complete --empty_beams` fills, "
            "or was thinned out"
        )


def interpolate_gaps(range_m: Tensor, missing: Tensor, how: Interpolation = "inverse") -> Tensor:
    """Interpolate the missing pixels of a range image: between beams, else between columns.

    Args:
        range_m: ``(H, W)`` metres, -1 without a return.
        missing: ``(H, W)`` bool; all other pixels keep their values.
        how: ``inverse`` is linear in 1 / range between two returns, which is exact on planes up to
            the curvature of the angles; ``linear`` is linear in range. ``nearest`` copies the
            nearest pixel, the upper or left one at a tie, as the others do where a neighbour has
            no return.
    """
    return torch.where(missing, _neighbours(range_m, missing, how).interpolate(how), range_m)


def blend_completion(generated_m: Tensor, range_m: Tensor, missing: Tensor) -> Tensor:
    """Fill missing pixels by interpolation on surfaces and by a generated image at edges.

    The generated image says where returns are. Their range is interpolated (``inverse``) where the
    two known neighbours lie on one surface. At edges and in front of holes it is the mean of the
    interpolated and the generated range, which is first limited to the ranges of the neighbours.
    Either range stands alone where the other image has no return.

    Args:
        generated_m: ``(H, W)`` metres, not above 0 without a return.
        range_m: ``(H, W)`` metres, the scan; not read where pixels are missing.
        missing: ``(H, W)`` bool.

    Returns:
        ``(H, W)``, -1 without a return; pixels that are not missing keep their values.
    """
    neighbours = _neighbours(range_m, missing, "inverse")
    interpolated = neighbours.interpolate("inverse")
    near = torch.minimum(neighbours.first, neighbours.second)
    far = torch.maximum(neighbours.first, neighbours.second)
    between_returns = near > 0
    one_surface = between_returns & (far < _ONE_SURFACE * near)
    limited = torch.where(between_returns, generated_m.clamp(near, far), generated_m)
    blended = torch.where(between_returns, (interpolated + limited) / 2, interpolated)
    filled = torch.where(one_surface, interpolated, blended)
    filled = torch.where(interpolated > 0, filled, generated_m)
    filled = torch.where(generated_m > 0, filled, EMPTY_RANGE_M)
    return torch.where(missing, filled, range_m)


def median_draw(draws: Pixels) -> Pixels:
    """Pixels ``(H, W)`` with a return in at least half of the draws ``(K, H, W)``.

    They have the range, intensity and class of the draw with the median range.
    """
    returns = draws.range_m > 0
    median = torch.where(returns, draws.range_m, torch.nan).nanmedian(dim=0)
    is_return = 2 * returns.sum(dim=0) >= len(returns)
    range_m = torch.where(is_return, median.values, EMPTY_RANGE_M)
    intensity, classes = (
        None if values is None else values.gather(0, median.indices[None])[0]
        for values in (draws.intensity, draws.classes)
    )
    return Pixels(range_m, intensity, classes)


def unseen_pixels(range_m: Tensor) -> Tensor:
    """Pixels ``(H, W)`` bool that the beams of a scan do not reach.

    These are rows without a return, and empty pixels between two returns of their column that are
    at most 8 rows apart, since the beams of another sensor need not lie in one row each.
    """
    returns = range_m > 0
    row = torch.arange(len(range_m))[:, None].expand_as(range_m)
    above = torch.where(returns, row, -_WIDEST_GAP_ROWS).cummax(dim=0).values
    below = torch.where(returns, row, len(range_m) + _WIDEST_GAP_ROWS)
    below = below.flip(0).cummin(dim=0).values.flip(0)
    in_narrow_gap = below - above <= _WIDEST_GAP_ROWS
    empty_row = ~returns.any(dim=1, keepdim=True)
    return ~returns & (in_narrow_gap | empty_row)


def range_error_m(first_m: Tensor, second_m: Tensor, pixels: Tensor | None = None) -> float:
    """Mean absolute difference, metres, over the pixels with a return in both range images.

    ``pixels`` ``(H, W)`` bool restricts the mean; NaN if no pixel counts.
    """
    both = (first_m > 0) & (second_m > 0)
    if pixels is not None:
        both = both & pixels
    return (first_m.double() - second_m.double()).abs()[both].mean().item()


class _Neighbours(NamedTuple):
    """Nearest known values on both sides of a pixel, and its place between them, in [0, 1]."""

    first: Tensor
    second: Tensor
    share: Tensor

    def interpolate(self, how: Interpolation) -> Tensor:
        nearest = torch.where(self.share <= 0.5, self.first, self.second)
        if how == "nearest":
            return nearest
        power = 1 if how == "linear" else -1
        mean = self.first.pow(power).lerp(self.second.pow(power), self.share).pow(power)
        return torch.where((self.first > 0) & (self.second > 0), mean, nearest)


def _neighbours(range_m: Tensor, missing: Tensor, how: Interpolation) -> _Neighbours:
    """Known neighbours above and below, or left and right where the column has none.

    Columns wrap around. Neighbours to the left and right may be interpolated ones.
    """
    vertical, has_known = _neighbours_along_rows(range_m.T, ~missing.T)
    has_known = has_known.T
    vertical = _Neighbours(vertical.first.T, vertical.second.T, vertical.share.T)
    range_m = torch.where(missing & has_known, vertical.interpolate(how), range_m)
    width = range_m.shape[1]
    known = (~missing | has_known).repeat(1, 3)
    horizontal, _ = _neighbours_along_rows(range_m.repeat(1, 3), known)
    middle = slice(width, 2 * width)
    return _Neighbours(
        torch.where(has_known, vertical.first, horizontal.first[:, middle]),
        torch.where(has_known, vertical.second, horizontal.second[:, middle]),
        torch.where(has_known, vertical.share, horizontal.share[:, middle]),
    )


def _neighbours_along_rows(values: Tensor, known: Tensor) -> tuple[_Neighbours, Tensor]:
    """Known neighbours along the last axis, at an end one twice, and where there is any."""
    length = values.shape[-1]
    place = torch.arange(length).expand(values.shape)
    before = torch.where(known, place, -1).cummax(dim=-1).values
    after = torch.where(known, place, length).flip(-1).cummin(dim=-1).values.flip(-1)
    has_known = (before >= 0) | (after < length)
    before = torch.where(before >= 0, before, after).clamp(max=length - 1)
    after = torch.where(after < length, after, before)
    share = ((place - before).to(values) / (after - before).clamp(min=1)).clamp(0, 1)
    return _Neighbours(values.gather(-1, before), values.gather(-1, after), share), has_known
