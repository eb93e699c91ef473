"""Feature grids: point features of a frozen extractor, averaged over the cells of a grid, on disk.

``features_dir`` belongs to one extractor. Each grid size has a store ``features_dir/<h>x<w>``, see
:mod:`r3dpa.data.store`. Letters: P points, K values before the linear step, N = h * w cells, D
feature width, B batch.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from glob import has_magic
from pathlib import Path
from typing import Any, Literal, Protocol, Self

import torch
from torch import Tensor
from tqdm import tqdm

from r3dpa.data.datasets import CachedImages, PointDataset, PointSample
from r3dpa.data.loaders import plain_loader
from r3dpa.data.scans import Scan
from r3dpa.data.store import CachedTensors, Store, StoreError, writing
from r3dpa.geometry import Projection, pool_cells, projection_to_dict
from r3dpa.io import json_values, only_writer

REMEDY = "with `r3dpa data features --data <data YAML or folder>`"


class Extractor(Protocol):
    """Frozen network whose features of a scan are ``lift(point_features([prepare(points)])[0])``.

    A linear last step belongs into ``lift((N, K)) -> (N, dim)``, which may be absent: it commutes
    with the mean of a cell, so that cells are lifted instead of points. For augmentation, optional
    ``num_headings`` says that features are invariant to rotating a scan by multiples of
    ``2 * pi / num_headings``, and ``mirror_invariant`` to swapping left and right.

    Attributes:
        name: Short name, also of the default folder.
        dim: Width D of the features.
        settings: Whatever else determines the features, as JSON values; compared on opening.
        prepare: CPU part for the points ``(P, 4)`` x, y, z (metres), intensity of one scan, run in
            loader processes: can be pickled and holds no weights.
    """

    name: str
    dim: int
    settings: dict[str, Any]
    prepare: Callable[..., Any]

    def point_features(self, prepared: Sequence[Any]) -> list[Tensor]:
        """``(P, K)`` of each prepared scan, on the device of the extractor."""
        ...

    def __call__(self, points: Tensor) -> Tensor:
        """Features ``(P, dim)`` of the points ``(P, 4)``."""
        ...


@dataclass(frozen=True)
class GridSettings:
    """Settings of the grids of one store.

    ``projection`` and ``extractor`` (its name and settings) are plain values, ``grid_size`` (h, w),
    ``dim`` the width D; ``precision`` the extractor's, as Lightning names it.
    """

    projection: dict[str, Any]
    grid_size: tuple[int, int]
    extractor: dict[str, Any]
    dim: int
    dtype: Literal["float16"]
    precision: str

    @classmethod
    def of(
        cls,
        extractor: Extractor,
        projection: Projection,
        grid_size: tuple[int, int],
        precision: str = "32-true",
    ) -> Self:
        """Settings of the grids of an extractor.

        Raises:
            ValueError: If the grid does not divide the range image.
        """
        projection.sensor.cell_size(grid_size)
        wanted = _wanted(projection, extractor)
        return cls(
            grid_size=(grid_size[0], grid_size[1]), dtype="float16", precision=precision, **wanted
        )

    def store(self, features_dir: str | Path) -> Store:
        """Store of these grids, each ``(N, D)``."""
        return Store(
            folder=Path(features_dir) / f"{self.grid_size[0]}x{self.grid_size[1]}",
            settings=json.dumps(vars(self), indent=1),
            shape=(math.prod(self.grid_size), self.dim),
            dtype=self.dtype,
            what="feature grids",
            remedy=f"{REMEDY}, or give the data module an extractor",
        )

    def compare(self, wanted: Mapping[str, Any], features_dir: Path) -> None:
        """Compare these, the stored settings, with the wanted ones.

        Raises:
            StoreError: Naming a value that differs.
        """
        for key, value in wanted.items():
            if getattr(self, key) != value:
                folder = self.store(features_dir).folder
                raise _made_otherwise(key, getattr(self, key), value, folder)


def _wanted(projection: Projection, extractor: Extractor | None) -> dict[str, Any]:
    """Settings that a reader of grids needs, as JSON returns them; any extractor if None."""
    wanted: dict[str, Any] = {"projection": projection_to_dict(projection)}
    if extractor is not None:
        wanted["extractor"] = {"name": extractor.name, "settings": extractor.settings}
        wanted["dim"] = extractor.dim
    return dict(json_values(wanted))


def _made_otherwise(key: str, stored: Any, wanted: Any, folder: Path) -> StoreError:
    return StoreError(
        f"feature grids in {folder} were made with {key} {stored}, but {key} {wanted} is needed: "
        f"restore that setting, or give another features_dir and make new grids {REMEDY}"
    )


def stored_settings(features_dir: str | Path) -> dict[tuple[int, int], GridSettings]:
    """Settings of the stores of a folder by grid size.

    Raises:
        StoreError: If a file of settings is damaged.
    """
    stored = {}
    for path in sorted(Path(features_dir).glob("*/settings.json")):
        try:
            values = json.loads(path.read_text())
            settings = GridSettings(**values | {"grid_size": tuple(values["grid_size"])})
            store = settings.store(features_dir)
            if path.parent != store.folder:
                raise ValueError(f"it is of grid_size {list(settings.grid_size)}")
            _ = store.row_bytes, settings.extractor["name"]  # raise here if they are damaged
        except (LookupError, TypeError, ValueError, OverflowError, RecursionError) as error:
            raise StoreError(
                f"{path} is damaged ({error!r:.200}): delete {path.parent} and make its grids "
                f"again {REMEDY}"
            ) from error
        stored[settings.grid_size] = settings
    return stored


def any_settings(features_dir: str | Path) -> GridSettings:
    """Settings of any grids of a folder, all of one extractor.

    Raises:
        StoreError: If there are none.
    """
    stored = stored_settings(features_dir)
    if not stored:
        raise _no_grids(features_dir)
    return next(iter(stored.values()))


def _no_grids(features_dir: str | Path) -> StoreError:
    return StoreError(
        f"no feature grids in {features_dir}: make them {REMEDY}, or give an extractor"
    )


class FeatureGrids(CachedTensors[Scan]):
    """Grids ``(N, D)`` of one size (h, w), cells row by row; ``dim`` is D.

    Raises:
        StoreError: If the grid of one of ``scans`` is missing, was made with another projection or
            extractor (any if None), or the store is damaged.
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
            raise _no_grids(features_dir)
        if size not in stored:
            sizes = ", ".join(str(list(other)) for other in stored)
            raise _made_otherwise("grid_size", sizes, list(size), Path(features_dir))
        settings = stored[size]
        settings.compare(_wanted(projection, extractor), Path(features_dir))
        super().__init__(settings.store(features_dir), scans)
        self.dim = settings.dim


@dataclass(frozen=True)
class GridPlan:
    """Grids to make: stores by size, scans that lack one (sorted), disk space in bytes."""

    stores: Mapping[tuple[int, int], Store]
    missing: Sequence[Scan]
    num_kept: int
    num_bytes: int


def plan(
    scans: Sequence[Scan],
    extractor: Extractor,
    projection: Projection,
    grid_sizes: Sequence[tuple[int, int]],
    features_dir: str | Path,
    precision: str = "32-true",
) -> GridPlan:
    """Find the grids that are missing; arguments as for :func:`write_feature_grids`.

    ``precision`` counts only where grids are missing.

    Raises:
        StoreError: If there are grids of other settings.
        ValueError: If there are no grid sizes, or one does not divide the range image.
    """
    if not grid_sizes:
        raise ValueError("grid_sizes is empty: give at least one, for example [[8, 64]]")
    features_dir, scans = Path(features_dir), sorted(scans)
    wanted, stored = _wanted(projection, extractor), stored_settings(features_dir)
    stores, missing, num_bytes = {}, set(), 0
    for h, w in grid_sizes:
        settings = GridSettings.of(extractor, projection, (h, w), precision)
        for size, other in stored.items():
            keys = wanted if size == (h, w) else ("extractor", "dim")
            other.compare({key: wanted[key] for key in keys}, features_dir)
        stores[h, w] = store = settings.store(features_dir)
        new = store.missing(scans)
        if new and (h, w) in stored:
            stored[h, w].compare({"precision": precision}, features_dir)
        missing |= set(new)
        num_bytes += len(new) * store.row_bytes
    return GridPlan(stores, sorted(missing), len(scans) - len(missing), num_bytes)


@torch.inference_mode()
def pooled_grids(
    extractor: Extractor,
    samples: Sequence[PointSample],
    projection: Projection,
    grid_sizes: Sequence[tuple[int, int]],
) -> dict[tuple[int, int], Tensor]:
    """Feature grids of B prepared scans; the means and the linear step in float32 at least.

    Returns:
        ``(B, N, D)`` float32 on the CPU for each grid size (h, w); empty cells are zero.

    Raises:
        StoreError: Naming the scan whose features are not finite.
    """
    features = extractor.point_features([sample.prepared for sample in samples])
    grids: dict[tuple[int, int], list[Tensor]] = {(h, w): [] for h, w in grid_sizes}
    for sample, values in zip(samples, features, strict=True):
        for size, of_size in grids.items():
            of_size.append(_pooled(extractor, sample.points, values, projection, size))
            if not of_size[-1].isfinite().all():
                raise StoreError(
                    f"{sample.scan.path}: extractor {extractor.name} gave NaN or infinite "
                    "features; run it in float32 or leave this scan out"
                )
    return {size: torch.stack(of_size) for size, of_size in grids.items()}


def grid_of_points(
    extractor: Extractor, points: Tensor, projection: Projection, grid_size: tuple[int, int]
) -> Tensor:
    """Feature grid ``(N, D)`` float32 on the CPU of points ``(P, 4)`` that are no file."""
    values = extractor.point_features([extractor.prepare(points)])[0]
    return _pooled(extractor, points, values, projection, grid_size)


def _pooled(
    extractor: Extractor,
    points: Tensor,
    values: Tensor,
    projection: Projection,
    grid_size: tuple[int, int],
) -> Tensor:
    """Lifted means ``(N, D)`` of the features of points ``(P, 4)``; empty cells are zero."""
    lift = getattr(extractor, "lift", torch.nn.Identity())
    with torch.autocast(values.device.type, enabled=False):
        means, _ = pool_cells(points[:, :3].to(values.device), values, projection, grid_size)
        return lift(means).float().cpu()


def write_feature_grids(
    scans: Sequence[Scan],
    extractor: Extractor,
    projection: Projection,
    grid_sizes: Sequence[tuple[int, int]],
    features_dir: str | Path,
    *,
    workers: int = 0,
    batch_size: int = 1,
    images: CachedImages | None = None,
) -> int:
    """Make the missing grids of ``scans`` in this process.

    Waits for another process that writes to the folder. An error or a kill costs the grids of the
    last batch only.

    Args:
        scans: Scans that need grids.
        extractor: Feature source, which runs where its tensors are.
        projection: Projection of the range images.
        grid_sizes: Rows and columns (h, w) of each grid.
        features_dir: Folder of the grids of this extractor.
        workers: Processes that read and prepare scans, 0 for none.
        batch_size: Scans that the extractor takes at once.
        images: Cached images of the scans, if they are no files.

    Returns:
        Number of scans whose grids were made.

    Raises:
        StoreError: As for :func:`plan`.
        ScanError: If a scan cannot be used.
    """
    if not plan(scans, extractor, projection, grid_sizes, features_dir).missing:
        return 0  # complete grids may lie on a read-only disk
    with features_lock(features_dir):
        # Again, since another process may have made some.
        todo = plan(scans, extractor, projection, grid_sizes, features_dir)
        dataset = PointDataset(todo.missing, projection.sensor, extractor.prepare, images)
        loader = plain_loader(dataset, batch_size, workers, collate_fn=list)
        with ExitStack() as stack:
            writers = {size: stack.enter_context(s.writer()) for size, s in todo.stores.items()}
            for samples in tqdm(loader, desc="feature grids", unit="scan", disable=None):
                grids = pooled_grids(extractor, samples, projection, list(todo.stores))
                for size, writer in writers.items():
                    writer.add([sample.key for sample in samples], grids[size])
    return len(todo.missing)


@contextmanager
def features_lock(features_dir: str | Path) -> Iterator[None]:
    """Hold the lock of the job that makes grids in a folder; waits for another one."""
    folder = Path(features_dir)
    with writing("feature grids", folder):
        folder.mkdir(parents=True, exist_ok=True)
    with only_writer(folder / ".lock", f"makes feature grids in {folder}", wait=True):
        yield


def default_features_dir(scans: str | list[str], extractor: str) -> Path:
    """Folder of feature grids for a single folder of scans where none is given.

    ``runs/feature_grids/<folder>-<hash of its path>/<extractor>``, so that nothing is written
    beside the scans of a user; ``<scans>/feature_grids/<extractor>`` where that folder exists.

    Raises:
        ValueError: If the scans come from a file, glob or list.
    """
    if not isinstance(scans, str) or has_magic(scans) or Path(scans).is_file():
        raise ValueError(
            f"features_dir is needed for scans given as {scans!r}: only a single folder has a "
            "default place for its feature grids"
        )
    beside = Path(scans) / "feature_grids" / extractor
    if beside.is_dir():
        return beside
    place = Path(scans).absolute()
    digest = hashlib.sha256(str(place).encode()).hexdigest()[:8]
    return Path("runs", "feature_grids", f"{place.name}-{digest}", extractor)
