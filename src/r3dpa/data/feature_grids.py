"""Feature grids on disk: pooled point features, one memory-mapped file per drive.

``root/<drive>/grids.npy`` holds float16 ``(scans, h * w, D)``; ``root/<drive>/index.json`` says
how it was made and which scan each entry belongs to. A drive folder appears only when complete.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, fields
from itertools import groupby
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from r3dpa.data.scans import Scan, read_scan
from r3dpa.geometry import Projection, pool_cells

_GRIDS = "grids.npy"
_INDEX = "index.json"


class Extractor(Protocol):
    """Frozen network that describes every point of a scan.

    An extractor whose last step is linear may also offer ``point_features(points) -> (P, K)`` and
    ``lift((N, K)) -> (N, dim)``, of which its forward pass is the composition: the mean of a cell
    commutes with a linear step, so the writer then pools the K values and lifts the cells only.

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

    A drive is written to a hidden folder that gets its name when complete. After an interruption
    the new scans of that drive are done again, and no other.

    Args:
        scans: Scans, of any number of drives.
        extractor: Frozen network, run on the device of its parameters and buffers.
        projection: That of the range images.
        grid_size: Rows and columns (h, w) of the grid.
        root: Folder of the grids.
        workers: Processes that extract in parallel; 0 for none (needed on a GPU).
        progress: Called after each scan with the number of grids made and the number to make.

    Returns:
        Number of grids made.

    Raises:
        FeatureGridError: If ``root`` has grids of a drive that were made with other settings.
        ScanError: If a scan cannot be used; its drive is left incomplete.
    """
    settings = _settings(projection, grid_size, extractor)
    todo: list[tuple[Path, list[Scan]]] = []
    for drive, members in groupby(sorted(scans), key=lambda scan: scan.drive):
        folder, known = Path(root) / drive, {}
        if (folder / _INDEX).is_file():
            index = _read_index(folder)
            _compare(settings, index["settings"], folder)
            known = index["scans"]
        new = [scan for scan in members if _entry(scan) not in known.items()]
        if new:
            todo.append((folder, new))
    done, total = 0, sum(len(new) for _, new in todo)
    for folder, new in todo:
        for _ in _write_drive(folder, new, settings, extractor, projection, workers):
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
        FeatureGridError: If a grid is missing, was made from another version of its scan, or with
            another sensor, projection, grid size or extractor.
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
        self._position: dict[str, int] = {}
        self._open: dict[str, np.ndarray] = {}
        dims = set()
        for drive, group in groupby(sorted(scans), key=lambda scan: scan.drive):
            members, folder = list(group), self.root / drive
            if not (folder / _INDEX).is_file():
                raise _missing(members[0], self.root)
            index = _read_index(folder)
            _compare(expected, index["settings"], folder)
            dims.add(index["settings"]["dim"])
            positions = {frame: i for i, frame in enumerate(index["scans"])}
            for scan in members:
                if scan.frame not in positions:
                    raise _missing(scan, self.root)
                if _entry(scan) not in index["scans"].items():
                    raise FeatureGridError(
                        f"{scan.path} has {scan.path.stat().st_size} bytes, but its feature grid "
                        f"in {folder} was made from {index['scans'][scan.frame]}: the scan was "
                        f"replaced. Delete {folder} and make the grids again."
                    )
                self._position[scan.name] = positions[scan.frame]
        if len(dims) != 1:
            raise FeatureGridError(f"{self.root} needs one feature width, found {sorted(dims)}.")
        self.dim: int = dims.pop()

    def read(self, scan: Scan) -> Tensor:
        """Grid ``(h * w, D)`` float32 of one scan, cells row by row; empty cells are zero.

        Raises:
            FeatureGridError: If the scan is none of those given to the constructor.
        """
        if scan.name not in self._position:
            raise _missing(scan, self.root)
        if scan.drive not in self._open:
            self._open[scan.drive] = np.load(self.root / scan.drive / _GRIDS, mmap_mode="r")
        grid = self._open[scan.drive][self._position[scan.name]]
        return torch.from_numpy(grid.astype(np.float32))

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


def _write_drive(
    folder: Path,
    new: list[Scan],
    settings: dict[str, Any],
    extractor: Extractor,
    projection: Projection,
    workers: int,
) -> Iterator[None]:
    """Add scans to the grids of one drive, yielding after each."""
    complete = (folder / _INDEX).is_file()
    scans = _read_index(folder)["scans"] if complete else {}
    old = {frame: position for position, frame in enumerate(scans)}
    scans |= dict(_entry(scan) for scan in new)
    h, w = settings["grid_size"]
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    shape = (len(scans), h * w, extractor.dim)
    grids = np.lib.format.open_memmap(partial / _GRIDS, "w+", np.float16, shape)
    if complete:
        grids[: len(old)] = np.load(folder / _GRIDS, mmap_mode="r")
    position_of = {frame: position for position, frame in enumerate(scans)}
    loader = DataLoader(
        _GridDataset(new, extractor, projection, (h, w)),
        batch_size=None,
        num_workers=workers,
        generator=torch.Generator(),  # the default one would draw from the global random state
    )
    for scan, grid in zip(new, loader, strict=True):
        grids[position_of[scan.frame]] = grid.numpy()
        yield
    grids.flush()
    (partial / _INDEX).write_text(json.dumps({"settings": settings, "scans": scans}, indent=1))
    shutil.rmtree(folder, ignore_errors=True)
    partial.replace(folder)


def _entry(scan: Scan) -> tuple[str, int]:
    """What identifies the version of a scan that a grid was made from."""
    return scan.frame, scan.path.stat().st_size


def _settings(
    projection: Projection, grid_size: tuple[int, int], extractor: Extractor | None
) -> dict[str, Any]:
    rows = {f.name: getattr(projection, f.name) for f in fields(projection) if f.name != "sensor"}
    settings: dict[str, Any] = {
        "sensor": asdict(projection.sensor),
        "projection": {"kind": type(projection).__name__, **rows},
        "grid_size": list(grid_size),
    }
    if extractor is not None:
        settings["extractor"] = {"name": extractor.name, "settings": extractor.settings}
        settings["dim"] = extractor.dim
    return settings


def _compare(expected: dict[str, Any], stored: dict[str, Any], folder: Path) -> None:
    for key, value in json.loads(json.dumps(expected)).items():
        if stored[key] != value:
            raise FeatureGridError(
                f"Feature grids in {folder} were made with {key} {stored[key]}, but {key} {value} "
                "is asked for: restore that setting, or give another features_dir and make new "
                "grids there with `r3dpa features --config <data YAML>`."
            )


def _read_index(folder: Path) -> dict[str, Any]:
    return json.loads((folder / _INDEX).read_text())


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
