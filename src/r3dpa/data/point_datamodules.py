"""Lightning data modules of networks on points."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch.utils.data import DataLoader

from lidarsim.weather import WeatherPrior
from r3dpa.data.datamodules import LidarDataModule
from r3dpa.data.datasets import DrawnPoints, LabelledPoints
from r3dpa.data.loader_module import LoaderModule


class PointDataModule(LoaderModule):
    """Points of the scans of another data module, prepared at random in each epoch.

    Batches are lists of what ``prepare`` returns; no feature grids are made.

    Args:
        source: Scans and their split, simulated where it does that. Give it ``extractor: null``.
            Where it caches images, points lie at the centres of pixels, and its codec must have a
            channel of intensity.
        prepare: Function of the points ``(P, 4)`` and a generator, such as
            ``r3dpa.features.Masking``.
        batch_size: Scans per batch and process.
        num_workers: Loader processes per training process.
        seed: Seed of order and draws.
        weather: Weather of training scans, drawn anew in each epoch; none by default.
    """

    points_class = DrawnPoints

    def __init__(
        self,
        source: LidarDataModule,
        prepare: Callable[..., Any],
        batch_size: int = 2,
        num_workers: int = 0,
        seed: int = 0,
        weather: WeatherPrior | None = None,
    ) -> None:
        super().__init__(batch_size, num_workers, seed)
        if source.extractor is not None:
            raise ValueError(
                "--data.init_args.source.init_args.extractor must be null: a network on points is "
                "trained without feature grids"
            )
        self.source, self.prepare, self.weather_prior = source, prepare, weather
        self.prepare_data_per_node = source.prepare_data_per_node

    def prepare_data(self) -> None:
        """Simulate the scans, where the source does."""
        self.source.prepare_data()

    def setup(self, stage: str) -> None:
        """Index the scans."""
        images = self.source.images
        if images is not None and not self.source.codec.intensity_channel:
            raise ValueError(
                "--data.init_args.source caches ranges alone, and a network on points reads "
                "intensities: set source.init_args.codec.intensity_channel to true"
            )
        self.train_set, self.val_set = (
            self.points_class(
                scans, self.source.sensor, self.prepare, images, self.seed, self.weather_prior
            )
            for scans in self.source.limited_split()
        )

    def train_dataloader(self) -> DataLoader[Any]:
        """Shuffled, resumable loader of full batches."""
        return self.loader(self.train_set, train=True, with_epoch=True, collate_fn=list)

    def val_dataloader(self) -> DataLoader[Any]:
        """Held-out scans in order, none twice, each drawn the same every time."""
        return self.loader(self.val_set, train=False, collate_fn=list)


class LabelledPointDataModule(PointDataModule):
    """Points of the scans of another data module, masked, with the classes of those that have any.

    Weather would move points away from their labels, so there is none.

    Args:
        source: Scans and their split, with or without label files, see
            :func:`r3dpa.data.labels.find_labels`, or with classes in its cached images. Give it
            ``extractor: null``.
        prepare: An ``r3dpa.features.Masking``.
        kwargs: Further arguments of :class:`PointDataModule`.
    """

    points_class = LabelledPoints

    def __init__(self, source: LidarDataModule, prepare: Callable[..., Any], **kwargs: Any) -> None:
        super().__init__(source, prepare, weather=None, **kwargs)  # so that it is no option
