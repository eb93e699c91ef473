"""``r3dpa evaluate``, ``data reference`` and ``data realism``: comparisons with real scans."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from jsonargparse.typing import PositiveInt

from r3dpa.feature_names import DEFAULT_SPACES, FeatureSpace
from r3dpa.io import check_file, check_folder


def reference(
    *,
    data: Path,
    out: Path,
    spaces: tuple[FeatureSpace, ...] = DEFAULT_SPACES,
    ckpt: dict[str, Path] | None = None,
    split: Literal["train", "val", "all"] = "all",
    limit: PositiveInt | None = None,
    columns: tuple[str, ...] = (),
    protocol: Literal["default", "published"] = "default",
    device: str = "auto",
) -> str:
    """Write the statistics of real scans that r3dpa evaluate compares samples with.

    The same command completes an interrupted run, from ``<name>.partial.safetensors``.

    Args:
        data: Folder of scans, in the KITTI-360 layout or any other, or a data YAML.
        out: File to write, ``.safetensors``.
        spaces: Feature spaces: ``fwid``, ``fwid_judge`` and ``fgeo`` need no file; ``frid``,
            ``fld``, ``fsvd`` and ``fpvd``, and ``frd``, ``frid_r2flow``, ``frid_lidm`` and ``fpd``
            of the baselines, need the weights of the official networks.
        ckpt: Weights by space, such as ``--ckpt.frid model.ckpt``.
        split: Part of the data.
        limit: Maximum scans, evenly spaced.
        columns: Columns of files without names, such as ``x,y,z,intensity,ring``; default:
            inferred from the values.
        protocol: ``published`` prepares scans as the published numbers do: points on the corners
            of pixels, and pictures of LIP-Loc that wrap around.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
    """
    from r3dpa.cli.features import read_data
    from r3dpa.data.scans import evenly
    from r3dpa.io import source_commit
    from r3dpa.metrics.evaluation import feature_spaces
    from r3dpa.metrics.reference import ReferenceStatistics, cards_of, compute_reference
    from r3dpa.metrics.scene import PROTOCOLS, EvaluationScene

    check_file(out)
    if out.suffix != ".safetensors":
        raise ValueError(f"--out {out}: must be a .safetensors file, the format of a reference")
    if out.exists():
        raise ValueError(f"{out} exists: delete it, or give another --out")
    module = read_data(data, columns)
    train, val = module.limited_split()
    splits = {"train": train, "val": val, "all": train + val}
    # A scan may be repeated in training.
    scans = evenly(module.without_further(sorted(set(splits[split]))), limit)
    if len(scans) < 2:
        given = "1 scan" if len(scans) == 1 else "no scans"
        raise ValueError(f"{data}: {given} in split {split}; at least 2 are needed")
    setting = replace(PROTOCOLS[protocol], sensor=module.sensor)
    networks = feature_spaces(spaces, ckpt, setting, device)
    about = {
        "data": str(data),
        "split": split,
        "limit": limit,
        "dataset": module.dataset,
        "commit": source_commit(),
    }
    job = ReferenceStatistics(setting, cards_of(networks), [scan.name for scan in scans], about)

    def scenes_from(start: int) -> Iterator[EvaluationScene]:
        for scan in scans[start:]:
            yield EvaluationScene(scan.name, module.points(scan))

    statistics = compute_reference(job, scenes_from, networks, out)
    return f"{out}: {statistics.describe()}; {', '.join(statistics.spaces)}; protocol {protocol}"


def evaluate(
    *,
    samples: Path,
    reference: Path,
    spaces: list[FeatureSpace] | None = None,
    ckpt: dict[str, Path] | None = None,
    skip_bad: bool = False,
    allow_few: bool = False,
    baseline_metrics: bool = False,
    label: str | None = None,
    device: str = "auto",
    out: Path | None = None,
    split: Literal["val", "all"] | None = None,
    beside: tuple[Path, ...] = (),
) -> str:
    """Compare the samples of any generator with real scans.

    Prints every metric with its confidence interval and its floor, the distance of real scans from
    real scans, and a table, beside the published numbers if the real scans are KITTI-360.

    Args:
        samples: File or folder: ``r3dpa sample``, R3DPA, LiDAR-Diffusion, R2DM, R2Flow, RangeLDM,
            or any clouds as ``.bin``, ``.ply``, ``.pcd``, ``.las``, ``.laz``, ``.txt``, ``.npy`` or
            ``.npz``.
        reference: File of ``r3dpa data reference``, or R3DPA's own ``data_statistics.npy``.
        spaces: Feature spaces; default: all of the reference that need no weights or have them in
            ``ckpt``.
        ckpt: Weights by space, such as ``--ckpt.frid model.ckpt``.
        skip_bad: Leave out samples that cannot be used, and list them.
        allow_few: Accept fewer samples than features, for a trial.
        baseline_metrics: Also JSD and MMD as R2DM, R2Flow and LiDM define them, by other names.
        label: Name of the generator in tables; default: the name of ``samples``.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
        out: Folder for the numbers (JSON, CSV), tables (Markdown, LaTeX) and figures.
        split: Part of ``data_statistics.npy``; default: ``val`` if it holds both.
        beside: Files ``evaluation.json`` of earlier comparisons, shown in the table in place of the
            published numbers.
    """
    from tqdm import tqdm

    from r3dpa.data.samples import read_samples
    from r3dpa.metrics import evaluation as metrics
    from r3dpa.metrics.results import Evaluation, report, save_reports
    from r3dpa.metrics.scene import EvaluationScene
    from r3dpa.viz.evaluation import save_figures

    check_folder(out)
    earlier = [Evaluation.load(path) for path in beside]
    made_with = _made_with(samples)  # refuses damaged metadata before the work starts
    statistics = metrics.load_reference(reference, split)
    networks = metrics.reference_spaces(statistics, spaces, ckpt, device)
    setting = statistics.protocol
    files = read_samples(
        samples, setting.sensor, unprojection=setting.unprojection, skip_bad=skip_bad
    )
    place = samples.resolve()
    comparison = metrics.evaluate(
        (EvaluationScene(*sample) for sample in tqdm(files, "samples", disable=None)),
        statistics,
        networks,
        label=label or (place.name if place.is_dir() else place.stem),
        source=str(samples),
        made_with=made_with,
        allow_few=allow_few,
        skip_bad=skip_bad,
        baseline_metrics=baseline_metrics,
    )
    evaluation = comparison.evaluation
    if files.bad:  # the reader refused these, so that they never became scenes
        evaluation.about["extra"]["bad_samples"] = [*files.bad, *evaluation.bad_samples]
    if out is not None:
        save_reports(evaluation, statistics.about, out, earlier)
        if comparison.figures:
            save_figures(out, **comparison.figures)
    return report(evaluation, statistics.about, earlier)


def _made_with(samples: Path) -> dict[str, Any]:
    """Read what made the samples from the metadata of ``r3dpa sample``; empty without any."""
    folder = samples if (samples / "metadata.json").is_file() else samples.parent
    path = folder / "metadata.json"
    if not path.is_file():
        return {}
    try:
        metadata = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: is damaged ({error}); repair or remove it") from error
    if not isinstance(metadata, dict) or "r3dpa" not in metadata:
        return {}
    sampler = metadata.get("sampler") or {}
    keys = ("seed", "precision", "feature_source", "checkpoint", "stage", "step", "weights", "nfe")
    made_with = {key: metadata.get(key) for key in keys}
    made_with |= {key: sampler.get(key) for key in ("solver", "steps")}
    return made_with | {"sampler": sampler, "made_by_commit": metadata.get("commit")}


def realism(
    *, scans: Path, reference: Path, columns: tuple[str, ...] = (), out: Path | None = None
) -> Any:
    """Compare scans with real ones, each measure beside the distance between real drives.

    Args:
        scans: Folder of scans (A), .bin, .pcd, .ply, .npy, .npz or .las; one drive per folder.
        reference: Folder of real scans (B); a single drive gives no floor.
        columns: Columns of files without names, such as ``x,y,z,intensity,ring``; default:
            inferred from the values.
        out: JSON file for the table.
    """
    from tqdm import tqdm

    from lidarsim.realism import realism_table
    from lidarsim.scan_files import ScanError
    from lidarsim.scan_statistics import ScanStatistics, scan_statistics
    from r3dpa.data.scans import find_scans
    from r3dpa.io import write_text

    check_file(out)

    def statistics_by_drive(folder: Path, name: str) -> dict[str, ScanStatistics]:
        drives: dict[str, ScanStatistics] = defaultdict(ScanStatistics)
        for scan in tqdm(find_scans(folder, columns), name, unit="scan", disable=None):
            points = scan.read()
            try:
                drives[scan.drive] += scan_statistics(points)
            except ValueError as error:
                raise ScanError(f"{scan.path}: {error}") from error
        return drives

    drives, real_drives = statistics_by_drive(scans, "A"), statistics_by_drive(reference, "B")
    table = realism_table(drives, real_drives, [f"A: {scans}", f"B: {reference}"])
    if out is not None:
        write_text(out, json.dumps(table.to_dict(), indent=1, allow_nan=False) + "\n")
    return table
