"""Sensors as YAML files: the presets, calibrations of velodyne_pointcloud, and files of users.

A file of ours holds ``name``, ``source``, fields of :class:`SpinningLidar` under ``sensor`` and the
columns of :class:`Lasers` under ``lasers``, highest beam first; angles in ``_deg`` or ``_rad``.
Columns left out are 0, gains 1. What ``r3dpa data sensor`` adds under ``estimate`` is not read.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarsim.io import write_text
from lidarsim.sensors.spinning import Lasers, SpinningLidar

_FOLDER = Path(__file__).parent / "presets"
#: Names of the presets.
PRESETS = tuple(sorted(path.stem for path in _FOLDER.glob("*.yaml")))
_NO_TURN = {
    "at128": "the Hesai AT128 sweeps a sector of 120 degrees and does not turn",
}
_SECTIONS = {"name", "source", "sensor", "lasers", "estimate"}
_CALIBRATION = {
    "inclination_rad": "vert_correction",
    "azimuth_offset_rad": "rot_correction",
    "height_m": "vert_offset_correction",
    "lateral_m": "horiz_offset_correction",
}


class SensorFile(NamedTuple):
    """Content of a sensor's file."""

    name: str
    source: str
    sensor: SpinningLidar


def load_sensor(model: str | Path, **changes: Any) -> SpinningLidar:
    """Load a preset by its name, or a sensor from a YAML file.

    Args:
        model: One of ``PRESETS``; a file of ``r3dpa data sensor``; or a calibration as
            ``velodyne_pointcloud`` of ros-drivers reads, for an HDL-64E: a list ``lasers`` with
            ``vert_correction`` and ``rot_correction`` in radians and ``vert_offset_correction``
            and ``horiz_offset_correction`` in metres.
        changes: Other values for fields of :class:`SpinningLidar`.

    Raises:
        ValueError: If there is no such preset or file, or its content is wrong.
    """
    return replace(read_sensor(model).sensor, **changes)


def read_sensor(model: str | Path) -> SensorFile:
    """Read name, source and sensor of a preset or file, see :func:`load_sensor`."""
    name = str(model)
    if name in PRESETS:
        return _preset(name)
    if name in _NO_TURN:
        raise ValueError(f"{_NO_TURN[name]}: only LiDARs that turn fully can be simulated")
    path = Path(model)
    if not path.is_file():
        close = difflib.get_close_matches(name, PRESETS, 1)
        guess = f" (did you mean {close[0]!r}?)" if close else ""
        choices = ", ".join(PRESETS)
        raise ValueError(f"unknown sensor {name!r}{guess}; choose from {choices}, or give a YAML")
    return _read(path)


def hdl64e(shots: int = 2083) -> SpinningLidar:
    """Velodyne HDL-64E as mounted on the recording car of KITTI-360, 2083 shots at 10 Hz."""
    return load_sensor("hdl64e", shots=shots)


def write_sensor(
    path: str | Path, content: SensorFile, estimate: Mapping[str, Any] | None = None
) -> None:
    """Write a sensor as a YAML file, atomically, with what is known about its estimate.

    Settings and columns that have their default are left out; numbers keep six decimals.
    """
    import yaml

    sensor = content.sensor
    document: dict[str, Any] = {
        "name": content.name,
        "source": content.source,
        "sensor": {
            field.name: getattr(sensor, field.name)
            for field in fields(SpinningLidar)
            if field.name != "lasers" and getattr(sensor, field.name) != field.default
        },
        "lasers": _columns_of(sensor.lasers),
    }
    if estimate is not None:
        document["estimate"] = dict(estimate)
    text = yaml.safe_dump(document, default_flow_style=None, sort_keys=False, width=100)
    write_text(path, text)


def _columns_of(lasers: Lasers) -> dict[str, list[float]]:
    columns = {}
    for name, values in asdict(lasers).items():
        default = _default_of(name)
        if name != "inclination_rad" and all(value == default for value in values):
            continue
        if name.endswith("_rad"):
            name, values = name.replace("_rad", "_deg"), np.degrees(values)
        columns[name] = [round(float(value), 6) for value in values]
    return columns


def _default_of(column: str) -> float:
    return 1.0 if column == "intensity_gain" else 0.0


@cache
def _preset(name: str) -> SensorFile:
    return _read(_FOLDER / f"{name}.yaml")


def _read(path: Path) -> SensorFile:
    import yaml  # the import of lidarsim does not need it

    try:
        content = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not YAML: {error}") from error
    try:
        if isinstance(content, dict) and isinstance(content.get("lasers"), list):
            sensor = SpinningLidar(_calibrated_lasers(content["lasers"]))
            return SensorFile(path.stem, f"calibration {path.name}, HDL-64E", sensor)
        return _content(path, content)
    except (KeyError, TypeError, ValueError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else error
        raise ValueError(
            f"{path}: {reason}; a sensor needs `lasers` with `inclination_deg` of each beam, or a "
            "list `lasers`, each with vert_correction (radians)"
        ) from error


def _content(path: Path, content: Any) -> SensorFile:
    if not isinstance(content, dict) or not isinstance(content.get("lasers"), dict):
        raise ValueError("holds no table `lasers`")
    _check_names("section", content, _SECTIONS)
    settings = content.get("sensor") or {}
    _check_names("setting", settings, {field.name for field in fields(SpinningLidar)} - {"lasers"})
    numbers: dict[str, Any] = {
        name: value if name in ("shots", "return_mode") else float(value)
        for name, value in settings.items()
    }
    sensor = SpinningLidar(_lasers(content["lasers"]), **numbers)
    name, source = (str(content.get(key, "")) for key in ("name", "source"))
    return SensorFile(name or path.stem, source, sensor)


def _calibrated_lasers(lasers: list[Any]) -> Lasers:
    table = sorted(lasers, key=lambda laser: -laser["vert_correction"])
    columns = {
        name: np.array([laser.get(key, 0.0) for laser in table], float)
        for name, key in _CALIBRATION.items()
    }
    columns["height_m"] /= np.cos(columns["inclination_rad"])  # it is measured across the beam
    return _lasers(columns)


def _lasers(columns: Mapping[str, Any]) -> Lasers:
    """Laser table of these columns; missing gains are 1, other missing values 0."""
    names = [field.name for field in fields(Lasers)]
    in_degrees = {n.replace("_rad", "_deg"): n for n in names if n.endswith("_rad")}
    _check_names("column", columns, {*names, *in_degrees})
    table = {
        in_degrees.get(name, name): np.array(values, float) for name, values in columns.items()
    }
    for name in set(columns) & set(in_degrees):
        table[in_degrees[name]] = np.radians(table[in_degrees[name]])
    num_beams = len(table["inclination_rad"])
    for name in names:
        table.setdefault(name, np.full(num_beams, _default_of(name)))
    return Lasers(**{name: tuple(map(float, table[name])) for name in names})


def _check_names(kind: str, given: Mapping[str, Any], known: set[str]) -> None:
    if unknown := sorted(set(given) - known):
        raise ValueError(f"unknown {kind} {unknown[0]!r}; choose from {', '.join(sorted(known))}")
