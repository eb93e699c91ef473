"""Pairs of noise and scene of a trained flow, the training data of its straightening."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from r3dpa.baselines.generator import FULL_SCALE
from r3dpa.baselines.stages import baseline_generator
from r3dpa.checkpoints import read_checkpoint, weights_sha256
from r3dpa.data.loader_module import LoaderModule
from r3dpa.data.loaders import at_least
from r3dpa.data.posterior_cache import fill_cache
from r3dpa.data.store import CachedTensors, ItemKey, Store, tensor_cache
from r3dpa.flow.noise import scene_noise
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.geometry import ScanGeometry

_SAMPLER = SamplerConfig("heun", 82)


@dataclass(frozen=True)
class Pair:
    """Number of a pair and the folder that holds it."""

    number: int
    path: Path

    @property
    def name(self) -> str:
        """Name of the scene."""
        return f"{self.number:010d}"

    @property
    def cache_key(self) -> ItemKey:
        """Key of the cache: the name alone, as a pair has no file that could change."""
        return self.name, 0, 0


class ReflowPairs(LoaderModule):
    """Scenes of a trained flow with the noise that each was made of, as training data.

    Missing scenes are generated before training, by all processes; runs with the same checkpoint
    and sampler share them. The noise of a pair is recomputed from its number.

    Args:
        root: Folder of the scenes: 524 kB each at 2 x 64 x 1024.
        checkpoint: Flow whose averaged weights generate them.
        num_pairs: Number of pairs; officially 1 M for the 2-rectified flow, 100 k to distil it.
        sampler: Solver and steps. Official: dopri5 with a tolerance of 1e-5, about 160 evaluations.
        num_held_out: Pairs, the last ones, for validation and test alone.
        generation_batch: Scenes that are generated together.
        device: Where to generate them: ``cpu``, ``auto``, or ``cuda`` for the process's device.
        batch_size: Pairs per batch and process.
        num_workers: Loader processes per training process.
        seed: Seed of the order of training; the pairs do not depend on it.

    Raises:
        ValueError: If an argument is out of its range.
    """

    def __init__(
        self,
        root: str,
        checkpoint: str,
        num_pairs: int,
        sampler: SamplerConfig = _SAMPLER,
        num_held_out: int = 16,
        generation_batch: int = 16,
        device: str = "auto",
        batch_size: int = 8,
        num_workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__(batch_size, num_workers, seed)
        self.prepare_data_per_node = False  # all processes share the pairs, on all nodes
        at_least(1, num_held_out=num_held_out, generation_batch=generation_batch)
        at_least(num_held_out + 1, num_pairs=num_pairs)
        self.root, self.checkpoint, self.num_pairs = root, checkpoint, num_pairs
        self.sampler, self.num_held_out = sampler, num_held_out
        self.generation_batch, self.device = generation_batch, device

    def setup(self, stage: str) -> None:
        """Generate the scenes that are missing, and open the cache."""
        store, pairs = self._store()
        images = fill_cache(self.trainer, store, pairs, self._generate_images)
        split = len(pairs) - self.num_held_out
        self.train_set = PairDataset(pairs[:split], images)
        self.val_set = PairDataset(pairs[split:], images)

    def train_dataloader(self) -> DataLoader[Any]:
        """Shuffled pairs."""
        return self.loader(self.train_set, train=True, kind="pairs")

    def val_dataloader(self) -> DataLoader[Any]:
        """The held-out pairs in order."""
        return self.loader(self.val_set, train=False)

    test_dataloader = val_dataloader

    def _generate_images(self, pairs: list[Pair]) -> Iterator[Tensor]:
        """Images ``(B, C, H, W)`` of pairs, in order."""
        checkpoint = read_checkpoint(self.checkpoint)
        generator = baseline_generator(checkpoint, self.sampler, device=self.device)
        parts = range(0, len(pairs), self.generation_batch)
        for first in tqdm(parts, "generate", unit="batch", disable=None):
            numbers = [pair.number for pair in pairs[first : first + self.generation_batch]]
            yield clamp_to_sensor(generator.generate(numbers).latents, generator.geometry)

    def _store(self) -> tuple[Store, list[Pair]]:
        checkpoint = read_checkpoint(self.checkpoint)
        if checkpoint.geometry is None:
            raise ValueError(f"{self.checkpoint} does not record which sensor it was trained for")
        self.geometry = ScanGeometry.from_dict(dict(checkpoint.geometry))
        settings = {
            "weights": weights_sha256(checkpoint.network("ema_network").state_dict),
            "settings": dict(checkpoint.settings),
            "sampler": asdict(self.sampler),
            "geometry": self.geometry.to_dict(),
        }
        sensor = self.geometry.projection.sensor
        shape = (self.geometry.codec.channels, sensor.beams, sensor.columns)
        store = tensor_cache(Path(self.root), "pairs", settings, shape)
        return store, [Pair(index, store.folder) for index in range(self.num_pairs)]


@dataclass(eq=False, repr=False)
class PairDataset(Dataset[dict[str, Any]]):
    """Scene as ``range_image`` and its ``noise``, both ``(C, H, W)``, ``index`` and ``name``."""

    pairs: list[Pair]
    images: CachedTensors[Pair]

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> dict[str, Any]:
        pair = self.pairs[index]
        image = self.images.read(pair)
        channels, rows, columns = image.shape
        noise = next(scene_noise((channels, rows, columns), [pair.number], seed=0))[0]
        return {"range_image": image, "noise": noise, "index": index, "name": pair.name}


def clamp_to_sensor(samples: Tensor, geometry: ScanGeometry) -> Tensor:
    """Samples ``(B, C, H, W)`` as images of a scan: clamped, empty out of the sensor's range.

    The official pairs pass through files of metric depth, which does the same.
    """
    samples = samples.clamp(-1, FULL_SCALE)
    codec, sensor = geometry.codec, geometry.projection.sensor
    ranges = codec.encode(codec.ranges_of(samples, sensor)).unsqueeze(1)
    return torch.cat([ranges, samples[:, 1:]], dim=1)
