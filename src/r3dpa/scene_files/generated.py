"""Files that several commands read or write: clouds, pictures of scenes, pages, provenance."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from tqdm import tqdm

import r3dpa
from lidarsim.clouds import check_metres
from lidarsim.scan_files import ScanError, read_beside, read_clouds
from r3dpa import viz
from r3dpa.checkpoints import Checkpoint, read_snapshot
from r3dpa.data.labels import find_labels
from r3dpa.data.scans import find_scans
from r3dpa.data.scene_writer import SceneWriter
from r3dpa.flow.sampler import Quality
from r3dpa.generation import Autoguidance, SamplerConfig, SceneGenerator
from r3dpa.geometry import BeamProjection, ScanGeometry
from r3dpa.io import source_commit
from r3dpa.pretrained import weights_file, without_features
from r3dpa.scene_files.options import SceneOptions
from r3dpa.stages import BASELINE_STAGES, published_sampler

if TYPE_CHECKING:
    from r3dpa.baselines import BaselineGenerator


def written(path: Path) -> str:
    """Time of the last change of a file: the same name may hold other weights later."""
    return datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat()


def feature_source_of(checkpoint: Checkpoint) -> str:
    """Feature source of a checkpoint; raises a ValueError if it was trained without."""
    if checkpoint.feature_source is None:
        raise without_features(checkpoint.path)
    return checkpoint.feature_source


def provenance(
    checkpoint: Checkpoint, options: SceneOptions, num: int, device: str, geometry: ScanGeometry
) -> dict[str, Any]:
    """Checkpoint, request, geometry and versions, as the metadata of scenes holds them."""
    trained = ("stage", "step", "feature_source", "interpolant")
    about = {name: getattr(checkpoint, name) for name in trained}
    about |= {name: getattr(options, name) for name in ("weights", "seed", "batch_size")}
    return about | {
        "checkpoint": str(options.ckpt),
        "checkpoint_written": written(checkpoint.path),
        "num": num,
        "device": device,
        "formats": list(options.formats),
        "geometry": geometry.to_dict(),
        "r3dpa": r3dpa.__version__,
        "commit": source_commit(),
        "torch": torch.__version__,
    }


def sampler_of(
    checkpoint: Checkpoint, quality: Quality | None, given: Mapping[str, Any]
) -> SamplerConfig | Quality | None:
    """Sampler of a quality, or of a baseline as published, with the settings that are given."""
    if not given:
        return quality
    if checkpoint.stage in BASELINE_STAGES:
        return published_sampler(checkpoint).changed(**given)
    return SamplerConfig.of_quality(quality or "good").changed(**given)


def autoguidance_of(
    path: Path,
    checkpoint: Checkpoint,
    weights: Literal["ema", "last"],
    device: str,
    scale: float,
    interval: tuple[float, float],
) -> tuple[Autoguidance, dict[str, Any]]:
    """Guidance away from the model of a snapshot, and what the metadata says about it."""
    weak = read_snapshot(path, checkpoint, weights)
    sit, shift = weak.sit.to(device), weak.shift.to(device)
    about = {
        "checkpoint": str(path),
        "checkpoint_written": written(weights_file(path)),
        "step": weak.step,
        "scale": scale,
        "interval": list(interval),
    }
    return Autoguidance(sit, scale, interval, weak.scale, shift), about


def generate_all(
    generator: SceneGenerator | BaselineGenerator,
    writer: SceneWriter,
    batch_size: int,
    seed: int,
    seen_by: BeamProjection | None = None,
) -> dict[str, Any]:
    """Generate and write the missing scenes, as a sensor sees them if one is given.

    Return evaluations and time.
    """
    first_index, start = writer.num_done, time.perf_counter()
    with tqdm(
        total=writer.num, initial=first_index, unit="scene", desc="sampling", disable=None
    ) as progress:
        for first in range(first_index, writer.num, batch_size):
            indices = range(first, min(first + batch_size, writer.num))
            batch = generator.generate(indices, seed)
            if seen_by is not None:
                batch = batch.seen_by(seen_by)
            writer.put(batch.range_m, batch.nfe, batch.intensity, batch.labels)
            progress.update(len(indices))
    writer.close()
    elapsed, drawn = time.perf_counter() - start, writer.num - first_index
    nfe = writer.evaluations / writer.num  # a fraction only if a solver chooses its steps
    return {
        "nfe": int(nfe) if nfe.is_integer() else nfe,
        "drawn_by_last_run": drawn,
        "seconds_per_scene": elapsed / drawn if drawn else None,
        "threads": torch.get_num_threads(),
    }


def page_scans(source: Path, columns: Sequence[str] = ()) -> list[Callable[[], viz.PageScan]]:
    """Readers of the scans of a folder or file, in order.

    They raise a ScanError where :func:`lidarsim.clouds.check_metres` does.
    """

    def read(name: str, path: Path) -> viz.PageScan:
        clouds = read_clouds(path, columns)
        if len(clouds) > 1:
            raise ScanError(f"{path}: holds {len(clouds)} scans: give the file alone, or remove it")
        (points,) = clouds.values()
        check_metres(path, points)
        origins = read_beside(path, "origins") if path.suffix == ".bin" else None
        return viz.PageScan(name, points, find_labels(path, len(points)), origins)

    def member(name: str, points: np.ndarray) -> viz.PageScan:
        check_metres(f"{source}: {name}", points)
        return viz.PageScan(f"{source.stem}/{name}", points)

    if source.suffix == ".npz" and source.is_file():
        return [partial(member, *item) for item in read_clouds(source, columns).items()]
    return [partial(read, scan.name, scan.path) for scan in find_scans(source)]
