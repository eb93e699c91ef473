"""The statistics file of the official R3DPA as a reference, see ``evaluate.py`` of valeoai/R3DPA.

For one or two splits it holds mean and covariance of each network's features and the histogram of
occupied cells, and for ``val`` the occupied cells of single scans; no features, no range images,
and neither names of scans nor hashes of weights. Source: valeoai/R3DPA 2789885.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import torch
from torch import Tensor
from torchmetrics import MetricCollection

from r3dpa.io import UNPICKLING_ERRORS
from r3dpa.metrics.distances import BEVHistogramDistance, MinimumMatchingDistance
from r3dpa.metrics.feature_distances import FrechetDistance, metrics_of
from r3dpa.metrics.scene import PUBLISHED
from r3dpa.metrics.scene_features import SceneFeatures

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
    """One split of the official file.

    Args:
        path: The file, for messages.
        split: ``val`` (drives 00 and 02) or ``all`` (these and the training drives).
        moments: Mean ``(F,)`` and covariance ``(F, F)`` float64 by official name of the network.
        cells: ``(cells,)`` float64, scans that occupy each cell seen from above; None without.
        clouds: Occupied cells ``(n,)`` int64 of single scans, in the random order of the file.
    """

    path: Path
    split: OfficialSplit
    moments: Mapping[str, tuple[Tensor, Tensor]]
    cells: Tensor | None
    clouds: Sequence[Tensor]

    protocol = PUBLISHED

    @property
    def about(self) -> dict[str, Any]:
        """Data and split."""
        return {"data": self.path.name, "split": self.split}

    def describe(self) -> str:
        """File and split, in one line."""
        return f"official statistics {self.path.name}, split {self.split}, scans not listed"

    @property
    def spaces(self) -> list[str]:
        """Names of the feature spaces that the file has moments of."""
        found = [name for name, key in _EVALUATORS.items() if key in self.moments]
        return ["frid"] * any(key in self.moments for key in _FRID.values()) + found

    @property
    def left_out(self) -> str:
        """Rows that cannot be computed from the file."""
        absent = ["floors", "W1 range", "CD 3D", "FD-infinity, KID, precision and its relatives"]
        absent += ["JSD", "TV"] * (self.cells is None) + ["MMD"] * (not self.clouds)
        return f"the official file does not hold what these need: {', '.join(absent)}"

    def of_space(self, space: SceneFeatures) -> tuple[Tensor, Tensor]:
        """Mean and covariance of a space; a ``ValueError`` if it is absent or of another width."""
        channels = space.card.get("in_channels", 4)
        key = _FRID.get(channels) if space.name == "frid" else _EVALUATORS.get(space.name)
        where = f"{self.path}, field {self.split}"
        if key is None or key not in self.moments:
            raise ValueError(
                f"{where}: has no moments of {space.name} ({key or 'which is not an official one'})"
                f", only of {', '.join(self.moments) or 'none'}; choose among these spaces"
            )
        mean, covariance = self.moments[key]
        if len(mean) != space.dim:
            raise ValueError(
                f"{where}.{key}.mu: has {len(mean)} numbers, but {space.name} has {space.dim} "
                "features; give the weights that it was made with"
            )
        return mean, covariance

    def check(self, spaces: Sequence[SceneFeatures]) -> None:
        """Refuses spaces that the file lacks, and a file that has nothing to compare with."""
        for space in spaces:
            self.of_space(space)
        if not spaces and self.cells is None and not self.clouds:
            raise ValueError(f"{self.path}: nothing to compare; choose spaces that it holds")

    def fill(self, metrics: MetricCollection, spaces: Sequence[SceneFeatures]) -> None:
        """Sets the real side of the metrics that the file has something for."""
        by_name = metrics_of(metrics)
        if self.cells is not None:
            cast(BEVHistogramDistance, by_name["cells"]).real_bins = self.cells
        matching = cast(MinimumMatchingDistance, by_name["matching"])
        matching.reference_cells = list(self.clouds[: self.protocol.num_mmd_references])
        for space in spaces:
            frechet = cast(FrechetDistance, by_name[f"{space.name}_frechet"])
            frechet.reference = self.of_space(space)

    @classmethod
    def load(cls, path: str | Path, split: OfficialSplit | None = None) -> OfficialStatistics:
        """Reads the file without executing anything in it; ``val`` comes first without a split.

        Raises:
            ValueError: If the file is missing, damaged or of something else, lacks the split, or a
                field is wrong; names file and field.
        """
        path = Path(path)
        content = _read(path)
        chosen = split or next((name for name in get_args(OfficialSplit) if name in content), None)
        part = content.get(chosen)
        if chosen is None or not isinstance(part, dict):
            raise ValueError(
                f"{path}: holds no split {chosen or 'val or all'}, its fields are "
                f"{', '.join(map(str, content)) or 'none'}; give the official statistics file"
            )
        where = f"{path}, field {chosen}"
        keys = [key for key in (*_FRID.values(), *_EVALUATORS.values()) if key in part]
        moments = {key: _moments(part[key], f"{where}.{key}") for key in keys}
        cells = _histogram(part, f"{where}.{_HISTOGRAM}") if _HISTOGRAM in part else None
        clouds = _clouds(part[_CLOUDS], f"{where}.{_CLOUDS}") if _CLOUDS in part else []
        if not moments and not clouds and cells is None:
            raise ValueError(f"{where}: holds no statistics; give the official statistics file")
        return cls(path, chosen, moments, cells, clouds)


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


def _array(parent: Any, key: str, where: str, ndim: int) -> np.ndarray:
    """A finite array of float64 from a dictionary."""
    value = parent.get(key) if isinstance(parent, dict) else None
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu" or value.ndim != ndim:
        raise ValueError(f"{where}: needs an array of numbers with {ndim} axes; get the file again")
    if not np.isfinite(value).all():
        raise ValueError(f"{where}: holds NaN or infinite numbers; get the file again")
    return value.astype(np.float64)


def _moments(value: Any, where: str) -> tuple[Tensor, Tensor]:
    mean = _array(value, "mu", f"{where}.mu", 1)
    covariance = _array(value, "sigma", f"{where}.sigma", 2)
    if covariance.shape != (len(mean), len(mean)):
        raise ValueError(
            f"{where}.sigma: has shape {covariance.shape}, but mu has {len(mean)} numbers"
        )
    largest = np.abs(covariance).max(initial=0.0)
    if np.abs(covariance - covariance.T).max(initial=0.0) > _SYMMETRY * largest:
        raise ValueError(f"{where}.sigma: is not symmetric, so no covariance; get the file again")
    return torch.from_numpy(mean), torch.from_numpy(covariance)


def _histogram(part: dict[str, Any], where: str) -> Tensor:
    counts = _array(part, _HISTOGRAM, where, 2)
    if counts.shape != PUBLISHED.grid.shape or (counts < 0).any() or not counts.any():
        raise ValueError(
            f"{where}: needs counts of scans in {PUBLISHED.grid.shape} cells, at least 0 and not "
            f"all 0, got {counts.shape}"
        )
    return torch.from_numpy(counts).flatten()


def _clouds(value: Any, where: str) -> list[Tensor]:
    """Occupied cells of the scans that MMD may use."""
    parts = value.get("points") if isinstance(value, dict) else None
    if not isinstance(parts, list) or not parts:
        raise ValueError(f"{where}.points: needs a list of clouds, got {type(parts).__name__}")
    side, clouds = PUBLISHED.grid.shape[0], []
    for index, part in enumerate(parts[: PUBLISHED.num_mmd_references]):
        name = f"{where}.points[{index}]"
        scaled = _array({name: part}, name, name, 2) * side
        cells = np.rint(scaled)
        inside = scaled.shape[1] == 2 and len(scaled) and (cells >= 0).all()
        if not inside or (cells >= side).any() or np.abs(cells - scaled).max() > 0.01:
            raise ValueError(
                f"{name}: needs occupied cells (n, 2) divided by {side}, got {part.shape}"
            )
        index_of = torch.from_numpy(cells).long()
        clouds.append((index_of[:, 0] * side + index_of[:, 1]).unique())
    return clouds
