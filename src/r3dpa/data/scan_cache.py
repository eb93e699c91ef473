"""Range images of scans, projected once and kept on disk. Letters: H x W image size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from torch.utils.data import DataLoader

from r3dpa.data.datasets import LidarDataset
from r3dpa.data.scans import Scan
from r3dpa.data.tensor_cache import TensorCache
from r3dpa.geometry import Projection, RangeCodec, projection_to_dict

__all__ = ["range_image_cache", "write_range_images"]


def range_image_cache(
    root: str | Path, projection: Projection, codec: RangeCodec
) -> TensorCache[Scan]:
    """Place of the encoded range images ``(1, H, W)`` of a projection and codec."""
    settings = {"projection": projection_to_dict(projection), "codec": asdict(codec)}
    sensor = projection.sensor
    return TensorCache(Path(root), "range_images", settings, (1, sensor.beams, sensor.columns))


def write_range_images(
    scans: Sequence[Scan],
    projection: Projection,
    codec: RangeCodec,
    root: str | Path,
    *,
    workers: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Project the scans whose range images are missing; another process that does is waited for.

    Args:
        scans: Scans, of any number of drives.
        projection: Points to pixels.
        codec: Metres to [-1, 1].
        root: Folder of caches.
        workers: Processes that project; 0 for none.
        progress: Called after each scan with the number of scans done and the number to do.

    Returns:
        Number of range images made.

    Raises:
        TensorCacheError: If the cache cannot be written or is damaged.
        ScanError: If a scan cannot be used; the message names the file.
    """
    cache = range_image_cache(root, projection, codec)
    if not cache.missing(scans):
        return 0  # a complete cache may lie on a read-only disk
    with cache.lock():
        todo = cache.missing(scans)  # another process may have made some
        loader = DataLoader(
            LidarDataset(todo, projection, codec),
            batch_size=8,
            num_workers=workers,
            generator=torch.Generator(),  # the default draws from the global random state
        )
        done = 0
        with cache.writer() as add:
            for batch in loader:
                add([todo[index] for index in batch["index"].tolist()], batch["range_image"])
                for _ in batch["name"]:
                    done += 1
                    if progress is not None:
                        progress(done, len(todo))
    return done
