"""``r3dpa reference`` and ``r3dpa evaluate``: how near anybody's samples are to real scans."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch
from jsonargparse import Namespace
from lightning.pytorch.cli import LightningArgumentParser
from tqdm import tqdm

from r3dpa.data.datamodules import KITTI360DataModule, LidarDataModule
from r3dpa.data.samples import SampleError, Samples, read_samples
from r3dpa.data.scans import Scan, evenly, read_scan
from r3dpa.geometry import LidarSensor
from r3dpa.io import source_commit
from r3dpa.metrics.evaluation import feature_spaces
from r3dpa.metrics.official_statistics import (
    OfficialSplit,
    compare,
    load_reference,
    reference_spaces,
)
from r3dpa.metrics.protocol import PROTOCOLS
from r3dpa.metrics.reference import ReferenceStatistics, complete_reference
from r3dpa.metrics.result_table import report, save_reports
from r3dpa.metrics.scene import EvaluationScene
from r3dpa.metrics.scene_features import FREE_SPACES
from r3dpa.viz.evaluation import save_figures

__all__ = ["evaluate", "reference"]

SplitName = Literal["train", "val", "all"]
_OPTION = "--{}"  # how `r3dpa evaluate` is told to allow something


def reference(
    data: Path,
    out: Path,
    spaces: Sequence[str] = FREE_SPACES,
    ckpt: Mapping[str, Path] | None = None,
    split: SplitName = "all",
    limit: int | None = None,
    protocol: str = "default",
    device: str = "auto",
    every: int = 2000,
) -> str:
    """Statistics of real scans for ``r3dpa evaluate``; see ``r3dpa reference --help``.

    Args:
        data: Folder of scans or data YAML.
        out: File to write; beside it lies ``<name>.partial.safetensors`` until it is complete, from
            which the same call goes on.
        spaces: Feature spaces.
        ckpt: Their weights by name.
        split: Which scans of the data.
        limit: Use this many at most, spread evenly.
        protocol: ``default`` or ``published``.
        device: Where the networks compute.
        every: Scans after which the unfinished file is saved; it also is on an interrupt.

    Returns:
        What was written, in a line.

    Raises:
        ValueError: If an argument is not as above, ``out`` exists, there are fewer than two scans,
            or one cannot be used; the message names it.
    """
    if out.exists():
        raise ValueError(f"{out} exists: delete it, or give another --out")
    scans, sensor = _scans(data, split, limit)
    setting = PROTOCOLS[protocol].with_sensor(sensor)
    found = feature_spaces(spaces, ckpt, setting, device)
    about = {"data": str(data), "split": split, "limit": limit, "commit": source_commit()}
    names = [scan.name for scan in scans]
    job = ReferenceStatistics.prepare(found, setting, names, about)

    def scans_from(start: int) -> Iterator[EvaluationScene]:
        for scan in scans[start:]:
            yield EvaluationScene(scan.name, torch.from_numpy(read_scan(scan.path, sensor)))

    statistics = complete_reference(job, scans_from, found, out, every)
    return f"{out}: {statistics.describe()}; {', '.join(statistics.spaces)}; protocol {protocol}"


def evaluate(
    samples: Path,
    reference: Path,
    spaces: Sequence[str] | None = None,
    ckpt: Mapping[str, Path] | None = None,
    protocol: str | None = None,
    skip_bad: bool = False,
    allow_few: bool = False,
    label: str | None = None,
    device: str = "auto",
    out: Path | None = None,
    split: OfficialSplit | None = None,
) -> str:
    """Compares samples in files with real scans; see ``r3dpa evaluate --help``.

    Args:
        samples: File or folder, see :func:`r3dpa.data.samples.read_samples`.
        reference: File of ``r3dpa reference``, or the official statistics file.
        spaces: Feature spaces; where None, those of the reference that need no file or that
            ``ckpt`` has one for.
        ckpt: Their weights by name.
        protocol: Must be that of the reference; not compared where None.
        skip_bad: Leave out samples that cannot be used, and list them.
        allow_few: Accept fewer samples than features.
        label: Of the generator; the name of ``samples`` where None.
        device: Where the networks compute.
        out: Folder for tables and figures; without figures for the official file.
        split: Part of the official file, see :meth:`OfficialStatistics.load`.

    Returns:
        The numbers, and a table with the published ones.

    Raises:
        ValueError: If an argument is not as above, or samples or reference cannot be used.
    """
    made_with = _made_with(samples)
    statistics = load_reference(reference, split)
    found = reference_spaces(statistics, spaces, ckpt, protocol, device)
    setting = statistics.protocol
    files = read_samples(
        samples, setting.sensor, unprojection=setting.unprojection, skip_bad=skip_bad
    )
    evaluation, comparison = compare(
        tqdm(_scenes(files), "samples", disable=None),
        statistics,
        found,
        label=label or samples.stem,
        source=str(samples),
        made_with=made_with,
        commit=source_commit(),
        allow_few=allow_few,
        skip_bad=skip_bad,
        option=_OPTION,
    )
    if files.bad:  # what the reader refuses never becomes a scene
        bad = {"bad_samples": [*files.bad, *evaluation.bad_samples]}
        about: Any = {**evaluation.about, "extra": {**evaluation.about["extra"], **bad}}
        evaluation = replace(evaluation, about=about)
    if out is not None:
        save_reports(evaluation, statistics.about.get("split"), out)
        if comparison is not None:
            save_figures(out, **comparison.figure_data())
    return report(evaluation, statistics.about.get("split"))


def _scenes(samples: Samples) -> Iterator[EvaluationScene]:
    """Samples as scenes; the message of a bad one says how to go on without."""
    try:
        yield from (EvaluationScene(*sample) for sample in samples)
    except SampleError as error:
        if samples.skip_bad or error.__cause__ is None:  # that of one sample has a cause
            raise
        advice = f"{_OPTION.format('skip_bad')} leaves such samples out, and lists them"
        raise SampleError(f"{error}. {advice}") from error


def _scans(data: Path, split: SplitName, limit: int | None) -> tuple[list[Scan], LidarSensor]:
    """Scans of a split of a folder or data YAML, and its sensor."""
    module: LidarDataModule
    if data.is_dir():
        in_layout = (data / "data_3d_raw").is_dir()
        module = KITTI360DataModule(str(data)) if in_layout else LidarDataModule(str(data))
    elif data.suffix in (".yaml", ".yml"):
        parser = LightningArgumentParser()
        parser.add_argument("--config", action="config")
        parser.add_lightning_class_args(LidarDataModule, "data", subclass_mode=True)
        config: Namespace = parser.parse_args(["--config", str(data)])
        settings = config.data.init_args
        settings.extractor = settings.features_dir = None  # the scans are all it is here for
        module = parser.instantiate_classes(config).data
        module.prepare_data()  # simulates the scans, where it does
    else:
        raise ValueError(f"--data {data}: is no folder of scans and no data YAML")
    if limit is not None and limit < 2:
        raise ValueError(f"limit must be at least 2, got {limit}")
    train, val = module.limited_split()
    scans = {"train": train, "val": val, "all": sorted(train + val)}[split]
    if len(scans) < 2:
        raise ValueError(f"{data}: the split {split} has {len(scans)} scans; at least 2 are needed")
    return evenly(scans, limit), module.sensor


def _made_with(samples: Path) -> dict[str, Any]:
    """What ``r3dpa sample`` wrote of its samples; nothing for those of others."""
    folders = (samples, samples.parent) if samples.is_dir() else (samples.parent,)
    path = next((f / "metadata.json" for f in folders if (f / "metadata.json").is_file()), None)
    if path is None:
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: is damaged ({error}); repair or remove it") from error
    if not isinstance(found, dict) or "r3dpa" not in found:
        return {}
    sampler = found.get("sampler") or {}
    kept = ("seed", "precision", "feature_source", "checkpoint", "stage", "step", "weights", "nfe")
    return {
        "solver": sampler.get("solver"),
        "steps": sampler.get("steps"),
        **{key: found.get(key) for key in kept},
        "sampler": sampler,
        "made_by_commit": found.get("commit"),
    }
