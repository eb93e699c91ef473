"""What all edits share: a checkpoint, scans and features read for it, results written.

Letters: B scenes, H beams, W columns, N tokens, F feature width, P points.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import r3dpa
from r3dpa import viz
from r3dpa.checkpoints import read_checkpoint
from r3dpa.cli.edits import EditJob
from r3dpa.cli.scenes import draw_scene, written
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
from r3dpa.geometry import LidarSensor, in_range, range_image
from r3dpa.geometry.gaps import check_view
from r3dpa.io import atomic_path, source_commit, usable_device
from r3dpa.nn.backbones import feature_source

__all__ = ["EditDesk", "Guidance", "Parts", "ScanView", "without_features"]

_SHOWN = 8  # results on the sheet and the page
#: Strength and window, where given.
Guidance = tuple[float | None, tuple[float, float] | None]


class ScanView(NamedTuple):
    """A scan: its file, points ``(P, 4)`` and range image ``(H, W)``."""

    path: Path
    points: Tensor
    range_m: Tensor


class Parts(NamedTuple):
    """Number of the part ``(H, W)`` that each pixel belongs to, and their names."""

    numbers: NDArray[np.uint8]
    names: Sequence[str]


class EditDesk:
    """The checkpoint of a job with all that is read for it, and written of it.

    Args:
        job: What all edits are asked.
        num: Number of results.
        guidance: Strength and window, where given.

    Attributes:
        job: That of the arguments.
        editor: On the device of the job.
        projection: Of the checkpoint.
        sensor: Of the projection.
        grid_size: Rows and columns of the tokens.
        feature_dim: Width of the features that guide.

    Raises:
        ValueError: If a number is out of its range or the checkpoint cannot be sampled from.
        OSError: If the checkpoint cannot be read.
    """

    def __init__(self, job: EditJob, num: int, guidance: Guidance) -> None:
        if num < 1:
            raise ValueError(f"num must be at least 1, got {num}")
        if job.seed < 0 or job.pictures < 0:
            raise ValueError(
                f"seed and pictures must be at least 0, got {job.seed} and {job.pictures}"
            )
        given: dict[str, Any] = {
            name: value
            for name, value in zip(("strength", "window"), guidance, strict=True)
            if value is not None
        }
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
        self.projection = generator.geometry.projection
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
        """A scan, refused if it does not fill the field of view but for what is missing.

        Args:
            path: ``.bin``, ``.ply``, or ``.npz`` of one scan.
            missing: Masks ``(H, W)``.
            empty_beams: Rows without a return are missing too.

        Raises:
            ScanError: If the file cannot be used; it is named.
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
        """Feature grid ``(N, F)`` of a scan, as ``r3dpa features`` makes it."""
        file = Scan(scan.path.parent.name, scan.path.stem, scan.path)
        prepared = extractor.prepare(scan.points)
        sample = PointSample(file, file.cache_key, scan.points, prepared)
        grids = pooled_grids(extractor, [sample], self.projection, [self.grid_size])
        return grids[self.grid_size][0].clone()

    def object_feature(
        self,
        path: Path,
        label: str | None,
        box: Sequence[float] | None,
        ckpt: Path | None,
    ) -> Tensor:
        """Mean feature ``(F,)`` of a class, or of the points in a box, of one scan."""
        if label is not None:
            scan = Scan(path.parent.name, path.stem, path)
            extractor = self.extractor(ckpt)
            library = object_library([scan], extractor, self.projection, self.grid_size, [label])
            return library.feature(label)
        assert box is not None
        if min(box[3:6]) <= 0:
            raise ValueError(f"features_box3d needs a size above 0 on every axis, got {list(box)}")
        scan_view = self.read(path)
        points = scan_view.points
        turned = points[:, :3] - torch.tensor(box[:3])
        yaw = torch.tensor(box[6]).deg2rad()
        along = turned[:, 0] * yaw.cos() + turned[:, 1] * yaw.sin()
        across = turned[:, 1] * yaw.cos() - turned[:, 0] * yaw.sin()
        turned = torch.stack([along, across, turned[:, 2]], dim=1).abs()
        inside = (turned <= torch.tensor(box[3:6]) / 2).all(dim=1)
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
        asked: dict[str, Any],
        before: Mapping[str, Tensor],
        run: Callable[[], EditResult],
        parts: Parts | None = None,
        measure: Callable[[Tensor], dict[str, Any]] | None = None,
    ) -> str:
        """Runs an edit and writes all of it; what it was, in words.

        Args:
            command: Its name.
            asked: What decides about it beside the job.
            before: Range images ``(H, W)`` of the scans by name.
            run: The edit.
            parts: Parts of the range image.
            measure: More figures of the results ``(B, H, W)``.

        Raises:
            ValueError: If the edit is refused, or ``out`` holds other scenes.
            OSError: If a file cannot be written.
        """
        job, out = self.job, self.job.out
        settings = asdict(self.settings)
        if not asked["guided"]:
            del settings["strength"], settings["window"]
        request = {
            "command": command,
            **asked,
            **{"checkpoint": str(job.ckpt), "checkpoint_written": written(job.ckpt)},
            **{"stage": self.checkpoint.stage, "step": self.checkpoint.step},
            "feature_source": self.checkpoint.feature_source,
            **{"weights": job.weights, "num": self.num, "seed": job.seed},
            **{"settings": settings, "device": self.device, "batch_size": job.batch_size},
            "interpolant": self.checkpoint.interpolant,
            "formats": [name.strip() for name in job.formats.split(",")],
            "geometry": self.geometry.to_dict(),
            **{"r3dpa": r3dpa.__version__, "commit": source_commit(), "torch": torch.__version__},
        }
        formats = request["formats"]
        with SceneWriter(out, self.num, self.projection, formats, request, job.overwrite) as writer:
            seconds = -time.perf_counter()
            result = run()
            seconds += time.perf_counter()
            writer.put(result.range_m[writer.num_done :].contiguous(), result.nfe)
            writer.close()
            self._show(command, before, result.range_m, parts)
            cosine = None if result.cosine is None else result.cosine.tolist()
            figures = {
                **{"nfe": result.nfe, "seconds": seconds, "cosine": cosine},
                **{"vae_error_m": result.vae_error_m, "round_trip_m": result.round_trip_m},
                **(measure(result.range_m) if measure else {}),
            }
            writer.finish(request | figures)
        return _summary(command, out, self.num, figures)

    def _show(
        self, command: str, before: Mapping[str, Tensor], made: Tensor, parts: Parts | None
    ) -> None:
        """Pictures of each scene, the sheet, the page, the mask and the scans as they were."""
        out = self.job.out
        with atomic_path(out / "before.npy") as temporary, temporary.open("wb") as file:
            np.save(file, torch.stack(list(before.values())).numpy())
        for index, range_m in enumerate(made[: self.job.pictures]):
            draw_scene(out, f"{index:06d}", range_m, self.geometry)
        after = {f"{command} {index}": image for index, image in enumerate(made[:_SHOWN])}
        rows = [viz.EditRow(name, image) for name, image in before.items()]
        numbers, names = parts or (None, ())
        if parts is not None:
            scans = torch.stack(list(before.values()))
            own = torch.from_numpy(parts.numbers).long() if command == "mix" else torch.zeros(1, 1)
            asked = scans.gather(0, own.long().expand(1, *scans.shape[1:]))[0]
            rows.append(viz.EditRow("mask", asked, parts.numbers))
            viz.save(parts.numbers * np.uint8(255 // (len(names) - 1)), out / "mask.png")
        rows += [viz.EditRow(name, image, outline=numbers) for name, image in after.items()]
        viz.save(viz.edit_sheet(rows, names, self.projection), out / "edit.png")
        page = viz.edit_page(before, after, numbers, names, self.projection, f"r3dpa {command}")
        with atomic_path(out / "edit.html") as temporary:
            temporary.write_text(page, "utf-8")


def _points(path: Path, sensor: LidarSensor) -> NDArray[np.float32]:
    """Points ``(P, 4)`` of a file; the intensity is 0 where it has none."""
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
        lines.append(f"cosine with the features that guide: {sum(cosines) / len(cosines):.3f}")
    for name, errors in figures.get("held_out", {}).items():
        lines.append(
            f"held out, {name}: {errors['mae_m']:.3f} m, returns as in the scan in "
            f"{errors['same_returns']:.1%} of the pixels"
        )
    return "\n".join([*lines, str(out / "edit.png"), str(out / "edit.html")])


def without_features(ckpt: Path) -> str:
    """Why a checkpoint cannot be guided."""
    return (
        f"{ckpt} was trained without 3D features, so that none can guide it; give a checkpoint of "
        "a run with an extractor"
    )
