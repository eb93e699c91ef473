"""Completion of scans from files: generated points appended to the scan's, and errors."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from tqdm import tqdm

from lidarsim.changed_scans import refuse_folder_of_scans, write_below
from lidarsim.clouds import PointCloud, read_cloud
from lidarsim.scan_folders import find_files
from r3dpa.data.labels import classes_as_of_cloud
from r3dpa.data.scene_writer import SceneWriter
from r3dpa.editing import EditResult
from r3dpa.editing.editor import COMPLETION_START
from r3dpa.editing.gaps import interpolate_gaps, range_error_m, unseen_pixels
from r3dpa.editing.regions import check_mask, dropped_beams, sector, sensor_pair
from r3dpa.editing.settings import check_start
from r3dpa.geometry import (
    Pixels,
    Projection,
    SphericalProjection,
    in_view,
    points_of,
    values_at_returns,
)
from r3dpa.io import in_processes, number_of
from r3dpa.scene_files.edits import EditSession, ScanView, refuse_inside
from r3dpa.scene_files.options import EditOptions

_SCANS = "scans"  # folder of the completed scans
_RESAMPLINGS = 10  # of RePaint, by default
_METHODS = ("completed", "linear", "nearest")
# notebooks/results/completion.json
_BENCHMARK = (
    "no return was held out; on 30 real scans without every 2nd beam the mean error of completions "
    "is 0.38 m, of linear interpolation 0.40 m, of the nearest beam 0.60 m"
)


@dataclass(frozen=True)
class MissingPixels:
    """Which pixels of a scan are missing; see the options of ``r3dpa edit complete``."""

    sector: tuple[float, float] | None = None
    keep_every: int | None = None
    empty_beams: bool = False
    other_sensor: tuple[int, float, float] | None = None
    mask: Path | None = None

    def find(self, range_m: Tensor, session: EditSession) -> Tensor:
        """Mask ``(H, W)`` of all that is missing in a range image."""
        projection, sensor = session.projection, session.sensor
        masks = []
        if self.sector is not None:
            masks.append(sector(projection, *self.sector))
        if self.keep_every is not None:
            if not 2 <= self.keep_every <= sensor.beams // 2:
                raise ValueError(
                    f"--keep_every must be 2 to {sensor.beams // 2}, got {self.keep_every}"
                )
            rows = range(0, sensor.beams, self.keep_every)
            masks.append(dropped_beams(projection, rows))
        if self.other_sensor is not None:
            beams, lowest, highest = self.other_sensor
            other = replace(
                sensor, beams=beams, inclination_min_deg=lowest, inclination_max_deg=highest
            )
            masks.append(sensor_pair(projection, SphericalProjection(other)))
        if self.mask is not None:
            masks.append(session.read_mask(self.mask))
        if self.empty_beams:
            masks.append(unseen_pixels(range_m))
        return check_mask(torch.stack(masks).any(dim=0), "all that is missing")


class Completion(NamedTuple):
    """Result of a worker: NumPy arrays travel between processes as they are."""

    range_m: np.ndarray
    nfe: int


@dataclass(frozen=True)
class CompletionJob:
    """A call completes one file, writes the results and returns their images.

    Args:
        options: Options of the edit.
        missing: What is missing.
        num: Results per scan.
        start: Time of the noise; default: the editor's.
        resamplings: Of RePaint.
        root: Folder that names of results are relative to.
        threads: Of torch in each process; None leaves them as they are.
    """

    options: EditOptions
    missing: MissingPixels
    num: int
    start: float | None
    resamplings: int | None
    root: Path = Path()
    threads: int | None = None

    def read(self, path: Path) -> tuple[PointCloud, ScanView, Tensor]:
        """A scan, its view, and the mask of what is missing."""
        session, cloud = _session(self.options, self.num), read_cloud(path, self.options.columns)
        view = session.view(path, cloud)
        missing = self.missing.find(view.pixels.range_m, session)
        session.check(view, missing)
        if session.baseline is not None:
            session.baseline.known_latents(~missing)  # refuses what it could read nothing of
        return cloud, view, missing

    def __call__(self, path: Path) -> Completion:
        """Complete the scan of a file."""
        if self.threads is not None:
            torch.set_num_threads(self.threads)
        session = _session(self.options, self.num)
        cloud, view, missing = self.read(path)
        if session.baseline is not None:
            result = session.complete(view, missing, self.resamplings or _RESAMPLINGS)
        else:
            start = COMPLETION_START if self.start is None else self.start
            result = session.editor.complete(
                view.pixels, missing, self.num, self.options.seed, start=start
            )
        for index in range(self.num):
            completed = _completed_cloud(cloud, result, index, missing)
            folder = self.options.out / _SCANS
            write_below(completed, self.root, folder / str(index) if self.num > 1 else folder)
        return Completion(result.range_m.numpy(), result.nfe)


@lru_cache(maxsize=1)
def _session(options: EditOptions, num: int) -> EditSession:
    return EditSession(options, num)


def complete_files(
    source: Path, job: CompletionJob, arguments: dict[str, Any], workers: int
) -> str:
    """Complete a scan or all scans of a folder; return a summary with errors."""
    root, paths = find_files(source)
    options, num = job.options, job.num
    refuse_inside(options.out, paths)
    refuse_folder_of_scans(options.out, root, len(paths))
    session = _session(options, num)
    stage = session.checkpoint.stage
    if job.start is not None:
        check_start(job.start)
        if session.baseline is not None:
            raise ValueError(f"--start is for R3DPA: stage {stage} starts from noise")
    if job.resamplings is not None and stage not in ("r2dm", "r2flow"):
        raise ValueError(f"--resamplings is for R2DM and R2Flow, not for stage {stage}")
    threads = None if workers == 1 else max(1, (os.cpu_count() or 1) // workers)
    job = replace(job, root=root, threads=threads)
    _, first_view, first_missing = job.read(paths[0])  # a bad request fails before the first file
    names = [path.relative_to(root).as_posix() for path in paths]
    request = session.request("complete", arguments, {"scans": names})
    request |= {"num": len(paths) * num, "num_per_scan": num}
    with SceneWriter(
        options.out, request["num"], session.projection, (), request, options.overwrite
    ) as writer:
        done = writer.num_done // num
        results = in_processes(job, paths[done:], workers)
        bar = tqdm(results, total=len(paths), initial=done, unit="scan", disable=None)
        for completion in bar:
            writer.put(torch.from_numpy(completion.range_m), completion.nfe)
        writer.close()
        images = np.load(writer.range_path, mmap_mode="r")
        images = images.reshape(len(paths), num, *images.shape[1:])
        errors = {}
        for name, path, image in zip(names, paths, images, strict=True):
            _, view, gaps = job.read(path)
            completed = torch.from_numpy(image.copy())
            errors[name] = held_out_errors(completed, view.pixels.range_m, gaps)
        known_m = torch.where(first_missing, -1.0, first_view.pixels.range_m)
        known = first_view._replace(pixels=Pixels(known_m))
        shown = {f"scan {paths[0].stem}": first_view, "known part": known}
        first_images = torch.from_numpy(images[0].copy())
        session.show("complete", shown, first_images, first_missing, ("kept", "missing"))
        mean = _mean_errors(list(errors.values()))
        nfe = writer.evaluations // writer.num
        writer.finish(request | {"nfe": nfe, "held_out": mean, "held_out_by_scan": errors})
    return _summary(len(paths), nfe, mean, options.out)


def _completed_cloud(
    cloud: PointCloud, result: EditResult, index: int, missing: Tensor
) -> PointCloud:
    """Scan with all its points, and generated ones where it has no point.

    Generated points take intensity and further columns from the nearest point of the scan: a model
    knows the intensities of the sensor that it was trained on. Labels come from the model, else
    they are 0.
    """
    points, projection = cloud.points.astype(np.float32), result.projection
    empty = missing & ~_occupied(torch.from_numpy(points), projection)
    range_m = torch.where(empty, result.range_m[index], -1.0)
    added = points_of(range_m, projection).numpy()
    nearest = cKDTree(points).query(added)[1].astype(np.int64)
    labels = cloud.labels
    if labels is not None:
        added_labels = np.zeros(len(added), labels.dtype)
        if result.labels is not None:
            classes = values_at_returns(result.labels[index], range_m, projection).numpy()
            added_labels = classes_as_of_cloud(classes, cloud).astype(labels.dtype)
        labels = np.concatenate([labels, added_labels])
    rows = np.concatenate([np.arange(len(cloud)), nearest])
    return cloud.changed(rows, np.concatenate([points, added]), labels=labels)


def _occupied(points: Tensor, projection: Projection) -> Tensor:
    """Pixels ``(H, W)`` bool with a point of the scan, beyond the range limits too.

    Points above or below the field of view occupy none, nor does the origin, which files use for
    shots without a return.
    """
    points = points[in_view(points, projection) & (points.norm(dim=-1) > 0)]
    sensor = projection.sensor
    occupied = torch.zeros(sensor.beams, sensor.columns, dtype=torch.bool)
    occupied[projection.pixel_of(points)] = True
    return occupied


def held_out_errors(completed: Tensor, range_m: Tensor, missing: Tensor) -> dict[str, Any]:
    """Errors of completions ``(B, H, W)`` on the returns of the scan, beside interpolations.

    Ranges are compared where the scan and all methods have a return; empty if they share none.
    """
    if not ((range_m > 0) & missing).any():
        return {}
    images = {"completed": completed}
    for how in ("linear", "nearest"):
        images[how] = interpolate_gaps(range_m, missing, how)[None]
    common = missing & (torch.cat(list(images.values())) > 0).all(dim=0)
    if not common.any():
        return {}
    return {
        name: {
            "mae_m": range_error_m(image, range_m.expand_as(image), common),
            "same_returns": ((image > 0) == (range_m > 0))[:, missing].double().mean().item(),
        }
        for name, image in images.items()
    }


def _mean_errors(errors: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Mean over the scans with held-out returns, empty if there are none."""
    measured = [error for error in errors if error]
    if not measured:
        return {}
    return {
        method: {
            key: float(np.mean([error[method][key] for error in measured]))
            for key in measured[0][method]
        }
        for method in _METHODS
    }


def _summary(num_scans: int, nfe: int, errors: dict[str, Any], out: Path) -> str:
    text = _BENCHMARK
    if errors:
        completed, linear, nearest = (errors[method]["mae_m"] for method in _METHODS)
        text = (
            f"mean error of the held-out returns: completed {completed:.2f} m, linear "
            f"interpolation {linear:.2f} m, nearest beam or column {nearest:.2f} m"
        )
    return (
        f"complete: {number_of(num_scans, 'scan')} in {out / _SCANS}, {nfe} network evaluations "
        f"each; all points of the input, then the generated ones\n{text}\n"
        f"open {out / 'edit.png'} and {out / 'edit.html'}"
    )
