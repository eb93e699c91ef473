"""``r3dpa reference`` and ``r3dpa evaluate``: how near anybody's samples are to real scans."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from jsonargparse import Namespace
from lightning.pytorch.cli import LightningArgumentParser
from tqdm import tqdm

from r3dpa.checkpoints import refuse_leak, source_commit
from r3dpa.data.datamodules import KITTI360DataModule, LidarDataModule
from r3dpa.data.samples import read_samples
from r3dpa.data.scans import Scan, evenly
from r3dpa.geometry import LidarSensor
from r3dpa.metrics.distances import Resampling
from r3dpa.metrics.evaluation import Comparison
from r3dpa.metrics.evaluation import evaluate as compare
from r3dpa.metrics.official_statistics import (
    OfficialSplit,
    OfficialStatistics,
    evaluate_official,
    is_official,
)
from r3dpa.metrics.protocol import PROTOCOLS
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.scene import EvaluationScene
from r3dpa.metrics.scene_features import FREE_SPACES, SceneFeatures
from r3dpa.scoring import (
    AnyReference,
    complete_reference,
    feature_spaces,
    report,
    save_reports,
    save_tables,
)

__all__ = ["evaluate", "evaluate_scenes", "reference"]

SplitName = Literal["train", "val", "all"]
_SHOWN_BAD = 20  # messages of unusable samples that are kept


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
        every: Scans after which the unfinished file is saved.

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
    statistics = complete_reference(job, scans, found, out, every)
    return f"{out}: {statistics.describe()}; {', '.join(statistics.spaces)}; protocol {protocol}"


def evaluate(
    samples: Path,
    reference: Path,
    spaces: Sequence[str] | None = None,
    ckpt: Mapping[str, Path] | None = None,
    protocol: str | None = None,
    skip_bad: bool = False,
    allow_few: bool = False,
    allow_oracle: bool = False,
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
        skip_bad: Leave out samples that cannot be used, and say so.
        allow_few: Accept fewer samples than features.
        allow_oracle: Accept samples of a model that learned from labels.
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
    refuse_leak(made_with.get("feature_source"), str(samples), allow=allow_oracle)
    statistics = _load(reference, split)
    setting = statistics.protocol
    files = read_samples(
        samples, setting.sensor, unprojection=setting.unprojection, skip_bad=skip_bad
    )
    progress = tqdm((EvaluationScene(*scene) for scene in files), "samples", disable=None)
    found = _chosen_spaces(statistics, spaces, ckpt, protocol, device)
    options: dict[str, Any] = {
        "label": label or samples.stem,
        "source": str(samples),
        "made_with": made_with,
        "commit": source_commit(),
        "allow_few": allow_few,
    }
    comparison = None
    if isinstance(statistics, OfficialStatistics):
        evaluation = evaluate_official(progress, statistics, found, **options)
    else:
        comparison = compare(progress, statistics, found, **options)
        evaluation = comparison.evaluation
    if files.bad:
        bad = {"count": len(files.bad), "first": files.bad[:_SHOWN_BAD]}
        extra = {**evaluation.about["extra"], "bad_samples": bad}
        evaluation = replace(evaluation, about={**evaluation.about, "extra": extra})
    if out is not None:
        if comparison is None:
            save_tables(evaluation, statistics, out)
        else:
            assert isinstance(statistics, ReferenceStatistics)
            save_reports(comparison._replace(evaluation=evaluation), statistics, out)
    return report(evaluation, statistics)


def _load(path: Path, split: OfficialSplit | None) -> AnyReference:
    """Reference of either kind."""
    if is_official(path):
        return OfficialStatistics.load(path, split)
    if split is not None:
        raise ValueError(
            f"{path}: is no official statistics file, so --split {split} does not apply to it; "
            "leave it out"
        )
    return ReferenceStatistics.load(path)


def evaluate_scenes(
    scenes: Iterable[EvaluationScene],
    statistics: ReferenceStatistics,
    *,
    label: str,
    source: str = "",
    spaces: Sequence[str] | None = None,
    ckpt: Mapping[str, Path] | None = None,
    protocol: str | None = None,
    made_with: Mapping[str, Any] | None = None,
    allow_few: bool = False,
    device: str = "auto",
    resampling: Resampling | None = None,
) -> Comparison:
    """Compares scenes with real ones; a generated one is ``EvaluationScene(name, None, range_m)``.

    Args:
        scenes: Read once, in batches.
        statistics: Reference to compare with.
        label: Of the generator.
        source: Where the scenes come from.
        spaces: As for :func:`evaluate`.
        ckpt: As for :func:`evaluate`.
        protocol: As for :func:`evaluate`.
        made_with: See :func:`r3dpa.metrics.evaluation.evaluate`.
        allow_few: Accept fewer scenes than features.
        device: Where the networks compute.
        resampling: Seed, and cost of the intervals.

    Raises:
        ValueError: If the reference is of another protocol or lacks a space, or as
            :func:`r3dpa.metrics.evaluation.evaluate`.
    """
    found = _chosen_spaces(statistics, spaces, ckpt, protocol, device)
    return compare(
        scenes,
        statistics,
        found,
        label=label,
        source=source,
        made_with=made_with,
        commit=source_commit(),
        allow_few=allow_few,
        resampling=resampling or Resampling(),
    )


def _chosen_spaces(
    statistics: AnyReference,
    spaces: Sequence[str] | None,
    ckpt: Mapping[str, Path] | None,
    protocol: str | None,
    device: str,
) -> list[SceneFeatures]:
    """Feature spaces of a comparison; the arguments are those of :func:`evaluate`."""
    setting = statistics.protocol
    if protocol is not None and protocol != setting.name:
        raise ValueError(
            f"the reference is of the protocol {setting.name}, not {protocol}: compute another one "
            f"with `r3dpa reference --protocol {protocol}`"
        )
    if spaces is None:
        spaces = [name for name in statistics.spaces if name in (*FREE_SPACES, *(ckpt or {}))]
    return feature_spaces(spaces, ckpt, setting, device)


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
