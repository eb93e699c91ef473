"""The files of one simulated drive, in the layout of KITTI-360.

::

    data_3d_raw/2013_05_28_drive_XXXX_sync/velodyne_points/
        timestamps.txt                  one line per scan, 0.1 s apart, or a multiple
        data/%010d.bin                  (P, 4) float32 x, y, z, intensity
        labels/%010d.label              (P,) uint32 semantic | instance << 16
        origins/%010d.origin            (P,) uint8 origin of each point, see ``Origin``
        sim/%010d.json                  summary of the scene and of each effect
        boxes/%010d.txt                 3-D boxes of vehicles and people, see ``kitti_label``
    data_poses/2013_05_28_drive_XXXX_sync/
        velodyne_to_world.txt           one line per scan: number, then (3, 4) row by row

KITTI-360's own ``poses.txt``, of the same format, holds poses of its inertial unit, which is not
simulated; hence the other name. Every file depends on the request only.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.boxes import kitti_label
from lidarsim.io import delete_unfinished, write_bytes
from lidarsim.scan import SimulatedScan
from lidarsim.scene import Conditions, Pose

# In the order of writing: a scan whose points exist is complete.
_SUFFIXES = {"labels": ".label", "origins": ".origin", "sim": ".json", "data": ".bin"}
_FIRST_SCAN = datetime(2013, 5, 28, 8, 46, 2)
_SCAN_PERIOD = timedelta(seconds=0.1)


@dataclass(frozen=True)
class DriveFiles:
    """The files of one drive (a four-digit number) below the root folder of a data set."""

    root: Path
    drive: str

    @property
    def points_folder(self) -> Path:
        """Folder of the scans."""
        return self.root / "data_3d_raw" / drive_name(self.drive) / "velodyne_points"

    def missing(self, count: int) -> list[int]:
        """Numbers below ``count`` of the scans that lack a file, or whose points lack a label."""
        boxes = {path.stem for path in (self.points_folder / "boxes").glob("[!.]*")}
        sizes = {
            kind: {p.stem: p.stat().st_size for p in (self.points_folder / kind).glob("[!.]*")}
            for kind in _SUFFIXES
        }
        complete = {
            stem
            for stem, size in sizes["data"].items()
            if stem in boxes
            and sizes["labels"].get(stem) == size // 4
            and sizes["origins"].get(stem) == size // 16
            and sizes["sim"].get(stem)
        }
        return [number for number in range(count) if _stem(number) not in complete]

    def write_scan(self, number: int, scan: SimulatedScan) -> None:
        """Write the files of a scan, the points last."""
        scene = scan.scene
        summary = {
            "drive": self.drive,
            "scan": number,
            "pose": asdict(scene.pose),
            "motion": asdict(scene.motion),
            "weather": weather_to_dict(scene.weather),
            "primitives": len(scene.primitives),
            "moving_primitives": sum(any(p.velocity_m_s) for p in scene.primitives),
            "puddles": len(scene.puddles),
            "points": len(scan.points),
            "effects": {
                effect.name: {"status": effect.status, "reason": effect.reason, "rays": effect.rays}
                for effect in scan.effects
            },
        }
        contents = {
            "labels": scan.labels.astype("<u4").tobytes(),
            "origins": scan.origins.tobytes(),
            "sim": to_json(summary),
            "data": scan.points.astype("<f4").tobytes(),
        }
        boxes = kitti_label(scan, velodyne_to_world(scene.pose))
        write(self.points_folder / "boxes" / f"{_stem(number)}.txt", boxes.encode())
        for kind in _SUFFIXES:
            write(self._path(kind, number), contents[kind])

    def summaries(self, count: int) -> list[dict[str, Any]]:
        """Contents of ``sim/*.json`` of the first ``count`` scans; errors name a damaged file."""
        advice = "delete it and simulate again, which completes the data set"
        return [read_json(self._path("sim", number), advice) for number in range(count)]

    def write_times_and_poses(self, summaries: Sequence[dict[str, Any]], every: int) -> None:
        """Write ``timestamps.txt`` and ``velodyne_to_world.txt`` of all scans, in order.

        ``every`` is the stride of the files in scans of the drive.
        """
        stamps = (_FIRST_SCAN + summary["scan"] * every * _SCAN_PERIOD for summary in summaries)
        # KITTI-360 stores nanoseconds.
        times = "".join(f"{stamp:%Y-%m-%d %H:%M:%S.%f}000\n" for stamp in stamps)
        write(self.points_folder / "timestamps.txt", times.encode())
        lines = []
        for summary in summaries:
            matrix = velodyne_to_world(Pose(**summary["pose"]))
            numbers = " ".join(f"{value:.12g}" for value in matrix.flat)
            lines.append(f"{summary['scan']} {numbers}\n")
        poses = self.root / "data_poses" / drive_name(self.drive) / "velodyne_to_world.txt"
        write(poses, "".join(lines).encode())

    def delete_unfinished(self) -> None:
        """Delete the temporary files of killed writers."""
        for top in ("data_3d_raw", "data_poses"):
            delete_unfinished(self.root / top / drive_name(self.drive))

    def _path(self, kind: str, number: int) -> Path:
        return self.points_folder / kind / f"{_stem(number)}{_SUFFIXES[kind]}"


def drive_name(number: str) -> str:
    """Folder of a drive in the KITTI-360 layout, of its four-digit number."""
    return f"2013_05_28_drive_{number}_sync"


def velodyne_to_world(pose: Pose) -> NDArray[np.float64]:
    """Matrix ``(3, 4)`` from the sensor frame (middle of the sweep) to the world frame, metres.

    World x east, y north, z up::

        [Rz(heading) Ry(pitch) Rx(roll) | (x, y, z)]
    """
    (cos_h, sin_h), (cos_p, sin_p), (cos_r, sin_r) = (
        (math.cos(angle), math.sin(angle))
        for angle in (pose.heading_rad, pose.pitch_rad, pose.roll_rad)
    )
    heading = np.array([[cos_h, -sin_h, 0], [sin_h, cos_h, 0], [0, 0, 1]])
    pitch = np.array([[cos_p, 0, sin_p], [0, 1, 0], [-sin_p, 0, cos_p]])
    roll = np.array([[1, 0, 0], [0, cos_r, -sin_r], [0, sin_r, cos_r]])
    return np.column_stack([heading @ pitch @ roll, (pose.x_m, pose.y_m, pose.z_m)])


def weather_to_dict(weather: Conditions) -> dict[str, Any]:
    """The weather as JSON holds it: a visibility of None, not infinity, without fog."""
    values = {field.name: getattr(weather, field.name) for field in fields(Conditions)}
    if math.isinf(weather.visibility_m):
        values["visibility_m"] = None
    return values


def to_json(values: Any) -> bytes:
    """Plain values and NumPy scalars as the bytes of a JSON file."""
    return f"{json.dumps(values, indent=1, allow_nan=False, default=np.generic.item)}\n".encode()


def read_json(path: Path, advice: str) -> dict[str, Any]:
    """Object of a JSON file; ``ValueError`` with advice if the file is damaged."""
    try:
        values = json.loads(path.read_text())
        if not isinstance(values, dict):
            raise ValueError(f"it holds {type(values).__name__}, not an object")
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged ({error}): {advice}") from error
    return values


def write(path: Path, content: bytes) -> None:
    """Write a file atomically, unless it already holds these bytes."""
    if not path.is_file() or path.read_bytes() != content:
        write_bytes(path, content)


def _stem(number: int) -> str:
    return f"{number:010d}"
