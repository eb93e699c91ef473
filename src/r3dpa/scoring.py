"""Generated scenes beside real scans: the reference of a set of scans, and what is reported."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from glob import escape
from pathlib import Path
from typing import Any, Literal

import torch
from tqdm import tqdm

from r3dpa import viz
from r3dpa.data.scans import Scan, read_scan
from r3dpa.io import only_writer, usable_device
from r3dpa.metrics.evaluation import Comparison, evaluate
from r3dpa.metrics.official_statistics import (
    OfficialSplit,
    OfficialStatistics,
    evaluate_official,
    is_official,
)
from r3dpa.metrics.protocol import Protocol
from r3dpa.metrics.reference import ReferenceStatistics, check_spaces, resume_or_start
from r3dpa.metrics.result_table import EvaluationTable
from r3dpa.metrics.results import Evaluation, published_evaluations
from r3dpa.metrics.scene import EvaluationScene
from r3dpa.metrics.scene_features import FREE_SPACES, SPACES, SceneFeatures, scene_features
from r3dpa.metrics.scene_set import RANGE_BIN_M
from r3dpa.viz import evaluation as figures

__all__ = [
    "AnyReference",
    "cached_reference",
    "compare",
    "complete_reference",
    "feature_spaces",
    "load_reference",
    "reference_spaces",
    "report",
    "save_reports",
]

_log = logging.getLogger(__name__)

AnyReference = ReferenceStatistics | OfficialStatistics

_EVERY = 2000  # scans between two savings of an unfinished reference
_SHOWN_MATCHES = 3


def feature_spaces(
    names: Sequence[str],
    ckpt: Mapping[str, str | Path] | None,
    protocol: Protocol,
    device: str,
) -> list[SceneFeatures]:
    """Feature spaces by name.

    Args:
        names: Of :data:`r3dpa.metrics.scene_features.SPACES`.
        ckpt: Weight files by name.
        protocol: How scenes are prepared.
        device: Where the networks compute; ``auto`` is the GPU where there is one.

    Raises:
        ValueError: If a name occurs twice, a file belongs to none of them, or as
            :func:`scene_features`.
    """
    if len(set(names)) < len(names):
        raise ValueError(f"spaces must be different names, got {', '.join(names)}")
    unused = [name for name in ckpt or {} if name not in names]
    if unused:
        raise ValueError(
            f"--ckpt.{unused[0]}: {unused[0]} is not among the spaces ({', '.join(names)}); add it "
            f"to them, or leave its file out (`r3dpa test`: --scorer.ckpt.{unused[0]})"
        )
    device = usable_device(device)
    return [scene_features(name, (ckpt or {}).get(name), protocol, device) for name in names]


def load_reference(path: Path, split: OfficialSplit | None = None) -> AnyReference:
    """Reference of either kind, ready to compare with.

    Args:
        path: File of ``r3dpa reference``, or the official statistics file.
        split: Part of the official file, see :meth:`OfficialStatistics.load`.

    Raises:
        ValueError: If the file is missing, damaged, of something else or not complete, or a split
            is asked of a file that has none.
    """
    if is_official(path):
        return OfficialStatistics.load(path, split)
    if split is not None:
        raise ValueError(
            f"{path}: is no official statistics file, so the split {split} does not apply to it; "
            "leave it out"
        )
    statistics = ReferenceStatistics.load(path)
    statistics.check_complete()
    return statistics


def reference_spaces(
    statistics: AnyReference,
    names: Sequence[str] | None,
    ckpt: Mapping[str, str | Path] | None,
    protocol: str | None,
    device: str,
) -> list[SceneFeatures]:
    """Feature spaces of a comparison with a reference.

    Args:
        statistics: The reference.
        names: Feature spaces; where None, those of the reference that need no file or that
            ``ckpt`` has one for.
        ckpt: Weight files by name.
        protocol: Must be that of the reference; not compared where None.
        device: As for :func:`feature_spaces`.

    Raises:
        ValueError: If the reference is of another protocol or lacks a space, or as
            :func:`feature_spaces`.
    """
    setting = statistics.protocol
    if protocol is not None and protocol != setting.name:
        raise ValueError(
            f"the reference is of the protocol {setting.name}, not {protocol}: compute another one "
            f"with `r3dpa reference --protocol {protocol}`, or ask for no protocol"
        )
    if names is None:
        names = [name for name in statistics.spaces if name in (*FREE_SPACES, *(ckpt or {}))]
    spaces = feature_spaces(names, ckpt, setting, device)
    if isinstance(statistics, OfficialStatistics):
        for space in spaces:
            statistics.of_space(space)
    else:
        check_spaces(statistics.spaces, spaces)
    return spaces


def compare(
    scenes: Iterable[EvaluationScene],
    statistics: AnyReference,
    spaces: Sequence[SceneFeatures],
    **options: Any,
) -> tuple[Evaluation, Comparison | None]:
    """Generated scenes beside a reference of either kind.

    Args:
        scenes: Read once; a generated one is ``EvaluationScene(name, None, range_m)``.
        statistics: Reference.
        spaces: Of :func:`reference_spaces`.
        options: Those that :func:`r3dpa.metrics.evaluation.evaluate` and ``evaluate_official``
            share.

    Returns:
        All numbers, and what figures are drawn from; None for the official file, which holds no
        scans.
    """
    if isinstance(statistics, OfficialStatistics):
        return evaluate_official(scenes, statistics, spaces, **options), None
    comparison = evaluate(scenes, statistics, spaces, **options)
    return comparison.evaluation, comparison


def complete_reference(
    job: ReferenceStatistics,
    scans: Sequence[Scan],
    spaces: Sequence[SceneFeatures],
    out: Path,
    every: int = _EVERY,
) -> ReferenceStatistics:
    """Statistics of scans as a file; goes on where an interrupted call has stopped.

    Args:
        job: Empty statistics that were prepared for these scans and spaces.
        scans: All of them, in the order of their names in ``job``.
        spaces: Those of ``job``.
        out: File to write; beside it lies ``<name>.partial.safetensors`` until it is complete.
        every: Scans after which the unfinished file is saved.

    Raises:
        ValueError: If the unfinished file is of another job, another process computes ``out``, or
            a scan cannot be used.
    """
    with only_writer(out.with_name(f".{out.name}.lock"), f"computes {out}"):
        return _complete(job, scans, spaces, out, every)


def _complete(
    job: ReferenceStatistics,
    scans: Sequence[Scan],
    spaces: Sequence[SceneFeatures],
    out: Path,
    every: int,
) -> ReferenceStatistics:
    partial = _partial(out)
    for path in out.parent.glob(f".{escape(partial.stem)}.*.partial.*"):
        path.unlink(missing_ok=True)  # of a killed call
    statistics = resume_or_start(job, partial)
    start, sensor = statistics.num_done, statistics.protocol.sensor

    def scenes() -> Iterator[EvaluationScene]:
        for scan in tqdm(
            scans[start:], "reference", len(scans), initial=start, unit="scan", disable=None
        ):
            yield EvaluationScene(scan.name, torch.from_numpy(read_scan(scan.path, sensor)))

    statistics.update(scenes(), spaces, partial, every)
    statistics.save(partial)
    partial.replace(out)
    return statistics


def cached_reference(
    job: ReferenceStatistics, scans: Sequence[Scan], spaces: Sequence[SceneFeatures], out: Path
) -> ReferenceStatistics:
    """The same, but read from ``out`` where that file is of the same job; replaced where not."""
    for path in (out, _partial(out)):
        try:
            found = resume_or_start(job, path)
        except ValueError as error:  # of other scans, spaces or settings, or damaged
            _log.warning("made anew: %s", error)
            path.unlink()
        else:
            if found.complete:
                return found
    return complete_reference(job, scans, spaces, out)


def _partial(out: Path) -> Path:
    return out.with_name(f"{out.stem}.partial{out.suffix}")


def report(evaluation: Evaluation, statistics: AnyReference) -> str:
    """All numbers of an evaluation, and below those that the paper has, beside the published."""
    text, table = str(evaluation), _beside_published(evaluation, statistics)
    return text if table is None else f"{text}\n\n{table}"


def save_reports(
    evaluation: Evaluation, comparison: Comparison | None, statistics: AnyReference, out: Path
) -> None:
    """Writes numbers, tables and figures to a folder.

    ``evaluation.json`` and ``metrics.csv`` hold all rows; ``table.md`` and ``table.tex`` the
    distances beside the published ones; ``birds_eye.png``, ``ranges.png`` and ``matches.png`` are
    drawn from the sets themselves, where there are any.

    Args:
        evaluation: All numbers.
        comparison: Of the same scenes; see :func:`compare`.
        statistics: The reference.
        out: Folder; files of these names are replaced.
    """
    evaluation.save(out / "evaluation.json")
    EvaluationTable((evaluation,)).save(out / "metrics.csv")
    table = _beside_published(evaluation, statistics) or EvaluationTable((evaluation,))
    table.save(out / "table.md")
    table.save(out / "table.tex")
    if comparison is not None and isinstance(statistics, ReferenceStatistics):
        _draw(comparison, statistics, out)


def _beside_published(evaluation: Evaluation, statistics: AnyReference) -> EvaluationTable | None:
    """Distances without relatives of theirs, below the published rows that have some of them."""
    split: Literal["val-only", "train-val"] = (
        "val-only" if statistics.about.get("split") == "val" else "train-val"
    )
    heads = {space.upper() for space in SPACES} | {"JSD", "MMD"}
    own = replace(evaluation, rows=tuple(r for r in evaluation.rows if r.name in heads))
    names = {row.name for row in own.rows}
    others = [
        replace(other, rows=tuple(row for row in other.rows if row.name in names))
        for other in published_evaluations(split)
    ]
    others = [other for other in others if other.rows]
    return EvaluationTable((*others, own)) if others else None


def _draw(comparison: Comparison, statistics: ReferenceStatistics, out: Path) -> None:
    samples, references, matching = comparison[1:]
    setting = statistics.protocol
    grid, sensor = setting.grid, setting.sensor
    both = (samples, references)
    made, real = (part.cells.sum(dim=0).view(grid.shape).numpy() for part in both)
    viz.save(figures.bev_histograms(made, real, grid.x_m, grid.y_m), out / "birds_eye.png")
    edges_m = torch.arange(references.ranges.shape[1] + 1).double() * RANGE_BIN_M
    halves = [part.ranges[0] for part in statistics.halves if part.count]
    made, real = (part.ranges.sum(dim=0).numpy() for part in both)
    ranges = figures.range_histogram(edges_m.numpy(), made, real, torch.stack(halves).numpy())
    viz.save(ranges, out / "ranges.png")

    shown, scans = samples.images.items(), references.images.items()
    order = matching.squared_normalised.argsort().tolist()

    def pair(index: int) -> figures.MatchedPair:
        name, _, sample_m = shown[int(matching.nearest[index])]
        scan, _, reference_m = scans[index]
        title = f"{name} and {scan}: {matching.squared_normalised[index]:.3g}"
        return figures.MatchedPair(title, sample_m.numpy(), reference_m.numpy())

    best = [pair(index) for index in order[:_SHOWN_MATCHES]]
    worst = [pair(index) for index in order[::-1][:_SHOWN_MATCHES]]
    viz.save(figures.matches_figure(best, worst, sensor), out / "matches.png")
