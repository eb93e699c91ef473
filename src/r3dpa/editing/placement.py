"""Placement of an object: what a solver draws in front of its box is moved into the box.

Letters: B batch, H beams, W columns, ``...`` axes of the latents.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from r3dpa.flow.interpolant import Interpolant
from r3dpa.flow.solvers import AfterStep, Velocity
from r3dpa.flow.times import batch_time, per_sample

_MARGIN_M = 0.2  # what is this little in front of the box counts as in it
# Share of the pixels in front of the box that end at its near side or behind it.
_MOVED_SHARE = 0.8
_FIRST_TIME, _LAST_TIME = 0.95, 0.2


def move_behind(range_m: Tensor, front_m: Tensor) -> Tensor:
    """Move what stands in front of a box away from the sensor until it stands in the box.

    One factor per image, with which most of the moved pixels reach the box, keeps the shape of what
    is moved; pixels that are still in front of the box get the range of its near side.

    Args:
        range_m: ``(B, H, W)`` metres, not above 0 without a return.
        front_m: ``(H, W)`` metres of the near side of the box, 0 outside, see
            :func:`r3dpa.editing.regions.box3d_front_m`.

    Returns:
        ``(B, H, W)`` metres; images with nothing in front of the box are unchanged.
    """
    in_front = (range_m > 0) & (range_m < front_m - _MARGIN_M)
    moved = []
    for image, nearer in zip(range_m, in_front, strict=True):
        if nearer.any():
            factor = (front_m / image)[nearer].quantile(_MOVED_SHARE)
            image = torch.where(nearer, torch.maximum(image * factor, front_m), image)
        moved.append(image)
    return torch.stack(moved)


def is_corrected(time: float) -> bool:
    """Whether a step to a time in [0, 1] is corrected.

    The first estimates of the data are blurs, and the last steps draw details.
    """
    return _LAST_TIME <= time <= _FIRST_TIME


def correct_data(
    velocity: Velocity, correct: Callable[[Tensor], Tensor], interpolant: Interpolant
) -> AfterStep:
    """Return a solver hook that corrects the data that a state will become.

    After a step to time t, the data is estimated from the velocity, and the state moves with the
    corrected estimate while its noise stays::

        x + alpha(t) (correct(data) - data)

    Steps are corrected at the times of :func:`is_corrected`, at the cost of one evaluation each.

    Source: as in projected diffusion (Christopher et al. 2024), with a correction in place of the
    projection.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``.
        correct: Estimated data ``(B, ...)`` to corrected data.
        interpolant: Path of the velocity.
    """

    def after_step(x: Tensor, time: float, index: int) -> Tensor:
        if not is_corrected(time):
            return x
        times = batch_time(time, x)
        data = interpolant.denoise(velocity(x, times), x, times)
        alpha = interpolant.coefficients(per_sample(times, x)).alpha
        return x + alpha * (correct(data) - data)

    return after_step
