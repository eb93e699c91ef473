"""Data module of networks on points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader, Dataset

from r3dpa.data.datamodules import LidarDataModule
from r3dpa.data.loaders import ordered_sampler, training_loader
from r3dpa.data.points import list_collate
from r3dpa.data.scans import Scan, read_scan
from r3dpa.geometry import LidarSensor


class DrawnPoints(Dataset[Any]):
    """What a preparation draws from each scan: a function of seed, epoch and index alone.

    Args:
        scans: The scans, in the order of the indices.
        sensor: At least one point of a scan must lie within its range limits.
        prepare: Function of the points ``(P, 4)`` and a generator.
        seed: Seed of the draws.
    """

    def __init__(
        self,
        scans: Sequence[Scan],
        sensor: LidarSensor,
        prepare: Callable[[torch.Tensor, np.random.Generator], Any],
        seed: int,
    ) -> None:
        self.scans, self.sensor, self.prepare, self.seed = list(scans), sensor, prepare, seed

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.scans)

    def __getitem__(self, key: tuple[int, int] | int) -> Any:
        """What is drawn of ``(epoch, index)``; of the epoch 0 where only an index is given.

        Raises:
            ScanError: If the scan cannot be used; the message names the file.
        """
        epoch, index = key if isinstance(key, tuple) else (0, key)
        points = torch.from_numpy(read_scan(self.scans[index].path, self.sensor))
        return self.prepare(points, np.random.default_rng((self.seed, epoch, index)))


class PointDataModule(LightningDataModule):
    """Scans of another data module as points, prepared at random in each epoch.

    Batches are lists of what ``prepare`` returns. Neither range images nor feature grids are made.

    Args:
        source: Where the scans come from and how they are split; simulates them where they are to
            be simulated. Give it ``extractor: null``.
        prepare: Function of the points ``(P, 4)`` and a generator, such as
            ``r3dpa.nn.backbones.Masking``.
        batch_size: Scans per batch and process.
        num_workers: Loader processes per training process.
        seed: Seed of order and draws.

    Raises:
        ValueError: If ``source`` has an extractor, which would make grids that nobody reads.
    """

    def __init__(
        self,
        source: LidarDataModule,
        prepare: Callable[..., Any],
        batch_size: int = 2,
        num_workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if source.extractor is not None:
            raise ValueError(
                "data.init_args.source.init_args.extractor must be null: a network on points is "
                "trained without feature grids."
            )
        self.source, self.prepare = source, prepare
        self.batch_size, self.num_workers, self.seed = batch_size, num_workers, seed
        self.train_set: DrawnPoints | None = None
        self.val_set: DrawnPoints | None = None

    def prepare_data(self) -> None:
        """Simulate the scans, where the source does."""
        self.source.prepare_data()

    def setup(self, stage: str) -> None:
        """Index the scans."""
        self.train_set, self.val_set = (
            DrawnPoints(scans, self.source.sensor, self.prepare, self.seed)
            for scans in self.source.limited_split()
        )

    def train_dataloader(self) -> DataLoader[Any]:
        """Shuffled, resumable loader of full batches."""
        assert self.train_set is not None
        trainer = self.trainer
        return training_loader(
            self.train_set,
            self.batch_size,
            num_workers=self.num_workers,
            seed=self.seed,
            num_replicas=1 if trainer is None else trainer.world_size,
            rank=0 if trainer is None else trainer.global_rank,
            limit_batches=1.0 if trainer is None else trainer.limit_train_batches,
            with_epoch=True,
            collate_fn=list_collate,
        )

    def val_dataloader(self) -> DataLoader[Any]:
        """Held-out scans in order, none twice, each drawn the same every time."""
        assert self.val_set is not None
        trainer = self.trainer
        replicas, rank = (1, 0) if trainer is None else (trainer.world_size, trainer.global_rank)
        return DataLoader(
            self.val_set,
            self.batch_size,
            sampler=ordered_sampler(self.val_set, replicas, rank),
            num_workers=self.num_workers,
            collate_fn=list_collate,
            generator=torch.Generator(),  # the default would draw from the global random state
        )
