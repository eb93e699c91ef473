"""Making feature grids: point features of a frozen extractor, averaged over the cells of a grid.

Letters: P points, K values before the linear step, N = h * w cells, D feature width, B batch.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from r3dpa.data.feature_store import FeatureGridWriter, folder_lock, known_grids
from r3dpa.data.grid_settings import FeatureGridError, GridSettings, check_settings
from r3dpa.data.points import PointDataset, PointSample, list_collate
from r3dpa.data.scans import Scan
from r3dpa.geometry import Projection, pool_cells


class Extractor(Protocol):
    """Frozen network that describes every point of a scan.

    Its features are ``lift(point_features([prepare(points)])[0])``. A last step that is linear
    belongs into ``lift((N, K)) -> (N, dim)``, which may be absent: it commutes with the mean of a
    cell, so that cells are lifted instead of points.

    It may also say which augmentation its features follow: ``num_headings``, if rotating a scan by
    any multiple of ``2 * pi / num_headings`` about the vertical axis leaves the features of its
    points alone, and ``mirror_invariant``, if swapping left and right does. With ``needs_labels``,
    labels ``(P,)`` int64 of the simulator are the second argument of ``prepare`` and of a call.

    Attributes:
        name: Short name, that of the default folder.
        dim: Width D of the features.
        settings: Whatever else determines the features, as JSON values; compared on opening.
        prepare: Work on the CPU for the points ``(P, 4)`` x, y, z (metres), intensity of one scan.
            Loader processes do it: a function that can be pickled and holds no weights.
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
class GridPlan:
    """What is to be made.

    Attributes:
        features_dir: Folder of the extractor.
        settings: Those of the store of each grid size.
        missing: Scans that lack a grid of at least one size, sorted.
        num_kept: Scans that lack none.
        num_bytes: Disk space that the missing grids need.
        free_bytes: Disk space that there is.
    """

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
    dtype: str = "float16",
    precision: str = "32-true",
) -> GridPlan:
    """Find the grids that are missing, and refuse what cannot work before anything is written.

    ``dtype`` and ``precision`` need to be those of the store only where grids are missing.

    Args:
        scans: Scans, of any number of drives.
        extractor: What would make them.
        projection: That of the range images.
        grid_sizes: Rows and columns (h, w) of each grid.
        features_dir: Folder of the extractor.
        dtype: How grids are stored, see :class:`GridSettings`.
        precision: Arithmetic of the extractor, as Lightning names it.

    Raises:
        FeatureGridError: If there are grids that were made with other settings, or the disk has
            not enough space left.
        ValueError: If there are no grid sizes, or one does not divide the range image.
    """
    if not grid_sizes:
        raise ValueError("grid_sizes is empty: give at least one, for example [[8, 64]].")
    features_dir, scans = Path(features_dir), sorted(scans)
    keys = [(scan.name, scan.num_bytes) for scan in scans]
    settings, missing, num_bytes = {}, set(), 0
    for h, w in grid_sizes:
        own = GridSettings.of(extractor, projection, (h, w), dtype, precision)
        known = known_grids(features_dir, own)
        new = {key for key in keys if key not in known}
        if new:
            check_settings(features_dir, own)
        settings[h, w] = own
        missing |= new
        num_bytes += len(new) * own.row.itemsize
    free_bytes = shutil.disk_usage(_existing(features_dir)).free
    if num_bytes > free_bytes:
        raise FeatureGridError(
            f"The feature grids of {len(missing)} scans need {num_bytes / 1e9:.1f} GB, but "
            f"{features_dir} has {free_bytes / 1e9:.1f} GB free: make space, give a features_dir "
            "on another disk, use dtype int8, or fewer scans (limit)."
        )
    return GridPlan(
        features_dir=features_dir,
        settings=settings,
        missing=[scan for scan, key in zip(scans, keys, strict=True) if key in missing],
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
        ``(B, N, D)`` float32 on the CPU for each grid size; empty cells are zero.

    Raises:
        FeatureGridError: If a feature is NaN or infinite; names the file of the scan.
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
                    raise FeatureGridError(
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
    dtype: str = "float16",
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Make the grids that are missing for ``scans`` in this process; those that exist are kept.

    Another process that makes grids in the folder is waited for, and then what is still missing is
    made. After an error or a kill, all but the grids of the last batch are kept.

    Args:
        scans: Scans, of any number of drives.
        extractor: Frozen network, run where its tensors are.
        projection: That of the range images.
        grid_sizes: Rows and columns (h, w) of each grid.
        features_dir: Folder of the extractor.
        workers: Processes that read and prepare the scans; 0 for none.
        batch_size: Scans that the extractor is given at once.
        dtype: How grids are stored, see :class:`GridSettings`.
        progress: Called after each scan with the number of scans done and the number to do.

    Returns:
        Number of scans whose grids were made.

    Raises:
        FeatureGridError: If ``features_dir`` has grids that were made with other settings, cannot
            be written, or has not enough space left.
        ScanError: If a scan cannot be used; the message names the file.
        ValueError: If there are no grid sizes, or one does not divide the range image.
    """
    arguments = scans, extractor, projection, grid_sizes, features_dir, dtype
    if not plan(*arguments).missing:
        return 0  # complete grids may lie on a read-only disk
    with features_lock(features_dir):
        todo = plan(*arguments)  # another process may have made some
        needs_labels = getattr(extractor, "needs_labels", False)
        loader = DataLoader(
            PointDataset(todo.missing, projection.sensor, extractor.prepare, needs_labels),
            batch_size=batch_size,
            collate_fn=list_collate,
            num_workers=workers,
            generator=torch.Generator(),  # the default draws from the global random state
        )
        done = 0
        with ExitStack() as stack:
            writers = {
                size: stack.enter_context(FeatureGridWriter(features_dir, settings))
                for size, settings in todo.settings.items()
            }
            for samples in loader:
                grids = pooled_grids(extractor, samples, projection, grid_sizes)
                for size, writer in writers.items():
                    writer.add([(sample.scan, sample.num_bytes) for sample in samples], grids[size])
                for _ in samples:
                    done += 1
                    if progress is not None:
                        progress(done, len(todo.missing))
    return done


def features_lock(features_dir: str | Path) -> AbstractContextManager[None]:
    """The lock of the one job that makes grids in a folder; another job waits for it.

    Raises:
        FeatureGridError: If the folder cannot be written.
    """
    waiting = f"waiting for another process that makes feature grids in {features_dir}"
    return folder_lock(Path(features_dir), waiting)


def _existing(folder: Path) -> Path:
    """The folder itself or the first of its parents that exists."""
    folder = folder.absolute()
    return next(parent for parent in (folder, *folder.parents) if parent.exists())
