"""Data module of networks on points."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch.utils.data import DataLoader

from r3dpa.data.datamodules import LidarDataModule
from r3dpa.data.datasets import DrawnPoints, list_collate
from r3dpa.data.loaders import LoaderModule, ready


class PointDataModule(LoaderModule):
    """Points of the scans of another data module, prepared at random in each epoch.

    Batches are lists of what ``prepare`` returns; no range images or feature grids are made.

    Args:
        source: Scans and their split, simulated where it does that. Give it ``extractor: null``.
        prepare: Function of the points ``(P, 4)`` and a generator, such as
            ``r3dpa.nn.backbones.Masking``.
        batch_size: Scans per batch and process.
        num_workers: Loader processes per training process.
        seed: Seed of order and draws.

    Raises:
        ValueError: If ``source`` has an extractor, or an argument is out of its range.
    """

    def __init__(
        self,
        source: LidarDataModule,
        prepare: Callable[..., Any],
        batch_size: int = 2,
        num_workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__(batch_size, num_workers, seed)
        if source.extractor is not None:
            raise ValueError(
                "data.init_args.source.init_args.extractor must be null: a network on points is "
                "trained without feature grids."
            )
        self.source, self.prepare = source, prepare
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
        points = ready(self.train_set)
        return self.loader(points, train=True, with_epoch=True, collate_fn=list_collate)

    def val_dataloader(self) -> DataLoader[Any]:
        """Held-out scans in order, none twice, each drawn the same every time."""
        return self.loader(ready(self.val_set), train=False, collate_fn=list_collate)
