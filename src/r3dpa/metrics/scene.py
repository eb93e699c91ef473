"""Protocol of an evaluation, and its scenes as the sensor of the protocol sees them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Self

import torch
from torch import Tensor

from r3dpa.geometry import EMPTY_RANGE_M, LidarSensor, SphericalProjection, points_of, range_image
from r3dpa.metrics.functional_bev import BEVGrid

Unprojection = Literal["corner", "centre"]
LIPLocCast = Literal["wrap", "clip"]


@dataclass(frozen=True)
class Protocol:
    """Preparation and number of the scenes that are compared.

    Source: ``evaluate.py`` of valeoai/R3DPA and its paper (ICRA 2026).

    Args:
        name: Name in results.
        unprojection: Point that stands for a pixel: its upper left corner or its centre.
        liploc_cast: Treatment of values beyond 8 bits in FLD's picture: ``wrap`` modulo 256, which
            makes empty pixels nearly white, or ``clip``, which makes them black.
        voxel_m: Edge of the voxels of FSVD and FPVD and of the cells of JSD, TV and MMD, metres.
        num_samples: Generated scenes that count.
        num_mmd_samples: Of these, for MMD.
        num_mmd_references: Real scans for MMD.
        sensor: Image size, field of view and range limits of all scenes.
    """

    name: str
    unprojection: Unprojection
    liploc_cast: LIPLocCast
    voxel_m: float = 0.05
    num_samples: int = 10_000
    num_mmd_samples: int = 2000
    num_mmd_references: int = 1000
    sensor: LidarSensor = LidarSensor()

    @property
    def projection(self) -> SphericalProjection:
        """Points to pixels and back."""
        return SphericalProjection(self.sensor)

    @property
    def grid(self) -> BEVGrid:
        """Cells seen from above."""
        return BEVGrid(cell_m=self.voxel_m)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Inverse of ``dataclasses.asdict``."""
        return cls(**{**values, "sensor": LidarSensor(**values["sensor"])})


#: Protocol of the published numbers.
PUBLISHED = Protocol("published", "corner", "wrap")
#: Points at pixel centres, and black pixels without a return.
DEFAULT = Protocol("default", "centre", "clip")
PROTOCOLS = {protocol.name: protocol for protocol in (DEFAULT, PUBLISHED)}


class EvaluationScene(NamedTuple):
    """A scene as a file or a generator gives it, or as :func:`through_sensor` makes it.

    Either points ``(P, 3)`` or ``(P, 4)`` x, y, z in metres and, if known, intensity, or a range
    image ``(H, W)`` in metres, not above 0 without a return, and its intensity, if known.
    """

    name: str  #: unique within its set; ``drive/frame`` for a scan of a recording
    points: Tensor | None
    range_m: Tensor | None = None
    intensity: Tensor | None = None


def through_sensor(scene: EvaluationScene, protocol: Protocol) -> EvaluationScene:
    """Return the scene as the sensor of the protocol would have seen it.

    Every scene becomes a range image, and its points become the points of the pixels: a real scan
    loses hidden returns and its points move onto rays, where generated ones lie. A range image is
    taken as it is; points given beside it are ignored. Points on pixel centres keep their pixels;
    points on corners may move to a neighbour by rounding (give the images then).

    Source: the official ``evaluate.py`` of valeoai/R3DPA passes real scans through range images.

    Returns:
        The scene with all fields: points ``(P, 3)`` and range ``(H, W)`` float32 on the CPU,
        ``EMPTY_RANGE_M`` without a return; the intensity ``(H, W)`` if it was known.

    Raises:
        ValueError: If the scene cannot be used; names it.
    """
    projection, sensor = protocol.projection, protocol.sensor
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
            intensity = torch.where(valid, intensity.detach().float().cpu(), 0.0)
            intensity = _finite(scene.name, "intensity", intensity)
    elif scene.points is not None:
        points = _finite(scene.name, "cloud", scene.points)
        if points.ndim != 2 or points.shape[1] not in (3, 4):
            raise ValueError(
                f"{scene.name}: points of shape {tuple(points.shape)}; give (P, 3) or (P, 4)"
            )
        values = points[:, 3:] if points.shape[1] == 4 else None
        range_m, image = range_image(points[:, :3], projection, values)
        intensity = None if image is None else image[0]
    else:
        raise ValueError(f"{scene.name}: has neither points nor a range image")
    if not (range_m > 0).any():
        raise ValueError(
            f"{scene.name}: no pixel of the range image lies within the sensor's range "
            f"{sensor.range_min_m:g}..{sensor.range_max_m:g} m; leave it out and report it, or "
            "check its unit"
        )
    points = points_of(range_m, projection, protocol.unprojection == "corner")
    return EvaluationScene(scene.name, points, range_m, intensity)


def usable_scenes(
    scenes: Iterable[EvaluationScene],
    protocol: Protocol,
    bad: list[str] | None = None,
    advice: str = "",
) -> Iterator[EvaluationScene]:
    """Yield scenes through the sensor that every metric can use; faults of others go to ``bad``.

    Raises:
        ValueError: Without ``bad``, at the first scene that cannot be used, with ``advice``.
    """
    for scene in scenes:
        try:
            seen = through_sensor(scene, protocol)
            assert seen.points is not None
            protocol.grid.points_inside(seen.points, seen.name)
        except ValueError as error:
            if bad is None:
                raise ValueError(f"{error}{advice}") from error
            bad.append(str(error))
        else:
            yield seen


def _finite(name: str, what: str, values: Tensor) -> Tensor:
    """Values as a float32 tensor on the CPU; arrays of numpy are taken too."""
    values = torch.as_tensor(values).detach().float().cpu()
    if broken := int((~values.isfinite()).sum()):
        raise ValueError(
            f"{name}: {what} holds {broken} NaN or infinite values; repair the generator, or leave "
            "the scene out and report it"
        )
    return values
