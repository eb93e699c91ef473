"""Check of a folder of scans, for ``r3dpa check``."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from multiprocessing.pool import ThreadPool
from pathlib import Path

from tqdm import tqdm

from r3dpa.data.scans import (
    KITTI360_DRIVES,
    RAW,
    VELODYNE,
    Scan,
    ScanError,
    find_scans,
    read_scan,
    scan_files,
)
from r3dpa.geometry import LidarSensor
from r3dpa.simulation import expected_scans


@dataclass(frozen=True)
class CheckReport:
    """Result of :func:`check`; ``str`` gives the text that the command prints.

    ``num_scans`` counts by drive, bad ones included; ``bad`` holds ``(file, reason)`` of unusable
    scans, ``missing`` folders that should exist or hold scans; ``intensity`` the smallest and
    largest intensity of the usable scans.
    """

    root: Path
    num_scans: dict[str, int]
    bad: tuple[tuple[Path, str], ...]
    missing: tuple[Path, ...]
    intensity: tuple[float, float] | None = None

    @property
    def ok(self) -> bool:
        """Whether every scan is usable and no folder is missing."""
        return not self.bad and not self.missing

    def __str__(self) -> str:
        lines = [f"{drive}: {count} scans" for drive, count in self.num_scans.items()]
        lines += [f"missing: {folder}" for folder in self.missing]
        lines += [f"bad: {file}: {reason}" for file, reason in self.bad]
        if self.intensity is not None:
            low, high = self.intensity
            outside = " (expected 0..1: divide by 255)" if low < 0 or high > 1 else ""
            lines.append(f"intensity: {low:.3g}..{high:.3g}{outside}")
        total = sum(self.num_scans.values())
        problems = f"{len(self.bad)} bad, {len(self.missing)} folders missing or without scans"
        verdict = "all usable" if self.ok else problems
        return "\n".join(
            [*lines, f"{self.root}: {total} scans in {len(self.num_scans)} drives, {verdict}"]
        )


def check(path: str | Path, sensor: LidarSensor | None = None, workers: int = 8) -> CheckReport:
    """Read every scan of a data set, folder or file, and report all that is wrong with it.

    A folder with ``data_3d_raw``, or without any scan, is compared with the KITTI-360 layout and
    its nine LiDAR drives; a simulated one with its manifest (``ValueError`` if that is damaged).
    Every scan needs a point within the range limits of ``sensor``.
    """
    root = Path(path).absolute()
    sensor = sensor or LidarSensor()
    scans = find_scans(root) if any(scan_files(root)) else []
    counts = dict(sorted(Counter(scan.drive for scan in scans).items()))
    missing, bad = _compare_layout(root, counts)
    scales = []

    def examine(scan: Scan) -> str | tuple[float, float]:
        try:
            intensity = read_scan(scan.path, sensor)[:, 3]
        except ScanError as error:
            return str(error).removeprefix(f"{scan.path}: ")
        return float(intensity.min()), float(intensity.max())

    with ThreadPool(workers) as pool:
        results = tqdm(pool.imap(examine, scans), total=len(scans), unit="scan", disable=None)
        for scan, found in zip(scans, results, strict=True):
            if isinstance(found, str):
                bad.append((scan.path, found))
            else:
                scales.append(found)
    scale = (min(low for low, _ in scales), max(high for _, high in scales)) if scales else None
    return CheckReport(root, counts, tuple(bad), tuple(missing), scale)


def _compare_layout(
    root: Path, counts: dict[str, int]
) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Missing folders, and incomplete drives with the reason."""
    raw, simulated = root / RAW, expected_scans(root)
    if not root.exists():
        return [root], []
    if not raw.is_dir():
        return ([] if counts and simulated is None else [raw]), []
    missing, incomplete = [], []
    official = dict.fromkeys(KITTI360_DRIVES["train"] + KITTI360_DRIVES["val"], 1)
    for drive, expected in sorted((simulated or official).items()):
        folder, count = raw / drive, counts.get(drive, 0)
        if not folder.is_dir():
            missing.append(folder)
        elif not count:
            missing.append(folder / VELODYNE)
        elif count < expected:
            reason = f"holds {count} of {expected} scans; simulate again to complete it"
            incomplete.append((folder, reason))
    return missing, incomplete
