"""``r3dpa data``: checks and views of scans, features of object classes, and sensors."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from jsonargparse.typing import PositiveFloat, PositiveInt

from r3dpa.io import check_file, check_folder
from r3dpa.pretrained import DEFAULT_WEIGHTS, OBJECTS_SUFFIX, check_features

_FRAME_NOTE = (
    "a turn about z cannot be seen in a scan: x has to point forward; where y does, "
    "points[:, [0, 1]] = points[:, [1, 0]] * [1, -1] turns the points"
)
_SCANS_TO_CHECK = 3  # of whose points the share in the image is printed


def check(folder: Path, *, columns: tuple[str, ...] = ()) -> None:
    """List every bad scan and missing folder of a data set; exit with 1 if there is any.

    Says which columns scans hold, which beams they show and how sure that is, which files were
    skipped, and whether points are in the frame of the vehicle.

    Args:
        folder: Root in the KITTI-360 layout, or a folder of scans of any format that can be read.
        columns: Columns of files without names, such as ``x,y,z,intensity,ring``; default:
            inferred from the values.
    """
    from lidarsim.cloud_formats import READABLE
    from lidarsim.clouds import read_cloud, suffix_of
    from lidarsim.scan_folders import files_below, find_files

    if not folder.exists():  # said before torch is imported
        sys.stdout.write(f"bad: {folder}: is no folder and no file; can be read: {READABLE}\n")
        sys.exit(1)
    from lidarsim.scan_files import ScanError
    from lidarsim.survey import describe_scan, skipped_files
    from r3dpa.data.scans import RAW, evenly, scan_files, verdict
    from r3dpa.data.scans import check as check_scans

    is_layout = (folder / RAW).is_dir()
    files = list(scan_files(folder))
    kitti = [file for file in sorted(files) if suffix_of(file) == ".bin" and not columns]
    lines: list[str] = []
    others: list[Path] = []
    if not kitti and not is_layout:
        with suppress(ScanError):  # which check_scans says
            others = find_files(folder)[1]
    num_bad = 0
    for file in others or evenly(kitti, 4):
        try:
            cloud = read_cloud(file, columns)
            cloud.check_metres()
            lines.append(describe_scan(cloud))
        except ScanError as error:
            num_bad += 1
            if others:  # a bad .bin file is named by check_scans
                lines.append(f"bad: {error}")
    if others:
        text = f"{folder.absolute()}: {verdict(len(others), num_bad)}"
        usable = num_bad == 0
    else:
        text, usable = check_scans(folder)
    is_plain = not is_layout and bool(others or kitti)
    if is_plain and (line := skipped_files(files_below(folder), others or kitti)):
        lines.append(line)
    sys.stdout.write("\n".join([*lines, text, ""]))
    if not usable:
        sys.exit(1)


def view(
    source: Path,
    *,
    out: Path | None = None,
    num: PositiveInt = 8,
    columns: tuple[str, ...] = (),
) -> str:
    """Draw scans as range images, from above, and as a page with point clouds to turn.

    Range images reach as far up, down and away as the points of the scans.

    Args:
        source: A scan of any format that can be read, a folder of scans, or a ``.npz`` of scans.
        out: Folder for the pictures and the page; default: ``view/<name of the source>``.
        num: Maximum number of scans, evenly spaced over the folder.
        columns: Columns of files without names, such as ``x,y,z,intensity,ring``; default:
            inferred from the values.
    """
    import numpy as np

    from r3dpa import viz
    from r3dpa.data.scans import evenly
    from r3dpa.geometry import LidarSensor, SphericalProjection
    from r3dpa.scene_files.generated import page_scans
    from r3dpa.viz.scenes import write_page

    check_folder(out)
    readers = page_scans(source, columns)
    scans = [read() for read in evenly(readers, num)]
    drawn = {scan.name: scan.points for scan in scans}
    resolved = source.resolve()
    out = out or Path("view") / (resolved.name if resolved.is_dir() else resolved.stem)
    points = np.concatenate([scan.points[:, :3] for scan in scans])
    sensor = LidarSensor.around(points)
    strips = viz.range_strips(drawn, SphericalProjection(sensor))
    title = f"{resolved.name} - r3dpa data view"
    paths = [
        viz.save(strips, out / "range_images.png"),
        viz.save(viz.birds_eye_sheet(drawn), out / "birds_eye.png"),
        write_page(out / "view.html", scans, title, sensor=sensor),
    ]
    line = f"{len(scans)} of {len(readers)} scans in {source}"
    return "\n".join([line, *map(str, paths), "open the .html file in a browser"])


def objects(
    *,
    data: str,
    out: Path,
    ckpt: Path = Path(DEFAULT_WEIGHTS),
    features_ckpt: Path | None = None,
    limit: PositiveInt = 200,
    columns: tuple[str, ...] = (),
    device: str = "auto",
) -> str:
    """Write the mean feature of each class of labelled scans, for ``r3dpa edit inpaint``.

    Args:
        data: Folder, file or glob of scans with labels beside them: of ``r3dpa data simulate``,
            KITTI-360 or SemanticKITTI; or a data YAML of simulated images with classes.
        ckpt: Checkpoint to edit with; its feature source, sensor and grid are used.
        out: File to write, ``.safetensors``, or ``.objects`` beside the weights of that name,
            where ``r3dpa edit inpaint --object`` finds it.
        features_ckpt: Weights of the feature source, if it has none of its own.
        limit: Maximum number of scans, evenly spaced.
        columns: Columns of files without names, such as ``x,y,z,intensity,ring``; default:
            inferred from the values.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
    """
    check_file(out)
    if out.suffix not in (".safetensors", OBJECTS_SUFFIX):
        raise ValueError(f"--out must be a .safetensors or {OBJECTS_SUFFIX} file, got {out}")
    check_features(ckpt)
    from tqdm import tqdm

    from r3dpa.checkpoints import read_checkpoint
    from r3dpa.cli.features import read_data
    from r3dpa.data import find_scans
    from r3dpa.data.scans import evenly
    from r3dpa.editing.objects import object_library
    from r3dpa.features import feature_source
    from r3dpa.generation import SceneGenerator
    from r3dpa.io import number_of, text_table, usable_device
    from r3dpa.scene_files.generated import feature_source_of

    source = feature_source_of(read_checkpoint(ckpt))
    generator = SceneGenerator.from_checkpoint(ckpt, device="cpu")
    projection, sit = generator.geometry.projection, generator.sit
    extractor: Any = feature_source(source, features_ckpt, sit.feature_dim)
    extractor = extractor.to(usable_device(device))
    images = None
    if data.endswith((".yaml", ".yml")):
        module = read_data(Path(data), columns)
        scans, images = module.limited_split()[0], module.images
    else:
        scans = find_scans(data, columns)
    scans = evenly(scans, limit)
    shown = tqdm(scans, unit="scan", desc="objects", disable=None)
    library = object_library(iter(shown), extractor, projection, sit.grid_size, images)
    library.save(out)
    rows = [
        [
            item.name,
            f"{item.num_scans}",
            f"{item.num_cells}",
            f"{item.num_points}",
            f"{item.spread:.3f}",
        ]
        for item in library.classes
    ]
    table = text_table(rows, ["class", "scans", "cells", "points", "spread"], "rrrrr", "plain")
    spread = "Spread: mean of 1 - cosine between the class's feature and its cells."
    count = number_of(len(scans), "scan")
    return f"{table}\n{spread}\n{count}, features of {source}, written to {out}"


def sensors() -> str:
    """List the sensors that ``--sensor`` takes by name, with their source."""
    import numpy as np

    from lidarsim.sensors import PRESETS, read_sensor
    from r3dpa.io import text_table

    rows = []
    for name in PRESETS:
        title, source, lidar = read_sensor(name)
        lowest_deg, *_, highest_deg = np.degrees(lidar.lasers.inclination_rad)
        rows.append(
            [
                name,
                title,
                f"{lidar.num_beams}",
                f"{lidar.shots}",
                f"{lowest_deg:+.2f} to {highest_deg:+.2f}",
                f"{lidar.min_range_m:g} to {lidar.max_range_m:g}",
                source.strip(),
            ]
        )
    header = ["name", "sensor", "beams", "columns", "field of view, deg", "range, m", "source"]
    return text_table(rows, header, "llrrrrl", "plain")


def sensor(scans: Path, *, out: Path, num: PositiveInt = 30) -> str:
    """Estimate a sensor from its scans: beams, columns, range limits, mount.

    Writes a YAML file that ``--sensor`` takes, and beside it a picture of the residuals per beam.

    Args:
        scans: A scan of any format that can be read, or a folder of scans of one sensor.
        out: File to write, ``.yaml``; neither it nor the picture may exist.
        num: Maximum number of scans, evenly spaced.
    """
    check_file(out)
    if out.suffix not in (".yaml", ".yml"):
        raise ValueError(f"--out must be a .yaml file, got {out}")
    picture = out.with_suffix(".png")
    for file in (out, picture):
        if file.exists():
            raise ValueError(f"{file} exists: delete it, or give another --out")
    import numpy as np
    import torch

    from lidarsim.clouds import read_cloud
    from lidarsim.scan_folders import find_files
    from lidarsim.sensors import estimate
    from r3dpa import viz
    from r3dpa.data.scans import evenly
    from r3dpa.geometry import BeamProjection, describe_share_kept
    from r3dpa.io import text_table

    files = evenly(find_files(scans)[1], num)
    estimated = estimate(files)
    estimated.save(out)
    viz.save(viz.beam_residuals(estimated), picture)
    table = text_table(estimated.rows(), ["quantity", "value", "confidence"], "llr", "plain")
    notes = [f"note: {note}" for note in (*estimated.notes, _FRAME_NOTE)]
    checked = evenly(files, _SCANS_TO_CHECK)
    clouds = [read_cloud(file, drop_nan=True, with_labels=False) for file in checked]
    points = [torch.from_numpy(cloud.points.astype(np.float32)) for cloud in clouds]
    share = describe_share_kept(points, BeamProjection.of(estimated.sensor))
    return "\n".join([table, *notes, share, f"{out}", f"{picture}"])


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
        scans: Folder of scans of that sensor; every fifth is held out, at least two. In place of
            one or two scans, simulated ones are held out.
        out: Folder for the files, and for what the commands write.
        minutes: Time for simulation and training on two cores.
        columns: Columns of the range images, a multiple of 128.
        workers: Processes.
    """
    check_folder(out)
    from lidarsim.sensors import load_sensor

    load_sensor(sensor)  # refuses an unknown one before torch is imported
    from r3dpa.data.sensor_plan import SensorPlan

    # YAML cannot hold the number types of options.
    sensor_plan = SensorPlan.of(
        sensor, str(scans), minutes=float(minutes), columns=int(columns), workers=int(workers)
    )
    sensor_plan.write(out)
    return str(sensor_plan)
