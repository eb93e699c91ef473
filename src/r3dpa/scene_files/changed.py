"""Scans of files and folders, each changed by weather or a fault and written under its name."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from lidarsim.changed_scans import (
    inputs_of,
    refuse_folder_of_scans,
    refuse_outside,
    refuse_shared_labels,
    write_below,
)
from lidarsim.clouds import PointCloud, read_cloud
from lidarsim.drive_files import to_json, write
from lidarsim.recorded import RecordedScan
from lidarsim.scan_files import ScanError
from lidarsim.scan_folders import find_files
from lidarsim.weather import WeatheredScan, changed_cloud, recorded_scan
from r3dpa.io import (
    Journal,
    check_folder,
    delete_unfinished,
    differences,
    in_processes,
    json_values,
    number_of,
    only_writer,
)
from r3dpa.scene_files.options import FolderOptions

_REQUEST, _LINES, _REPORT, _PAGE = "request.json", ".unfinished.jsonl", "report.jsonl", "scans.html"
Change = Callable[[RecordedScan, Any], WeatheredScan]
"""Weather or fault of a scan, drawn by a seed and the name of the scan."""
_LOST, _MOVED = 254, 255  # colours of the page, beside the values of Origin


@dataclass(frozen=True)
class _FolderRun:
    """Change of a run; a call applies it to a scan, writes the result and returns a report line."""

    root: Path
    change: Change
    options: FolderOptions

    def name(self, path: Path) -> str:
        return path.relative_to(self.root).as_posix()

    def read(self, path: Path) -> tuple[PointCloud, WeatheredScan]:
        cloud = read_cloud(path, self.options.columns, self.options.drop_nan)
        cloud.check_metres()
        key = (self.options.seed, self.name(path))
        scan = recorded_scan(cloud)
        try:
            result = self.change(scan, key)
        except ValueError as error:
            raise ScanError(f"{path}: {error}") from error
        if not len(result.points):
            raise ScanError(
                f"{path}: none of its {len(scan)} points is left, and no reader takes an empty "
                "scan: give milder weather or a smaller strength"
            )
        return cloud, result

    def __call__(self, path: Path) -> dict[str, Any]:
        inputs = inputs_of(path, self.root)  # before they are read
        try:
            cloud, result = self.read(path)
        except ScanError as error:
            return {"scan": self.name(path), "error": str(error)}
        results = write_below(changed_cloud(cloud, result), self.root, self.options.out)
        ran = {effect.name: effect.reason for effect in result.effects if effect.status == "ran"}
        files = {"scan": self.name(path), "inputs": inputs, "results": results}
        about = {"file": cloud.describe(), "effects": ran, **result.report}
        return files | about | {"written": len(result.points)}


def change_scans(
    source: Path, change: Change, request: dict[str, Any], options: FolderOptions
) -> str:
    """Write a changed copy of a scan or of all scans of a folder; return a summary.

    Scans that an earlier run of the same request has made, of inputs that are as they were then,
    are left as they are.

    Args:
        source: Scan or folder.
        change: Weather or fault.
        request: What determines the change, as JSON values.
        options: Output folder, seed, processes.

    Raises:
        ValueError: If the output folder holds other files, or results of another request.
        ScanError: After all other scans are written, if some cannot be used.
    """
    from r3dpa.data.scans import evenly

    root, files = find_files(source)
    out, job = options.out, _FolderRun(root, change, options)
    paths = {job.name(path): path for path in files}
    request = request | {
        "source": str(root.resolve()),
        "seed": options.seed,
        "columns": options.columns,
        "drop_nan": options.drop_nan,
    }
    _check_out(root, out, files, json_values(request))
    with only_writer(out / ".lock", f"writes scans to {out}", wait=True):
        write(out / _REQUEST, to_json(request))
        lines = _lines_that_stand(paths, root, out)
        todo = [path for name, path in paths.items() if name not in lines]
        lines = _change(job, todo, lines)
        bad = [lines[name]["error"] for name in paths if "error" in lines[name]]
        has_results = len(bad) < len(lines)
        if not has_results:
            (out / _REPORT).unlink()
            (out / _REQUEST).unlink()
    if bad:
        with suppress(OSError):
            out.rmdir()
        message = bad[0]
        if len(paths) > 1:
            where = f", see {out / _REPORT}" if has_results else ""
            message += f" ({len(bad)} of {len(paths)} scans cannot be used{where})"
        raise ScanError(message)
    if options.show:
        _write_page(job, evenly(files, options.show))
    return _summary([lines[name] for name in paths], len(todo), out)


def _lines_that_stand(paths: dict[str, Path], root: Path, out: Path) -> dict[str, dict[str, Any]]:
    """Lines of earlier runs whose results are as their inputs are now; the others are deleted."""
    lines = _lines(out)
    for name in list(lines):
        if name not in paths:
            if not (out / name).is_file():
                del lines[name]
        elif not _is_done(lines[name], inputs_of(paths[name], root), out):
            _delete_results(lines.pop(name), out)
    return lines


def _change(
    job: _FolderRun, todo: list[Path], done: dict[str, dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Change scans, each with a line in the journal at once; write and return the lines of all."""
    out, lines = job.options.out, dict(done)
    journal, report = Journal(out / _LINES), Journal(out / _REPORT)
    journal.start(*journal.read())  # without an incomplete last line
    total = len(done) + len(todo)
    with tqdm(total=total, initial=len(done), unit="scan", disable=None) as bar:
        for line in in_processes(job, todo, job.options.workers):
            lines[line["scan"]] = line
            journal.add(line)
            bar.update()
    report.start(*(lines[name] for name in sorted(lines)))
    journal.delete()
    delete_unfinished(out)  # at the end: workers of a killed run may outlive it
    return lines


def _check_out(root: Path, out: Path, files: list[Path], request: dict[str, Any]) -> None:
    """Refuse a folder of other files or results, before anything is written."""
    check_folder(out)
    refuse_folder_of_scans(out, root, len(files))
    if (out / _REQUEST).is_file():
        before = json.loads((out / _REQUEST).read_text())
        if different := "; ".join(differences(before, request)):
            raise ValueError(
                f"{out} holds scans of another request ({different}): give another --out, or "
                "delete it"
            )
    elif out.is_dir() and any(out.iterdir()):
        raise ValueError(f"{out} holds other files: give a new folder as --out")
    earlier = {root / name: out / name for name in _lines(out) if (out / name).is_file()}
    if gone := [result for path, result in earlier.items() if not path.is_file()]:
        raise ValueError(
            f"{out} holds results of {number_of(len(gone), 'scan')} that {root} does not hold any "
            f"more, such as {gone[0]}: delete them, or give another --out"
        )
    refuse_shared_labels({*files, *earlier})


def _lines(out: Path) -> dict[str, dict[str, Any]]:
    """Lines of earlier runs by scan."""
    lines: dict[str, dict[str, Any]] = {}
    for path in (out / _REPORT, out / _LINES):
        try:
            lines |= {line["scan"]: line for line in Journal(path).read()}
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(
                f"{path} is damaged ({error}): delete it, and repeat the command to make its scans "
                "again"
            ) from error
    return lines


def _is_done(line: dict[str, Any], inputs: dict[str, list[int]], out: Path) -> bool:
    """Whether the results of a scan are whole and made from its inputs as they are now."""
    if "error" in line or line.get("inputs") != inputs:
        return False
    results = {name: out / name for name in line["results"]}
    sizes = {name: path.stat().st_size for name, path in results.items() if path.is_file()}
    return bool(sizes == line["results"])


def _delete_results(line: dict[str, Any], out: Path) -> None:
    """Delete the files of an earlier run, since new ones may have no labels in their place."""
    for name in line.get("results", ()):
        refuse_outside(out / name, out)
        (out / name).unlink(missing_ok=True)


def _summary(lines: list[dict[str, Any]], num_now: int, out: Path) -> str:
    """Formats, shares of points and effects of all scans."""
    # By format and columns, the description of the first scan that has them.
    kinds = {line["file"].partition(")")[0]: line["file"] for line in reversed(lines)}
    num_points = sum(line["points"] for line in lines)
    texts = [
        f"{number_of(len(lines), 'scan')} in {out}, {num_now} of them written now",
        *kinds.values(),
    ]
    scales = Counter(line["intensity"].split(": ")[1] for line in lines if "intensity" in line)
    texts += [
        f"intensity: {scale}, in {number_of(num, 'scan')}" for scale, num in scales.most_common(4)
    ]
    for key in ("lost", "moved", "dimmed", "added"):
        causes = Counter[str]()
        for line in lines:
            causes.update(line[key] if isinstance(line[key], dict) else {"": line[key]})
        shares = [f"{n / num_points:.2%} {cause}".strip() for cause, n in causes.items() if n]
        texts.append(f"{key}: {', '.join(shares) or 'no point'}")
    ran = Counter((name, why) for line in lines for name, why in line["effects"].items())
    texts += [
        f"{name}: {why}, in {number_of(num, 'scan')}" for (name, why), num in ran.most_common(12)
    ]
    page = f"; open {out / _PAGE}" if (out / _PAGE).exists() else ""
    return "\n".join([*texts, f"{out / _REPORT} has a line for each{page}"])


def _write_page(job: _FolderRun, files: list[Path]) -> None:
    """Page of scans, each beside its result."""
    from r3dpa import viz
    from r3dpa.viz.scenes import write_page

    before: list[viz.PageScan] = []
    after: list[viz.PageScan] = []
    for path in files:
        cloud, result = job.read(path)
        scan = recorded_scan(cloud)
        index = result.index[result.index >= 0]
        fate = np.full(len(scan), _LOST, dtype=np.uint8)
        fate[index] = 0
        away = (result.points[: len(index)] != scan.points[index]).any(axis=1)
        fate[index[away]] = _MOVED
        made_by = result.origins.copy()
        made_by[: len(index)][away] = _MOVED
        sides = ((before, "", scan, fate), (after, ", changed", result, made_by))
        for scans, note, side, origins in sides:
            points = side.points
            if side.intensity is not None:
                points = np.column_stack([points, side.intensity.astype(np.float32)])
            scans.append(viz.PageScan(f"{job.name(path)}{note}", points, origins=origins))
    more = {_LOST: viz.Category("lost", "#ff5c5c"), _MOVED: viz.Category("moved", "#ffb000")}
    title = f"{job.root.resolve().name} - r3dpa"
    write_page(job.options.out / _PAGE, before, title, more, beside=after, mode="origin")
