"""``r3dpa data weather`` and ``data corrupt``: scans of files and folders, changed."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jsonargparse.typing import NonNegativeInt, PositiveInt
from tqdm import tqdm

from lidarsim.clouds import PointCloud
from lidarsim.drive_files import to_json, weather_to_dict, write
from lidarsim.faults import Fault, Kind
from lidarsim.recorded import Instrument, RecordedScan
from lidarsim.weather import Weather, WeatheredScan, changed_cloud, recorded_scan
from r3dpa.cli.parser import check_folder
from r3dpa.io import (
    Journal,
    delete_unfinished,
    differences,
    in_processes,
    json_values,
    only_writer,
)

_REQUEST, _LINES, _REPORT, _PAGE = "request.json", ".unfinished.jsonl", "report.jsonl", "scans.html"
Change = Callable[[RecordedScan, Any], WeatheredScan]
"""Weather or fault of a scan, drawn by a seed and the name of the scan."""
_LOST, _MOVED = 254, 255  # colours of the page, beside the values of Origin


def weather(
    source: Path,
    *,
    weather: Weather = Weather(),  # noqa: B008
    instrument: Instrument = Instrument(),  # noqa: B008
    effects: Mapping[str, str | bool] | None = None,
    **options: Any,
) -> str:
    """Write scans as they would be in other weather, in their own formats and below their names.

    Points that stay keep their coordinates and order, added ones come last. ``report.jsonl`` has
    one line per scan, ``scans.html`` shows some beside their results. The same command completes
    an interrupted run, and makes again what has changed: a scan, its labels or their results. Files
    do not depend on the number of workers.

    Args:
        source: Scan or folder of scans: .bin, .pcd, .ply, .npy, .npz, .las, with .label files.
        weather: Such as ``--weather.visibility_m 60 --weather.rain_mm_h 10``.
        instrument: What is assumed of the instrument; the intensity scale is found and reported.
        effects: ``off`` or ``on`` by effect, such as ``--effects.range_noise on``.
        **options: See :class:`FolderOptions`.
    """
    change = partial(weather.apply, instrument=instrument, effects=effects)
    # An error in the request must not be reported as one in the first scan.
    change(RecordedScan(np.ones((1, 3), np.float32)), 0)
    conditions = weather_to_dict(weather) | {"traffic_m_s": weather.traffic_m_s}
    about = {"weather": conditions, "instrument": asdict(instrument)}
    return _run(source, change, about | {"effects": effects}, FolderOptions(**options))


def corrupt(
    source: Path,
    *,
    fault: Kind,
    severity: Literal[0, 1, 2, 3] = 2,
    strength: float | None = None,
    **options: Any,
) -> str:
    """Write scans with a fault of the sensor, as ``r3dpa data weather`` does.

    Args:
        source: Scan or folder of scans: .bin, .pcd, .ply, .npy, .npz, .las, with .label files.
        fault: What fails.
        severity: 0 (nothing) to 3, as in Robo3D.
        strength: In place of the severity: share of beams or points, metres, degrees.
        **options: See :class:`FolderOptions`.
    """
    change = Fault(fault, severity, strength)
    return _run(source, change.apply, asdict(change), FolderOptions(**options))


@dataclass(frozen=True, kw_only=True)
class FolderOptions:
    """Options shared by ``weather`` and ``corrupt``.

    Args:
        out: Folder of the results.
        seed: Of the random draws, together with the name of each scan.
        workers: Processes.
        columns: Columns of files without names, such as ``x,y,z,intensity,ring``; default: by the
            values.
        drop_nan: Leave out points with NaN.
        show: Scans on the page at most.
    """

    out: Path
    seed: NonNegativeInt = 0
    workers: PositiveInt = 1
    columns: tuple[str, ...] = ()
    drop_nan: bool = False
    show: NonNegativeInt = 4


@dataclass(frozen=True)
class _FolderRun:
    """Change of a run; a call applies it to a scan, writes the result and returns a report line."""

    root: Path
    change: Change
    options: FolderOptions

    def name(self, path: Path) -> str:
        return path.relative_to(self.root).as_posix()

    def read(self, path: Path) -> tuple[PointCloud, WeatheredScan]:
        from lidarsim.clouds import read_cloud
        from lidarsim.scan_files import ScanError

        cloud = read_cloud(path, self.options.columns, self.options.drop_nan)
        cloud.check_metres()
        key, scan = (self.options.seed, self.name(path)), recorded_scan(cloud)
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
        from lidarsim.changed_scans import inputs_of, write_below
        from lidarsim.scan_files import ScanError

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


def _run(source: Path, change: Change, request: dict[str, Any], options: FolderOptions) -> str:
    from lidarsim.changed_scans import inputs_of
    from lidarsim.clouds import find_files
    from lidarsim.scan_files import ScanError
    from r3dpa.data.scans import evenly

    root, files = find_files(source)
    out, job = options.out, _FolderRun(root, change, options)
    paths = {job.name(path): path for path in files}
    request |= {"source": str(root.resolve()), "seed": options.seed}
    request |= {"columns": options.columns, "drop_nan": options.drop_nan}
    _check_out(root, out, files, json_values(request))
    with only_writer(out / ".lock", f"writes scans to {out}", wait=True):
        write(out / _REQUEST, to_json(request))
        lines = _lines(out)
        for name in [name for name in lines if name not in paths and not (out / name).is_file()]:
            del lines[name]
        for name in lines.keys() & paths.keys():
            if not _is_done(lines[name], inputs_of(paths[name], root), out):
                _delete_results(lines.pop(name), out)
        todo = [path for name, path in paths.items() if name not in lines]
        num_done = len(paths) - len(todo)
        journal, report = Journal(out / _LINES), Journal(out / _REPORT)
        journal.start(*journal.read())  # without an incomplete last line
        with tqdm(total=len(paths), initial=num_done, unit="scan", disable=None) as bar:
            for line in in_processes(job, todo, options.workers):
                lines[line["scan"]] = line
                journal.add(line)
                bar.update()
        report.start(*(lines[name] for name in sorted(lines)))
        journal.delete()
        delete_unfinished(out)  # at the end: workers of a killed run may outlive it
        bad = [lines[name]["error"] for name in paths if "error" in lines[name]]
        has_results = len(bad) < len(lines)
        if not has_results:
            (out / _REPORT).unlink()
            (out / _REQUEST).unlink()
    if bad:
        with suppress(OSError):
            out.rmdir()
        where = f", see {out / _REPORT}" if has_results else ""
        more = f" ({len(bad)} of {len(paths)} scans cannot be used{where})"
        raise ScanError(bad[0] + (more if len(paths) > 1 else ""))
    if options.show and (todo or not (out / _PAGE).exists()):
        _write_page(job, evenly(files, options.show))
    return _summary([lines[name] for name in paths], len(todo), out)


def _check_out(root: Path, out: Path, files: list[Path], request: dict[str, Any]) -> None:
    """Refuse a folder of other files or results, before anything is written."""
    from lidarsim.changed_scans import refuse_shared_labels

    check_folder(out)
    place, above = out.resolve(), root.resolve()
    if place == above or (place.is_relative_to(above) and len(files) > 1):
        raise ValueError(f"--out {out} is the folder of the scans, or in it: give another one")
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
            f"{out} holds results of {len(gone)} scans that {root} does not hold any more, such as "
            f"{gone[0]}: delete them, or give another --out"
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
    from lidarsim.changed_scans import refuse_outside

    for name in line.get("results", ()):
        refuse_outside(out / name, out)
        (out / name).unlink(missing_ok=True)


def _summary(lines: list[dict[str, Any]], num_now: int, out: Path) -> str:
    """Formats, shares of points and effects of all scans."""
    kinds = {line["file"].partition(")")[0]: line["file"] for line in reversed(lines)}
    num_points = sum(line["points"] for line in lines)
    texts = [f"{len(lines)} scans in {out}, {num_now} of them written now", *kinds.values()]
    scales = Counter(line["intensity"].split(": ")[1] for line in lines if "intensity" in line)
    texts += [f"intensity: {scale}, in {num} scans" for scale, num in scales.most_common(4)]
    for key in ("lost", "moved", "dimmed", "added"):
        causes = Counter[str]()
        for line in lines:
            causes.update(line[key] if isinstance(line[key], dict) else {"": line[key]})
        shares = [f"{n / num_points:.2%} {cause}".strip() for cause, n in causes.items() if n]
        texts.append(f"{key}: {', '.join(shares) or 'no point'}")
    ran = Counter((name, why) for line in lines for name, why in line["effects"].items())
    texts += [f"{name}: {why}, in {num} scans" for (name, why), num in ran.most_common(12)]
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
