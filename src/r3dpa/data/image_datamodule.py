"""Data set and data module of RGB images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NotRequired, TypedDict

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from r3dpa.data.images import ImageEntry, ImageSource
from r3dpa.data.loader_module import LoaderModule
from r3dpa.data.loaders import at_least
from r3dpa.data.scans import evenly
from r3dpa.data.store import CachedTensors

_IMAGES_TO_MEASURE = 10_000


class ImageBatch(TypedDict):
    """Batch of the stages on RGB images.

    ``image`` ``(B, 3, S, S)`` float32 red, green, blue in [-1, 1], absent where posteriors suffice;
    ``posterior_moments`` ``(B, 2C, h, w)`` float32, means, then log-variances of the raw latents,
    where they are cached; ``index`` ``(B,)`` int64; ``name`` B strings.
    """

    image: NotRequired[Tensor]
    posterior_moments: NotRequired[Tensor]
    index: Tensor
    name: list[str]


@dataclass(eq=False, repr=False)
class ImageDataset(Dataset[dict[str, Any]]):
    """Square images of some entries of a source, or cached posteriors of a VAE, or both."""

    source: ImageSource
    entries: Sequence[ImageEntry]
    size: int
    posteriors: CachedTensors[ImageEntry] | None = None
    with_images: bool = True

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: int) -> dict[str, Any]:
        entry = self.entries[index]
        sample: dict[str, Any] = {"index": index, "name": entry.name}
        if self.with_images:
            pixels = self.source.read(entry, self.size)
            if entry.mirrored:
                pixels = pixels[:, ::-1]
            values = torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)))
            sample["image"] = values.float() / 127.5 - 1.0
        if self.posteriors is not None:
            sample["posterior_moments"] = self.posteriors.read(entry)
        return sample


def latent_statistics(posteriors: CachedTensors[ImageEntry]) -> tuple[Tensor, Tensor]:
    """Mean and variance ``(C,)`` of the raw latents, samples of the posteriors ``(2C, h, w)``.

    At most 10 000 posteriors, spread evenly, are read.
    """
    chosen = evenly(posteriors.items, _IMAGES_TO_MEASURE)
    channels, rows, columns = posteriors.store.shape
    sums = torch.zeros(3, channels // 2, dtype=torch.float64)
    for entry in chosen:
        mean, logvar = posteriors.read(entry).double().flatten(1).chunk(2)
        sums += torch.stack([mean.sum(1), mean.square().sum(1), logvar.exp().sum(1)])
    mean, square, noise = sums / (len(chosen) * rows * columns)
    return mean.float(), (square - mean.square() + noise).float()


class ImageDataModule(LoaderModule):
    """Square RGB images of a source, or cached posteriors of them, shuffled and resumable.

    Args:
        source: Folder, tar shards or generator of images.
        image_size: Side of the images, pixels.
        batch_size: Images per batch **per process**.
        num_workers: Loader processes per training process.
        seed: Seed of the order.
        val_every: Hold out every n-th image.
        mirrored: Also train on the mirror image of each image. Off, as in REPA-E, which caches
            latents of centre crops as they are.
        prepare_data_per_node: Whether the processes of each node encode the images for themselves,
            as node-local disks need; by default all share the work, on a disk that the nodes share.
    """

    def __init__(
        self,
        source: ImageSource,
        image_size: int = 256,
        batch_size: int = 32,
        num_workers: int = 0,
        seed: int = 0,
        val_every: int = 100,
        mirrored: bool = False,
        prepare_data_per_node: bool = False,
    ) -> None:
        super().__init__(batch_size, num_workers, seed)
        self.prepare_data_per_node = prepare_data_per_node
        at_least(1, image_size=image_size)
        at_least(2, val_every=val_every)
        self.source, self.image_size = source, image_size
        self.val_every, self.mirrored = val_every, mirrored

    def setup(self, stage: str) -> None:
        """Index the images.

        Raises:
            ImageError: If there are none, or a file is damaged.
        """
        entries = self.source.entries()
        train = [entry for place, entry in enumerate(entries) if place % self.val_every]
        if self.mirrored:
            train = [view for entry in train for view in (entry, entry.mirror())]
        self.train_set = ImageDataset(self.source, train, self.image_size)
        self.val_set = ImageDataset(self.source, entries[:: self.val_every], self.image_size)

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that the pixels of an entry depend on, as JSON values."""
        kind = type(self.source).__qualname__
        return {"source": kind, "image_size": self.image_size, **self.source.settings()}

    def use_posteriors(self, posteriors: CachedTensors[ImageEntry], with_images: bool) -> None:
        """Train on cached posteriors, and on the pixels too where a teacher needs them."""
        self.train_set = ImageDataset(
            self.source, posteriors.items, self.image_size, posteriors, with_images
        )

    def train_dataloader(self) -> DataLoader[Any]:
        """Shuffled, resumable loader of full batches."""
        return self.loader(self.train_set, train=True, kind="images")

    def val_dataloader(self) -> DataLoader[Any]:
        """Held-out images in order, none twice."""
        return self.loader(self.val_set, train=False, kind="held-out images")

    test_dataloader = val_dataloader
