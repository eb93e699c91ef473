"""``r3dpa data sensors``, ``sensor`` and ``plan``: presets, estimates, and fine-tuning on scans."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jsonargparse.typing import PositiveFloat, PositiveInt

from r3dpa.cli.parser import check_file, check_folder


def sensors() -> str:
    """List the sensors that ``--sensor`` takes by name, with their source."""
    from lidarsim.sensors import PRESETS, read_sensor
    from r3dpa.io import text_table

    rows = []
    for name in PRESETS:
        title, source, sensor = read_sensor(name)
        degrees = np.degrees(sensor.lasers.inclination_rad)
        view = f"{degrees[0]:+.2f} to {degrees[-1]:+.2f}"
        limits = f"{sensor.min_range_m:g} to {sensor.max_range_m:g}"
        numbers = [f"{sensor.num_beams}", f"{sensor.shots}", view, limits]
        rows.append([name, title, *numbers, source.strip()])
    header = ["name", "sensor", "beams", "columns", "field of view, deg", "range, m", "source"]
    return text_table(rows, header, "llrrrrl", "plain")


def sensor(scans: Path, *, out: Path, num: PositiveInt = 30) -> str:
    """Estimate a sensor from its scans: beams, columns, range limits, mount.

    Writes a YAML file that ``--sensor`` takes, and beside it a picture of the residuals per beam.

    Args:
        scans: A scan of any format that can be read, or a folder of scans of one sensor.
        out: File to write, ``.yaml``.
        num: Maximum number of scans, evenly spaced.
    """
    check_file(out)
    if out.suffix not in (".yaml", ".yml"):
        raise ValueError(f"--out must be a .yaml file, got {out}")
    from lidarsim.clouds import find_files
    from lidarsim.sensors import estimate
    from r3dpa import viz
    from r3dpa.data.scans import evenly
    from r3dpa.io import text_table

    estimated = estimate(evenly(find_files(scans)[1], num))
    estimated.save(out)
    picture = viz.save(viz.beam_residuals(estimated), out.with_suffix(".png"))
    table = text_table(estimated.rows(), ["quantity", "value", "confidence"], "llr", "plain")
    notes = [f"note: {note}" for note in estimated.notes]
    return "\n".join([table, *notes, f"{out}", f"{picture}"])


def plan(
    sensor: str,
    *,
    scans: Path,
    out: Path,
    minutes: PositiveFloat = 10,
    columns: PositiveInt = 1024,
    workers: PositiveInt = 2,
) -> str:
    """Plan how to fine-tune r3dpa-s on scans of a sensor, within a time.

    Writes ``data.yaml``, ``vae.yaml``, ``flow.yaml`` and ``simulate.yaml`` for the commands of
    ``make my-sensor``. A few scans are simulated to measure the machine.

    Args:
        sensor: Preset of ``r3dpa data sensors`` or YAML of ``r3dpa data sensor``.
        scans: Folder of scans of that sensor; every fifth is held out, at least two.
        out: Folder for the files, and for what the commands write.
        minutes: Time for simulation and training on two cores.
        columns: Columns of the range images, a multiple of 128.
        workers: Processes.
    """
    check_folder(out)
    from r3dpa.data.sensor_plan import SensorPlan

    # Plain numbers, which YAML can hold.
    numbers = (float(minutes), int(columns), int(workers))
    sensor_plan = SensorPlan.of(sensor, str(scans), *numbers)
    sensor_plan.write(out)
    return str(sensor_plan)
