"""``r3dpa sample`` and ``r3dpa report``: scenes and loss curves as files."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import asdict
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import torch
from torch import Tensor
from tqdm import tqdm

import r3dpa
from r3dpa import viz
from r3dpa.atomic import atomic_path
from r3dpa.checkpoints import Checkpoint, read_checkpoint, source_commit
from r3dpa.data.scans import write_bin, write_npz, write_ply
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import ScanGeometry, points_of
from r3dpa.nn import VAE, LatentNorm, SiT

__all__ = ["generator_from", "report", "sample"]

_ON_SHEET = 16
_KINDS = ("bin", "ply", "range", "birds_eye", "scene_3d")


def generator_from(
    checkpoint: Checkpoint,
    sampler: SamplerConfig,
    weights: Literal["ema", "last"] = "ema",
    precision: Literal["fp32", "bf16"] = "fp32",
    device: str = "cpu",
) -> SceneGenerator:
    """Rebuilds the networks of a checkpoint for sampling, on the path they were trained on.

    Raises:
        ValueError: If a network, the latent statistics or the scan geometry is missing.
    """
    if checkpoint.stage == "vae_alignment":
        raise ValueError(
            f"{checkpoint.path} is of stage vae_alignment, which trains no velocity; sample from "
            "a checkpoint of stage joint or flow_matching"
        )
    if checkpoint.geometry is None:
        raise ValueError(
            f"{checkpoint.path} does not say which sensor it was trained for; convert it with "
            "`r3dpa convert`, which records it"
        )
    names = ("ema", "ema_latent_norm") if weights == "ema" else ("sit", "latent_norm")
    vae, sit, norm = (checkpoint.network(name).build().to(device) for name in ("vae", *names))
    if not (isinstance(vae, VAE) and isinstance(sit, SiT) and isinstance(norm, LatentNorm)):
        raise ValueError(f"{checkpoint.path} holds other classes than VAE, SiT and LatentNorm")
    geometry = ScanGeometry.from_dict(dict(checkpoint.geometry))
    return SceneGenerator(vae, sit, norm, geometry, sampler, checkpoint.interpolant, precision)


def sample(
    ckpt: Path,
    out: Path,
    num: int,
    seed: int,
    sampler: SamplerConfig,
    batch_size: int,
    precision: Literal["fp32", "bf16"],
    device: str,
    weights: Literal["ema", "last"],
    pictures: int,
    overwrite: bool,
) -> dict[str, Any]:
    """Writes scenes, pictures and metadata below ``out``; see ``r3dpa sample --help``.

    Returns:
        The metadata.

    Raises:
        ValueError: If ``out`` holds scenes already, or the checkpoint cannot be sampled from.
    """
    if (out / "metadata.json").exists() and not overwrite:
        raise ValueError(f"{out} holds scenes already; give another --out or --overwrite true")
    if num < 1 or batch_size < 1:
        raise ValueError(f"num and batch_size must be at least 1, got {num} and {batch_size}")
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    checkpoint = read_checkpoint(ckpt)
    generator = generator_from(checkpoint, sampler, weights, precision, device)
    for kind in _KINDS:
        shutil.rmtree(out / kind, ignore_errors=True)  # of an earlier run with more scenes
    drawn, points, seconds, nfe = [], {}, 0.0, 0
    with tqdm(total=num, unit="scene", desc="sampling") as progress:
        for first in range(0, num, batch_size):
            indices = range(first, min(first + batch_size, num))
            start = time.perf_counter()
            batch = generator.generate(indices, seed)
            range_m, nfe = batch.range_m.cpu(), batch.nfe  # the copy waits for the GPU
            seconds += time.perf_counter() - start
            for index, scene_m in zip(indices, range_m, strict=True):
                name = f"{index:06d}"
                points[name] = points_of(scene_m, generator.geometry.projection)
                write_bin(out / "bin" / f"{name}.bin", points[name])
                write_ply(out / "ply" / f"{name}.ply", points[name])
                if index < pictures:
                    _draw_scene(out, name, scene_m, points[name], generator.geometry)
                    drawn.append(scene_m)
            progress.update(len(indices))
    write_npz(out / "scenes.npz", points)
    if drawn:
        sheet = viz.scenes_sheet(drawn[:_ON_SHEET], generator.geometry.projection)
        viz.save(sheet, out / "scenes.png")
    metadata = {
        "checkpoint": str(ckpt),
        "stage": checkpoint.stage,
        "step": checkpoint.step,
        "feature_source": checkpoint.feature_source,
        "weights": weights,
        "num": num,
        "seed": seed,
        "sampler": asdict(sampler),
        "interpolant": checkpoint.interpolant,
        "nfe": nfe,
        "precision": precision,
        "device": device,
        "batch_size": batch_size,
        "seconds_per_scene": seconds / num,
        "geometry": generator.geometry.to_dict(),
        "r3dpa": r3dpa.__version__,
        "commit": source_commit(),
        "torch": torch.__version__,
    }
    with atomic_path(out / "metadata.json") as temporary:
        temporary.write_text(json.dumps(metadata, indent=2) + "\n")
    return metadata


def _draw_scene(
    out: Path, name: str, range_m: Tensor, points: Tensor, geometry: ScanGeometry
) -> None:
    sensor = geometry.projection.sensor
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
