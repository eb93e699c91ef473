"""The edits of ``r3dpa inpaint`` and its like: options checked, inputs read, networks run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r3dpa.checkpoints import read_checkpoint
from r3dpa.cli.edit_desk import EditDesk, Guidance, Parts, without_features
from r3dpa.cli.edits import EditJob
from r3dpa.data.images import read_mask
from r3dpa.data.objects import ObjectLibrary
from r3dpa.editing import EditResult
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import LidarSensor, SphericalProjection
from r3dpa.geometry.gaps import filled, range_error_m
from r3dpa.geometry.regions import (
    angle_box,
    box3d,
    check_mask,
    dropped_beams,
    mask_of_tokens,
    sector,
    sector_weights,
    sensor_pair,
)

__all__ = ["complete", "inpaint", "interpolate", "library_settings", "mix", "vary"]


def inpaint(
    job: EditJob,
    path: Path,
    region: tuple[Sequence[float] | None, Sequence[float] | None, Path | None],
    source: tuple[Path | None, str | None, Path | None, str | None, Sequence[float] | None],
    features_ckpt: Path | None,
    guidance: Guidance,
    start: float,
    dilation: int,
    num: int,
) -> str:
    """See ``r3dpa inpaint --help``; returns what was made, and where.

    Args:
        job: What all edits are asked.
        path: The scan.
        region: Box of angles, box in space, picture: one of them.
        source: Library and its class, or scan and a class or box of it; may be none.
        features_ckpt: Weights of the feature source.
        guidance: Strength and window, where given.
        start: First time.
        dilation: Rings of tokens.
        num: Number of results.

    Raises:
        ValueError: If the inputs do not fit each other or the checkpoint; tells which.
        OSError: If a file cannot be read or written.
    """
    library, name, features_from, label, features_box = source
    guided = library is not None or features_from is not None
    if sum(given is not None for given in region) != 1:
        raise ValueError("give one of --box, --box3d and --mask: the part that is to change")
    if (library is None) != (name is None):
        raise ValueError("--objects FILE and --object NAME go together; `r3dpa objects` writes one")
    if library is not None and features_from is not None:
        raise ValueError("give --object or --features_from, not both")
    if (features_from is None) != (label is None and features_box is None) or (
        label is not None and features_box is not None
    ):
        raise ValueError("--features_from needs one of --label and --features_box3d")
    if not guided and guidance != (None, None):
        raise ValueError("--strength and --window say nothing without --object or --features_from")
    desk = EditDesk(job, num, guidance)
    scan = desk.read(path)
    box, solid, picture = region
    if picture is not None:
        mask = check_mask(read_mask(picture, desk.sensor), str(picture))
    elif box is not None:
        mask = angle_box(desk.projection, *box)
    else:
        assert solid is not None
        mask = box3d(desk.projection, solid[:3], solid[3:6], solid[6])
    feature = None
    if library is not None and name is not None:
        objects = ObjectLibrary.load(library)
        objects.check_source(desk.feature_name, desk.feature_dim)
        feature = objects.feature(name)
    elif features_from is not None:
        feature = desk.object_feature(features_from, label, features_box, features_ckpt)
    asked = {
        "scans": {"scan": str(path)},
        **{"box": box, "box3d": solid, "mask": picture and str(picture)},
        **{"objects": library and str(library), "object": name, "label": label},
        **{"features_from": features_from and str(features_from), "features_box3d": features_box},
        **{"start": start, "dilation": dilation, "guided": guided},
    }

    def run() -> EditResult:
        return desk.editor.inpaint(
            scan.range_m,
            mask,
            range(num),
            job.seed,
            feature=feature,
            start=start,
            dilation=dilation,
        )

    parts = Parts(mask.numpy().astype(np.uint8), ("kept", name or label or "generated anew"))
    return desk.write("inpaint", asked, {f"scan {path.stem}": scan.range_m}, run, parts)


def mix(
    job: EditJob,
    scans: tuple[Path | None, Path | None, Sequence[tuple[float, Path]] | None, Path | None],
    split: float,
    blend: float,
    features_ckpt: Path | None,
    guidance: Guidance,
    num: int,
) -> str:
    """See ``r3dpa mix --help``; returns what was made, and where.

    Args:
        job: What all edits are asked.
        scans: Left and right, or a layout; and a picture that parts left from right.
        split: Where the left half starts, degrees.
        blend: Width of the seams, degrees.
        features_ckpt: Weights of the feature source.
        guidance: Strength and window.
        num: Number of results.

    Raises:
        ValueError: If the inputs do not fit each other or the checkpoint; tells which.
        OSError: If a file cannot be read or written.
    """
    left, right, layout, picture = scans
    if (left is None) != (right is None) or (left is None) == (layout is None):
        raise ValueError("give --left and --right, or a --layout of sectors and scans")
    if picture is not None and layout is not None:
        raise ValueError("--mask parts --left from --right; drop it or --layout")
    if left is not None and right is not None:
        layout = [(split, left), (split + 180, right)]
    assert layout is not None
    paths = list(dict.fromkeys(path for _, path in layout))
    if len(paths) < 2:
        raise ValueError(f"there is nothing to mix: give two scans or more, got {layout}")
    desk = EditDesk(job, num, guidance)
    grid_size = desk.grid_size
    if picture is not None:
        share = check_mask(read_mask(picture, desk.sensor), str(picture)).float()
        rows, columns = desk.sensor.cell_size(grid_size)
        cells = torch.nn.functional.avg_pool2d(share[None, None], (rows, columns)).flatten()
        weights = torch.stack([1 - cells, cells])
    else:
        sectors = [(azimuth, paths.index(path)) for azimuth, path in layout]
        weights = sector_weights(sectors, grid_size, blend)
    read = [desk.read(path) for path in paths]
    extractor = desk.extractor(features_ckpt)
    grids = [desk.grid(scan, extractor) for scan in read]
    size = (desk.sensor.beams, desk.sensor.columns)
    numbers = mask_of_tokens(weights.argmax(dim=0), grid_size, size)
    names = [f"{number}: {path.stem}" for number, path in enumerate(paths)]
    asked = {
        "scans": dict(zip(names, map(str, paths), strict=True)),
        "layout": [[azimuth, str(path)] for azimuth, path in layout],
        **{"blend": blend, "mask": picture and str(picture), "guided": True},
    }

    def run() -> EditResult:
        return desk.editor.mix(grids, weights, range(num), job.seed)

    before = {name: scan.range_m for name, scan in zip(names, read, strict=True)}
    return desk.write("mix", asked, before, run, Parts(numbers.numpy().astype(np.uint8), names))


def complete(
    job: EditJob,
    path: Path,
    gaps: tuple[
        Sequence[float] | None,
        int | None,
        Sequence[int] | None,
        bool,
        tuple[int, float, float] | None,
        Path | None,
    ],
    start: float,
    num: int,
) -> str:
    """See ``r3dpa complete --help``; returns what was made, and where.

    Args:
        job: What all edits are asked.
        path: The scan.
        gaps: Sector, every how many beams are kept, those that are, whether empty ones are
            missing, another sensor (beams, lowest and highest inclination in degrees), picture.
        start: First time.
        num: Number of results.

    Raises:
        ValueError: If the inputs do not fit each other or the checkpoint; tells which.
        OSError: If a file cannot be read or written.
    """
    azimuths, keep_every, beams, empty_beams, other, picture = gaps
    desk = EditDesk(job, num, (None, None))
    masks = []
    if azimuths is not None:
        masks.append(sector(desk.projection, *azimuths))
    if keep_every is not None:
        if not 2 <= keep_every <= desk.sensor.beams // 2:
            raise ValueError(
                f"--keep_every must be 2 to {desk.sensor.beams // 2}, so that two or more of the "
                f"{desk.sensor.beams} beams remain; got {keep_every}"
            )
        masks.append(dropped_beams(desk.projection, range(0, desk.sensor.beams, keep_every)))
    if beams is not None:
        masks.append(dropped_beams(desk.projection, beams))
    if other is not None:
        count, low, high = other
        sensor = replace(
            desk.sensor, beams=count, inclination_min_deg=low, inclination_max_deg=high
        )
        masks.append(sensor_pair(desk.projection, SphericalProjection(sensor)))
    if picture is not None:
        masks.append(check_mask(read_mask(picture, desk.sensor), str(picture)))
    scan = desk.read(path, masks, empty_beams)
    if empty_beams:
        empty = ~(scan.range_m > 0).any(dim=1, keepdim=True)
        masks.append(empty.expand_as(scan.range_m))
    if not masks:
        raise ValueError(
            "nothing is missing: give --sector, --keep_every, --beams, --empty_beams, "
            "--other_sensor or --mask"
        )
    missing = check_mask(torch.stack(masks).any(dim=0), "all that is missing")
    asked = {
        "scans": {"scan": str(path)},
        **{"sector": azimuths, "keep_every": keep_every, "beams": beams},
        **{"empty_beams": empty_beams, "other_sensor": other},
        **{"mask": picture and str(picture), "start": start},
        "guided": False,
    }

    def run() -> EditResult:
        return desk.editor.complete(scan.range_m, missing, range(num), job.seed, start=start)

    known = torch.where(missing, -1.0, scan.range_m)
    shown = {f"scan {path.stem}": scan.range_m, "what is known": known}
    parts = Parts(missing.numpy().astype(np.uint8), ("kept", "missing"))
    return desk.write("complete", asked, shown, run, parts, _held_out(scan.range_m, missing))


def vary(job: EditJob, path: Path, start: float, num: int) -> str:
    """See ``r3dpa vary --help``; returns what was made, and where.

    Args:
        job: What all edits are asked.
        path: The scan.
        start: Time of the noise.
        num: Number of results.

    Raises:
        ValueError: If the inputs do not fit each other or the checkpoint; tells which.
        OSError: If a file cannot be read or written.
    """
    desk = EditDesk(job, num, (None, None))
    desk.settings.times(start)
    scan = desk.read(path)
    asked = {"scans": {"scan": str(path)}, "start": start, "guided": False}

    def run() -> EditResult:
        return desk.editor.vary(scan.range_m, range(num), job.seed, start=start)

    return desk.write("vary", asked, {f"scan {path.stem}": scan.range_m}, run)


def interpolate(job: EditJob, first: Path, second: Path, frames: int) -> str:
    """See ``r3dpa interpolate --help``; returns what was made, and where.

    Args:
        job: What all edits are asked.
        first: Scan of the first frame.
        second: Scan of the last one.
        frames: Number of scenes.

    Raises:
        ValueError: If the inputs do not fit each other or the checkpoint; tells which.
        OSError: If a file cannot be read or written.
    """
    if frames < 2:
        raise ValueError(f"frames must be at least 2, the two scans; got {frames}")
    desk = EditDesk(job, frames, (None, None))
    scans = [desk.read(path) for path in (first, second)]
    names = [f"first: {first.stem}", f"second: {second.stem}"]
    asked = {
        "scans": dict(zip(names, (str(first), str(second)), strict=True)),
        "guided": False,
    }

    def run() -> EditResult:
        return desk.editor.interpolate(scans[0].range_m, scans[1].range_m, frames)

    before = {name: scan.range_m for name, scan in zip(names, scans, strict=True)}
    return desk.write("interpolate", asked, before, run)


def library_settings(ckpt: Path) -> tuple[str, int, LidarSensor, tuple[int, int]]:
    """Feature source, width, sensor and grid size that objects for a checkpoint need.

    Raises:
        ValueError: If it cannot be sampled from, or was trained without features.
    """
    checkpoint = read_checkpoint(ckpt)
    generator = SceneGenerator.from_checkpoint(checkpoint, SamplerConfig(), device="cpu")
    if checkpoint.feature_source is None:
        raise ValueError(without_features(ckpt))
    sit, sensor = generator.sit, generator.geometry.projection.sensor
    return checkpoint.feature_source, sit.feature_dim, sensor, sit.grid_size


def _held_out(range_m: Tensor, missing: Tensor) -> Callable[[Tensor], dict[str, Any]]:
    """Errors of completions where the scan itself has returns, beside those of interpolation.

    Ranges are compared where scan and all methods have a return.
    """

    def measure(made: Tensor) -> dict[str, Any]:
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
        return {
            "held_out": {
                name: {
                    "mae_m": range_error_m(images, range_m.expand_as(images), common),
                    "same_returns": float(
                        ((images > 0) == (range_m > 0))[:, missing].double().mean()
                    ),
                }
                for name, images in methods.items()
            }
        }

    return measure
