"""Scans as training samples."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NotRequired, TypedDict

import torch
from torch import Tensor
from torch.utils.data import Dataset

from r3dpa.data.feature_store import FeatureGrids
from r3dpa.data.scans import Scan, ScanError, read_scan
from r3dpa.geometry import Projection, RangeCodec, range_image

if TYPE_CHECKING:
    from r3dpa.data.tensor_cache import CachedTensors


class LidarSample(TypedDict):
    """One scan: the shapes of :class:`LidarBatch` without B, ``index`` and ``name`` single."""

    range_image: Tensor
    valid_mask: Tensor
    feature_grid: NotRequired[Tensor]
    index: int
    name: str


class LidarBatch(TypedDict):
    """What the training modules receive.

    ``range_image`` ``(B, 1, H, W)`` float32 in [-1, 1]; ``valid_mask`` ``(B, 1, H, W)`` bool, True
    where a pixel has a return; ``feature_grid`` ``(B, N, D)`` float32, empty cells zero, absent
    where no grids are used; ``index`` ``(B,)`` int64 position in the data set; ``name`` list of B
    scan names.
    """

    range_image: Tensor
    valid_mask: Tensor
    feature_grid: NotRequired[Tensor]
    index: Tensor
    name: list[str]


class LatentSample(TypedDict):
    """One scan as a frozen VAE sees it: the shapes of :class:`LatentBatch` without B."""

    posterior_moments: Tensor
    feature_grid: NotRequired[Tensor]
    index: int
    name: str


class LatentBatch(TypedDict):
    """What replaces a :class:`LidarBatch` where the posteriors of the VAE are cached.

    ``posterior_moments`` ``(B, 2C, h, w)`` float32, means, then log-variances of the raw latents,
    see :class:`r3dpa.nn.Posterior`; the rest is that of :class:`LidarBatch`.
    """

    posterior_moments: Tensor
    feature_grid: NotRequired[Tensor]
    index: Tensor
    name: list[str]


class LidarDataset(Dataset[LidarSample]):
    """Range image, mask and feature grid of each scan as it is; nothing random.

    Args:
        scans: The scans, in the order of the indices.
        projection: Points to pixels; its sensor sets the image size and range limits.
        codec: Metres to [-1, 1].
        grids: Feature grids of the scans, if any.
        images: Range images of the scans, made with this projection and codec, if they are cached;
            the scans themselves are then not read.
    """

    def __init__(
        self,
        scans: Sequence[Scan],
        projection: Projection,
        codec: RangeCodec,
        grids: FeatureGrids | None = None,
        images: CachedTensors | None = None,
    ) -> None:
        self.scans = list(scans)
        self.projection = projection
        self.codec = codec
        self.grids = grids
        self.images = images

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.scans)

    def __getitem__(self, index: int) -> LidarSample:
        """Sample of one scan.

        Raises:
            ScanError: If the scan cannot be used; the message names the file.
        """
        scan = self.scans[index]
        image = self._project(scan) if self.images is None else self.images.read(scan)
        sample = LidarSample(
            range_image=image,
            valid_mask=self.codec.valid_mask(image),
            index=index,
            name=scan.name,
        )
        if self.grids is not None:
            sample["feature_grid"] = self.grids.read(scan, scan.num_bytes)
        return sample

    def _project(self, scan: Scan) -> Tensor:
        points = torch.from_numpy(read_scan(scan.path, self.projection.sensor))
        try:
            range_m, _ = range_image(points[:, :3], self.projection)
        except ValueError as error:
            raise ScanError(f"{scan.path}: cannot be projected: {error}") from error
        return self.codec.encode(range_m)[None]


class LatentDataset(Dataset[LatentSample]):
    """Posterior of a frozen VAE and feature grid of each scan; range images are not read.

    Args:
        scans: The scans, in the order of the indices.
        posteriors: Moments ``(2C, h, w)`` of the scans.
        grids: Feature grids of the scans, if any.
    """

    def __init__(
        self, scans: Sequence[Scan], posteriors: CachedTensors, grids: FeatureGrids | None = None
    ) -> None:
        self.scans, self.posteriors, self.grids = list(scans), posteriors, grids

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.scans)

    def __getitem__(self, index: int) -> LatentSample:
        """Sample of one scan."""
        scan = self.scans[index]
        sample = LatentSample(
            posterior_moments=self.posteriors.read(scan), index=index, name=scan.name
        )
        if self.grids is not None:
            sample["feature_grid"] = self.grids.read(scan, scan.num_bytes)
        return sample
