"""Feature extraction: a frozen extractor over many scans, on any number of devices."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from lightning.pytorch import LightningModule, Trainer
from torch.utils.data import DataLoader, DistributedSampler

from r3dpa.data.datamodules import LidarDataModule
from r3dpa.data.datasets import CachedImages, PointDataset, PointSample
from r3dpa.data.feature_grids import (
    Extractor,
    GridSettings,
    features_lock,
    plan,
    pooled_grids,
)
from r3dpa.data.loaders import plain_loader
from r3dpa.data.scans import Scan
from r3dpa.data.store import StoreWriter
from r3dpa.geometry import Projection
from r3dpa.io import number_of


class FeatureExtraction(LightningModule):
    """Writes the feature grids of scans, as ``trainer.predict`` runs it without further data.

    Each process gets its share of the scans and appends to a shard of its own, so that finished
    grids survive any interruption. Nothing is returned.

    Args:
        extractor: Frozen network, see :class:`r3dpa.data.Extractor`; its ``prepare`` runs in the
            loader processes.
        projection: Projection of the range images; only the first process's counts. At least one
            point of a scan must lie within the range limits of its sensor.
        grid_sizes: Rows and columns (h, w) of the grids; all are pooled from one pass.
        features_dir: Folder of the grids of this extractor.
        scans: Scans to extract; only the list of the first process counts.
        images: Cached images whose pixels are the points, in place of the files of the scans; only
            the first process's count.
        batch_size: Scans per batch and process.
        num_workers: Loader processes per process.

    Raises:
        StoreError: While it runs, if the store cannot be written, or features are not finite.
    """

    def __init__(
        self,
        extractor: Extractor,
        projection: Projection | None,
        grid_sizes: Sequence[tuple[int, int]],
        features_dir: str | Path,
        scans: Sequence[Scan],
        batch_size: int = 1,
        num_workers: int = 0,
        images: CachedImages | None = None,
    ) -> None:
        super().__init__()
        self.allow_zero_length_dataloader_with_multiple_devices = True  # fewer scans than processes
        self.extractor: Extractor = extractor
        self.projection, self.scans, self.images = projection, list(scans), images
        self.grid_sizes = list(grid_sizes)
        self.features_dir = Path(features_dir)
        self.batch_size, self.num_workers = batch_size, num_workers
        self._writers: dict[tuple[int, int], StoreWriter] = {}

    def setup(self, stage: str) -> None:
        """Take the scans of the first process: others may lack what is needed."""
        given = self.projection, self.scans, self.images
        self.projection, self.scans, self.images = self.trainer.strategy.broadcast(given)

    def predict_dataloader(self) -> DataLoader[Any]:
        """The share of this process, in order; no scan is given twice."""
        scans = self.scans[self.trainer.global_rank :: self.trainer.world_size]
        sensor = cast(Projection, self.projection).sensor
        dataset = PointDataset(scans, sensor, self.extractor.prepare, self.images)
        # Of one process, so that Lightning does not divide the share once more.
        sampler: DistributedSampler[Any] = DistributedSampler(dataset, 1, 0, shuffle=False)
        return plain_loader(
            dataset, self.batch_size, self.num_workers, sampler=sampler, collate_fn=list
        )

    def transfer_batch_to_device(
        self, batch: list[PointSample], device: torch.device, dataloader_idx: int
    ) -> list[PointSample]:
        """Leave the batch where it is: the extractor moves what it needs."""
        return batch

    def on_predict_start(self) -> None:
        """Open a shard for each grid size; not called in a process that has nothing to do."""
        projection = cast(Projection, self.projection)
        for size in self.grid_sizes:
            settings = GridSettings.of(self.extractor, projection, size, self.trainer.precision)
            self._writers[size] = settings.store(self.features_dir).writer(self.global_rank)

    def predict_step(self, batch: list[PointSample]) -> None:
        """Pool the features of scans prepared by the extractor, and write their grids."""
        projection = cast(Projection, self.projection)
        grids = pooled_grids(self.extractor, batch, projection, self.grid_sizes)
        keys = [sample.key for sample in batch]
        for size, writer in self._writers.items():
            writer.add(keys, grids[size])

    def teardown(self, stage: str) -> None:
        """Wait until all processes have written all of their grids."""
        self.close()
        self.trainer.strategy.barrier("feature grids")

    def close(self) -> None:
        """Release the shards, after an error too."""
        for writer in self._writers.values():
            writer.close()
        self._writers.clear()


def extract_features(
    data: LidarDataModule, trainer: Trainer, grid_sizes: list[tuple[int, int]]
) -> None:
    """Write the feature grids that a data module with an extractor lacks, and say how many.

    A repeated call continues. The first process plans the work and locks the folder before
    Lightning starts the others, which would wait and time out.

    Raises:
        KeyboardInterrupt: After Ctrl-C, which Lightning turns into a SystemExit.
    """
    # The data module finds or simulates its scans; it must not extract grids itself.
    extractor, data.extractor = cast(Any, data.extractor), None
    folder = cast(Path, data.features_dir)
    projection: Projection | None = None
    scans: list[Scan] = []
    images: CachedImages | None = None
    with ExitStack() as job:
        if trainer.is_global_zero:
            data.prepare_data()
            data.setup("predict")
            projection, images = data.geometry.projection, data.images
            make_plan = partial(
                plan,
                data.all_set.scans,
                extractor,
                projection,
                grid_sizes,
                folder,
                trainer.precision,
            )
            if make_plan().missing:  # complete grids may lie on a read-only disk
                job.enter_context(features_lock(folder))
            todo = make_plan()  # another job may have written some before the lock was free
            scans = list(todo.missing)
            stores = ", ".join(str(folder / f"{h}x{w}") for h, w in todo.stores)
            sys.stdout.write(
                f"feature grids of {extractor.name}: {number_of(len(scans), 'scan')} to do, "
                f"{todo.num_kept} done; {todo.num_bytes / 1e9:.3g} GB needed, in {stores}\n"
            )
            sys.stdout.flush()  # into a log file at once
        extraction = FeatureExtraction(
            extractor,
            projection,
            grid_sizes,
            folder,
            scans,
            batch_size=data.batch_size,
            num_workers=data.num_workers,
            images=images,
        )
        started = time.monotonic()
        try:
            trainer.predict(extraction, return_predictions=False)
        except SystemExit as stop:
            if stop.code == 1:
                raise KeyboardInterrupt from None
            raise
        finally:
            extraction.close()
    if trainer.is_global_zero:
        rate = len(scans) / (time.monotonic() - started)
        sys.stdout.write(
            f"feature grids: {len(scans)} made, {todo.num_kept} kept, {rate:.3g} scans per second, "
            f"in {stores}\n"
        )
