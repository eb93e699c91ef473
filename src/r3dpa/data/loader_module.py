"""Base class of the data modules: loaders for the processes of a trainer."""

from __future__ import annotations

from collections.abc import Sized
from typing import Any, cast

from lightning.pytorch import LightningDataModule
from lightning.pytorch.utilities.rank_zero import rank_zero_info
from torch.utils.data import DataLoader, Dataset, DistributedSampler

from r3dpa.data.loaders import at_least, plain_loader, training_loader, worker_options


class LoaderModule(LightningDataModule):
    """Settings of the loaders, and the loaders for the processes of the trainer."""

    def __init__(self, batch_size: int, num_workers: int, seed: int) -> None:
        super().__init__()
        at_least(1, batch_size=batch_size)
        at_least(0, num_workers=num_workers, seed=seed)
        self.batch_size, self.num_workers, self.seed = batch_size, num_workers, seed

    def __getattr__(self, name: str) -> Any:
        """AttributeError with the remedy: data sets and geometry are known after ``setup``."""
        raise AttributeError(
            f"{type(self).__name__} has no {name}; if it depends on the data, call prepare_data() "
            "and setup('fit') first"
        )

    @property
    def overfits(self) -> bool:
        """Whether the trainer takes the same few batches again and again."""
        return getattr(self.trainer, "overfit_batches", 0) > 0

    def loader(
        self, dataset: Dataset[Any], *, train: bool, kind: str = "scans", **options: Any
    ) -> DataLoader[Any]:
        """Loader as :func:`training_loader`, or of all samples in order.

        Under ``overfit_batches`` training samples come in order too. A training set smaller than
        one batch makes smaller batches, which is said on the screen.
        """
        trainer = self.trainer
        replicas, rank = (1, 0) if trainer is None else (trainer.world_size, trainer.global_rank)
        options |= worker_options(self.num_workers)
        if not train or self.overfits:
            options.pop("with_epoch", None)
            # Some samples come twice, so that all processes have as many batches.
            in_order: DistributedSampler[Any] = DistributedSampler(
                dataset, replicas, rank, shuffle=False
            )
            return plain_loader(dataset, self.batch_size, sampler=in_order, **options)
        num_samples = len(cast(Sized, dataset))
        batch_size = min(self.batch_size, max(1, num_samples // replicas))
        if batch_size < self.batch_size:
            rank_zero_info(
                f"only {num_samples} training {kind}: batch_size {batch_size} in place of "
                f"{self.batch_size}"
            )
        return training_loader(
            dataset,
            batch_size,
            seed=self.seed,
            num_replicas=replicas,
            rank=rank,
            limit_batches=1.0 if trainer is None else trainer.limit_train_batches,
            kind=kind,
            **options,
        )
