"""What an evaluation fixes, so that its numbers compare with those of others."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, Self, get_args

from r3dpa.geometry import LidarSensor, SphericalProjection
from r3dpa.metrics.functional_bev import MAX_SIDE, BEVGrid

Unprojection = Literal["corner", "centre"]
LIPLocCast = Literal["wrap", "clip"]


@dataclass(frozen=True)
class Protocol:
    """How scenes are prepared, and how many of them are compared.

    Source: ``evaluate.py`` of valeoai/R3DPA and its paper (ICRA 2026).

    Args:
        name: Under which results report it.
        unprojection: Which point of a pixel stands for it: its upper left corner or its centre.
        liploc_cast: How FLD's picture treats what does not fit into 8 bits: ``wrap`` modulo 256, so
            that empty pixels are nearly white, or ``clip``, so that they are black.
        voxel_m: Edge of the voxels of FSVD and FPVD and of the cells of JSD, TV and MMD, metres.
        num_samples: Generated scenes that count.
        num_mmd_samples: Of these, for MMD.
        num_mmd_references: Real scans for MMD.
        sensor: Image size, field of view and range limits of all scenes.

    Raises:
        ValueError: If a field is not as above.
    """

    name: str
    unprojection: Unprojection
    liploc_cast: LIPLocCast
    voxel_m: float = 0.05
    num_samples: int = 10_000
    num_mmd_samples: int = 2000
    num_mmd_references: int = 1000
    sensor: LidarSensor = LidarSensor()

    def __post_init__(self) -> None:
        """Check the fields, since protocols also come from files."""
        for key, kinds in (("unprojection", Unprojection), ("liploc_cast", LIPLocCast)):
            if getattr(self, key) not in get_args(kinds):
                given = getattr(self, key)
                raise ValueError(f"{key} must be one of {', '.join(get_args(kinds))}, got {given}")
        for key in ("voxel_m", "num_samples", "num_mmd_samples", "num_mmd_references"):
            if not getattr(self, key) > 0:
                raise ValueError(f"{key} must be above 0, got {getattr(self, key)}")
        side, (low, high) = max(self.grid.shape), self.grid.x_m
        if side > MAX_SIDE:  # here, and not by MMD at the end of an evaluation
            raise ValueError(
                f"voxel_m = {self.voxel_m} makes a grid of {side} cells along a side, but MMD can "
                f"match {MAX_SIDE}; give at least {(high - low) / MAX_SIDE:.4f}"
            )

    @property
    def corner(self) -> bool:
        """Whether pixels stand for their corners."""
        return self.unprojection == "corner"

    @property
    def projection(self) -> SphericalProjection:
        """Points to pixels and back."""
        return SphericalProjection(self.sensor)

    @property
    def grid(self) -> BEVGrid:
        """Cells seen from above."""
        return BEVGrid(cell_m=self.voxel_m)

    def with_sensor(self, sensor: LidarSensor) -> Self:
        """The same protocol for another sensor."""
        return replace(self, sensor=sensor)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Inverse of :meth:`to_dict`.

        Raises:
            ValueError: If an entry is missing, unknown or not as it must be.
        """
        try:
            return cls(**{**values, "sensor": LidarSensor(**values["sensor"])})
        except (KeyError, TypeError) as error:
            raise ValueError(f"not a protocol: {values!r} ({error!r})") from error


#: That of the published numbers.
PUBLISHED = Protocol("published", "corner", "wrap")
#: Points where a pixel looks, and pictures that show nothing as black.
DEFAULT = Protocol("default", "centre", "clip")
PROTOCOLS = {protocol.name: protocol for protocol in (DEFAULT, PUBLISHED)}
