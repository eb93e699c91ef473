"""The statistics file of the official R3DPA as a reference: what ``evaluate.py`` compares with.

It holds, for one or two splits, mean and covariance of each network's features and the histogram of
occupied cells, and for ``val`` the occupied cells of single scans. It keeps neither features nor
range images, and does not say which scans and weights it is of.

Source: ``evaluate.py`` of valeoai/R3DPA 2789885, ``dataset_stat_path``.
Letters: F feature width, n occupied cells of one scan.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import torch
from torch import Tensor

from r3dpa.io import UNPICKLING_ERRORS
from r3dpa.metrics.bootstrap import Resampling
from r3dpa.metrics.distances import BEVHistogramDistance, MinimumMatchingDistance, distance_row
from r3dpa.metrics.evaluation import (
    PYTHON_OPTION,
    Comparison,
    about_generated,
    check_counts,
    empty_metrics,
    evaluate,
    feature_spaces,
    gather,
)
from r3dpa.metrics.feature_distances import FrechetDistance, metrics_of
from r3dpa.metrics.functional_bev import minimum_matching
from r3dpa.metrics.protocol import PUBLISHED
from r3dpa.metrics.reference import ReferenceStatistics, check_spaces
from r3dpa.metrics.results import Evaluation, MetricResult
from r3dpa.metrics.scene import EvaluationScene
from r3dpa.metrics.scene_features import FREE_SPACES, SceneFeatures

OfficialSplit = Literal["val", "all"]
#: Official names of the feature spaces; FRID also reads the intensity with other weights.
_EVALUATORS = {"fld": "liploc", "fsvd": "minkowskinet", "fpvd": "spvcnn"}
_FRID = {4: "rangevit_wo_i", 5: "rangevit_w_i"}  # by input channels
_HISTOGRAM, _CLOUDS = "dataset_bev_hist", "valset_voxelized_bev"
_MAGIC = b"\x93NUMPY"
_SYMMETRY = 1e-5  # of the largest entry of a covariance


def is_official(path: str | Path) -> bool:
    """Whether a file is in NumPy's format, which no file of ``r3dpa reference`` is."""
    path = Path(path)
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.read(len(_MAGIC)) == _MAGIC


@dataclass(frozen=True)
class OfficialStatistics:
    """One split of the official file; :meth:`load` reads it.

    Args:
        path: The file, for messages.
        split: ``val`` (drives 00 and 02) or ``all`` (these and the training drives).
        moments: Mean ``(F,)`` and covariance ``(F, F)`` float64 by official name of the network.
        cells: ``(cells,)`` int64, scans that occupy each cell seen from above; None without.
        clouds: Occupied cells ``(n,)`` int64 of single scans, in the random order of the file.
    """

    path: Path
    split: OfficialSplit
    moments: Mapping[str, tuple[Tensor, Tensor]]
    cells: Tensor | None
    clouds: Sequence[Tensor]

    #: All published numbers are of it.
    protocol = PUBLISHED

    @property
    def about(self) -> dict[str, Any]:
        """What tables of published numbers ask for."""
        return {"data": self.path.name, "split": self.split}

    def describe(self) -> str:
        """File and split, in one line."""
        return f"official statistics {self.path.name}, split {self.split}, scans not listed"

    @property
    def spaces(self) -> list[str]:
        """Names of the feature spaces that the file has moments of."""
        found = [name for name, key in _EVALUATORS.items() if key in self.moments]
        return ["frid"] * any(key in self.moments for key in _FRID.values()) + found

    def of_space(self, space: SceneFeatures) -> tuple[Tensor, Tensor]:
        """Mean and covariance of a space.

        Raises:
            ValueError: If the file lacks it or has it in another width.
        """
        channels = space.card.get("in_channels", 4)
        key = _FRID.get(channels) if space.name == "frid" else _EVALUATORS.get(space.name)
        if key is None or key not in self.moments:
            where = f"{self.path}, field {self.split}"
            raise ValueError(
                f"{where}: has no moments of {space.name} ({key or 'which is not an official one'})"
                f", only of {', '.join(self.moments) or 'none'}; choose among these spaces"
            )
        mean, covariance = self.moments[key]
        if len(mean) != space.dim:
            raise ValueError(
                f"{self.path}, field {self.split}.{key}.mu: has {len(mean)} numbers, but "
                f"{space.name} has {space.dim} features; give the weights that it was made with"
            )
        return mean, covariance

    @classmethod
    def load(cls, path: str | Path, split: OfficialSplit | None = None) -> OfficialStatistics:
        """Reads the file; nothing in it is executed.

        Raises:
            ValueError: If the file is missing, damaged or of something else, lacks the split, or a
                field is not as it must be; file and field are named.
        """
        path = Path(path)
        content = _read(path)
        held: list[OfficialSplit] = [n for n in get_args(OfficialSplit) if n in content]
        chosen = split or next(iter(held), None)
        if chosen is None or chosen not in held:
            raise ValueError(
                f"{path}: holds no split {chosen or 'val or all'}, its fields are "
                f"{', '.join(map(str, content)) or 'none'}; give the official statistics file"
            )
        part, where = content[chosen], f"{path}, field {chosen}"
        if not isinstance(part, dict):
            raise ValueError(f"{where}: is a {type(part).__name__}, not a dictionary")
        keys = [key for key in (*_FRID.values(), *_EVALUATORS.values()) if key in part]
        moments = {key: _moments(part[key], f"{where}.{key}") for key in keys}
        counted = part.get(_HISTOGRAM)
        cells = None if counted is None else _histogram(counted, f"{where}.{_HISTOGRAM}")
        clouds = _clouds(part[_CLOUDS], f"{where}.{_CLOUDS}") if _CLOUDS in part else []
        if not moments and cells is None and not clouds:
            raise ValueError(
                f"{where}: holds no statistics, only {', '.join(map(str, part)) or 'nothing'}"
            )
        return cls(path, chosen, moments, cells, clouds)


def evaluate_official(
    scenes: Iterable[EvaluationScene],
    statistics: OfficialStatistics,
    spaces: Sequence[SceneFeatures],
    *,
    label: str,
    source: str = "",
    made_with: Mapping[str, Any] | None = None,
    commit: str | None = None,
    allow_few: bool = False,
    skip_bad: bool = False,
    option: str = PYTHON_OPTION,
    batch_size: int = 8,
    resampling: Resampling | None = None,
) -> Evaluation:
    """Compare generated scenes with the official statistics, under the published protocol.

    The rows are the Fréchet distances, and JSD, TV and MMD where the file has what they need. All
    other rows of :func:`r3dpa.metrics.evaluation.evaluate` and every floor need real scans;
    ``left_out`` of the result's ``extra`` names them. The file does not say which weights it was
    made with: that those of ``spaces`` are the same is for the caller to know. The other arguments
    and errors are those of ``evaluate``.
    """
    resampling = resampling or Resampling()
    moments = [statistics.of_space(space) for space in spaces]  # before the long way
    protocol = statistics.protocol
    metrics = empty_metrics(protocol, spaces)
    bad: list[str] | None = [] if skip_bad else None
    names, more = gather(metrics, scenes, spaces, protocol, batch_size, bad, option)
    count, by_name = len(names), metrics_of(metrics)
    check_counts({"generated scenes": count}, spaces, allow_few, option, bad or ())
    rows: list[MetricResult] = []
    absent = ["floors", "W1 range", "CD 3D", "FD-infinity, KID, precision and its relatives"]
    if statistics.cells is None:
        absent += ["JSD", "TV"]
    else:
        cells = cast(BEVHistogramDistance, by_name["cells"])
        cells.real_bins = statistics.cells
        rows += cells.results(resampling)
    if statistics.clouds:
        references = statistics.clouds[: protocol.num_mmd_references]
        own, _ = cast(MinimumMatchingDistance, by_name["matching"]).cells("generated")
        values = minimum_matching(references, own, protocol.grid).squared_normalised
        ends = resampling.of_mean(values)
        sizes = (len(own), len(references))
        rows.append(distance_row("MMD", "MMD", values.mean().item(), sizes, interval=ends))
    else:
        absent.append("MMD")
    for space, (mean, covariance) in zip(spaces, moments, strict=True):
        frechet = cast(FrechetDistance, by_name[f"{space.name}_frechet"])
        frechet.reference_mean, frechet.reference_covariance = mean, covariance
        rows += frechet.results(resampling)
    if not rows:
        raise ValueError(f"{statistics.path}: nothing to compare; choose spaces that it holds")
    note = f"the official file does not hold what these need: {', '.join(absent)}"
    about = about_generated(count, more, spaces, statistics, made_with, commit, source)
    about["extra"] |= {"left_out": note, "bootstrap": vars(resampling)}
    about["extra"] |= {"bad_samples": bad} if bad else {}
    return Evaluation(label, tuple(rows), about)


class _ArraysOnly(pickle.Unpickler):
    """Unpickler of NumPy arrays and plain containers; refuses everything else by name."""

    def find_class(self, module: str, name: str) -> Any:
        parts = module.replace("numpy._core", "numpy.core").split(".")
        if (parts[0], name) in {("numpy", "ndarray"), ("numpy", "dtype")}:
            return super().find_class("numpy", name)
        if parts == ["numpy", "core", "multiarray"] and name in ("_reconstruct", "scalar"):
            return super().find_class("numpy._core.multiarray", name)
        raise pickle.UnpicklingError(f"{module}.{name} is no array; it is not loaded")


def _read(path: Path) -> dict[Any, Any]:
    """The dictionary of the file; nothing in it is executed."""
    try:
        with path.open("rb") as stream:
            version = np.lib.format.read_magic(stream)
            head = getattr(np.lib.format, f"read_array_header_{version[0]}_0")(stream)
            if head[0] != () or not head[2].hasobject:
                raise ValueError(f"an array {head[0]} of {head[2]} instead of one dictionary")
            content = _ArraysOnly(stream).load()
        content = content.item() if isinstance(content, np.ndarray) else content
        if not isinstance(content, dict):
            raise ValueError(f"holds a {type(content).__name__} instead of a dictionary")
    except UNPICKLING_ERRORS as error:
        raise ValueError(
            f"{path}: is no official statistics file ({error}); give its data_statistics.npy"
        ) from error
    return content


def _array(value: Any, where: str, ndim: int) -> np.ndarray:
    """A finite array of float64."""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu" or value.ndim != ndim:
        given = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value)
        raise ValueError(f"{where}: needs an array of numbers with {ndim} axes, got {given}")
    found = value.astype(np.float64)
    if not np.isfinite(found).all():
        raise ValueError(f"{where}: holds NaN or infinite numbers; get the file again")
    return found


def _entry(value: Any, key: str, where: str) -> Any:
    if not isinstance(value, dict) or key not in value:
        raise ValueError(f"{where}.{key}: is missing; get the official file again")
    return value[key]


def _moments(value: Any, where: str) -> tuple[Tensor, Tensor]:
    mean = _array(_entry(value, "mu", where), f"{where}.mu", 1)
    covariance = _array(_entry(value, "sigma", where), f"{where}.sigma", 2)
    if covariance.shape != (len(mean), len(mean)):
        raise ValueError(
            f"{where}.sigma: has shape {covariance.shape}, but mu has {len(mean)} numbers"
        )
    largest = np.abs(covariance).max(initial=0.0)
    if np.abs(covariance - covariance.T).max(initial=0.0) > _SYMMETRY * largest:
        raise ValueError(f"{where}.sigma: is not symmetric, so no covariance; get the file again")
    return torch.from_numpy(mean), torch.from_numpy(covariance)


def _histogram(value: Any, where: str) -> Tensor:
    counts = _array(value, where, 2)
    if counts.shape != PUBLISHED.grid.shape:
        raise ValueError(f"{where}: has shape {counts.shape}, needs {PUBLISHED.grid.shape}")
    if (counts < 0).any() or not counts.any():
        raise ValueError(f"{where}: counts of scans must be at least 0, and not all 0")
    return torch.from_numpy(counts).flatten()


def _clouds(value: Any, where: str) -> list[Tensor]:
    """Occupied cells of the scans that MMD may use."""
    parts = _entry(value, "points", where)
    if not isinstance(parts, list) or not parts:
        raise ValueError(f"{where}.points: needs a list of clouds, got {type(parts).__name__}")
    side, clouds = PUBLISHED.grid.shape[0], []
    for index, part in enumerate(parts[: PUBLISHED.num_mmd_references]):
        name = f"{where}.points[{index}]"
        scaled = _array(part, name, 2) * side
        cells = np.rint(scaled)
        inside = scaled.shape[1] == 2 and len(scaled) and (cells >= 0).all()
        if not inside or (cells >= side).any() or np.abs(cells - scaled).max() > 0.01:
            raise ValueError(
                f"{name}: needs occupied cells (n, 2) divided by {side}, got {part.shape}"
            )
        index_of = torch.from_numpy(cells).long()
        clouds.append((index_of[:, 0] * side + index_of[:, 1]).unique())
    return clouds


AnyReference = ReferenceStatistics | OfficialStatistics


def load_reference(path: Path, split: OfficialSplit | None = None) -> AnyReference:
    """Reference of either kind, ready to compare with.

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
    ckpt: Mapping[str, Any] | None,
    protocol: str | None,
    device: str,
) -> list[SceneFeatures]:
    """Feature spaces of a comparison with a reference.

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
    """Generated scenes beside a reference of either kind."""
    if isinstance(statistics, OfficialStatistics):
        return evaluate_official(scenes, statistics, spaces, **options), None
    comparison = evaluate(scenes, statistics, spaces, **options)
    return comparison.evaluation, comparison
