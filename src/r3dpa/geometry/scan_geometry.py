"""Projection, range encoding and grid size as one value that checkpoints store."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Self

import torch

from r3dpa.geometry.projection import Projection, RingProjection, SphericalProjection
from r3dpa.geometry.range_codec import RangeCodec
from r3dpa.geometry.sensor import LidarSensor

_PROJECTIONS = {"spherical": SphericalProjection, "rings": RingProjection}
_ROUNDING_M = 1e-3


@dataclass(frozen=True)
class ScanGeometry:
    """Projection, range encoding and feature-grid size of a data set.

    Args:
        projection: Points to pixels and back, with its sensor.
        codec: Metres to [-1, 1] and back.
        grid_size: Rows and columns of the feature grid.

    Raises:
        ValueError: If the codec ends before the farthest range of the sensor, or the grid does
            not divide the range image.
    """

    projection: Projection
    codec: RangeCodec
    grid_size: tuple[int, int]

    def __post_init__(self) -> None:
        sensor = self.projection.sensor
        sensor.cell_size(self.grid_size)
        farthest_m = self.codec.to_range(torch.ones(())).item()
        if farthest_m < sensor.range_max_m - _ROUNDING_M:
            raise ValueError(
                f"the range encoding ends at {farthest_m:.2f} m, but the sensor reports up to "
                f"{sensor.range_max_m:g} m: farther points would become a wall. Raise the scale of "
                f"the codec (linear: range_max_m, log2: log2(range_max_m + 1)) or lower range_max_m"
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, as YAML and ``weights_only`` loading allow."""
        return {
            "projection": projection_to_dict(self.projection),
            "codec": asdict(self.codec),
            "grid_size": list(self.grid_size),
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Inverse of :meth:`to_dict`; ValueError if an entry is missing or unknown."""
        try:
            arguments = dict(values["projection"])
            kind = _PROJECTIONS[arguments.pop("kind")]
            sensor = LidarSensor(**arguments.pop("sensor"))
            arguments = {k: tuple(v) if isinstance(v, list) else v for k, v in arguments.items()}
            return cls(
                kind(sensor=sensor, **arguments),
                RangeCodec(**values["codec"]),
                (int(values["grid_size"][0]), int(values["grid_size"][1])),
            )
        except (KeyError, TypeError, IndexError) as error:
            raise ValueError(f"not a scan geometry: {values!r} ({error!r})") from error


def projection_to_dict(projection: Projection) -> dict[str, Any]:
    """Kind and settings of a projection as plain numbers, strings and lists."""
    kind = next(k for k, v in _PROJECTIONS.items() if isinstance(projection, v))
    settings = {
        key: list(value) if isinstance(value, tuple) else value
        for key, value in asdict(projection).items()
    }
    return {"kind": kind, **settings}
