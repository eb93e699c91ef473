"""The statistics file of the official R3DPA as a reference (valeoai/R3DPA 2789885).

It holds moments of features and histograms of occupied cells, and for ``val`` the occupied cells
of single scans; no features, no range images, and neither names of scans nor hashes of weights.
"""

from __future__ import annotations

import io
import math
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torchmetrics import MetricCollection

from r3dpa.io import UNPICKLING_ERRORS
from r3dpa.metrics.collection import metrics_by_name
from r3dpa.metrics.results import PUBLISHED_DATASET
from r3dpa.metrics.scene import PUBLISHED
from r3dpa.metrics.scene_features import SceneFeatures

OfficialSplit = Literal["val", "all"]
#: Official names of the feature spaces; FRID also reads the intensity with other weights.
_EVALUATORS = {"fld": "liploc", "fsvd": "minkowskinet", "fpvd": "spvcnn"}
_FRID = {4: "rangevit_wo_i", 5: "rangevit_w_i"}  # by input channels
_HISTOGRAM, _CLOUDS = "dataset_bev_hist", "valset_voxelized_bev"


@dataclass(frozen=True)
class OfficialStatistics:
    """One split of the official file."""

    path: Path
    split: OfficialSplit  # val: drives 00 and 02; all: these and the training drives
    #: Mean ``(F,)`` and covariance ``(F, F)`` float64 by official name of the network.
    moments: Mapping[str, tuple[Tensor, Tensor]]
    cells: Tensor | None  # (cells,) float64, scans that occupy each cell seen from above
    clouds: Sequence[Tensor]  # occupied cells (n,) int64 of single scans

    protocol = PUBLISHED
    names = ()  # unknown

    @property
    def about(self) -> dict[str, Any]:
        """Data, split, and the data set that all official files are of."""
        return {"data": self.path.name, "split": self.split, "dataset": PUBLISHED_DATASET}

    def describe(self) -> str:
        """Return file and split, in one line."""
        return f"official statistics {self.path.name}, split {self.split}, scans not listed"

    @property
    def spaces(self) -> list[str]:
        """Names of the feature spaces that the file has moments of."""
        names = [name for name, key in _EVALUATORS.items() if key in self.moments]
        if any(key in self.moments for key in _FRID.values()):
            names.insert(0, "frid")
        return names

    @property
    def left_out(self) -> str:
        """Rows that cannot be computed from the file."""
        absent = ["floors", "W1 range", "CD 3D", "FD-infinity, KID, precision and its relatives"]
        if self.cells is None:
            absent += ["JSD", "TV"]
        if not self.clouds:
            absent.append("MMD")
        return f"the official file does not hold what these need: {', '.join(absent)}"

    def moments_of(self, space: SceneFeatures) -> tuple[Tensor, Tensor]:
        """Return mean and covariance of a space.

        Raises:
            ValueError: If the space is absent or of another width.
        """
        channels = space.card.get("in_channels", 4)
        key = _FRID.get(channels) if space.name == "frid" else _EVALUATORS.get(space.name)
        moments = self.moments.get(key or "")
        if moments is None:
            raise ValueError(
                f"{self.path}, field {self.split}: has no moments of {space.name} ({key or 'ours'})"
                f", only of {', '.join(self.moments) or 'none'}; choose among these spaces"
            )
        if len(moments[0]) != space.dim:
            raise ValueError(
                f"{self.path}, field {self.split}.{key}: has {len(moments[0])} features, but "
                f"{space.name} has {space.dim}; give the weights that it was made with"
            )
        return moments

    def check(self, spaces: Sequence[SceneFeatures] = ()) -> None:
        """Check that the file has moments of these spaces; see :meth:`moments_of`."""
        for space in spaces:
            self.moments_of(space)

    def fill(self, metrics: MetricCollection, spaces: Sequence[SceneFeatures]) -> None:
        """Set the real side of the metrics that the file has statistics for."""
        by_name = metrics_by_name(metrics)
        if self.cells is not None:
            by_name["cells"].real_bins = self.cells
            by_name["cells"].has_official_reference = True
        if self.clouds:
            by_name["matching"].reference_cells = list(self.clouds)
            by_name["matching"].has_official_reference = True
        for space in spaces:
            metric = by_name[f"{space.name}_frechet"]
            metric.reference = self.moments_of(space)
            metric.has_official_reference = True

    @classmethod
    def load(cls, path: str | Path, split: OfficialSplit | None = None) -> OfficialStatistics:
        """Read the file without executing anything in it.

        Args:
            path: The official ``data_statistics.npy``.
            split: Part of the file; default: ``val`` if it has both.

        Raises:
            ValueError: Naming the file and the fault.
        """
        path = Path(path)
        try:
            stream = io.BytesIO(path.read_bytes())
            version = np.lib.format.read_magic(stream)
            getattr(np.lib.format, f"read_array_header_{version[0]}_0")(stream)
            content = _ArraysOnly(stream).load().item()
            chosen: OfficialSplit = split or ("val" if "val" in content else "all")
            part = content[chosen]
            moments = {}
            for key in (*_FRID.values(), *_EVALUATORS.values()):
                if key in part:
                    mean, covariance = _numbers(part[key]["mu"], 1), _numbers(part[key]["sigma"], 2)
                    moments[key] = (mean, covariance.view(len(mean), len(mean)))
            cells = None
            if _HISTOGRAM in part:
                cells = _numbers(part[_HISTOGRAM], 2).view([PUBLISHED.grid.side] * 2).flatten()
            parts = part[_CLOUDS]["points"] if _CLOUDS in part else []
            clouds = [_cells(cloud) for cloud in parts[: PUBLISHED.num_mmd_references]]
        except (*UNPICKLING_ERRORS, SystemError) as error:  # of NumPy, for a damaged type
            raise ValueError(
                f"{path}: is no official statistics file with the split {split or 'val or all'} "
                f"({error!r}); give its data_statistics.npy"
            ) from error
        if not moments and not clouds and cells is None:
            raise ValueError(f"{path}, field {chosen}: holds no statistics")
        return cls(path, chosen, moments, cells, clouds)


class _Array(np.ndarray):
    """Array that is refused if it claims more elements than its pickled values can have."""

    def __setstate__(self, state: Any) -> None:
        if math.prod(state[1]) > len(state[4]):
            raise pickle.UnpicklingError(f"an array of shape {state[1]} is cut short")
        super().__setstate__(state)


_PICKLED: dict[str, Any] = {
    "numpy.dtype": np.dtype,
    "numpy.ndarray": None,  # only an argument of the next, which needs none
    "numpy._core.multiarray._reconstruct": lambda *_: _Array(0),
    "numpy._core.multiarray.scalar": np.float64().__reduce__()[0],
}


class _ArraysOnly(pickle._Unpickler):
    """Unpickler of NumPy arrays and plain containers; refuses everything else by name.

    The one written in C allocates its memo by the indices in the file, which may be damaged.
    """

    def find_class(self, module: str, name: str) -> Any:
        full = f"{module}.{name}".replace("numpy.core", "numpy._core")
        if full not in _PICKLED:
            raise pickle.UnpicklingError(f"{full} is no array; it is not loaded")
        return _PICKLED[full]


def _numbers(values: np.ndarray, ndim: int) -> Tensor:
    if values.ndim != ndim or not np.isfinite(values).all():
        raise ValueError(f"an array of shape {values.shape} instead of {ndim} axes of numbers")
    return torch.from_numpy(values.astype(np.float64))


def _cells(points: np.ndarray) -> Tensor:
    """Indices of occupied cells from their coordinates, which the file divides by the side."""
    side = PUBLISHED.grid.side
    scaled = _numbers(points, 2) * side
    cells = scaled.round()
    if ((cells < 0) | (cells >= side) | ((cells - scaled).abs() > 0.01)).any():
        raise ValueError(f"occupied cells that are not multiples of 1 / {side}")
    return (cells.long() @ torch.tensor([side, 1])).unique()
