"""One row per laser ring, for scans that are stored ring after ring.

Letters: B batch, P points, H beams, W columns, R rings found.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from lidarsim import ring_order
from lidarsim.ring_order import not_in_ring_order
from lidarsim.sensors.view import LidarSensor
from r3dpa.geometry.sensor import (
    angles_of,
    check_points,
    column_azimuths,
    column_of,
    range_of,
)

_OUT_OF_PLACE_SHARE = 1 / 8  # of the field of view; 1/2 where the lowest ring comes first


@dataclass(frozen=True)
class RingProjection:
    """One row per laser ring ("scan unfolding") for scans stored ring after ring.

    The lasers of a real sensor neither start at one point nor have one pitch, so that rows of
    equal pitch leave many pixels empty; one row per laser fills them. The ring of a point
    follows from its place in the file: the highest ring comes first, azimuth grows and each
    ring starts at azimuth 0, as in KITTI. Columns as in :class:`SphericalProjection`. A
    point clipped off the vertical field of view cannot exist here; the inclination limits of
    the sensor only tell scans in ring order from others.

    Source: Triess et al., "Scan-based Semantic Segmentation of LiDAR Point Clouds" (IV 2020).

    Args:
        sensor: Image size and range limits.
        ring_inclinations_deg: H inclinations, first row first, degrees above the horizon; see
            :meth:`fit`.
        legacy_rows: Count rings from the bottom row, each from where the quadrant falls from the
            last to the first, as R2DM and R2Flow do; see :func:`unfolded_rows`.
        legacy_hiding: See :class:`r3dpa.geometry.SphericalProjection`.

    Example:
        >>> projection = RingProjection(LidarSensor(beams=2), (1.0, -1.0))
        >>> inclination, azimuth = projection.ray_angles()
        >>> inclination.rad2deg().tolist(), len(azimuth)
        ([1.0, -1.0], 1024)
    """

    sensor: LidarSensor
    ring_inclinations_deg: tuple[float, ...]
    legacy_rows: bool = False
    legacy_hiding: bool = False

    def __post_init__(self) -> None:
        # A list, as YAML gives it, would not be hashable.
        object.__setattr__(self, "ring_inclinations_deg", tuple(self.ring_inclinations_deg))
        inclinations = self.ring_inclinations_deg
        inside = all(-90.0 <= angle <= 90.0 for angle in inclinations)
        if len(inclinations) != self.sensor.beams or not inside:
            raise ValueError(
                f"a sensor of {self.sensor.beams} beams needs as many ring inclinations in "
                f"[-90, 90] degrees, got {len(inclinations)}: {inclinations}"
            )

    @classmethod
    def fit(cls, scans: Iterable[Tensor], sensor: LidarSensor) -> Self:
        """Projection whose ring inclinations are the medians measured in real scans.

        Scans that show another number of rings than H (a laser without any return) are left out.

        Args:
            scans: Each ``(P, 3)`` metres, points in the order of the file.
            sensor: Image size, range limits and field of view.
        """
        measured: list[list[Tensor]] = [[] for _ in range(sensor.beams)]
        counts_seen = []
        for scan in scans:
            inclination, azimuth = angles_of(scan[_is_return(scan, sensor)])
            ring, num_rings = rings_in_order(inclination, azimuth, sensor)
            counts_seen.append(num_rings)
            if num_rings == sensor.beams:
                for index, values in enumerate(measured):
                    values.append(inclination[ring == index])
        if not measured[0]:
            raise ValueError(
                f"no scan shows the {sensor.beams} rings of the sensor; rings found per scan: "
                f"{counts_seen}. Give more scans, or a sensor with another number of beams"
            )
        medians = torch.stack([torch.cat(values).median() for values in measured])
        if (medians.diff() >= 0).any():
            raise not_in_ring_order("the inclination does not fall from ring to ring", sensor)
        return cls(sensor, tuple(medians.rad2deg().tolist()))

    def pixel_of(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Row and column of the pixel that each point of whole scans falls into.

        Where fewer than H rings are found they are matched in order to the known inclinations;
        fewer than H returns go to the nearest inclinations one by one.

        Args:
            points: ``(P, 3)`` or ``(B, P, 3)`` metres, each scan whole and in the order of the
                file. Points that are not finite (padding) or too near get pixel (0, 0).

        Returns:
            ``(row, column)``, each ``(P,)`` or ``(B, P)`` int64, in ``[0, H)`` and ``[0, W)``.
        """
        if points.ndim == 3:
            rows, columns = zip(*map(self.pixel_of, points), strict=True)
            return torch.stack(rows), torch.stack(columns)
        if self.legacy_rows:
            column = column_of(angles_of(points)[1], self.sensor.columns)
            return unfolded_rows(points, self.sensor.beams), column
        is_return = _is_return(points, self.sensor)
        inclination, azimuth = angles_of(points[is_return])
        row = torch.zeros(len(points), dtype=torch.int64, device=points.device)
        column = torch.zeros_like(row)
        column[is_return] = column_of(azimuth, self.sensor.columns)
        row[is_return] = self._beam_of(inclination, azimuth)
        return row, column

    def ray_angles(self, corner: bool = False) -> tuple[Tensor, Tensor]:
        """Inclination ``(H,)`` and azimuth ``(W,)``, radians; ``corner``: left column borders."""
        return self._inclinations(), column_azimuths(self.sensor.columns, corner)

    def column_order(self) -> Tensor:
        """Columns ``(W,)`` int64 in the order in which a scan lists the points of a ring."""
        return (column_azimuths(self.sensor.columns, corner=False) % (2 * math.pi)).argsort()

    def _beam_of(self, inclination: Tensor, azimuth: Tensor) -> Tensor:
        beams, known = self.sensor.beams, self._inclinations()
        if len(inclination) < beams:  # too few for turns of the azimuth to show
            return (inclination.unsqueeze(-1) - known.to(inclination.device)).abs().argmin(dim=-1)
        ring, num_rings = rings_in_order(inclination, azimuth, self.sensor)
        if num_rings > beams:
            raise ValueError(
                f"the scan shows {num_rings} rings but the sensor has {beams} beams; "
                "check that the scan is complete and the sensor is the right one"
            )
        measured = mean_per_ring(inclination, ring, num_rings).cpu()
        beam = match_in_order(measured, known)
        out_of_place = (measured - known[beam]).abs().median()
        if out_of_place > _OUT_OF_PLACE_SHARE * self.sensor.field_of_view_rad:
            reason = f"rings lie {out_of_place.rad2deg():.1f} degrees from the beam of their place"
            raise not_in_ring_order(reason, self.sensor)
        return beam.to(ring.device)[ring]

    def _inclinations(self) -> Tensor:
        return torch.tensor(self.ring_inclinations_deg, dtype=torch.float64).deg2rad()


def rings_in_order(inclination: Tensor, azimuth: Tensor, sensor: LidarSensor) -> tuple[Tensor, int]:
    """Ring ``(P,)`` of each return and the number of rings, see :mod:`lidarsim.ring_order`."""
    angles = inclination.cpu().numpy(), azimuth.cpu().numpy()
    ring, num_rings = ring_order.rings_in_order(*angles, sensor)
    return torch.from_numpy(ring).to(inclination.device), num_rings


def unfolded_rows(points: Tensor, beams: int) -> Tensor:
    """Row ``(P,)`` int64 of points ``(P, 3)`` in the released code of R2DM and R2Flow.

    A ring starts where the quadrant falls from the fourth to the first, the point before the first
    being the last. The last ring has row H - 1, those before it the rows above; one ring too many
    wraps to the bottom, further ones and points before the first start are in row 0.
    """
    x, y = points[:, 0], points[:, 1]
    quadrant = torch.where(y >= 0, (x < 0).long(), 3 - (x < 0).long())
    ring = (quadrant.roll(1) - quadrant == 3).long().cumsum(0)
    row = ring - ring[-1:] + beams - 1
    wraps = (row == -1) & (ring > 0)
    return torch.where(wraps, beams - 1, row.clamp(min=0).where(ring > 0, 0))


def match_in_order(measured: Tensor, known: Tensor) -> Tensor:
    """Beam of each measured ring: the order-keeping choice with the least sum of differences.

    ``measured`` is ``(R,)`` and ``known`` ``(H,)``, radians, R <= H; the result is ``(R,)`` int64,
    strictly increasing.
    """
    costs = (measured.unsqueeze(1) - known.unsqueeze(0)).abs()
    total, choices = costs[0], []
    for cost in costs[1:]:
        best_before, choice = torch.cummin(total[:-1], dim=0)
        total = torch.cat([cost[:1] + math.inf, cost[1:] + best_before])
        choices.append(choice)
    beams = [int(total.argmin())]
    for choice in reversed(choices):
        beams.append(int(choice[beams[-1] - 1]))
    return torch.tensor(beams[::-1])


def mean_per_ring(values: Tensor, ring: Tensor, num_rings: int) -> Tensor:
    """Mean ``(R,)`` of values ``(P,)`` per ring; every ring in ``[0, R)`` has a return."""
    sums = values.new_zeros(num_rings).index_add(0, ring, values)
    return sums / torch.bincount(ring, minlength=num_rings)


def _is_return(points: Tensor, sensor: LidarSensor) -> Tensor:
    """Points other than NaN padding and the dummies at the origin that files hold."""
    check_points(points)
    distance = range_of(points)
    return distance.isfinite() & (distance > sensor.range_min_m)
