"""Metres to the [-1, 1] of the networks and back; projection, codec and grid size as one value."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple, Self

import torch
from torch import Tensor

from lidarsim.sensors.view import LidarSensor
from r3dpa.geometry.beams import BeamProjection
from r3dpa.geometry.projection import (
    Projection,
    RingProjection,
    SphericalProjection,
    range_image,
)
from r3dpa.geometry.semantics import NUM_CLASSES, UNKNOWN_CLASS, classes_of
from r3dpa.geometry.sensor import EMPTY_RANGE_M

_PROJECTIONS = {
    "spherical": SphericalProjection,
    "rings": RingProjection,
    "beams": BeamProjection,
}
_ROUNDING_M = 1e-3
_LIKELY_RETURN = 0.7
_LOGIT_SCALE = 1.3  # reconstructions of r3dpa-s then have as many returns as their 120 scans
_DEFAULT_SCALES = {"linear": 56.0, "log2": 5.84, "inverse": 1.45}
_LOG_OFFSET_M = 1e-4
_LEAST_VALID_M = 1 / 255  # one grey level of a metre in the official 8-bit pictures
_THRESHOLD_MARGIN = 1e-6


class Pixels(NamedTuple):
    """What is known of the pixels of scans, each ``(..., H, W)``; None where it is not.

    ``range_m`` metres, -1 without a return; ``intensity`` in [0, 1], 0 without a return;
    ``classes`` int64 numbers of :data:`r3dpa.geometry.SEMANTIC_CLASSES`, -1 without a return or a
    label.
    """

    range_m: Tensor
    intensity: Tensor | None = None
    classes: Tensor | None = None


def project_pixels(points: Tensor, projection: Projection, labels: Tensor | None = None) -> Pixels:
    """Range and, where they are given, intensity and class of the nearest return in each pixel.

    Args:
        points: ``(P, 3)`` x, y, z in metres, or ``(P, 4)`` with the intensity.
        projection: Which pixel a point belongs to.
        labels: ``(P,)`` integers, KITTI-360 class in the lower 16 bits.

    Raises:
        ValueError: If the number of labels is not the number of points.
    """
    if labels is not None and labels.shape != points.shape[:1]:
        raise ValueError(
            f"labels must be ({len(points)},), one per point, got shape {tuple(labels.shape)}"
        )
    values = points[:, 3:4]
    with_intensity = values.shape[1] == 1
    if labels is not None:
        known = classes_of(labels & 0xFFFF) - UNKNOWN_CLASS  # 0 without a return
        values = torch.cat([values, known[:, None].to(values)], dim=1)
    range_m, image = range_image(points[:, :3], projection, values)
    assert image is not None
    intensity = image[0] if with_intensity else None
    return Pixels(range_m, intensity, None if labels is None else image[-1].long() + UNKNOWN_CLASS)


@dataclass(frozen=True)
class RangeCodec:
    """Range in metres to an image in [-1, 1] and back.

    Formulas, with range d in metres::

        linear  image = 2 * d / scale - 1
        log2    image = 2 * log2(d + 1 + offset) / scale - 1
        inverse image = 2 * scale / d - 1

    all clipped to [-1, 1]; a pixel without a return is -1 or counts as d = 0. With
    ``return_channel`` a second channel is 1 at returns and -1 at empty pixels, so that a decoder
    does not blur the border between the two into ghost points. With ``reflectance`` the second
    channel is the reflectance of the returns instead, mapped from [0, 1] to [-1, 1], and -1
    without a return.

    After range and return there may be two further channels: with ``intensity_channel`` the
    intensity, from [0, 1] to [-1, 1]; with ``num_classes`` the number of the class of a return, see
    :data:`r3dpa.geometry.SEMANTIC_CLASSES`, which is not scaled. Both are -1 without a return, and
    the class also where the return has none.

    Source: the two data configurations of valeoai/R3DPA. Its inverse of the logarithm leaves
    the 1e-4 m out; ``legacy_inverse`` does so too, for published numbers. R2DM and R2Flow: ``log2``
    with scale ``log2(81)`` and offset 0, or ``inverse``, both with ``reflectance``.

    Args:
        encoding: ``linear``, ``log2`` or ``inverse``.
        scale: Number in the formula; 56, 5.84 or 1.45 where None.
        legacy_inverse: Return ranges that are 1e-4 m too long from a ``log2`` image.
        return_channel: Images have a second channel, whose sign says where returns are.
        reflectance: Images have a second channel of reflectance.
        offset_m: Offset of ``log2``, metres.
        intensity_channel: Images have a channel of intensity; needs ``return_channel``.
        num_classes: Number of semantic classes, of which images have a channel; 0 for none. Needs
            ``return_channel``.

    Example:
        >>> codec = RangeCodec("linear", scale=56.0)
        >>> image = codec.to_image(torch.tensor([[-1.0, 14.0]]))  # no return; 14 m
        >>> image
        tensor([[[-1.0000, -0.5000]]])
        >>> codec.decode(image, LidarSensor())
        tensor([[[-1., 14.]]])
    """

    encoding: Literal["linear", "log2", "inverse"] = "linear"
    scale: float | None = None
    legacy_inverse: bool = False
    return_channel: bool = False
    reflectance: bool = False
    offset_m: float = _LOG_OFFSET_M
    intensity_channel: bool = False
    num_classes: int = 0

    def __post_init__(self) -> None:
        if self.encoding not in _DEFAULT_SCALES:
            known = ", ".join(_DEFAULT_SCALES)
            raise ValueError(f"range encoding must be one of {known}, got {self.encoding!r}")
        if self.return_channel and self.reflectance:
            raise ValueError("codec.return_channel and codec.reflectance exclude each other")
        if (self.intensity_channel or self.num_classes) and not self.return_channel:
            raise ValueError("codec.intensity_channel and num_classes need codec.return_channel")
        if self.num_classes not in (0, NUM_CLASSES):
            raise ValueError(
                f"codec.num_classes must be {NUM_CLASSES}, or 0 for none, got {self.num_classes}"
            )
        # Store a default scale as None: equal codecs compare equal, and a YAML that changes only
        # `encoding` gets the default scale of that encoding.
        if self.scale == _DEFAULT_SCALES[self.encoding]:
            object.__setattr__(self, "scale", None)
        if not 0.0 < self._divisor < math.inf:
            raise ValueError(f"range scale must be positive and finite, got {self.scale}")

    @property
    def _divisor(self) -> float:
        return _DEFAULT_SCALES[self.encoding] if self.scale is None else self.scale

    def reaching(self, range_max_m: float) -> Self:
        """Codec of the same encoding whose images reach this range, by default scale or more."""
        farthest_m = self.to_range(torch.ones(())).item()
        if self.scale is not None or self.encoding == "inverse" or farthest_m >= range_max_m:
            return self
        if self.encoding == "log2":
            return replace(self, scale=math.log2(range_max_m + 1 + self.offset_m))
        return replace(self, scale=range_max_m)

    @property
    def threshold(self) -> float:
        """Image value in [-1, 1] above which a pixel holds a return: about 4 mm of range.

        Of ``inverse``, where no return is infinitely far, 4 mm of 1 / range.
        """
        if self.encoding == "inverse":
            return 2 * _LEAST_VALID_M * self._divisor - 1
        if self.encoding == "linear":
            fraction = _LEAST_VALID_M / self._divisor
        else:
            fraction = math.log2(1 + _LEAST_VALID_M) / self._divisor
        return 2 * fraction - 1 + _THRESHOLD_MARGIN

    def encode(self, range_m: Tensor) -> Tensor:
        """Image in [-1, 1], float32, of ranges in metres; any negative range means no return."""
        # Clamped first: log2 of a range below -1 m is NaN, which would survive the last clamp.
        # float64: float32 logarithms alone would move a range of 50 m by 2e-5 m.
        metres = range_m.double().clamp(min=0)
        if self.encoding == "inverse":
            near = torch.where(metres > 0, self._divisor / metres, 0.0)
            return (2 * near - 1).clamp(-1, 1).float()
        if self.encoding == "log2":
            metres = torch.log1p(metres + self.offset_m) / math.log(2)
        return (2 * metres / self._divisor - 1).clamp(-1, 1).float()

    def valid_mask(self, image: Tensor) -> Tensor:
        """Pixels of an encoded image that hold a return, bool."""
        return image > self.threshold

    def to_range(self, image: Tensor) -> Tensor:
        """Inverse of the formula for every pixel, float32 metres; negative below an image of -1."""
        if self.encoding == "inverse":
            return (2 * self._divisor / (image.double() + 1)).float()
        metres = (image.double() + 1) / 2 * self._divisor
        if self.encoding == "log2":
            offset = 0.0 if self.legacy_inverse else self.offset_m
            metres = torch.expm1(metres * math.log(2)) - offset
        return metres.float()

    def decode(self, image: Tensor, sensor: LidarSensor) -> Tensor:
        """Ranges of an encoded image, float32 metres.

        Args:
            image: Any shape, encoded range; decoder outputs outside [-1, 1] are allowed.
            sensor: Gives the range limits, which are exclusive.

        Returns:
            ``EMPTY_RANGE_M`` where the pixel is empty, outside the range limits, or NaN.
        """
        range_m = self.to_range(image)
        inside = (range_m > sensor.range_min_m) & (range_m < sensor.range_max_m)
        return torch.where(inside & self.valid_mask(image), range_m, EMPTY_RANGE_M)

    @property
    def channels(self) -> int:
        """Channels C of an image."""
        further = self.intensity_channel + (self.num_classes > 0)
        return 1 + (self.return_channel or self.reflectance) + further

    def without_further(self) -> Self:
        """Codec of the same images without intensity and class, their last channels."""
        return replace(self, intensity_channel=False, num_classes=0)

    def to_image(
        self, range_m: Tensor, intensity: Tensor | None = None, classes: Tensor | None = None
    ) -> Tensor:
        """Image ``(..., C, H, W)`` in [-1, 1] of ranges ``(..., H, W)`` in metres.

        Args:
            range_m: Any value of 0 or less means no return.
            intensity: ``(..., H, W)`` in [0, 1]; needed where a channel is of intensity or
                reflectance.
            classes: ``(..., H, W)`` numbers of semantic classes; unknown where None.
        """
        encoded, returns = self.encode(range_m), range_m > 0
        channels = [encoded]
        if self.return_channel:
            channels.append(torch.where(returns, 1.0, -1.0).to(encoded))
        if self.reflectance or self.intensity_channel:
            if intensity is None:
                option, what = "intensity_channel", "an intensity"
                if self.reflectance:
                    option, what = "reflectance", "a reflectance"
                raise ValueError(f"codec.{option} needs scans with {what}; set it false")
            scaled = torch.where(returns, 2 * intensity - 1, -1.0)
            channels.append(scaled.clamp(-1, 1).to(encoded))
        if self.num_classes:
            unknown = torch.full_like(encoded, UNKNOWN_CLASS)
            channels.append(unknown if classes is None else torch.where(returns, classes, unknown))
        return torch.stack(channels, dim=-3)

    def pixels_of(self, image: Tensor, sensor: LidarSensor) -> Pixels:
        """Inverse of :meth:`to_image`, as :meth:`decode` for the ranges."""
        range_m = self.ranges_of(image, sensor)
        intensity, classes = None, None
        if self.intensity_channel:
            intensity = (image[..., 2, :, :].float() + 1) / 2
            intensity = torch.where(range_m > 0, intensity.clamp(0, 1), 0.0)
        if self.num_classes:
            classes = torch.where(range_m > 0, image[..., -1, :, :].long(), UNKNOWN_CLASS)
        return Pixels(range_m, intensity, classes)

    def returns_of(self, image: Tensor) -> Tensor:
        """Pixels ``(..., 1, H, W)``, bool, with a return in images ``(..., C, H, W)``."""
        if self.return_channel:
            return image[..., 1:2, :, :] > 0
        return self.valid_mask(image[..., :1, :, :] if self.reflectance else image)

    def drop_returns(self, image: Tensor, uniform: Tensor) -> Tensor:
        """Images of that shape with single returns dropped, as often as a decoder expects.

        Sensors lose single shots. Latents do not tell which, so the most likely image has no such
        holes. Only pixels with a likely return are drawn, since independent draws would fray the
        borders of large holes. Other pixels take the likelier outcome, which loses more returns
        than it adds; larger logits make up for that.

        Args:
            image: ``(..., C, H, W)``, whose second channel is the logit of a return.
            uniform: ``(..., H, W)`` in [0, 1).
        """
        returns = (_LOGIT_SCALE * image[..., 1, :, :]).sigmoid()
        dropped = (returns > _LIKELY_RETURN) & (uniform > returns)
        return image.masked_fill(dropped.unsqueeze(-3), -1.0)

    def ranges_of(self, image: Tensor, sensor: LidarSensor) -> Tensor:
        """Ranges ``(..., H, W)`` of images ``(..., C, H, W)``, see :meth:`decode`."""
        range_m = self.decode(image[..., 0, :, :], sensor)
        return torch.where(self.returns_of(image)[..., 0, :, :], range_m, EMPTY_RANGE_M)


@dataclass(frozen=True)
class ScanGeometry:
    """Projection, range encoding and feature-grid size of a data set.

    Args:
        projection: Points to pixels and back, with its sensor.
        codec: Metres to [-1, 1] and back.
        grid_size: Rows and columns of the feature grid.

    Example:
        >>> geometry = ScanGeometry(SphericalProjection(LidarSensor()), RangeCodec(), (8, 64))
        >>> ScanGeometry.from_dict(geometry.to_dict()) == geometry
        True
    """

    projection: Projection
    codec: RangeCodec
    grid_size: tuple[int, int]

    def __post_init__(self) -> None:
        sensor = self.projection.sensor
        sensor.cell_size(self.grid_size)
        limit_m = self.codec.to_range(torch.ones(())).item()
        if self.codec.encoding == "inverse":
            if limit_m > sensor.range_min_m + _ROUNDING_M:
                raise ValueError(
                    f"the inverse encoding begins at its scale of {limit_m:.2f} m, but the sensor "
                    f"reports from {sensor.range_min_m:g} m: nearer points would become a wall. "
                    "Lower the scale of the codec to range_min_m or raise range_min_m"
                )
        elif limit_m < sensor.range_max_m - _ROUNDING_M:
            raise ValueError(
                f"the range encoding ends at {limit_m:.2f} m, but the sensor reports up to "
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
