"""Feature grids: point features of a frozen extractor, averaged over the cells of a grid, on disk.

``features_dir`` belongs to one extractor. Each grid size has a store ``features_dir/<h>x<w>``, see
:mod:`r3dpa.data.store`. Letters: P points, K values before the linear step, N = h * w cells, D
feature width, B batch.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, Self

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from r3dpa.data.datasets import PointDataset, PointSample, list_collate
from r3dpa.data.scans import Scan
from r3dpa.data.store import CachedTensors, Store, StoreError, StoreWriter, store_lock
from r3dpa.geometry import Projection, pool_cells, projection_to_dict

REMEDY = "with `r3dpa features --data <data YAML or folder>`"
_SETTINGS = "settings.json"


class Extractor(Protocol):
    """Frozen network whose features of a scan are ``lift(point_features([prepare(points)])[0])``.

    A last step that is linear belongs into ``lift((N, K)) -> (N, dim)``, which may be absent: it
    commutes with the mean of a cell, so that cells are lifted instead of points. For augmentation,
    ``num_headings`` may say that rotating a scan by multiples of ``2 * pi / num_headings`` leaves
    the features of its points alone, and ``mirror_invariant`` that swapping left and right does.

    Attributes:
        name: Short name, that of the default folder.
        dim: Width D of the features.
        settings: Whatever else determines the features, as JSON values; compared on opening.
        prepare: Work on the CPU for the points ``(P, 4)`` x, y, z (metres), intensity of one scan,
            done in loader processes: can be pickled and holds no weights.
    """

    name: str
    dim: int
    settings: dict[str, Any]
    prepare: Callable[..., Any]

    def point_features(self, prepared: Sequence[Any]) -> list[Tensor]:
        """``(P, K)`` of each scan that was prepared, on the device of the extractor."""
        ...

    def __call__(self, points: Tensor) -> Tensor:
        """Features ``(P, dim)`` of the points ``(P, 4)``."""
        ...


@dataclass(frozen=True)
class GridSettings:
    """How the grids of one store were made.

    Args:
        projection: That of the range images, as plain values.
        grid_size: Rows and columns (h, w).
        extractor: ``name`` and ``settings`` of what made the features.
        dim: Width D of the features.
        dtype: ``"float16"`` or ``"int8"``, see :class:`r3dpa.data.store.Store`; an empty cell is
            zero in both.
        precision: Arithmetic that the extractor ran in, as Lightning names it.

    Raises:
        ValueError: If ``dtype`` is none of the two.
    """

    projection: dict[str, Any]
    grid_size: tuple[int, int]
    extractor: dict[str, Any]
    dim: int
    dtype: Literal["float16", "int8"]
    precision: str

    def __post_init__(self) -> None:
        if self.dtype not in ("float16", "int8"):
            raise ValueError(f"dtype must be float16 or int8, got {self.dtype!r}")

    @classmethod
    def of(
        cls,
        extractor: Extractor,
        projection: Projection,
        grid_size: tuple[int, int],
        dtype: Literal["float16", "int8"] = "float16",
        precision: str = "32-true",
    ) -> Self:
        """Settings of the grids that an extractor would make; refuses a grid that does not fit."""
        projection.sensor.cell_size(grid_size)
        wanted = _wanted(projection, extractor)
        size = (grid_size[0], grid_size[1])
        return cls(grid_size=size, dtype=dtype, precision=precision, **wanted)

    def store(self, features_dir: str | Path) -> Store[Scan]:
        """The store of these grids, each ``(N, D)``."""
        return Store(
            folder=Path(features_dir) / f"{self.grid_size[0]}x{self.grid_size[1]}",
            settings=json.dumps(vars(self), indent=1),
            shape=(math.prod(self.grid_size), self.dim),
            dtype=self.dtype,
            what="feature grids",
            remedy=f"{REMEDY}, or give the data module an extractor",
        )

    def writer(self, features_dir: str | Path, shard: int = 0) -> StoreWriter:
        """Writer of such grids; ``StoreError`` if the folder was made with other settings."""
        self.check(features_dir)
        return self.store(features_dir).writer(shard)

    def check(self, features_dir: str | Path) -> None:
        """Raise :class:`StoreError` where a folder holds grids of other settings or extractors."""
        for size, stored in stored_settings(features_dir).items():
            same_size = size == self.grid_size
            stored.compare(
                {k: v for k, v in vars(self).items() if same_size or k in ("extractor", "dim")},
                stored.store(features_dir).folder,
            )

    def compare(self, wanted: Mapping[str, Any], folder: Path) -> None:
        """Raise :class:`StoreError`, with both values, where these stored grids are not those."""
        for key, value in wanted.items():
            if getattr(self, key) != value:
                raise _made_otherwise(key, getattr(self, key), value, folder)


def _wanted(projection: Projection, extractor: Extractor | None) -> dict[str, Any]:
    """Settings that a user of grids needs, as they come back from a file; any extractor if None."""
    wanted: dict[str, Any] = {"projection": projection_to_dict(projection)}
    if extractor is not None:
        wanted["extractor"] = {"name": extractor.name, "settings": extractor.settings}
        wanted["dim"] = extractor.dim
    return json.loads(json.dumps(wanted))


def _made_otherwise(key: str, stored: Any, wanted: Any, folder: Path) -> StoreError:
    return StoreError(
        f"Feature grids in {folder} were made with {key} {stored}, but {key} {wanted} is asked "
        f"for: restore that setting, or give another features_dir and make new grids {REMEDY}."
    )


def stored_settings(features_dir: str | Path) -> dict[tuple[int, int], GridSettings]:
    """Settings of the stores of a folder by grid size; ``StoreError`` for a damaged file."""
    found = {}
    for path in sorted(Path(features_dir).glob(f"*/{_SETTINGS}")):
        try:
            values = json.loads(path.read_text())
            settings = GridSettings(**values | {"grid_size": tuple(values["grid_size"])})
            store = settings.store(features_dir)
            if path.parent != store.folder:
                raise ValueError(f"it is of grid_size {list(settings.grid_size)}")
            _ = store.row, settings.extractor["name"]  # can be made
        except (LookupError, TypeError, ValueError, OverflowError, RecursionError) as error:
            raise StoreError(
                f"{path} is damaged ({error!r:.200}): delete {path.parent} and make its grids "
                f"again {REMEDY}."
            ) from error
        found[settings.grid_size] = settings
    return found


def any_settings(features_dir: str | Path) -> GridSettings:
    """Settings of the first grids of a folder, all of one extractor; ``StoreError`` if none."""
    stored = stored_settings(features_dir)
    if not stored:
        raise StoreError(
            f"No feature grids in {features_dir}: make them {REMEDY}, or give an extractor."
        )
    return next(iter(stored.values()))


class FeatureGrids(CachedTensors[Scan]):
    """Grids ``(N, D)`` of one size, cells row by row; ``dim`` is D. Safe for loader processes.

    Args:
        features_dir: Folder of one extractor.
        scans: Scans that will be asked for; each must have a grid.
        projection: That of the range images.
        grid_size: Rows and columns (h, w) of the grids.
        extractor: The extractor that must have made them; any if None.

    Raises:
        StoreError: If a grid is missing or was made otherwise, or if the store is damaged.
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
        if stored and size not in stored:
            sizes = ", ".join(str(list(other)) for other in stored)
            raise _made_otherwise("grid_size", sizes, list(size), Path(features_dir))
        settings = stored[size] if stored else any_settings(features_dir)
        store = settings.store(features_dir)
        settings.compare(_wanted(projection, extractor), store.folder)
        super().__init__(store, scans)
        self.dim = settings.dim


@dataclass(frozen=True)
class GridPlan:
    """Grids to make: settings by size, scans that lack one (sorted), and disk space in bytes."""

    features_dir: Path
    settings: Mapping[tuple[int, int], GridSettings]
    missing: Sequence[Scan]
    num_kept: int
    num_bytes: int
    free_bytes: int


def default_features_dir(data_root: str | Path, name: str) -> Path:
    """``data_root/feature_grids/<name>``, the folder of an extractor unless another is given."""
    return Path(data_root) / "feature_grids" / name


def plan(
    scans: Sequence[Scan],
    extractor: Extractor,
    projection: Projection,
    grid_sizes: Sequence[tuple[int, int]],
    features_dir: str | Path,
    dtype: Literal["float16", "int8"] = "float16",
    precision: str = "32-true",
) -> GridPlan:
    """Find the grids that are missing, and refuse what cannot work before anything is written.

    ``dtype`` and ``precision`` (as Lightning names it) need to be those of the store only where
    grids are missing. Arguments: see :func:`write_feature_grids`.

    Raises:
        StoreError: If there are grids that were made with other settings, or the disk has not
            enough space left.
        ValueError: If there are no grid sizes, or one does not divide the range image.
    """
    if not grid_sizes:
        raise ValueError("grid_sizes is empty: give at least one, for example [[8, 64]].")
    features_dir, scans = Path(features_dir), sorted(scans)
    settings, missing, num_bytes = {}, set(), 0
    for h, w in grid_sizes:
        own = GridSettings.of(extractor, projection, (h, w), dtype, precision)
        stored = stored_settings(features_dir).get((h, w), own)
        stored.compare(_wanted(projection, extractor), stored.store(features_dir).folder)
        new = stored.store(features_dir).missing(scans)
        if new:
            own.check(features_dir)
        settings[h, w] = own
        missing |= set(new)
        num_bytes += len(new) * own.store(features_dir).row.itemsize
    free_bytes = shutil.disk_usage(_existing(features_dir)).free
    if num_bytes > free_bytes:
        raise StoreError(
            f"The feature grids of {len(missing)} scans need {num_bytes / 1e9:.1f} GB, but "
            f"{features_dir} has {free_bytes / 1e9:.1f} GB free: make space, give a features_dir "
            "on another disk, use dtype int8, or fewer scans (limit)."
        )
    return GridPlan(
        features_dir=features_dir,
        settings=settings,
        missing=sorted(missing),
        num_kept=len(scans) - len(missing),
        num_bytes=num_bytes,
        free_bytes=free_bytes,
    )


@torch.inference_mode()
def pooled_grids(
    extractor: Extractor,
    samples: Sequence[PointSample],
    projection: Projection,
    grid_sizes: Sequence[tuple[int, int]],
) -> dict[tuple[int, int], Tensor]:
    """Feature grids of a batch of scans; the means and the linear step in float32 at least.

    Args:
        extractor: Frozen network, run where its tensors are.
        samples: B scans, prepared for it.
        projection: That of the range images.
        grid_sizes: Rows and columns (h, w) of each grid.

    Returns:
        ``(B, N, D)`` float32 on the CPU for each grid size; empty cells are zero. ``StoreError``
        names the scan whose features are not finite.
    """
    features = extractor.point_features([sample.prepared for sample in samples])
    lift = getattr(extractor, "lift", torch.nn.Identity())
    grids: dict[tuple[int, int], list[Tensor]] = {(h, w): [] for h, w in grid_sizes}
    for sample, values in zip(samples, features, strict=True):
        points = sample.points[:, :3].to(values.device)
        with torch.autocast(values.device.type, enabled=False):
            for size, made in grids.items():
                means, _ = pool_cells(points, values, projection, size)
                made.append(lift(means).float().cpu())
                if not made[-1].isfinite().all():
                    raise StoreError(
                        f"{sample.scan.path}: extractor {extractor.name} gave NaN or infinite "
                        "features; run it in float32 or leave this scan out."
                    )
    return {size: torch.stack(made) for size, made in grids.items()}


def write_feature_grids(
    scans: Sequence[Scan],
    extractor: Extractor,
    projection: Projection,
    grid_sizes: Sequence[tuple[int, int]],
    features_dir: str | Path,
    *,
    workers: int = 0,
    batch_size: int = 1,
    dtype: Literal["float16", "int8"] = "float16",
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Make the grids that are missing for ``scans`` in this process; those that exist are kept.

    Another process that makes grids in the folder is waited for. After an error or a kill, all but
    the grids of the last batch are kept.

    Args:
        scans: Scans, of any number of drives.
        extractor: Frozen network, run where its tensors are.
        projection: That of the range images.
        grid_sizes: Rows and columns (h, w) of each grid.
        features_dir: Folder of the extractor.
        workers: Processes that read and prepare the scans; 0 for none.
        batch_size: Scans that the extractor is given at once.
        dtype: How grids are stored, see :class:`r3dpa.data.store.Store`.
        progress: Called after each scan with the number of scans done and the number to do.

    Returns:
        Number of scans whose grids were made.

    Raises:
        StoreError: As :func:`plan`, or if ``features_dir`` cannot be written.
        ScanError: If a scan cannot be used; the message names the file.
    """
    arguments = scans, extractor, projection, grid_sizes, features_dir, dtype
    if not plan(*arguments).missing:
        return 0  # complete grids may lie on a read-only disk
    with features_lock(features_dir):
        todo = plan(*arguments)  # another process may have made some
        loader = DataLoader(
            PointDataset(todo.missing, projection.sensor, extractor.prepare),
            batch_size=batch_size,
            collate_fn=list_collate,
            num_workers=workers,
            generator=torch.Generator(),  # the default draws from the global random state
        )
        done = 0
        with ExitStack() as stack:
            writers = {
                size: stack.enter_context(settings.writer(features_dir))
                for size, settings in todo.settings.items()
            }
            for samples in loader:
                grids = pooled_grids(extractor, samples, projection, grid_sizes)
                for size, writer in writers.items():
                    writer.add([sample.key for sample in samples], grids[size])
                for _ in samples:
                    done += 1
                    if progress is not None:
                        progress(done, len(todo.missing))
    return done


def features_lock(features_dir: str | Path) -> AbstractContextManager[None]:
    """Lock of the one job that makes grids in a folder; another job waits for it."""
    return store_lock(Path(features_dir), f"makes feature grids in {features_dir}")


def _existing(folder: Path) -> Path:
    """The folder itself or the first of its parents that exists."""
    folder = folder.absolute()
    return next(parent for parent in (folder, *folder.parents) if parent.exists())
