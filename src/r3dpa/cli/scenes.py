"""``r3dpa sample`` and ``r3dpa report``: scenes and loss curves as files."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

import r3dpa
from r3dpa import viz
from r3dpa.checkpoints import (
    Checkpoint,
    read_checkpoint,
)
from r3dpa.data.scene_writer import SceneWriter
from r3dpa.generation import Autoguidance, SamplerConfig, SceneGenerator
from r3dpa.geometry import ScanGeometry, points_of
from r3dpa.io import source_commit, usable_device

__all__ = [
    "WeakGuide",
    "draw_scene",
    "report",
    "sample",
    "written",
]

_ON_SHEET = 16


@dataclass(frozen=True)
class WeakGuide:
    """A weak model that guides: file, strength, guided times, and whether other latents may."""

    path: Path
    scale: float
    interval: tuple[float, float]
    allow: bool


def _autoguidance(
    checkpoint: Checkpoint, guide: WeakGuide, weights: Literal["ema", "last"], device: str
) -> tuple[Autoguidance, dict[str, Any]]:
    """The weak model, and what the metadata tell of it."""
    from r3dpa.checkpoints.snapshots import read_snapshot

    weak = read_snapshot(guide.path, checkpoint, weights, guide.allow)
    about = {
        "checkpoint": str(guide.path),
        "checkpoint_written": written(guide.path),
        "step": weak.step,
        "feature_source": weak.feature_source,
        "scale": guide.scale,
        "interval": list(guide.interval),
    }
    sit, shift = weak.sit.to(device), weak.shift.to(device)
    return Autoguidance(sit, guide.scale, guide.interval, weak.scale, shift), about


def sample(
    ckpt: Path,
    out: Path,
    num: int,
    seed: int,
    sampler: SamplerConfig,
    *,
    batch_size: int = 8,
    decode_batch_size: int | None = None,
    compile: bool = False,
    precision: Literal["fp32", "bf16"] = "fp32",
    device: str = "auto",
    weights: Literal["ema", "last"] = "ema",
    guide: WeakGuide | None = None,
    formats: Sequence[str] = ("bin",),
    pictures: int = 64,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Writes scenes, pictures and metadata below ``out``; see ``r3dpa sample --help``.

    What can be refused is refused before anything in ``out`` is written or removed.

    Returns:
        The metadata. ``nfe`` is the mean over all scenes, those of interrupted runs too.

    Raises:
        ValueError: If ``out`` holds scenes already, or unfinished ones of another request, the
            checkpoint cannot be sampled from.
        OSError: If a file cannot be written.
    """
    if num < 1 or batch_size < 1:
        raise ValueError(f"num and batch_size must be at least 1, got {num} and {batch_size}")
    if seed < 0 or pictures < 0:
        raise ValueError(f"seed and pictures must be at least 0, got {seed} and {pictures}")
    device = usable_device(device)
    checkpoint = read_checkpoint(ckpt)
    guidance, about_guide = None, None
    if guide is not None:
        guidance, about_guide = _autoguidance(checkpoint, guide, weights, device)
    generator = SceneGenerator.from_checkpoint(
        checkpoint,
        sampler,
        weights=weights,
        device=device,
        precision=precision,
        autoguidance=guidance,
        batch_size=batch_size if compile else None,
        decode_batch_size=decode_batch_size,
        compile=compile,
    )
    generator.prepare()
    request = {
        "checkpoint": str(ckpt),
        "checkpoint_written": written(ckpt),
        "stage": checkpoint.stage,
        "step": checkpoint.step,
        "feature_source": checkpoint.feature_source,
        "weights": weights,
        "num": num,
        "seed": seed,
        "sampler": asdict(sampler),
        "autoguidance": about_guide,
        "interpolant": checkpoint.interpolant,
        "precision": precision,
        "device": device,
        "compile": compile,
        "batch_size": batch_size,
        "decode_batch_size": decode_batch_size,
        "formats": list(formats),
        "geometry": generator.geometry.to_dict(),
        "r3dpa": r3dpa.__version__,
        "commit": source_commit(),
        "torch": torch.__version__,
    }
    projection = generator.geometry.projection
    with SceneWriter(out, num, projection, formats, request, overwrite) as writer:
        measured = _draw_scenes(generator, writer, batch_size, seed)
        seconds = -time.perf_counter()
        ranges = np.load(writer.range_path, mmap_mode="r")
        drawn = [torch.from_numpy(np.array(range_m)) for range_m in ranges[:pictures]]
        for index, range_m in enumerate(drawn):
            draw_scene(out, f"{index:06d}", range_m, generator.geometry)
        if drawn:
            sheet = viz.scenes_sheet(drawn[:_ON_SHEET], projection)
            viz.save(sheet, out / "scenes.png")
        metadata = request | measured | {"picture_seconds": seconds + time.perf_counter()}
        writer.finish(metadata)
    return metadata


def _draw_scenes(
    generator: SceneGenerator, writer: SceneWriter, batch_size: int, seed: int
) -> dict[str, Any]:
    """Draws and writes the scenes that are missing; returns what it took.

    Device seconds are those of the networks; on a GPU by its own clock, which nothing waits for.
    """
    first_index, clock = writer.num_done, _DeviceClock(generator.device)
    start = time.perf_counter()
    with tqdm(
        total=writer.num, initial=first_index, unit="scene", desc="sampling", disable=None
    ) as progress:
        for first in range(first_index, writer.num, batch_size):
            indices = range(first, min(first + batch_size, writer.num))
            clock.start()
            batch = generator.generate(indices, seed)
            clock.stop()
            writer.put(batch.range_m, batch.nfe)
            progress.update(len(indices))
    writer.close()
    elapsed = time.perf_counter() - start
    device_seconds = clock.seconds()
    drawn = writer.num - first_index
    nfe = writer.evaluations / writer.num  # whole but for a solver that chooses its steps
    return {
        "nfe": int(nfe) if nfe.is_integer() else nfe,
        "drawn_by_last_run": drawn,
        "device_seconds_per_scene": sum(device_seconds) / drawn if drawn else None,
        "seconds_per_scene": elapsed / drawn if drawn else None,
        "first_batch_device_seconds": device_seconds[0] if drawn else None,
        "threads": {
            "torch": torch.get_num_threads(),
            "between_operations": torch.get_num_interop_threads(),
            "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS"),
        },
    }


class _DeviceClock:
    """Seconds between each start and stop, in the time of the device."""

    def __init__(self, device: torch.device) -> None:
        self._on_gpu = device.type == "cuda"
        self._marks: list[Any] = []

    def start(self) -> None:
        if not self._on_gpu:
            self._marks.append(time.perf_counter())
            return
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        self._marks.append(event)

    stop = start

    def seconds(self) -> list[float]:
        pairs = zip(self._marks[::2], self._marks[1::2], strict=True)
        if not self._on_gpu:
            return [stop - start for start, stop in pairs]
        torch.cuda.synchronize()
        return [start.elapsed_time(stop) / 1000 for start, stop in pairs]


def written(path: Path) -> str:
    """When a file was written last: the same name may hold other weights by now."""
    return datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat()


def draw_scene(out: Path, name: str, range_m: Tensor, geometry: ScanGeometry) -> None:
    """Pictures of a scene ``(H, W)``: range image, from above and from behind."""
    sensor, points = geometry.projection.sensor, points_of(range_m, geometry.projection)
    picture = viz.range_image_picture(range_m, sensor, scale=max(1, 1024 // sensor.columns))
    viz.save(picture, out / "range" / f"{name}.png")
    viz.save(viz.birds_eye_view(points), out / "birds_eye" / f"{name}.png")
    viz.save(viz.scene_3d(points), out / "scene_3d" / f"{name}.png")


def report(run: Path) -> str:
    """Draws ``loss_curves.png`` of a run and says where each logged quantity started and ended.

    Args:
        run: Folder with the ``version_*/metrics.csv`` of a CSVLogger; a resumed run has several.

    Returns:
        A table: quantity, mean of the first and of the last tenth of its values, their difference
        and, where both are positive, their ratio.

    Raises:
        ValueError: If the folder holds no metrics.
    """
    paths = sorted(run.glob("version_*/metrics.csv"), key=lambda path: path.stat().st_mtime)
    if not paths:
        raise ValueError(f"{run} holds no version_*/metrics.csv; give the --run_dir of a fit")
    curves: dict[str, viz.Series] = {}
    for path in paths:
        for name, (steps, values) in viz.read_metrics(path).items():
            before = curves.get(name, ([], []))
            curves[name] = ([*before[0], *steps], [*before[1], *values])
    viz.save(viz.loss_curves(curves), run / "loss_curves.png")
    rows = [f"{'quantity':<26}{'first tenth':>13}{'last tenth':>13}{'change':>13}{'ratio':>8}"]
    for name, (_, values) in curves.items():
        tenth = max(1, len(values) // 10)
        first, last = fmean(values[:tenth]), fmean(values[-tenth:])
        ratio = f"{last / first:.3f}" if first > 0 and last > 0 else ""
        rows.append(f"{name:<26}{first:>13.5g}{last:>13.5g}{last - first:>+13.5g}{ratio:>8}")
    return "\n".join([*rows, f"curves: {run / 'loss_curves.png'}"])
