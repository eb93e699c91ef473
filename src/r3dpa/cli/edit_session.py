"""Work shared by the edits: read checkpoint, scans and features, run the edit, write the results.

Letters: B scenes, H beams, W columns, N tokens, F feature width, P points.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

import r3dpa
from r3dpa import viz
from r3dpa.checkpoints import read_checkpoint
from r3dpa.cli.parser import check_folder
from r3dpa.cli.sample import draw_scene, written
from r3dpa.data import (
    Extractor,
    PointSample,
    Scan,
    ScanError,
    pooled_grids,
    read_npz,
    read_ply,
    read_scan,
)
from r3dpa.data.objects import object_library
from r3dpa.data.scene_writer import SceneWriter
from r3dpa.editing import EditResult, EditSettings, SceneEditor
from r3dpa.flow.solvers import evaluations
from r3dpa.geometry import LidarSensor, in_range, range_image
from r3dpa.geometry.gaps import check_view, filled, range_error_m
from r3dpa.io import atomic_path, source_commit, usable_device
from r3dpa.nn.backbones import feature_source

if TYPE_CHECKING:
    from r3dpa.cli.edit import EditJob

__all__ = ["EditSession", "Parts", "ScanView", "held_out_errors", "without_features"]

_SHOWN = 8  # results on the sheet and the page


class ScanView(NamedTuple):
    """A scan: its file, points ``(P, 4)`` and range image ``(H, W)``."""

    path: Path
    points: Tensor
    range_m: Tensor


class Parts(NamedTuple):
    """Part ``(H, W)`` of the range image that each pixel belongs to, and names of the parts."""

    numbers: NDArray[np.uint8]
    names: Sequence[str]


class EditSession:
    """A checkpoint opened for one edit.

    Args:
        job: Options of all edits.
        num: Number of results.
        strength: Guidance strength; None for the default.
        window: Guided times; None for the default.

    Raises:
        ValueError: If a number is out of its range or the checkpoint cannot be sampled from.
        OSError: If the checkpoint cannot be read.
    """

    def __init__(
        self,
        job: EditJob,
        num: int,
        strength: float | None = None,
        window: tuple[float, float] | None = None,
    ) -> None:
        if num < 1:
            raise ValueError(f"num must be at least 1, got {num}")
        if job.seed < 0 or job.pictures < 0:
            raise ValueError(
                f"seed and pictures must be at least 0, got {job.seed} and {job.pictures}"
            )
        check_folder(job.out)
        given: dict[str, Any] = {"strength": strength, "window": window}
        given = {name: value for name, value in given.items() if value is not None}
        self.job, self.num = job, num
        self.settings = EditSettings(job.solver, job.steps, job.shift, **given)
        self.device = usable_device(job.device)
        self.checkpoint = read_checkpoint(job.ckpt)
        self.editor = SceneEditor.from_checkpoint(
            self.checkpoint,
            self.settings,
            weights=job.weights,
            device=self.device,
            batch_size=job.batch_size,
        )
        generator = self.editor.generator
        self.geometry = generator.geometry
        self.projection = self.geometry.projection
        self.sensor = self.projection.sensor
        self.grid_size, self.feature_dim = generator.sit.grid_size, generator.sit.feature_dim

    @property
    def feature_name(self) -> str:
        """Feature source of the checkpoint.

        Raises:
            ValueError: If it has none.
        """
        if self.checkpoint.feature_source is None:
            raise ValueError(without_features(self.job.ckpt))
        return self.checkpoint.feature_source

    def read(
        self, path: Path, missing: Sequence[Tensor] = (), empty_beams: bool = False
    ) -> ScanView:
        """A scan that fills the field of view outside the ``missing`` masks ``(H, W)``.

        Args:
            path: ``.bin``, ``.ply``, or ``.npz`` of one scan.
            missing: Masks of pixels that may be empty.
            empty_beams: Rows without a return may be empty, too.

        Raises:
            ScanError: If the file cannot be used; names it.
        """
        points = torch.from_numpy(_points(path, self.sensor))
        try:
            range_m, _ = range_image(points[:, :3], self.projection)
            gaps = [*missing]
            if empty_beams:
                gaps.append(~(range_m > 0).any(dim=1, keepdim=True).expand_as(range_m))
            absent = torch.stack(gaps).any(dim=0) if gaps else None
            check_view(points[:, :3], range_m, self.projection, absent)
        except ValueError as error:
            raise ScanError(f"{path}: {error}") from error
        return ScanView(path, points, range_m)

    def extractor(self, ckpt: Path | None) -> Extractor:
        """The feature source that the checkpoint was aligned with."""
        source: Any = feature_source(self.feature_name, ckpt, self.feature_dim)
        return source.to(self.device)

    def grid(self, scan: ScanView, extractor: Extractor) -> Tensor:
        """Feature grid ``(N, F)`` of a scan, as ``r3dpa features`` writes it."""
        prepared = extractor.prepare(scan.points)
        file = Scan(scan.path.parent.name, scan.path.stem, scan.path)
        sample = PointSample(file, file.cache_key, scan.points, prepared)
        grids = pooled_grids(extractor, [sample], self.projection, [self.grid_size])
        return grids[self.grid_size][0].clone()

    def feature_of_class(self, path: Path, label: str, ckpt: Path | None) -> Tensor:
        """Mean feature ``(F,)`` of a class of one scan."""
        scan = Scan(path.parent.name, path.stem, path)
        extractor = self.extractor(ckpt)
        library = object_library([scan], extractor, self.projection, self.grid_size, [label])
        return library.feature(label)

    def feature_in_box(self, path: Path, box: Sequence[float], ckpt: Path | None) -> Tensor:
        """Mean feature ``(F,)`` of the points of a scan in a box: centre, size, yaw in degrees."""
        if min(box[3:6]) <= 0:
            raise ValueError(f"features_box3d needs a size above 0 on every axis, got {list(box)}")
        points = self.read(path).points
        offset = points[:, :3] - torch.tensor(box[:3])
        yaw = torch.tensor(box[6]).deg2rad()
        along = offset[:, 0] * yaw.cos() + offset[:, 1] * yaw.sin()
        across = offset[:, 1] * yaw.cos() - offset[:, 0] * yaw.sin()
        distance = torch.stack([along, across, offset[:, 2]], dim=1).abs()
        inside = (distance <= torch.tensor(box[3:6]) / 2).all(dim=1)
        inside &= in_range(points[:, :3], self.sensor)
        if not inside.any():
            raise ValueError(f"{path}: has no point in the box {list(box)}")
        extractor = self.extractor(ckpt)
        with torch.no_grad():
            values = extractor.point_features([extractor.prepare(points)])[0]
            mean = values[inside.to(values.device)].float().mean(dim=0, keepdim=True)
            return getattr(extractor, "lift", torch.nn.Identity())(mean)[0].cpu()

    def write(
        self,
        command: str,
        about: dict[str, Any],
        before: Mapping[str, Tensor],
        run: Callable[[], EditResult],
        parts: Parts | None = None,
        measure: Callable[[Tensor], dict[str, Any]] | None = None,
    ) -> str:
        """Runs an edit and writes scenes, pictures, page and metadata; returns a summary.

        Args:
            command: Name of the edit.
            about: Its own options, for the metadata.
            before: Range images ``(H, W)`` of the scans by name.
            run: The edit.
            parts: Parts of the range image.
            measure: More figures of the results ``(B, H, W)``.

        Raises:
            ValueError: If the edit is refused, or ``out`` holds other scenes.
            OSError: If a file cannot be written.
        """
        job, settings = self.job, asdict(self.settings)
        if not about["guided"]:
            del settings["strength"], settings["window"]
        paths = {key: str(value) for key, value in about.items() if isinstance(value, Path)}
        request = about | paths
        request |= {
            "command": command,
            "checkpoint": str(job.ckpt),
            "checkpoint_written": written(job.ckpt),
            "stage": self.checkpoint.stage,
            "step": self.checkpoint.step,
            "feature_source": self.checkpoint.feature_source,
            "weights": job.weights,
            "num": self.num,
            "seed": job.seed,
            "settings": settings,
            "device": self.device,
            "batch_size": job.batch_size,
            "interpolant": self.checkpoint.interpolant,
            "formats": list(job.formats),
            "geometry": self.geometry.to_dict(),
            "r3dpa": r3dpa.__version__,
            "commit": source_commit(),
            "torch": torch.__version__,
        }
        with SceneWriter(
            job.out, self.num, self.projection, job.formats, request, job.overwrite
        ) as writer:
            seconds = -time.perf_counter()
            with self._progress(command):
                result = run()
            seconds += time.perf_counter()
            writer.put(result.range_m[writer.num_done :].contiguous(), result.nfe)
            writer.close()
            self._show(command, before, result.range_m, parts)
            figures = {
                "nfe": result.nfe,
                "seconds": seconds,
                "cosine": None if result.cosine is None else result.cosine.tolist(),
                "vae_error_m": result.vae_error_m,
                "round_trip_m": result.round_trip_m,
            }
            figures |= measure(result.range_m) if measure else {}
            writer.finish(request | figures)
        return _summary(command, job.out, self.num, figures)

    @contextmanager
    def _progress(self, command: str) -> Iterator[None]:
        """Bar of network evaluations of whole batches; the total is that of a full way and back."""
        steps = evaluations(self.job.solver, self.job.steps)
        batches = math.ceil(self.num / self.job.batch_size)
        total = self.num * self.job.steps if command == "complete" else steps * (batches + 1)
        first = next(self.editor.generator.sit.children())  # called once in each evaluation
        with tqdm(total=total, unit="evaluation", desc=command, disable=None) as bar:

            def count(*_: Any) -> None:
                bar.update()

            hook = first.register_forward_hook(count)
            try:
                yield
            finally:
                hook.remove()

    def _show(
        self, command: str, before: Mapping[str, Tensor], made: Tensor, parts: Parts | None
    ) -> None:
        """Pictures of each scene, the sheet, the page, the mask and the scans before the edit."""
        out = self.job.out
        scans = torch.stack(list(before.values()))
        with atomic_path(out / "before.npy") as temporary, temporary.open("wb") as file:
            np.save(file, scans.numpy())
        for index, range_m in enumerate(made[: self.job.pictures]):
            draw_scene(out, f"{index:06d}", range_m, self.geometry)
        after = {f"{command} {index}": image for index, image in enumerate(made[:_SHOWN])}
        rows = [viz.EditRow(name, image) for name, image in before.items()]
        numbers, names = parts or (None, ())
        if parts is not None:
            shown = scans[0]
            if command == "mix":  # each part as in the scan that it follows
                shown = scans.gather(0, torch.from_numpy(parts.numbers).long()[None])[0]
            rows.append(viz.EditRow("mask", shown, parts.numbers))
            viz.save(parts.numbers * np.uint8(255 // (len(names) - 1)), out / "mask.png")
        rows += [viz.EditRow(name, image, outline=numbers) for name, image in after.items()]
        viz.save(viz.edit_sheet(rows, names, self.projection), out / "edit.png")
        page = viz.edit_page(before, after, numbers, names, self.projection, f"r3dpa {command}")
        with atomic_path(out / "edit.html") as temporary:
            temporary.write_text(page, "utf-8")


def _points(path: Path, sensor: LidarSensor) -> NDArray[np.float32]:
    """Points ``(P, 4)`` of a file; the intensity is 0 if it has none."""
    if path.suffix == ".bin":
        return read_scan(path, sensor)
    if path.suffix == ".ply":
        points = read_ply(path)
    elif path.suffix == ".npz":
        members = read_npz(path)
        if len(members) != 1:
            raise ScanError(
                f"{path}: holds {len(members)} scans ({', '.join(list(members)[:3])}); give a file "
                "of one"
            )
        (points,) = members.values()
    else:
        raise ScanError(f"{path}: is no scan; give a .bin, .ply or .npz file")
    if points.ndim != 2 or points.shape[1] not in (3, 4) or not np.isfinite(points).all():
        raise ScanError(f"{path}: must hold finite points (P, 3) or (P, 4), got {points.shape}")
    padded = np.zeros((len(points), 4), np.float32)
    padded[:, : points.shape[1]] = points
    if not in_range(torch.from_numpy(padded[:, :3]), sensor).any():
        limits = f"{sensor.range_min_m:g}..{sensor.range_max_m:g} m"
        raise ScanError(f"{path}: has no point within the sensor's range {limits}")
    return padded


def _summary(command: str, out: Path, num: int, figures: Mapping[str, Any]) -> str:
    lines = [
        f"{command}: {num} scenes in {out}, {figures['nfe']} network evaluations each, "
        f"{figures['seconds']:.3g} s"
    ]
    if figures["vae_error_m"] is not None:
        lines.append(f"range error of encoder and decoder alone: {figures['vae_error_m']:.3f} m")
    if figures["round_trip_m"] is not None:
        lines.append(
            f"inversion and back, without an edit: {figures['round_trip_m']:.4f} m more at most"
        )
    if figures["cosine"] is not None:
        cosines = figures["cosine"]
        lines.append(f"cosine with the guiding features: {sum(cosines) / len(cosines):.3f}")
    for name, errors in figures.get("held_out", {}).items():
        lines.append(
            f"held out, {name}: {errors['mae_m']:.3f} m, returns as in the scan in "
            f"{errors['same_returns']:.1%} of the pixels"
        )
    return "\n".join([*lines, f"open {out / 'edit.png'} and {out / 'edit.html'}"])


def without_features(ckpt: Path) -> str:
    """Error message for a checkpoint that features cannot guide."""
    return (
        f"{ckpt} was trained without 3D features, so that none can guide it; give a checkpoint of "
        "a run with an extractor"
    )


def held_out_errors(made: Tensor, range_m: Tensor, missing: Tensor) -> dict[str, Any]:
    """Errors of completions ``(B, H, W)`` on the returns of the scan, beside interpolations.

    Ranges are compared where the scan and all methods have a return; empty without any there.
    """
    if not ((range_m > 0) & missing).any():
        return {}
    methods = {
        "completed": made,
        "nearest": filled(range_m, missing, "nearest")[None],
        "linear": filled(range_m, missing, "linear")[None],
    }
    common = missing
    for images in methods.values():
        common = common & (images > 0).all(dim=0)
    held_out = {}
    for name, images in methods.items():
        same = ((images > 0) == (range_m > 0))[:, missing]
        held_out[name] = {
            "mae_m": range_error_m(images, range_m.expand_as(images), common),
            "same_returns": float(same.double().mean()),
        }
    return {"held_out": held_out}
