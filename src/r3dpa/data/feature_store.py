"""Feature grids on disk: a row store and the settings of how its grids were made.

``features_dir`` belongs to one extractor. Each grid size has a store in ``features_dir/<h>x<w>``:
that of :mod:`r3dpa.data.row_store`, and beside it ``settings.json``, see :class:`GridSettings`.
Letters: B batch, N = h * w cells, D feature width.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor

from r3dpa.data.grid_settings import (
    REMEDY,
    FeatureGridError,
    GridSettings,
    check_settings,
    compare_settings,
    made_otherwise,
    store_folder,
    stored_settings,
    wanted_settings,
    write_settings,
)
from r3dpa.data.row_store import RowKey, RowReader, Rows, RowWriter
from r3dpa.data.scans import Scan
from r3dpa.geometry import Projection

if TYPE_CHECKING:
    from r3dpa.data.feature_grids import Extractor

_LARGEST_CODE = 127
_GRIDS = Rows("feature grids", "features_dir", f"grids again with {REMEDY}", FeatureGridError)


class FeatureGridWriter:
    """Appends grids to a shard of its own; a context manager, or to be closed.

    What a killed process left unfinished at the end of the shard is cut off. An error closes the
    writer; what was added before stays.

    Args:
        features_dir: Folder of one extractor; the store lies in a sub-folder by grid size.
        settings: How the grids are made; must be those of the store, if there is one.
        shard: Number of the shard; the next one that no other process writes, if that is taken.

    Attributes:
        shard: Number of the shard that is written.

    Raises:
        FeatureGridError: If the store was made with other settings, is damaged, or cannot be
            written.
    """

    def __init__(self, features_dir: str | Path, settings: GridSettings, shard: int = 0) -> None:
        self._shape, self._row = settings.shape, settings.row
        folder = store_folder(features_dir, settings.grid_size)
        with _GRIDS.writing(folder), _GRIDS.lock(folder):
            check_settings(features_dir, settings)
            write_settings(features_dir, settings)
        self._writer = RowWriter(folder, self._row.itemsize, _GRIDS, shard)
        self.shard = self._writer.shard

    def add(self, samples: Sequence[tuple[Scan, int]], grids: Tensor) -> None:
        """Append grids; those that the store had when it was opened, or has since, are left out.

        When this returns, the rows are on disk and other processes can read them.

        Args:
            samples: B scans, each with the size of its file in bytes.
            grids: ``(B, N, D)``, finite, on any device.

        Raises:
            FeatureGridError: If the disk is full or cannot be written; names the folder.
            ValueError: If the shapes do not fit each other or the settings.
        """
        if tuple(grids.shape) != (len(samples), *self._shape):
            raise ValueError(
                f"grids must be {(len(samples), *self._shape)}, got {tuple(grids.shape)}."
            )
        keys = [(scan.name, num_bytes) for scan, num_bytes in samples]
        new = self._writer.new(keys)
        if new:
            rows = _packed(grids[new].float().cpu().numpy(), self._row)
            self._writer.add([keys[place] for place in new], rows.tobytes())

    def close(self) -> None:
        """Give the shard free; a second call does nothing."""
        self._writer.close()

    def __enter__(self) -> Self:
        """The writer itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close it."""
        self.close()


class FeatureGrids:
    """Grids of one size, read scan by scan; safe to hand to loader processes.

    Args:
        features_dir: Folder of one extractor.
        scans: Scans that will be asked for; each must have a grid.
        projection: That of the range images.
        grid_size: Rows and columns (h, w) of the grids.
        extractor: The extractor that must have made them; any if None.

    Attributes:
        dim: Width D of the features.

    Raises:
        FeatureGridError: If a grid is missing or was made with another sensor, projection, grid
            size or extractor, or if the store is damaged.
    """

    def __init__(
        self,
        features_dir: str | Path,
        scans: Sequence[Scan],
        projection: Projection,
        grid_size: tuple[int, int],
        extractor: Extractor | None = None,
    ) -> None:
        stored, size = stored_settings(features_dir), (grid_size[0], grid_size[1])
        if not stored:
            raise _missing(scans, Path(features_dir))
        if size not in stored:
            sizes = ", ".join(str(list(other)) for other in stored)
            raise made_otherwise("grid_size", sizes, list(size), Path(features_dir))
        self._folder, settings = store_folder(features_dir, size), stored[size]
        compare_settings(wanted_settings(projection, extractor), settings, self._folder)
        self.dim, self._row = settings.dim, settings.row
        wanted = {scan.name for scan in scans}
        self._reader = RowReader(self._folder, self._row.itemsize, _GRIDS, wanted)
        missing = wanted - {key[0] for key in self._reader.places}
        if missing:
            raise _missing([scan for scan in scans if scan.name in missing], self._folder)

    def read(self, scan: Scan, num_bytes: int) -> Tensor:
        """Grid ``(N, D)`` float32 of one scan, cells row by row; empty cells are zero.

        Args:
            scan: One of the scans given to the constructor.
            num_bytes: Size of its file, by which a replaced scan is noticed.

        Raises:
            FeatureGridError: If the scan was not given to the constructor, or the grid was made
                from a file of another size.
        """
        found = self._reader.find((scan.name, num_bytes))
        if found is None:
            raise self._replaced_or_missing(scan, num_bytes)
        mapping, start = found

        def field(name: str) -> Tensor:
            assert self._row.fields is not None
            dtype, offset = self._row.fields[name][:2]
            kind, shape = dtype.subdtype or (dtype, ())
            values = np.frombuffer(mapping, kind, math.prod(shape), start + offset)
            return torch.from_numpy(values.reshape(shape).copy()).float()

        if "values" in (self._row.names or ()):
            return field("values")
        return field("codes").mul_(field("scale")[:, None])

    def _replaced_or_missing(self, scan: Scan, num_bytes: int) -> FeatureGridError:
        others = [str(key[1]) for key in self._reader.places if key[0] == scan.name]
        if not others:
            return _missing([scan], self._folder)
        return FeatureGridError(
            f"{scan.path} has {num_bytes} bytes, but its feature grid in {self._folder} was made "
            f"from {' or '.join(others)}: the scan was replaced. Make the grid again with "
            f"{REMEDY}."
        )


def known_grids(features_dir: str | Path, settings: GridSettings) -> set[RowKey]:
    """Scan name and bytes of each grid of a store; empty if there is no store.

    Raises:
        FeatureGridError: If they would not be those of ``settings``, ``dtype`` and ``precision``
            apart, or the store is damaged.
    """
    folder = store_folder(features_dir, settings.grid_size)
    stored = stored_settings(features_dir).get(settings.grid_size)
    if stored is None:
        return set()
    reading = ("projection", "extractor", "dim")
    compare_settings({key: getattr(settings, key) for key in reading}, stored, folder)
    return set(_GRIDS.places(folder, stored.row.itemsize))


def stored_feature_dim(features_dir: str | Path) -> int:
    """Width D of the grids of a folder, the same for all sizes.

    Raises:
        FeatureGridError: If there are none.
    """
    return _any_settings(features_dir).dim


def stored_source(features_dir: str | Path) -> str:
    """Name of the extractor that made the grids of a folder.

    Raises:
        FeatureGridError: If there are none.
    """
    return str(_any_settings(features_dir).extractor["name"])


def folder_lock(folder: Path, waiting: str | None = None) -> AbstractContextManager[None]:
    """Holds ``folder/.lock``, which the system releases when the process dies.

    Args:
        folder: Made if it is missing.
        waiting: Logged as a warning where another process holds it.

    Raises:
        FeatureGridError: If the folder cannot be written.
    """
    return _GRIDS.lock(folder, waiting)


def _any_settings(features_dir: str | Path) -> GridSettings:
    stored = stored_settings(features_dir)
    if not stored:
        raise FeatureGridError(
            f"No feature grids in {features_dir}: make them with {REMEDY}, or give an extractor."
        )
    return next(iter(stored.values()))


def _packed(grids: np.ndarray, row: np.dtype[Any]) -> np.ndarray:
    """Rows ``(B,)`` of float32 grids ``(B, N, D)``, see :class:`GridSettings`."""
    rows = np.empty(len(grids), row)
    if "values" in (row.names or ()):
        largest = np.finfo(np.float16).max
        rows["values"] = grids.clip(-largest, largest)
        return rows
    scale = np.abs(grids).max(axis=2) / np.float32(_LARGEST_CODE)
    scale[scale < np.finfo(np.float32).tiny] = 0  # too small to be exact, as are their values
    rows["scale"] = scale
    rows["codes"] = np.rint(grids / np.where(scale > 0, scale, np.float32(np.inf))[..., None])
    return rows


def _missing(scans: Sequence[Scan], folder: Path) -> FeatureGridError:
    more = f" and {len(scans) - 1} more" if len(scans) > 1 else ""
    what = f"grid for scan {scans[0].path}{more}" if scans else "grids"
    return FeatureGridError(
        f"No feature {what} in {folder}: make what is missing with {REMEDY}, or give the data "
        "module an extractor, which does."
    )
