"""Faults of the sensor on recorded scans, in the manner of Robo3D."""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lidarsim.draws import generator_for
from lidarsim.recorded import RecordedScan
from lidarsim.rings import rings_of
from lidarsim.scan import EffectRecord
from lidarsim.sensors.view import angles_of
from lidarsim.weather import ADDED_CLASS, Seed, WeatheredScan, change_scan, kept_part

Kind = Literal[
    "missing_beams", "fewer_beams", "crosstalk", "incomplete_echo", "motion_blur",
    "shifted_extrinsics", "dropped_sectors",
]  # fmt: skip
#: Strength of severity 1, 2, 3, the greatest one, and its unit.
STRENGTHS: dict[str, tuple[tuple[float, float, float], float, str]] = {
    "missing_beams": ((0.25, 0.5, 0.75), 1, "of the beams"),  # 16, 32, 48 of 64
    "fewer_beams": ((0.25, 0.5, 0.75), 1, "of the beams"),
    "crosstalk": ((0.006, 0.008, 0.01), 1, "of the points"),
    "incomplete_echo": ((0.75, 0.85, 0.95), 1, "of the points of vehicles"),
    "motion_blur": ((0.2, 0.25, 0.3), 10, "m"),
    "shifted_extrinsics": ((1, 2, 4), 180, "degrees"),
    "dropped_sectors": ((30, 60, 120), 360, "degrees"),
}
#: Class of points that crosstalk has moved.
CROSSTALK_CLASS = ADDED_CLASS + 0xFF
_CROSSTALK_M = 3.0
_JITTER = (0.1, 0.1, 0.05)  # of single points, in units of the shift of the scan
_METRES_PER_DEGREE = 0.1
_NUM_SECTORS = 3
_LEAST_SURE = 0.5  # share of the points whose beam is sure
_LEAST_POINTS = 10  # of a class of vehicles
# Classes of KITTI-360 and of SemanticKITTI; only the latter has classes from 45 on.
_VEHICLES = tuple(range(26, 34))
_SEMANTIC_KITTI, _ITS_VEHICLES = 45, (10, 11, 13, 15, 16, 18, 20, 252, *range(256, 260))


@dataclass(frozen=True)
class Fault:
    """A fault of a given severity or strength.

    - ``missing_beams``: a share of the beams, by chance, has no return.
    - ``fewer_beams``: another sensor; evenly spread beams stay. A ``severity`` also drops every
      second shot, as Robo3D does; a ``strength`` keeps all shots.
    - ``crosstalk``: a share of the points is elsewhere, normal with 3 m, of ``CROSSTALK_CLASS``.
    - ``incomplete_echo``: a share of the points of each labelled class of vehicles is lost.
    - ``motion_blur``: the scan moves along each axis, normal, and its points by a tenth of that (z:
      a twentieth).
    - ``shifted_extrinsics``: a turn about a random axis, and 0.1 m per degree in some direction.
    - ``dropped_sectors``: three sectors, which together cover this angle, are dark.

    Robo3D draws missing beams with replacement, so that fewer are missing than it says, and adds
    crosstalk to intensities too. Source: Kong et al., "Robo3D" (ICCV 2023) and its code for the
    first five; the others are of our own measure.

    Args:
        kind: Which one.
        severity: 0 (none) to 3.
        strength: In place of the severity, in the unit of :data:`STRENGTHS`.

    Raises:
        ValueError: If the kind is unknown, or severity or strength are out of range.
    """

    kind: Kind
    severity: int = 2
    strength: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in STRENGTHS:
            raise ValueError(f"unknown fault {self.kind!r}; choose from {', '.join(STRENGTHS)}")
        _, most, unit = STRENGTHS[self.kind]
        if not isinstance(self.severity, Integral) or self.severity not in range(4):
            raise ValueError(f"severity must be 0, 1, 2 or 3, got {self.severity}")
        if not 0 <= self.amount <= most:
            raise ValueError(f"strength must lie in 0..{most} ({unit}), got {self.strength}")

    @property
    def amount(self) -> float:
        """Strength, given or of the severity."""
        levels = (0.0, *STRENGTHS[self.kind][0])
        return levels[self.severity] if self.strength is None else self.strength

    @property
    def _halves_shots(self) -> bool:
        return self.kind == "fewer_beams" and self.strength is None and self.severity > 0

    def apply(self, scan: Any, seed: Seed = 0) -> Any:
        """Return a scan, of any kind that :meth:`Weather.apply` takes, with this fault.

        Raises:
            ValueError: If the fault needs labels or beams that the scan does not show.
        """
        return change_scan(scan, lambda recorded: self._apply(recorded, seed))

    def _apply(self, scan: RecordedScan, seed: Seed) -> WeatheredScan:
        generator = generator_for(*(seed if isinstance(seed, tuple) else (seed,)), self.kind)
        points = scan.points
        is_return = np.any(points, axis=1)  # drivers write (0, 0, 0) for a shot without a return
        stays = np.ones(len(scan), dtype=bool)
        labels = None if scan.labels is None else scan.labels.copy()
        if not self.amount:
            pass
        elif self.kind in ("missing_beams", "fewer_beams"):
            stays = self._beams(scan, generator)
        elif self.kind == "incomplete_echo":
            stays = self._echoes(scan, generator)
        elif self.kind == "dropped_sectors":
            width, third = self.amount / 360 / _NUM_SECTORS, 1 / _NUM_SECTORS
            azimuth = angles_of(points)[1] % (2 * np.pi)
            turns = (azimuth / (2 * np.pi) + generator.random()) % 1
            start = generator.uniform(0, third - width, _NUM_SECTORS)
            sector = (turns / third).astype(int) % _NUM_SECTORS
            stays = (turns - sector * third - start[sector]) % 1 >= width
        elif self.kind == "crosstalk":
            returns = np.flatnonzero(is_return)
            hit = generator.choice(returns, round(self.amount * len(returns)), replace=False)
            points = points.copy()
            points[hit] += generator.normal(0, _CROSSTALK_M, (len(hit), 3)).astype(np.float32)
            if labels is not None:
                labels[hit] = CROSSTALK_CLASS
        elif self.kind == "motion_blur":
            jitter = generator.normal(0, _JITTER, points.shape) + generator.normal(size=3)
            points = (points + self.amount * jitter).astype(np.float32)
        else:
            vectors = generator.normal(size=(2, 3))
            axis, way = (vector / np.linalg.norm(vector) for vector in vectors)
            turned = Rotation.from_rotvec(np.radians(self.amount) * axis).apply(points)
            points = (turned + _METRES_PER_DEGREE * self.amount * way).astype(np.float32)
        points = np.where(is_return[:, None], points, np.float32(0))
        kept = np.flatnonzero(stays)
        lost = len(scan) - len(kept)
        moved = int((points != scan.points).any(axis=1).sum())
        how = f"{self.amount:g} {STRENGTHS[self.kind][2]}"
        if self._halves_shots:
            how += ", and every second shot"
        record = EffectRecord(self.kind, "ran" if self.amount else "not_called", how, lost + moved)
        changed = replace(scan, points=points, labels=labels)
        return kept_part(changed, kept, (record,), {self.kind: lost}, moved)

    def _beams(self, scan: RecordedScan, generator: np.random.Generator) -> NDArray[np.bool_]:
        rings = rings_of(scan)
        if rings.sure < _LEAST_SURE or rings.num_rings < 2:
            raise ValueError(
                f"{self.kind} needs the beam of each point, but only {rings.sure:.0%} of the "
                f"points are sure of one ({rings.num_rings} beams by {rings.how}): keep the order "
                "of the sensor, or store the column ring"
            )
        number = np.arange(rings.num_rings)
        kept = round((1 - self.amount) * rings.num_rings)
        is_empty = ~scan.points.any(axis=1)  # shots without a return have no beam
        if self.kind == "missing_beams":
            return is_empty | (generator.permutation(number) < kept)[rings.ring]
        chosen = (number + 1) * kept // rings.num_rings > number * kept // rings.num_rings
        stays = chosen[rings.ring]
        if self._halves_shots:
            stays &= rings.shot % 2 == 0
        return is_empty | stays

    def _echoes(self, scan: RecordedScan, generator: np.random.Generator) -> NDArray[np.bool_]:
        if scan.labels is None:
            raise ValueError("incomplete_echo acts on vehicles: it needs labels beside the scan")
        classes = scan.labels & 0xFFFF
        stays = np.ones(len(scan), dtype=bool)
        foreign = ((classes >= _SEMANTIC_KITTI) & (classes < ADDED_CLASS)).any()
        for number in _ITS_VEHICLES if foreign else _VEHICLES:
            points = np.flatnonzero(classes == number)
            if len(points) > _LEAST_POINTS:
                lost = int(self.amount * len(points))
                stays[generator.choice(points, lost, replace=False)] = False
        return stays
