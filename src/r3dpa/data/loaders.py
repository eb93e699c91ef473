"""Loaders: a training loader that restarts at any batch, and a plain one.

The order of training does not depend on the number of processes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sized
from typing import Any, cast

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, DistributedSampler


class EpochSampler(DistributedSampler[Any]):
    """Seeded shuffle of each epoch, dealt out to the processes in turn.

    Position p of an epoch goes to process ``p % processes``, so that a batch over all processes
    holds the same samples whatever their number, as long as ``batch_size * processes`` is the
    same. The order is a function of (seed, epoch) alone; a rest smaller than the number of
    processes is dropped. ``with_epoch`` yields ``(epoch, index)``.

    Attributes:
        start: Samples of this process that the next pass skips without reading them.
        epoch_shift: Added to the epoch that the trainer sets.
    """

    def __init__(
        self, dataset: Dataset[Any], seed: int, num_replicas: int, rank: int, with_epoch: bool
    ) -> None:
        super().__init__(dataset, num_replicas, rank, shuffle=True, seed=seed, drop_last=True)
        self.with_epoch = with_epoch
        self.start = self.epoch_shift = 0

    def __iter__(self) -> Iterator[Any]:
        epoch = self.epoch + self.epoch_shift
        generator = np.random.default_rng((self.seed, epoch))
        order = generator.permutation(len(cast(Sized, self.dataset)))
        share = order[self.rank : self.total_size : self.num_replicas][self.start :].tolist()
        return iter([(epoch, index) for index in share] if self.with_epoch else share)


class ResumableLoader(DataLoader[Any]):
    """Loader whose state is its place in the data: epoch, and samples of it handed out.

    Lightning saves the state in every checkpoint; the next batch of a resumed run is the one that
    the interrupted run would have received, whatever loader processes had prefetched. Built by
    :func:`training_loader`, since Lightning rebuilds loaders from the arguments of ``DataLoader``.

    Attributes:
        batches_per_epoch: Batches that the trainer takes of each epoch.
    """

    batches_per_epoch = 0
    _epoch = 0  # epoch of the current or last pass
    _handed_out = 0  # batches of it
    _resume_at: tuple[int, int] | None = None  # epoch and batch at which the next pass starts

    @property
    def _samples_per_batch(self) -> int:
        return cast(int, self.batch_size) * cast(EpochSampler, self.sampler).num_replicas

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        # A generator: Lightning makes the iterator first and sets the epoch of the sampler later.
        sampler = cast(EpochSampler, self.sampler)
        first = 0
        if self._resume_at is not None:
            # A trainer that stopped at max_steps within an epoch counts this epoch as complete
            # when it saves afterwards, and goes on with the rest of it under the next number.
            epoch, first = self._resume_at
            sampler.epoch_shift, self._resume_at = epoch - sampler.epoch, None
        sampler.start = first * cast(int, self.batch_size)
        self._epoch, self._handed_out = sampler.epoch + sampler.epoch_shift, first
        for batch in super().__iter__():
            self._handed_out += 1
            yield batch

    def state_dict(self) -> dict[str, int]:
        """Place of the next batch: epoch, samples before it in the epoch over all processes."""
        epoch, batches = self._resume_at or (self._epoch, self._handed_out)
        if batches >= (self.batches_per_epoch or len(self)):
            epoch, batches = epoch + 1, 0
        return {
            "epoch": epoch,
            "samples": batches * self._samples_per_batch,
            "dataset_size": len(cast(Sized, self.dataset)),
            "seed": cast(EpochSampler, self.sampler).seed,
        }

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Continue at a saved place.

        Raises:
            ValueError: If it lies within an epoch of other data, another order or another batch.
        """
        samples, num_samples = state_dict["samples"], len(cast(Sized, self.dataset))
        seed = cast(EpochSampler, self.sampler).seed
        if samples and (state_dict["dataset_size"], state_dict["seed"]) != (num_samples, seed):
            raise ValueError(
                f"the checkpoint was saved within an epoch over {state_dict['dataset_size']} "
                f"samples in the order of seed {state_dict['seed']}, but this run has "
                f"{num_samples} samples and seed {seed}: resume with the same data and seed, or "
                "start a new run from the weights"
            )
        if samples % self._samples_per_batch:
            raise ValueError(
                f"the checkpoint was saved after {samples} samples of an epoch, no multiple of "
                f"this run's batch of {self._samples_per_batch} samples (batch_size x processes): "
                "resume with the same total batch"
            )
        self._resume_at = (state_dict["epoch"], samples // self._samples_per_batch)


def training_loader(
    dataset: Dataset[Any],
    batch_size: int,
    *,
    seed: int = 0,
    num_replicas: int = 1,
    rank: int = 0,
    limit_batches: float = 1.0,
    with_epoch: bool = False,
    kind: str = "scans",
    **options: Any,
) -> ResumableLoader:
    """Shuffled, resumable loader of full batches; draws nothing from the global random state.

    Args:
        dataset: Data set, of one process or of several with equal data sets.
        batch_size: Samples per batch and process.
        seed: Seed of the order.
        num_replicas: Number of processes.
        rank: Number of this process.
        limit_batches: ``limit_train_batches`` of the trainer.
        with_epoch: Index the data set with ``(epoch, index)``.
        kind: Name of the samples in error messages.
        **options: Options of ``DataLoader``.

    Raises:
        ValueError: If the data set is smaller than one batch over all processes.
    """
    num_samples = len(cast(Sized, dataset))
    if num_samples < batch_size * num_replicas:
        raise ValueError(
            f"{num_samples} training {kind} do not fill one batch of {batch_size} {kind} for each "
            f"of {num_replicas} processes: use a smaller batch_size or more {kind}"
        )
    sampler = EpochSampler(dataset, seed, num_replicas, rank, with_epoch)
    loader = ResumableLoader(
        dataset,
        batch_size=batch_size,
        sampler=sampler,
        drop_last=True,
        generator=torch.Generator(),  # the default draws from the global random state
        **options,
    )
    batches = limit_batches if isinstance(limit_batches, int) else limit_batches * len(loader)
    loader.batches_per_epoch = min(int(batches), len(loader))
    return loader


def plain_loader(
    dataset: Dataset[Any], batch_size: int, num_workers: int = 0, **options: Any
) -> DataLoader[Any]:
    """Loader of all samples in order; draws nothing from the global random state.

    ``options`` are of ``DataLoader``.
    """
    return DataLoader(
        dataset,
        batch_size=batch_size,
        num_workers=num_workers,
        generator=torch.Generator(),  # the default draws from the global random state
        **options,
    )


def worker_options(num_workers: int) -> dict[str, Any]:
    """Options of a ``DataLoader`` whose processes serve every epoch of a training."""
    return {
        "num_workers": num_workers,
        "pin_memory": torch.cuda.is_available(),
        "persistent_workers": num_workers > 0,
    }


def at_least(least: int, **values: int | None) -> None:
    """Refuse named arguments below their range; None passes.

    Raises:
        ValueError: Naming the argument.
    """
    for name, value in values.items():
        if value is not None and value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")
