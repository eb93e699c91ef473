"""Results of a command on a folder of scans, each below the name of its scan."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from lidarsim.cloud_formats import ScanError
from lidarsim.clouds import PointCloud, label_path_of, packed
from lidarsim.io import write_bytes


def write_below(cloud: PointCloud, root: Path, out: Path) -> dict[str, int]:
    """Write a cloud and its labels below ``out``, where its file has its place below ``root``.

    Labels come first: where the scan is, it is complete. Labels from outside ``root`` are written
    beside the scan.

    Returns:
        Size of each written file by its name below ``out``.

    Raises:
        ScanError: If a link leads out of ``out``.
    """
    assert cloud.file is not None
    path = out / cloud.file.path.relative_to(root)
    contents: dict[Path, bytes] = {}
    if cloud.labels is not None and cloud.file.label_path is not None:
        name = Path(os.path.relpath(cloud.file.label_path, root))
        is_outside = name.parts[0] == ".."
        label_path = path.with_name(name.name) if is_outside else out / name
        contents[label_path] = cloud.labels.astype("<u4").tobytes()
    contents[path] = packed(path, cloud)
    for written, content in contents.items():
        refuse_outside(written, out)
        write_bytes(written, content)
    return {written.relative_to(out).as_posix(): len(data) for written, data in contents.items()}


def refuse_outside(path: Path, out: Path) -> None:
    """Refuse a file to write or delete that is not below ``out``, once links are followed.

    Raises:
        ScanError: With the name of the file.
    """
    if not path.parent.resolve().is_relative_to(out.resolve()):
        raise ScanError(f"{path}: a link leads out of {out}; give another --out")


def refuse_folder_of_scans(out: Path, root: Path, num_scans: int) -> None:
    """Refuse to write results where a later run would read them as scans of the folder ``root``.

    Raises:
        ValueError: With the name of ``out``.
    """
    place, above = out.resolve(), root.resolve()
    if place == above or (place.is_relative_to(above) and num_scans > 1):
        raise ValueError(f"--out {out} is the folder of the scans, or in it: give another one")


def inputs_of(path: Path, root: Path) -> dict[str, list[int]]:
    """Size and time of change in ns of a scan and its labels, by their names from ``root``."""
    inputs = {}
    for file in (path, label_path_of(path)):
        if file is not None and file.is_file():
            status = file.stat()
            name = Path(os.path.relpath(file, root)).as_posix()
            inputs[name] = [status.st_size, status.st_mtime_ns]
    return inputs


def refuse_shared_labels(paths: Iterable[Path]) -> None:
    """Refuse scans of which two have the same file of labels, also in their results.

    Raises:
        ScanError: With the names of two such scans.
    """
    scan_of: dict[Path, Path] = {}
    for path in sorted(paths):
        label_path = label_path_of(path)
        if label_path is not None and scan_of.setdefault(label_path, path) != path:
            raise ScanError(
                f"{label_path}: would be the labels of {scan_of[label_path]} and of {path}: keep "
                "one of these scans, or its labels in another folder"
            )
