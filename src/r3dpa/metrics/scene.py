"""One scene of an evaluation, real or generated, and the one way that all of them take."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from r3dpa.geometry import EMPTY_RANGE_M, in_range, points_of, range_image
from r3dpa.metrics.protocol import Protocol


class EvaluationScene(NamedTuple):
    """A scene as a file or a generator gives it, or as :func:`through_sensor` makes it.

    Letters: P points, H x W range image.

    Args:
        name: Unique within its set; ``drive/frame`` for a scan of a recording.
        points: ``(P, 3)`` or ``(P, 4)`` x, y, z in metres and, where known, intensity. None where
            there is a range image.
        range_m: ``(H, W)`` metres, not above 0 without a return. None where there are points.
        intensity: ``(H, W)`` beside ``range_m``, None where unknown.
    """

    name: str
    points: Tensor | None
    range_m: Tensor | None = None
    intensity: Tensor | None = None


def through_sensor(scene: EvaluationScene, protocol: Protocol) -> EvaluationScene:
    """The scene as the sensor of the protocol would have seen it.

    Every scene becomes a range image, and its points are those of the pixels: a real scan loses
    the returns behind others and its points move onto rays, as those of generated images are from
    the start. Where there is a range image, it is taken as it is and points beside it are not
    used. Else the points are projected; points that already stand for pixels keep them if they lie
    on centres, but not on corners, where rounding may move them next door (give the images then).

    Source: the official ``evaluate.py`` of valeoai/R3DPA passes real scans through range images.

    Args:
        scene: Points, or a range image of the sensor's size.
        protocol: Its sensor, and which point of a pixel stands for it.

    Returns:
        The scene with all fields: points ``(P, 3)`` and range ``(H, W)`` float32 on the CPU,
        ``EMPTY_RANGE_M`` without a return; the intensity ``(H, W)`` if it was known.

    Raises:
        ValueError: If there are neither points nor image, values are NaN or infinite, a shape is
            wrong, or nothing lies within the range limits; the message names the scene.
    """
    projection, sensor = protocol.projection, protocol.sensor
    limits = f"{sensor.range_min_m:g}..{sensor.range_max_m:g} m"
    if scene.range_m is not None:
        range_m = _finite(scene.name, "range image", scene.range_m)
        if range_m.shape != (sensor.beams, sensor.columns):
            raise ValueError(
                f"{scene.name}: range image of shape {tuple(range_m.shape)}, but the sensor of the "
                f"protocol has {sensor.beams} x {sensor.columns}; give it as points, or compare "
                "with a reference for this sensor"
            )
        valid = (range_m > sensor.range_min_m) & (range_m < sensor.range_max_m)
        range_m, intensity = torch.where(valid, range_m, EMPTY_RANGE_M), scene.intensity
        if intensity is not None:
            if intensity.shape != range_m.shape:
                raise ValueError(
                    f"{scene.name}: intensity of shape {tuple(intensity.shape)} beside a range "
                    f"image of {tuple(range_m.shape)}"
                )
            kept = torch.where(valid, intensity.detach().float().cpu(), 0.0)
            intensity = _finite(scene.name, "intensity", kept)
    elif scene.points is not None:
        points = _finite(scene.name, "cloud", scene.points)
        if points.ndim != 2 or points.shape[1] not in (3, 4):
            raise ValueError(
                f"{scene.name}: points of shape {tuple(points.shape)}; give (P, 3) or (P, 4)"
            )
        if not in_range(points[:, :3], sensor).any():
            raise ValueError(
                f"{scene.name}: none of {len(points)} points lies within the sensor's range "
                f"{limits}; leave the cloud out and say so, or check its unit"
            )
        values = points[:, 3:] if points.shape[1] == 4 else None
        range_m, image = range_image(points[:, :3], projection, values)
        intensity = None if image is None else image[0]
    else:
        raise ValueError(f"{scene.name}: has neither points nor a range image")
    if not (range_m > 0).any():
        raise ValueError(
            f"{scene.name}: no pixel of the range image lies within the sensor's range {limits}; "
            "leave it out and say so, or check its unit"
        )
    points = points_of(range_m, projection, protocol.corner)
    return EvaluationScene(scene.name, points, range_m, intensity)


def usable_scenes(
    scenes: Iterable[EvaluationScene],
    protocol: Protocol,
    bad: list[str] | None = None,
    advice: str = "",
) -> Iterator[EvaluationScene]:
    """Scenes through the sensor, as long as every metric can use them.

    Raises:
        ValueError: As :func:`through_sensor`, or if nothing lies on the grid seen from above.
    """
    for scene in scenes:
        try:
            seen = through_sensor(scene, protocol)
            assert seen.points is not None
            protocol.grid.kept(seen.points, seen.name)
        except ValueError as error:
            if bad is None:
                raise ValueError(f"{error}{advice}") from error
            bad.append(str(error))
        else:
            yield seen


def _finite(name: str, what: str, values: Tensor) -> Tensor:
    """Values as float32 on the CPU."""
    values = values.detach().float().cpu()
    broken = int((~values.isfinite()).sum())
    if broken:
        raise ValueError(
            f"{name}: {what} holds {broken} NaN or infinite values; repair the generator, or leave "
            "the scene out and say so"
        )
    return values
