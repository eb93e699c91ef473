"""``r3dpa probe``: what sources of 3D features know of the classes of simulated scans."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from r3dpa.data import PointDataset, Scan, kitti360_scans
from r3dpa.data.scans import evenly
from r3dpa.geometry import LidarSensor
from r3dpa.io import atomic_path, command, machine, one_line, usable_device, versions
from r3dpa.metrics import SourceProbe, known, probe_source
from r3dpa.metrics.probe import Labelled
from r3dpa.nn.backbones import WaffleIronS, feature_source
from r3dpa.simulation import Semantic

#: Classes to tell apart: all but points in the air (fog, rain, snow, spray, blooming, sun), which
#: have no label, and the ego vehicle.
CLASSES = {
    int(label): label.name.lower()
    for label in Semantic
    if label not in (Semantic.UNLABELED, Semantic.EGO_VEHICLE)
}


def probe(
    data: Path,
    sources: Sequence[str],
    ckpt: Path | None = None,
    train_scans: int = 40,
    val_scans: int = 20,
    device: str = "auto",
    out: Path | None = None,
) -> str:
    """Linear probe, cell statistics and time of sources of features on a simulated data set.

    Args:
        data: Root of a data set of ``r3dpa simulate``, in which every scan has labels.
        sources: Names as of :func:`r3dpa.nn.backbones.feature_source`, or ``random``:
            the network of ``waffleiron-s`` before any training.
        ckpt: Checkpoint of ``scalr``, or of ``waffleiron-s`` where that is not among the sources.
        train_scans: Scans of the training drives that the probe is fitted on, evenly spread.
        val_scans: Scans of the validation drives that it is tested on, likewise.
        device: Where the features are computed; ``auto`` for the GPU where there is one.
        out: JSON file for the same figures and the confusion matrices.

    Returns:
        A table with a column for each source, and what was measured where.

    Raises:
        ValueError: If a source is unknown or named twice, a number of scans is below 1 or there
            is no scan, or a scan has no labels; the message names what is wrong.
    """
    if not sources or len(set(sources)) < len(sources):
        raise ValueError(f"sources must be different names, at least one, got {','.join(sources)}")
    device = usable_device(device)
    train = _some(kitti360_scans(data, "train"), train_scans, "train_scans", data)
    test = _some(kitti360_scans(data, "val"), val_scans, "val_scans", data)
    extractors = {name: source.to(device) for name, source in _extractors(sources, ckpt).items()}
    total = len(sources) * (len(train) + len(test))
    with tqdm(total=total, unit="scan", desc="probe", disable=None) as progress:
        probes = {
            name: probe_source(
                extractor, _labelled(train, progress), _labelled(test, progress), tuple(CLASSES)
            )
            for name, extractor in extractors.items()
        }
    threads = os.environ.get("OMP_NUM_THREADS", "not set")
    about: dict[str, str | dict[str, Any]] = {
        "data": f"{data}: {len(train)} scans to fit, {len(test)} to test",
        "command": command(),
        "machine": machine() | {"OMP_NUM_THREADS": threads, "device": _device_name(device)},
        "versions": versions(np, torch),
    }
    if out is not None:
        content = {
            **about,
            "classes": {name: label for label, name in CLASSES.items()},
            "sources": {
                name: {"settings": extractors[name].settings, **_figures(result)}
                for name, result in probes.items()
            },
        }
        with atomic_path(out) as temporary:
            temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    lines = [_table(probes), "", *(f"{name}: {one_line(text)}" for name, text in about.items())]
    return "\n".join(lines)


def _extractors(names: Sequence[str], ckpt: Path | None) -> dict[str, Any]:
    """Sources by name; the checkpoint goes to the first that can take one."""
    reader = next((name for name in ("scalr", "waffleiron-s") if name in names), None)
    if ckpt is not None and reader is None:
        raise ValueError(f"no source of {', '.join(names)} reads a ckpt: leave {ckpt} out")
    found: dict[str, Any] = {}
    for name in names:
        if name == "random":
            found[name] = WaffleIronS.untrained(seed=0)
        else:
            found[name] = feature_source(name, ckpt if name == reader else None)
    return found


def _some(scans: list[Scan], count: int, option: str, data: Path) -> list[Scan]:
    """Up to ``count`` scans, evenly spread over those there are."""
    if count < 1:
        raise ValueError(f"{option} must be 1 or greater, got {count}")
    if not scans:
        raise ValueError(f"{data} has no scan for {option}: simulate drives of both splits")
    return evenly(scans, count)


def _labelled(scans: Sequence[Scan], progress: tqdm) -> Iterator[Labelled]:
    """Points and labels of scans."""
    dataset = PointDataset(scans, LidarSensor(), _labels_of, needs_labels=True)
    for index in range(len(dataset)):
        sample = dataset[index]
        yield sample.points, sample.prepared
        progress.update()


def _labels_of(points: Tensor, labels: Tensor) -> Tensor:
    return labels


def _device_name(device: str) -> str:
    return torch.cuda.get_device_name(device) if device.startswith("cuda") else device


def _figures(probe: SourceProbe) -> dict[str, Any]:
    """The figures of a source as JSON values, None where unknown."""
    scores = probe.scores
    return {
        "mean_iou": known(scores.mean_iou),
        "accuracy": known(scores.accuracy),
        "iou": {CLASSES[label]: known(value) for label, value in scores.iou.items()},
        "empty_share": probe.empty_share,
        "neighbour_cosine": known(probe.neighbour_cosine),
        "ms_per_scan": probe.ms_per_scan,
        "train_points": probe.train_points,
        "confusion": scores.confusion.tolist(),
    }


def _table(probes: dict[str, SourceProbe]) -> str:
    """A column for each source; classes from the most to the least frequent in the test."""
    rows: list[tuple[str, list[str]]] = [
        ("mean IoU (%)", [_percent(p.scores.mean_iou) for p in probes.values()]),
        ("accuracy (%)", [_percent(p.scores.accuracy) for p in probes.values()]),
    ]
    shares = next(iter(probes.values())).scores.shares
    for label, share in sorted(shares.items(), key=lambda entry: -entry[1]):
        if share > 0:
            name = f"IoU {CLASSES[label]}, {100 * share:.2g} % of the points"
            rows.append((name, [_percent(p.scores.iou[label]) for p in probes.values()]))
    rows += [
        ("empty cells (%)", [_percent(p.empty_share) for p in probes.values()]),
        (
            "cosine between neighbouring cells",
            [f"{p.neighbour_cosine:.3f}" for p in probes.values()],
        ),
        ("time per scan (ms)", [f"{p.ms_per_scan:.0f}" for p in probes.values()]),
    ]
    missing = [CLASSES[label] for label, share in shares.items() if share == 0]
    widths = [max(8, len(name)) for name in probes]
    first = max(len(name) for name, _ in rows)
    cells = [("", list(probes)), *rows]
    lines = [
        "  ".join([name.ljust(first), *(v.rjust(w) for v, w in zip(values, widths, strict=True))])
        for name, values in cells
    ]
    lines += ["", "Linear probe of single points; cells are those of an 8 x 64 grid. Left out:"]
    lines.append("points without a label (in the air) and of the ego vehicle.")
    if missing:
        lines.append(f"Not in the mean, as the test has no point of them: {', '.join(missing)}.")
    return "\n".join(lines)


def _percent(share: float) -> str:
    return "-" if math.isnan(share) else f"{100 * share:.1f}"
