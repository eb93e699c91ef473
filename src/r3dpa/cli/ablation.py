"""``r3dpa simulate --ablate``: scan with all effects and without each one.

Each effect is switched off in the scans that call for it. The random draws of the other effects
stay as they are, so what changes is the effect's doing.
"""

from __future__ import annotations

import csv
import json
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from r3dpa.bench.simulation import DRIVES, WEATHERS
from r3dpa.cli.ablation_report import NOTHING, Ablation, EffectAblation
from r3dpa.cli.realism import pooled
from r3dpa.data.scans import find_scans
from r3dpa.io import atomic_path, command, machine, versions
from r3dpa.metrics import scan_statistics
from r3dpa.simulation import (
    EFFECTS,
    SimulatedScan,
    SpinningLidar,
    Street,
    Switch,
    Weather,
    effect_name,
    simulate_scan,
)
from r3dpa.simulation.drive_files import weather_to_dict
from r3dpa.simulation.weather import WeatherPrior

_DRY, _DUAL, _GIVEN = "dry", "dual return", "as given"
_DRY_PRIOR = WeatherPrior(clear_dry=1.0, wet=0.0)
# Weather of the scans in turn: half of them dry, as most of a data set is.
_TURNS = (_DRY, "wet", _DRY, "rain", _DRY, "fog", _DRY, "snow", _DRY, "low sun", _DRY, _DUAL)
_SCANS_APART = 25
# Each scan is timed so often with and without an effect, by turns.
_PAIRS = 3


def ablate(
    out: Path,
    sensor: SpinningLidar,
    scans: int = 24,
    seed: int = 0,
    weather: Weather | None = None,
    reference: Path | None = None,
) -> Ablation:
    """Switch off one effect at a time and measure what changes.

    Half of the scans are dry; the others are wet, in rain, fog or snow, under a low sun, or taken
    with two returns a shot, in turn: twelve scans show each once. Scans of two returns are compared
    for that effect alone.

    Args:
        out: Folder for ``ablation.md``, ``.csv`` and ``.json``.
        sensor: Instrument.
        scans: Scenes, 1 or more, spread over all drives.
        seed: Seed of streets and instrument.
        weather: Of all scans, in place of those above.
        reference: Folder of real scans; then the distance to them is told with and without.

    Returns:
        The changes and costs, effect by effect.

    Raises:
        ValueError: If ``scans`` or ``seed`` is out of range, or the reference cannot be used.
    """
    if scans < 1:
        raise ValueError(f"scans must be 1 or greater, got {scans}")
    real = None
    if reference is not None:
        real = pooled(tqdm(find_scans(reference), unit="scan", desc="reference", disable=None))
    effects = {name: EffectAblation() for name in (NOTHING, *map(effect_name, EFFECTS))}
    places = list(_places(scans, seed, weather))
    # Without a terminal there is no bar.
    for name, street, number in tqdm(places, unit="scan", desc="ablate", disable=None):
        two = replace(sensor, return_mode="dual") if name == _DUAL else sensor
        _ablate_scene(effects, street, number, two, ("dual_return",) if name == _DUAL else None)
    settings: dict[str, Any] = {
        "scans": scans,
        "seed": seed,
        "sensor": f"{sensor.num_beams} x {sensor.shots}",
        "reference": None if reference is None else str(reference),
    }
    about: dict[str, str | dict[str, Any]] = {
        "settings": settings if weather is None else settings | weather_to_dict(weather),
        "command": command(),
        "machine": machine(),
        "versions": versions(np),
    }
    ablation = Ablation(Counter(name for name, _, _ in places), effects, real, about)
    _write(out, ablation)
    return ablation


def _places(scans: int, seed: int, weather: Weather | None) -> Iterator[tuple[str, Street, int]]:
    """Stratum, street and number of each scan."""
    for i in range(scans):
        name = _TURNS[i % len(_TURNS)]
        if weather is not None and name != _DUAL:
            name = _GIVEN
        air: Weather | WeatherPrior = WEATHERS.get(name, _DRY_PRIOR)
        # One further each round, so that no stratum keeps to a few drives.
        drive = DRIVES[(i + i // len(_TURNS)) % len(DRIVES)]
        yield name, Street(seed, drive, air if weather is None else weather), _SCANS_APART * i


def _ablate_scene(
    effects: dict[str, EffectAblation],
    street: Street,
    number: int,
    sensor: SpinningLidar,
    only: tuple[str, ...] | None,
) -> None:
    """Scan one scene with all effects and without each of those that it calls for, or of some."""
    scene = street.scene(number, sensor.mount_height_m)
    key = (street.seed, "effects", street.drive, number)

    def scan(off: str) -> tuple[float, SimulatedScan]:
        switches: dict[str, Switch] = {} if off == NOTHING else {off: "off"}
        start = time.perf_counter()
        result = simulate_scan(scene, sensor, key, switches)
        return 1000 * (time.perf_counter() - start), result

    _, complete = scan(NOTHING)
    with_all = scan_statistics(complete.points)
    called = {NOTHING: "the same scan twice"}
    called |= {record.name: record.reason for record in complete.effects if record.status == "ran"}
    for name, why in called.items():
        if only is not None and name not in only:
            continue
        effect = effects[name]
        for pair in range(_PAIRS):
            if pair % 2:
                (less_ms, less), (all_ms, whole) = scan(name), scan(NOTHING)
            else:
                (all_ms, whole), (less_ms, less) = scan(NOTHING), scan(name)
            effect.saved_ms.append(all_ms - less_ms)
            effect.own_ms.append(sum(part.ms for part in whole.effects if part.name == name))
        effect.why = effect.why or why
        effect.scans += 1
        effect.with_all += with_all
        effect.without += scan_statistics(less.points)


def _write(out: Path, ablation: Ablation) -> None:
    rows = list(ablation.rows())
    with atomic_path(out / "ablation.json") as temporary:
        temporary.write_text(json.dumps(ablation.to_dict(), indent=1, allow_nan=False) + "\n")
    with atomic_path(out / "ablation.csv") as temporary, temporary.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    with atomic_path(out / "ablation.md") as temporary:
        temporary.write_text(f"{ablation}\n")
