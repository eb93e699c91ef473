"""Scans that go into the networks, and scenes that come out.

Scans are given as NumPy arrays, tensors, files or objects with points; scenes hold tensors.
Letters: B scenes, H beams, W columns, C latent channels, h x w latent size, P points.
"""

from __future__ import annotations

import html
import io
import operator
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self, overload

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from lidarsim.cloud_formats import ODD_SHARE
from lidarsim.clouds import PointCloud, read_cloud
from r3dpa.geometry import (
    EMPTY_RANGE_M,
    SEMANTIC_CLASSES,
    BeamProjection,
    Pixels,
    Projection,
    RangeCodec,
    classes_of,
    in_range,
    labels_of,
    points_of,
    project_pixels,
    share_outside_view,
    values_at_returns,
    values_in,
    view_limits_deg,
    view_of,
)
from r3dpa.io import number_of

_PICTURES, _PAGES = 4, 8  # scenes that a notebook cell shows
MOST_OUTSIDE_VIEW = 0.2  #: share of the points of a scan of the same sensor

ScanLike = Any
"""A scan: points ``(P, 3)``, or ``(P, 4)`` with the intensity; a range image ``(H, W)`` in metres;
both as tensors or NumPy arrays; the file of a scan; a :class:`Scene` or
:class:`r3dpa.geometry.Pixels`; or an object with ``points`` and perhaps ``intensity`` and
``labels``, such as a simulated or recorded scan."""


def scan_pixels(scan: ScanLike, projection: Projection, labels: ArrayLike | None = None) -> Pixels:
    """Pixels ``(H, W)`` of a scan, on the CPU; see :func:`warn_of_points_outside_view`.

    Args:
        scan: See :data:`ScanLike`.
        projection: Which pixel a point belongs to.
        labels: ``(P,)`` KITTI-360 class of each point in the lower 16 bits; default: of the scan.

    Raises:
        ValueError: If the scan is of another shape, has a value that is not finite, has no point
            within the range limits, or has pixels and ``labels`` are given.
    """
    if isinstance(scan, SceneBatch):
        raise ValueError(f"a scan is one scene, got {len(scan)}: give one of them, as scenes[0]")
    if isinstance(scan, Scene) and scan.projection == projection:
        classes = None if scan.labels is None else classes_of(scan.labels.cpu())
        scan = Pixels(scan.range_m, scan.intensity, classes)
    if isinstance(scan, Pixels):
        _refuse_labels(labels)
        scan = map_pixels(torch.Tensor.cpu, scan)
        return scan._replace(range_m=_within_limits(scan.range_m, projection))
    points, own_labels = _points_of_scan(scan)
    values = torch.as_tensor(points).detach().cpu().float()
    sensor = projection.sensor
    if values.shape == (sensor.beams, sensor.columns):
        _refuse_labels(labels)
        return Pixels(_within_limits(values, projection))
    if values.ndim != 2 or values.shape[1] not in (3, 4):
        raise ValueError(
            f"a scan must be points (P, 3) or (P, 4), or a range image ({sensor.beams}, "
            f"{sensor.columns}), got shape {tuple(values.shape)}"
        )
    if not values.isfinite().all():
        raise ValueError("the scan has NaN or infinite values; leave these points out")
    if not in_range(values[:, :3], sensor).any():
        raise ValueError(
            f"the scan has no point within {sensor.range_min_m:g}..{sensor.range_max_m:g} m; "
            "coordinates must be metres"
        )
    warn_of_points_outside_view(values[:, :3], projection)
    labels = own_labels if labels is None else labels
    given = None if labels is None else torch.from_numpy(np.asarray(labels, dtype=np.int64))
    return project_pixels(values, projection, given)


def _refuse_labels(labels: ArrayLike | None) -> None:
    """Refuse labels of points for a scan that has pixels in their place."""
    if labels is not None:
        raise ValueError("labels are of points, but the scan is a range image: give its points")


def _points_of_scan(scan: ScanLike) -> tuple[Any, ArrayLike | None]:
    """Points with their intensity, where it is known, or what else was given; and labels."""
    if isinstance(scan, str | Path):
        scan = read_cloud(scan)
    if isinstance(scan, PointCloud):
        from r3dpa.data.labels import labels_of_cloud

        rows = scan.rows()[:, : 3 if scan.intensity is None else 4]
        return rows, labels_of_cloud(scan)
    if isinstance(scan, Scene):
        intensity = None if scan.intensity is None else scan.point_intensity
        labels = None if scan.labels is None else scan.point_labels
    elif hasattr(scan, "points"):
        intensity, labels = getattr(scan, "intensity", None), getattr(scan, "labels", None)
    else:
        return scan, None
    if intensity is None:
        return scan.points, labels
    return np.column_stack([scan.points, np.asarray(intensity, dtype=np.float32)]), labels


def with_unknown_intensity(pixels: Pixels, codec: RangeCodec) -> Pixels:
    """Pixels with an intensity of 0 where they have none and images of the codec need one.

    Encoders that were trained with ``further_dropout`` take it for unknown.
    """
    if pixels.intensity is None and codec.intensity_channel:
        return pixels._replace(intensity=torch.zeros_like(pixels.range_m))
    return pixels


def clamp_intensities(pixels: Pixels, codec: RangeCodec) -> Pixels:
    """Clamp single bright returns to an intensity of 1, if images of the codec show intensities.

    Raises:
        ValueError: With the largest intensity, if more than 0.1 % of the returns are above 1.
    """
    intensity = pixels.intensity
    if intensity is None or not (codec.intensity_channel or codec.reflectance):
        return pixels
    if (intensity > 1).sum() > ODD_SHARE * (pixels.range_m > 0).sum():
        raise ValueError(
            f"the scan has intensities up to {intensity.max():g}; the model needs 0..1: divide "
            "them by their full scale, such as 255"
        )
    return pixels._replace(intensity=intensity.clamp(max=1))


def _within_limits(range_m: Tensor, projection: Projection) -> Tensor:
    """Range image without returns beyond the limits of the sensor, as of points.

    Refuses images of another size, and without a return within the limits.
    """
    sensor = projection.sensor
    if range_m.shape != (sensor.beams, sensor.columns):
        raise ValueError(
            f"a range image must be ({sensor.beams}, {sensor.columns}), "
            f"got shape {tuple(range_m.shape)}"
        )
    if not range_m.isfinite().all():
        raise ValueError("the range image has NaN or infinite values; leave these pixels empty")
    within = (range_m > sensor.range_min_m) & (range_m < sensor.range_max_m)
    if not within.any():
        raise ValueError(
            f"the range image has no return within {sensor.range_min_m:g}.."
            f"{sensor.range_max_m:g} m; ranges must be metres"
        )
    return torch.where(within, range_m, EMPTY_RANGE_M)


def warn_of_points_outside_view(points: Tensor, projection: Projection) -> None:
    """Warn if more than a fifth of points ``(P, 3)`` lies above or below the field of view."""
    outside = share_outside_view(points, projection)
    if outside > MOST_OUTSIDE_VIEW:
        lowest, highest = view_limits_deg(projection)
        warnings.warn(
            f"{outside:.0%} of the points of the scan lie above or below the field of view, "
            f"{lowest:.1f} to {highest:.1f} degrees, and end in its first or last row: the scan is "
            "of another sensor, or not in its own frame",
            stacklevel=4,
        )


def map_pixels(function: Callable[[Tensor], Tensor], pixels: Pixels) -> Pixels:
    """Apply a function to each known part of pixels."""
    further = (None if values is None else function(values) for values in pixels[1:])
    return Pixels(function(pixels.range_m), *further)


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """One scene.

    Attributes:
        range_m: ``(H, W)`` metres, -1 without a return.
        projection: Maps pixels to points.
        intensity: ``(H, W)`` in [0, 1], or None.
        labels: ``(H, W)`` int64 class ids of KITTI-360, 0 without a return, or None.
    """

    range_m: Tensor
    projection: Projection
    intensity: Tensor | None = None
    labels: Tensor | None = None

    def __repr__(self) -> str:
        num_points = int((self.range_m > 0).sum())
        return f"Scene({num_points} points, {_describe(self.range_m, self.intensity, self.labels)})"

    @property
    def points(self) -> Tensor:
        """Points ``(P, 3)`` in metres, x forward, y left, z up, on the CPU."""
        return points_of(self.range_m.cpu(), self.projection)

    @property
    def point_intensity(self) -> Tensor:
        """Intensity ``(P,)`` of the points, on the CPU; ValueError if the scene has none."""
        return self._at_points("intensity", self.intensity)

    @property
    def point_labels(self) -> Tensor:
        """Class ids of KITTI-360 ``(P,)`` of the points, on the CPU; ValueError if there are none.

        Names are in :data:`r3dpa.geometry.SEMANTIC_CLASSES`.
        """
        return self._at_points("labels", self.labels)

    def _at_points(self, name: str, values: Tensor | None) -> Tensor:
        if values is None:
            raise ValueError(
                f"these scenes have no {name}: their checkpoint was trained on range images without"
            )
        return values_at_returns(values.cpu(), self.range_m.cpu(), self.projection)


@dataclass(frozen=True, eq=False, repr=False)
class SceneBatch:
    """Generated scenes, on the device of the networks.

    ``batch[i]`` and iteration give a :class:`Scene`, ``batch[1:3]`` and ``batch[order]``, a list,
    array or tensor of numbers or a mask, a batch of some.

    Attributes:
        range_m: ``(B, H, W)`` float32 metres; -1 without a return, NaN for a whole scene if the
            networks returned anything non-finite for it.
        latents: ``(B, C, h, w)`` normalised latents.
        nfe: Network evaluations per scene.
        projection: Maps pixels to points.
        intensity: ``(B, H, W)`` in [0, 1], of networks that generate it.
        labels: ``(B, H, W)`` int64 class ids of KITTI-360, 0 without a return, likewise.
    """

    range_m: Tensor
    latents: Tensor
    nfe: int
    projection: Projection
    intensity: Tensor | None = None
    labels: Tensor | None = None

    @classmethod
    def of(cls, pixels: Pixels, latents: Tensor, nfe: int, projection: Projection) -> Self:
        """Scenes of decoded pixels ``(B, H, W)``."""
        labels = None if pixels.classes is None else labels_of(pixels.classes)
        return cls(pixels.range_m, latents, nfe, projection, pixels.intensity, labels)

    def seen_by(self, projection: BeamProjection) -> Self:
        """The scenes along the beams of another sensor.

        Args:
            projection: Of :func:`r3dpa.geometry.projection_for`, which refuses sensors that see
                more than the images show.
        """
        range_m, view = view_of(self.range_m, self.projection, projection)
        intensity, labels = (
            None if values is None else values_in(values, view, range_m)
            for values in (self.intensity, self.labels)
        )
        return replace(
            self, range_m=range_m, projection=projection, intensity=intensity, labels=labels
        )

    def __repr__(self) -> str:
        about = _describe(self.range_m, self.intensity, self.labels)
        count = number_of(len(self), "scene")
        return f"{type(self).__name__}({count}, {about}, {self.nfe} evaluations each)"

    def __len__(self) -> int:
        """Number of scenes B."""
        return len(self.range_m)

    @overload
    def __getitem__(self, index: int) -> Scene: ...

    @overload
    def __getitem__(self, index: slice | list[int] | np.ndarray | Tensor) -> Self: ...

    def __getitem__(self, index: int | slice | list[int] | np.ndarray | Tensor) -> Scene | Self:
        """One scene, or a batch of some."""
        if isinstance(index, list | np.ndarray):
            index = torch.as_tensor(index) if len(index) else torch.zeros(0, dtype=torch.long)
        if isinstance(index, slice) or (isinstance(index, Tensor) and index.ndim > 0):
            values = {field.name: getattr(self, field.name) for field in fields(self)}
            parts: dict[str, Any] = {
                name: value[index] for name, value in values.items() if isinstance(value, Tensor)
            }
            return replace(self, **parts)
        number = operator.index(index)
        intensity, labels = (
            None if values is None else values[number] for values in (self.intensity, self.labels)
        )
        return Scene(self.range_m[number], self.projection, intensity, labels)

    def __iter__(self) -> Iterator[Scene]:
        return (self[index] for index in range(len(self)))

    def points(self, index: int) -> Tensor:
        """Points ``(P, 3)`` of one scene in metres, x forward, y left, z up, on the CPU."""
        return self[index].points

    def point_intensity(self, index: int) -> Tensor:
        """Intensity ``(P,)`` of each of the points of one scene, on the CPU."""
        return self[index].point_intensity

    def point_labels(self, index: int) -> Tensor:
        """Class id of KITTI-360 ``(P,)`` of each of the points of one scene, on the CPU."""
        return self[index].point_labels

    def save(
        self,
        folder: str | Path,
        formats: str | Sequence[str] = ("bin",),
        overwrite: bool = False,
    ) -> Path:
        """Write the scenes to a folder as ``r3dpa sample`` does; return the folder.

        Args:
            folder: New folder, or one with earlier scenes and ``overwrite``.
            formats: Files of points: ``bin``, ``ply``, ``npz``, one or several.
            overwrite: Replace earlier scenes.

        Raises:
            ValueError: If a format is unknown, a scene holds NaN, or the folder is a file, or holds
                scenes and ``overwrite`` is False.
        """
        from r3dpa.data.scene_writer import SceneWriter

        folder = Path(folder)
        if folder.is_file():
            raise ValueError(f"{folder} is a file; give a folder")
        if (folder / "metadata.json").exists() and not overwrite:
            raise ValueError(
                f"{folder} holds scenes already; give another folder or overwrite=True"
            )
        if self.range_m.isnan().any():
            raise ValueError("the scenes hold NaN: the networks diverged; sample in fp32")
        formats = (formats,) if isinstance(formats, str) else tuple(formats)
        about = {"num": len(self), "nfe": self.nfe, "formats": list(formats)}
        # Scenes that an interrupted call left without metadata may be others: they are replaced.
        with SceneWriter(folder, len(self), self.projection, formats, about, True) as writer:
            writer.put(self.range_m, self.nfe, self.intensity, self.labels)
            writer.close()
            writer.finish(about)
        return folder

    def show(self) -> Any:
        """Return a page with the first point clouds to turn, for the output of a notebook cell.

        Raises:
            ImportError: If IPython is missing, which notebooks have.
        """
        try:
            from IPython.display import HTML
        except ImportError as error:
            raise ImportError(
                "show() is for notebooks, and needs IPython: pip install ipykernel; elsewhere use "
                "save() and `r3dpa data view`"
            ) from error
        page = html.escape(self._page())
        # In a block of its own: IPython warns of a bare iframe.
        return HTML(f'<div><iframe srcdoc="{page}" width="100%" height="600"></iframe></div>')

    def to_open3d(self) -> list[Any]:
        """Return an ``open3d.geometry.PointCloud`` of each scene, coloured by intensity if known.

        Raises:
            ImportError: If Open3D is missing.
        """
        try:
            import open3d
        except ImportError as error:
            raise ImportError("to_open3d() needs Open3D: pip install open3d") from error
        clouds = []
        for scene in self:
            cloud = open3d.geometry.PointCloud()
            cloud.points = open3d.utility.Vector3dVector(scene.points.double().numpy())
            if scene.intensity is not None:
                grey = scene.point_intensity.double()[:, None].repeat(1, 3)
                cloud.colors = open3d.utility.Vector3dVector(grey.numpy())
            clouds.append(cloud)
        return clouds

    def _repr_png_(self) -> bytes | None:
        """Range images of the first scenes, as the output of a notebook cell."""
        if not len(self):
            return None
        from PIL import Image

        from r3dpa.viz import range_image_picture

        sensor = self.projection.sensor
        rows = [range_image_picture(scene.range_m, sensor) for scene in self[:_PICTURES]]
        border = np.full((4, *rows[0].shape[1:]), 255, np.uint8)
        stacked = [part for row in rows for part in (row, border)][:-1]
        stream = io.BytesIO()
        Image.fromarray(np.concatenate(stacked)).save(stream, format="PNG")
        return stream.getvalue()

    def _page(self) -> str:
        from r3dpa.viz import Category, PageScan, scan_page

        scans = []
        for index, scene in enumerate(self[:_PAGES]):
            points = scene.points
            if scene.intensity is not None:
                points = torch.cat([points, scene.point_intensity[:, None]], dim=1)
            labels = None if scene.labels is None else scene.point_labels.numpy()
            scans.append(PageScan(f"scene {index}", points.numpy(), labels))
        classes = {semantic.label: Category(semantic.name) for semantic in SEMANTIC_CLASSES}
        return scan_page(scans, repr(self), classes, {}, sensor=self.projection.sensor)


def _describe(range_m: Tensor, intensity: Tensor | None, labels: Tensor | None) -> str:
    beams, columns = range_m.shape[-2:]
    known = ["range"]
    if intensity is not None:
        known.append("intensity")
    if labels is not None:
        known.append("labels")
    return f"{beams} x {columns} pixels of {', '.join(known)}"
