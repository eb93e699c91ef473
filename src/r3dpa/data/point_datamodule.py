"""Data module of networks on points."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader

from r3dpa.data.datamodules import LidarDataModule
from r3dpa.data.datasets import DrawnPoints, list_collate
from r3dpa.data.loaders import module_loader


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
        return module_loader(
            self, self.train_set, train=True, with_epoch=True, collate_fn=list_collate
        )

    def val_dataloader(self) -> DataLoader[Any]:
        """Held-out scans in order, none twice, each drawn the same every time."""
        assert self.val_set is not None
        return module_loader(self, self.val_set, train=False, collate_fn=list_collate)
