"""Posteriors of a frozen image VAE, computed once and kept in shards with their statistics.

Other settings find another folder, never a wrong row; folders of settings that nobody uses any
more may be deleted. Letters: C latent channels, h x w latent size.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from r3dpa.atomic import atomic_path
from r3dpa.data.images import ImageEntry, ImageError
from r3dpa.data.row_store import RowReader, Rows, RowWriter
from r3dpa.data.scans import evenly

__all__ = ["ImageLatents", "ImagePosteriors"]

_FLOAT_BYTES = 4
_VERSION = 1  # to be raised when other numbers come out of the same settings
_IMAGES_TO_MEASURE = 10_000

_ROWS = Rows(
    "cached image latents",
    "latents_dir",
    "rows again by starting the run again",
    ImageError,
)


@dataclass(frozen=True)
class ImageLatents:
    """Place of the posterior moments of images.

    Args:
        root: Folder of caches.
        settings: All that the posteriors depend on beside the entry, as JSON values.
        shape: ``(2C, h, w)``.
    """

    root: Path
    settings: Mapping[str, Any]
    shape: tuple[int, int, int]

    @property
    def folder(self) -> Path:
        """``root/image_latents_<hash of settings, shape and version>``."""
        digest = hashlib.sha256(self._about.encode()).hexdigest()
        return self.root / f"image_latents_{digest[:16]}"

    @property
    def row_bytes(self) -> int:
        """Disk space of the moments of one image."""
        return _FLOAT_BYTES * math.prod(self.shape)

    @property
    def _about(self) -> str:
        values = {"version": _VERSION, "shape": self.shape, "settings": self.settings}
        return json.dumps(values, indent=1, sort_keys=True)

    def missing(self, entries: Sequence[ImageEntry]) -> list[ImageEntry]:
        """Those of the entries that have no row.

        Raises:
            ImageError: If the cache is damaged.
        """
        known = _ROWS.places(self.folder, self.row_bytes).keys()
        return [entry for entry in entries if _key(entry) not in known]

    @contextmanager
    def writer(self, shard: int) -> Iterator[Callable[[Sequence[ImageEntry], Tensor], None]]:
        """Function that appends the moments ``(B, 2C, h, w)`` of some entries.

        Args:
            shard: Shard that is written, one for each process.

        Raises:
            ImageError: If the folder cannot be written or is damaged, or moments are not finite.
        """
        with _ROWS.writing(self.folder), atomic_path(self.folder / "settings.json") as temporary:
            temporary.write_text(self._about)
        writer = RowWriter(self.folder, self.row_bytes, _ROWS, shard)

        def add(entries: Sequence[ImageEntry], moments: Tensor) -> None:
            sound = moments.isfinite().flatten(1).all(dim=1).tolist()
            if not all(sound):
                entry = entries[sound.index(False)]
                raise ImageError(
                    f"{entry.path}: {entry.name}: its latents are not finite; look at the image, "
                    "or encode in 32-true"
                )
            keys = [_key(entry) for entry in entries]
            if new := writer.new(keys):
                rows = moments[new].float().cpu().contiguous().numpy().astype("<f4", copy=False)
                writer.add([keys[place] for place in new], rows.tobytes())

        try:
            yield add
        finally:
            writer.close()


class ImagePosteriors:
    """Moments by entry, read from disk; safe to hand to loader processes.

    Args:
        latents: Where they are.
        entries: Entries that will be asked for.

    Raises:
        ImageError: If one is missing.

    Attributes:
        entries: As given.
    """

    def __init__(self, latents: ImageLatents, entries: Sequence[ImageEntry]) -> None:
        self.shape, self._folder = latents.shape, latents.folder
        names = {entry.name for entry in entries}
        self.entries = list(entries)
        self._reader = RowReader(latents.folder, latents.row_bytes, _ROWS, names)
        if missing := names - {key[0] for key in self._reader.places}:
            raise ImageError(
                f"{latents.folder} lacks {len(missing)} of {len(names)} images, such as "
                f"{min(missing)}: start the run again, which adds them."
            )

    def read(self, entry: ImageEntry) -> Tensor:
        """Moments ``(2C, h, w)`` of one entry, a copy.

        Raises:
            ImageError: If the entry was not given to the constructor, or has another size than the
                one that was encoded.
        """
        found = self._reader.find(_key(entry))
        if found is None:
            raise ImageError(
                f"{entry.path}: {entry.name} was replaced after {self._folder} was made: start the "
                "run again, which adds it."
            )
        mapping, start = found
        values = torch.frombuffer(
            mapping, dtype=torch.float32, count=math.prod(self.shape), offset=start
        )
        return values.reshape(self.shape).clone()

    def statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and variance ``(C,)`` of the raw latents, samples of the posteriors.

        Of at most 10 000 images, spread evenly. They are written to ``statistics.json`` too.
        """
        chosen = evenly(self.entries, _IMAGES_TO_MEASURE)
        sums = torch.zeros(3, self.shape[0] // 2, dtype=torch.float64)
        for entry in chosen:
            mean, logvar = self.read(entry).double().flatten(1).chunk(2)
            sums += torch.stack([mean.sum(1), mean.square().sum(1), logvar.exp().sum(1)])
        mean, square, noise = sums / (len(chosen) * self.shape[1] * self.shape[2])
        variance = square - mean.square() + noise
        with (
            _ROWS.writing(self._folder),
            atomic_path(self._folder / "statistics.json") as temporary,
        ):
            about = {
                "images": len(chosen),
                "mean": mean.tolist(),
                "variance": variance.tolist(),
            }
            temporary.write_text(json.dumps(about, indent=1))
        return mean.float(), variance.float()


def _key(entry: ImageEntry) -> tuple[str, int]:
    return entry.name, entry.num_bytes
