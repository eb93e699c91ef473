"""``r3dpa realism``: folders of scans against folders of real ones."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path

from tqdm import tqdm

from r3dpa.data.scans import Scan, ScanError, find_scans, read_scan
from r3dpa.io import atomic_path
from r3dpa.metrics import RealismTable, ScanStatistics, realism_table, scan_statistics


def realism(scans: Path, reference: Path, out: Path | None = None) -> RealismTable:
    """Compare the scans of two folders.

    A reference of a single drive is split in two halves in time, which gives a floor lower than
    two drives would; a note below the table says so.

    Args:
        scans: Folder of ``.bin`` scans, in the KITTI-360 layout or not; one drive per folder.
        reference: The same of real scans.
        out: JSON file for the table and the curves behind it.

    Returns:
        The table.

    Raises:
        ValueError: If a folder holds no scan, or a scan cannot be used; the message names it.
    """
    of_scans = _by_drive(find_scans(scans))
    of_reference = _by_drive(find_scans(reference))
    notes = [f"A: {scans}", f"B: {reference}"]
    if len(of_reference) == 1:
        of_reference, note = _halves(of_reference)
        notes.append(note)
    num_scans = sum(map(len, [*of_scans.values(), *of_reference.values()]))
    with tqdm(total=num_scans, unit="scan", desc="realism", disable=None) as progress:
        table = realism_table(
            _statistics(of_scans, progress), _statistics(of_reference, progress), notes
        )
    if out is not None:
        with atomic_path(out) as temporary:
            temporary.write_text(json.dumps(table.to_dict(), indent=1, allow_nan=False) + "\n")
    return table


def _by_drive(scans: list[Scan]) -> dict[str, list[Scan]]:
    return {drive: list(group) for drive, group in groupby(scans, lambda scan: scan.drive)}


def _halves(drives: dict[str, list[Scan]]) -> tuple[dict[str, list[Scan]], str]:
    ((drive, scans),) = drives.items()
    if len(scans) == 1:
        return drives, "B is a single scan: there is no floor; give a reference of two drives"
    middle = len(scans) // 2
    halves = {f"{drive}, first half": scans[:middle], f"{drive}, second half": scans[middle:]}
    return halves, (
        "B is a single drive: the floor compares its first half with its second one, which are "
        "more alike than two drives; all ratios come out too high"
    )


def _statistics(drives: dict[str, list[Scan]], progress: tqdm) -> dict[str, ScanStatistics]:
    return {drive: pooled(_counted(scans, progress)) for drive, scans in drives.items()}


def _counted(scans: Iterable[Scan], progress: tqdm) -> Iterator[Scan]:
    for scan in scans:
        yield scan
        progress.update()


def pooled(scans: Iterable[Scan]) -> ScanStatistics:
    """Statistics of all these scans together.

    Raises:
        ScanError: If a scan cannot be used; the message names the file.
    """
    total = ScanStatistics()
    for scan in scans:
        points = read_scan(scan.path)
        try:
            total += scan_statistics(points)
        except ValueError as error:
            raise ScanError(f"{scan.path}: {error}") from error
    return total
