"""How feature grids were made: what lies beside them on disk, compared on opening."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from r3dpa.geometry import Projection, projection_to_dict
from r3dpa.io import atomic_path

if TYPE_CHECKING:
    from r3dpa.data.feature_grids import Extractor

REMEDY = "`r3dpa features --data <data YAML or folder>`"
_FILE = "settings.json"
DTYPES = ("float16", "int8")


class FeatureGridError(ValueError):
    """Grids that are missing or were made with other settings; the message says the remedy."""


@dataclass(frozen=True)
class GridSettings:
    """How the grids of one store were made.

    Args:
        projection: That of the range images, as plain values.
        grid_size: Rows and columns (h, w).
        extractor: ``name`` and ``settings`` of what made the features.
        dim: Width D of the features.
        dtype: ``"float16"``, to which larger values are clamped; or ``"int8"``: codes -127..127
            and a float32 scale per cell, its largest magnitude / 127, so that a value is off by
            at most half the scale. An empty cell is zero in both.
        precision: Arithmetic that the extractor ran in, as Lightning names it.

    Raises:
        ValueError: If ``dtype`` is none of the two.
    """

    projection: dict[str, Any]
    grid_size: tuple[int, int]
    extractor: dict[str, Any]
    dim: int
    dtype: str
    precision: str

    def __post_init__(self) -> None:
        """Refuse an unknown ``dtype``."""
        if self.dtype not in DTYPES:
            raise ValueError(f"dtype must be one of {', '.join(DTYPES)}, got {self.dtype!r}.")

    @classmethod
    def of(
        cls,
        extractor: Extractor,
        projection: Projection,
        grid_size: tuple[int, int],
        dtype: str = "float16",
        precision: str = "32-true",
    ) -> Self:
        """Settings of the grids that an extractor would make.

        Raises:
            ValueError: If the grid does not divide the range image, or ``dtype`` is unknown.
        """
        projection.sensor.cell_size(grid_size)
        size = (grid_size[0], grid_size[1])
        wanted = wanted_settings(projection, extractor)
        return cls(grid_size=size, dtype=dtype, precision=precision, **wanted)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (N, D) of a grid."""
        return math.prod(self.grid_size), self.dim

    @property
    def row(self) -> np.dtype[Any]:
        """NumPy type of one grid: ``values`` (N, D), or ``scale`` (N,) and ``codes`` (N, D)."""
        if self.dtype == "float16":
            return np.dtype([("values", "<f2", self.shape)])
        return np.dtype([("scale", "<f4", self.shape[:1]), ("codes", "i1", self.shape)])


def wanted_settings(projection: Projection, extractor: Extractor | None) -> dict[str, Any]:
    """What a user of grids asks for, as it comes back from a file; any extractor if None."""
    wanted: dict[str, Any] = {"projection": projection_to_dict(projection)}
    if extractor is not None:
        wanted["extractor"] = {"name": extractor.name, "settings": extractor.settings}
        wanted["dim"] = extractor.dim
    return json.loads(json.dumps(wanted))


def store_folder(features_dir: str | Path, grid_size: tuple[int, int]) -> Path:
    """Folder of the store of one grid size."""
    return Path(features_dir) / f"{grid_size[0]}x{grid_size[1]}"


def stored_settings(features_dir: str | Path) -> dict[tuple[int, int], GridSettings]:
    """Settings of the stores of a folder by grid size; empty if there are none.

    Raises:
        FeatureGridError: If a file of settings is damaged.
    """
    found = {}
    for path in sorted(Path(features_dir).glob(f"*/{_FILE}")):
        try:
            values = json.loads(path.read_text())
            settings = GridSettings(**values | {"grid_size": tuple(values["grid_size"])})
            if path.parent != store_folder(features_dir, settings.grid_size):
                raise ValueError(f"it is of grid_size {list(settings.grid_size)}")
            _ = settings.row, settings.extractor["name"]  # can be made
        except (LookupError, TypeError, ValueError, OverflowError, RecursionError) as error:
            raise FeatureGridError(
                f"{path} is damaged ({error!r}): delete {path.parent} and make its grids again "
                f"with {REMEDY}."
            ) from error
        found[settings.grid_size] = settings
    return found


def write_settings(features_dir: str | Path, settings: GridSettings) -> None:
    """Write the settings of a store that has none."""
    path = store_folder(features_dir, settings.grid_size) / _FILE
    if not path.exists():
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(vars(settings), indent=1))


def check_settings(features_dir: str | Path, settings: GridSettings) -> None:
    """Refuse to add grids to those of other settings, or to a folder of another extractor.

    Raises:
        FeatureGridError: Names both values.
    """
    for size, stored in stored_settings(features_dir).items():
        wanted = vars(settings)
        if size != settings.grid_size:
            wanted = {key: wanted[key] for key in ("extractor", "dim")}
        compare_settings(wanted, stored, store_folder(features_dir, size))


def compare_settings(wanted: Mapping[str, Any], stored: GridSettings, folder: Path) -> None:
    """Refuse grids that were made with other settings than those that are wanted.

    Raises:
        FeatureGridError: Names both values.
    """
    for key, value in wanted.items():
        if getattr(stored, key) != value:
            raise made_otherwise(key, getattr(stored, key), value, folder)


def made_otherwise(key: str, stored: Any, wanted: Any, folder: Path) -> FeatureGridError:
    """Error that names both values of a setting, and the remedy."""
    return FeatureGridError(
        f"Feature grids in {folder} were made with {key} {stored}, but {key} {wanted} is asked "
        "for: restore that setting, or give another features_dir and make new grids there with "
        f"{REMEDY}."
    )
