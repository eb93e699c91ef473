"""Augmentation of a scan together with its range image and its feature grid.

Mirroring left and right and rotating about the vertical axis by whole grid columns move whole
pixels and cells: image and stored grid are reordered, nothing is projected or extracted again.
Letters: H beams, W columns, h x w cells, D feature width.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from lidarsim.weather import WeatherPrior
from r3dpa.data.datasets import WEATHER_STREAM, LidarDataset
from r3dpa.geometry import BeamProjection, Projection

# Separate these draws from the draws of the order, which have the same seed.
_STREAM = 1


@dataclass(frozen=True)
class View:
    """A scan mirrored or not, then rotated by ``columns`` of the ``grid_columns`` w of its grid.

    Everything moves to the right, that is clockwise seen from above.

    Example:
        >>> View(columns=1, mirrored=False, grid_columns=4).image(torch.arange(4))
        tensor([3, 0, 1, 2])
    """

    columns: int
    mirrored: bool
    grid_columns: int

    def image(self, image: Tensor, projection: Projection | None = None) -> Tensor:
        """Reordered image ``(..., W)``, W a multiple of w.

        Equals projecting the transformed points, but for those at the border of two pixels: a pixel
        holds its left border only, which mirroring makes the right one. Beams beside the axis
        (``lateral_m`` of a BeamProjection) keep their side: mirrored, they are off by twice that.

        Args:
            image: ``(..., W)``, or ``(..., H, W)`` with a projection.
            projection: Of the image, whose beams may be turned against each other.
        """
        if self.mirrored and isinstance(projection, BeamProjection):
            image = _with_moved_rows(image, -projection.mirrored_columns())
        return self._reordered(image, -1, image.shape[-1] // self.grid_columns)

    def grid(self, grid: Tensor) -> Tensor:
        """Reordered feature grid ``(h * w, D)``, see :meth:`Augmentation.check_extractor`."""
        return self._reordered(grid.unflatten(0, (-1, self.grid_columns)), 1, 1).flatten(0, 1)

    def sample(self, sample: dict[str, Any], projection: Projection) -> dict[str, Any]:
        """Transformed training sample; index and name stay."""
        result = dict(sample)
        for name in result.keys() & {"range_image", "valid_mask"}:
            result[name] = self.image(result[name], projection)
        if "posterior_moments" in result:
            result["posterior_moments"] = self.image(result["posterior_moments"])
        if "feature_grid" in result:
            result["feature_grid"] = self.grid(result["feature_grid"])
        return result

    def _reordered(self, values: Tensor, axis: int, cell_columns: int) -> Tensor:
        if self.mirrored:
            values = values.flip(axis)
        return torch.roll(values, self.columns * cell_columns, axis)


@dataclass(frozen=True)
class Augmentation:
    """Views of the training scans, drawn anew for each scan and epoch.

    Args:
        rotate: Rotate by a whole number of grid columns, each equally likely.
        flip: Mirror left and right in half of the cases.
        approximate_grids: Reorder also grids whose features do not follow the scan exactly, or
            are not known to.
    """

    rotate: bool = False
    flip: bool = False
    approximate_grids: bool = False

    @property
    def active(self) -> bool:
        """Whether anything is drawn at all."""
        return self.rotate or self.flip

    def draw(self, seed: int, epoch: int, index: int, grid_columns: int) -> View:
        """View of one scan in one epoch: a function of the arguments alone."""
        generator = np.random.default_rng((seed, epoch, index, _STREAM))
        columns = int(generator.integers(grid_columns))
        mirrored = bool(generator.random() < 0.5)
        return View(columns if self.rotate else 0, self.flip and mirrored, grid_columns)

    def check_extractor(self, extractor: Any, grid_columns: int) -> None:
        """Refuse extractors whose reordered grids may differ from the grids of the view.

        Judged by ``num_headings`` and ``mirror_invariant``, see :class:`r3dpa.data.Extractor`.

        Raises:
            ValueError: Naming the option and the property that the features lack.
        """
        problems = {}
        headings = getattr(extractor, "num_headings", None) or 1
        if self.rotate and headings % grid_columns != 0:
            problems["rotate"] = f"rotate with the scan by a {grid_columns}th of a turn"
        if self.flip and not getattr(extractor, "mirror_invariant", False):
            problems["flip"] = "stay the same when the scan is mirrored"
        if problems and not self.approximate_grids:
            options = " and ".join(problems)
            name = "of an unknown extractor" if extractor is None else f"of {extractor.name!r}"
            raise ValueError(
                f"augmentation.{options}: the features {name} are not known to "
                f"{' or to '.join(problems.values())}. Switch {options} off, use "
                "GeometricFeatures, or train on the approximation with "
                "augmentation.approximate_grids: true"
            )

    def check_latents(self, latent_columns: int, grid_columns: int) -> None:
        """Refuse views whose posteriors are no reordered cached posteriors.

        The encoder commutes with rotation by its column stride only, and not with mirroring.

        Raises:
            ValueError: Naming the option to switch off.
        """
        if self.flip:
            reason = "flip: the encoder of the VAE does not commute with mirroring"
        elif self.rotate and latent_columns % grid_columns:
            columns = f"{latent_columns} columns of the latents"
            reason = f"rotate: {grid_columns} grid columns do not divide the {columns}"
        else:
            return
        raise ValueError(
            f"augmentation.{reason}. Switch it off, or encode in each step: "
            "--model.init_args.cache_latents false"
        )


@dataclass(eq=False, repr=False)
class AugmentedDataset(Dataset[dict[str, Any]]):
    """Samples ``(epoch, index)`` of a dataset in the weather and the view drawn for them."""

    dataset: LidarDataset
    augmentation: Augmentation
    seed: int
    grid_columns: int
    weather: WeatherPrior | None = None

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, key: tuple[int, int]) -> dict[str, Any]:
        view = self.augmentation.draw(self.seed, *key, self.grid_columns)
        projection = self.dataset.projection
        if self.weather is None:
            return view.sample(self.dataset[key[1]], projection)
        change = partial(self.weather.points, seed=(self.seed, *key, WEATHER_STREAM))
        return view.sample(self.dataset.sample(key[1], change), projection)


def _with_moved_rows(image: Tensor, columns: Tensor) -> Tensor:
    """Image ``(..., H, W)`` whose rows are moved to the right by ``columns`` ``(H,)``."""
    sources = torch.arange(image.shape[-1]) - columns[:, None]
    return image.gather(-1, (sources % image.shape[-1]).expand_as(image))
