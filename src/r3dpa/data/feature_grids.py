"""Feature grids on disk: pooled point features, one memory-mapped file per drive.

``root/<drive>/grids.npy`` holds float16 ``(scans, h * w, D)``; ``root/<drive>/index.json`` says
how it was made, and the scan and its bytes for each row. Rows are appended, the index is replaced
afterwards: what it does not name does not count. ``root/.lock`` is held by the process that writes.
"""

from __future__ import annotations

import fcntl
import json
import logging
import math
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from r3dpa.atomic import atomic_path
from r3dpa.data.scans import Scan, read_scan
from r3dpa.geometry import Projection, pool_cells, projection_to_dict

_log = logging.getLogger(__name__)
_GRIDS = "grids.npy"
_INDEX = "index.json"


class Extractor(Protocol):
    """Frozen network that describes every point of a scan.

    An extractor whose last step is linear may also offer ``point_features(points) -> (P, K)`` and
    ``lift((N, K)) -> (N, dim)``, of which its forward pass is the composition: the mean of a cell
    commutes with a linear step, so the writer then pools the K values and lifts the cells only.

    It may also say which augmentation its features follow: ``num_headings``, if rotating a scan by
    any multiple of ``2 * pi / num_headings`` about the vertical axis leaves the features of its
    points alone, and ``mirror_invariant``, if swapping left and right does.

    Attributes:
        name: Short name, part of the default folder name.
        dim: Width D of the features.
        settings: Whatever else determines the features, as JSON values; compared on opening.
    """

    name: str
    dim: int
    settings: dict[str, Any]

    def __call__(self, points: Tensor) -> Tensor:
        """Features ``(P, dim)`` of the points ``(P, 4)`` x, y, z (metres), intensity."""
        ...


class FeatureGridError(ValueError):
    """Grids that are missing or were made with other settings; the message says the remedy."""


def default_features_dir(data_root: str | Path, name: str, grid_size: tuple[int, int]) -> Path:
    """``data_root/feature_grids/<name>_<h>x<w>``, where grids are kept unless another is given."""
    return Path(data_root) / "feature_grids" / f"{name}_{grid_size[0]}x{grid_size[1]}"


def grid_bytes(grid_size: tuple[int, int], dim: int) -> int:
    """Bytes on disk of one grid, float16 ``(h * w, dim)``."""
    return math.prod(grid_size) * dim * np.dtype(np.float16).itemsize


def write_feature_grids(
    scans: Sequence[Scan],
    extractor: Extractor,
    projection: Projection,
    grid_size: tuple[int, int],
    root: str | Path,
    *,
    workers: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Make the grids that are missing for ``scans``; those that exist are kept.

    One process writes at a time; another one waits and then makes what is still missing. After an
    error or Ctrl-C the grids made so far are kept, after a kill those of the drives done.

    Args:
        scans: Scans, of any number of drives.
        extractor: Frozen network, run on the device of its parameters and buffers.
        projection: That of the range images.
        grid_size: Rows and columns (h, w) of the grid.
        root: Folder of the grids.
        workers: Processes that extract in parallel; 0 for none, as on a GPU in any case.
        progress: Called after each scan with the number of grids made and the number to make.

    Returns:
        Number of grids made.

    Raises:
        FeatureGridError: If ``root`` has grids of a drive that were made with other settings,
            cannot be written, or has not enough space left.
        ScanError: If a scan cannot be used; the message names the file.
    """
    root, settings = Path(root), _settings(projection, grid_size, extractor)
    if not _missing_grids(scans, settings, root):
        return 0
    with _locked(root):
        todo = _missing_grids(scans, settings, root)  # another process may have made some
        done, total = 0, sum(len(new) for _, new in todo)
        needed, free = total * grid_bytes(grid_size, extractor.dim), shutil.disk_usage(root).free
        if needed > free:
            raise FeatureGridError(
                f"{total} feature grids need {needed / 1e9:.1f} GB, but {root} has "
                f"{free / 1e9:.1f} GB free: make space, give a features_dir on another disk, or "
                "use fewer scans (limit)."
            )
        for folder, new in todo:
            loader = DataLoader(
                _GridDataset([scan for scan, _ in new], extractor, projection, grid_size),
                batch_size=None,
                num_workers=workers if _device(extractor).type == "cpu" else 0,
                generator=torch.Generator(),  # the default draws from the global random state
            )
            with _opened_drive(folder, settings) as add:
                for (scan, num_bytes), grid in zip(new, loader, strict=True):
                    add(scan.frame, num_bytes, grid)
                    done += 1
                    if progress is not None:
                        progress(done, total)
    return done


class FeatureGrids:
    """Grids of a folder, read scan by scan; safe to hand to loader processes.

    Args:
        root: Folder of the grids.
        scans: Scans that will be asked for; each must have a grid.
        projection: That of the range images.
        grid_size: Rows and columns (h, w) that the grids must have.
        extractor: The extractor that must have made them; any if None.

    Attributes:
        dim: Width D of the features.

    Raises:
        FeatureGridError: If a grid is missing or was made with another sensor, projection, grid
            size or extractor.
    """

    def __init__(
        self,
        root: str | Path,
        scans: Sequence[Scan],
        projection: Projection,
        grid_size: tuple[int, int],
        extractor: Extractor | None = None,
    ) -> None:
        self.root = Path(root)
        expected = _settings(projection, grid_size, extractor)
        self._row: dict[str, tuple[int, int]] = {}  # position, bytes of the scan it was made from
        self._open: dict[str, np.ndarray] = {}
        dims = set()
        for drive, group in groupby(sorted(scans), key=lambda scan: scan.drive):
            members, folder = list(group), self.root / drive
            if not (folder / _INDEX).is_file():
                raise _missing(members[0], self.root)
            index = _read_index(folder)
            _compare(expected, index["settings"], folder)
            dims.add(index["settings"]["dim"])
            rows = {frame: (i, size) for i, (frame, size) in enumerate(index["scans"].items())}
            for scan in members:
                if scan.frame not in rows:
                    raise _missing(scan, self.root)
                self._row[scan.name] = rows[scan.frame]
        if len(dims) != 1:
            raise FeatureGridError(f"{self.root} needs one feature width, found {sorted(dims)}.")
        self.dim: int = dims.pop()

    def read(self, scan: Scan, num_bytes: int) -> Tensor:
        """Grid ``(h * w, D)`` float32 of one scan, cells row by row; empty cells are zero.

        Args:
            scan: One of the scans given to the constructor.
            num_bytes: Size of its file, by which a replaced scan is noticed.

        Raises:
            FeatureGridError: If the scan was not given to the constructor, or the grid was made
                from a file of another size.
        """
        if scan.name not in self._row:
            raise _missing(scan, self.root)
        position, expected = self._row[scan.name]
        folder = self.root / scan.drive
        if num_bytes != expected:
            raise FeatureGridError(
                f"{scan.path} has {num_bytes} bytes, but its feature grid in {folder} was made "
                f"from {expected}: the scan was replaced. Make the grid again with `r3dpa "
                "features --config <data YAML>`."
            )
        if scan.drive not in self._open:
            self._open[scan.drive] = np.load(folder / _GRIDS, mmap_mode="r")
        return torch.from_numpy(self._open[scan.drive][position].astype(np.float32))

    def __getstate__(self) -> dict[str, Any]:
        """State without the open files: each process maps them itself."""
        return self.__dict__ | {"_open": {}}


def stored_feature_dim(root: str | Path) -> int:
    """Width D of the grids below ``root``.

    Raises:
        FeatureGridError: If there are none.
    """
    index = next(Path(root).rglob(_INDEX), None)
    if index is None:
        raise FeatureGridError(
            f"No feature grids in {root}: make them with `r3dpa features --config <data YAML>`, "
            "or give an extractor."
        )
    return _read_index(index.parent)["settings"]["dim"]


class _GridDataset(Dataset[Tensor]):
    """Grid of each scan as float16 ``(h * w, D)``."""

    def __init__(
        self,
        scans: list[Scan],
        extractor: Extractor,
        projection: Projection,
        grid_size: tuple[int, int],
    ) -> None:
        self.scans, self.extractor = scans, extractor
        self.projection, self.grid_size = projection, grid_size

    def __len__(self) -> int:
        return len(self.scans)

    @torch.inference_mode()
    def __getitem__(self, index: int) -> Tensor:
        scan = self.scans[index]
        points = torch.from_numpy(read_scan(scan.path, self.projection.sensor))
        points = points.to(_device(self.extractor))
        point_features = getattr(self.extractor, "point_features", self.extractor)
        values = point_features(points)
        means, _ = pool_cells(points[:, :3], values, self.projection, self.grid_size)
        if hasattr(self.extractor, "lift"):
            means = self.extractor.lift(means)
        if not torch.isfinite(means).all():
            raise FeatureGridError(
                f"{scan.path}: extractor {self.extractor.name} gave NaN or infinite features; "
                "run it in float32 or leave this scan out."
            )
        largest = torch.finfo(torch.float16).max
        return means.float().clamp(-largest, largest).half().cpu()


def _missing_grids(
    scans: Sequence[Scan], settings: dict[str, Any], root: Path
) -> list[tuple[Path, list[tuple[Scan, int]]]]:
    """Folder of each drive that lacks grids, and these scans with their bytes, in order."""
    missing = []
    for drive, members in groupby(sorted(scans), key=lambda scan: scan.drive):
        folder, known = root / drive, {}
        if (folder / _INDEX).is_file():
            index = _read_index(folder)
            _compare(settings, index["settings"], folder)
            known = index["scans"]
        sizes = [(scan, scan.path.stat().st_size) for scan in members]
        if new := [(scan, size) for scan, size in sizes if known.get(scan.frame) != size]:
            missing.append((folder, new))
    return missing


@contextmanager
def _locked(root: Path) -> Iterator[None]:
    """Holds the folder's lock, which the system releases when the process dies."""
    try:
        root.mkdir(parents=True, exist_ok=True)
        file = (root / ".lock").open("w")
    except OSError as error:
        raise FeatureGridError(
            f"Feature grids cannot be written to {root} ({error.strerror}): give a features_dir on "
            "a disk that can be written."
        ) from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _log.warning("waiting for another process that makes feature grids in %s", root)
            fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            fcntl.flock(file, fcntl.LOCK_UN)  # loader processes still hold copies of the file


@contextmanager
def _opened_drive(
    folder: Path, settings: dict[str, Any]
) -> Iterator[Callable[[str, int, Tensor], None]]:
    """Function that writes the grid of a scan (frame, bytes, grid); the index follows at the end.

    The grid of a replaced scan takes the place of the old one; should the index not be written
    after that, the old index names the old size and the grid is made again.
    """
    scans: dict[str, int] = _read_index(folder)["scans"] if (folder / _INDEX).is_file() else {}
    position = {frame: i for i, frame in enumerate(scans)}
    h, w = settings["grid_size"]
    shape, row_bytes = (h * w, settings["dim"]), grid_bytes((h, w), settings["dim"])
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / _GRIDS).open("r+b" if scans else "wb") as file:

        def write_header() -> int:
            header = {"descr": "<f2", "fortran_order": False, "shape": (len(scans), *shape)}
            file.seek(0)
            np.lib.format.write_array_header_1_0(file, header)  # as long for any number of rows
            return file.tell()

        start = write_header()

        def add(frame: str, num_bytes: int, grid: Tensor) -> None:
            row = position.setdefault(frame, len(position))
            file.seek(start + row * row_bytes)
            # Not through a memory map: a full disk is an error here and a killed process there.
            file.write(grid.numpy().astype("<f2").tobytes())
            scans[frame] = num_bytes

        try:
            yield add
        finally:
            write_header()
            file.flush()
            os.fsync(file.fileno())
            if scans:
                index = json.dumps({"settings": settings, "scans": scans}, indent=1)
                with atomic_path(folder / _INDEX) as temporary:
                    temporary.write_text(index)


def _settings(
    projection: Projection, grid_size: tuple[int, int], extractor: Extractor | None
) -> dict[str, Any]:
    settings: dict[str, Any] = {
        "projection": projection_to_dict(projection),
        "grid_size": list(grid_size),
    }
    if extractor is not None:
        settings["extractor"] = {"name": extractor.name, "settings": extractor.settings}
        settings["dim"] = extractor.dim
    return settings


def _compare(expected: dict[str, Any], stored: dict[str, Any], folder: Path) -> None:
    for key, value in json.loads(json.dumps(expected)).items():
        if stored.get(key) != value:
            raise FeatureGridError(
                f"Feature grids in {folder} were made with {key} {stored.get(key)}, but {key} "
                f"{value} is asked for: restore that setting, or give another features_dir and "
                "make new grids there with `r3dpa features --config <data YAML>`."
            )


def _read_index(folder: Path) -> dict[str, Any]:
    path = folder / _INDEX
    try:
        index = json.loads(path.read_text())
        return {"settings": dict(index["settings"]), "scans": dict(index["scans"])}
    except (KeyError, TypeError, ValueError) as error:
        raise FeatureGridError(
            f"{path} is damaged ({error!r}): delete {folder} and make its grids again with "
            "`r3dpa features --config <data YAML>`."
        ) from error


def _missing(scan: Scan, root: Path) -> FeatureGridError:
    return FeatureGridError(
        f"No feature grid for scan {scan.path} in {root}: make it with `r3dpa features --config "
        "<data YAML>`, or give the data module an extractor, which makes what is missing."
    )


def _device(extractor: Extractor) -> torch.device:
    if isinstance(extractor, torch.nn.Module):
        for tensor in (*extractor.parameters(), *extractor.buffers()):
            return tensor.device
    return torch.device("cpu")
