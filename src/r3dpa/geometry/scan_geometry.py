"""Everything that turns a scan into network inputs, as one value that checkpoints can hold."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Self

from r3dpa.geometry.projection import Projection, RingProjection, SphericalProjection
from r3dpa.geometry.range_codec import RangeCodec
from r3dpa.geometry.sensor import LidarSensor

_PROJECTIONS = {"spherical": SphericalProjection, "rings": RingProjection}


@dataclass(frozen=True)
class ScanGeometry:
    """Projection, range encoding and feature-grid size of a data set.

    Args:
        projection: Points to pixels and back, with its sensor.
        codec: Metres to [-1, 1] and back.
        grid_size: Rows and columns of the feature grid.
    """

    projection: Projection
    codec: RangeCodec
    grid_size: tuple[int, int]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, as YAML and ``weights_only`` loading allow."""
        kind = next(k for k, v in _PROJECTIONS.items() if isinstance(self.projection, v))
        projection = {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in asdict(self.projection).items()
        }
        return {
            "projection": {"kind": kind, **projection},
            "codec": asdict(self.codec),
            "grid_size": list(self.grid_size),
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Inverse of :meth:`to_dict`.

        Raises:
            ValueError: If an entry is missing or unknown.
        """
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
